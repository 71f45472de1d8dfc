"""Checks of the recorded channels without a model: copied, stuck, contradicting, impossible values."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import combinations

import numpy as np

from ident.dynamics.kinematics import Chain
from ident.dynamics.parameters import Floats, joint_unit
from ident.rows.content import Recall, content
from ident.rows.data_quality import Jump, position_jumps, run_bounds
from ident.rows.shared_rows import ROUNDED, SAME_ROWS, Cells, row_numbers, shared
from ident.screening.doubts import Doubt, torques_of
from ident.screening.speeds import check_speeds
from ident.screening.spikes import check_spikes
from ident.screening.stuck import dead_sensors, frozen_channels, never_moving, saturated, spans_in_words
from ident.screening.unmeasured import check_unmeasured
from lwr_driver.session import Session
from lwr_driver.session.spool import column

# Sampling rates of robot logs [Hz], and the least duration for a comparison of two clocks [s].
_RATES, _LONG_S = (10.0, 20_000.0), 2.0
# Difference of two clocks beyond jitter.
_CLOCKS = 0.02
# Wrapped angle: largest difference of a jump from one turn, over the turn.
_TURN = 0.02
# Copied torques in a part of a session: least time [s], least share, least changes of the value (columns at rest, dead
# or held have few).
_COPIED_S, _COPIED, _CHANGES = 1.0, 0.1, 20


def check_channels(sessions: Sequence[Session], chain: Chain, *, recall: Recall | None = None) -> list[Doubt]:
    """Doubts about the channels of sessions with the joints of `chain`. recall : as for `prepare`."""
    recall = recall or Recall()
    units = dict(zip(chain.joint_names, chain.torque_units, strict=True))
    found = [
        *check_unmeasured(chain),
        *_repeated(sessions),
        *never_moving(sessions),
        *dead_sensors(sessions, units),
    ]
    for session in sessions:
        found += [*_copied(session), *_both_sides(session)]
        frozen = list(frozen_channels(session))
        named = {(doubt.channel, doubt.joints) for doubt in frozen}
        clipped = [doubt for doubt in saturated(session, units) if (doubt.channel, doubt.joints) not in named]
        found += [*_clocks(session), *frozen, *_jumps(session, chain), *check_spikes(session, chain, recall)]
        found += [*clipped, *check_speeds(session, recall)]
    return found


def _repeated(sessions: Sequence[Session]) -> Iterator[Doubt]:
    if len(sessions) < 2:
        return
    numbers, cells = {id(session): row_numbers(session) for session in sessions}, Cells(sessions[0])
    for a, b in combinations(sessions, 2):
        share, how = shared(numbers[id(a)], numbers[id(b)]), ""
        if share <= SAME_ROWS:
            share, how = cells.shared(a, b), ", rounded otherwise"
        uid = a.metadata.get("uid", "")
        alike = f" and the uid {uid}" if uid and uid == b.metadata.get("uid", "") else ""
        names = f"{a.path.name} and {b.path.name}"
        if share > SAME_ROWS:
            seen = f"{names} hold the same samples ({100 * share:.0f} %{how}){alike}"
            yield Doubt(
                "log", (), seen, "one log given twice", "give each log once; a copy is no new data", True
            )
        elif alike:
            # Two recordings by one experiment file had one uid once.
            seen = f"{names} hold different samples{alike}"
            advice = "leave one out if it was made from the other; two recordings may stay"
            yield Doubt("log", (), seen, "one log processed into another", advice, False)


def _copied(session: Session) -> Iterator[Doubt]:
    """Channels of several joints with the same values, as two sensors never have them.

    Torques: equal but for rounding in every sample, or to the last bit in a long part of the session. Positions: equal
    to the last bit in every sample; a simulation may have such, if its motion asks for them or if all joints go the
    same way.
    """
    for channel, columns in torques_of(session):
        whole = _alike(columns.effort, ROUNDED)
        for joints in whole:
            yield _copies(session, channel, joints, certain=True, where="to four digits in every sample")
        times = np.asarray((columns.log_time - session.joint.log_time[:1]) * 1e-9, dtype=np.float64)
        for joints, span in _alike_in_part(columns.effort, times):
            if not any(set(joints) <= set(some) for some in whole):
                where = f"to the last bit {spans_in_words(times, [span])}"
                yield _copies(session, channel, joints, certain=True, where=where)
    for joints in _alike(session.joint.position):
        if len(joints) == session.joint.position.shape[1]:
            continue
        command = session.command
        names = [session.joint_names[joint] for joint in joints]
        known = command is not None and bool(command.position.shape[1]) and set(names) <= set(command.names)
        if command is None or not known:
            yield _copies(session, "position", joints, certain=False)
        elif len(_alike(command.position[:, [command.names.index(name) for name in names]])) != 1:
            yield _copies(session, "position", joints, certain=True)


def _both_sides(session: Session) -> Iterator[Doubt]:
    """Motor torques equal to the joint torques but for rounding, as no two sensors are."""
    joint, motor = session.joint, session.motor
    if motor is None or motor.effort.shape != joint.effort.shape:
        return
    same = [
        k
        for k in range(joint.effort.shape[1])
        if np.ptp(own := column(motor.effort, k)) > 0.0 and _equal(own, column(joint.effort, k), ROUNDED)
    ]
    if same:
        seen = "is the joint torque to four digits in every sample"
        looks = "one column taken for both sides"
        mend = (
            "import the side that was measured only, or leave the motor torques aside (Model 1, `--model 1`)"
        )
        names = tuple(session.joint_names[k] for k in same)
        yield Doubt("motor torque", names, seen, looks, mend, True, session.path.name)


def _alike(values: Floats, share: float = 0.0) -> list[list[int]]:
    """Groups of columns that change and are equal within a share of their range."""
    groups: list[list[int]] = []
    for joint in range(values.shape[1]):
        own = column(values, joint)
        if not np.ptp(own) > 0.0:
            continue
        same = [group for group in groups if _equal(own, column(values, group[0]), share)]
        if same:
            same[0].append(joint)
        else:
            groups.append([joint])
    return [joints for joints in groups if len(joints) > 1]


def _equal(own: Floats, other: Floats, share: float) -> bool:
    """Whether values (n,) are equal within a share of their range."""
    return bool(np.max(np.abs(own - other)) <= share * float(np.ptp(own)))


def _alike_in_part(values: Floats, times: Floats) -> Iterator[tuple[list[int], tuple[int, int]]]:
    """Groups of columns that change and are equal, and the first and the last sample: the longest run of each pair."""
    found: dict[tuple[int, int, bytes], set[int]] = {}
    least = max(_COPIED_S, _COPIED * float(times[-1] - times[0]))
    for one in range(values.shape[1] - 1):
        own = column(values, one)
        for other in range(one + 1, values.shape[1]):
            equal = own == column(values, other)
            bounds = run_bounds(equal)
            starts, ends = bounds[:-1], bounds[1:] - 1
            lasting = np.where(equal[starts], times[ends] - times[starts], 0.0)
            longest = int(np.argmax(lasting))
            first, last = int(starts[longest]), int(ends[longest])
            part = own[first : last + 1]
            if lasting[longest] >= least and np.count_nonzero(np.diff(part)) >= _CHANGES:
                found.setdefault((first, last, content(part)), set()).update((one, other))
    for (first, last, _), joints in found.items():
        yield sorted(joints), (first, last)


def _copies(
    session: Session,
    channel: str,
    joints: Sequence[int],
    *,
    certain: bool,
    where: str = "to the last bit in every sample",
) -> Doubt:
    names = tuple(session.joint_names[joint] for joint in joints)
    seen = f"read the same {where}"
    looks, mend = "one column taken for several joints", "give each joint its own column when importing"
    return Doubt(channel, names, seen, looks, mend, certain, session.path.name)


def _clocks(session: Session) -> Iterator[Doubt]:
    name, joint = session.path.name, session.joint
    if len(joint) < 16:
        return
    host, source = (float(t[-1] - t[0]) * 1e-9 for t in (joint.log_time, joint.publish_time))
    used = source if source > 0.0 else host
    rate = (len(joint) - 1) / max(used, 1e-12)
    if not _RATES[0] <= rate <= _RATES[1]:
        unit = (
            "milliseconds read as seconds"
            if rate < _RATES[0]
            else "a unit of time too large, such as minutes for seconds"
        )
        seen = f"{len(joint)} samples in {used:.4g} s, {rate:.4g} Hz"
        mend = "state the unit of time of the log when importing it"
        yield Doubt("time", (), seen, unit, mend, rate < 0.1 * _RATES[0] or rate > 5.0 * _RATES[1], name)
    if min(host, source) > 0.0 and max(host, source) > _LONG_S:
        ratio = source / host
        if abs(ratio - 1.0) > _CLOCKS:
            seen = f"the source's clock passes {source:.2f} s while the host's passes {host:.2f} s"
            mend = "repair the clock of the source, or state its rate when importing"
            yield Doubt(
                "time", (), seen, f"a rate wrong by {ratio:.3g}", mend, abs(np.log(ratio)) > 0.1, name
            )
    motor = session.motor
    if (
        motor is not None
        and len(motor) > 16
        and used > _LONG_S
        and np.ptp(motor.publish_time) > 0
        and source > 0.0
    ):
        other = float(motor.publish_time[-1] - motor.publish_time[0]) * 1e-9
        if abs(np.log(other / used)) > 0.2:
            seen = f"the motor channel spans {other:.2f} s, the joint channel {used:.2f} s"
            mend = "state the unit of time of both channels when importing"
            yield Doubt(
                "time",
                (),
                seen,
                "different units or rates of the channels",
                mend,
                abs(np.log(other / used)) > 1,
                name,
            )


def _jumps(session: Session, chain: Chain) -> list[Doubt]:
    log = session.joint.log_time
    times = np.asarray((log - log[:1]) * 1e-9, dtype=np.float64)
    found = position_jumps(session.joint)
    return jump_doubts(found, times, session.joint_names, chain.prismatic.tolist(), session.path.name)


def jump_doubts(
    found: Sequence[Jump], times: Floats, names: Sequence[str], prismatic: Sequence[bool], session: str = ""
) -> list[Doubt]:
    """Positions elsewhere in the next sample: by a turn, or by anything. times : of the samples [s].

    names, prismatic : of the joints.
    """
    turns = [jump for jump in found if abs(abs(jump.size) / (2.0 * np.pi) - 1.0) < _TURN]
    others = [jump for jump in found if jump not in turns]

    def doubt(some: Sequence[Jump], size: str, looks: str, mend: str) -> Doubt:
        joints = sorted({jump.joint for jump in some})
        places = sorted({jump.behind for jump in some})
        again = len(places) - 1
        more = f" and {again} more time{'s' if again > 1 else ''}" if again else ""
        verb = "jumps" if len(joints) == 1 else "jump"
        seen = f"{verb} by {size} in one sample at {times[places[0]]:.4g} s{more}"
        mend = f"{mend}; rows are built on either side only"
        return Doubt("position", tuple(names[k] for k in joints), seen, looks, mend, False, session)

    doubts = [
        doubt(
            [jump for jump in turns if jump.joint == joint],
            "360 deg",
            "an angle that wraps",
            "import the recording with `lwr-run import`, which unwraps it",
        )
        for joint in sorted({jump.joint for jump in turns})
    ]
    if others:
        largest = max(others, key=lambda jump: abs(jump.size))
        size = f"{'up to ' if len(others) > 1 else ''}{abs(largest.size):.3g}"
        looks = "samples missing without a gap in the stamps"
        if len({jump.joint for jump in others}) == 1:
            looks += ", or a joint zeroed anew"
        unit = joint_unit("rad", prismatic=bool(prismatic[largest.joint]))
        mend = "give the samples the times of their source, or cut the log there"
        doubts.append(doubt(others, f"{size} {unit}", looks, mend))
    return doubts
