"""A joint torque sensor whose zero moves."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ident.effects.effect import Column, Effect, Parameter, Setting, Shape, Simulated
from ident.effects.motion import Motion
from ident.effects.sessions import shares_of_session, steps_between


class SensorOffsetDrift(Effect):
    """The sensor's zero moves by `drift`: as 1 - exp(-t / time_constant) in each session, or from the session
    number `since` on, beside a `zero` that all sessions share.

    Before a motion starts a zero has moved by whatever it likes: sessions of which each has its own have two
    numbers, the zero of the first and the step to the later ones, and one column for both would leave the other
    to whatever has another mean in each session.
    """

    cause = "sensor_offset_drift"
    side = "sensor"
    physics = "the strain gauges' zero moves with temperature"
    source = "Hirzinger et al., ICRA 2002"
    parameters = (
        Parameter("drift", "Nm", "change of the zero"),
        Parameter("zero", "Nm", "of all sessions, against the reference"),
        Parameter(
            "time_constant",
            "s",
            "within a session; 0: between the sessions, -1: since the reference",
            shape=True,
        ),
        Parameter(
            "since", "1", "number of the first session after a change between the sessions", shape=True
        ),
        Parameter("own", "1", "1: the sessions before it have a zero of their own too", shape=True),
    )
    tell_apart = "hold one static pose for a minute at the start, in the middle and at the end of the session"

    def shapes(self, setting: Setting, joint: int) -> Sequence[Shape]:
        """From a fifth of the session to a steady drift, and between sessions where there are several."""
        longest = max(setting.durations_s)
        within = [{"time_constant": share * longest} for share in (0.15, 0.4, 1.0, 5.0)]
        return [*within, *steps_between(setting), {"time_constant": -1.0}]

    def continuous(self, shape: Shape) -> tuple[str, ...]:
        """The time constant, where it is one."""
        return ("time_constant",) if shape["time_constant"] > 0.0 else ()

    def mode(self, shape: Shape) -> str | None:
        """Within a session or between sessions."""
        return "within" if shape["time_constant"] > 0.0 else "between"

    def columns(self, motion: Motion, joint: int, shape: Shape) -> tuple[Column, ...]:
        """The course of the zero, in the joint torque only."""
        constant = shape["time_constant"]
        if constant > 0.0:
            return (Column(joint=1.0 - np.exp(-motion.time / constant)),)
        whole = np.ones(len(motion.time))
        return tuple(Column(joint=share * whole) for share in shares_of_session(motion.session, shape))

    def simulate(self, joint: int, parameters: Mapping[str, float]) -> Simulated:
        """Shifts the reported joint torque."""
        drift, constant = float(parameters["drift"]), float(parameters.get("time_constant", 0.0))
        return _Drift(joint, drift, constant, float(parameters.get("zero", 0.0)))


class _Drift(Simulated):
    def __init__(self, joint: int, drift: float, constant: float, zero: float) -> None:
        self.joint, self.drift, self.constant, self.zero = joint, drift, constant, zero

    def sense(self, time_s: float, plant: Any, reading: Any) -> None:
        share = 1.0 - np.exp(-time_s / self.constant) if self.constant > 0.0 else 1.0
        reading.joint_torque[self.joint] += self.drift * share + self.zero
