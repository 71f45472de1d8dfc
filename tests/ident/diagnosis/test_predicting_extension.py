"""An extended model never predicts held-out sessions worse than the base model, as `validate` measures it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from ident.diagnosis import Diagnosis, diagnose
from ident.diagnosis.gain.evidence import Evidence
from ident.diagnosis.outcome.torque_errors import TorqueErrors
from ident.dynamics.kinematics import Chain
from ident.estimation.validate import validate
from ident.model import DynamicModel
from ident.model.model_file import write_model
from lwr_driver.session import Session

Make = Callable[..., Session]


def springs(s: dict) -> None:
    """Hoses at joints 2 and 3, in both torques."""
    for joint, stiffness in ((1, 1.5), (2, 1.2)):
        for side in ("motor", "joint"):
            s[side][:, joint] += stiffness * s["q"][:, joint]


@pytest.fixture(scope="module")
def logs(make: Make) -> tuple[list[Session], Session]:
    return [make("a.mcap", 1, springs), make("b.mcap", 2, springs, 1)], make("c.mcap", 5, springs, 2)


def found(logs: tuple[list[Session], Session], chain: Chain) -> Diagnosis:
    return diagnose(logs[0], chain, test=[logs[1]], causes=["cable_spring"])


@pytest.fixture(scope="module")
def told(logs: tuple[list[Session], Session], chain: Chain) -> Diagnosis:
    return found(logs, chain)


def test_the_torque_errors_are_those_of_validate(
    logs: tuple[list[Session], Session], told: Diagnosis
) -> None:
    assert {f.joints for f in told.claims} == {(2,), (3,)}
    extended, base = (TorqueErrors.of(model, [logs[1]]) for model in (told.extended_model, told.base_model))
    for model, own in ((told.extended_model, extended), (told.base_model, base)):
        (score,) = validate(model, [logs[1]]).scores
        assert own.sides.tolist() == list(score.relative.values())
        assert own.joints.tolist() == [one.rms for one in score.scores]
    assert extended.left_of(base) < 0.5


def test_the_gain_is_what_validate_measures_for_the_written_models(
    logs: tuple[list[Session], Session], make: Make, chain: Chain, tmp_path: Path
) -> None:
    short = make("d.mcap", 6, springs, 3)
    short = replace(short, phases=[short.phases[0], short.phases[1]._replace(name="return")])
    test = [logs[1], short]
    told = diagnose(logs[0], chain, test=test, causes=["cable_spring"])
    gain = told.to_dict()["gain"]
    for name, model in (("base", told.base_model), ("extended", told.extended_model)):
        write_model(model, tmp_path / f"{name}.yaml")
        found = validate(tmp_path / f"{name}.yaml", test, allow_seen=True).scores
        assert len({score.scores[0].samples for score in found}) == 2
        for side in ("motor", "joint"):
            table = [[s for s in score.scores if s.side == side] for score in found]
            samples, rms = np.array([[(s.samples, s.rms) for s in row] for row in table]).transpose(2, 0, 1)
            pooled = np.sqrt(np.sum(samples * rms**2, axis=0) / np.sum(samples, axis=0))
            np.testing.assert_allclose(gain[f"test_rms_{name}"][side], pooled, rtol=1e-4)
    np.testing.assert_allclose(gain["rows_extended"]["joint"], told.rms_extended["joint"])
    assert told.to_dict()["baseline"]["test_rms"] == gain["rows_base"] != gain["test_rms_base"]


def test_without_test_sessions_the_gain_is_that_of_the_rows(
    logs: tuple[list[Session], Session], chain: Chain
) -> None:
    told = diagnose(logs[0], chain, causes=["cable_spring"])
    gain = told.to_dict()["gain"]
    assert told.torque_rms_base == told.torque_rms_extended == {}
    assert gain["test_rms_extended"] == gain["rows_extended"]
    assert told.to_dict()["healthy"] == []


def test_each_joint_is_measured_by_its_own_error() -> None:
    def errors(sides: list[float], *joints: float) -> TorqueErrors:
        return TorqueErrors(np.array(sides), np.array(joints), np.array(joints))

    before = errors([0.2], 2.0, 0.05)
    assert errors([0.2002], 2.002, 0.03).left_of(before) < 1.0
    assert errors([0.2], 2.0, 0.06).left_of(before) > 1.0
    assert errors([0.203], 2.03, 0.03).left_of(before) == np.inf
    assert errors([0.2], 2.0).left_of(before) == np.inf
    assert errors([]).left_of(errors([])) == 1.0


def test_reversals_are_no_reason_against_what_predicts_the_motion() -> None:
    def errors(*joints: float, moving: float) -> TorqueErrors:
        return TorqueErrors(np.ones(1), np.array(joints), np.array([joints[0], moving]))

    before = errors(1.0, 0.92, moving=0.54)
    assert errors(1.0, 0.925, moving=0.46).left_of(before) == 1.0
    assert errors(1.0, 0.925, moving=0.539).left_of(before) > 1.0
    assert errors(1.0, 0.935, moving=0.46).left_of(before) > 1.0


@pytest.mark.parametrize("harmful", [2, 3])
def test_an_effect_that_raises_the_torque_error_is_not_in_the_extension(
    logs: tuple[list[Session], Session],
    chain: Chain,
    told: Diagnosis,
    monkeypatch: pytest.MonkeyPatch,
    harmful: int,
) -> None:
    sure = {f.joints: f.confidence for f in told.claims}

    def measured(model: DynamicModel, sessions: Sequence[Session]) -> TorqueErrors:
        joints = [entry["joints"] for entry in model.effects]
        error = np.array([1.0 + 2.0 * ([harmful] in joints) - 0.5 * (len(joints) > 0)])
        return TorqueErrors(error, error, error)

    monkeypatch.setattr(TorqueErrors, "of", measured)
    spared = found(logs, chain)
    other = 5 - harmful
    assert [entry["joints"] for entry in spared.extended_model.effects] == [[other]]
    left = {f.joints: f.confidence for f in spared.claims}
    assert left[other,] == sure[other,]
    assert left.get((harmful,), 0.0) <= 0.7 < sure[harmful,]
    assert spared.rms_extended["joint"][harmful - 1] > 2.0 * spared.rms_extended["joint"][other - 1]


def three_errors(s: dict) -> None:
    """Friction of joint 2 by the speed of joint 3, without a name; a hose at joint 3; one-sided friction of joint 1."""
    s["motor"][:, 1] += 0.5 * np.abs(s["qd"][:, 2]) * np.tanh(5.0 * s["qd"][:, 2] ** 2)
    s["motor"][:, 0] += 0.5 * np.abs(s["qd"][:, 0])
    for side in ("motor", "joint"):
        s[side][:, 2] += 1.2 * s["q"][:, 2]


@pytest.mark.parametrize("harmful", [False, True])
def test_where_no_extension_predicts_better_nothing_says_that_there_is_one(
    make: Make, chain: Chain, monkeypatch: pytest.MonkeyPatch, harmful: bool
) -> None:
    def measured(model: DynamicModel, sessions: Sequence[Session]) -> TorqueErrors:
        error = np.array([1.0 + (len(model.effects) > 0) * (1.0 if harmful else -0.5)])
        return TorqueErrors(error, error, error)

    # As with the drawing of an arm, so that `identify` makes the models.
    monkeypatch.setattr(Evidence, "drawn", property(lambda self: True))
    monkeypatch.setattr(TorqueErrors, "of", measured)
    monkeypatch.setattr(
        "ident.diagnosis.verdict.conclusion.believable", lambda grounds: not grounds.get("worse")
    )
    logs = [make(f"{k}.mcap", seed, three_errors, k) for k, seed in enumerate((1, 2, 5))]
    told = diagnose(logs[:2], chain, test=logs[2:], causes=["cable_spring", "friction_asymmetry"])
    fitted, left = ([(one.side, one.joint) for one in part] for part in (told.nameless, told.unexplained))
    # Beside those that the held-out rows refute.
    doubted = [(f.cause, f.confidence <= 0.7) for f in told.doubted if f.confidence > 0.0]
    if not harmful:
        assert {"cable_spring(3)", "friction_asymmetry(1)"} < set(told.extension)
        assert ("motor", 2) in fitted
        assert ("motor", 2) not in left
        assert not doubted
        return
    assert (fitted, told.extension) == ([], ())
    assert told.extended_model is told.base_model
    assert ("motor", 2) in left
    # The name of a fault is contradicted; what every such drive has is only not in the model.
    assert doubted == [("cable_spring", True)]
    assert [(f.cause, f.confidence <= 0.7) for f in told.character] == [("friction_asymmetry", True)]


@pytest.mark.parametrize(("spread", "harm"), [(0.2, False), (0.002, True)])
def test_a_rise_within_its_interval_is_no_harm(spread: float, harm: bool) -> None:
    rng = np.random.default_rng(3)
    squares = 1.0 + rng.uniform(0.0, 0.5, (60, 2))
    change = rng.normal(1.004, spread, squares.shape)
    change *= 1.004 / (np.sum(squares * change) / np.sum(squares))

    def errors(power: Any) -> TorqueErrors:
        rms = np.sqrt(power.sum(axis=0))
        return TorqueErrors(np.ones(1), rms, rms, (SimpleNamespace(squares={"joint": power}),))  # type: ignore[arg-type]

    assert (errors(squares * change).left_of(errors(squares)) > 1.0) == harm
