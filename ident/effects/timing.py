"""Causes in the timing of the channels: torques late against the positions, lost samples."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from ident.effects.effect import (
    Column,
    Effect,
    Experiment,
    Form,
    Parameter,
    Parameters,
    Plant,
    Reading,
    Setting,
    Shape,
    Simulated,
)
from ident.effects.motion import Floats, Motion

__all__ = ["JointTorqueDelay", "LostSamples", "MotorTorqueDelay"]


class _Delay(Effect):
    """The torques of a channel are `delay` older than the positions beside them."""

    side = "timing"
    source = "Swevers, Verdonck and De Schutter, IEEE Control Systems Magazine 27 (2007)"
    depends_on = "velocity"
    hidden = ("share",)
    whole_arm = True
    experiment = Experiment.CHIRP
    tell_apart = "a 1 to 15 Hz chirp of one joint"
    grid_s: tuple[float, ...]

    def shapes(self, setting: Setting, joint: int) -> Sequence[Shape]:
        """From a millisecond to thirty, late and early."""
        return [Shape(delay=sign * delay) for delay in self.grid_s for sign in (1.0, -1.0)]

    def late(self, motion: Motion, torque: Floats, delay: float) -> Floats:
        """Torque (N, n) of `delay` before, minus that of now."""
        before = motion.time - delay
        return np.column_stack([np.interp(before, motion.time, column) for column in torque.T]) - torque

    def simulate(self, joint: int, parameters: Parameters, form: str | Form | None = None) -> Simulated:
        """Reports old torques."""
        cycles = max(0, round(1e3 * float(parameters["delay"])))
        past: list[Any] = []

        def sense(time_s: float, plant: Plant, reading: Reading) -> None:
            torque = reading.motor_torque if self.channel == "motor" else reading.joint_torque
            past.append(torque.copy())
            if len(past) > cycles + 1:
                past.pop(0)
            torque[:] = past[0]

        return Simulated(sense_motor=sense) if self.channel == "motor" else Simulated(sense=sense)


# Time in which friction turns after a reversal, about: a presliding length of 0.1 mrad at 5 rad/s^2.
_TURN_S = 5e-3


class MotorTorqueDelay(_Delay):
    """The motor torque is `delay` older than the positions beside it."""

    cause = "motor_torque_delay"
    summary = "motor torque late against the position"
    physics = "the motor torques take longer through the controller than the positions"
    parameters = (
        Parameter("share", "1", "share of the torque that is late", low=0.5, high=1.5, share=True),
        Parameter("delay", "s", "age of the motor torques", shape=True, low=-0.2, high=0.2),
    )
    channel = "motor"
    confused_with = ("presliding_hysteresis", "joint_elasticity")
    # Close enough that friction's turns overlap.
    grid_s = (0.001, 0.002, 0.004, 0.007, 0.011, 0.015, 0.021, 0.03)

    def columns(self, motion: Motion, joint: int, shape: Shape) -> tuple[Column, ...]:
        """Earlier minus present predicted torque, in all motor rows.

        Coulomb friction is in it where the delay is longer than it takes to turn after a reversal. A shorter delay
        and another presliding length look alike there.
        """
        torque = motion.motor_torque if abs(shape["delay"]) > _TURN_S else motion.smooth_torque("motor")
        return (Column(motor=self.late(motion, torque, shape["delay"])),)


class JointTorqueDelay(_Delay):
    """The joint torque is `delay` older than the positions beside it."""

    cause = "joint_torque_delay"
    summary = "joint torque late against the position"
    physics = "the joint torques take longer through the controller than the positions"
    parameters = (
        Parameter("share", "1", "share of the torque that is late", low=0.5, high=1.5, share=True),
        Parameter("delay", "s", "age of the joint torques", shape=True, low=-0.2, high=0.2),
    )
    channel = "joint"
    confused_with = ("sensor_hysteresis", "joint_elasticity")
    grid_s = (0.001, 0.002, 0.004, 0.008, 0.016, 0.032)

    def columns(self, motion: Motion, joint: int, shape: Shape) -> tuple[Column, ...]:
        """Earlier minus present predicted torque without the jumps at reversals, in all joint rows."""
        return (Column(joint=self.late(motion, motion.smooth_torque("joint"), shape["delay"])),)


class LostSamples(Effect):
    """A share of the samples of a channel repeats the one before, or is missing."""

    cause = "lost_samples"
    side = "timing"
    summary = "dropped, repeated or held samples"
    physics = "packets are lost, come twice, or a value is held on its way"
    source = "the channels themselves: equal values in a row, gaps of the counter"
    parameters = (Parameter("share", "1", "share of the samples", low=0.0, high=1.0, share=True),)
    depends_on = "time"
    whole_arm = True
    counted = True
    experiment = Experiment.REPEATED_RUN
    tell_apart = "record at rest for ten seconds and look at the counter and at repeated values"

    def shapes(self, setting: Setting, joint: int) -> Sequence[Shape]:
        """None: seen in the channels, not in residuals."""
        return []

    def columns(self, motion: Motion, joint: int, shape: Shape) -> tuple[Column, ...]:
        """No torque of its own."""
        return (Column(motor=np.zeros_like(motion.q), joint=np.zeros_like(motion.q)),)

    def simulate(self, joint: int, parameters: Parameters, form: str | Form | None = None) -> Simulated:
        """Holds the reported joint torque for a cycle, now and then."""
        return _Held(float(parameters["share"]))


class _Held(Simulated):
    def __init__(self, share: float) -> None:
        super().__init__()
        self.share = share
        self.random = np.random.default_rng(0)
        self.last: Any = None

    def start(self, joints: int, random: np.random.Generator) -> None:
        self.random = random

    def sense(self, time_s: float, plant: Plant, reading: Reading) -> None:
        if self.last is not None and self.random.random() < self.share:
            reading.joint_torque[:] = self.last
        self.last = reading.joint_torque.copy()
