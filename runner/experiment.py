"""The experiment: plan, approach, excite, log, swap the payload, and again, as one resumable sequence."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal, Protocol

import numpy as np
import numpy.typing as npt

from fri.errors import DataError, LwrError, RefusedError, RobotError, naming
from lwr_driver.arm import Arm
from lwr_driver.arm.cell import Cell
from lwr_driver.configuration import find
from lwr_driver.driver import LOCK_STEP_EPOCH_NS, Driver, LinkState, MotionProgress, Outcome
from lwr_driver.motion import Motion
from lwr_driver.realtime import Rights
from lwr_driver.references import Frozen
from lwr_driver.session import read_session, session_metadata
from lwr_driver.session.motor_torque import match_torques
from lwr_driver.session.trace import import_trace
from runner.computer import git_commit, software
from runner.experiment_file import Experiment, Payload, SessionPlan
from runner.planning import attached_plan, session_motion
from runner.preflight import (
    Preflight,
    Rest,
    check_gravity,
    check_link,
    check_payload,
    check_rights,
    load_data,
    set_load,
)
from runner.status import StatusLine
from runner.terminal import Interrupts

Vector = npt.NDArray[np.float64]
Status = Literal["success", "abort", "fail"]

_REST_S = 0.5
_LEAST_MOTION_RAD = 0.02
_PROGRESS = "progress.json"


@dataclass
class ExperimentProgress:
    """Progress of an experiment, stored beside its logs for a resumption.

    finished : the arm's state at rest after each finished session. attempts : uids of all attempts by session.
    """

    path: Path
    origin: Path | None = None
    finished: dict[str, dict[str, list[float]]] = field(default_factory=dict)
    attempts: dict[str, list[str]] = field(default_factory=dict)

    @classmethod
    def load(cls, folder: Path) -> ExperimentProgress:
        """Read the progress in `folder`, or begin anew. DataError for a broken file."""
        path = folder / _PROGRESS
        if not path.exists():
            return cls(path)
        try:
            content: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
            origin = Path(content["origin"]) if content["origin"] else None
            progress = cls(path, origin, dict(content["finished"]), dict(content["attempts"]))
            for name, entry in progress.finished.items():
                rest, _ = progress.rest(name, None), progress.rows(name)
                if (
                    rest.q.shape != rest.tau.shape
                    or rest.q.ndim != 1
                    or not np.isfinite([rest.q, rest.tau]).all()
                ):
                    raise ValueError(f"finished session {name!r} is {entry!r:.80}")
            if not all(isinstance(uid, str) for uids in progress.attempts.values() for uid in uids):
                raise ValueError("an attempt is no text")
            return progress
        except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
            raise DataError(
                f"{path}: cannot be read, {type(error).__name__}: {error}; delete it to start the experiment anew"
            ) from error

    @classmethod
    def create(cls, folder: Path, origin: Path) -> ExperimentProgress:
        """Begin the progress of an experiment. origin : folder of its file."""
        progress = cls(folder / _PROGRESS, origin)
        progress._save()
        return progress

    def rest(self, session: str, payload: Payload | None) -> Rest:
        """The arm at rest after a finished session."""
        entry = self.finished[session]
        return Rest(np.asarray(entry["q"]), np.asarray(entry["tau"]), payload)

    def begin(self, session: str, log: Path, uid: str) -> tuple[str, str]:
        """Count an attempt at a session; an earlier unfinished log is renamed.

        Returns the uid of this attempt, `uid` with a number, and the uid of the previous attempt or "".
        """
        earlier = self.attempts.setdefault(session, [])
        if log.exists():
            number = max(len(earlier), 1)
            while (kept := log.with_name(f"{log.stem}.attempt-{number}{log.suffix}")).exists():
                number += 1
            log.rename(kept)
        parent = earlier[-1] if earlier else ""
        earlier.append(f"{uid}-{len(earlier) + 1}")
        self._save()
        return earlier[-1], parent

    def rows(self, session: str) -> int:
        """Number of samples in the log of a finished session, 0 if unknown."""
        entry = self.finished[session].get("rows", [0])
        return int(entry[0])

    def finish(self, session: str, rest: Rest, rows: int = 0) -> None:
        """Mark a session as finished, with the number of samples in its log."""
        self.finished[session] = {"q": rest.q.tolist(), "tau": rest.tau.tolist(), "rows": [rows]}
        self._save()

    def _save(self) -> None:
        content = {"origin": str(self.origin or ""), "finished": self.finished, "attempts": self.attempts}
        draft = self.path.with_suffix(".json.new")
        with naming(draft), draft.open("w", encoding="utf-8") as stream:
            json.dump(content, stream, indent=1)
            stream.flush()
            os.fsync(stream.fileno())
        draft.replace(self.path)


@dataclass(frozen=True)
class LinkReport:
    """The link during a session: counts of cycles, reply latency of the loop, tracking.

    missed : late answers by the controller's count. latency_s : quantiles since the connection, by name (p99).
    worst_tracking_error_rad : by joint.
    """

    cycles: int
    missed: int
    lost: int
    late: int
    period_s: float
    latency_s: dict[str, float]
    worst_tracking_error_rad: list[float]

    @classmethod
    def between(cls, start: LinkState, end: LinkState) -> LinkReport:
        """From the states before and after."""
        return cls(
            end.received - start.received,
            end.miss_counter - start.miss_counter,
            end.lost - start.lost,
            end.late - start.late,
            end.period_s,
            {f"p{100 * quantile:g}": value for quantile, value in end.latency_s.items()},
            end.tracking_error.tolist(),
        )


@dataclass(frozen=True)
class Record:
    """The end of a session: file, status, reason, link, and warnings about the data."""

    name: str
    path: Path
    status: Status
    reason: str
    link: LinkReport | None = None
    error: LwrError | None = None
    warnings: tuple[str, ...] = ()


class Operator(Protocol):
    """The requests of an experiment to the person at the arm."""

    def swap(self, mounted: Payload | None, wanted: Payload | None) -> None:
        """Swap the payload `mounted` for `wanted`, and enter its load data in the controller."""

    def start_trace(self) -> None:
        """Start the controller's own recording."""

    def save_trace(self, path: Path) -> bool:
        """Save the controller's recording to `path`; False without a file."""


class Onlooker(Protocol):
    """An observer of the motions, such as the live view."""

    def begin(self, session: str, payload: Payload | None, motion: Motion) -> None:
        """A motion begins."""


@dataclass(frozen=True)
class Bench:
    """The surroundings of the sequence: the arm's description, a driver, a person, an observer."""

    arm: Arm
    cell: Cell
    driver: Driver
    operator: Operator
    status: StatusLine = field(default_factory=StatusLine)
    onlooker: Onlooker | None = None

    def cycles(self, seconds: float) -> int:
        """Controller cycles in a time [s], at least 10."""
        return max(10, round(seconds / self.driver.state().period_s))

    def metadata(
        self, experiment: Experiment, payload: Payload | None, uid: str, parent_uid: str = ""
    ) -> dict[str, str]:
        """Metadata of a log recorded here with a payload mounted; lock step has the epoch of its clock."""
        epoch = datetime.fromtimestamp(LOCK_STEP_EPOCH_NS * 1e-9, UTC)
        return session_metadata(
            robot=self.arm.name,
            serial=experiment.serial,
            payload="none" if payload is None else payload.name,
            payload_mass=None if payload is None else payload.mass,
            experiment=experiment.name,
            uid=uid,
            parent_uid=parent_uid,
            motor_torque_source="krl_reals" if experiment.motor_torque.source == "krl_reals" else "none",
            software=software(),
            git_commit=git_commit(),
            utc_start=epoch.isoformat() if experiment.lock_step else None,
        )


@dataclass
class CommandMode:
    """A stay in command mode. stuck : why it was not left at its end, None if it was."""

    stuck: RobotError | None = None


@contextlib.contextmanager
def command_mode(driver: Driver, status: StatusLine) -> Iterator[CommandMode]:
    """Command mode, left at the end; a failure of that is in `stuck`, and said beside an exception under way."""
    driver.enter_command()
    stay = CommandMode()
    try:
        yield stay
    except BaseException:
        status.clear()
        _leave(driver, stay)
        if stay.stuck is not None:
            status.say(str(stay.stuck))
        raise
    status.clear()
    _leave(driver, stay)


def _leave(driver: Driver, stay: CommandMode) -> None:
    try:
        driver.leave_command()
    except LwrError as error:
        stay.stuck = RobotError(
            f"command mode was not left, the arm may be held with its drives on: {error}. Stop the KRL program at the "
            "pendant and switch the drives off before anybody goes near"
        )
        stay.stuck.rows = error.rows


def _with_stay(reason: str, stay: CommandMode) -> str:
    """A reason, and that command mode was not left."""
    return reason if stay.stuck is None else f"{reason}; {stay.stuck}"


class Run:
    """One run of an experiment into one folder.

    folder : of the logs; its finished sessions are not repeated.
    excite : planned exciting motion of a session at the controller's period [s].
    """

    def __init__(
        self,
        experiment: Experiment,
        folder: Path,
        bench: Bench,
        excite: Callable[[SessionPlan, float], Motion],
    ) -> None:
        self.experiment, self.folder, self.bench, self.excite = experiment, folder, bench, excite
        self._progress = ExperimentProgress.load(folder)
        self._mounted: Payload | None = None
        self._asked = False  # whether this process has had a payload mounted
        self._rest: Rest | None = None

    def followed_by(self, experiment: Experiment, excite: Callable[[SessionPlan, float], Motion]) -> Run:
        """A run of further sessions, from the present state of the arm and its payload."""
        run = Run(experiment, self.folder, self.bench, excite)
        run._mounted, run._asked, run._rest = self._mounted, self._asked, self._rest
        return run

    def sessions(self) -> list[Record]:
        """Run every unfinished session; returns the records of all, finished earlier or now.

        An aborted or failed session ends the sequence and has the last record.
        """
        records: list[Record] = []
        for plan in self.experiment.sessions:
            path = self.folder / f"{plan.name}.mcap"
            if plan.name in self._progress.finished and path.is_file():
                records.append(Record(plan.name, path, "success", "finished in an earlier run"))
                self._mounted, self._rest = plan.payload, self._progress.rest(plan.name, plan.payload)
                continue
            record = self._session(plan, path)
            records.append(record)
            if record.status != "success":
                break
        return records

    def _session(self, plan: SessionPlan, path: Path) -> Record:
        bench, driver = self.bench, self.bench.driver
        driver.wait_quality(cycles=bench.cycles(self.experiment.link.quality_s))
        self._swap(plan)
        driver.expect_load(*load_data(bench.arm, plan.payload))
        here = self._at_rest(plan.payload)
        motion, preflight = self._prepare(plan, here)
        start = driver.state()
        traced = self.experiment.motor_torque.source == "trace_file"
        if traced:
            bench.operator.start_trace()
        self._rest = None
        with (
            Interrupts(driver.request_stop, driver.drop_link),
            command_mode(driver, bench.status) as stay,
        ):
            if not np.array_equal(motion.q[0], driver.state().q_command):
                # The controller moved its set point at the start of command mode.
                motion, preflight = self._prepare(plan, here)
            uids = self._progress.begin(plan.name, path, self.experiment.session_uid(plan.name))
            driver.record(
                path,
                bench.metadata(self.experiment, plan.payload, *uids),
                self._attachments(motion, preflight),
            )
            outcome, held = self._still_loaded(plan, here, self._drive(plan, motion))
            recorded = driver.end_record(outcome.status, outcome.reason)
        link = LinkReport.between(start, driver.state())
        if recorded.error:
            reason = _with_stay(f"the log could not be written: {recorded.error}", stay)
            return Record(plan.name, path, "fail", reason, link)
        if traced:
            self._import_trace(path)
        warnings = self._torque_warnings(path, recorded.motor_rejected) if outcome.status == "success" else ()
        for warning in warnings:
            bench.status.say(warning)
        if outcome.status == "success":
            # An arm that stays in command mode was measured there; its session is whole all the same.
            self._rest = self._at_rest(plan.payload) if stay.stuck is None else held
            worst = 1000.0 * float(np.max(link.worst_tracking_error_rad))
            bench.status.say(
                f"{plan.name}: logged {recorded.samples} samples, {link.missed} cycles missed, tracking within "
                f"{worst:.1f} mrad"
            )
            self._progress.finish(plan.name, self._rest, recorded.samples)
            if stay.stuck is not None:
                # Nobody may be sent to an arm in command mode: the sequence ends here.
                return Record(plan.name, path, "fail", str(stay.stuck), link, stay.stuck, warnings)
        reason = _with_stay(outcome.reason, stay)
        return Record(plan.name, path, outcome.status, reason, link, outcome.error, warnings)

    def _still_loaded(self, plan: SessionPlan, before: Rest, outcome: Outcome) -> tuple[Outcome, Rest]:
        """The outcome, a failure if the payload changed during the motion, and the arm at rest after a success."""
        if outcome.status != "success":
            return outcome, before
        after = self._at_rest(plan.payload)
        check = check_payload(self.bench.arm, before, after)
        if check.ok:
            return outcome, after
        reason = f"the payload changed during the motion: {check.reason(self.bench.arm.joint_names)}"
        return dataclasses.replace(outcome, status="fail", reason=reason, error=RobotError(reason)), after

    def _torque_warnings(self, path: Path, rejected: int) -> tuple[str, ...]:
        """Warnings about motor torques of the wrong joint, size or sign, or not finite. The session stands anyway."""
        if self.experiment.motor_torque.source != "krl_reals":
            return ()
        dropped: tuple[str, ...] = ()
        if rejected:
            dropped = (
                f"{path.name}: {rejected} samples of the motor torques were not finite and are left out; check what "
                "the KRL program writes into the variables of `motor_torque.krl.reals`",
            )
        try:
            return dropped + self._mismatches(path)
        except (LwrError, ValueError, ArithmeticError) as error:
            return (*dropped, f"{path.name}: motor torques were not compared with the sensors: {error}")

    def _mismatches(self, path: Path) -> tuple[str, ...]:
        """Warnings about motor torques of the wrong joint, size or sign."""
        session = read_session(path)
        if session.motor is None or len(session.motor) < 2:
            return (
                f"{path.name} has no motor torques: the counter `counter_int` in the KRL variables stands "
                "still. It serves Model 1",
            )
        # At a resting joint only reactions of the other joints are visible.
        moves = np.ptp(session.joint.position, axis=0) > _LEAST_MOTION_RAD
        moving = {name for name, moved in zip(session.joint.names, moves, strict=True) if moved}
        return tuple(
            f"{path.name}: {match}; check `reals`, `scale` and `sign` of motor_torque.krl"
            for match in match_torques(session.joint, session.motor)
            if match.suspect and match.joint in moving
        )

    def _prepare(self, plan: SessionPlan, here: Rest) -> tuple[Motion, Preflight]:
        """The motion of a session from the present posture. RefusedError after a failed check."""
        bench, state = self.bench, self.bench.driver.state()
        rows = self.excite(plan, state.period_s)
        motion, preflight = session_motion(
            self.experiment, bench.arm, bench.cell, plan, rows, state.q_command, self.folder
        )
        preflight += (
            check_link(state),
            check_gravity(bench.arm, here),
            check_rights(bench.driver.rights or Rights(), needed=not self.experiment.lock_step),
        )
        preflight.enforce()
        return motion, preflight

    def _swap(self, plan: SessionPlan) -> None:
        """Have the payload of the session mounted, and check it by the torques at rest.

        What hung on the flange in an earlier run is no knowledge: the first session of every run asks.
        """
        bench, before = self.bench, self._rest
        if not self._asked or plan.payload != self._mounted or before is None:
            load = plan.payload
            name = "none" if load is None else f"{load.name}, {load.mass:g} kg"
            self._require_monitor_mode()
            bench.status.say(f"payload for session {plan.name}: {name}")
            bench.operator.swap(self._mounted, plan.payload)
            if bench.driver.sets_load:
                bench.status.say(set_load(bench.driver, bench.arm, plan.payload))
            self._mounted, self._asked = plan.payload, True
        if before is None:
            return
        after = self._at_rest(plan.payload)
        check = check_payload(bench.arm, before, after)
        if not check.ok:
            raise RefusedError(check.reason(bench.arm.joint_names))
        bench.status.say(check.summary())

    def _require_monitor_mode(self) -> None:
        """Raise RobotError while the arm is commanded: nobody may mount anything then."""
        state = self.bench.driver.state()
        if state.state == "CMD" or state.mode != "mirror":
            raise RobotError(
                f"payload swap: the arm is in state {state.state}, mode {state.mode}; it must be in monitor mode (MON, "
                "mirror). Stop the KRL program at the pendant, stay clear of the arm until then, and begin again"
            )

    def _at_rest(self, payload: Payload | None) -> Rest:
        measured = self.bench.driver.monitor(self.bench.cycles(_REST_S))
        return Rest(measured.q, measured.tau, payload)

    def _drive(self, plan: SessionPlan, motion: Motion) -> Outcome:
        """Execute the motion with the status line. The caller handles Ctrl-C."""

        def progress(now: MotionProgress) -> None:
            error = 1000 * float(np.max(now.state.tracking_error))
            self.bench.status.show(
                plan.name,
                now.row / max(now.rows, 1),
                f"missed {now.state.miss_counter}",
                f"tracking {error:.1f} mrad",
                f"{now.state.state} {now.state.quality}",
                f"{now.time_s:.1f} of {motion.duration_s:.1f} s",
                phase=now.phase.replace("_", " "),
            )

        if self.bench.onlooker is not None:
            self.bench.onlooker.begin(plan.name, plan.payload, motion)
        return self.bench.driver.execute(motion, progress)

    def _import_trace(self, path: Path) -> None:
        """Add the motor torques of the controller's trace, if present, to the log."""
        trace = path.with_suffix(".trace.csv")
        text = (
            f"{trace.name} is not there: {path.name} has no motor torques and serves Model 1; "
            f"`lwr-run attach {path} TRACE --force` adds them later"
        )
        if self.bench.operator.save_trace(trace):
            try:
                text = str(import_trace(path, trace))
            except LwrError as error:
                # The session is driven and logged; the trace can be added to it later.
                text = f"{error}. {path.name} has no motor torques; `lwr-run attach {path} TRACE --force` adds them"
        self.bench.status.say(text)

    def _named_files(self) -> dict[str, bytes]:
        """Arm and cell file, and the manifest of all files, for the log."""
        experiment, frozen = self.experiment, Frozen(self.folder)
        named = {"arm.yaml": experiment.arm, "cell.yaml": experiment.cell}
        files = {key: find(name, beside=experiment.folder).read_bytes() for key, name in named.items()}
        return files | ({"files.json": frozen.manifest} if frozen.there else {})

    def _attachments(self, motion: Motion, preflight: Preflight) -> dict[str, bytes]:
        return {
            "experiment.yaml": self.experiment.text.encode(),
            **self._named_files(),
            "robot.urdf": self.bench.arm.urdf.encode(),
            "plan.npz": attached_plan(motion),
            "preflight.json": preflight.to_json(),
        }
