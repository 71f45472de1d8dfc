"""A payload that changes or comes loose during a session."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from ident.effects.body import Body, Sliding, body_columns, leaning, slide
from ident.effects.effect import Column, Effect, Parameter, Setting, Shape, Simulated
from ident.effects.motion import Floats, Motion

# What comes off hangs within so much of the last link's frame; a load of 7 kg slips by 0.2 m at most.
_LEVER_M = 0.5
_SLIP_KG_M = 1.4


class PayloadChange(Effect):
    """Mass and first moments of the last link jump at `time`, in the session number `session` from 1, and stay so in
    the sessions after it: what came loose is still loose when the next session begins.

    loose : 1 where nothing falls off, but the payload slides along the last link's axes to where gravity pulls it,
    so that the first moments, of half the way each, change their signs with the pose.
    """

    cause = "payload_change"
    side = "joint"
    physics = "the payload slips, loosens, or a part of it falls off during the motion"
    source = "Khalil, Gautier and Lemoine, ICRA 2007"
    parameters = (
        Parameter("moment_x", "kg m", "jump of the first moment in x of the last link's frame"),
        Parameter("moment_y", "kg m", "jump of the first moment in y"),
        Parameter("moment_z", "kg m", "jump of the first moment in z"),
        Parameter("mass", "kg", "jump of the mass", low=-50.0, high=50.0),
        Parameter("time", "s", "from the start of the session", shape=True),
        Parameter("session", "1", "number of the session", shape=True),
        Parameter("loose", "1", "1: the payload slides back and forth from then on", shape=True),
    )
    whole_arm = True
    event = True
    step = True
    optional = ("loose",)
    tell_apart = "hold one static pose for a minute at the start, in the middle and at the end of the session"

    def shapes(self, setting: Setting, joint: int) -> Sequence[Shape]:
        """A time each half second of each session, not closer than a second to its ends."""
        return [
            {"time": float(time), "session": float(number + 1), "loose": loose}
            for loose in (0.0, 1.0)
            for number, duration in enumerate(setting.durations_s)
            for time in np.arange(1.0, duration - 1.0, 0.5)
        ]

    def continuous(self, shape: Shape) -> tuple[str, ...]:
        """The time."""
        return ("time",)

    def plausible(self, coefficients: Floats, shape: Shape) -> bool:
        """Whether the part that comes off, or the slip, is within reach of the flange."""
        mass = float(coefficients[3]) if len(coefficients) > 3 else 0.0
        within_reach = np.linalg.norm(coefficients[:3]) <= _LEVER_M * abs(mass) + _SLIP_KG_M
        return super().plausible(coefficients, shape) and bool(within_reach)

    def columns(self, motion: Motion, joint: int, shape: Shape) -> tuple[Column, ...]:
        """Torque of a unit mass and unit first moments in the last link after the time, in all rows of loaded
        sessions."""
        changed = round(shape["session"]) - 1
        after = np.full(len(motion.time), motion.loaded and motion.session > changed)
        if motion.session == changed:
            after = motion.time >= shape["time"]
        mass, *moments = (c.motor for c in body_columns(motion, 4))
        if shape.get("loose", 0.0) > 0.5:
            place = slide(leaning(motion))
            moments = [place[:, k, None] * torque for k, torque in enumerate(moments) if torque is not None]
            torques = moments
        else:
            torques = [torque for torque in (*moments, mass) if torque is not None]
        return tuple(
            Column(motor=after[:, None] * torque, joint=after[:, None] * torque) for torque in torques
        )

    def simulate(self, joint: int, parameters: Mapping[str, float]) -> Simulated:
        """Gravity and inertia of the lost part, or of the way of a loose one, from the time on."""
        values = np.array(
            [float(parameters.get(n, 0.0)) for n in ("mass", "moment_x", "moment_y", "moment_z")]
        )
        kind = Sliding if parameters.get("loose", 0.0) > 0.5 else Body
        return kind(values, float(parameters["time"]))
