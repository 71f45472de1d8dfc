"""Rarer forms of listed causes, hidden by their own names only; a draw of all causes leaves them out."""

from __future__ import annotations

import math
from collections.abc import Callable

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
    log_uniform,
    trait,
)

__all__ = ["VARIANTS"]


def _ripple(random: Random, joint: int, scene: Scene) -> Callable[[float], Hidden]:
    phase, turned = random.uniform(-math.pi, math.pi), random.uniform(0.6 * math.pi, 1.4 * math.pi)
    late = random.uniform(0.0, 0.04)
    turns = 160.0 if joint == 5 else 100.0

    def sized(size: float) -> Hidden:
        amplitude = size * 1.5 * MOTOR_NOISE[joint - 1]
        setting = trait(
            joint, ripple_once=amplitude, ripple_once_phase=phase, ripple_back=turned, ripple_late=late
        )
        truth = {"cycles_per_turn": turns, "amplitude": amplitude, "delay": late}
        return Hidden(
            "gear_ripple", "motor", (joint,), size, everywhere(setting), truth, variant="by direction"
        )

    return sized


def _constant(random: Random, joint: int, scene: Scene) -> Callable[[float], Hidden]:
    def sized(size: float) -> Hidden:
        # The largest torque is read so much too large.
        share = min(0.4, 0.12 * size)
        peak = scene.peaks[joint - 1] + COULOMB[joint - 1]
        setting = trait(joint, gain_falls=share / peak**2)
        return Hidden("motor_torque_gain", "motor", (joint,), size, everywhere(setting), variant="saturating")

    return sized


def _creep(random: Random, joint: int, scene: Scene) -> Callable[[float], Hidden]:
    speed = log_uniform(random, 0.01, 0.06)

    def sized(size: float) -> Hidden:
        share = min(0.9, size * 4.0 * MOTOR_NOISE[joint - 1] / COULOMB[joint - 1])
        setting = trait(joint, creep=share, creep_speed=speed)
        return Hidden(
            "presliding_hysteresis",
            "motor",
            (joint,),
            size,
            everywhere(setting),
            {"amplitude": share * COULOMB[joint - 1], "velocity": speed},
            variant="smooth in speed",
        )

    return sized


def _hose(random: Random, joint: int, scene: Scene) -> Callable[[float], Hidden]:
    other = joint + int(random.integers(1, 3))
    ratio = either_sign(random) * log_uniform(random, 0.5, 2.0)

    def sized(size: float) -> Hidden:
        stiffness = size * 1.4 * JOINT_NOISE[joint - 1]
        setting = trait(joint, hose=stiffness, hose_other=float(other), hose_ratio=ratio)
        truth = {"stiffness": stiffness, "source": float(other), "ratio": ratio}
        return Hidden(
            "cable_spring", "joint", (joint,), size, everywhere(setting), truth, variant="over two joints"
        )

    return sized


VARIANTS: dict[str, Cause] = {
    "gear_ripple by direction": Cause("gear_ripple", "motor", _ripple),
    "motor_torque_gain that saturates": Cause("motor_torque_gain", "motor", _constant, (1, 2, 3, 4)),
    "presliding_hysteresis smooth in speed": Cause("presliding_hysteresis", "motor", _creep),
    "cable_spring over two joints": Cause("cable_spring", "joint", _hose, (1, 2, 3, 4, 5)),
}
"""Ways to hide a form of a cause."""
