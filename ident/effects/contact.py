"""An outside force during an interval."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ident.effects.body import force_torque, plant_jacobian
from ident.effects.effect import Column, Effect, Parameter, Setting, Shape, Simulated
from ident.effects.motion import Motion

# Share of its duration by which the middle of a force of any course may differ from that of a half sine.
_COURSE = 0.1


class Contact(Effect):
    """A force [N] on a link, in axes of the base, half a sine of length `duration` around `time`."""

    cause = "contact"
    side = "joint"
    physics = "something or somebody outside pushes the arm for a while"
    source = "Haddadin, De Luca and Albu-Schaeffer, IEEE Trans. Robotics 33 (2017)"
    parameters = (
        Parameter("force_x", "N", "largest force along x of the base"),
        Parameter("force_y", "N", "largest force along y of the base"),
        Parameter("force_z", "N", "largest force along z of the base"),
        Parameter("time", "s", "middle of the contact, from the start of the session", shape=True),
        Parameter("duration", "s", "of the contact", shape=True, low=0.02),
        Parameter("session", "1", "number of the session", shape=True),
        Parameter("link", "1", "link that is pushed, at the origin of the frame after it", shape=True),
    )
    whole_arm = True
    event = True
    tell_apart = "repeat the motion: a contact is tied to the moment, a snagging cable to the posture"

    def shapes(self, setting: Setting, joint: int) -> Sequence[Shape]:
        """None: times and durations come from the residual's bursts."""
        return []

    def continuous(self, shape: Shape) -> tuple[str, ...]:
        """Middle and duration."""
        return ("time", "duration")

    def coarse(self, parameters: Mapping[str, float]) -> Mapping[str, float]:
        """Middle and duration: nobody pushes by half a sine, so these are known to a part of the duration."""
        return {"time": _COURSE * parameters["duration"], "duration": 2.0 * _COURSE * parameters["duration"]}

    def columns(self, motion: Motion, joint: int, shape: Shape) -> tuple[Column, ...]:
        """Less the Jacobian's transpose times the force's course, in all rows."""
        since = motion.time - shape["time"]
        inside = (np.abs(since) <= 0.5 * shape["duration"]) & (motion.session == round(shape["session"]) - 1)
        course = np.where(inside, np.cos(np.pi * since / shape["duration"]), 0.0)
        columns = []
        for axis in range(3):
            torque = np.zeros_like(motion.q)
            if inside.any():
                torque[inside] = -course[inside, None] * force_torque(
                    motion.chain, motion.q[inside], axis, round(shape["link"])
                )
            columns.append(Column(motor=torque, joint=torque))
        return tuple(columns)

    def simulate(self, joint: int, parameters: Mapping[str, float]) -> Simulated:
        """A torque on the links."""
        return _Push({p.name: float(parameters[p.name]) for p in self.parameters})


class _Push(Simulated):
    def __init__(self, values: Mapping[str, float]) -> None:
        self.values = values
        self.chain: Any = None

    def load(self, time_s: float, plant: Any, loads: Any) -> None:
        since = time_s - self.values["time"]
        if abs(since) > 0.5 * self.values["duration"]:
            return
        course = np.cos(np.pi * since / self.values["duration"])
        force = np.array([self.values[f"force_{axis}"] for axis in "xyz"])
        jacobian = plant_jacobian(plant, int(self.values["link"]))
        loads.link_torque += course * (jacobian.T @ force)
