"""Days of a healthy arm: what changes from one to the next, and the sessions of a day."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from benchmarks.mujoco_arms.arms import Individual, Kind
from benchmarks.mujoco_arms.motions import STYLES, motion
from benchmarks.mujoco_arms.sensors import Encoder, Label, Sensing, torque_channel
from benchmarks.mujoco_arms.simulation import Body, Payload, Plant, drives

Floats = NDArray[np.float64]

_HERTZ = (6.0, 11.0)
"""Bandwidth of the position controllers; the tuning of a day is drawn in it."""

_OTHER_PAYLOAD = 0.25
_NOISE = 0.35
"""Of an encoder, in its steps."""


@dataclass(frozen=True)
class Setup:
    """One session before it is run.

    role : `train_1`, `train_2`, `test_1`. plant, sensing, label : see there. q, qd : commands
    seed : of the noise. uid : says nothing of what is hidden
    """

    role: str
    arm: Individual
    plant: Plant
    sensing: Sensing
    label: Label
    q: Floats
    qd: Floats
    seed: int
    uid: str

    @property
    def seconds(self) -> float:
        """Length of the motion."""
        return len(self.q) * 1e-3


ROLES = ("train_1", "train_2", "test_1")


def payload(kind: Kind, random: np.random.Generator) -> Payload:
    """A payload as it is mounted every time."""
    centre = np.array(kind.tool) + random.uniform(-0.02, 0.02, 3)
    mass = float(np.round(random.uniform(*kind.payloads), 2))
    return Payload(mass, (float(centre[0]), float(centre[1]), float(centre[2])))


def day(arm: Individual, seed: tuple[int, ...], payloads: tuple[Payload, Payload]) -> list[Setup]:
    """The three sessions of a healthy day: two to fit, without and with a payload, and another motion.

    payloads : the one that hangs there on most days, and the other
    """
    random = np.random.default_rng(seed)
    kind, n = arm.kind, arm.kind.size
    drive = drives(arm)
    drive["coulomb"] *= random.uniform(0.9, 1.1, n)
    drive["viscous"] *= random.uniform(0.85, 1.15, n)
    drive["presliding"] *= random.uniform(0.7, 1.4, n)
    drive["stribeck"] *= random.uniform(0.7, 1.3, n)
    kp, kd = _tuning(kind, arm.inertia, random)
    warmth = random.uniform(0.0, 8.0)
    name, load = "load_A", payloads[0]
    if random.random() < _OTHER_PAYLOAD:
        name, load = "load_B", payloads[1]
    hoses = tuple((j, float(arm.hose[j]), 0.0) for j in range(n))
    sensing = Sensing(
        Encoder(
            quantum=arm.resolution,
            noise=_NOISE * arm.resolution,
            zero=np.zeros(n),
            once=np.zeros(n),
            twice=np.zeros(n),
            phase=random.uniform(0.0, 2.0 * np.pi, n),
        ),
        torque_channel(arm, "motor", random),
        torque_channel(arm, "joint", random),
    )
    styles = [str(style) for style in random.choice(STYLES, 2, replace=False)]
    setups = []
    for index, role in enumerate(ROLES):
        seconds = float(random.uniform(20.0, 40.0)) if random.random() > 0.15 else 60.0
        q, qd = motion(kind, styles[0] if index < 2 else styles[1], seconds, random)
        kelvin = warmth + random.uniform(0.0, 2.0) * index * np.ones(n)
        loaded = index > 0
        body = Body(payload=load if loaded else Payload(), hoses=hoses)
        setups.append(
            Setup(
                role=role,
                arm=arm,
                plant=Plant(kind, drive.copy(), body, kp, kd, kelvin, np.zeros(n)),
                sensing=sensing,
                label=Label(name, load.mass) if loaded else Label(),
                q=q,
                qd=qd,
                seed=int(random.integers(2**31)),
                uid=f"{int(random.integers(2**62)):032x}",
            )
        )
    return setups


def _tuning(kind: Kind, inertia: Floats, random: np.random.Generator) -> tuple[Floats, Floats]:
    """Gains of the position controllers, stiffness [Nm/rad] and damping [Nm s/rad]."""
    hertz, ratio = random.uniform(*_HERTZ), random.uniform(0.6, 1.0)
    moved = 1.5 * inertia + 0.1
    kp = (2.0 * np.pi * hertz) ** 2 * moved
    return kp, 2.0 * ratio * np.sqrt(kp * moved)
