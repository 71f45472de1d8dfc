"""Faults that no catalogue has."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from benchmarks.mujoco_arms.causes import Cause, Change, Outcome, Variant
from benchmarks.mujoco_arms.days import Setup


def _drive(s: Setup, joint: int, **values: float) -> Setup:
    return replace(s, plant=s.plant.with_drive(joint, **values))


def _body(s: Setup, **values: Any) -> Setup:
    return replace(s, plant=replace(s.plant, body=replace(s.plant.body, **values)))


def _channel(side: str, name: str, unit: str) -> Change:
    """A value of one joint's torque channel."""

    def change(s: Setup, v: Variant, p: float) -> Outcome:
        channel = getattr(s.sensing, side)
        values = getattr(channel, name).copy()
        values[v.joint] += v.sign * p
        sensing = replace(s.sensing, **{side: replace(channel, **{name: values})})
        return replace(s, sensing=sensing), {name: (v.sign * p, unit)}

    return change


def _parameter(name: str, unit: str) -> Change:
    """A parameter of one drive."""

    def change(s: Setup, v: Variant, p: float) -> Outcome:
        return _drive(s, v.joint, **{name: p}), {name: (p, unit)}

    return change


def _stand(s: Setup, v: Variant, p: float) -> Outcome:
    return _body(s, base=1.0 / p), {"compliance": (p, "rad/Nm")}


def _brake_disc(s: Setup, v: Variant, p: float) -> Outcome:
    """A disc on a stage that turns a tenth as fast as the motor rubs in a fifth of its turn."""
    return _drive(s, v.joint, window=p, window_phase=v.angle), {"torque": (p, "Nm")}


def _cushion(s: Setup, v: Variant, p: float) -> Outcome:
    """A stop that is out of place drags a torque against the joint beyond an angle."""
    angle = 0.6 * (v.share - 0.5)
    return _drive(s, v.joint, jump=v.sign * p, jump_angle=angle), {"torque": (v.sign * p, "Nm")}


def _slosh(s: Setup, v: Variant, p: float) -> Outcome:
    """A part p of the payload's mass is a fluid that swings at 1.5 to 3.5 Hz."""
    payload = s.plant.body.payload
    truth = {"share": (p, "1")}
    if payload.mass <= 0.0:
        return s, truth
    rest = replace(payload, mass=payload.mass * (1.0 - p))
    return _body(s, payload=rest, slosh=(payload.mass * p, 1.5 + 2.0 * v.share, 0.08)), truth


def _loose_bolt(s: Setup, v: Variant, p: float) -> Outcome:
    """Half of the payload slides in a play of p."""
    payload = s.plant.body.payload
    truth = {"play": (p, "m")}
    if payload.mass <= 0.0:
        return s, truth
    rest = replace(payload, mass=0.5 * payload.mass)
    return _body(s, payload=rest, rattle=(0.5 * payload.mass, p)), truth


def _long_hose(s: Setup, v: Variant, p: float) -> Outcome:
    return _body(s, long_hose=p), {"stiffness": (p, "N/m")}


def _jitter(s: Setup, v: Variant, p: float) -> Outcome:
    motor = replace(s.sensing.motor, jitter=p)
    return replace(s, sensing=replace(s.sensing, motor=motor)), {"jitter": (p, "s")}


def _softening(s: Setup, v: Variant, p: float) -> Outcome:
    """Stiffness that falls by p a kelvin, in a drive that warms in a minute."""
    heat = float(s.plant.drive["heat"][v.joint]) * 12.0
    return _drive(s, v.joint, softening_kelvin=-p, heat=heat, cooling=60.0), {"per_kelvin": (-p, "1/K")}


def _soft_start(s: Setup, v: Variant, p: float) -> Outcome:
    """A spring that has lost the share p of its stiffness at rest, and has it back at the largest torque."""
    stiffness = float(s.plant.drive["stiffness"][v.joint])
    twist = float(v.peaks[v.joint]) / stiffness
    s = _drive(s, v.joint, stiffness=(1.0 - p) * stiffness, hardening=p * stiffness / twist**2)
    return s, {"share": (p, "1")}


def _hum(s: Setup, v: Variant, p: float) -> Outcome:
    """A line frequency that the sampling folds down to about a hertz, on a motor's current."""
    motor, unit = s.sensing.motor, np.eye(s.arm.kind.size)[v.joint]
    motor = replace(motor, hum=p * unit, hum_hz=0.4 + 2.0 * v.share)
    truth = {"amplitude": (p, "Nm"), "frequency": (motor.hum_hz, "Hz")}
    return replace(s, sensing=replace(s.sensing, motor=motor)), truth


OUTSIDE = {
    cause.name: cause
    for cause in (
        Cause("soft_stand", "joint", _stand, (3e-07, 4e-4), "arm", listed=False),
        Cause("brake_disc", "motor", _brake_disc, (0.1, 60.0), listed=False),
        Cause("aliased_hum", "sensor", _hum, (0.004, 30.0), listed=False),
        Cause(
            "shaken_sensor", "sensor", _channel("joint", "inertia", "Nm s2/rad"), (0.002, 5.0), listed=False
        ),
        Cause("sloshing_payload", "joint", _slosh, (0.01, 0.9), "arm", listed=False),
        Cause("loose_bolt", "joint", _loose_bolt, (1e-4, 0.06), "arm", listed=False),
        Cause("long_hose", "joint", _long_hose, (0.1, 500.0), "arm", listed=False),
        Cause("neighbour_friction", "motor", _parameter("neighbour", "Nm s/rad"), (0.05, 40.0), listed=False),
        Cause(
            "gravity_friction",
            "motor",
            _parameter("gravity_friction", "1"),
            (0.001, 1.5),
            "heavy",
            listed=False,
        ),
        Cause("standstill_friction", "motor", _parameter("dwell", "1"), (0.1, 30.0), listed=False),
        Cause("clock_jitter", "timing", _jitter, (0.001, 0.3), "arm", listed=False),
        Cause(
            "bent_sensor", "sensor", _channel("joint", "bend", "1/Nm"), (1e-5, 0.02), "heavy", listed=False
        ),
        Cause("stop_cushion", "joint", _cushion, (0.05, 40.0), listed=False),
        Cause("warm_spring", "joint", _softening, (0.002, 0.08), "elastic", "motor", listed=False),
        Cause("soft_start_spring", "joint", _soft_start, (0.1, 0.98), "elastic", "motor", listed=False),
    )
}
"""By name; no name is a cause of the catalogue."""
