"""The watch of torque and contact in an experiment."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from fri.errors import ConfigurationError
from ident.dynamics.kinematics import Chain
from ident.dynamics.structure import ModelStructure
from ident.model import DynamicModel
from ident.model.model_file import write_model
from lwr_driver.arm import Arm
from lwr_driver.contact import ContactWatch
from lwr_driver.session import read_session
from runner.contact import ContactPlan, expected_arm
from runner.experiment_file import Experiment
from runner.files import begin, gather
from sim_backend.robot import truth
from tests.lwr_driver.contact_rig import follow, swing
from tests.runner.experiment.experiment_rig import experiment_file, run


def true_model() -> DynamicModel:
    structure = ModelStructure(Chain.from_urdf(Arm.load().urdf), 2)
    values = truth("emulator/default.yaml")
    return DynamicModel(
        "LWR4+", structure, structure.names, np.array([values.get(name, 0.0) for name in structure.names])
    )


def test_an_experiment_file_lowers_the_limits_and_raises_none(tmp_path: Path) -> None:
    low = [10.0, 10.0, 5.0, 5.0, 5.0, 2.0, 2.0]
    file = experiment_file(tmp_path, contact={"external_nm": low, "torque_share": 0.5})
    experiment = Experiment.load(file)
    assert experiment.contact == ContactPlan(0.5, tuple(low))  # type: ignore[arg-type]
    file = experiment_file(tmp_path, contact={"external_nm": [*low[:6], 4.0]})
    with pytest.raises(
        ConfigurationError, match=r"short\.yaml:\d+: `contact`: external_nm of joint 7 is 4\.0 Nm.*lowered"
    ):
        Experiment.load(file)


def test_the_model_of_the_watch_is_frozen_with_the_experiment(tmp_path: Path) -> None:
    write_model(true_model(), tmp_path / "model.yaml")
    experiment = Experiment.load(experiment_file(tmp_path, contact={"model": "model.yaml"}))
    (tmp_path / "results").mkdir()
    frozen = begin(experiment, gather(experiment), tmp_path / "results")
    (tmp_path / "model.yaml").unlink()
    assert expected_arm(frozen.contact, Arm.load(), frozen.folder).coulomb[1] == pytest.approx(0.41)
    with pytest.raises(ConfigurationError, match=r"'model\.yaml' not found"):
        gather(experiment)


def test_an_identified_model_expects_more_than_the_nominal_arm(tmp_path: Path) -> None:
    arm, model = Arm.load(), true_model()
    write_model(model, tmp_path / "model.yaml")
    expected = expected_arm(ContactPlan(model="model.yaml"), arm, tmp_path)
    assert expected.coulomb[1] == pytest.approx(0.41)
    q, qd, qdd = swing(1e-3)
    tau = model.torque(q, qd, qdd, side="joint")
    left = {}
    for name, one in (("own", expected), ("nominal", expected_arm(ContactPlan(), arm, tmp_path))):
        watch = ContactWatch(one, ContactPlan(), arm.tau_max)
        found, external = follow(watch, q, tau)
        assert not any(found)
        left[name] = float(np.sqrt(np.mean(external[200:] ** 2)))
    assert left["own"] < 0.5 * left["nominal"]


def test_a_model_without_joint_torques_is_refused(tmp_path: Path) -> None:
    structure = ModelStructure(Chain.from_urdf(Arm.load().urdf), 3)
    if "joint" in structure.sides:
        pytest.skip("every model has joint torques")
    write_model(
        DynamicModel("LWR4+", structure, structure.names, np.zeros(len(structure.names))),
        tmp_path / "model.yaml",
    )
    with pytest.raises(ConfigurationError, match="a model of the joint torques"):
        expected_arm(ContactPlan(model="model.yaml"), Arm.load(), tmp_path)


def test_a_push_ends_the_session_with_status_reason_and_log(tmp_path: Path) -> None:
    hand = {
        "command": "push",
        "when": "moving",
        "after_cycles": 60,
        "arguments": {"torque": [0.0, 30.0, 0.0, 0.0, 0.0, 0.0, 0.0]},
    }
    file = experiment_file(tmp_path, emulator_settings={"fri.period_ms": 5, "schedule": [hand]})
    done = run("experiment", str(file), "--yes", "--out", str(tmp_path / "out"))
    assert done.code == 5, done.text
    assert "session unloaded: contact: A2 external torque by the model" in done.text
    session = read_session(tmp_path / "out" / "unloaded.mcap")
    assert session.end is not None
    assert session.end["exit_status"] == "fail"
    assert session.end["reason"].startswith("contact: A2")
    assert "contact" in [phase.name for phase in session.phases]
