"""Causes, joints and quantities in words."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence

__all__ = ["CAUSES", "joints_text", "named", "one_joint", "quantity_text", "variable_of"]

CAUSES = {
    "stribeck": "friction rises as the velocity falls towards zero",
    "viscous_nonlinear": "viscous friction is not proportional to velocity",
    "friction_asymmetry": "friction depends on the direction",
    "friction_load": "friction grows with the transmitted torque",
    "friction_temperature": "friction drifts as the joint warms up",
    "friction_position": "friction depends on the joint angle",
    "presliding_hysteresis": "hysteresis around reversals",
    "gear_ripple": "torque periodic in the motor angle",
    "motor_torque_gain": "wrong torque constant",
    "backlash": "lost motion when the torque reverses",
    "joint_elasticity": "the link is not where the motor encoder says",
    "cable_spring": "a torque that depends on the joint angle (hoses, cables)",
    "base_tilt": "gravity is not along the assumed axis",
    "payload_error": "the payload is not the announced one",
    "payload_change": "the payload changes or comes loose during a session",
    "joint_zero_offset": "the zero of the encoder is off",
    "contact": "an outside force during an interval",
    "sensor_gain": "scale of the joint torque sensor",
    "sensor_crosstalk": "the torque of another joint leaks in",
    "sensor_hysteresis": "hysteresis of the joint torque sensor",
    "sensor_saturation": "clipped torque",
    "sensor_offset_drift": "the zero of a sensor moves",
    "sensor_ripple": "sensor error periodic in the angle",
    "motor_torque_delay": "motor torque late against the position",
    "joint_torque_delay": "joint torque late against the position",
    "lost_samples": "dropped, repeated or held samples",
}

_VARIABLES = {
    "velocity": (
        "stribeck",
        "viscous_nonlinear",
        "friction_asymmetry",
        "presliding_hysteresis",
        "motor_torque_delay",
        "joint_torque_delay",
    ),
    "load": (
        "friction_load",
        "motor_torque_gain",
        "backlash",
        "joint_elasticity",
        "sensor_gain",
        "sensor_crosstalk",
        "sensor_hysteresis",
        "sensor_saturation",
    ),
    "position": (
        "friction_position",
        "cable_spring",
        "base_tilt",
        "payload_error",
        "joint_zero_offset",
        "sensor_ripple",
    ),
    "time": ("friction_temperature", "sensor_offset_drift", "payload_change", "contact", "lost_samples"),
    "motor angle": ("gear_ripple",),
}


def variable_of(cause: str, ratio: float = 1.0) -> str:
    """What a cause depends on: velocity, load, position, time or motor angle.

    ratio : turns of what a ripple repeats with for a turn of the joint.
    """
    if cause == "sensor_ripple" and ratio > 1.5:
        return "motor angle"
    return next((name for name, causes in _VARIABLES.items() if cause in causes), "time")


def joints_text(joints: Sequence[int], names: Sequence[str]) -> str:
    """Joints (from 1) as `joint A2` or `joints A2, E1`, `whole arm` for none."""
    if not joints:
        return "whole arm"
    if len(joints) == 1:
        return one_joint(joints[0], names)
    return "joints " + ", ".join(names[j - 1] if 0 < j <= len(names) else str(j) for j in joints)


def one_joint(joint: int, names: Sequence[str]) -> str:
    """A joint (from 1) as `joint A2`; its name alone where that says joint already."""
    name = names[joint - 1] if 0 < joint <= len(names) else str(joint)
    return name if "joint" in name.lower() else f"joint {name}"


def named(text: str, names: Sequence[str]) -> str:
    """A sentence with the names of joints in place of their numbers."""
    return re.sub(r"\bjoint (\d+)\b", lambda match: one_joint(int(match.group(1)), names), text)


def quantity_text(value: float, std: float, unit: str) -> str:
    """A value with its standard deviation to two digits, and the value to no more than that says."""
    unit = "" if unit == "1" else f" {unit.replace('^2', '²')}"
    if not (std > 0.0 and math.isfinite(std)):
        return f"{value:.4g}{unit}"
    places = max(0, 1 - math.floor(math.log10(std)))
    if places > 4:
        return f"{value:.4g} ± {std:.2g}{unit}"
    shown, spread = f"{value:.{places}f}", f"{std:.{places}f}"
    while "." in shown and shown[-1] == spread[-1] == "0":
        shown, spread = shown[:-1].rstrip("."), spread[:-1].rstrip(".")
    return f"{shown} ± {spread}{unit}"
