"""A replay along the measured positions compares models, whatever the controller of the arm."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ident.diagnosis import Reference, SimulationError
from ident.model.dynamic_model import DynamicModel
from ident.model.model_file import read_model
from lwr_driver.arm import Arm
from lwr_driver.session import Session, read_session
from runner.diagnosis.study import _stiffness
from runner.replay import METHOD, Replay
from tests.hidden_physics.engine import REFERENCE
from tests.hidden_physics.motions import exciting_motion
from tests.hidden_physics.recording import Order, record
from tests.ident.real.real_lwr4 import identified, joint_rms, needs_recordings, session

HOSE_NM_RAD, FILM_NM, FILM_RAD_S = 4.0, 4.0, 0.08
SECONDS = 8.0
# A third of the feedback, half of the friction compensation.
SOFT = {
    "controller.position_gain": [3e3, 3e3, 2e3, 2e3, 1e3, 700.0, 700.0],
    "controller.velocity_gain": [120.0, 120.0, 120.0, 120.0, 30.0, 20.0, 20.0],
    "controller.coulomb": [7.0, 8.0, 4.0, 5.0, 2.5, 2.0, 2.0],
    "controller.torque_gain": [0.2] * 7,
}


def hidden() -> list[dict[str, Any]]:
    return [
        {
            "type": "sim_backend.model_arm:Cause",
            "options": {
                "cause": entry["cause"],
                "joint": entry["joints"][0],
                "form": entry.get("form"),
                "parameters": {name: value["value"] for name, value in entry["parameters"].items()},
            },
        }
        for entry in EFFECTS
    ]


def numbers(**values: float) -> dict[str, Any]:
    return {name: {"value": value, "std": 0.01, "unit": "1"} for name, value in values.items()}


EFFECTS: tuple[dict[str, Any], ...] = (
    {
        "cause": "cable_spring",
        "side": "joint",
        "joints": [4],
        "form": "linear",
        "parameters": numbers(stiffness=HOSE_NM_RAD),
    },
    {
        "cause": "stribeck",
        "side": "motor",
        "joints": [2],
        "parameters": numbers(amplitude=FILM_NM, velocity=FILM_RAD_S, exponent=1.0),
    },
)


@pytest.fixture(scope="module")
def sessions(tmp_path_factory: pytest.TempPathFactory) -> Mapping[str, Session]:
    folder = tmp_path_factory.mktemp("replayed")

    def recorded(name: str, controller: Mapping[str, Any]) -> Session:
        settings = {**controller, "robot.effects": hidden()}
        return read_session(record(Order(exciting_motion("A1"), folder / f"{name}.mcap", settings, uid=name)))

    return {name: recorded(name, settings) for name, settings in (("nominal", {}), ("soft", SOFT))}


@pytest.fixture(scope="module")
def models() -> tuple[DynamicModel, DynamicModel]:
    base = replace(read_model(REFERENCE), effects=())
    return base, replace(base, effects=EFFECTS)


def errors(models: tuple[DynamicModel, DynamicModel], session: Session) -> tuple[SimulationError, ...]:
    follower = Replay(Arm.load().stiffness, [session], longest_s=SECONDS)
    found = tuple(follower(model, [session]) for model in models)
    assert all(one is not None for one in found)
    return found  # type: ignore[return-value]


def of(error: SimulationError, quantity: str) -> np.ndarray:
    values = getattr(error, quantity)
    assert values is not None
    return np.asarray(values)


def test_another_tuning_of_the_controller_leaves_the_errors_of_both_models(
    models: tuple[DynamicModel, DynamicModel], sessions: Mapping[str, Session]
) -> None:
    nominal, soft = (errors(models, sessions[name]) for name in ("nominal", "soft"))
    for one, other in zip(nominal, soft, strict=True):
        np.testing.assert_allclose(of(one, "motor"), of(other, "motor"), rtol=0.2)
        # At the wrist 0.1 mrad is 0.02 Nm, far below the noise of its motor torque.
        np.testing.assert_allclose(of(one, "position"), of(other, "position"), rtol=0.2, atol=1e-4)
        # The links ring more behind a softer controller.
        np.testing.assert_allclose(of(one, "joint"), of(other, "joint"), rtol=0.5, atol=0.1)


@pytest.mark.parametrize("controller", ["nominal", "soft"])
def test_the_gain_is_that_of_the_missing_physics(
    models: tuple[DynamicModel, DynamicModel], sessions: Mapping[str, Session], controller: str
) -> None:
    base, extended = errors(models, sessions[controller])
    # The hose of A3, and the film of A2 in the motor torque alone.
    for quantity in ("motor", "joint", "position"):
        assert of(extended, quantity)[3] < 0.3 * of(base, quantity)[3]
    assert of(extended, "motor")[1] < 0.8 * of(base, "motor")[1]
    assert of(extended, "position")[1] < 0.5 * of(base, "position")[1]
    others = [0, 2, 4, 5, 6]
    # Of a position some steps of the encoder, 6 urad each.
    for quantity, steps in (("motor", 0.0), ("joint", 0.0), ("position", 2e-5)):
        np.testing.assert_allclose(
            of(base, quantity)[others], of(extended, quantity)[others], rtol=0.05, atol=steps
        )


def test_without_motor_torques_there_is_no_simulated_position(
    models: tuple[DynamicModel, DynamicModel], sessions: Mapping[str, Session]
) -> None:
    session = replace(sessions["nominal"], motor=None, command=None)
    follower = Replay(None, [session], longest_s=2.0)
    error = follower(models[0], [session])
    assert error is not None
    assert error.position is None
    assert error.motor is None
    assert error.to_dict()["joint"] is not None
    assert error.method == METHOD
    told = " ".join(follower.notes)
    assert "no simulated position" in told
    assert "stiffness of the joints is unknown" in told


def test_a_rigid_joint_among_elastic_ones_is_a_stiff_spring(
    models: tuple[DynamicModel, DynamicModel], sessions: Mapping[str, Session]
) -> None:
    session, springs = sessions["nominal"], Arm.load().stiffness
    mixed = np.where(np.arange(len(springs)) < 3, springs, np.inf)
    runs = [
        Replay(chosen, [session], longest_s=2.0) for chosen in (mixed, np.full(len(springs), np.inf), None)
    ]
    left = [of(error, "motor") for run in runs if (error := run(models[0], [session])) is not None]
    np.testing.assert_array_equal(left[1], left[2])
    assert np.isfinite(left[0]).all()
    assert not np.array_equal(left[0], left[1])


def test_a_reference_with_a_rigid_joint_gives_the_springs_of_the_others() -> None:
    healthy = replace(Reference.of(read_model(REFERENCE)), compliance=np.array([1e-4, 0.0]))
    np.testing.assert_allclose(_stiffness(Arm.load(), healthy), [1e4, np.inf])


def test_published_motor_positions_are_led_to_the_same_torques(
    models: tuple[DynamicModel, DynamicModel], tmp_path: Path
) -> None:
    settings = {"sensors.position_sensor": "motor", "robot.effects": hidden()}
    log = record(Order(exciting_motion("A1"), tmp_path / "motor.mcap", settings, uid="motor"))
    session = read_session(log)
    follower = Replay(Arm.load().stiffness, [session], longest_s=SECONDS, encoder="motor")
    base, extended = (follower(model, [session]) for model in models)
    assert base is not None
    assert extended is not None
    assert np.all(of(extended, "motor") < 1.0)
    assert of(extended, "joint")[3] < 0.3 * of(base, "joint")[3]


@pytest.mark.slow
@needs_recordings
def test_a_real_arm_is_replayed_to_the_error_of_its_model() -> None:
    found, run = identified((1, 2), "physical"), session(3)
    error = Replay(Arm.load().stiffness, [run])(found.model, [run])
    assert error is not None
    assert error.position is None
    assert np.all(of(error, "joint") < 2.5 * joint_rms(found, 3) + 0.1)


def test_of_many_sessions_shorter_parts_are_simulated_and_of_very_many_some(
    models: tuple[DynamicModel, DynamicModel], sessions: Mapping[str, Session]
) -> None:
    base, session = models[0], sessions["nominal"]
    follower = Replay(Arm.load().stiffness, [session], longest_s=12.0, together_s=20.0)
    assert follower(base, [session]) is not None
    assert follower.notes == ()
    assert follower(base, [session] * 5) is not None
    assert follower.notes == ("replay of at most the first 10 s of 2 of 5 sessions, for time",)
    assert follower.first[-1][1].duration_s <= 10.0
