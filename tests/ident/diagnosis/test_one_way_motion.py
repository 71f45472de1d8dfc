"""Joints that never reverse within a session."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from ident.diagnosis import diagnose
from ident.dynamics.kinematics import Chain
from lwr_driver.session import JointColumns, Session


def between(session: Session, first: int, last: int) -> Session:
    """The samples of a session from `first` to `last` [ns], by the host's clock."""

    def part(channel: JointColumns) -> JointColumns:
        kept = (channel.log_time >= first) & (channel.log_time <= last)
        names = ("log_time", "publish_time", "sequence", "position", "velocity", "effort")
        return replace(channel, **{name: getattr(channel, name)[kept] for name in names})

    assert session.motor is not None
    return replace(session, joint=part(session.joint), motor=part(session.motor))


def test_a_joint_that_never_reverses_has_no_more_friction_than_torque(
    make: Callable[..., Session], chain: Chain
) -> None:
    session = make("a.mcap", 1)
    stamps = session.joint.log_time
    one_way = np.gradient(session.joint.position[:, 1], 1e-9 * (stamps - stamps[0])) > 0.02
    ends = np.flatnonzero(np.diff(np.concatenate([[False], one_way, [False]]).astype(int)))
    longest = int(np.argmax(ends[1::2] - ends[::2]))
    short = between(session, *stamps[[ends[2 * longest], ends[2 * longest + 1] - 1]].tolist())
    model = diagnose([short], chain).base_model
    rms = float(np.sqrt(np.mean(short.joint.effort[:, 1] ** 2)))
    assert model.std is not None
    for name in ("Fcl2", "offl2"):
        assert abs(model.value(name)) < 1.0
        assert model.std[model.names.index(name)] < 1.1 * rms
