"""Record, hold, jog and home on the emulated arm, in lock step."""

from __future__ import annotations

import json
import threading
from collections.abc import Iterator
from pathlib import Path

import click
import numpy as np
import pytest
import yaml
from click.testing import CliRunner

from fri.errors import ConfigurationError, LwrError, OperatorError, RefusedError, RobotError
from lwr_driver.session import read_session
from runner.cli import main
from runner.commands.steps import jog_command
from runner.experiment import Bench
from runner.experiment_file import DEFAULT, Experiment
from runner.laboratory import Laboratory
from runner.steps import LARGEST_JOG_DEG, Steps, jogged, standstills

LAB = {
    "name": "steps",
    "emulator_settings": {"fri.period_ms": 10},
    "sessions": [
        {"name": "unloaded"},
        {"name": "loaded", "payload": {"name": "paper_load", "mass": 3.34, "com": [0.0, -0.066, 0.144]}},
    ],
}
NAMES = ("A1", "A2", "E1", "A3", "A4", "A5", "A6")


class Day:
    """One laboratory for all steps of this file."""

    def __init__(self, folder: Path) -> None:
        (folder / "lab.yaml").write_text(yaml.safe_dump(LAB))
        self.experiment = Experiment.load(folder / "lab.yaml")
        self.laboratory = Laboratory(self.experiment)
        self.bench: Bench = self.laboratory.__enter__()

    @property
    def pendant(self):
        assert self.laboratory.emulator is not None
        return self.laboratory.emulator.pendant

    def steps(self, payload: str | None = None) -> Steps:
        return Steps(
            self.experiment, self.bench, None if payload is None else self.experiment.payloads()[payload]
        )

    def ready(self) -> None:
        self.pendant.release_emergency_stop()
        self.pendant.push([0.0] * 7)
        self.pendant.mode("EXT")
        self.bench.driver.monitor(50)
        self.pendant.drives(on=True)
        self.bench.driver.stop()


@pytest.fixture(scope="module")
def laboratory(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Day]:
    day = Day(tmp_path_factory.mktemp("lab"))
    yield day
    day.laboratory.__exit__(None, None, None)


@pytest.fixture
def day(laboratory: Day) -> Day:
    laboratory.ready()
    return laboratory


def test_record_commands_nothing_and_finds_the_poses(day: Day, tmp_path: Path) -> None:
    path = tmp_path / "guided.mcap"
    here = day.bench.driver.state().q
    ways = ([0.2, 0.0, 0.0, 0.1, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 0.0, 0.3, 0.0, 0.0])
    day.pendant.drives(on=False)
    # The drives are off, as in gravity compensation, and a person moves the arm.
    for number, way in enumerate(ways):
        day.pendant.schedule("displace", after_cycles=250 * (number + 1), offset=way)
    step = day.steps().record(path, 8.0)
    session = read_session(path)
    assert session.end is not None
    assert session.end["exit_status"] == "success"
    assert session.joint.lost == 0
    assert step.samples == len(session.joint) == 800
    assert [pose.name for pose in step.poses] == ["pose_1", "pose_2", "pose_3"]
    np.testing.assert_allclose(step.poses[0].q, here, atol=2e-3)
    np.testing.assert_allclose(step.poses[2].q, here + np.sum(ways, axis=0), atol=5e-3)
    assert "nothing commanded" in str(step)
    assert "3 poses at rest" in str(step)
    assert str(step).endswith(f"log: {path}")
    assert day.pendant.status()["state"] == "MON"
    day.pendant.displace((-np.sum(ways, axis=0)).tolist())


def test_a_pose_that_cannot_be_home_is_noted(day: Day, tmp_path: Path) -> None:
    day.pendant.drives(on=False)
    day.pendant.displace([0.0, 0.0, 0.0, 0.0, 0.0, 1.35, 0.0])
    step = day.steps().record(tmp_path / "far.mcap", 2.0)
    assert len(step.notes) == 1
    assert "A5" in step.notes[0]
    assert "no home pose" in step.notes[0]
    day.pendant.displace([0.0, 0.0, 0.0, 0.0, 0.0, -1.35, 0.0])


def test_ctrl_c_ends_a_recording_in_order(day: Day, tmp_path: Path) -> None:
    timer = threading.Timer(1.0, day.bench.driver.request_stop)
    timer.start()
    step = day.steps().record(tmp_path / "r.mcap", None)
    assert step.samples > 10
    end = read_session(tmp_path / "r.mcap").end
    assert end is not None
    assert end["exit_status"] == "success"


def test_hold_enters_and_leaves_command_mode_without_motion(day: Day, tmp_path: Path) -> None:
    path = tmp_path / "hold.mcap"
    step = day.steps().hold(path, 1.0)
    assert "held the pose for 1 s in command mode" in str(step)
    assert day.bench.driver.state().state == "MON"
    session = read_session(path)
    assert session.end is not None
    assert session.end["restarts"] == "0"
    assert np.ptp(session.joint.position, axis=0).max() < 1e-3
    assert session.metadata["uid"]
    assert {"preflight.json", "plan.npz", "experiment.yaml"} <= set(session.attachments)
    subjects = {item["subject"] for item in json.loads(session.attachments["preflight.json"])}
    assert {"clearance of a stop", "torque of a stop"} <= subjects


@pytest.mark.parametrize("degrees", [4.0, -4.0])
def test_jog_moves_one_joint_by_so_much(day: Day, tmp_path: Path, degrees: float) -> None:
    step = day.steps().jog(tmp_path / "jog.mcap", "a4", degrees, 0.2)
    moved = np.degrees(step.after - step.before)
    assert moved[4] == pytest.approx(degrees, abs=0.1)
    assert np.abs(np.delete(moved, 4)).max() < 0.1
    assert f"moved by A4 {degrees:+.0f}"[:14] in str(step) or "moved by A4" in str(step)
    assert day.pendant.status()["monitor"]["violations"] == 0
    assert read_session(tmp_path / "jog.mcap").end is not None


def test_home_goes_to_the_pose(day: Day, tmp_path: Path) -> None:
    goal = day.experiment.home(7) + 0.05
    step = day.steps().home(tmp_path / "there.mcap", goal, 0.3, "pose_1")
    np.testing.assert_allclose(step.after, goal, atol=2e-3)
    assert "moved to pose_1" in str(step)
    day.steps().home(tmp_path / "back.mcap", day.experiment.home(7), 0.3)


def test_a_way_through_the_table_or_beyond_a_limit_is_refused_before_command_mode(
    day: Day, tmp_path: Path
) -> None:
    down = day.experiment.home(7) + np.array([0.0, 1.2, 0.0, 0.6, 0.0, 0.0, 0.0])
    with pytest.raises(RefusedError, match="clearance"):
        day.steps().home(tmp_path / "down.mcap", down, 0.3)
    beyond = day.experiment.home(7).copy()
    beyond[0] = 3.2
    with pytest.raises(RefusedError, match="A1"):
        day.steps().home(tmp_path / "beyond.mcap", beyond, 0.3)
    assert not list(tmp_path.iterdir())
    assert day.bench.driver.state().state == "MON"


def test_another_payload_than_announced_is_refused(day: Day, tmp_path: Path) -> None:
    with pytest.raises(RefusedError, match="torque at rest"):
        day.steps("paper_load").hold(tmp_path / "hold.mcap", 1.0)
    assert not (tmp_path / "hold.mcap").exists()


def test_an_emergency_stop_ends_the_step_and_the_same_command_begins_anew(day: Day, tmp_path: Path) -> None:
    day.pendant.schedule("emergency_stop", when="moving", after_cycles=60)
    with pytest.raises(
        RobotError, match="Nothing resumes by itself; the same command begins at the present pose"
    ):
        day.steps().jog(tmp_path / "first.mcap", "A1", 20.0, 0.1)
    end = read_session(tmp_path / "first.mcap").end
    assert end is not None
    assert end["exit_status"] == "fail"
    day.ready()
    before = day.bench.driver.state().q
    step = day.steps().jog(tmp_path / "again.mcap", "A1", -3.0, 0.1)
    assert step.after[0] - before[0] == pytest.approx(np.radians(-3.0), abs=2e-3)


def test_an_emergency_stop_ends_a_hold(day: Day, tmp_path: Path) -> None:
    day.pendant.schedule("emergency_stop", when="command", after_cycles=80)
    with pytest.raises(RobotError, match=r"command mode ended: .*Log: "):
        day.steps().hold(tmp_path / "hold.mcap", 30.0)


def test_ctrl_c_stops_a_jog_within_limits(day: Day, tmp_path: Path) -> None:
    steps, driver = day.steps(), day.bench.driver
    stop = steps._progress
    steps._progress = lambda now: driver.request_stop() if now.row > 60 else stop(now)  # type: ignore[method-assign]
    with pytest.raises(OperatorError, match="stop requested at row"):
        steps.jog(tmp_path / "jog.mcap", "A2", -25.0, 0.005)
    assert day.pendant.status()["monitor"]["violations"] == 0
    end = read_session(tmp_path / "jog.mcap").end
    assert end is not None
    assert end["exit_status"] == "abort"


@pytest.mark.parametrize("degrees", [0.0, LARGEST_JOG_DEG + 0.1, -90.0, float("nan"), float("inf")])
def test_a_jog_is_small(degrees: float) -> None:
    with pytest.raises(ConfigurationError, match=r"at most 30\. Go further in several jogs"):
        jogged(NAMES, "A1", degrees)


def test_a_jog_names_its_joint() -> None:
    assert jogged(NAMES, "e1", 3.0) == 2
    with pytest.raises(ConfigurationError, match="choose one of A1, A2, E1, A3, A4, A5, A6"):
        jogged(NAMES, "A7", 3.0)


@pytest.mark.parametrize(
    "line",
    [
        "A6 -5",
        "A6 -5 lab.yaml",
        "A6 -5 --speed 0.05",
        "A6 -5 lab.yaml --speed 0.05 --yes",
        "--speed 0.05 A6 -5 lab.yaml",
        "A6 -.5e1",
    ],
)
def test_negative_degrees_are_no_option(line: str) -> None:
    context = jog_command.make_context(
        "jog", line.split(), parent=click.Context(main, **main.context_settings)
    )
    assert (context.params["joint"], context.params["degrees"]) == ("A6", -5.0)
    assert context.params["file"] == ("lab.yaml" if "lab" in line else str(DEFAULT))
    assert context.params["speed"] == (0.05 if "speed" in line else 0.1)
    with pytest.raises(click.UsageError):
        jog_command.make_context(
            "jog", ["A6", "-5", "--unknown"], parent=click.Context(main, **main.context_settings)
        )


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("jog A9 5", "joint 'A9' is unknown"),
        ("jog A2 45", "at most 30"),
        ("jog A2 five", "is not a valid float"),
        ("home --pose pose_1", "needs --poses"),
        ("home --poses poses.yaml --pose pose_9", "no pose pose_9; poses there: pose_1"),
        ("home --poses poses.yaml --pose short", "must be 7 joint positions in rad"),
        ("hold --payload brick", "payload 'brick' is not in"),
        ("hold --out there.mcap", "there.mcap exists"),
        ("hold --out log.txt", "ends in .mcap"),
        ("hold --seconds 0", "not in the range"),
        ("record --out none/log.mcap", "make the folder first"),
        ("record --poses poses.yaml", "poses.yaml exists"),
        ("record nothing.yaml", "not found"),
    ],
)
def test_wrong_lines_are_refused_before_anything_is_connected(
    line: str, words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("runner.laboratory.Laboratory.__enter__", lambda self: pytest.fail("connected"))
    (tmp_path / "there.mcap").touch()
    (tmp_path / "poses.yaml").write_text("poses: {pose_1: [0, 0, 0, 0, 0, 0, 0], short: [1, 2]}\nmoves: {}\n")
    result = CliRunner().invoke(main, line.split())
    assert result.exit_code == 2, result.output
    assert words in result.output


def test_without_a_yes_nothing_moves(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "lab.yaml").write_text(yaml.safe_dump({**LAB, "backend": "fri", "lock_step": False}))
    for line in ("jog A1 5 lab.yaml", "hold lab.yaml", "home lab.yaml"):
        result = CliRunner().invoke(main, line.split(), input="n\n")
        assert result.exit_code == 4
        assert "was not confirmed; nothing moved" in result.output


@pytest.mark.slow
def test_the_commands_say_at_the_end_what_was_done_and_where_the_log_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "lab.yaml").write_text(yaml.safe_dump(LAB))

    def lwr_run(line: str) -> str:
        result = CliRunner().invoke(main, line.split())
        assert result.exit_code == 0, result.output
        return result.stdout

    assert lwr_run("record lab.yaml --seconds 2 --out r.mcap --poses p.yaml").endswith("log: r.mcap\n")
    poses = yaml.safe_load((tmp_path / "p.yaml").read_text())
    assert poses["moves"]["home"] == poses["poses"]["pose_1"]
    said = lwr_run("home lab.yaml --poses p.yaml --pose pose_1 --out h.mcap")
    assert said.startswith("moved to pose_1")
    value = json.loads(lwr_run("jog A5 -3 lab.yaml --json"))
    assert value["log"].startswith("steps/jog-")
    assert (tmp_path / value["log"]).is_file()
    assert value["after"][5] - value["before"][5] == pytest.approx(np.radians(-3.0), abs=2e-3)


def test_a_log_too_short_or_always_moving_has_no_pose(day: Day, tmp_path: Path) -> None:
    day.steps().record(tmp_path / "short.mcap", 0.5)
    assert standstills(tmp_path / "short.mcap") == ()
    assert issubclass(RefusedError, LwrError)


def test_an_arm_that_stays_in_command_mode_is_told(
    day: Day, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    leave = day.bench.driver.leave_command

    def halted() -> None:
        raise RobotError("waited 30.0 s for monitor mode")

    monkeypatch.setattr(day.bench.driver, "leave_command", halted)
    with pytest.raises(RobotError, match=r"command mode was not left.*at the pendant"):
        day.steps().hold(tmp_path / "hold.mcap", 1.0)
    leave()


def test_load_data_at_the_controller_are_not_replaced_unasked(day: Day, tmp_path: Path) -> None:
    day.pendant.set_load(0.8, (0.0, 0.0, 0.198))
    day.bench.driver.monitor(20)
    with pytest.raises(RefusedError, match=r"0\.8 kg at .*120\) mm.*by none \(0 kg\).*`--payload none`"):
        day.steps().hold(tmp_path / "no.mcap", 1.0)
    assert day.pendant.status()["load"]["mass"] == pytest.approx(0.8)
    stated = Steps(day.experiment, day.bench, None, empty=True)
    assert "held the pose" in str(stated.hold(tmp_path / "hold.mcap", 1.0))
    assert day.pendant.status()["load"]["mass"] == 0.0
