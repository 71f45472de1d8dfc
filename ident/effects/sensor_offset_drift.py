"""A joint torque sensor whose zero moves."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ident.effects.effect import Column, Effect, Parameter, Setting, Shape, Simulated
from ident.effects.motion import Motion


class SensorOffsetDrift(Effect):
    """The sensor's zero moves by `drift`: as 1 - exp(-t / time_constant) in each session, or
    between sessions.
    """

    cause = "sensor_offset_drift"
    side = "sensor"
    physics = "the strain gauges' zero moves with temperature"
    source = "Hirzinger et al., ICRA 2002"
    parameters = (
        Parameter("drift", "Nm", "change of the zero"),
        Parameter(
            "time_constant",
            "s",
            "within a session; 0: between the sessions, -1: since the reference",
            shape=True,
        ),
    )
    tell_apart = "hold one static pose for a minute at the start, in the middle and at the end of the session"

    def shapes(self, setting: Setting, joint: int) -> Sequence[Shape]:
        """From a fifth of the session to a steady drift, and between sessions where there are several."""
        longest = max(setting.durations_s)
        within = [{"time_constant": share * longest} for share in (0.15, 0.4, 1.0, 5.0)]
        between = [{"time_constant": 0.0}] if setting.sessions > 1 else []
        return [*within, *between, {"time_constant": -1.0}]

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
        return (Column(joint=np.full(len(motion.time), float(constant < 0.0 or motion.session > 0))),)

    def simulate(self, joint: int, parameters: Mapping[str, float]) -> Simulated:
        """Shifts the reported joint torque."""
        return _Drift(joint, float(parameters["drift"]), float(parameters.get("time_constant", 0.0)))


class _Drift(Simulated):
    def __init__(self, joint: int, drift: float, constant: float) -> None:
        self.joint, self.drift, self.constant = joint, drift, constant

    def sense(self, time_s: float, plant: Any, reading: Any) -> None:
        share = 1.0 - np.exp(-time_s / self.constant) if self.constant > 0.0 else 1.0
        reading.joint_torque[self.joint] += self.drift * share
