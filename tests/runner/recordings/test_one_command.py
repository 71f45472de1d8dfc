"""From a stranger's recording to a model in one command, and bags without a question."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from click.testing import CliRunner, Result
from mcap_ros2.writer import Writer

from fri.errors import ConfigurationError, DataError
from ident.dynamics.kinematics import Chain
from ident.model.model_file import read_model
from lwr_driver.session import read_session
from lwr_driver.session.messages import JOINT_STATE
from runner.cli import main
from runner.estimation import announced
from runner.recordings import read_recordings
from tests.ident.stock_panda import JOINTS, stock_panda

RATE, SECONDS = 100.0, 16.0
TIMES = np.arange(int(RATE * SECONDS)) / RATE


def motion(seed: int) -> np.ndarray:
    """Positions, velocities, torques (3, n, 7) of a motion that excites every joint."""
    random = np.random.default_rng(seed)
    q, qd, qdd = np.zeros((3, len(TIMES), 7))
    for k in range(1, 5):
        w = 2 * np.pi * 0.12 * k
        a, b = random.normal(size=(2, 7)) * 0.35
        q += a * np.sin(w * TIMES[:, None]) + b * np.cos(w * TIMES[:, None])
        qd += w * (a * np.cos(w * TIMES[:, None]) - b * np.sin(w * TIMES[:, None]))
        qdd -= w**2 * (a * np.sin(w * TIMES[:, None]) + b * np.cos(w * TIMES[:, None]))
    chain = Chain.from_urdf(stock_panda(), joints=JOINTS)
    model = chain.to_pinocchio(chain.urdf_inertials())
    data = model.createData()
    tau = np.array([pin.rnea(model, data, *state) for state in zip(q, qd, qdd, strict=True)])
    tau += 0.5 * np.sign(qd) + random.normal(size=tau.shape) * 0.02
    return np.array([q, qd, tau])


@pytest.fixture(scope="module")
def lab(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two recordings as CSV and as bag, and the arm's URDF with hand, head and floating root."""
    folder = tmp_path_factory.mktemp("lab")
    (folder / "arm.urdf").write_text(stock_panda(floating=True, head=True))
    for name, seed in (("one", 1), ("two", 2)):
        q, qd, tau = motion(seed)
        head = ",".join(["t", *(f"{word}{k}" for word in ("q", "dq", "tau") for k in range(1, 8))])
        table = np.column_stack([TIMES - 0.007, q, qd, tau])
        np.savetxt(folder / f"{name}.csv", table, fmt="%.10g", delimiter=",", header=head, comments="")
        write_bag(folder / f"{name}.mcap", q, tau)
    return folder


def write_bag(path: Path, q: np.ndarray, tau: np.ndarray) -> None:
    """A bag with the fingers in the same messages, their efforts missing, joints sorted by name."""
    names = ["panda_finger_joint1", "panda_finger_joint2", *JOINTS]
    with path.open("wb") as file:
        writer = Writer(file)
        state = writer.register_msgdef(JOINT_STATE.name, JOINT_STATE.text)
        for k, time in enumerate(TIMES):
            stamp = round((1.7e9 + time) * 1e9)
            content = {
                "header": {"stamp": {"sec": stamp // 10**9, "nanosec": stamp % 10**9}, "frame_id": ""},
                "name": names,
                "position": [0.04, 0.04, *q[k]],
                "velocity": [],
                "effort": [float("nan"), 0.0, *tau[k]],
            }
            writer.write_message("/joint_states", state, content, log_time=stamp + 10**5, publish_time=stamp)
        writer.finish()


def run(*words: Any) -> Result:
    result = CliRunner().invoke(main, [str(word) for word in words])
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    return result


def error_of(model: Path) -> float:
    """Error of the torque on the second motion, relative to its rms."""
    q, qd, tau = motion(2)
    qdd = np.gradient(qd, 1.0 / RATE, axis=0)
    error = read_model(model).torque(q, qd, qdd, side="joint") - tau
    return float(np.linalg.norm(error) / np.linalg.norm(tau))


@pytest.fixture(scope="module")
def first(lab: Path) -> Result:
    words = (lab / "one.csv", "--urdf", lab / "arm.urdf", "--yes", "--json")
    return run("identify", *words, "--results", lab / "first", "--test", lab / "two.csv")


def test_one_command_from_a_table_to_a_report(first: Result, lab: Path) -> None:
    assert first.exit_code == 0, first.output
    assert json.loads(first.stdout)["model"] == 1
    assert "the clock begins at -0.007 s; all times moved by 0.007 s" in first.stderr
    assert {path.name for path in (lab / "first").iterdir()} >= {
        "model.yaml", "summary.json", "report.html", "one.mapping.yaml", "one.mcap", "two.mcap",
    }  # fmt: skip
    assert read_model(lab / "first/model.yaml").structure.chain.joint_names == JOINTS
    assert error_of(lab / "first/model.yaml") < 0.1


def test_a_payload_is_named_by_the_file_as_typed_or_as_imported(first: Result, lab: Path) -> None:
    logs = [read_session(lab / f"first/{name}.mcap", status=False) for name in ("one", "two")]
    typed = (lab / "one.csv", lab / "two.csv")
    for name in ("two.csv", lab / "two.csv", "two.mcap", lab / "first/two.mcap"):
        found = announced(logs, [f"{name}=block:1.5"], typed)
        assert [log.metadata.get("payload") for log in found] == [logs[0].metadata.get("payload"), "block"]
        assert found[1].metadata["payload_mass"] == "1.5"
    with pytest.raises(ConfigurationError, match=r"with one of the files one\.csv, two\.csv"):
        announced(logs, ["three.csv=block"], typed)
    with pytest.raises(ConfigurationError, match=r"with one of the files one\.mcap, two\.mcap"):
        announced(logs, ["two.csv=block"])
    for mass in ("0", "-1", "nan", "inf"):
        with pytest.raises(ConfigurationError, match="is no mass in kg; give a positive number"):
            announced(logs, [f"two.mcap=block:{mass}"])


def test_the_written_mapping_repeats_the_import(first: Result, lab: Path) -> None:
    assert first.exit_code == 0
    again = run("import", lab / "first/one.mapping.yaml", lab / "one.csv", lab / "again.mcap")
    assert again.exit_code == 0, again.output
    assert (
        read_session(lab / "again.mcap").metadata["uid"]
        == read_session(lab / "first/one.mcap").metadata["uid"]
    )


def test_without_a_terminal_the_guess_is_shown_and_not_taken(lab: Path, tmp_path: Path) -> None:
    result = run("identify", lab / "one.csv", "--urdf", lab / "arm.urdf", "--out", tmp_path / "model.yaml")
    assert result.exit_code == 2
    for part in (
        "confirmed at a terminal or with --yes",
        "q1 ... q7",
        "position:\n  unit: rad",
        "`lwr-run import`",
    ):
        assert part in result.output
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(("answer", "code"), [("y", 0), ("n", 2)])
def test_at_a_terminal_the_guess_is_asked_for(
    answer: str, code: int, lab: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("runner.recordings.at_terminal", lambda: True)
    words = ["identify", lab / "one.csv", "--urdf", lab / "arm.urdf", "--out", tmp_path / "model.yaml"]
    result = CliRunner().invoke(main, list(map(str, words)), input=answer)
    assert result.exit_code == code, result.output
    assert "Is this right?" in result.output
    assert (tmp_path / "model.yaml").exists() == (code == 0)


def test_a_table_without_a_urdf_or_beside_foreign_files_is_refused(lab: Path, tmp_path: Path) -> None:
    assert "name the arm's URDF with --urdf" in run("identify", lab / "one.csv", "--yes").output
    (tmp_path / "one.mapping.yaml").write_text("robot: mine\n")
    words = (
        "identify",
        lab / "one.csv",
        "--urdf",
        lab / "arm.urdf",
        "--yes",
        "--out",
        tmp_path / "model.yaml",
    )
    assert "exists and was not guessed" in run(*words).output
    (tmp_path / "one.mapping.yaml").unlink()
    (tmp_path / "one.mcap").write_bytes(b"precious")
    assert "exists and is no import" in run(*words).output
    assert (tmp_path / "one.mcap").read_bytes() == b"precious"


def test_bags_are_read_as_they_are(first: Result, lab: Path) -> None:
    model = lab / "bag.yaml"
    done = run("identify", lab / "one.mcap", "--urdf", lab / "arm.urdf", "--out", model)
    assert done.exit_code == 0, done.output
    assert read_model(model).structure.chain.joint_names == JOINTS
    scored = run("validate", model, lab / "two.mcap", "--json")
    assert scored.exit_code == 0, scored.output
    assert error_of(model) < 0.1


def test_the_effort_of_a_bag_may_be_the_motors(lab: Path) -> None:
    done = run("identify", lab / "one.mcap", "--urdf", lab / "arm.urdf", "--torque", "motor", "--json")
    assert done.exit_code == 0, done.output
    assert json.loads(done.stdout)["model"] == 2
    refused = run("identify", lab / "one.mcap", "--urdf", lab / "arm.urdf", "--rate-hz", "100")
    assert "names its joints and quantities" in refused.output


def test_two_bags_of_one_arm_and_the_joints_of_a_bag(lab: Path) -> None:
    words = ("identify", lab / "one.mcap", lab / "two.mcap", "--urdf", lab / "arm.urdf", "--model", "1")
    done = run(*words, "--joints", ",".join(JOINTS), "--out", lab / "both.yaml")
    assert done.exit_code == 0, done.output
    assert read_model(lab / "both.yaml").structure.chain.joint_names == JOINTS
    refused = run(*words, "--joints", ",".join(JOINTS[:6]))
    assert "panda_joint7 moves by" in refused.output
    assert "name it in --joints" in refused.output


def test_the_joints_of_a_session_log_are_those_of_its_import(first: Result, lab: Path) -> None:
    refused = run("identify", lab / "first" / "one.mcap", "--joints", ",".join(JOINTS))
    assert "were chosen at its import" in refused.output


def test_a_folder_with_a_split_bag_is_one_recording(lab: Path, tmp_path: Path) -> None:
    from ident.import_log import read_recording

    folder = tmp_path / "bag"
    folder.mkdir()
    q, _, tau = motion(1)
    write_bag(folder / "bag_0.mcap", q, tau)
    session = read_recording(folder)
    whole = read_recording(lab / "one.mcap")
    np.testing.assert_array_equal(session.joint.effort, whole.joint.effort)
    assert (session.path, session.joint_names) == (folder, ("panda_finger_joint2", *JOINTS))
    assert np.ptp(np.diff(whole.joint.log_time)) < 1000


def test_a_second_table_with_other_names_gets_a_mapping_of_its_own(lab: Path, tmp_path: Path) -> None:
    head, _, rows = (lab / "two.csv").read_text().partition("\n")
    other = tmp_path / "other.csv"
    other.write_text(head.replace("dq", "vel_").replace("q", "pos_").replace("tau", "effort_") + "\n" + rows)
    words = {"urdf": lab / "arm.urdf", "folder": tmp_path, "yes": True}
    logs = read_recordings((lab / "one.csv", other), **words)
    same = read_recordings((lab / "two.csv",), **words)[0]
    np.testing.assert_array_equal(logs[1].joint.effort, same.joint.effort)
    assert "pos_1" in (tmp_path / "other.mapping.yaml").read_text()
    other.write_text(head.replace("tau", "x") + "\n" + rows)
    with pytest.raises(DataError, match="no column 'tau1'"):
        read_recordings((lab / "one.csv", other), **words)
