"""Channels that cannot be what they say: told first, left out of the rows, and no cause is named from them.

Dead, frozen and clipped torques, and a turned or mis-scaled torque of one joint, are left out alone: the rows of the
other joints and of the other side stay. A wrong position, a wrong clock, or such torques of several joints put the log
as a whole in doubt, and the diagnosis ends with them. What is wrong by some percent is no broken channel but a cause of
the catalogue. A doubt that nothing confirms leaves the rows as they are, and no cause in them is sure.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from fri.errors import LwrError
from ident.diagnosis.rows.recording import SessionRecord
from ident.dynamics.kinematics import Chain
from ident.dynamics.parameters import LINK_FRICTION
from ident.dynamics.structure import Coupling
from ident.rows.content import Recall
from ident.rows.filters import SignalSettings
from ident.screening.doubts import Doubt, settle
from ident.screening.screen import screen
from ident.screening.stuck import asked_to_move
from lwr_driver.session import Session

_TORQUES = ("joint torque", "motor torque")
# Channels whose error bends all rows.
_BENDING = ("position", "time", "payload", "mounting", "kinematics", "motor torque against joint torque")


@dataclass(frozen=True)
class BrokenChannel:
    """A channel of a joint (from 1, None for all) in a session (empty for all). lost : whether it holds nothing."""

    channel: str
    joint: int | None
    what: str
    advice: str
    session: str = ""
    lost: bool = False

    def to_dict(self) -> dict[str, Any]:
        """Plain content."""
        where = f"{self.session}: " if self.session else ""
        return {
            "channel": self.channel,
            "joint": self.joint,
            "what": where + self.what,
            "advice": self.advice,
        }


def broken_channels(
    sessions: Sequence[Session],
    chain: Chain,
    signals: SignalSettings,
    couplings: Sequence[Coupling] = (),
    *,
    recall: Recall | None = None,
) -> tuple[BrokenChannel, ...]:
    """The channels of the sessions that `ident.screening` is certain about, and dead or clipped ones.

    recall : as for `prepare`.
    """
    return screened(sessions, chain, signals, couplings, recall=recall)[0]


def screened(
    sessions: Sequence[Session],
    chain: Chain,
    signals: SignalSettings,
    couplings: Sequence[Coupling] = (),
    *,
    recall: Recall | None = None,
) -> tuple[tuple[BrokenChannel, ...], tuple[Doubt, ...]]:
    """The broken channels, and the doubts that are not certain about torques, positions and the log as a whole.

    Other zeros of a torque and their drift are none: the catalogue has them, and the healthy arm from day to day.
    """
    found, doubts = list[BrokenChannel](), list[Doubt]()
    chosen = [session.select(chain.joint_names) for session in sessions]
    for doubt in screen(chosen, chain, signals, couplings, recall=recall):
        if _stands(doubt, chosen):
            continue
        if doubt.certain or doubt.lost:
            found += _by_joint(doubt, chain)
        elif doubt.channel in (*_TORQUES, *_BENDING) and doubt.kind not in ("zero", "drift"):
            doubts.append(doubt)
    return tuple(found), tuple(doubts)


def in_doubt(doubts: Sequence[Doubt], chain: Chain) -> tuple[BrokenChannel, ...]:
    """The channels that doubts are about, as those of `data` are told."""
    return tuple(one for doubt in doubts for one in _by_joint(doubt, chain))


def _by_joint(doubt: Doubt, chain: Chain) -> list[BrokenChannel]:
    what = f"{doubt.seen}, looks like {doubt.looks_like}" if doubt.looks_like else doubt.seen
    joints: list[int | None] = [chain.joint_names.index(name) + 1 for name in doubt.joints]
    return [
        BrokenChannel(doubt.channel, joint, what, doubt.mend, doubt.session, doubt.lost)
        for joint in joints or [None]
    ]


def _stands(doubt: Doubt, sessions: Sequence[Session]) -> bool:
    """Whether the doubt is of a joint that never moves and is not asked to: a diagnosis does without its motion."""
    if doubt.channel != "position" or len(doubt.joints) != 1:
        return False
    joint = sessions[0].joint_names.index(doubt.joints[0])
    return all(np.ptp(s.joint.position[:, joint]) == 0.0 and not asked_to_move(s, joint) for s in sessions)


def worthless(broken: Sequence[BrokenChannel]) -> bool:
    """Whether more is in doubt than dead and frozen torques, or one torque beside them."""
    wrong = {(one.channel, one.joint) for one in broken if not one.lost}
    return len(wrong) > 1 or any(channel not in _TORQUES for channel, _ in wrong)


def is_broken(broken: Sequence[BrokenChannel], side: str, joint: int) -> bool:
    """Whether the torque of a joint (from 1) is among them."""
    return any((one.channel, one.joint) == (f"{side} torque", joint) for one in broken)


def without_broken(
    records: Sequence[SessionRecord], broken: Sequence[BrokenChannel]
) -> tuple[SessionRecord, ...]:
    """The records without the torques of broken channels."""
    return tuple(_usable(record, [b for b in broken if b.session in ("", record.name)]) for record in records)


def unseen(records: Sequence[SessionRecord], chain: Chain) -> tuple[str, ...]:
    """Parameters without any row: of a drive without motor torques, and of the link side of a joint without joint
    torques, as the drive's own take their place.
    """
    stretches = [stretch for record in records for stretch in record.stretches]
    motor = np.any([np.any(s.motor_usable, axis=0) for s in stretches], axis=0)
    sensed = any(record.has_effort for record in records)
    joint = np.any([np.any(s.usable, axis=0) & sensed for s in stretches], axis=0)
    return tuple(
        f"{symbol}{j + 1}"
        for j in range(chain.n)
        for seen, symbols in ((motor[j], ("Ia", "Fvm", "Fcm", "offm")), (joint[j], LINK_FRICTION))
        if not seen
        for symbol in symbols
    )


def _usable(record: SessionRecord, broken: Sequence[BrokenChannel]) -> SessionRecord:
    out = {
        side: [b.joint - 1 for b in broken if b.joint is not None and b.channel == f"{side} torque"]
        for side in ("joint", "motor")
    }
    stretches = []
    for stretch in record.stretches:
        usable, motor = stretch.usable.copy(), stretch.motor_usable.copy()
        usable[:, out["joint"]], motor[:, out["motor"]] = False, False
        stretches.append(replace(stretch, usable=usable, motor_usable=motor))
    return replace(record, stretches=tuple(stretches))


def refuse(broken: Sequence[BrokenChannel], names: Sequence[str]) -> None:
    """Raise DataError with all of the broken channels, where there are any. names : of the joints."""
    settle(
        [
            Doubt(
                b.channel,
                () if b.joint is None else (names[b.joint - 1],),
                b.what,
                "",
                b.advice,
                True,
                b.session,
            )
            for b in broken
        ]
    )


@contextmanager
def blamed(broken: Sequence[BrokenChannel], names: Sequence[str]) -> Iterator[None]:
    """An error inside is one of the broken channels, where there are any: DataError with all of them."""
    try:
        yield
    except (LwrError, np.linalg.LinAlgError):
        refuse(broken, names)
        raise
