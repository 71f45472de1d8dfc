"""Instruments for the estimation: the same rows on motions that carry no measurement noise.

The commanded motion is known exactly, correlates with the true one, and owes nothing to the sensors, which is
all that an instrument must be; the regressor evaluated on it serves `InstrumentalVariables` and the test of
exogeneity.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ident.signals.filters import differentiate, interpolate_uniform, low_pass
from ident.signals.prepare import PreparedSession, TorqueChannel
from ident.signals.timebase import Stretch, sample_period, stretches

if TYPE_CHECKING:
    from lwr_driver.session import Session

__all__ = ["commanded"]

FloatArray = NDArray[np.float64]


def commanded(session: Session, prepared: PreparedSession) -> PreparedSession | None:
    """`prepared` with the motion commanded in place of the one
    measured; None without the whole command channel.
    """
    if session.command is None or not session.command.position.shape[1]:
        return None
    joint, command = session.joint, session.command.select(prepared.joint_names)
    own = command.publish_time if np.ptp(command.publish_time) > 0 else command.log_time
    reference = joint.publish_time if np.ptp(joint.publish_time) > 0 else joint.log_time
    times = np.asarray((own - int(reference[0])) * 1e-9, dtype=np.float64)
    where = f"{prepared.name}: /joint_command"
    dt = sample_period(times, command.sequence if command.numbered else None, where)
    bad: NDArray[np.bool_] = np.asarray(~np.isfinite(command.position).all(axis=1))
    parts, _ = stretches(times, command.position, bad, dt, prepared.settings.longest_bridge_s)
    motions = [_Motion(parts.pop(0), prepared) for _ in range(len(parts))]
    passages = []
    for passage in prepared.passages:
        home = next((m for m in motions if m.covers(passage.joint) and m.covers(passage.motor)), None)
        if home is None:
            return None
        passages.append(
            replace(
                passage,
                joint=home.at(passage.joint),
                motor=None if passage.motor is None else home.at(passage.motor),
            )
        )
    return replace(prepared, passages=tuple(passages))


class _Motion:
    """The commanded motion of one stretch, filtered like the measured one."""

    def __init__(self, part: Stretch, prepared: PreparedSession) -> None:
        self._start, self._dt, self._end = part.start, part.dt, part.end
        position = low_pass(part.values, part.dt, prepared.cutoff_hz, prepared.settings.order)
        self._states = (position, *differentiate(position, part.dt))

    def covers(self, channel: TorqueChannel | None) -> bool:
        """Whether the channel's times lie within the stretch."""
        if channel is None:
            return True
        slack = 0.5 * self._dt
        first, last = self._start - slack, self._end + slack
        return bool(first <= channel.times[0] and channel.times[-1] <= last)

    def at(self, channel: TorqueChannel) -> TorqueChannel:
        """The channel with the commanded motion at its times."""
        q, qd, qdd = (
            interpolate_uniform(state, self._start, self._dt, channel.times) for state in self._states
        )
        return replace(channel, q=q, qd=qd, qdd=qdd)
