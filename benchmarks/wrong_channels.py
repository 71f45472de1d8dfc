"""Are wrong channels named before they become confident nonsense?

Run `python -m benchmarks.wrong_channels [--seed 700] [--healthy 40] [--case TEXT]`. Two logs of the default emulator
(bare arm, payload) are changed in memory, one channel at a time, and identified with the settings as they come. For
each change the table says: error, warning or silent; whether the messages name channel and joint; the largest
deviation of a parameter from the truth in its standard deviations, where there is a result. Unchanged logs follow,
identified as by `lwr-run identify`: other motions, lengths, paces, and arms with a day's tolerances. They shall say
nothing: no doubt, no warning of the fit, no advice, no disagreement with the URDF.
"""

from __future__ import annotations

import argparse
import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import logging
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from fri.errors import DataError
from ident.dynamics.kinematics import Chain
from ident.estimation.identification import Identification, IdentificationSettings
from ident.estimation.identify import identify
from ident.estimators.names import AUTO
from ident.screening.screen import screen
from lwr_driver.configuration import find
from lwr_driver.session import JointColumns, Session
from tests.hidden_physics.robots import Day, session_settings
from tests.hidden_physics.robots import Setting as Hidden
from tests.ident.estimation.emulated_sessions import record_pair
from tests.ident.estimation_arm import true_base

Sessions = list[Session]
Change = Callable[[Sessions], Sessions]

JOINTS = ("A1", "A2", "E1", "A3", "A4", "A5", "A6")
LIMIT = 5.0


@dataclass(frozen=True)
class Case:
    """A change of the logs, and the words that name its channel and its joints."""

    name: str
    change: Change
    words: tuple[str, ...]


def _channel(sessions: Sessions, channel: str, edit: Callable[[JointColumns], JointColumns]) -> Sessions:
    done = []
    for session in sessions:
        columns = getattr(session, channel)
        changed: dict[str, Any] = {} if columns is None else {channel: edit(columns)}
        done.append(replace(session, **changed))
    return done


def scaled(channel: str, field: str, factor: float, *joints: str) -> Change:
    """One field of the joints (all without names) times a factor."""

    def edit(columns: JointColumns) -> JointColumns:
        values = getattr(columns, field).copy()
        picked = [JOINTS.index(name) for name in joints or JOINTS]
        values[:, picked] *= factor
        return replace(columns, **{field: values})

    return lambda sessions: _channel(sessions, channel, edit)


def swapped(channel: str, field: str, first: str, second: str) -> Change:
    """Two joints of one field interchanged."""

    def edit(columns: JointColumns) -> JointColumns:
        values = getattr(columns, field).copy()
        a, b = JOINTS.index(first), JOINTS.index(second)
        values[:, [a, b]] = values[:, [b, a]]
        return replace(columns, **{field: values})

    return lambda sessions: _channel(sessions, channel, edit)


def turned(degrees: float, *joints: str) -> Change:
    """Positions with another zero."""

    def edit(columns: JointColumns) -> JointColumns:
        values = columns.position.copy()
        values[:, [JOINTS.index(name) for name in joints]] += np.radians(degrees)
        return replace(columns, position=values)

    return lambda sessions: _channel(sessions, "joint", edit)


def delayed(seconds: float, joint: str) -> Change:
    """A joint's position from `seconds` before."""

    def edit(columns: JointColumns) -> JointColumns:
        values, k = columns.position.copy(), JOINTS.index(joint)
        time = 1e-9 * (columns.log_time - columns.log_time[0])
        values[:, k] = np.interp(time - seconds, time, values[:, k])
        return replace(columns, position=values)

    return lambda sessions: _channel(sessions, "joint", edit)


def copied(channel: str, field: str, source: str, target: str) -> Change:
    """The column of a joint read for another, too."""

    def edit(columns: JointColumns) -> JointColumns:
        values = getattr(columns, field).copy()
        values[:, JOINTS.index(target)] = values[:, JOINTS.index(source)]
        return replace(columns, **{field: values})

    return lambda sessions: _channel(sessions, channel, edit)


def clipped(channel: str, field: str, share: float, *joints: str) -> Change:
    """The joints' values held within a share of their largest."""

    def edit(columns: JointColumns) -> JointColumns:
        values = getattr(columns, field).copy()
        for joint in (JOINTS.index(name) for name in joints or JOINTS):
            limit = share * np.abs(values[:, joint]).max()
            values[:, joint] = np.clip(values[:, joint], -limit, limit)
        return replace(columns, **{field: values})

    return lambda sessions: _channel(sessions, channel, edit)


def shifted(channel: str, field: str, value: float, *joints: str) -> Change:
    """One field of the joints with another zero."""

    def edit(columns: JointColumns) -> JointColumns:
        values = getattr(columns, field).copy()
        values[:, [JOINTS.index(name) for name in joints]] += value
        return replace(columns, **{field: values})

    return lambda sessions: _channel(sessions, channel, edit)


def drifting(channel: str, field: str, value: float, *joints: str) -> Change:
    """The joints' zero moves by `value` from the start of each log to its end."""

    def edit(columns: JointColumns) -> JointColumns:
        values = getattr(columns, field).copy()
        values[:, [JOINTS.index(name) for name in joints]] += np.linspace(0.0, value, len(values))[:, None]
        return replace(columns, **{field: values})

    return lambda sessions: _channel(sessions, channel, edit)


def in_one(change: Change, number: int = 0) -> Change:
    """The change in one session, the others as they were."""
    return lambda sessions: [
        done if k == number else session
        for k, (session, done) in enumerate(zip(sessions, change(sessions), strict=True))
    ]


def from_the_middle(channel: str, field: str, change: Change) -> Change:
    """The change of one field from half of the first session on."""

    def whole(sessions: Sessions) -> Sessions:
        before, after = (getattr(one[0], channel) for one in (sessions, change(sessions)))
        values = getattr(before, field).copy()
        values[len(values) // 2 :] = getattr(after, field)[len(values) // 2 :]
        changed: dict[str, Any] = {channel: replace(before, **{field: values})}
        return [replace(sessions[0], **changed), *sessions[1:]]

    return whole


def constant(channel: str, field: str, value: float, *joints: str) -> Change:
    """The joints read one value all the time."""

    def edit(columns: JointColumns) -> JointColumns:
        values = getattr(columns, field).copy()
        values[:, [JOINTS.index(name) for name in joints]] = value
        return replace(columns, **{field: values})

    return lambda sessions: _channel(sessions, channel, edit)


def frozen(channel: str, field: str, joint: str) -> Change:
    """The joint keeps the value of a quarter of the log until three quarters."""

    def edit(columns: JointColumns) -> JointColumns:
        values, k = getattr(columns, field).copy(), JOINTS.index(joint)
        first, last = len(values) // 4, 3 * len(values) // 4
        values[first:last, k] = values[first, k]
        return replace(columns, **{field: values})

    return lambda sessions: _channel(sessions, channel, edit)


def paced(
    factor: float,
    channels: tuple[str, ...] = ("joint", "motor", "command"),
    clocks: tuple[str, ...] = ("publish_time", "log_time"),
) -> Change:
    """Times and phases stretched by a factor."""

    def change(sessions: Sessions) -> Sessions:
        done = []
        for session in sessions:
            origin = {
                "publish_time": int(session.joint.publish_time[0]),
                "log_time": int(session.joint.log_time[0]),
            }

            def late(clock: str, times: Any, origin: dict[str, int] = origin) -> Any:
                return np.asarray(origin[clock] + np.rint((times - origin[clock]) * factor), dtype=np.int64)

            fields: dict[str, Any] = {}
            for channel in channels:
                columns = getattr(session, channel)
                fields[channel] = replace(columns, **{c: late(c, getattr(columns, c)) for c in clocks})
            if "log_time" in clocks:
                fields["phases"] = tuple(
                    phase._replace(log_time=int(late("log_time", np.int64(phase.log_time))))
                    for phase in session.phases
                )
            done.append(replace(session, **fields))
        return done

    return change


def labelled(*labels: str, mass: float | None = None) -> Change:
    """Other payload labels."""

    def change(sessions: Sessions) -> Sessions:
        more = {} if mass is None else {"payload_mass": str(mass)}
        return [
            replace(
                session, metadata={**session.metadata, "payload": label, **(more if label != "none" else {})}
            )
            for session, label in zip(sessions, labels, strict=True)
        ]

    return change


def with_speed(change: Change | None = None, factor: float = 1.0, *joints: str) -> Change:
    """Velocities beside the positions, as dq/dt, changed by a factor in the joints."""

    def edit(columns: JointColumns) -> JointColumns:
        speed = np.gradient(columns.position, 1e-9 * (columns.log_time - columns.log_time[0]), axis=0)
        speed = speed.copy()
        picked = [JOINTS.index(name) for name in joints]
        speed[:, picked] *= factor
        return replace(columns, velocity=speed)

    def whole(sessions: Sessions) -> Sessions:
        done = _channel(sessions, "joint", edit)
        return done if change is None else change(done)

    return whole


def renamed(sessions: Sessions) -> Sessions:
    """The bare arm's log copied under another name with another uid."""
    copy = replace(
        sessions[0],
        path=sessions[0].path.with_name("copy.mcap"),
        metadata={**sessions[0].metadata, "uid": "another"},
    )
    return [*sessions, copy]


def without(channel: str, change: Change) -> Change:
    """The change in logs without the motor or the joint torque."""

    def whole(sessions: Sessions) -> Sessions:
        if channel == "motor":
            return change([replace(session, motor=None) for session in sessions])
        return change(
            [replace(s, joint=replace(s.joint, effort=np.zeros((len(s.joint), 0)))) for s in sessions]
        )

    return whole


def mistaken(sessions: Sessions) -> Sessions:
    """The motor torques under the name of joint torques, which are missing."""

    def efforts(session: Session) -> Any:
        assert session.motor is not None
        times = session.joint.publish_time, session.motor.publish_time
        return np.column_stack([np.interp(*times, effort) for effort in session.motor.effort.T])

    return [replace(s, joint=replace(s.joint, effort=efforts(s)), motor=None) for s in sessions]


M, L, Q = ("motor", "effort"), ("joint", "effort"), ("joint", "position")
MOTOR, JOINT, POSITION = "motor torque", "joint torque", "position"

CASES: tuple[Case, ...] = (
    # Of the review of an adversary.
    Case("motor A4 in mNm", scaled(*M, 1e3, "A4"), (MOTOR, "A4")),
    Case("motor A5 sign", scaled(*M, -1.0, "A5"), (MOTOR, "A5")),
    Case("position E1 sign", scaled(*Q, -1.0, "E1"), (POSITION, "E1")),
    Case("motor E1/A3 swapped", swapped(*M, "E1", "A3"), (MOTOR, "E1", "A3")),
    Case("joint A2 x 1.3", scaled(*L, 1.3, "A2"), (JOINT, "A2")),
    Case("the pair five times", lambda s: s * 5, ("twice",)),
    Case("motor torques saturated", clipped(*M, 0.6), (MOTOR, *JOINTS)),
    Case("rate x 2", paced(0.5), ("time",)),
    Case("degrees as radians", scaled(*Q, 180 / np.pi), (POSITION, *JOINTS)),
    Case("ms as s", paced(1e3), ("time",)),
    Case("joint A4 reads 0", constant(*L, 0.0, "A4"), (JOINT, "A4")),
    # Units.
    Case("joint A2 in mNm", scaled(*L, 1e3, "A2"), (JOINT, "A2")),
    Case("joint A6 in mNm", scaled(*L, 1e3, "A6"), (JOINT, "A6")),
    Case("joint torques in mNm", scaled(*L, 1e3), (JOINT, *JOINTS)),
    Case("motor torques in mNm", scaled(*M, 1e3), (MOTOR, *JOINTS)),
    Case("motor torques before the gear", scaled(*M, 1e-2), (MOTOR, *JOINTS)),
    Case("motor A1 in kNm", scaled(*M, 1e-3, "A1"), (MOTOR, "A1")),
    Case("position A4 in degrees", scaled(*Q, 180 / np.pi, "A4"), (POSITION, "A4")),
    Case("position A2 in turns", scaled(*Q, 0.5 / np.pi, "A2"), (POSITION, "A2")),
    Case("positions as rad, were degrees twice", scaled(*Q, np.pi / 180), (POSITION, *JOINTS)),
    Case("time in minutes", paced(1 / 60), ("time",)),
    Case("time x 1.5", paced(1.5), ("time",)),
    Case("source clock x 2, host's right", paced(2.0, clocks=("publish_time",)), ("time",)),
    Case("velocity A3 in deg/s", with_speed(None, 180 / np.pi, "A3"), ("velocity", "A3")),
    Case("velocity A3 sign", with_speed(None, -1.0, "A3"), ("velocity", "A3")),
    Case("time x 2 beside right velocities", with_speed(paced(2.0)), ("time",)),
    # Signs.
    Case("motor A1 sign", scaled(*M, -1.0, "A1"), (MOTOR, "A1")),
    Case("joint A2 sign", scaled(*L, -1.0, "A2"), (JOINT, "A2")),
    Case("joint A6 sign", scaled(*L, -1.0, "A6"), (JOINT, "A6")),
    Case("joint torques sign", scaled(*L, -1.0), (JOINT, *JOINTS)),
    Case("motor torques sign", scaled(*M, -1.0), (MOTOR, *JOINTS)),
    Case("both torques sign", lambda s: scaled(*M, -1.0)(scaled(*L, -1.0)(s)), ("torque", *JOINTS)),
    Case("position A1 sign", scaled(*Q, -1.0, "A1"), (POSITION, "A1")),
    Case("position A6 sign", scaled(*Q, -1.0, "A6"), (POSITION, "A6")),
    # Swaps.
    Case("joint A1/A2 swapped", swapped(*L, "A1", "A2"), (JOINT, "A1", "A2")),
    Case("joint A5/A6 swapped", swapped(*L, "A5", "A6"), (JOINT, "A5", "A6")),
    Case("motor A5/A6 swapped", swapped(*M, "A5", "A6"), (MOTOR, "A5", "A6")),
    Case("position A3/A4 swapped", swapped(*Q, "A3", "A4"), (POSITION, "A3", "A4")),
    Case("position A1/E1 swapped", swapped(*Q, "A1", "E1"), (POSITION, "A1", "E1")),
    # Gains.
    Case("motor A2 x 1.3", scaled(*M, 1.3, "A2"), (MOTOR, "A2")),
    Case("motor A6 x 0.7", scaled(*M, 0.7, "A6"), (MOTOR, "A6")),
    Case("joint A3 x 0.7", scaled(*L, 0.7, "A3"), (JOINT, "A3")),
    Case("joint A6 x 1.3", scaled(*L, 1.3, "A6"), (JOINT, "A6")),
    Case("position A3 x 1.3", scaled(*Q, 1.3, "A3"), (POSITION, "A3")),
    Case("position A2 x 1.15", scaled(*Q, 1.15, "A2"), (POSITION, "A2")),
    Case("position E1 5 deg off", turned(5.0, "E1"), (POSITION, "E1")),
    Case("position A4 15 deg off", turned(15.0, "A4"), (POSITION, "A4")),
    Case("position A2 40 ms late", delayed(0.04, "A2"), (POSITION, "A2")),
    Case("position E1 read for A4, too", copied(*Q, "E1", "A4"), (POSITION, "E1", "A4")),
    Case("joint E1 read for A4, too", copied(*L, "E1", "A4"), (JOINT, "E1", "A4")),
    # Saturation and dead sensors.
    Case("joint A2 saturated", clipped(*L, 0.7, "A2"), (JOINT, "A2")),
    Case("joint A5 saturated", clipped(*L, 0.5, "A5"), (JOINT, "A5")),
    Case("motor A3 saturated", clipped(*M, 0.5, "A3"), (MOTOR, "A3")),
    Case("position A4 saturated", clipped(*Q, 0.7, "A4"), (POSITION, "A4")),
    Case("motor A6 reads 0", constant(*M, 0.0, "A6"), (MOTOR, "A6")),
    Case("joint A2 reads 12.3", constant(*L, 12.3, "A2"), (JOINT, "A2")),
    Case("position A5 reads 0.4", constant(*Q, 0.4, "A5"), (POSITION, "A5")),
    Case("position A5 reads 0.4 in one log", in_one(constant(*Q, 0.4, "A5")), (POSITION, "A5")),
    Case("motor A2 frozen half the time", frozen(*M, "A2"), (MOTOR, "A2")),
    Case("motor A6 frozen half of one log", in_one(frozen(*M, "A6")), (MOTOR, "A6")),
    Case("joint A1 frozen half the time", frozen(*L, "A1"), (JOINT, "A1")),
    Case("joint A4 frozen half of one log", in_one(frozen(*L, "A4")), (JOINT, "A4")),
    Case("position E1 frozen half of one log", in_one(frozen(*Q, "E1")), (POSITION, "E1")),
    # In one of the logs, or from some moment on.
    Case("motor A2 sign in one log", in_one(scaled(*M, -1.0, "A2"), 1), (MOTOR, "A2")),
    Case("joint A3 in kNm in one log", in_one(scaled(*L, 1e-3, "A3")), (JOINT, "A3")),
    Case("joint A4 x 1.4 in one log", in_one(scaled(*L, 1.4, "A4"), 1), (JOINT, "A4")),
    Case("motor A3/A4 swapped in one log", in_one(swapped(*M, "A3", "A4"), 1), (MOTOR, "A3", "A4")),
    Case("joint A2 20 Nm off in one log", in_one(shifted(*L, 20.0, "A2")), (JOINT, "A2")),
    Case("joint A2 drifts by 20 Nm in one log", in_one(drifting(*L, 20.0, "A2")), (JOINT, "A2")),
    Case("motor A3 drifts by 10 Nm in both logs", drifting(*M, 10.0, "A3"), (MOTOR, "A3")),
    Case("motor A4 sign from the middle", from_the_middle(*M, scaled(*M, -1.0, "A4")), (MOTOR, "A4")),
    Case("joint A2 halved from the middle", from_the_middle(*L, scaled(*L, 0.5, "A2")), (JOINT, "A2")),
    Case("position E1 8 deg off in one log", in_one(turned(8.0, "E1"), 1), (POSITION, "E1")),
    # One torque alone.
    Case("motor torques as joint torques", mistaken, (JOINT, "motor torques")),
    Case("joint only: A2 x 1.3", without("motor", scaled(*L, 1.3, "A2")), (JOINT, "A2")),
    Case("joint only: A5 sign", without("motor", scaled(*L, -1.0, "A5")), (JOINT, "A5")),
    Case("joint only: E1/A3 swapped", without("motor", swapped(*L, "E1", "A3")), (JOINT, "E1", "A3")),
    Case("joint only: position A4 sign", without("motor", scaled(*Q, -1.0, "A4")), (POSITION, "A4")),
    Case("motor only: A3 sign", without("joint", scaled(*M, -1.0, "A3")), (MOTOR, "A3")),
    Case("motor only: A2 x 1.3", without("joint", scaled(*M, 1.3, "A2")), (MOTOR, "A2")),
    Case("motor only: A4/A5 swapped", without("joint", swapped(*M, "A4", "A5")), (MOTOR, "A4", "A5")),
    Case("motor only: position E1 sign", without("joint", scaled(*Q, -1.0, "E1")), (POSITION, "E1")),
    # Logs and labels.
    Case("a copy of a log under another name", renamed, ("twice",)),
    Case("labels interchanged", labelled("paper_load", "none"), ("payload",)),
    Case("loaded log labelled bare", labelled("none", "none"), ("payload",)),
    Case("bare log labelled loaded", labelled("paper_load", "paper_load"), ("payload",)),
    Case("payload stated at half its mass", labelled("none", "paper_load", mass=1.67), ("payload",)),
)


@dataclass(frozen=True)
class Outcome:
    """What identification said of one set of logs.

    verdict : "error", "warning" or "silent". text : all messages. deviation : largest |estimate - truth| in
        standard deviations, of `parameter`; NaN without an estimate or a truth.
    """

    verdict: str
    text: str
    deviation: float = float("nan")
    parameter: str = ""
    seconds: float = 0.0

    def names(self, words: tuple[str, ...]) -> bool:
        """Whether the messages hold all words."""
        return all(word in self.text for word in words)


def outcome(sessions: Sessions, chain: Chain, estimator: str = "wls") -> Outcome:
    """Identification with the settings as they come."""
    start = time.perf_counter()
    model = 2 if any(session.motor is not None for session in sessions) else 1
    try:
        settings = IdentificationSettings(model=model, estimator=estimator, essential=None)
        found = identify(sessions, chain, settings)
    except DataError as error:
        return Outcome("error", str(error), seconds=time.perf_counter() - start)
    said = [*found.warnings]
    if found.choice is not None:
        apart = found.choice.disagreement
        said += [*found.choice.advice, *([str(apart)] if apart and "disagree" in str(apart) else [])]
    text = "\n".join(said)
    spent = time.perf_counter() - start
    try:
        scores = _scores(found)
    except (KeyError, ValueError, IndexError):
        return Outcome("warning" if text else "silent", text, seconds=spent)
    worst = int(np.argmax(np.abs(scores)))
    return Outcome(
        "warning" if text else "silent", text, abs(float(scores[worst])), found.base.names[worst], spent
    )


def _scores(found: Identification) -> np.ndarray:
    return (found.estimate.values - true_base(found)) / found.estimate.std


def healthy(number: int, folder: Path) -> Sessions:
    """Set `number` of unchanged logs: other motions, lengths, paces, and every third an arm with a day's tolerances."""
    period_s, periods = ((20.0, 2), (10.0, 2), (30.0, 1), (15.0, 1))[number % 4]
    settings = session_settings(Day(number), Hidden()) if number % 3 == 2 else {}
    return record_pair(folder, 2000 + number, period_s=period_s, periods=periods, settings=settings)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--seed", type=int, default=700)
    parser.add_argument("--healthy", type=int, default=40)
    parser.add_argument("--case", default="", help="only the cases with this text")
    parser.add_argument("--messages", action="store_true", help="print the first message of each case")
    options = parser.parse_args()
    logging.disable(logging.WARNING)
    chain = Chain.from_urdf(find("lwr4plus.urdf"))
    with tempfile.TemporaryDirectory() as folder:
        sessions = record_pair(Path(folder), options.seed)
    plain = outcome(sessions, chain)
    print(f"{'case':<38}{'says':<9}{'named':<7}{'worst':>10}  parameter        s")
    print(
        f"{'as recorded':<38}{plain.verdict:<9}{'':<7}{plain.deviation:>10.1f}  "
        f"{plain.parameter:<10}{plain.seconds:>7.1f}"
    )
    missed = []
    for case in CASES:
        if options.case not in case.name:
            continue
        found = outcome(case.change(sessions), chain)
        named = found.verdict != "silent" and found.names(case.words)
        print(
            f"{case.name:<38}{found.verdict:<9}{'yes' if named else 'NO':<7}{found.deviation:>10.1f}  "
            f"{found.parameter:<10}{found.seconds:>7.1f}",
            flush=True,
        )
        if options.messages and found.text:
            print("    " + found.text.splitlines()[0])
        harmless = found.deviation <= LIMIT and found.verdict == "silent"
        if not named and not harmless:
            missed.append(case.name)
    print(
        f"\n{len(missed)} of {len(CASES)} changes neither named nor harmless (beyond {LIMIT:g} sigma): {missed}"
    )
    alarms = others = 0
    for number in range(options.healthy):
        with tempfile.TemporaryDirectory() as folder:
            unchanged = healthy(number, Path(folder))
        found = outcome(unchanged, chain, AUTO)
        doubted = screen(unchanged, chain)
        alarms += bool(doubted) or found.verdict == "error"
        others += found.verdict == "warning" and not doubted
        if found.text:
            print(f"healthy {number}: {found.verdict}: {found.text}", flush=True)
    if options.healthy:
        print(f"{alarms} of {options.healthy} healthy sets with an error or a doubt about a channel,")
        print(f"{others} with a warning of the fit or of the estimator's choice alone")


if __name__ == "__main__":
    main()
