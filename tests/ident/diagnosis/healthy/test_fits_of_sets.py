"""A healthy set is fitted anew only with an arm that acts differently."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from ident.diagnosis import DiagnosisSettings
from ident.diagnosis.healthy import commission as module
from ident.diagnosis.healthy.tuning import SettledArm
from ident.diagnosis.rows.nominal_arm import NominalArm
from ident.dynamics.kinematics import Chain

OWN = ({"cause": "stribeck friction", "joints": [1], "parameters": {}},)


@pytest.mark.parametrize(
    ("late", "own", "fits"),
    [({"motor": 0.0, "joint": 0.0}, (), 1), ({"motor": 0.0, "joint": 0.0}, OWN, 2), ({"motor": 0.0}, OWN, 4)],
)
def test_sets_are_fitted_once_for_each_arm(
    chain: Chain, monkeypatch: pytest.MonkeyPatch, late: dict[str, float], own: Sequence[Any], fits: int
) -> None:
    """With an open delay the arm changes in each of two rounds, with effects of its own at the end."""
    arms: list[NominalArm] = []

    def prepared(arm: NominalArm, *_: Any, **__: Any) -> SimpleNamespace:
        arms.append(arm)
        return SimpleNamespace()

    day = SimpleNamespace(slow_turns=np.zeros((2, 3, 3)), coulomb=np.ones(3), late={"joint": (1e-3, 1e-4)})
    monkeypatch.setattr(module, "prepare_bench", prepared)
    monkeypatch.setattr(module, "_day", lambda *_: day)
    monkeypatch.setattr(module, "character", lambda benches, _: own)
    settled = SettledArm(NominalArm(chain, np.zeros(3), np.ones(3)), None, [], late)  # type: ignore[arg-type]

    known, days = module._with_days(settled, [[], []], DiagnosisSettings())

    assert len(arms) == 2 * fits
    assert days == [day, day]
    assert known.healthy == own
    assert arms[-1].acts_as(known)


def test_a_longer_distance_without_friction_changes_nothing(chain: Chain) -> None:
    arm = NominalArm(chain, np.zeros(3), np.ones(3), presliding=np.full(3, 1e-3))
    far = replace(arm, far=np.full(3, 1e-2), far_share=np.zeros(3))
    assert far.acts_as(arm)
    assert not replace(far, far_share=np.array([0.0, 0.1, 0.0])).acts_as(arm)
    assert not replace(arm, motor_delay_s=1e-3).acts_as(arm)
