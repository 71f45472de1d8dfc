"""The files of an experiment: all read first, frozen, checked on resumption; a folder belongs to one process."""

from __future__ import annotations

import shutil
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from fri.errors import ConfigurationError, DataError, LwrError, RefusedError
from lwr_driver.configuration import CONFIGS
from lwr_driver.references import Frozen
from runner.experiment import ExperimentProgress
from runner.experiment_file import Experiment
from runner.files import begin, check_finished, examine, gather, go_on, listed, locked
from runner.preflight import Rest, check_gravity_change, gravity_of_load, gravity_torque
from tests.lwr_driver.driver_rig import arm
from tests.lwr_driver.session.session_samples import write_session
from tests.runner.experiment.experiment_rig import experiment_file, run
from tests.runner.experiment.stand import HOME, LOAD


@pytest.fixture
def file(tmp_path: Path) -> Path:
    """An experiment file with an arm and a cell of its own beside it."""
    (tmp_path / "lab").mkdir()
    for name in ("lwr4plus.yaml", "lwr4plus.urdf", "cell.yaml"):
        shutil.copy(CONFIGS / name, tmp_path / "lab" / name)
    return experiment_file(tmp_path / "lab", backend="emulator")


def begun(file: Path) -> Path:
    """A folder of results of this experiment file."""
    folder = file.parents[1] / "results"
    folder.mkdir()
    experiment = Experiment.load(file)
    begin(experiment, gather(experiment), folder)
    return folder


def test_every_file_is_listed_with_its_path_and_hash(file: Path) -> None:
    files = examine(Experiment.load(file))
    lab = {one.path.name for one in files if one.path.parent == file.parent}
    assert lab == {"short.yaml", "lwr4plus.yaml", "lwr4plus.urdf", "cell.yaml"}
    assert {"default.yaml", "table2.yaml"} <= {one.path.name for one in files}
    text = listed(files)
    assert all(f"{one.sha256}  {one.path}" in text for one in files)


def test_the_working_directory_lends_nothing(
    file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (file.parent / "cell.yaml").write_text(
        "boxes: [{name: wall, size_m: [2, 0.1, 2], centre_m: [0, 0.3, 0.9]}]\n"
    )
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    (elsewhere / "cell.yaml").write_text("ground_z_m: null\n")
    monkeypatch.chdir(elsewhere)
    done = run("check", str(file))
    assert "to wall" in done.text
    assert f"  {file.parent / 'cell.yaml'}\n" in done.text


def test_a_resumption_reads_the_frozen_files(file: Path) -> None:
    folder = begun(file)
    cell = file.parent / "cell.yaml"
    cell.write_text("name: moved\n")
    experiment, remarks = go_on(folder)
    assert experiment.source.is_relative_to(folder)
    assert [remark.split(" changed")[0] for remark in remarks] == [str(cell)]
    shutil.rmtree(file.parent)
    assert go_on(folder)[1] == []


def test_a_resumption_refuses_what_changed(file: Path) -> None:
    folder = begun(file)
    for path in (folder / "experiment.yaml", *(folder / "files/lab").iterdir()):
        text = path.read_text()
        path.write_text(text + "\n")
        with pytest.raises(ConfigurationError, match="changed since the start"):
            go_on(folder)
        path.write_text(text)
    go_on(folder)


def test_a_real_arm_does_not_go_on_beside_edited_originals(file: Path) -> None:
    file.write_text(file.read_text().replace("backend: emulator", "backend: fri\nlock_step: false"))
    folder = begun(file)
    (file.parent / "cell.yaml").write_text("name: moved\n")
    with pytest.raises(ConfigurationError, match=r"cell\.yaml changed .* surroundings may have"):
        go_on(folder)


def test_a_folder_of_an_earlier_version_is_not_gone_on_with(tmp_path: Path) -> None:
    (tmp_path / "experiment.yaml").write_text("name: old\n")
    with pytest.raises(ConfigurationError, match="holds no frozen files"):
        go_on(tmp_path)


def test_a_folder_belongs_to_one_process_until_its_end(tmp_path: Path) -> None:
    code = "import sys, time; from pathlib import Path; from runner.files import locked\n"
    code += "with locked(Path(sys.argv[1])):\n    print('held', flush=True); time.sleep(60)"
    with subprocess.Popen([sys.executable, "-c", code, str(tmp_path)], stdout=subprocess.PIPE) as other:
        assert other.stdout is not None
        other.stdout.readline()
        with pytest.raises(RefusedError, match=f"in use by process {other.pid}"), locked(tmp_path):
            pass
        other.send_signal(signal.SIGKILL)
        other.wait()
        with locked(tmp_path), pytest.raises(RefusedError), locked(tmp_path):
            pass


def test_recordings_by_one_file_have_uids_of_their_own() -> None:
    experiment = Experiment("short")
    assert experiment.session_uid("unloaded") == experiment.session_uid("unloaded")
    seeded = experiment.changed(emulator_settings={"seed": 7})
    clocked = experiment.changed(lock_step=False)
    others = [seeded, clocked, clocked]
    assert len({one.session_uid("unloaded") for one in (experiment, *others)}) == 4


@pytest.mark.parametrize("change", ["none", "empty", "cut", "other", "short"])
def test_finished_logs_are_whole_and_of_this_experiment(tmp_path: Path, change: str) -> None:
    experiment = Experiment("short")
    progress = ExperimentProgress.create(tmp_path, tmp_path)
    log = tmp_path / "unloaded.mcap"
    uid, _ = progress.begin("unloaded", log, experiment.uid)
    told = {
        "robot": "LWR4+",
        "experiment": "short",
        "payload": "none",
        "uid": "x" if change == "other" else uid,
    }
    write_session(log, 300, metadata=told)
    progress.finish("unloaded", Rest(HOME, HOME, None), 400 if change == "short" else 300)
    data = log.read_bytes()
    if change in ("empty", "cut"):
        log.write_bytes(data[: 0 if change == "empty" else -50])
    if change == "none":
        check_finished(experiment, tmp_path)
        return
    with pytest.raises(DataError, match=r"finished session unloaded.*to drive session unloaded again"):
        check_finished(experiment, tmp_path)


def test_a_plan_with_reversed_joints_is_refused_on_resumption_too(file: Path) -> None:
    from ident.excitation import ExcitationPlan
    from runner.planning import stored_plan

    folder = begun(file)
    plan = ExcitationPlan.load(CONFIGS / "plans/default.plan.yaml")
    text = plan.to_yaml().replace("- A1\n- A2\n", "- A2\n- A1\n", 1)
    (folder / "plan.yaml").write_text(text)
    assert stored_plan(folder, "plan.yaml", arm()) is None
    Frozen(folder).keep("plan.yaml")
    with pytest.raises(ConfigurationError, match=r"joint_names A2, A1, E1, .* are not those of"):
        stored_plan(folder, "plan.yaml", arm())


def test_load_data_in_force_show_in_the_gravity_torques() -> None:
    bare, com = (0.0, (0.0, 0.0, 0.0)), (0.0, -0.066, 0.066)
    before, after = (gravity_of_load(arm(), HOME, *load) for load in (bare, (3.34, com)))
    assert after == pytest.approx(gravity_torque(arm(), HOME, LOAD), abs=1e-9)
    for sign in (1.0, -1.0):
        said = check_gravity_change(arm(), HOME, (sign * before, sign * after), (bare, (3.34, com)))
        assert said.startswith("load data in force")
    with pytest.raises(
        LwrError, match=r"A3 in the controller changed by \+0.00 Nm, expected .* nothing moved"
    ):
        check_gravity_change(arm(), HOME, (before, before), (bare, (3.34, com)))


def test_a_real_arm_of_another_name_keeps_the_limits_of_the_lwr4(file: Path) -> None:
    lab = file.parent
    text, urdf = (lab / "lwr4plus.yaml").read_text(), (lab / "lwr4plus.urdf").read_text()
    for name in arm().joint_names:
        text = text.replace(f"name: {name},", f"name: J{name},")
        urdf = urdf.replace(f'<joint name="{name}"', f'<joint name="J{name}"')
    text = text.replace("acceleration_rad_s2: 8.0", "acceleration_rad_s2: 20.0")
    (lab / "lwr4plus.yaml").write_text(f"{text}\nmodel: my arm\n")
    (lab / "lwr4plus.urdf").write_text(urdf)
    assert examine(Experiment.load(file))  # as an emulated arm it may
    real = experiment_file(lab, backend="fri", lock_step=False, emulator_settings={})
    with pytest.raises(ConfigurationError, match=r"JA1: acceleration_rad_s2 20 rad/s² is beyond 8"):
        examine(Experiment.load(real))
