"""The driver and its processes against the emulator in lock step: what a lab goes through in a session."""

from __future__ import annotations

import dataclasses
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from fri.errors import ConfigurationError, DataError, NetworkError, OperatorError, RefusedError, RobotError
from lwr_driver.driver import Driver, LinkSettings, Outcome
from lwr_driver.motion import Motion, move_to
from lwr_driver.session import read_session
from lwr_driver.session.motor_torque import KrlMotorTorque
from lwr_driver.session.writer import session_metadata
from runner.laboratory import free_port
from sim_backend.process import EmulatorProcess
from tests.lwr_driver.driver_rig import arm

HOP = np.array([0.3, -0.2, 0.3, 0.4, -0.5, 0.2, 0.6])


@pytest.fixture(scope="module")
def laboratories():
    """The laboratory that tests share until one of them spoils it."""
    kept: list[Lab] = []
    yield kept
    for each in kept:
        each.close()


@pytest.fixture
def lab(laboratories):
    """An emulator and a driver connected to it, out of command mode, with nothing left of the test before."""
    if not laboratories:
        laboratories.append(Lab())
    yield laboratories[0]
    if not laboratories[0].reset():
        laboratories.pop().close()


class Lab:
    def __init__(self) -> None:
        self.spoiled = False
        self.emulator = EmulatorProcess(lock_step=True, fri_port=free_port("127.0.0.1"))
        self.emulator.start()
        self.driver = Driver(arm(), _settings(self.emulator.fri_port), motor_torque=KrlMotorTorque())
        self.driver.connect()

    def close(self) -> None:
        self.driver.close()
        self.emulator.stop()

    def reset(self) -> bool:
        """Whether the next test can use this laboratory too."""
        if self.spoiled:
            return False
        pendant = self.emulator.pendant
        pendant.clear_faults()
        self.driver.stop()
        self.driver.leave_command()
        pendant.drives(on=True)
        pendant.reset_monitor()
        return True

    def hop(self, speed_scale: float = 1.0) -> Motion:
        """A motion from where the arm is: away, and back if it is away already."""
        state = self.driver.state()
        goal = state.setpoint + (HOP if state.setpoint[6] < 0.3 else -HOP)
        return move_to(arm(), state.setpoint, goal, state.period_s, speed_scale=speed_scale)

    def command(self) -> Driver:
        self.driver.wait_quality()
        self.driver.enter_command()
        return self.driver

    def interrupted(self, action, after_s: float = 0.1) -> Outcome:
        """Outcome of a motion during which `action` is called once."""
        done = []

        def progress(now) -> None:
            if now.time_s >= after_s and not done:
                done.append(action())

        motion = self.hop(0.1)
        outcome = self.driver.execute(motion, progress)
        assert done, (outcome.status, outcome.reason)
        return outcome

    def check_commands(self) -> None:
        monitor = self.emulator.status()["monitor"]
        assert monitor["commands"] > 0
        assert monitor["violations"] == 0, monitor["first_violation"]


def _settings(port: int, **more: object) -> LinkSettings:
    options = {"lock_step": True, "realtime": "allow", "lock_step_patience_s": 1.0, **more}
    return LinkSettings(address="127.0.0.1", port=port, **options)  # type: ignore[arg-type]


def _gone(pid: int) -> bool:
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except OSError:
        return True
    return state == "Z"


def test_session_from_connecting_to_the_log(lab, tmp_path):
    driver = lab.driver
    seen = []
    driver.wait_quality()
    rest = driver.monitor(50)
    assert rest.cycles == 50
    assert np.abs(rest.q - driver.state().setpoint).max() < 0.01
    assert np.abs(rest.tau[1]) > 5.0
    motion = lab.hop()
    path = tmp_path / "hop.mcap"
    driver.record(path, session_metadata(robot="LWR4+", payload="none"), {"note.txt": b"hello"})
    state = driver.enter_command()
    assert (state.state, state.mode) == ("CMD", "hold")
    outcome = driver.execute(motion, seen.append)
    driver.leave_command()
    recorded = driver.end_record(outcome.status, outcome.reason)
    assert outcome.check().status == "success"
    assert (outcome.row, outcome.rows) == (len(motion) - 1, len(motion))
    assert len(outcome.last_rows) == 50
    assert driver.state().mode == "mirror"
    assert recorded.missed == 0
    lab.check_commands()

    session = read_session(path)
    assert session.attachments["note.txt"] == b"hello"
    assert session.end is not None
    assert session.end["exit_status"] == "success"
    assert {"hold", "move_to_start"} <= {name for _, name in session.phases}
    begin = next(time for time, name in session.phases if name == "move_to_start")
    command = session.command
    assert command is not None
    first = int(np.searchsorted(command.log_time, begin))
    sent = command.position[first : first + len(motion)]
    assert np.allclose(sent, motion.q, atol=1.2e-7)
    assert np.all(np.diff(session.joint.sequence) == 1)
    assert session.motor is not None
    assert len(session.motor.effort) > 10


def test_stop_request_stops_and_leaves_the_arm_ready(lab):
    driver = lab.command()
    outcome = lab.interrupted(driver.request_stop)
    assert outcome.status == "abort"
    assert outcome.error is None
    assert outcome.reason.startswith("stop requested at row")
    assert 0 < outcome.row < outcome.rows - 1
    assert driver.state().mode == "hold"
    assert driver.execute(lab.hop()).status == "success"
    lab.check_commands()


def test_stop_request_between_motions_is_not_lost(lab):
    driver = lab.command()
    driver.request_stop()
    outcome = driver.execute(lab.hop())
    assert (outcome.status, outcome.row) == ("abort", -1)
    assert driver.execute(lab.hop()).status == "success"
    driver.request_stop()
    with pytest.raises(OperatorError, match="stop requested while waiting for 10 cycles"):
        driver.monitor(10)
    driver.leave_command()
    driver.request_stop()
    with pytest.raises(OperatorError, match="command mode"):
        driver.enter_command()
    assert driver.state().state == "MON"


def test_emergency_stop_ends_the_motion_for_good(lab):
    driver = lab.command()
    outcome = lab.interrupted(lab.emulator.pendant.emergency_stop)
    assert outcome.status == "fail"
    assert "drives are off" in outcome.reason
    with pytest.raises(RobotError, match="drives are off") as error:
        outcome.check()
    assert len(error.value.rows) == 50
    with pytest.raises(RobotError, match=r"not in command mode .* drives are off"):
        driver.execute(lab.hop())
    driver.monitor(500)
    lab.emulator.pendant.release_emergency_stop()
    lab.emulator.pendant.drives(on=True)
    driver.monitor(500)
    assert driver.state().state == "MON"
    lab.command()
    assert driver.execute(lab.hop()).status == "success"
    lab.check_commands()


def test_lost_link_ends_the_motion_and_names_the_link(lab):
    driver = lab.command()
    outcome = lab.interrupted(lambda: lab.emulator.pendant.inject("loss", probability=1.0, cycles=40))
    assert outcome.status == "fail"
    assert isinstance(outcome.error, NetworkError)
    assert driver.state().lost > 0
    lab.command()
    lab.check_commands()


def test_dropped_link_is_the_end(lab):
    driver, lab.spoiled = lab.command(), True
    outcome = lab.interrupted(driver.drop_link)
    assert outcome.status == "abort"
    assert "dropped on request" in outcome.reason
    assert driver.leave_command().mode == "silent"
    with pytest.raises(OperatorError, match="link dropped"):
        driver.monitor(5)
    lab.check_commands()


def test_exception_from_the_progress_callback_stops_the_arm_first(lab):
    driver = lab.command()

    def progress(now) -> None:
        if now.row > 100:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        driver.execute(lab.hop(0.1), progress)
    assert driver.state().mode == "hold"
    lab.check_commands()


def test_motion_that_breaks_a_limit_or_begins_elsewhere_does_not_start(lab):
    driver = lab.command()
    state = driver.state()
    steps = np.tile(state.q_command, (10, 1))
    steps[5, 0] += 0.1
    with pytest.raises(RefusedError, match="A1 velocity"):
        driver.execute(Motion(steps, state.period_s))
    with pytest.raises(RefusedError, match="begins with"):
        driver.execute(move_to(arm(), state.q_command + 0.01, state.q_command, state.period_s))
    with pytest.raises(ConfigurationError, match="period"):
        driver.execute(move_to(arm(), state.q_command, state.q_command, 0.005))
    assert driver.state().mode == "hold"


def test_waiting_is_reported_while_it_lasts(lab, monkeypatch):
    notes = []
    monkeypatch.setattr(lab.driver, "_notify", notes.append)
    monkeypatch.setattr("lwr_driver.driver._NOTIFY_S", 0.0)
    lab.driver.monitor(200)
    assert notes
    assert notes[0].awaited == "200 cycles"
    assert notes[0].seen.startswith("state MON, quality")


def test_command_mode_that_does_not_come_says_what_is_seen_and_what_to_do(lab):
    lab.emulator.pendant.degrade_quality(1500)
    with pytest.raises(RobotError, match=r"waited .* seen: state MON, quality .*\. .+") as error:
        lab.driver.enter_command(timeout_s=1.0)
    assert error.value.rows is not None
    lab.driver.monitor(1500)
    assert lab.driver.state().state == "MON"


def test_recorder_that_dies_stops_the_motion(lab, tmp_path):
    driver = lab.driver
    lab.spoiled = True
    driver.record(tmp_path / "x.mcap", session_metadata(robot="LWR4+"))
    lab.command()
    recorder = driver._recorder
    assert recorder is not None
    outcome = lab.interrupted(lambda: os.kill(recorder.pid, signal.SIGKILL))
    assert outcome.status == "fail"
    assert isinstance(outcome.error, DataError)
    assert driver.state().mode == "hold"
    lab.check_commands()


def test_loop_that_dies_is_a_network_error(lab):
    driver, lab.spoiled = lab.command(), True
    loop = driver._loop
    assert loop is not None
    outcome = lab.interrupted(lambda: os.kill(loop.pid, signal.SIGKILL))
    assert outcome.status == "fail"
    assert isinstance(outcome.error, NetworkError)
    assert "ended with code -9" in outcome.reason
    driver.close()


@pytest.mark.slow
def test_emulator_that_is_gone_is_noticed(lab):
    driver, lab.spoiled = lab.command(), True
    outcome = lab.interrupted(lab.emulator.stop)
    driver.close()
    assert outcome.status == "fail"
    assert "in lock step; the emulator is gone" in outcome.reason


def test_close_leaves_no_process_and_no_memory_behind(lab, tmp_path):
    driver, lab.spoiled = lab.command(), True
    pids = [driver._loop.pid, driver._recorder.pid]
    driver.record(tmp_path / "open.mcap", session_metadata(robot="LWR4+"))
    name = driver._ring.name
    driver.close()
    driver.close()
    assert all(_gone(pid) for pid in pids)
    assert not Path(name).exists()
    assert lab.emulator.status()["state"] == "MON"
    assert read_session(tmp_path / "open.mcap").end["exit_status"] == "fail"
    with pytest.raises(NetworkError, match="not connected"):
        driver.state()


def test_ctrl_c_of_the_terminal_does_not_reach_the_loop(lab):
    driver = lab.command()
    for process in (driver._loop, driver._recorder):
        os.kill(process.pid, signal.SIGINT)
    assert driver.execute(lab.hop()).status == "success"


def test_connecting_without_a_controller_says_what_to_check():
    with pytest.raises(
        NetworkError, match=r"first packet on UDP 127.0.0.1:\d+; seen: no packet yet.*KRL program"
    ):
        Driver(arm(), _settings(0)).connect(timeout_s=0.3)


def test_address_that_is_not_ours_is_refused():
    with pytest.raises(NetworkError, match=r"cannot bind UDP 192\.0\.2\.1"):
        Driver(arm(), LinkSettings(address="192.0.2.1", realtime="allow", lock_step=True)).connect()


def test_loop_ends_when_its_parent_is_killed():
    program = (
        "import time\n"
        "from tests.lwr_driver.driver_rig import arm\n"
        "from lwr_driver.driver import Driver, LinkSettings\n"
        "link = LinkSettings(address='127.0.0.1', port=0, realtime='allow', lock_step=True)\n"
        "driver = Driver(arm(), link)\n"
        "driver._wait = lambda *a, **k: None\n"
        "driver.connect()\n"
        "print(driver._loop.pid, driver._recorder.pid, flush=True)\n"
        "time.sleep(60)\n"
    )
    parent = subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE)
    try:
        assert parent.stdout is not None
        pids = [int(word) for word in parent.stdout.readline().split()]
        parent.kill()
        parent.wait()
        deadline = time.monotonic() + 20.0
        while not all(_gone(pid) for pid in pids):
            assert time.monotonic() < deadline
            time.sleep(0.01)
    finally:
        parent.kill()
        parent.stdout.close()


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"handshake": "none"}, "known are"),
        ({"handshake": "rcprg"}, "impedance"),
        ({"priority": 100}, "priority"),
        ({"link_timeout_s": 0.0}, "link_timeout_s"),
        ({"longest_motion_s": -1.0}, "longest_motion_s"),
    ],
)
def test_settings_that_make_no_sense_are_refused(settings, message):
    with pytest.raises(ConfigurationError, match=message):
        LinkSettings(**settings)


def test_unknown_quality_is_refused_with_the_known_ones(lab):
    with pytest.raises(ConfigurationError, match="UNACCEPTABLE, BAD, OK, PERFECT"):
        lab.driver.wait_quality("GOOD")


def test_no_motion_with_a_factor_that_no_controller_gives(lab, monkeypatch):
    motion, state = lab.hop(), lab.command().state()
    monkeypatch.setattr(lab.driver, "state", lambda: dataclasses.replace(state, safety_limits=0.0))
    with pytest.raises(RefusedError, match=r"safety_limits .* is 0, it must be above 0 and finite.*friStart"):
        lab.driver.execute(motion)
