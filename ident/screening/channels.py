"""What the recorded channels show by themselves, without a model: dead, clipped, contradicting, impossible."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator, Sequence
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from ident.dynamics.kinematics import Chain
from ident.dynamics.parameters import Floats
from ident.rows.content import content
from ident.rows.data_quality import (
    STEP_RAD,
    Frozen,
    Jump,
    clipped_at,
    frozen_positions,
    frozen_torques,
    held,
    position_jumps,
    run_bounds,
    stuck_at,
)
from ident.rows.shared_rows import ROUNDED, SAME_ROWS, Cells, row_numbers, shared
from ident.screening.doubts import LATE_S, MEND_TIME, Doubt
from lwr_driver.session import JointColumns, Session
from lwr_driver.session.spool import column

# Sampling rates of robot logs [Hz], and the least duration for a comparison of two clocks [s].
_RATES, _LONG_S = (10.0, 20_000.0), 2.0
# Difference of two clocks or of dq/dt and velocity beyond filters and jitter; beyond the second one is a wrong unit.
_CLOCKS, _SPEEDS, _UNIT = 0.02, 0.15, 1.5
# Least difference of dq/dt and velocity that is the same in all joints, and largest spread of the joints over it: real
# velocities, filtered by their drives, differ by 0.8 % and less.
_COMMON, _SPREAD = 0.03, 0.25
# Blocks of the comparison with the velocity: least samples, least time [s]; least movement of a joint [rad or m].
_BLOCK, _BLOCK_S, _MOVED = 5, 0.05, 0.05
_CORRELATED = 0.9
# Standard deviations of a delay of positions against velocities, beyond which it is told.
_SURE = 5.0
# Velocities over rad/s in other units.
_SPEED_UNITS = {180.0 / np.pi: "deg/s for rad/s", 30.0 / np.pi: "revolutions per minute for rad/s"}
# Overshoot of a limit by calibration, over which a doubt is raised, and share of the samples left out as outliers.
_OVER, _OUTLIERS = 1.1, 0.001
# Corners at a flat top: least number, length of the top, way before it over the one of a usual stop, time of that way.
_CORNERS, _TOP, _SHARP, _LAG_S = 2, 5, 2.0, 0.02
# Share of the motion at one torque, wherever it is.
_OFTEN = 0.05
# Samples within which the torques of nearly all sensors change.
_SOON = 100
# Largest distance of a jump from one turn, as a share of it, for an angle that wraps.
_TURN = 0.02
# Least time [s] of torques kept in all joints at once to be told; shorter ones are usual in a network.
_TOGETHER_S = 0.1


# Torques of two joints that are one for a part of a session: least time [s], least share, least changes of the value:
# columns at rest, dead or held have few.
_COPIED_S, _COPIED, _CHANGES = 1.0, 0.1, 20


def check_channels(sessions: Sequence[Session], chain: Chain) -> list[Doubt]:
    """Doubts about the channels of sessions with the joints of `chain`."""
    found = [*_repeated(sessions), *_never_moving(sessions), *_dead(sessions)]
    for session in sessions:
        found += [*_copied(session), *_both_sides(session)]
        frozen = list(_frozen(session))
        named = {(doubt.channel, doubt.joints) for doubt in frozen}
        clipped = [doubt for doubt in _clipped(session) if (doubt.channel, doubt.joints) not in named]
        found += [*_clocks(session), *frozen, *_jumps(session, chain), *clipped, *_velocity(session)]
    return found


def check_limits(sessions: Sequence[Session], chain: Chain) -> list[Doubt]:
    """Doubts by the limits in the URDF: a channel is wrong, seldom clear how."""
    limits, found = joint_limits(chain), list[Doubt]()
    for session in sessions:
        beyond = list(_limits(session, limits))
        # A position in another unit is too fast as well.
        named = {name for doubt in beyond if doubt.channel == "position" for name in doubt.joints}
        rest = {name: limit for name, limit in limits.items() if name not in named}
        found += [*beyond, *_pace(session, rest)]
    return found


def joint_limits(chain: Chain) -> dict[str, dict[str, float]]:
    """`lower`, `upper`, `velocity`, `effort` of the joints in the URDF of `chain`, as far as they are limits."""
    if chain.urdf is None:
        return {}
    found: dict[str, dict[str, float]] = {}
    for joint in ElementTree.fromstring(chain.urdf).findall("joint"):
        limit = joint.find("limit")
        if limit is None or joint.get("name", "") not in chain.joint_names:
            continue
        values: dict[str, float] = {}
        for key in ("lower", "upper", "velocity", "effort"):
            try:
                values[key] = float(limit.get(key, "nan"))
            except ValueError:
                values[key] = float("nan")
        if joint.get("type") == "continuous" or not values["upper"] > values["lower"]:
            del values["lower"], values["upper"]
        found[joint.get("name", "")] = {
            k: v for k, v in values.items() if np.isfinite(v) and (v > 0 or k in ("lower", "upper"))
        }
    return found


def dead(columns: JointColumns | None) -> tuple[int, ...]:
    """Joints (from 0) with one and the same torque in all samples."""
    if columns is None or not columns.effort.size:
        return ()
    effort = columns.effort
    quiet = np.flatnonzero(np.all(effort[:_SOON] == effort[0], axis=0))
    return tuple(int(j) for j in quiet if np.ptp(effort[:, j]) == 0.0)


def _torques(session: Session) -> Iterator[tuple[str, JointColumns]]:
    for channel, columns in (("joint torque", session.joint), ("motor torque", session.motor)):
        if columns is not None and columns.effort.size:
            yield channel, columns


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


def _never_moving(sessions: Sequence[Session]) -> Iterator[Doubt]:
    names = sessions[0].joint_names if sessions else ()
    for joint, name in enumerate(names):
        still = [s for s in sessions if len(s.joint) and np.ptp(s.joint.position[:, joint]) == 0.0]
        driven = [s for s in still if asked_to_move(s, joint)]
        if not still or (len(still) < len(sessions) and not driven and _others_stand(still, joint)):
            continue
        value = float(still[0].joint.position[0, joint])
        where = "" if len(still) == len(sessions) else still[0].path.name
        seen, looks = (
            f"joint {name} never moves, {value:.6g} in every sample",
            "a locked joint or a dead sensor",
        )
        if driven:
            seen, looks = (
                f"reads {value:.6g} in every sample of a motion",
                "a dead sensor or a column of constants",
            )
        mend = "repair the channel or leave the log out; for a locked joint take a chain in which it is fixed"
        certain = bool(driven) or len(still) == len(sessions)
        yield Doubt("position", (name,), seen, looks, mend, certain, where)


def asked_to_move(session: Session, joint: int) -> bool:
    """Whether the joint (from 0) is commanded to move, or moves by its velocity."""
    name = session.joint_names[joint]
    command = session.command
    asked = command is not None and name in command.names and bool(command.position.shape[1])
    if asked and command is not None and np.ptp(command.position[:, command.names.index(name)]) > _MOVED:
        return True
    speed = session.joint.velocity
    return bool(speed.shape[1]) and bool(np.percentile(np.abs(speed[:, joint]), 90) > _MOVED)


def _others_stand(sessions: Sequence[Session], joint: int) -> bool:
    """Whether other joints stand still to the last bit, too, as in a log of one joint's motion."""
    return all(np.sum(np.ptp(s.joint.position, axis=0) == 0.0) > 1 for s in sessions)


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


def _dead(sessions: Sequence[Session]) -> Iterator[Doubt]:
    """Dead torque sensors; certain for a joint without any torque of the side, and for the motor side's delay."""
    for session in sessions:
        for channel, columns in _torques(session):
            motor = channel == "motor torque"
            for joint in dead(columns):
                alike = [own for other in sessions for name, own in _torques(other) if name == channel]
                never = all(joint in dead(own) for own in alike)
                mend = "its rows are left out; repair the channel"
                if motor:
                    mend = "repair the channel, or leave the motor torques aside (Model 1, `--model 1`)"
                elif never:
                    mend = "repair the channel, add a session with it, or leave the joint torques aside"
                seen = f"reads {float(columns.effort[0, joint]):.4g} Nm in every sample"
                names = (session.joint_names[joint],)
                certain = motor or never
                yield Doubt(
                    channel, names, seen, "a dead sensor", mend, certain, session.path.name, lost=True
                )


def _copied(session: Session) -> Iterator[Doubt]:
    """Torques of several joints equal but for rounding, as two sensors never are, in every sample, or to the last bit
    in a long part of them; or positions to the last bit in every sample. Positions of a simulation may be, if its
    motion asks for them, or if all joints go the same way."""
    for channel, columns in _torques(session):
        whole = _alike(columns.effort, ROUNDED)
        for joints in whole:
            yield _copies(session, channel, joints, certain=True, where="to four digits in every sample")
        times = np.asarray((columns.log_time - session.joint.log_time[:1]) * 1e-9, dtype=np.float64)
        for joints, span in _alike_in_part(columns.effort, times):
            if not any(set(joints) <= set(some) for some in whole):
                where = f"to the last bit {_spans(times, [span])}"
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


def _frozen(session: Session) -> Iterator[Doubt]:
    """Channels that stop in the middle of a motion."""
    joint = session.joint
    path_times = np.asarray((joint.log_time - joint.log_time[:1]) * 1e-9, dtype=np.float64)
    for channel, columns in _torques(session):
        times = np.asarray((columns.log_time - joint.log_time[:1]) * 1e-9, dtype=np.float64)
        effort = columns.effort
        runs = frozen_torques(effort, times, path_times, joint.position)
        yield from _stopped(session, channel, times, effort, runs)
        kept = np.flatnonzero(np.diff(held(effort, times, path_times, joint.position), prepend=0, append=0))
        together = [(int(a) - 1, int(b) - 1) for a, b in kept.reshape(-1, 2)]
        long = [(a, b) for a, b in together if times[b] - times[a] >= _TOGETHER_S]
        if long:
            seen, share = _spans(times, long), sum(b - a for a, b in long) / len(times)
            mend = "these samples are left out; look for what held the recording up"
            seen = f"every joint keeps its value {seen}, while the arm moves"
            yield Doubt(channel, (), seen, "lost samples", mend, share > _OFTEN, session.path.name)
    runs = frozen_positions(joint)
    yield from _stopped(session, "position", path_times, joint.position, runs)
    jumping = {run.joint for run in runs}
    rest = [run for k, run in enumerate(_standing(session)) if run is not None and k not in jumping]
    for run in rest:
        yield from _stopped(session, "position", path_times, joint.position, (run,), kept=True)


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
        unit = "m" if prismatic[largest.joint] else "rad"
        mend = "give the samples the times of their source, or cut the log there"
        doubts.append(doubt(others, f"{size} {unit}", looks, mend))
    return doubts


def _jumps(session: Session, chain: Chain) -> list[Doubt]:
    log = session.joint.log_time
    times = np.asarray((log - log[:1]) * 1e-9, dtype=np.float64)
    found = position_jumps(session.joint)
    return jump_doubts(found, times, session.joint_names, chain.prismatic.tolist(), session.path.name)


def _stopped(
    session: Session,
    channel: str,
    times: Floats,
    values: Floats,
    runs: Sequence[Frozen],
    *,
    kept: bool = False,
) -> Iterator[Doubt]:
    """Doubts about frozen channels; joints that freeze at the same times share one. kept : in the rows."""
    together: dict[tuple[tuple[int, int], ...], list[int]] = {}
    for joint in dict.fromkeys(run.joint for run in runs):
        spans = tuple((run.first, run.last) for run in runs if run.joint == joint)
        together.setdefault(spans, []).append(joint)
    for spans, joints in together.items():
        share = sum(last - first for first, last in spans) / len(times)
        longest = max(spans, key=lambda span: span[1] - span[0])
        alone = len(joints) == 1
        value = f"reads {values[longest[0], joints[0]]:.4g}" if alone else "keep their values"
        certain = kept or share > _OFTEN
        mend = "cut that part off the log, or repair the channel"
        yield Doubt(
            channel,
            tuple(session.joint_names[joint] for joint in joints),
            f"{value} {_spans(times, spans)}, in the middle of a motion",
            "a frozen channel" if alone else "lost samples, or frozen channels",
            mend if certain else "these samples are left out; repair the channel",
            certain,
            session.path.name,
            lost=channel != "position" and certain,
        )


def _spans(times: Floats, spans: Sequence[tuple[int, int]]) -> str:
    """The longest of some spans of samples in words, and how many there are."""
    first, last = max(spans, key=lambda span: times[span[1]] - times[span[0]])
    start, end = times[[first, last]]
    places = 1 if end - start >= _LONG_S else 2
    text = f"from {start:.{places}f} to {end:.{places}f} s ({end - start:.{places}f} s)"
    if len(spans) > 1:
        total = sum(times[b] - times[a] for a, b in spans)
        text += f" and {len(spans) - 1} more times, {total:.{places}f} s in all"
    return text


def _standing(session: Session) -> Iterator[Frozen | None]:
    """By joint, its longest standstill, if it was to move then, or stopped or left at speed, while others moved."""
    joint = session.joint
    for k, values in enumerate(joint.position.T):
        bounds = run_bounds(values)
        longest = int(np.argmax(np.diff(bounds)))
        first, last = int(bounds[longest]), int(bounds[longest + 1]) - 1
        stamps = joint.log_time[[first, last]]
        others = np.delete(joint.position[first : last + 1], k, axis=1)
        found = (
            (stamps[1] - stamps[0]) * 1e-9 >= _LONG_S
            and last - first + 1 < len(values)
            and bool(not others.shape[1] or np.any(np.ptp(others, axis=0) > _MOVED))
            and (_driven(session, k, stamps) or _abrupt(joint, k, first, last))
        )
        yield Frozen(k, first, last) if found else None


def _driven(session: Session, joint: int, stamps: NDArray[np.int64]) -> bool:
    """Whether the joint is commanded to move, or measured to move by its velocity, between two times."""
    name, command, speed = session.joint_names[joint], session.command, session.joint.velocity
    if command is not None and name in command.names and command.position.shape[1]:
        inside = (command.log_time >= stamps[0]) & (command.log_time <= stamps[1])
        return bool(inside.any() and np.ptp(command.position[inside, command.names.index(name)]) > _MOVED)
    times = session.joint.log_time
    inside = (times >= stamps[0]) & (times <= stamps[1])
    return bool(speed.shape[1]) and bool(np.percentile(np.abs(speed[inside, joint]), 90) > _MOVED)


def _abrupt(columns: JointColumns, joint: int, first: int, last: int) -> bool:
    """Whether the standstill begins or ends by a jump: a joint with the acceleration a covers a T^2 / 2 in T."""
    values, lag = columns.position[:, joint], _lag(columns)
    bends = np.abs(values[2 * lag :] - 2.0 * values[lag:-lag] + values[: -2 * lag])
    middle = np.arange(lag, len(values) - lag)
    usual = bends[(np.abs(middle - first) > 2 * lag) & (np.abs(middle - last) > 2 * lag)]
    before, after = values[max(first - lag, 0)], values[min(last + lag, len(values) - 1)]
    jump = max(abs(before - values[first]), abs(after - values[first]))
    return bool(len(usual) and jump > max(_SHARP * float(np.quantile(usual, 1.0 - _OUTLIERS)), STEP_RAD))


def _clipped(session: Session) -> Iterator[Doubt]:
    name = session.path.name
    mend = "move more gently or widen the sensor's range; the samples at the level are not the torque"
    if session.joint.effort.size:
        silent = set(dead(session.joint))
        for joint, level in enumerate(clipped_at(session.joint)):
            if np.isfinite(level) and joint not in silent:
                seen = f"stays at its largest value, {level:.4g} Nm, again and again"
                yield Doubt(
                    "joint torque", (session.joint_names[joint],), seen, "saturation", mend, False, name
                )
    if session.motor is not None and session.motor.effort.size:
        silent = set(dead(session.motor))
        levels: dict[int, list[str]] = {}
        for stuck in stuck_at(session.motor, session.joint):
            own, share = session.motor.effort[:, stuck.joint], stuck.count / max(stuck.samples, 1)
            # A coarse sensor may repeat a value somewhere in its range; a limit is the end of the range.
            if stuck.joint not in silent and (share > _OFTEN or stuck.value in (own.min(), own.max())):
                levels.setdefault(stuck.joint, []).append(
                    f"{stuck.value:.4g} Nm ({100 * share:.0f} % of the motion)"
                )
        for joint, texts in levels.items():
            seen = f"stays at {' and '.join(texts)}"
            yield Doubt(
                "motor torque",
                (session.joint_names[joint],),
                seen,
                "saturation or a dead zone",
                mend,
                False,
                name,
            )
    for joint, level in _flat_tops(session.joint):
        seen = f"stops abruptly at {level:.4g} again and again"
        mend = (
            "check the range of the sensor and of the column; the samples at the level are not the position"
        )
        yield Doubt("position", (session.joint_names[joint],), seen, "saturation", mend, False, name)


def _flat_tops(columns: JointColumns) -> Iterator[tuple[int, float]]:
    """Joint and level of repeated flat tops, entered or left at speed.

    A joint stopping with the acceleration a covers a T^2 / 2 in the time T before; a clipped one covers its speed
    times T. Second differences at the lag T are a T^2.
    """
    position, lag = columns.position, _lag(columns)
    for joint, values in enumerate(position.T):
        steps = np.abs(np.diff(values))
        if len(values) < 20 * lag or not steps.any():
            continue
        bends = np.abs(values[2 * lag :] - 2.0 * values[lag:-lag] + values[: -2 * lag])
        usual = float(np.quantile(bends, 0.9)) + 4.0 * float(np.min(steps[steps > 0.0]))
        for level in (float(values.min()), float(values.max())):
            at = np.concatenate([[False], values == level, [False]])
            edges = np.flatnonzero(at[1:] != at[:-1]).reshape(-1, 2)
            tops = [
                (a, b) for a, b in edges if b - a >= max(_TOP, lag) and a >= lag and b + lag <= len(values)
            ]
            sharp = [
                max(abs(values[a - lag] - level), abs(values[b + lag - 1] - level)) > _SHARP * usual
                for a, b in tops
            ]
            if sum(sharp) >= _CORNERS:
                yield joint, level


def _lag(columns: JointColumns) -> int:
    return max(3, round(_LAG_S / columns.period_s)) if columns.period_s > 0.0 else 3


def _velocity(session: Session) -> Iterator[Doubt]:
    """Velocities against the differences of the positions."""
    joint, name = session.joint, session.path.name
    blocks = _speeds(joint)
    if blocks is None:
        return
    inner, slope, change = blocks
    yield from _late(session, inner, slope, change)
    moved = np.ptp(joint.position, axis=0) > _MOVED
    factors: dict[int, float] = {}
    for k in map(int, np.flatnonzero(moved)):
        speed, own = slope[:, k], inner[:, k]
        if not own.any():
            seen, mend = (
                "reads 0 while the joint moves",
                "repair the column, or import the log without velocities",
            )
            yield Doubt("velocity", (session.joint_names[k],), seen, "a dead channel", mend, False, name)
            continue
        related = _correlation(speed, own)
        if abs(related) < _CORRELATED:
            others = [
                j
                for j in map(int, np.flatnonzero(moved))
                if j != k and abs(_correlation(slope[:, j], own)) > 0.95
            ]
            looks = (
                f"the velocity of {session.joint_names[others[0]]}"
                if others
                else "another joint or another time"
            )
            seen = f"follows dq/dt of the position with a correlation of {related:.2f}"
            mend = "check the columns of position and velocity of this joint"
            if others or abs(related) < 0.5:
                yield Doubt("velocity", (session.joint_names[k],), seen, looks, mend, bool(others), name)
            continue
        factors[k] = float(own @ speed / (speed @ speed))
    wrong = {k: f for k, f in factors.items() if abs(f - 1.0) > _SPEEDS}
    common = float(np.median(list(factors.values()))) if factors else 1.0
    spread = max((abs(f / common - 1.0) for f in factors.values()), default=0.0)
    beside = abs(common - 1.0)
    shared = len(wrong) == len(factors) and spread < _SPEEDS
    if len(factors) > 1 and (shared or (beside > _COMMON and spread < _SPREAD * beside)):
        seen = f"the velocities of all joints are {common:.4g} times dq/dt"
        known = [unit for value, unit in _SPEED_UNITS.items() if abs(common / value - 1.0) < _SPEEDS]
        if known:
            mend = "state the factor of the velocities when importing; the fit does not use them"
            yield Doubt(
                "velocity", tuple(session.joint_names[k] for k in wrong), seen, known[0], mend, False, name
            )
            return
        looks = f"stamps that pass {common:.4g} times too fast, or velocities in another unit"
        mend = "state the unit of time, or the factor of the velocities, when importing"
        if not shared:
            looks = f"stamps that pass {common:.4g} times too fast, or a wrong scale of the velocities"
            mend = "check the rate of the recording; inertia is wrong by the square of the rate's error"
        yield Doubt("time", (), seen, looks, mend, _by_unit(common), name)
        return
    for k, factor in wrong.items():
        seen = f"is {factor:.4g} times dq/dt of the position"
        kind = "reversed sign" if abs(factor + 1.0) < _SPEEDS else "wrong unit"
        looks = f"a {kind} of one of the two"
        mend = "check sign and unit of position and velocity of this joint"
        yield Doubt("velocity", (session.joint_names[k],), seen, looks, mend, False, name)


def _speeds(joint: JointColumns) -> tuple[Floats, Floats, Floats] | None:
    """Velocities, dq/dt and accelerations (m, J) by the velocities, means over blocks: the first two are exact there.
    None without velocities."""
    if not joint.velocity.shape[1] or len(joint) < 100:
        return None
    clock = joint.publish_time if np.ptp(joint.publish_time) > 0 else joint.log_time
    time = (clock - clock[0]) * 1e-9
    size = max(_BLOCK, int(np.ceil(_BLOCK_S / max(float(np.median(np.diff(time))), 1e-9))))
    places = np.arange(0, len(time) - 1, size)
    if len(places) < 20:
        return None
    sums = np.vstack([np.zeros(joint.velocity.shape[1]), np.cumsum(joint.velocity, axis=0)])
    # The trapezoidal mean of the velocity over a block is the difference of its positions.
    ends = places[1:]
    inner = (
        sums[ends + 1] - sums[places[:-1]] - 0.5 * (joint.velocity[ends] + joint.velocity[places[:-1]])
    ) / size
    slope = np.diff(joint.position[places], axis=0) / np.diff(time[places])[:, None]
    change = np.gradient(inner, 0.5 * (time[ends] + time[places[:-1]]), axis=0)
    # A position that jumps says nothing of the speed.
    behind = np.array([jump.behind for jump in position_jumps(joint)], dtype=np.int64)
    whole = np.diff(np.searchsorted(behind, places, side="right")) == 0
    return (inner[whole], slope[whole], change[whole]) if np.isfinite(inner).all() else None


def _late(session: Session, inner: Floats, slope: Floats, change: Floats) -> Iterator[Doubt]:
    """Positions late against their velocities v: dq/dt = v - L dv/dt. Late velocities, such as filtered ones, harm
    nothing: no row is made of them."""
    least, found = max(LATE_S, 1.5 * session.joint.period_s), dict[int, tuple[float, float]]()
    for k in map(int, np.flatnonzero(np.ptp(session.joint.position, axis=0) > _MOVED)):
        columns, own = np.column_stack([inner[:, k], -change[:, k]]), slope[:, k]
        (factor, product), _, rank, _ = np.linalg.lstsq(columns, own, rcond=None)
        fit = columns @ np.array([factor, product])
        if rank < 2 or factor <= 0.0 or _correlation(fit, own) < _CORRELATED:
            continue
        variance = float(np.mean((own - fit) ** 2)) * np.linalg.inv(columns.T @ columns)[1, 1]
        late, std = float(product / factor), float(np.sqrt(variance) / factor)
        if late > max(least, _SURE * std):
            found[k] = late, std
    if found:
        k = max(found, key=lambda joint: found[joint][0])
        names = tuple(session.joint_names[joint] for joint in found)
        size = f"{1e3 * found[k][0]:.0f} ± {1e3 * found[k][1]:.1g} ms"
        seen = (
            f"comes {size} after its velocity"
            if len(found) == 1
            else f"come up to {size} after their velocities"
        )
        yield Doubt("position", names, seen, "late positions", MEND_TIME, False, session.path.name)


def _by_unit(factor: float) -> bool:
    return factor < 0.0 or abs(np.log(factor)) > np.log(_UNIT)


def _correlation(a: Floats, b: Floats) -> float:
    size = float(np.linalg.norm(a - a.mean()) * np.linalg.norm(b - b.mean()))
    return float((a - a.mean()) @ (b - b.mean())) / size if size > 0.0 else 0.0


def _limits(session: Session, limits: dict[str, dict[str, float]]) -> Iterator[Doubt]:
    """Positions and torques against the limits of the URDF."""
    name, joint = session.path.name, session.joint
    for k, own in enumerate(session.joint_names):
        limit = limits.get(own, {})
        if "lower" in limit and len(joint):
            low, high = np.quantile(joint.position[:, k], [_OUTLIERS, 1.0 - _OUTLIERS])
            middle, half = 0.5 * (limit["lower"] + limit["upper"]), 0.5 * (limit["upper"] - limit["lower"])
            over = max(high - middle, middle - low) / half
            if over > _OVER:
                degrees = np.radians(1.0) * max(high - middle, middle - low) < 1.1 * half and over > 3.0
                seen = f"ranges from {low:.4g} to {high:.4g}, beyond "
                seen += f"{limit['lower']:.4g} to {limit['upper']:.4g} of the URDF"
                looks = "degrees for radians" if degrees else "another zero, unit or joint"
                yield Doubt(
                    "position", (own,), seen, looks, "state unit and offset when importing", degrees, name
                )
        for channel, columns in _torques(session):
            if limit.get("effort", 0.0) > 0.0:
                size = float(np.quantile(np.abs(columns.effort[:, k]), 1.0 - _OUTLIERS))
                over = size / limit["effort"]
                if over > 3.0:
                    seen = f"reaches {size:.4g} Nm, {over:.3g} times the limit of the URDF"
                    looks = "mNm for Nm, or a gain" if over > 100.0 else "a unit or gain"
                    yield Doubt(
                        channel, (own,), seen, looks, "state the unit when importing", over > 100.0, name
                    )


def _pace(session: Session, limits: dict[str, dict[str, float]]) -> Iterator[Doubt]:
    """Speeds of all joints against the limits of the URDF: a wrong unit of time or position makes all too fast."""
    joint = session.joint
    if len(joint) < 100:
        return
    clock = joint.publish_time if np.ptp(joint.publish_time) > 0 else joint.log_time
    time = (clock - clock[0]) * 1e-9
    step = max(1, len(time) // 500)
    speed = (
        np.abs(np.diff(joint.position[::step], axis=0)) / np.maximum(np.diff(time[::step]), 1e-12)[:, None]
    )
    own = [limits.get(name, {}).get("velocity", np.inf) for name in session.joint_names]
    over = float(np.max(np.quantile(speed, 0.9, axis=0) / np.array(own)))
    if over > 3.0:
        seen = f"the joints move at up to {over:.3g} times their speed limits of the URDF"
        looks = "a unit of time too large, such as minutes for seconds, or positions in a unit too small"
        mend = "state the units of time and position when importing"
        yield Doubt("time", (), seen, looks, mend, over > 10.0, session.path.name)
