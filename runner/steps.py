"""Small steps at the arm: record, hold, jog, home; each checked like an experiment, logged, and at its end over.

Nothing resumes by itself: after an abort or a fault the same step begins anew at the present pose.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from fri.errors import ConfigurationError, LwrError, OperatorError, RefusedError, RobotError
from lwr_driver.arm.collision import Clearance
from lwr_driver.arm.load import LoadInForce
from lwr_driver.driver import LinkState, MotionProgress, Outcome
from lwr_driver.motion import Motion, move_to
from lwr_driver.realtime import Rights
from lwr_driver.session import read_session
from lwr_driver.session.recording import Recorded
from runner.experiment import Bench, command_mode
from runner.experiment_file import Experiment, Payload
from runner.planning import attached_plan, checker, dwell
from runner.preflight import (
    Preflight,
    Rest,
    check_disk,
    check_gravity,
    check_link,
    check_motion_limits,
    check_path,
    check_rights,
    check_torque,
    load_data,
)
from runner.stopping import check_stops
from runner.terminal import Interrupts

Vector = npt.NDArray[np.float64]

LARGEST_JOG_DEG = 30.0
_REST_S = 0.5
_SLICE_S = 0.5
_ANCHOR_S = 0.5  # rest before and after a move
_LOG_S = 3600.0  # room for a recording without an end
# An arm guided by hand rests if it moves no more than this for so long.
_STILL_RAD, _STILL_S = 0.01, 1.0
_OTHER_POSE_RAD = 0.03


@dataclass(frozen=True)
class Step:
    """The end of a step: what was done, the log, positions before and after (7,) [rad], poses at rest, notes."""

    name: str
    done: str
    log: Path
    samples: int
    before: Vector
    after: Vector
    poses: tuple[Pose, ...] = ()
    notes: tuple[str, ...] = ()

    def __str__(self) -> str:
        return f"{self.done}; log: {self.log}"


@dataclass(frozen=True)
class Pose:
    """A pose at rest: name, time in the log [s], position (7,) [rad]."""

    name: str
    time_s: float
    q: Vector


@dataclass
class Steps:
    """Steps with a connected bench.

    payload : mounted on the flange, None for the empty flange
    empty : an empty flange is stated, not assumed; else load data of a payload in the controller are not replaced
    """

    experiment: Experiment
    bench: Bench
    payload: Payload | None = None
    empty: bool = False
    _mean: Rest = field(init=False, repr=False)
    _planned: Motion = field(init=False, repr=False)

    def record(self, path: Path, seconds: float | None) -> Step:
        """Log what the controller sends for `seconds`, or until Ctrl-C; nothing is commanded."""
        bench, driver = self.bench, self.bench.driver
        Preflight((check_disk(path.parent, self.bench.cycles(seconds or _LOG_S)),)).enforce()
        before = driver.state()
        driver.record(path, self._metadata("record"))
        with Interrupts(driver.request_stop, driver.drop_link):
            _, reason, error = self._wait("recording", seconds, lambda state: "")
        after = driver.state()
        recorded = self._end_record("success" if error is None else "fail", reason)
        bench.status.clear()
        if error is not None:
            raise _failure(error, path)
        poses = standstills(path)
        notes = tuple(note for pose in poses if (note := self._objection(pose)))
        seen = (
            f"recorded {recorded.samples * before.period_s:.1f} s in state {after.state}, nothing commanded"
        )
        if len(poses) > 1:
            seen += f", {len(poses)} poses at rest"
        return Step("record", seen, path, recorded.samples, before.q, after.q, poses, notes)

    def hold(self, path: Path, seconds: float) -> Step:
        """Enter command mode, hold the present pose for `seconds`, and leave it."""

        def holding(state: LinkState) -> Outcome | None:
            status, reason, error = self._wait("holding", seconds, _lost)
            rows = self.bench.driver.last_rows()
            if error is not None:
                return Outcome("fail", str(error), rows, -1, 0, error)
            return None if status == "success" else Outcome("abort", reason, rows, -1, 0)

        def still(state: LinkState) -> Motion:
            return dwell(state.q_command, 2 * state.period_s, state.period_s, "hold")

        return self._command("hold", path, still, holding, f"held the pose for {seconds:g} s in command mode")

    def jog(self, path: Path, joint: str, degrees: float, speed_scale: float) -> Step:
        """Move one joint by `degrees`. speed_scale : share of the velocity limits."""
        place = jogged(self.bench.arm.joint_names, joint, degrees)

        def goal(start: Vector) -> Vector:
            wanted = start.copy()
            wanted[place] += np.radians(degrees)
            return wanted

        return self._move("jog", path, goal, speed_scale, "moved")

    def home(self, path: Path, pose: Vector, speed_scale: float, name: str = "home") -> Step:
        """Move on a straight line in joint space to `pose`, (7,) [rad]."""
        return self._move("home", path, lambda start: pose, speed_scale, f"moved to {name}")

    # -- inside ----------------------------------------------------------------------------------------------

    def _move(
        self, name: str, path: Path, goal: Callable[[Vector], Vector], speed_scale: float, done: str
    ) -> Step:
        arm, driver = self.bench.arm, self.bench.driver

        def motion(state: LinkState) -> Motion:
            start, period = state.q_command, state.period_s
            way = move_to(arm, start, goal(start), period, speed_scale=speed_scale, phase=name)
            rest = dwell(start, _ANCHOR_S, period, "hold")
            return rest.join(way).join(dwell(way.q[-1], _ANCHOR_S, period, "settle"))

        def drive(state: LinkState) -> Outcome | None:
            outcome = driver.execute(self._planned, self._progress)
            return None if outcome.status == "success" else outcome

        return self._command(name, path, motion, drive, done)

    def _command(
        self,
        name: str,
        path: Path,
        plan: Callable[[LinkState], Motion],
        drive: Callable[[LinkState], Outcome | None],
        done: str,
    ) -> Step:
        """A step in command mode: checks, load data, command mode, log, and back to monitor mode."""
        bench, driver = self.bench, self.bench.driver
        driver.wait_quality(cycles=self.bench.cycles(self.experiment.link.quality_s))
        measured = driver.monitor(self.bench.cycles(_REST_S))
        self._mean = Rest(measured.q, measured.tau, self.payload)
        preflight = self._prepare(plan, path)
        load = load_data(bench.arm, self.payload)
        if driver.sets_load:
            self._keep_load(LoadInForce(*load[:2]))
            driver.set_load(*load)
        with (
            Interrupts(driver.request_stop, driver.drop_link),
            command_mode(driver, bench.status) as stay,
        ):
            if not np.array_equal(self._planned.q[0], driver.state().q_command):
                # The controller moved its set point at the start of command mode.
                preflight = self._prepare(plan, path)
            before = driver.state()
            driver.record(path, self._metadata(name), self._attachments(preflight))
            outcome = drive(before)
            after = driver.state()
            status, reason = ("success", "") if outcome is None else (outcome.status, outcome.reason)
            recorded = self._end_record(status, reason)
        if outcome is not None:
            if stay.stuck is not None:
                bench.status.say(str(stay.stuck))
            error = outcome.error if outcome.error is not None else OperatorError(outcome.reason)
            raise _failure(error, path)
        if stay.stuck is not None:
            raise _failure(stay.stuck, path)
        worst = 1000.0 * float(np.max(after.tracking_error))
        done = f"{done}{_moved(bench.arm.joint_names, before.q, after.q)}, tracking within {worst:.1f} mrad"
        return Step(name, done, path, recorded.samples, before.q, after.q)

    def _keep_load(self, wanted: LoadInForce) -> None:
        """Raise RefusedError before load data in the controller are replaced that nobody has spoken of."""
        force = self.bench.driver.load
        if self.payload is not None or self.empty or force is None or force.agrees(wanted):
            return
        raise RefusedError(
            f"load data in force in the controller: {force}; this step would replace them by {wanted}, and nobody has "
            "said that the flange is empty. State what is mounted: `--payload NAME`, or `--payload none` for the empty "
            "flange"
        )

    def _prepare(self, plan: Callable[[LinkState], Motion], path: Path) -> Preflight:
        """Plan the motion from the present set point and check it. RefusedError after a failed check."""
        bench, experiment = self.bench, self.experiment
        state = bench.driver.state()
        # In monitor mode the answer is the mirror, so this is the controller's own set point.
        motion = self._planned = plan(state)
        collision = checker(bench.arm, bench.cell, self.payload)
        margin = max(experiment.moves.clearance_m, bench.cell.margin_m)
        preflight = Preflight(
            (
                *check_motion_limits(bench.arm, motion),
                check_torque(bench.arm, motion, self.payload),
                check_path(collision, motion, margin),
                *check_stops(bench.arm, collision, motion, self.payload, margin),
                check_disk(path.parent, len(motion)),
                check_link(state),
                check_gravity(bench.arm, self._mean),
                check_rights(bench.driver.rights or Rights(), needed=not bench.driver.link.lock_step),
            )
        )
        preflight.enforce()
        return preflight

    def _wait(
        self, what: str, seconds: float | None, objection: Callable[[LinkState], str]
    ) -> tuple[str, str, LwrError | None]:
        """Let cycles pass; status, reason and error of the end. objection : to the state, ends the step."""
        driver, status = self.bench.driver, self.bench.status
        wanted = None if seconds is None else self.bench.cycles(seconds)
        cycles, slice_ = 0, self.bench.cycles(_SLICE_S)
        began = time.monotonic()
        while wanted is None or cycles < wanted:
            try:
                now = slice_ if wanted is None else min(slice_, wanted - cycles)
                driver.monitor(now)
            except OperatorError as error:
                return "abort", str(error), None
            except LwrError as error:
                return "fail", str(error), error
            cycles += now
            state = driver.state()
            if reason := objection(state):
                return "fail", reason, RobotError(reason)
            passed = cycles * state.period_s if seconds is not None else time.monotonic() - began
            positions = " ".join(f"{degrees:.1f}" for degrees in np.degrees(state.q))
            share = None if wanted is None else cycles / wanted
            end = () if seconds is not None else ("Ctrl-C ends it",)
            details = (f"{passed:.0f} s", *end, f"{state.state} {state.quality}", f"[{positions}] deg")
            status.show(what, share, *details)
        return "success", "", None

    def _progress(self, now: MotionProgress) -> None:
        error = 1000.0 * float(np.max(now.state.tracking_error))
        self.bench.status.show(
            now.phase.replace("_", " "),
            now.row / max(now.rows, 1),
            f"tracking {error:.1f} mrad",
            now.state.quality,
            f"{now.time_s:.1f} s",
        )

    def _end_record(self, status: Any, reason: str) -> Recorded:
        recorded = self.bench.driver.end_record(status, reason)
        if recorded.error:
            raise RobotError(f"the log could not be written: {recorded.error}")
        return recorded

    def _objection(self, pose: Pose) -> str:
        """Why a pose cannot be a home pose, empty if it can."""
        arm = self.bench.arm
        outside = np.maximum(arm.limits.q_low - pose.q, pose.q - arm.limits.q_high)
        joint = int(np.argmax(outside))
        if outside[joint] > 0.0:
            return (
                f"{pose.name}: {arm.joint_names[joint]} at {pose.q[joint]:.4f} rad is outside "
                f"{arm.limits.q_low[joint]:.4f} to {arm.limits.q_high[joint]:.4f} rad; no home pose"
            )
        margin = max(self.experiment.moves.clearance_m, self.bench.cell.margin_m)
        nearest: Clearance = checker(arm, self.bench.cell, self.payload).clearance(pose.q)
        if nearest.distance < margin:
            return (
                f"{pose.name}: {' to '.join(nearest.pair)} {1000 * nearest.distance:.0f} mm, limit "
                f"{1000 * margin:.0f} mm; no home pose"
            )
        return ""

    def _metadata(self, name: str) -> dict[str, str]:
        uid = f"{self.experiment.uid}-{name}-{datetime.now(UTC):%Y%m%d%H%M%S%f}"
        return self.bench.metadata(self.experiment, self.payload, uid)

    def _attachments(self, preflight: Preflight) -> dict[str, bytes]:
        return {
            "experiment.yaml": self.experiment.text.encode(),
            "robot.urdf": self.bench.arm.urdf.encode(),
            "plan.npz": attached_plan(self._planned),
            "preflight.json": preflight.to_json(),
        }


def jogged(names: tuple[str, ...], joint: str, degrees: float) -> int:
    """Place of the joint of a jog. ConfigurationError for an unknown joint or an angle too large."""
    known = {name.lower(): place for place, name in enumerate(names)}
    if joint.lower() not in known:
        raise ConfigurationError(f"joint {joint!r} is unknown; choose one of {', '.join(names)}")
    if not 0.0 < abs(degrees) <= LARGEST_JOG_DEG:
        raise ConfigurationError(
            f"jog of {degrees:g} degrees; it must not be 0 and at most {LARGEST_JOG_DEG:g}. Go further in several "
            "jogs, or with `lwr-run home`"
        )
    return known[joint.lower()]


def standstills(log: Path) -> tuple[Pose, ...]:
    """Poses in which the arm rested in a log, in order; one is listed again only after another one."""
    session = read_session(log)
    joint = session.joint
    if len(joint) < 2:
        return ()
    seconds = 1e-9 * (joint.log_time - joint.log_time[0])
    found: list[Pose] = []
    first = 0
    while first < len(joint):
        last = int(np.searchsorted(seconds, seconds[first] + _STILL_S))
        if last >= len(joint):
            break
        window = joint.position[first : last + 1]
        if np.max(np.ptp(window, axis=0)) > _STILL_RAD:
            first += max(1, (last - first) // 10)
            continue
        # As long as the arm stays there.
        away = np.abs(joint.position[last:] - window.mean(axis=0)).max(axis=1) > _STILL_RAD
        end = last + int(np.argmax(away)) if away.any() else len(joint)
        q = joint.position[first:end].mean(axis=0)
        if not found or float(np.max(np.abs(q - found[-1].q))) > _OTHER_POSE_RAD:
            found.append(Pose(f"pose_{len(found) + 1}", float(seconds[first]), q))
        first = max(end, first + 1)
    return tuple(found)


def _lost(state: LinkState) -> str:
    return "" if state.mode == "hold" else f"command mode ended: {state.left or state.summary}"


def _moved(names: tuple[str, ...], before: Vector, after: Vector) -> str:
    """The joints that moved, in degrees."""
    gone = np.degrees(after - before)
    told = [f"{name} {gone[k]:+.2f}°" for k, name in enumerate(names) if abs(gone[k]) >= 0.01]
    return f" by {', '.join(told)}" if told else ""


def _failure(error: LwrError, path: Path) -> LwrError:
    """The error, with its meaning for the next attempt and the place of the log."""
    text = f"{error}. Nothing resumes by itself; the same command begins at the present pose. Log: {path}"
    failed = type(error)(text)
    failed.rows = error.rows
    return failed
