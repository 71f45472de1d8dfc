"""The sequence of sessions: what is asked of driver and person, what is checked, and what a resumption knows."""

from __future__ import annotations

import io
import json
import signal
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fri.errors import DataError, FileError, RefusedError, RobotError
from lwr_driver.arm import Arm
from runner.commands.experiment import remarked
from runner.experiment import ExperimentProgress, LinkReport, Run
from runner.experiment_file import Link, Payload, SessionPlan
from runner.preflight import Rest, gravity_torque, load_data
from runner.results import write_text
from runner.status import StatusLine
from tests.runner.experiment.stand import HOME, LOAD, PERIOD_S, Stand, excite, experiment, run_of

BARE, LOADED, AGAIN = SessionPlan("bare"), SessionPlan("loaded", LOAD), SessionPlan("again", LOAD)


@pytest.fixture(scope="module")
def arm() -> Arm:
    return Arm.load()


@pytest.fixture
def stand(arm: Arm) -> Stand:
    return Stand(arm)


def test_a_session_asks_for_everything_in_its_order(stand: Stand, tmp_path: Path) -> None:
    (record,) = run_of(stand, tmp_path).sessions()
    assert (record.name, record.path) == ("bare", tmp_path / "bare.mcap")
    assert (record.status, record.reason, record.warnings) == ("success", "", ())
    order = [name for name in stand.names() if name != "monitor"]
    assert order == [
        "wait_quality",
        "swap",
        "set_load",
        "enter_command",
        "record",
        "begin",
        "execute",
        "end_record",
        "leave_command",
    ]
    # At rest before the motion, after it for the payload, and once more for the next session.
    assert stand.of("monitor") == [(50,)] * 3
    assert stand.of("end_record") == [("success", "")]


def test_the_link_is_watched_for_the_stated_time(stand: Stand, tmp_path: Path) -> None:
    run_of(stand, tmp_path, link=Link(quality_s=2.5)).sessions()
    assert stand.of("wait_quality") == [(250,)]
    stand.calls.clear()
    run_of(stand, tmp_path, SessionPlan("short"), link=Link(quality_s=0.01)).sessions()
    assert stand.of("wait_quality") == [(10,)]


def test_nothing_moves_after_a_failed_check(stand: Stand, tmp_path: Path) -> None:
    stand.sign[1] = -1.0
    with pytest.raises(RefusedError, match=r"torque at rest: A2 .*limit"):
        run_of(stand, tmp_path).sessions()
    assert not {"enter_command", "record", "execute"} & set(stand.names())
    assert not (tmp_path / "progress.json").exists()


@pytest.mark.parametrize(("quality", "error"), [("BAD", 0), ("OK", 4)])
def test_a_bad_link_or_a_drive_in_error_refuses_the_motion(
    stand: Stand, tmp_path: Path, quality: str, error: int
) -> None:
    stand.quality, stand.error = quality, error
    with pytest.raises(RefusedError, match=f"link: {quality}.*0x{error:02x}"):
        run_of(stand, tmp_path).sessions()
    assert "execute" not in stand.names()


def test_the_motion_begins_where_the_controller_has_the_arm(stand: Stand, tmp_path: Path) -> None:
    moved = (HOME + 0.001).astype(np.float32).astype(np.float64)

    def creep() -> None:
        stand.q = moved

    stand.at_command = creep
    run_of(stand, tmp_path).sessions()
    ((motion,),) = stand.of("execute")
    assert np.array_equal(motion.q[0], moved)
    np.testing.assert_allclose(motion.q[-1], HOME, atol=1e-6)
    assert [name for _, name in motion.phases] == ["move_to_start", "settle", "period 1", "brake", "return"]


def test_a_check_that_fails_after_the_move_of_the_set_point_leaves_command_mode(
    stand: Stand, tmp_path: Path
) -> None:
    def trouble() -> None:
        stand.q = stand.q + 1e-3
        stand.error = 1

    stand.at_command = trouble
    with pytest.raises(RefusedError, match="link"):
        run_of(stand, tmp_path).sessions()
    assert stand.names()[-2:] == ["enter_command", "leave_command"]


def test_the_payload_is_swapped_entered_and_weighed(stand: Stand, tmp_path: Path) -> None:
    records = run_of(stand, tmp_path, BARE, LOADED, AGAIN).sessions()
    assert [record.status for record in records] == ["success"] * 3
    assert stand.of("swap") == [(None, None), (None, LOAD)]
    assert stand.of("set_load") == [load_data(stand.arm, None), load_data(stand.arm, LOAD)]
    text = stand.text.getvalue()
    assert "payload for session bare: none" in text
    assert "payload for session loaded: paper_load, 3.34 kg" in text
    assert text.count("static check of the payload") == 2
    assert "like 3.34 kg" in text
    assert text.count("payload for session") == 2


def test_a_controller_that_takes_no_load_data_gets_none(stand: Stand, tmp_path: Path) -> None:
    stand.sets_load = False
    run_of(stand, tmp_path).sessions()
    assert "set_load" not in stand.names()


def test_a_forgotten_payload_is_refused(stand: Stand, tmp_path: Path) -> None:
    run = run_of(stand, tmp_path, BARE, LOADED)
    stand.careless = True
    with pytest.raises(RefusedError, match="payload 'paper_load' announced"):
        run.sessions()
    assert [path.name for path, *_ in stand.of("record")] == ["bare.mcap"]


def test_a_payload_lost_on_the_way_fails_the_session(stand: Stand, tmp_path: Path) -> None:
    def lose() -> None:
        stand.flange = None

    stand.during = lose
    records = run_of(stand, tmp_path, LOADED, AGAIN).sessions()
    assert [(r.name, r.status) for r in records] == [("loaded", "fail")]
    assert "the payload changed during the motion" in records[0].reason
    assert isinstance(records[0].error, RobotError)
    ((status, reason),) = stand.of("end_record")
    assert (status, reason) == ("fail", records[0].reason)
    assert ExperimentProgress.load(tmp_path).finished == {}


def test_an_aborted_motion_ends_the_sequence_and_is_not_finished(stand: Stand, tmp_path: Path) -> None:
    stand.outcome = ("abort", "stop requested", None)
    records = run_of(stand, tmp_path, BARE, LOADED).sessions()
    assert [(r.status, r.reason) for r in records] == [("abort", "stop requested")]
    assert ExperimentProgress.load(tmp_path).finished == {}
    # After a motion that did not end well nothing is known of the payload at the flange.
    assert stand.of("monitor") == [(50,)]


def test_a_failed_motion_keeps_its_error(stand: Stand, tmp_path: Path) -> None:
    error = RobotError("drives are off")
    stand.outcome = ("fail", "drives are off", error)
    (record,) = run_of(stand, tmp_path).sessions()
    assert record.error is error
    assert stand.of("end_record") == [("fail", "drives are off")]


@pytest.mark.parametrize(("status", "warned"), [("success", True), ("abort", False)])
def test_warnings_about_the_data_of_a_finished_session_are_said_and_kept(
    stand: Stand, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, status: str, warned: bool
) -> None:
    monkeypatch.setattr(
        Run, "_torque_warnings", lambda run, path, rejected: (f"{path.name}: A2 looks like A3",)
    )
    stand.outcome = (status, "", None)
    (record,) = run_of(stand, tmp_path).sessions()
    assert record.warnings == (("bare.mcap: A2 looks like A3",) if warned else ())
    assert ("A2 looks like A3" in stand.text.getvalue()) == warned


def test_a_log_that_could_not_be_written_fails_the_session(stand: Stand, tmp_path: Path) -> None:
    stand.write_error = "no space left on device"
    (record,) = run_of(stand, tmp_path).sessions()
    assert record.status == "fail"
    assert "no space left on device" in record.reason
    assert ExperimentProgress.load(tmp_path).finished == {}


@pytest.mark.parametrize(("presses", "asked"), [(1, ["request_stop"]), (2, ["request_stop", "drop_link"])])
def test_ctrl_c_asks_for_a_stop_and_then_for_silence(
    stand: Stand, tmp_path: Path, presses: int, asked: list[str]
) -> None:
    stand.during = lambda: [signal.raise_signal(signal.SIGINT) for _ in range(presses)] and None
    run_of(stand, tmp_path).sessions()
    assert [name for name in stand.names() if name in ("request_stop", "drop_link")] == asked


def test_the_onlooker_and_the_status_line_follow_the_motion(
    stand: Stand, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shown: list[tuple[Any, ...]] = []
    monkeypatch.setattr(StatusLine, "show", lambda self, *words, phase="": shown.append((*words, phase)))
    run_of(stand, tmp_path, LOADED).sessions()
    ((motion,),) = stand.of("execute")
    assert stand.of("begin") == [("loaded", LOAD, motion)]
    line = next(line for line in shown if line[-1] == "period 1")
    assert line[0] == "loaded"
    assert {f"1.5 of {motion.duration_s:.1f} s", "tracking 2.0 mrad"} < set(line)


def test_the_link_of_a_session_is_the_difference_of_two_states(stand: Stand) -> None:
    start, end = stand.state(), stand.state()
    report = LinkReport.between(start, end)  # type: ignore[arg-type]
    assert (report.cycles, report.missed, report.lost, report.late) == (100, 10, 5, 2)
    assert report.period_s == PERIOD_S
    assert report.latency_s == {"p50": 1e-4, "p99": 2e-4}
    assert report.worst_tracking_error_rad == [0.002] * 7


def test_a_session_has_the_link_from_before_to_after_the_motion(stand: Stand, tmp_path: Path) -> None:
    (record,) = run_of(stand, tmp_path).sessions()
    assert record.link is not None
    assert record.link.cycles > 0
    assert record.link.missed > 0


def test_the_log_tells_what_was_done_with_what(stand: Stand, tmp_path: Path) -> None:
    run = run_of(stand, tmp_path, LOADED, serial="4711")
    run.sessions()
    ((path, metadata, attachments),) = stand.of("record")
    assert path == tmp_path / "loaded.mcap"
    uid = run.experiment.uid
    expected = {
        "robot": stand.arm.name,
        "serial": "4711",
        "payload": "paper_load",
        "payload_mass": "3.34",
        "experiment": "stand",
        "uid": f"{uid}-loaded-1",
        "parent_uid": "",
        "motor_torque_source": "none",
        "utc_start": "2020-01-01T00:00:00+00:00",
    }
    assert {key: metadata[key] for key in expected} == expected
    assert attachments["experiment.yaml"] == b"name: stand\n"
    assert attachments["robot.urdf"].decode() == stand.arm.urdf
    checks = json.loads(attachments["preflight.json"])
    subjects = [item["subject"] for item in checks]
    assert {"link", "torque at rest", "clearance", "joint torque estimate", "free disk space"} <= set(
        subjects
    )
    ((motion,),) = stand.of("execute")
    with np.load(io.BytesIO(attachments["plan.npz"])) as plan:
        assert np.array_equal(plan["q"], motion.q)
        np.testing.assert_allclose(plan["time"], np.arange(len(motion)) * PERIOD_S, atol=1e-12)
        np.testing.assert_allclose(plan["qd"], np.gradient(motion.q, PERIOD_S, axis=0), atol=1e-9)
        np.testing.assert_allclose(plan["qdd"], np.gradient(plan["qd"], PERIOD_S, axis=0), atol=1e-9)


@pytest.mark.parametrize(("lock_step", "shown"), [(True, "not needed"), (False, "had")])
def test_real_time_rights_matter_out_of_lock_step(
    stand: Stand, tmp_path: Path, lock_step: bool, shown: str
) -> None:
    run_of(stand, tmp_path, lock_step=lock_step).sessions()
    ((_, metadata, attachments),) = stand.of("record")
    (rights,) = [i for i in json.loads(attachments["preflight.json"]) if i["subject"] == "real-time rights"]
    assert rights["value"] == shown
    assert (metadata["utc_start"] == "2020-01-01T00:00:00+00:00") == lock_step


def test_a_log_without_payload_has_no_mass(stand: Stand, tmp_path: Path) -> None:
    run_of(stand, tmp_path).sessions()
    ((_, metadata, _),) = stand.of("record")
    assert metadata["payload"] == "none"
    assert "payload_mass" not in metadata


def test_the_trace_is_started_before_the_motion_and_its_absence_is_said(stand: Stand, tmp_path: Path) -> None:
    (record,) = run_of(stand, tmp_path, source="trace_file").sessions()
    assert record.status == "success"
    names = stand.names()
    assert names.index("start_trace") < names.index("enter_command")
    assert names.index("save_trace") > names.index("leave_command")
    assert stand.of("save_trace") == [(tmp_path / "bare.trace.csv",)]
    assert "bare.trace.csv is not there" in stand.text.getvalue()


def test_without_a_trace_nobody_is_asked_for_one(stand: Stand, tmp_path: Path) -> None:
    run_of(stand, tmp_path).sessions()
    assert not {"start_trace", "save_trace"} & set(stand.names())


# -- resumption ----------------------------------------------------------------------------------------------


def test_finished_sessions_are_not_repeated(stand: Stand, tmp_path: Path) -> None:
    run_of(stand, tmp_path, BARE, LOADED).sessions()
    stand.calls.clear()
    records = run_of(stand, tmp_path, BARE, LOADED).sessions()
    assert [(r.status, r.reason) for r in records] == [("success", "finished in an earlier run")] * 2
    assert stand.calls == []


def test_a_finished_session_without_its_log_is_repeated(stand: Stand, tmp_path: Path) -> None:
    run_of(stand, tmp_path).sessions()
    (tmp_path / "bare.mcap").unlink()
    (record,) = run_of(stand, tmp_path).sessions()
    assert record.reason == ""
    assert "execute" in stand.names()


def test_a_resumption_asks_for_the_payload_and_weighs_it(stand: Stand, tmp_path: Path) -> None:
    run_of(stand, tmp_path, LOADED).sessions()
    stand.calls.clear()
    run_of(stand, tmp_path, LOADED, AGAIN).sessions()
    assert stand.of("swap") == [(LOAD, LOAD)]
    stand.calls.clear()
    run_of(stand, tmp_path, LOADED, AGAIN, BARE).sessions()
    assert stand.of("swap") == [(LOAD, None)]


def test_a_resumption_weighs_the_payload_against_the_last_session(stand: Stand, tmp_path: Path) -> None:
    run_of(stand, tmp_path, LOADED).sessions()
    stand.flange = None
    stand.careless = True
    with pytest.raises(RefusedError, match="payload 'paper_load' announced"):
        run_of(stand, tmp_path, LOADED, AGAIN).sessions()
    other = Payload("other", 1.0, (0.0, 0.0, 0.1))
    with pytest.raises(RefusedError, match="payload 'other' announced"):
        run_of(stand, tmp_path, LOADED, SessionPlan("next", other)).sessions()


def test_further_sessions_know_the_payload_and_its_weight(stand: Stand, tmp_path: Path) -> None:
    run = run_of(stand, tmp_path, LOADED)
    run.sessions()
    stand.calls.clear()
    followed = run.followed_by(experiment(AGAIN), excite)
    assert isinstance(followed, Run)
    followed.sessions()
    assert stand.of("swap") == []
    stand.flange = None
    with pytest.raises(RefusedError, match="announced"):
        followed.followed_by(experiment(SessionPlan("third", LOAD)), excite).sessions()


def test_the_state_at_rest_is_read_back(arm: Arm, tmp_path: Path) -> None:
    progress = ExperimentProgress.create(tmp_path, tmp_path / "files")
    rest = Rest(HOME, gravity_torque(arm, HOME, LOAD), LOAD)
    progress.finish("loaded", rest)
    again = ExperimentProgress.load(tmp_path)
    found = again.rest("loaded", LOAD)
    assert np.array_equal(found.q, rest.q)
    assert np.array_equal(found.tau, rest.tau)
    assert found.payload is LOAD
    assert again.origin == tmp_path / "files"
    assert ExperimentProgress.load(tmp_path / "empty").origin is None


def test_attempts_are_counted_and_their_logs_kept(tmp_path: Path) -> None:
    progress = ExperimentProgress.create(tmp_path, tmp_path)
    log = tmp_path / "bare.mcap"
    assert progress.begin("bare", log, "uid") == ("uid-1", "")
    log.write_text("first")
    assert ExperimentProgress.load(tmp_path).begin("bare", log, "uid") == ("uid-2", "uid-1")
    assert (tmp_path / "bare.attempt-1.mcap").read_text() == "first"
    log.write_text("second")
    assert ExperimentProgress.load(tmp_path).begin("bare", log, "uid") == ("uid-3", "uid-2")
    assert (tmp_path / "bare.attempt-2.mcap").read_text() == "second"
    # A log of unknown origin is kept too, and no earlier one is overwritten.
    log.write_text("third")
    progress = ExperimentProgress(tmp_path / "progress.json")
    assert progress.begin("bare", log, "uid") == ("uid-1", "")
    assert (tmp_path / "bare.attempt-1.mcap").read_text() == "first"
    assert (tmp_path / "bare.attempt-3.mcap").read_text() == "third"


@pytest.mark.parametrize("content", ["{", "[]", '{"origin": "", "attempts": {}}'])
def test_a_broken_progress_says_how_to_begin_anew(tmp_path: Path, content: str) -> None:
    (tmp_path / "progress.json").write_text(content)
    with pytest.raises(DataError, match=r"progress\.json: cannot be read, .*; delete it"):
        ExperimentProgress.load(tmp_path)


def test_an_arm_that_stays_in_command_mode_ends_the_run_before_anybody_is_sent_to_it(
    stand: Stand, tmp_path: Path
) -> None:
    stand.leave_error = RobotError("waited 30.0 s for monitor mode")
    (record,) = run_of(stand, tmp_path, BARE, LOADED).sessions()
    assert (record.status, type(record.error)) == ("fail", RobotError)
    assert "command mode was not left" in record.reason
    assert "at the pendant" in record.reason
    assert len(stand.of("swap")) == 1
    # What was driven is kept: the next run goes on behind it, but not before the arm is let go.
    with pytest.raises(RobotError, match=r"payload swap: the arm is in state CMD.*at the pendant"):
        run_of(stand, tmp_path, BARE, LOADED).sessions()
    stand.leave_error, stand.in_command = None, False
    assert [record.status for record in run_of(stand, tmp_path, BARE, LOADED).sessions()] == ["success"] * 2


def test_a_failed_leave_does_not_hide_the_failure_before_it(stand: Stand, tmp_path: Path) -> None:
    def trouble() -> None:
        stand.q = stand.q + 1e-3
        stand.error = 1

    stand.at_command, stand.leave_error = trouble, RobotError("waited 30.0 s for monitor mode")
    with pytest.raises(RefusedError, match="link"):
        run_of(stand, tmp_path).sessions()
    assert "command mode was not left" in stand.text.getvalue().replace("\n", " ")


def test_a_log_that_cannot_be_read_back_does_not_undo_the_session(stand: Stand, tmp_path: Path) -> None:
    stand.motor_rejected = 2
    run = run_of(stand, tmp_path, source="krl_reals")  # the stand's log is no MCAP file
    (record,) = run.sessions()
    assert record.status == "success"
    assert "2 samples of the motor torques were not finite" in record.warnings[0]
    assert "were not compared with the sensors" in record.warnings[1]
    assert "bare" in json.loads((tmp_path / "progress.json").read_text())["finished"]


def test_a_trace_that_cannot_be_read_does_not_undo_the_session(stand: Stand, tmp_path: Path) -> None:
    stand.trace = b"no trace"
    (tmp_path / "bare.trace.csv").write_bytes(stand.trace)
    (record,) = run_of(stand, tmp_path, source="trace_file").sessions()
    assert record.status == "success"
    assert "--force` adds them" in stand.text.getvalue().replace("\n", " ")


def test_a_full_disk_names_its_file(tmp_path: Path) -> None:
    (tmp_path / "progress.json.new").symlink_to("/dev/full")
    with pytest.raises(FileError, match=r"progress\.json\.new: No space left on device; make room"):
        ExperimentProgress.create(tmp_path, tmp_path)
    (tmp_path / "report.txt").symlink_to("/dev/full")
    with pytest.raises(FileError, match=r"report\.txt: No space left on device"):
        write_text(tmp_path / "report.txt", "verdict")


def test_a_report_that_fails_after_a_failed_session_is_a_remark(stand: Stand, tmp_path: Path) -> None:
    (tmp_path / "report.txt").symlink_to("/dev/full")
    with remarked(StatusLine(stand.text), failed=True):
        write_text(tmp_path / "report.txt", "verdict")
    assert "no report: " in stand.text.getvalue()
    with pytest.raises(FileError), remarked(StatusLine(stand.text), failed=False):
        write_text(tmp_path / "report.txt", "verdict")
