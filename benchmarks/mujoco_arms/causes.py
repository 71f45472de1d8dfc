"""The faults: each changes sessions of a healthy day by a strength; names as in the file of a diagnosis."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.mujoco_arms.arms import Kind
from benchmarks.mujoco_arms.days import Setup
from benchmarks.mujoco_arms.sensors import Loss, Torque
from benchmarks.mujoco_arms.simulation import Payload

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Variant:
    """What is drawn of a fault besides its strength.

    joint, other : from 0. sign : 1 or -1. choice : of a few forms. angle : [rad]. share : 0 to 1
    peaks : (n,) largest healthy joint torques of the case [Nm]
    """

    joint: int
    other: int
    sign: float
    choice: int
    angle: float
    share: float
    peaks: Floats


Parameter = tuple[float, str]
Outcome = tuple[Setup, Mapping[str, Parameter]]
Change = Callable[[Setup, Variant, float], Outcome]


@dataclass(frozen=True)
class Cause:
    """A fault. `change` gives a session with it, and its parameters with units.

    strengths : where the search for the wanted visibility begins and ends. encoder : that it needs
    where : joints that it is drawn for: all, elastic, heavy (loaded by gravity), arm (no joint)
    absorbed : base parameters take it up, so that it shows only against the reference days
    listed : in the catalogue. also : further names that are as right
    """

    name: str
    side: str
    change: Change
    strengths: tuple[float, float]
    where: str = "all"
    encoder: str | None = None
    absorbed: bool = False
    listed: bool = True
    also: tuple[str, ...] = ()

    def joints(self, kind: Kind) -> list[int]:
        """Joints that it can be in, from 0."""
        if self.where == "elastic":
            return [int(j) for j in np.flatnonzero(kind.stiffness)]
        if self.where == "heavy":
            return list(range(1, kind.size - 1))
        return list(range(kind.size))


def _drive(setup: Setup, joint: int, **values: float) -> Setup:
    return replace(setup, plant=setup.plant.with_drive(joint, **values))


def _value(setup: Setup, name: str, joint: int) -> float:
    return float(setup.plant.drive[name][joint])


def _channel(setup: Setup, side: str, **values: Any) -> Setup:
    channel: Torque = getattr(setup.sensing, side)
    return replace(setup, sensing=replace(setup.sensing, **{side: replace(channel, **values)}))


def _at(base: Floats, joint: int, value: float) -> Floats:
    out = np.array(base, dtype=np.float64)
    out[joint] = value
    return out


def _unit(joint: int, size: int) -> Floats:
    return _at(np.zeros(size), joint, 1.0)


def _stribeck(s: Setup, v: Variant, p: float) -> Outcome:
    speed = 0.03 + 0.09 * v.share
    coulomb = _value(s, "coulomb", v.joint)
    s = _drive(s, v.joint, stribeck=_value(s, "stribeck", v.joint) + p, stribeck_speed=speed)
    return s, {"amplitude": (p * coulomb, "Nm"), "velocity": (speed, "rad/s")}


def _viscous(s: Setup, v: Variant, p: float) -> Outcome:
    curve = _value(s, "curve", v.joint) + v.sign * p
    return _drive(s, v.joint, curve=curve), {"curve": (v.sign * p, "1")}


def _asymmetry(s: Setup, v: Variant, p: float) -> Outcome:
    value = _value(s, "asymmetry", v.joint) + v.sign * p
    coulomb = v.sign * p * _value(s, "coulomb", v.joint)
    return _drive(s, v.joint, asymmetry=value), {"asymmetry": (v.sign * p, "1"), "coulomb": (coulomb, "Nm")}


def _load(s: Setup, v: Variant, p: float) -> Outcome:
    return _drive(s, v.joint, load=_value(s, "load", v.joint) + p), {"factor": (p, "1")}


def _temperature(s: Setup, v: Variant, p: float) -> Outcome:
    if v.choice == 0:
        # A drive that warms in a minute by some ten kelvin.
        heat = _value(s, "heat", v.joint) * 12.0
        s = _drive(s, v.joint, heat=heat, cooling=60.0, coulomb_kelvin=-p, viscous_kelvin=-p)
        return s, {"per_kelvin": (-p, "1/K")}
    start = {"train_1": 0.0, "train_2": 12.0, "test_1": 25.0}[s.role]
    s = _drive(s, v.joint, coulomb_kelvin=-p, viscous_kelvin=-p)
    kelvin = _at(s.plant.kelvin, v.joint, s.plant.kelvin[v.joint] + start)
    return replace(s, plant=replace(s.plant, kelvin=kelvin)), {"per_kelvin": (-p, "1/K")}


def _position(s: Setup, v: Variant, p: float) -> Outcome:
    cycles = float(1 + v.choice)
    s = _drive(s, v.joint, place_amplitude=p, place_phase=v.angle, place_cycles=cycles)
    return s, {"cycles_per_turn": (cycles, "1"), "relative_amplitude": (p, "1")}


def _presliding(s: Setup, v: Variant, p: float) -> Outcome:
    value = _value(s, "presliding", v.joint) * (1.0 + p)
    return _drive(s, v.joint, presliding=value), {"distance": (value, "rad")}


def _gear_ripple(s: Setup, v: Variant, p: float) -> Outcome:
    cycles = 1 + v.choice
    name, phase = f"ripple_{cycles}", f"phase_{cycles}"
    s = _drive(s, v.joint, **{name: p, phase: v.angle})
    return s, {
        "cycles_per_turn": (cycles * _value(s, "gear", v.joint), "1"),
        "amplitude": (p, "Nm"),
    }


def _gain(side: str) -> Change:
    def change(s: Setup, v: Variant, p: float) -> Outcome:
        gain = getattr(s.sensing, side).gain
        s = _channel(s, side, gain=_at(gain, v.joint, gain[v.joint] * (1.0 + v.sign * p)))
        return s, {"gain": (v.sign * p, "1"), "error": (v.sign * p, "1")}

    return change


def _backlash(s: Setup, v: Variant, p: float) -> Outcome:
    return _drive(s, v.joint, gap=p), {"width": (p, "rad")}


def _elasticity(s: Setup, v: Variant, p: float) -> Outcome:
    stiffness = _value(s, "stiffness", v.joint) / (1.0 + p)
    return _drive(s, v.joint, stiffness=stiffness), {"stiffness": (stiffness, "Nm/rad")}


def _cable(s: Setup, v: Variant, p: float) -> Outcome:
    rest = v.angle - np.pi
    body = replace(s.plant.body, hoses=(*s.plant.body.hoses, (v.joint, p, 0.3 * rest)))
    return replace(s, plant=replace(s.plant, body=body)), {"stiffness": (p, "Nm/rad")}


def _tilt(s: Setup, v: Variant, p: float) -> Outcome:
    """The base leans by p about a level axis at `angle`: about its x and its y axis by small angles."""
    x, y = p * np.cos(v.angle), p * np.sin(v.angle)
    gravity = (9.81 * np.sin(y), -9.81 * np.sin(x), -9.81 * np.cos(p))
    plant = replace(s.plant, body=replace(s.plant.body, gravity=gravity))
    return replace(s, plant=plant), {"tilt_x": (x, "rad"), "tilt_y": (y, "rad")}


def _lighter(payload: Payload, mass: float) -> Payload:
    return replace(payload, mass=max(mass, 0.0))


def _payload_error(s: Setup, v: Variant, p: float) -> Outcome:
    mass = s.plant.body.payload.mass
    truth = {"mass": (v.sign * p, "kg")}
    if mass <= 0.0:
        return s, truth
    body = replace(s.plant.body, payload=_lighter(s.plant.body.payload, mass + v.sign * p))
    return replace(s, plant=replace(s.plant, body=body)), truth


def _payload_change(s: Setup, v: Variant, p: float) -> Outcome:
    """Some of the payload is lost in the second session, and missing in the third."""
    payload, time = s.plant.body.payload, s.seconds * (0.35 + 0.3 * v.share)
    left = _lighter(payload, payload.mass - p)
    truth = {"mass": (-p, "kg"), "time": (time, "s")}
    if s.role == "train_2":
        return replace(s, plant=replace(s.plant, change=(time, left))), truth
    if s.role == "test_1":
        body = replace(s.plant.body, payload=left)
        return replace(s, plant=replace(s.plant, body=body)), {}
    return s, {}


def _zero(s: Setup, v: Variant, p: float) -> Outcome:
    offset = v.sign * p
    unit = _unit(v.joint, s.arm.kind.size)
    encoder = replace(s.sensing.encoder, zero=s.sensing.encoder.zero + offset * unit)
    plant = replace(s.plant, zero=s.plant.zero + offset * unit)
    return replace(s, plant=plant, sensing=replace(s.sensing, encoder=encoder)), {"offset": (offset, "rad")}


def _eccentric(s: Setup, v: Variant, p: float) -> Outcome:
    name = ("once", "twice")[v.choice]
    encoder = replace(s.sensing.encoder, **{name: p * _unit(v.joint, s.arm.kind.size)})
    s = replace(s, sensing=replace(s.sensing, encoder=encoder))
    return s, {"cycles_per_turn": (1.0 + v.choice, "1"), "amplitude": (p, "rad")}


def _contact(s: Setup, v: Variant, p: float) -> Outcome:
    """Somebody leans on the arm's end for two seconds, in the first and the last session."""
    if s.role == "train_2":
        return s, {}
    begin = s.seconds * (0.2 + 0.5 * v.share)
    force = p * np.array([np.cos(v.angle), np.sin(v.angle), 0.5 * v.sign, 0.0, 0.0, 0.0])
    push = (begin, begin + 2.0, s.arm.kind.flange, tuple(float(x) for x in force))
    return replace(s, plant=replace(s.plant, push=push)), {"time": (begin, "s")}


def _crosstalk(s: Setup, v: Variant, p: float) -> Outcome:
    leak = s.sensing.joint.leak.copy()
    leak[v.joint, v.other] = v.sign * p
    s = _channel(s, "joint", leak=leak)
    return s, {"factor": (v.sign * p, "1"), "source": (v.other + 1.0, "1")}


def _hysteresis(s: Setup, v: Variant, p: float) -> Outcome:
    return _channel(s, "joint", play=p * _unit(v.joint, s.arm.kind.size)), {"width": (2.0 * p, "Nm")}


def _saturation(s: Setup, v: Variant, p: float) -> Outcome:
    limit = float(v.peaks[v.joint]) * (1.0 - p)
    return _channel(s, "joint", limit=_at(s.sensing.joint.limit, v.joint, limit)), {"limit": (limit, "Nm")}


def _drift(s: Setup, v: Variant, p: float) -> Outcome:
    unit = v.sign * _unit(v.joint, s.arm.kind.size)
    if v.choice == 0:
        return _channel(s, "joint", drift=p * unit / 30.0), {"rate": (v.sign * p / 30.0, "Nm/s")}
    share = {"train_1": -1.0, "train_2": 0.0, "test_1": 1.0}[s.role]
    return _channel(s, "joint", zero=s.sensing.joint.zero + share * p * unit), {"step": (v.sign * p, "Nm")}


def _sensor_ripple(s: Setup, v: Variant, p: float) -> Outcome:
    n = s.arm.kind.size
    cycles = (1.0, 2.0, float(s.arm.kind.gear[v.joint]))[v.choice]
    channel = s.sensing.joint
    s = _channel(
        s,
        "joint",
        ripple=p * _unit(v.joint, n),
        cycles=_at(channel.cycles, v.joint, cycles),
        phase=_at(channel.phase, v.joint, v.angle),
    )
    return s, {"cycles_per_turn": (cycles, "1"), "amplitude": (p, "Nm")}


def _late(side: str) -> Change:
    def change(s: Setup, v: Variant, p: float) -> Outcome:
        delay = getattr(s.sensing, side).delay
        # Like a gain, what it is beyond that of the healthy channel.
        return _channel(s, side, delay=delay + p), {"delay": (p, "s")}

    return change


def _lost(s: Setup, v: Variant, p: float) -> Outcome:
    loss = Loss("held", p, 0.02 + 0.06 * v.share)
    return replace(s, sensing=replace(s.sensing, loss=loss)), {
        "share": (p, "1"),
        "length": (loss.length, "s"),
    }


def _wear(s: Setup, v: Variant, p: float) -> Outcome:
    j = v.joint
    if v.choice == 0:
        s = _drive(
            s, j, coulomb=_value(s, "coulomb", j) * (1.0 + p), viscous=_value(s, "viscous", j) * (1.0 + p)
        )
        return s, {"coulomb": (p, "1"), "viscous": (p, "1")}
    if v.choice == 1:
        return _drive(s, j, inertia=_value(s, "inertia", j) * (1.0 + p)), {"inertia": (p, "1")}
    gain = s.sensing.motor.gain
    return _channel(s, "motor", gain=_at(gain, j, gain[j] * (1.0 + p))), {"gain": (p, "1")}


CAUSES = {
    cause.name: cause
    for cause in (
        Cause("stribeck", "motor", _stribeck, (0.02, 3.0)),
        Cause("viscous_nonlinear", "motor", _viscous, (0.01, 0.7)),
        Cause("friction_asymmetry", "motor", _asymmetry, (0.003, 0.6), absorbed=True),
        Cause("friction_load", "motor", _load, (0.001, 0.6), where="heavy"),
        Cause("friction_temperature", "motor", _temperature, (0.0001, 0.03)),
        Cause("friction_position", "motor", _position, (0.02, 0.9)),
        Cause("presliding_hysteresis", "motor", _presliding, (0.5, 100.0)),
        Cause("gear_ripple", "motor", _gear_ripple, (0.02, 20.0)),
        Cause("motor_torque_gain", "motor", _gain("motor"), (0.001, 0.3), absorbed=True, also=("wear",)),
        Cause("backlash", "joint", _backlash, (1e-4, 0.05), "elastic", "motor"),
        Cause("joint_elasticity", "joint", _elasticity, (0.1, 8.0), "elastic", "motor"),
        Cause("cable_spring", "joint", _cable, (0.02, 30.0)),
        Cause("base_tilt", "joint", _tilt, (0.0001, 0.2), "arm"),
        Cause("payload_error", "joint", _payload_error, (0.003, 3.0), "arm", absorbed=True),
        Cause("payload_change", "joint", _payload_change, (0.01, 2.0), "arm"),
        Cause("joint_zero_offset", "joint", _zero, (0.0002, 0.1), "heavy", absorbed=True),
        Cause("contact", "joint", _contact, (0.2, 80.0), "arm"),
        Cause("sensor_gain", "sensor", _gain("joint"), (0.0005, 0.3), "heavy", absorbed=True),
        Cause("sensor_crosstalk", "sensor", _crosstalk, (0.0002, 0.3)),
        Cause("sensor_hysteresis", "sensor", _hysteresis, (0.004, 20.0)),
        Cause("sensor_saturation", "sensor", _saturation, (0.05, 0.8), "heavy"),
        Cause("sensor_offset_drift", "sensor", _drift, (0.002, 20.0)),
        Cause("sensor_ripple", "sensor", _sensor_ripple, (0.002, 20.0)),
        Cause("motor_torque_delay", "timing", _late("motor"), (0.0005, 0.08), "arm"),
        Cause("joint_torque_delay", "timing", _late("joint"), (0.0005, 0.08), "arm"),
        Cause("lost_samples", "timing", _lost, (2e-4, 0.5), "arm"),
        Cause("wear", "motor", _wear, (0.10, 0.25), absorbed=True, also=("motor_torque_gain",)),
        Cause("encoder_eccentricity", "joint", _eccentric, (2e-4, 0.08)),
    )
}
"""By name, all of the catalogue."""
