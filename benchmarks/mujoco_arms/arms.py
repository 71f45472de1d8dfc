"""The arms: rigid bodies from a URDF, drives after data sheets, and the individuals drawn from them."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fri.errors import ConfigurationError
from lwr_driver.configuration import CONFIGS

Floats = NDArray[np.float64]

_UR5 = "share/example-robot-data/robots/ur_description/urdf/ur5_robot.urdf"


@dataclass(frozen=True)
class Kind:
    """An arm of the catalogue, all values per joint.

    inertia : of the drive at the joint [kg m2]. coulomb [Nm], viscous [Nm s/rad] : friction of the drive
    stiffness : of the elastic joints [Nm/rad], 0 for a rigid one. damping : of their spring [Nm s/rad]
    span, speed : positions and speeds in use [rad, rad/s]. effort : range of the torque channels [Nm]
    flange : body that carries the payload. tool : from its frame to the payload's centre [m]
    payloads : masses that the arm carries [kg]
    """

    name: str
    urdf: str
    joints: tuple[str, ...]
    inertia: Floats
    coulomb: Floats
    viscous: Floats
    stiffness: Floats
    damping: Floats
    gear: Floats
    span: tuple[Floats, Floats]
    speed: Floats
    effort: Floats
    flange: str
    tool: tuple[float, float, float]
    payloads: tuple[float, float]
    sensors: bool = True

    @property
    def size(self) -> int:
        """Number of joints."""
        return len(self.joints)


@dataclass(frozen=True)
class Individual:
    """One arm of a kind. What a healthy drive of the kind has besides Coulomb and viscous friction.

    encoder : side of the joints that the positions are of. rate : of them [Hz]. resolution : of them [rad]
    motor_divider : of the motor torques' rate. has_sensors : whether joint torques are measured
    stribeck : rise over Coulomb at standstill. stribeck_speed [rad/s]. curve : share of the viscous friction
    lost at full speed. load : friction per transmitted torque. coulomb_kelvin, viscous_kelvin : change per
    kelvin. heat : warming by friction [K/J]. presliding : displacement to full slip [rad]. ripple : torque of
    one and two cycles a motor turn [Nm], (2, n). hose : spring of the hoses about the joint [Nm/rad]
    """

    kind: Kind
    encoder: str
    rate: float
    motor_divider: int
    inertia: Floats
    coulomb: Floats
    viscous: Floats
    stiffness: Floats
    stribeck: Floats
    stribeck_speed: Floats
    curve: Floats
    asymmetry: Floats
    load: Floats
    coulomb_kelvin: Floats
    viscous_kelvin: Floats
    heat: Floats
    presliding: Floats
    ripple: Floats
    ripple_phase: Floats
    bearing: Floats
    hose: Floats
    has_sensors: bool = True
    resolution: float = 2.0 * np.pi / 2**19

    def traits(self) -> dict[str, dict[int, dict[str, float]]]:
        """Effects of the healthy arm by cause and joint (from 1), with the values of their parameters."""
        joints = range(self.kind.size)
        elastic = [j for j in joints if self.kind.stiffness[j] > 0.0]
        amplitude = self.stribeck * self.coulomb
        ripple = self.ripple.max(axis=0)
        half = self.asymmetry * self.coulomb
        return {
            "stribeck": {j + 1: {"amplitude": float(amplitude[j])} for j in joints},
            "viscous_nonlinear": {j + 1: {} for j in joints},
            "friction_asymmetry": {j + 1: {"coulomb": float(half[j])} for j in joints},
            "friction_load": {j + 1: {"factor": float(self.load[j])} for j in joints},
            "friction_temperature": {j + 1: {} for j in joints},
            "presliding_hysteresis": {j + 1: {} for j in joints},
            "gear_ripple": {j + 1: {"amplitude": float(ripple[j])} for j in joints},
            "joint_elasticity": {j + 1: {"stiffness": float(self.stiffness[j])} for j in elastic},
            "cable_spring": {j + 1: {"stiffness": float(self.hose[j])} for j in joints},
        }


def individual(kind: Kind, random: np.random.Generator) -> Individual:
    """An arm of the kind: parts differ by tens of per cent, habits are small."""
    n = kind.size

    def about(value: Floats, share: float) -> Floats:
        return np.asarray(value * random.uniform(1.0 - share, 1.0 + share, n))

    def between(low: float, high: float) -> Floats:
        return np.asarray(random.uniform(low, high, n))

    ripple = kind.coulomb * random.uniform(0.002, 0.02, (2, n))
    rate = float(random.choice([100.0, 125.0, 200.0, 250.0, 500.0, 1000.0]))
    return Individual(
        kind=kind,
        encoder="motor" if random.random() < 0.3 else "link",
        rate=rate,
        motor_divider=int(random.choice([1, 1, 2, 3])) if rate >= 200.0 else 1,
        inertia=about(kind.inertia, 0.05),
        coulomb=about(kind.coulomb, 0.3),
        viscous=about(kind.viscous, 0.3),
        stiffness=about(kind.stiffness, 0.25),
        stribeck=between(0.02, 0.12),
        stribeck_speed=between(0.02, 0.12),
        curve=between(0.0, 0.08),
        asymmetry=between(-0.02, 0.02),
        load=between(0.002, 0.015),
        coulomb_kelvin=-between(0.001, 0.004),
        viscous_kelvin=-between(0.003, 0.012),
        heat=between(0.001, 0.004) * 100.0 / (kind.coulomb * kind.speed * 10.0),
        presliding=between(1e-4, 6e-4),
        ripple=ripple,
        ripple_phase=random.uniform(0.0, 2.0 * np.pi, (2, n)),
        bearing=between(0.0, 0.03) * kind.coulomb,
        hose=between(0.0, 0.004) * kind.effort * 0.3,
        has_sensors=kind.sensors,
    )


def bare(urdf: str) -> str:
    """The URDF without geometry and foreign elements."""
    root = ET.fromstring(urdf)
    for element in list(root):
        if element.tag not in ("link", "joint"):
            root.remove(element)
    for link in root.iter("link"):
        for element in [*link.findall("visual"), *link.findall("collision")]:
            link.remove(element)
    return re.sub(r"\n\s*\n", "\n", ET.tostring(root, encoding="unicode"))


@cache
def lwr4plus() -> Kind:
    """The KUKA LWR4+ of the driver, drives as published (reference Table 2), four elastic joints."""
    ranges = np.radians([165.0, 112.0, 165.0, 112.0, 165.0, 112.0, 165.0])
    return Kind(
        name="KUKA LWR4+",
        urdf=bare((CONFIGS / "lwr4plus.urdf").read_text(encoding="utf-8")),
        joints=("A1", "A2", "E1", "A3", "A4", "A5", "A6"),
        inertia=np.array([3.14, 2.58, 2.14, 1.97, 0.67, 0.38, 0.42]),
        coulomb=np.array([13.0, 14.0, 8.8, 9.2, 6.5, 4.5, 4.8]),
        viscous=np.array([15.5, 17.0, 7.2, 11.3, 4.8, 3.0, 1.8]),
        stiffness=np.array([10e3, 10e3, 9e3, 9e3, 0.0, 0.0, 0.0]),
        damping=np.array([12.0, 12.0, 5.0, 5.0, 0.0, 0.0, 0.0]),
        gear=np.array([100.0, 100.0, 100.0, 100.0, 160.0, 100.0, 100.0]),
        span=(-ranges, ranges),
        speed=np.array([1.9, 1.9, 1.95, 1.95, 1.95, 1.95, 1.95]),
        effort=np.array([176.0, 176.0, 100.0, 100.0, 100.0, 38.0, 38.0]),
        flange="link_7",
        tool=(0.0, 0.0, 0.14),
        payloads=(1.5, 4.5),
    )


@cache
def ur5() -> Kind:
    """A UR5: bodies of `example-robot-data`, drives of our own with harmonic gears."""
    return Kind(
        name="UR5",
        urdf=bare(_ur5_file().read_text(encoding="utf-8")),
        joints=(
            "shoulder_pan_joint",
            "shoulder_lift_joint",
            "elbow_joint",
            "wrist_1_joint",
            "wrist_2_joint",
            "wrist_3_joint",
        ),
        inertia=np.array([2.1, 2.1, 1.7, 0.36, 0.33, 0.31]),
        coulomb=np.array([11.0, 12.5, 8.5, 2.4, 2.6, 2.1]),
        viscous=np.array([13.0, 14.0, 9.5, 2.1, 2.2, 1.7]),
        stiffness=np.array([16e3, 16e3, 12e3, 0.0, 0.0, 0.0]),
        damping=np.array([15.0, 15.0, 8.0, 0.0, 0.0, 0.0]),
        gear=np.full(6, 101.0),
        span=(np.array([-2.8, -2.9, -2.5, -2.8, -2.8, -2.8]), np.array([2.8, 0.0, 2.5, 2.8, 2.8, 2.8])),
        speed=np.array([2.0, 2.0, 2.2, 2.8, 2.8, 2.8]),
        effort=np.array([150.0, 150.0, 150.0, 28.0, 28.0, 28.0]),
        flange="wrist_3_link",
        tool=(0.0, 0.13, 0.0),
        payloads=(1.0, 4.0),
    )


def _ur5_file() -> Path:
    import mujoco

    for folder in (Path(mujoco.__file__).parents[1], Path(np.__file__).parents[1]):
        path = folder / "cmeel.prefix" / _UR5
        if path.is_file():
            return path
    raise ConfigurationError(f"{_UR5} is not installed; run pip install 'example-robot-data>=4'")


KINDS = {"lwr4plus": lwr4plus, "ur5": ur5}
