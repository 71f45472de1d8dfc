"""An extended model is a model like any other: emulated, computed, exported, validated."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest

from fri.errors import ConfigurationError
from ident.formats import standard_model, to_mjcf, to_urdf
from ident.model.dynamic_model import DynamicModel
from ident.model.model_file import read_model, write_model
from lwr_driver.configuration import find
from sim_backend.cabinet import Cabinet
from sim_backend.configuration import EmulatorConfig, load_configuration
from sim_backend.model_arm import Cause, model_effects
from sim_backend.plant import ElasticArm
from sim_backend.robot import chain, robot_file, true_arm, truth

HEALTHY = Path(__file__).parents[2] / "hidden_physics" / "reference.yaml"
HOSE_NM_RAD, PULL_NM = 2.0, 0.7


def entry(
    cause: str, side: str, joints: list[int], form: str | None = None, **values: tuple[float, str]
) -> dict[str, object]:
    parameters = {name: {"value": v, "std": 0.01, "unit": unit} for name, (v, unit) in values.items()}
    named = {} if form is None else {"form": form}
    return {"cause": cause, "side": side, "joints": joints, **named, "parameters": parameters}


HOSE = entry("cable_spring", "joint", [4], stiffness=(HOSE_NM_RAD, "Nm/rad"), form="linear")
FILM = entry("stribeck", "motor", [2], amplitude=(1.5, "Nm"), velocity=(0.05, "rad/s"), exponent=(1.0, "1"))
LOST = entry(
    "payload_change",
    "joint",
    [],
    "jump",
    mass=(-1.0, "kg"),
    moment_x=(0.0, "kg m"),
    moment_y=(0.0, "kg m"),
    moment_z=(-0.1, "kg m"),
    time=(3.0, "s"),
    session=(2.0, "1"),
)


@pytest.fixture(scope="module")
def healthy() -> DynamicModel:
    return read_model(HEALTHY)


def emulated(model: DynamicModel, folder: Path) -> EmulatorConfig:
    path = folder / "model_extended.yaml"
    write_model(model, path)
    return load_configuration(overrides={"robot.parameters": str(path)})


def test_the_emulator_runs_the_model_with_its_effects(healthy: DynamicModel, tmp_path: Path) -> None:
    extended = replace(healthy, effects=(HOSE, FILM))
    with_hose, without = Cabinet(emulated(extended, tmp_path)), Cabinet(emulated(healthy, tmp_path))
    held = [cabinet.plant.joint_torque.copy() for cabinet in (with_hose, without)]
    q = with_hose.plant.position
    hose = extended.torque(*rest(q), side="joint")[0] - healthy.torque(*rest(q), side="joint")[0]
    assert abs(hose[3]) > 1.0
    # At rest the joint's own Coulomb friction may hold a part of it.
    np.testing.assert_allclose(held[0] - held[1], hose, atol=0.6)
    np.testing.assert_allclose(
        held[1],
        healthy.gravity(q[None])[0] + healthy.drive()["offl"],
        atol=1.2 * healthy.drive()["Fcl"].max(),
    )


def rest(q: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    return q[None], np.zeros((1, len(q))), np.zeros((1, len(q)))


def test_the_emulated_arm_has_the_torque_of_the_model(healthy: DynamicModel, tmp_path: Path) -> None:
    values = truth(emulated(healthy, tmp_path))
    assert healthy.base is not None
    standard = np.array([values.get(name, 0.0) for name in healthy.structure.names])
    reduced = dict(zip(healthy.base.names, healthy.base.reduce(standard), strict=True))
    for name in ("MY2R", "ZZ2R", "Ia1", "Fvm3", "XX4R"):
        # The emulated bodies are the nearest possible ones.
        assert reduced[name] == pytest.approx(healthy.value(name), rel=1e-2)


def test_what_belongs_to_a_moment_acts_in_its_session_only(healthy: DynamicModel) -> None:
    model = replace(healthy, effects=(LOST, HOSE))
    assert len(model_effects(model)) == 1
    assert len(model_effects(model, session=0)) == 1
    assert len(model_effects(model, session=1)) == 2


def test_a_tilted_base_leans_once_however_often_it_is_simulated(healthy: DynamicModel) -> None:
    lean = entry("base_tilt", "joint", [], tilt_x=(0.02, "rad"), tilt_y=(-0.01, "rad"))
    extended = replace(healthy, effects=(lean,))
    links = pin.Model(chain(find("lwr4plus.urdf")))
    upright = np.array(links.gravity.linear)
    drive = true_arm(load_configuration(), robot_file(load_configuration()))[1]
    for _ in range(2):
        # A replay begins before the session does, so its effects see time zero for a while.
        arm = ElasticArm(links, drive, effects=model_effects(extended, begin_s=-0.01))
        for _ in range(20):
            arm.step(np.zeros(7))
        leaning = np.array(arm.model.gravity.linear)
        np.testing.assert_allclose(leaning, upright - np.cross([0.02, -0.01, 0.0], upright), atol=1e-12)
    np.testing.assert_array_equal(links.gravity.linear, upright)


def test_a_hidden_cause_needs_the_parameters_of_its_form_only() -> None:
    Cause("cable_spring", {"stiffness": 1.0}, joint=4, form="linear")
    with pytest.raises(ConfigurationError, match="needs `slack`"):
        Cause("cable_spring", {"stiffness": 1.0}, joint=4, form="play")
    with pytest.raises(ConfigurationError, match="has no parameter 'length'"):
        Cause("cable_spring", {"stiffness": 1.0, "length": 1.0}, joint=4, form="linear")


def test_a_model_of_another_arm_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "table.yaml"
    path.write_text("chain: {}\n")
    with pytest.raises(ConfigurationError, match="schema_version"):
        Cabinet(load_configuration(overrides={"robot.parameters": str(path)}))


def test_computed_torque_has_the_effects(healthy: DynamicModel) -> None:
    bare, extended = (replace(healthy, effects=effects) for effects in ((), (HOSE, FILM)))
    q, qd, qdd = np.random.default_rng(2).normal(size=(3, 50, 7)) * 0.3
    change = {
        side: extended.torque(q, qd, qdd, side=side) - bare.torque(q, qd, qdd, side=side)
        for side in ("motor", "joint")
    }
    film = 1.5 * np.sign(qd[:, 1]) * np.exp(-np.abs(qd[:, 1]) / 0.05)
    np.testing.assert_allclose(change["motor"][:, 1], film, atol=1e-12)
    np.testing.assert_allclose(change["joint"][:, 1], 0.0, atol=1e-12)
    np.testing.assert_allclose(change["motor"][:, 3], change["joint"][:, 3], atol=1e-12)
    assert np.corrcoef(change["joint"][:, 3], q[:, 3])[0, 1] > 0.99


def test_a_description_of_the_arm_says_what_it_cannot_carry(healthy: DynamicModel) -> None:
    extended = replace(healthy, effects=(HOSE, FILM))
    bodies = standard_model(extended, consistent=True)
    for text in (to_urdf(bodies), to_mjcf(bodies, name="arm")):
        words = " ".join(text.replace("*", " ").replace("#", " ").split())
        assert "Effects of the model missing in this file: cable_spring (A3), stribeck (A2)." in words


def test_parameters_of_effects_keep_their_intervals_in_the_file(
    healthy: DynamicModel, tmp_path: Path
) -> None:
    path = tmp_path / "model.yaml"
    write_model(replace(healthy, effects=(HOSE,)), path)
    again = read_model(path)
    assert again.effects[0]["parameters"]["stiffness"]["std"] == 0.01
    assert again.std is not None
    assert np.all(again.std > 0.0)
