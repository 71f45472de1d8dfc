"""An extended model never predicts held-out sessions worse than the base model, as `validate` measures it."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import pytest
from numpy.typing import NDArray

from ident.diagnosis import Diagnosis, diagnose, models
from ident.diagnosis.extension import squares_left, torque_errors
from ident.dynamics.kinematics import Chain
from ident.estimation.validate import validate
from ident.model import DynamicModel
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


def test_the_torque_errors_are_those_of_validate(logs: tuple[list[Session], Session], chain: Chain) -> None:
    told = found(logs, chain)
    assert {f.joints for f in told.claims} == {(2,), (3,)}
    errors = [torque_errors(model, [logs[1]]) for model in (told.extended_model, told.base_model)]
    for model, own in zip((told.extended_model, told.base_model), errors, strict=True):
        assert own.tolist() == list(validate(model, [logs[1]]).scores[0].relative.values())
    assert squares_left(*errors) < 0.5


def test_each_side_is_measured_by_its_own_error() -> None:
    before = np.array([0.2, 0.005])
    assert (
        squares_left(np.array([0.2002, 0.003]), before) < 1.0 < squares_left(np.array([0.2, 0.006]), before)
    )
    assert squares_left(before[:1], before) == np.inf
    assert squares_left(before[:0], before[:0]) == 1.0


@pytest.mark.parametrize("harmful", [2, 3])
def test_an_effect_that_raises_the_torque_error_is_not_in_the_extension(
    logs: tuple[list[Session], Session], chain: Chain, monkeypatch: pytest.MonkeyPatch, harmful: int
) -> None:
    sure = {f.joints: f.confidence for f in found(logs, chain).claims}

    def measured(model: DynamicModel, sessions: Sequence[Session]) -> NDArray[np.float64]:
        joints = [entry["joints"] for entry in model.effects]
        return np.array([1.0 + 2.0 * ([harmful] in joints) - 0.5 * (len(joints) > 0)])

    monkeypatch.setattr(models, "torque_errors", measured)
    told = found(logs, chain)
    other = 5 - harmful
    assert [entry["joints"] for entry in told.extended_model.effects] == [[other]]
    left = {f.joints: f.confidence for f in told.claims}
    assert left[other,] == sure[other,]
    assert left.get((harmful,), 0.0) <= 0.7 < sure[harmful,]
    assert told.rms_extended["joint"][harmful - 1] > 2.0 * told.rms_extended["joint"][other - 1]
