"""Channels that stay at a value: joints that never move, dead sensors, freezes, saturation."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from ident.dynamics.parameters import Floats
from ident.rows.data_quality import (
    STEP_RAD,
    Frozen,
    clipped_at,
    frozen_positions,
    frozen_torques,
    held,
    run_bounds,
    stuck_at,
)
from ident.screening.doubts import MOVED, Doubt, torques_of
from lwr_driver.session import JointColumns, Session

# Least standstill of a position that may be a frozen one [s].
_LONG_S = 2.0
# Corners at a flat top: least number, length of the top, way before it over the one of a usual stop, time of that way;
# share of the bends left out as outliers.
_CORNERS, _TOP, _SHARP, _LAG_S, _OUTLIERS = 2, 5, 2.0, 0.02, 0.001
# Share of the motion at one torque, wherever it is.
_OFTEN = 0.05
# Samples within which the torques of nearly all sensors change.
_SOON = 100
# Least time [s] of torques kept in all joints at once to be told; shorter ones are usual in a network.
_TOGETHER_S = 0.1


def never_moving(sessions: Sequence[Session]) -> Iterator[Doubt]:
    """Positions with one value in every sample."""
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
    if asked and command is not None and np.ptp(command.position[:, command.names.index(name)]) > MOVED:
        return True
    speed = session.joint.velocity
    return bool(speed.shape[1]) and bool(np.percentile(np.abs(speed[:, joint]), 90) > MOVED)


def _others_stand(sessions: Sequence[Session], joint: int) -> bool:
    """Whether other joints stand still to the last bit, too, as in a log of one joint's motion."""
    return all(np.sum(np.ptp(s.joint.position, axis=0) == 0.0) > 1 for s in sessions)


def dead_sensors(sessions: Sequence[Session], units: Mapping[str, str]) -> Iterator[Doubt]:
    """Dead torque sensors; certain for a joint without any torque of the side, and for the motor side's delay.

    units : of the torques by joint.
    """
    for session in sessions:
        for channel, columns in torques_of(session):
            motor = channel == "motor torque"
            for joint in dead(columns):
                alike = [own for other in sessions for name, own in torques_of(other) if name == channel]
                never = all(joint in dead(own) for own in alike)
                mend = "its rows are left out; repair the channel"
                if motor:
                    mend = "repair the channel, or leave the motor torques aside (Model 1, `--model 1`)"
                elif never:
                    mend = "repair the channel, add a session with it, or leave the joint torques aside"
                names = (session.joint_names[joint],)
                seen = (
                    f"reads {float(columns.effort[0, joint]):.4g} {units.get(names[0], 'Nm')} in every sample"
                )
                certain = motor or never
                yield Doubt(
                    channel, names, seen, "a dead sensor", mend, certain, session.path.name, lost=True
                )


def dead(columns: JointColumns | None) -> tuple[int, ...]:
    """Joints (from 0) with one and the same torque in all samples."""
    if columns is None or not columns.effort.size:
        return ()
    effort = columns.effort
    quiet = np.flatnonzero(np.all(effort[:_SOON] == effort[0], axis=0))
    return tuple(int(j) for j in quiet if np.ptp(effort[:, j]) == 0.0)


def frozen_channels(session: Session) -> Iterator[Doubt]:
    """Channels that stop in the middle of a motion."""
    joint = session.joint
    path_times = np.asarray((joint.log_time - joint.log_time[:1]) * 1e-9, dtype=np.float64)
    for channel, columns in torques_of(session):
        times = np.asarray((columns.log_time - joint.log_time[:1]) * 1e-9, dtype=np.float64)
        effort = columns.effort
        runs = frozen_torques(effort, times, path_times, joint.position)
        yield from _stopped(session, channel, times, effort, runs)
        kept = np.flatnonzero(np.diff(held(effort, times, path_times, joint.position), prepend=0, append=0))
        together = [(int(a) - 1, int(b) - 1) for a, b in kept.reshape(-1, 2)]
        long = [(a, b) for a, b in together if times[b] - times[a] >= _TOGETHER_S]
        if long:
            seen, share = spans_in_words(times, long), sum(b - a for a, b in long) / len(times)
            mend = "these samples are left out; look for what held the recording up"
            seen = f"every joint keeps its value {seen}, while the arm moves"
            yield Doubt(channel, (), seen, "lost samples", mend, share > _OFTEN, session.path.name)
    runs = frozen_positions(joint)
    yield from _stopped(session, "position", path_times, joint.position, runs)
    jumping = {run.joint for run in runs}
    rest = [run for k, run in enumerate(_standing(session)) if run is not None and k not in jumping]
    for run in rest:
        yield from _stopped(session, "position", path_times, joint.position, (run,), kept=True)


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
            f"{value} {spans_in_words(times, spans)}, in the middle of a motion",
            "a frozen channel" if alone else "lost samples, or frozen channels",
            mend if certain else "these samples are left out; repair the channel",
            certain,
            session.path.name,
            lost=channel != "position" and certain,
        )


def spans_in_words(times: Floats, spans: Sequence[tuple[int, int]]) -> str:
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
            and bool(not others.shape[1] or np.any(np.ptp(others, axis=0) > MOVED))
            and (_driven(session, k, stamps) or _abrupt(joint, k, first, last))
        )
        yield Frozen(k, first, last) if found else None


def _driven(session: Session, joint: int, stamps: NDArray[np.int64]) -> bool:
    """Whether the joint is commanded to move, or measured to move by its velocity, between two times."""
    name, command, speed = session.joint_names[joint], session.command, session.joint.velocity
    if command is not None and name in command.names and command.position.shape[1]:
        inside = (command.log_time >= stamps[0]) & (command.log_time <= stamps[1])
        return bool(inside.any() and np.ptp(command.position[inside, command.names.index(name)]) > MOVED)
    times = session.joint.log_time
    inside = (times >= stamps[0]) & (times <= stamps[1])
    return bool(speed.shape[1]) and bool(np.percentile(np.abs(speed[inside, joint]), 90) > MOVED)


def _abrupt(columns: JointColumns, joint: int, first: int, last: int) -> bool:
    """Whether the standstill begins or ends by a jump: a joint with the acceleration a covers a T^2 / 2 in T."""
    values, lag = columns.position[:, joint], _lag(columns)
    bends = np.abs(values[2 * lag :] - 2.0 * values[lag:-lag] + values[: -2 * lag])
    middle = np.arange(lag, len(values) - lag)
    usual = bends[(np.abs(middle - first) > 2 * lag) & (np.abs(middle - last) > 2 * lag)]
    before, after = values[max(first - lag, 0)], values[min(last + lag, len(values) - 1)]
    jump = max(abs(before - values[first]), abs(after - values[first]))
    return bool(len(usual) and jump > max(_SHARP * float(np.quantile(usual, 1.0 - _OUTLIERS)), STEP_RAD))


def saturated(session: Session, units: Mapping[str, str]) -> Iterator[Doubt]:
    """Channels that end at one value again and again. units : of the torques by joint."""
    name, by_joint = session.path.name, [units.get(own, "Nm") for own in session.joint_names]
    mend = "move more gently or widen the sensor's range; the samples at the level are not the torque"
    if session.joint.effort.size:
        silent = set(dead(session.joint))
        for joint, level in enumerate(clipped_at(session.joint)):
            if np.isfinite(level) and joint not in silent:
                seen = f"stays at its largest value, {level:.4g} {by_joint[joint]}, again and again"
                where = (session.joint_names[joint],)
                yield Doubt("joint torque", where, seen, "saturation", mend, session=name, kind="saturation")
    if session.motor is not None and session.motor.effort.size:
        silent = set(dead(session.motor))
        levels: dict[int, list[str]] = {}
        clipped = dict[int, float]()
        for stuck in stuck_at(session.motor, session.joint):
            own, share = session.motor.effort[:, stuck.joint], stuck.count / max(stuck.samples, 1)
            # A coarse sensor may repeat a value somewhere in its range; a limit is the end of the range.
            limit = stuck.value in (own.min(), own.max())
            if stuck.joint not in silent and (share > _OFTEN or limit):
                clipped[stuck.joint] = clipped.get(stuck.joint, 0.0) + share * limit
                levels.setdefault(stuck.joint, []).append(
                    f"{stuck.value:.4g} {by_joint[stuck.joint]} ({100 * share:.0f} % of the motion)"
                )
        for joint, texts in levels.items():
            yield Doubt(
                "motor torque",
                (session.joint_names[joint],),
                f"stays at {' and '.join(texts)}",
                "saturation" if clipped[joint] > 0.0 else "saturation or a dead zone",
                mend,
                session=name,
                lost=clipped[joint] > _OFTEN,
                kind="saturation",
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
