"""Samples that were dropped, repeated or held."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ident.effects.effect import Column, Effect, Parameter, Setting, Shape, Simulated
from ident.effects.motion import Motion


class LostSamples(Effect):
    """A share of the samples of a channel repeats the one before, or is missing."""

    cause = "lost_samples"
    side = "timing"
    physics = "packets are lost, come twice, or a value is held on its way"
    source = "the channels themselves: equal values in a row, gaps of the counter"
    parameters = (Parameter("share", "1", "share of the samples", low=0.0, high=1.0),)
    whole_arm = True
    tell_apart = "record at rest for ten seconds and look at the counter and at repeated values"

    def shapes(self, setting: Setting, joint: int) -> Sequence[Shape]:
        """None: seen in the channels, not in residuals."""
        return []

    def columns(self, motion: Motion, joint: int, shape: Shape) -> tuple[Column, ...]:
        """No torque of its own."""
        return (Column(motor=np.zeros_like(motion.q), joint=np.zeros_like(motion.q)),)

    def simulate(self, joint: int, parameters: Mapping[str, float]) -> Simulated:
        """Holds the reported joint torque for a cycle, now and then."""
        return _Held(float(parameters["share"]))


class _Held(Simulated):
    def __init__(self, share: float) -> None:
        self.share = share
        self.random = np.random.default_rng(0)
        self.last: Any = None

    def start(self, joints: int, random: np.random.Generator) -> None:
        self.random = random

    def sense(self, time_s: float, plant: Any, reading: Any) -> None:
        if self.last is not None and self.random.random() < self.share:
            reading.joint_torque[:] = self.last
        self.last = reading.joint_torque.copy()
