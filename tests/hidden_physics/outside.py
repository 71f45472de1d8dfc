"""What no catalogue has: the diagnosis must see it and not give it a name."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

from tests.hidden_physics.hidden import (
    COULOMB,
    JOINT_NOISE,
    MOTOR_NOISE,
    Cause,
    Hidden,
    Random,
    Scene,
    either_sign,
    everywhere,
    fault,
    trait,
)
from tests.hidden_physics.robots import Setting
from tests.hidden_physics.traits import JOINTS

__all__ = ["OUTSIDE"]


def _other(random: Random, joint: int) -> int:
    return int(random.choice([other for other in range(1, JOINTS + 1) if other != joint]))


def _unlisted(
    cause: str, joint: int, size: float, setting: Setting, depends_on: tuple[str, ...], side: str = "motor"
) -> Hidden:
    """The same in all sessions, on one joint."""
    return Hidden(cause, side, (joint,), size, everywhere(setting), depends_on=depends_on)


def _other_friction(random: Random, joint: int, scene: Scene) -> Callable[[float], Hidden]:
    other, phase = _other(random, joint), random.uniform(-math.pi, math.pi)

    def sized(size: float) -> Hidden:
        share = min(0.6, size * 2.0 * MOTOR_NOISE[joint - 1] / COULOMB[joint - 1])
        setting = trait(joint, other_friction=share, other=float(other), other_phase=phase)
        depends = (f"qd{joint}", f"q{other}")
        return _unlisted("friction by a neighbour's angle", joint, size, setting, depends)

    return sized


def _other_drag(random: Random, joint: int, scene: Scene) -> Callable[[float], Hidden]:
    other, sign = _other(random, joint), either_sign(random)

    def sized(size: float) -> Hidden:
        drag = sign * size * 1.2 * MOTOR_NOISE[joint - 1]
        setting = trait(joint, other_drag=drag, other=float(other))
        return _unlisted("drag by a neighbour's speed", joint, size, setting, (f"qd{other}",))

    return sized


def _memory(random: Random, joint: int, scene: Scene) -> Callable[[float], Hidden]:
    past_s, sign = random.uniform(0.5, 2.0), either_sign(random)

    def sized(size: float) -> Hidden:
        drag = sign * size * 4.0 * MOTOR_NOISE[joint - 1]
        setting = trait(joint, memory=drag, memory_time=past_s)
        return _unlisted("drag by past speed", joint, size, setting, (f"qd{joint}", "history"))

    return sized


def _inertial(random: Random, joint: int, scene: Scene) -> Callable[[float], Hidden]:
    def sized(size: float) -> Hidden:
        share = min(1.0, size * 1.0 * MOTOR_NOISE[joint - 1] / COULOMB[joint - 1])
        setting = trait(joint, inertial_friction=share)
        return _unlisted("friction by acceleration", joint, size, setting, (f"qd{joint}", f"qdd{joint}"))

    return sized


def _shake(random: Random, joint: int, scene: Scene) -> Callable[[float], Hidden]:
    # Not a multiple of the excitation's base frequency, so it differs from period to period.
    rate = random.uniform(0.6, 4.0)

    def sized(size: float) -> Hidden:
        setting = trait(joint, shake=size * 1.5 * MOTOR_NOISE[joint - 1], shake_hz=rate)
        return _unlisted("shaking from outside", joint, size, setting, ("time",))

    return sized


def _bent_sensor(random: Random, joint: int, scene: Scene) -> Callable[[float], Hidden]:
    other, phase = _other(random, joint), random.uniform(-math.pi, math.pi)

    def sized(size: float) -> Hidden:
        scale = size * 2.5 * JOINT_NOISE[joint - 1] / scene.peaks[joint - 1]
        setting = fault(joint, other=float(other), other_scale=scale, other_phase=phase)
        return _unlisted(
            "sensor scale by a neighbour's angle",
            joint,
            size,
            setting,
            (f"q{other}", f"tau{joint}"),
            side="sensor",
        )

    return sized


def _dead_current(random: Random, joint: int, scene: Scene) -> Callable[[float], Hidden]:
    def sized(size: float) -> Hidden:
        dead = min(COULOMB[joint - 1], size * 15.0 * MOTOR_NOISE[joint - 1])
        setting = fault(joint, motor_dead=dead)
        return _unlisted("small currents not reported", joint, size, setting, (f"tau{joint}",))

    return sized


_LOADED = (2, 3, 4)

OUTSIDE: Mapping[str, Cause] = {
    cause.name: cause
    for cause in (
        Cause("friction by a neighbour's angle", "motor", _other_friction),
        Cause("drag by a neighbour's speed", "motor", _other_drag),
        Cause("drag by past speed", "motor", _memory),
        Cause("friction by acceleration", "motor", _inertial),
        Cause("shaking from outside", "motor", _shake),
        Cause("sensor scale by a neighbour's angle", "sensor", _bent_sensor, joints=_LOADED),
        Cause("small currents not reported", "motor", _dead_current),
    )
}
"""Causes that no catalogue has."""
