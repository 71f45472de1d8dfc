"""The driver: the connection to the arm, on top of a real-time process and a recorder process.

::

    with Driver(Arm.load(), LinkSettings(address="192.168.0.100")) as driver:
        driver.connect()
        driver.wait_quality()
        motion = move_to(arm, driver.state().setpoint, goal, driver.state().period_s)
        driver.record(Path("session.mcap"), session_metadata(robot="LWR4+"))
        driver.enter_command()
        outcome = driver.execute(motion)
        driver.leave_command()
        driver.end_record(outcome.status, outcome.reason)
        outcome.check()

A motion is never resumed after its end.
"""

from __future__ import annotations

import contextlib
import logging
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fri.errors import ConfigurationError, LwrError, NetworkError, OperatorError, RefusedError, RobotError
from fri.handshake import IdentificationHandshake, find_handshake
from fri.states import Quality
from lwr_driver.arm import Arm
from lwr_driver.arm.description import enforce_ceilings
from lwr_driver.arm.load import LoadInForce, check_load
from lwr_driver.commander import BRAKE, CONTACT, HOLD, RETREAT
from lwr_driver.configuration import as_path, expect
from lwr_driver.contact import ContactSettings, ExpectedArm
from lwr_driver.control import BIN_NS, Control, Job, Mode, Result, Text, Word
from lwr_driver.guard import sound_factor
from lwr_driver.hosted_loop import HostedLoop, LoopHost
from lwr_driver.link import (
    LinkSettings,
    LinkState,
    Measured,
    MotionProgress,
    Outcome,
    Waiting,
    advise_command,
    advise_connect,
    advise_leave,
    advise_load,
    advise_monitor,
    advise_quality,
    advise_rest,
    silence_in_lock_step,
    snapshot,
)
from lwr_driver.loop import LoopSettings
from lwr_driver.loop_process import LoopProcess, Scheduling
from lwr_driver.motion import Motion, check_motion, check_start
from lwr_driver.realtime import Rights, undisturbed
from lwr_driver.recorder import Recorded, Recorder, SessionRequest
from lwr_driver.ring import Ring
from lwr_driver.session.motor_torque import KrlMotorTorque
from lwr_driver.session.writer import ExitStatus

log = logging.getLogger(__name__)

LOCK_STEP_EPOCH_NS = 1_577_836_800 * 10**9
"""Log time of packet 0 in lock step: the first of January 2020."""

ROWS_KEPT = 50
"""Cycles attached to an error or an outcome."""

_POLL_S, _MOTION_POLL_S = 0.002, 0.005
_NOTIFY_S = 0.5
_PROGRESS_S = 0.1
_SHORTEST_CYCLE_S = 1e-3
_CLOSE_PATIENCE_S = 2.0
_LONGEST_LOOK_S = 0.1
_ERRORS: Mapping[Result, type[LwrError]] = {
    Result.REFUSED: RefusedError,
    Result.ROBOT: RobotError,
    Result.NETWORK: NetworkError,
    Result.GUARD: RefusedError,
}
_PHASES = {HOLD: "hold", BRAKE: "brake", CONTACT: "contact", RETREAT: "retreat"}
_POOR = (Quality.UNACCEPTABLE.name, Quality.BAD.name)


class Driver:
    """Connection to one arm. A context manager: leaving it always stops the arm and ends both processes.

    arm : limits for the guard of every cycle; out of lock step none beyond those of the LWR4+, joint by joint along the
        chain, whatever its file calls arm and joints (ConfigurationError)
    link : settings of the connection
    notify : called with a Waiting about twice a second while a step waits
    motor_torque : places of the motor torques in the KRL variables; None records none
    contact : limits of torque and contact; expected : the arm of the own estimate, None for the nominal one
    host : in lock step, the emulator's process that takes the loop in; None starts a process for it

    A waiting step raises OperatorError after `request_stop` or `drop_link`, NetworkError if the link or a
    process is gone, RobotError if the controller does not follow a request. Errors carry the last cycles as
    `.rows`.
    """

    def __init__(
        self,
        arm: Arm,
        link: LinkSettings,
        *,
        notify: Callable[[Waiting], None] | None = None,
        motor_torque: KrlMotorTorque | None = None,
        contact: ContactSettings | None = None,
        expected: ExpectedArm | None = None,
        host: LoopHost | None = None,
    ) -> None:
        expect(arm, Arm, "arm of the driver", "give `Arm.load()`")
        expect(link, LinkSettings, "link of the driver", 'give `LinkSettings(address="192.168.0.100")`')
        if not link.lock_step:
            # FRI 1.0 reaches the LWR4+ alone, whatever an arm file calls it.
            enforce_ceilings(arm)
        self.arm, self.link, self.motor_torque = arm, link, motor_torque
        self.contact = ContactSettings() if contact is None else contact
        self._expected, self._host = expected, host
        self.rights: Rights | None = None
        self._notify = notify
        self._control: Control | None = None
        self._ring: Ring | None = None
        self._loop: LoopProcess | HostedLoop | None = None
        self._recorder: Recorder | None = None
        self._recording = False
        self._announced: LoadInForce | None = None
        self._restarts = 0  # of the controller, before the session being recorded
        self._stops_seen = 0
        self._notes_seen = 0

    def __repr__(self) -> str:
        link, seen = self.link, "not connected" if self._loop is None else self.state().summary
        return f"Driver of {self.arm.name}\n  link   {link.address}:{link.port}, {link.handshake}\n  state  {seen}"

    def __enter__(self) -> Driver:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    # -- lifecycle -------------------------------------------------------------------------------------------

    def connect(self, *, timeout_s: float = 60.0) -> LinkState:
        """Start loop and recorder and wait for the first packet; on failure both are ended again."""
        if self._loop is not None:
            return self.state()
        link = self.link
        try:
            with undisturbed():
                self._control = Control.create(round(link.longest_motion_s / _SHORTEST_CYCLE_S))
                self._ring = Ring.create()
                self._recorder = Recorder(self._ring, heartbeat_timeout_s=None if link.lock_step else 2.0)
            settings = LoopSettings(
                address=link.address,
                port=link.port,
                controller=link.controller,
                lock_step=link.lock_step,
                handshake=link.handshake,
                link_timeout_s=link.link_timeout_s,
                tracking_limit_rad=link.tracking_limit_rad,
                joint_names=self.arm.joint_names,
                torque_sign=tuple(self.arm.torque_sign.tolist()),
            )
            scheduling = Scheduling(
                apply=not link.lock_step,
                required=not link.lock_step and link.realtime == "require",
                priority=link.priority,
                cpu=link.cpu,
            )
            expected = ExpectedArm.nominal(self.arm) if self._expected is None else self._expected
            limits = ContactSettings(self.contact.torque_share, self.contact.external_nm)
            watch = (expected, limits, self.arm.tau_max)
            parts = settings, self.arm.limits, self._control, self._ring
            if self._host is not None:
                self._loop = HostedLoop(self._host, *parts, watch)
            else:
                self._loop = LoopProcess(*parts, scheduling, watch)
            self.rights = self._loop.rights
            for shortage in (*self.rights.missing, *self.rights.advice):
                log.warning("%s", shortage)
            awaited = f"the first packet on UDP {link.address}:{self._loop.port}"
            self._wait(Job.CYCLES, awaited, advise_connect, timeout_s, a=1, failure=NetworkError)
        except BaseException:
            self.close()
            raise
        return self.state()

    @property
    def port(self) -> int:
        """UDP port of the loop."""
        return self._need(self._loop).port

    @property
    def ring_name(self) -> str:
        """Name of the shared memory with every cycle, for observers (`Ring.attach`, `Ring.peek`)."""
        return str(self._need(self._ring).name)

    def close(self) -> None:
        """Stop, leave command mode, end the session and both processes. Safe at any time and repeatedly."""
        with undisturbed():
            self._close()

    def _close(self) -> None:
        if self._loop is not None:
            with contextlib.suppress(LwrError):
                self._come_to_rest()
            self._loop.stop()
            self._loop = None
        if self._recorder is not None:
            if self._recording:
                with contextlib.suppress(LwrError):
                    self._recorder.close("fail", "the driver was closed before the session ended")
                self._recording = False
            self._recorder.stop()
            self._recorder = None
        if self._ring is not None:
            self._ring.unlink()
            self._ring = None
        if self._control is not None:
            self._control.close()
            self._control = None

    def _come_to_rest(self) -> None:
        words = self._need(self._control).words
        if words[Word.DROP] or Mode(int(words[Word.MODE])) not in (Mode.HOLD, Mode.MOTION, Mode.STOP):
            return
        for job in (Job.HALT, Job.LEAVE):
            self._wait_for_rest(job, patience_s=_CLOSE_PATIENCE_S)

    def _wait_for_rest(
        self, job: Job, timeout_s: float = _CLOSE_PATIENCE_S, patience_s: float | None = None
    ) -> None:
        self._wait(job, "rest", advise_rest, timeout_s, stoppable=False, patience_s=patience_s)

    # -- steps -----------------------------------------------------------------------------------------------

    def wait_quality(self, quality: str = "OK", *, cycles: int = 100, timeout_s: float = 60.0) -> LinkState:
        """Wait until the controller rates the link `quality` or better for `cycles` successive cycles."""
        try:
            least = Quality[quality.upper()]
        except KeyError:
            known = ", ".join(item.name for item in Quality)
            raise ConfigurationError(f"quality {quality!r} is unknown; choose one of {known}") from None
        awaited = f"quality {least.name} for {cycles} cycles"
        self._wait(
            Job.QUALITY, awaited, advise_quality, timeout_s, a=cycles, b=int(least), failure=NetworkError
        )
        return self.state()

    @property
    def sets_load(self) -> bool:
        """Whether the KRL program accepts load data over the link, see `set_load`."""
        return isinstance(find_handshake(self.link.handshake), IdentificationHandshake)

    def set_load(
        self,
        mass: float,
        com: tuple[float, float, float] = (0.0, 0.0, 0.0),
        inertia: tuple[float, float, float] = (0.0, 0.0, 0.0),
        *,
        timeout_s: float = 10.0,
    ) -> LinkState:
        """Set load data for the gravity compensation of the controller; in monitor mode.

        mass : [kg]; com : centre of mass in the flange frame [m]
        inertia : JX JY JZ about it, along the axes of the flange frame [kg m2]

        Raises ConfigurationError if the KRL program accepts none, or no payload can have them.
        """
        check_load(mass, com, inertia)
        if not self.sets_load:
            raise ConfigurationError(
                f"KRL program {self.link.handshake!r} takes no load data; enter them at the pendant, or use "
                f"{IdentificationHandshake.name}"
            )
        control, mode = self._need(self._control), self.state().mode
        if mode != "mirror":
            raise RobotError(f"load data cannot change in mode {mode}; leave command mode first")
        control.plan[0] = (mass, *(1000.0 * value for value in com), *inertia)
        self._wait(Job.LOAD, f"load data of {mass:g} kg in force", advise_load, timeout_s)
        self._announced = LoadInForce(mass, com)
        return self.state()

    @property
    def load(self) -> LoadInForce | None:
        """Load data in force in the controller by the last packet; None where the KRL program tells none."""
        handshake, rows = find_handshake(self.link.handshake), self.last_rows(1)
        if not isinstance(handshake, IdentificationHandshake) or not len(rows):
            return None
        mass, x, y, z = handshake.load(rows[-1]["msr"]).tolist()
        return LoadInForce(mass, (1e-3 * x, 1e-3 * y, 1e-3 * z))

    def expect_load(
        self,
        mass: float,
        com: tuple[float, float, float] = (0.0, 0.0, 0.0),
        inertia: tuple[float, float, float] = (0.0, 0.0, 0.0),
    ) -> None:
        """Expect this payload in the own estimate of the external torque, at the latest when the arm rests next.

        Arguments as of `set_load`. Without a call the weight of the payload is taken from the controller's gravity
        torque, its load data; the inertia is then unknown. `enter_command` refuses other load data in the controller,
        where the KRL program tells them.
        """
        control = self._need(self._control)
        self._announced = LoadInForce(mass, com)
        control.load[:] = (mass, *com, *inertia)
        control.words[Word.LOAD] += 1

    def enter_command(self, *, timeout_s: float = 120.0) -> LinkState:
        """Ask the KRL program to start commanding; wait for command mode, drives on and no error.

        From then on the arm holds where the controller has it. Raises RefusedError, also if it shows on the way, if
        the load data in force differ from those of `expect_load` or `set_load`: the arm would sag or rise.
        """
        self._check_load()
        try:
            self._wait(Job.START, "command mode with drives on", advise_command, timeout_s)
            self._check_load()
        except BaseException:
            # The request must not be granted later, with nobody waiting for it.
            if self._loop is not None:
                with contextlib.suppress(LwrError):
                    self._wait_for_rest(Job.LEAVE)
            raise
        return self.state()

    def execute(self, motion: Motion, progress: Callable[[MotionProgress], None] | None = None) -> Outcome:
        """Command a motion from its first row to its last, then hold the last row.

        The first row must be the commanded position, `state().q_command`, to the last bit of float32.
        `progress` is called about ten times a second; an exception from it stops the arm and is passed on, and so does
        one that takes longer than a second out of lock step: an arm does not move on while nobody could stop it.

        Raises RefusedError, before anything moves, if the motion breaks a limit or begins elsewhere, and
        RobotError outside command mode. Failures after the beginning are in the outcome, not raised.
        """
        expect(motion, Motion, "motion to execute", "give a `Motion`, such as from `move_to`")
        control, state = self._need(self._control), self.state()
        if int(control.words[Word.STOP]) != self._stops_seen:
            self._stops_seen = int(control.words[Word.STOP])
            return Outcome(
                "abort", "stop requested before the motion began", self.last_rows(), -1, len(motion)
            )
        self._check_executable(motion, state)
        control.put_motion(motion.q, self._number_phases(motion))
        control.words[Word.BEAT_NS] = time.monotonic_ns()
        self._need(self._control).post(Job.MOTION, a=len(motion), b=self._stops_seen)
        names = dict(zip(control.phase_ids.tolist(), (name for _, name in motion.phases), strict=False))
        trouble: LwrError | None = None
        following = time.monotonic()
        watch, poor = _Watch(self), False
        try:
            while not self._need(self._control).done:
                time.sleep(_MOTION_POLL_S)
                control.words[Word.BEAT_NS] = time.monotonic_ns()
                watch.check(self.link.lock_step_patience_s)
                if time.monotonic() < following:
                    continue
                following = time.monotonic() + _PROGRESS_S
                if trouble is None:
                    trouble = self._recorder_trouble()
                if not poor and (poor := self.state().quality in _POOR):
                    log.warning("the controller rates the link %s in command mode", self.state().quality)
                if progress is not None:
                    row = max(int(control.words[Word.ROW]), 0)
                    phase = self._phase_name(names)
                    progress(MotionProgress(row, len(motion), row * motion.period_s, phase, self.state()))
        except BaseException as error:
            self._give_up(error)
            if isinstance(error, LwrError) and error is watch.error:
                return self._failed(motion, error)
            raise
        return self._outcome(motion, trouble)

    def monitor(self, cycles: int) -> Measured:
        """Means over `cycles` cycles, in monitor mode or while holding in command mode."""
        if cycles < 1:
            raise ConfigurationError(f"mean over {cycles} cycles; take one at least")
        limit_s = max(10.0, 20.0 * cycles * self.state().period_s)
        self._wait(Job.CYCLES, f"{cycles} cycles", advise_monitor, limit_s, a=cycles, failure=NetworkError)
        q, q_std, tau, tau_std, external, command = self._need(self._control).measured.copy()
        return Measured(cycles, q, q_std, tau, tau_std, external, command)

    def stop(self) -> LinkState:
        """Stop within the limits and wait until the commanded position rests."""
        self._wait_for_rest(Job.HALT, 10.0)
        words = self._need(self._control).words
        self._stops_seen = int(words[Word.STOP])
        return self.state()

    def request_stop(self) -> None:
        """Ask for a jerk-limited stop and return at once; from any thread or signal handler.

        It holds until a step notices it: a motion is stopped or does not begin, a waiting step raises
        OperatorError.
        """
        if self._control is not None:
            self._control.words[Word.STOP] += 1

    def drop_link(self) -> None:
        """Stop answering for good: the controller brakes by itself. From any thread or signal handler."""
        if self._control is not None:
            self._control.words[Word.DROP] = 1

    def leave_command(self, *, timeout_s: float = 30.0) -> LinkState:
        """Ask the KRL program to stop commanding and wait for monitor mode; no effect after `drop_link`."""
        if Mode(int(self._need(self._control).words[Word.MODE])) is Mode.SILENT:
            return self.state()
        self._wait(Job.LEAVE, "monitor mode", advise_leave, timeout_s, stoppable=False)
        return self.state()

    def state(self) -> LinkState:
        """Snapshot of the link at this moment; never waits."""
        control, ring = self._need(self._control), self._need(self._ring)
        return snapshot(control, time.monotonic_ns(), ring.overruns)

    def last_rows(self, count: int = ROWS_KEPT) -> NDArray[Any]:
        """Copy of the last cycles, at most `count` and 64, oldest first, dtype `lwr_driver.ring.ROW`."""
        rows: NDArray[Any] = self._need(self._control).last_rows(count)
        return rows

    def latency_histogram(self) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        """Reply latencies since `connect`: upper edges of the bins [s] and counts; the last bin is open."""
        counts = self._need(self._control).latency.copy()
        edges = np.arange(1, len(counts) + 1, dtype=np.float64) * (BIN_NS * 1e-9)
        return edges, counts

    # -- recording -------------------------------------------------------------------------------------------

    def record(
        self, path: Path, metadata: Mapping[str, str], attachments: Mapping[str, bytes] | None = None
    ) -> None:
        """Begin a session log at `path` with the next cycle; `metadata` from `session_metadata`."""
        path = as_path(path, "session log")
        self._need(self._recorder).open(
            SessionRequest(
                path=path,
                joint_names=self.arm.joint_names,
                metadata=dict(metadata),
                robot_description=self.arm.urdf,
                attachments=dict(attachments or {}),
                phase_names=tuple(_PHASES[number] for number in sorted(_PHASES)),
                motor_torque=self.motor_torque,
                virtual_epoch_ns=LOCK_STEP_EPOCH_NS if self.link.lock_step else None,
            )
        )
        self._restarts = int(self._need(self._control).words[Word.RESTARTS])
        self._recording = True

    def end_record(self, status: ExitStatus, reason: str = "") -> Recorded:
        """Write everything received so far, then the closing record."""
        self._recording = False
        restarts = int(self._need(self._control).words[Word.RESTARTS]) - self._restarts
        return self._need(self._recorder).close(status, reason, restarts=restarts)

    # -- inside ----------------------------------------------------------------------------------------------

    def _need(self, part: Any) -> Any:
        if part is None:
            raise NetworkError("the driver is not connected; call `connect` first")
        return part

    def _wait(
        self,
        job: Job,
        awaited: str,
        advice: Callable[[LinkState], str],
        timeout_s: float,
        *,
        a: int = 0,
        b: int = 0,
        failure: type[LwrError] = RobotError,
        stoppable: bool = True,
        patience_s: float | None = None,
    ) -> None:
        """Post a job and wait for its end; an error names the aim, the present state and the remedy.

        The time limit counts cycles as soon as there are any, so it has the same meaning in lock step.
        """
        state = self.state()
        limit = round(timeout_s / state.period_s) if state.period_s > 0.0 else 0
        self._need(self._control).post(job, a, b, limit)
        began = notified = time.monotonic()
        patience = self.link.lock_step_patience_s if patience_s is None else patience_s
        watch = _Watch(self)
        while not self._need(self._control).done:
            time.sleep(_POLL_S)
            if state.sequence >= 0:
                watch.check(patience)
            elif self._loop is not None:
                self._loop.check()
            if self._need(self._control).words[Word.DROP]:
                raise self._with_rows(OperatorError(f"link dropped on request, waiting for {awaited}"))
            if stoppable:
                self._obey(awaited)
            now = time.monotonic()
            if now - notified >= _NOTIFY_S:
                notified = now
                self._report_notes()
                if self._notify is not None:
                    self._notify(self._waiting(awaited, now - began, advice))
            wall = timeout_s if state.sequence < 0 or not self.link.lock_step else np.inf
            if now - began > wall:
                raise self._with_rows(failure(str(self._waiting(awaited, now - began, advice))))
        self._report_notes()
        result = self._need(self._control).result
        if result is Result.DONE:
            return
        if result is Result.TIMEOUT:
            raise self._with_rows(failure(str(self._waiting(awaited, timeout_s, advice))))
        reason = self._need(self._control).text(Text.REASON)
        if result is Result.ABORTED:
            raise self._with_rows(OperatorError(reason))
        raise self._with_rows(_ERRORS.get(result, failure)(f"{awaited}: {reason}"))

    def _waiting(self, awaited: str, since_s: float, advice: Callable[[LinkState], str]) -> Waiting:
        state = self.state()
        return Waiting(awaited, state.summary, since_s, advice(state))

    def _obey(self, awaited: str) -> None:
        stops = int(self._need(self._control).words[Word.STOP])
        if stops != self._stops_seen:
            self._stops_seen = stops
            raise self._with_rows(OperatorError(f"stop requested while waiting for {awaited}"))

    def _check_load(self) -> None:
        """Raise RefusedError if the controller compensates another load than the announced one."""
        announced, force = self._announced, self.load
        if announced is None or force is None or force.agrees(announced):
            return
        raise self._with_rows(
            RefusedError(
                f"load data in force in the controller: {force}, announced: {announced}; the arm would sag or rise. "
                "They were changed at the pendant, or the KRL program was started again: look at the tool's load data "
                "there, and begin again, which sends the announced ones"
            )
        )

    def _check_executable(self, motion: Motion, state: LinkState) -> None:
        if state.mode != "hold" or state.left:
            left = f" {state.left}." if state.left else ""
            where = "not in command mode" if state.mode != "hold" else "no motion yet"
            raise self._with_rows(RobotError(f"{where} ({state.summary}).{left} Call `enter_command` first"))
        if state.quality in _POOR:
            raise self._with_rows(
                NetworkError(f"the controller rates the link {state.quality}; `wait_quality` before a motion")
            )
        if abs(motion.period_s - state.period_s) > 1e-9:
            raise ConfigurationError(
                f"motion has a period of {motion.period_s} s, the controller's cycle is {state.period_s} s; "
                "plan with the controller's"
            )
        check_motion(self.arm, motion)
        check_start(self.arm, motion, state.q_command)
        if not sound_factor(state.safety_limits):
            raise RefusedError(
                f"safety_limits in the controller's packets is {state.safety_limits:g}, it must be above 0 and finite: "
                "no speed is safe with it. Start the KRL program again, and look at the argument of its friStart"
            )
        if state.safety_limits < 1.0:
            speed = np.abs(np.diff(motion.q, axis=0)).max(axis=0, initial=0.0) / motion.period_s
            share = speed / self.arm.v_max
            joint = int(share.argmax())
            if share[joint] > state.safety_limits:
                raise RefusedError(
                    f"{self.arm.joint_names[joint]} velocity {speed[joint]:.4g} rad/s is {share[joint]:.2f} "
                    f"of the limit, the controller allows {state.safety_limits:.2f} (friStart); slow down"
                )

    def _number_phases(self, motion: Motion) -> list[tuple[int, int]]:
        names = tuple(name for _, name in motion.phases)
        first = len(_PHASES)
        if self._recording and names:
            first = self._need(self._recorder).add_phases(names)
        return [(row, first + place) for place, (row, _) in enumerate(motion.phases)]

    def _phase_name(self, names: Mapping[int, str]) -> str:
        rows = self.last_rows(1)
        number = int(rows[0]["phase"]) if len(rows) else -1
        return _PHASES.get(number) or names.get(number, "")

    def _recorder_trouble(self) -> LwrError | None:
        """A failure of the recording; it stops the motion, useless without data."""
        if not self._recording:
            return None
        try:
            self._need(self._recorder).check()
        except LwrError as error:
            self.request_stop()
            return error
        return None

    def _give_up(self, error: BaseException) -> None:
        """Stop a moving arm before an exception is passed on."""
        log.info("motion given up: %s", error)
        with contextlib.suppress(LwrError):
            self._wait_for_rest(Job.HALT, patience_s=1.0)

    def _failed(self, motion: Motion, error: LwrError) -> Outcome:
        row = int(self._need(self._control).words[Word.ROW])
        return Outcome("fail", str(error), self.last_rows(), row, len(motion), self._with_rows(error))

    def _outcome(self, motion: Motion, trouble: LwrError | None) -> Outcome:
        control = self._need(self._control)
        result = control.result
        reason = control.text(Text.REASON)
        rows, row = self.last_rows(), int(control.words[Word.ROW])
        self._report_notes()
        if result is Result.ABORTED:
            self._stops_seen = int(control.words[Word.STOP])
        if trouble is not None:
            return self._failed(motion, trouble)
        if result is Result.DONE:
            return Outcome("success", "", rows, row, len(motion))
        if result is Result.ABORTED:
            return Outcome("abort", reason, rows, row, len(motion))
        return self._failed(motion, _ERRORS.get(result, RobotError)(reason))

    def _with_rows(self, error: LwrError) -> LwrError:
        if self._control is not None:
            error.rows = self.last_rows()
        return error

    def _report_notes(self) -> None:
        control = self._need(self._control)
        if int(control.words[Word.NOTES]) != self._notes_seen:
            self._notes_seen = int(control.words[Word.NOTES])
            note = control.text(Text.NOTE)
            log.log(logging.INFO if note.startswith("locked") else logging.WARNING, "link %s", note)


class _Watch:
    """Notices the end of the loop process and, in lock step, of the other side."""

    def __init__(self, driver: Driver) -> None:
        self._driver = driver
        self._cycles = -1
        self._silence_s = 0.0
        self._looked = time.monotonic()
        self.error: LwrError | None = None

    def check(self, patience_s: float) -> None:
        driver = self._driver
        try:
            driver._need(driver._loop).check()
        except LwrError as error:
            self.error = error
            raise
        if not driver.link.lock_step:
            return
        cycles = int(driver._need(driver._control).words[Word.CYCLES])
        now = time.monotonic()
        # A pause of this process is no silence of the others: they may have paused as well.
        self._silence_s += min(now - self._looked, _LONGEST_LOOK_S)
        self._looked = now
        if cycles != self._cycles:
            self._cycles, self._silence_s = cycles, 0.0
        elif self._silence_s > patience_s:
            self.error = NetworkError(silence_in_lock_step(driver.state(), self._silence_s))
            raise self.error
