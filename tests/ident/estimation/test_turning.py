"""Friction that turns over a path after a reversal becomes an effect of the identified model."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from ident.dynamics.kinematics import Chain
from ident.dynamics.structure import Coulomb
from ident.effects.motion import dahl
from ident.estimation import turning
from ident.estimation.identify import AUTO, IdentificationSettings, Known, identify
from ident.estimation.turning import friction_turning
from ident.estimation.validate import validate
from ident.rows.prepared import TorqueChannel
from lwr_driver.configuration import find
from tests.ident.estimation.emulated_sessions import record_pair

FRICTION, LENGTH = 2.0, 3e-3


def channel(
    friction: Callable[[np.ndarray, np.ndarray], np.ndarray], duration_s: float = 40.0
) -> TorqueChannel:
    """Two drives, the second with `friction` [Nm] of its path and speed, the first with a sign."""
    times = np.arange(0.0, duration_s, 2e-3)
    q = np.column_stack([np.sin(1.3 * times), 0.4 * np.sin(1.7 * times) + 0.3 * np.sin(2.9 * times)])
    qd = np.gradient(q, 2e-3, axis=0)
    torque = 0.05 * np.random.default_rng(3).normal(size=q.shape)
    torque[:, 0] += FRICTION * np.sign(qd[:, 0])
    torque[:, 1] += friction(q[:, 1], qd[:, 1])
    off = np.zeros(q.shape, dtype=bool)
    return TorqueChannel("motor", times, q, qd, 0.0 * q, torque, off, off, None, 2e-3)


def told(one: TorqueChannel, monkeypatch: pytest.MonkeyPatch) -> turning.Turning | None:
    model: Any = SimpleNamespace(
        structure=SimpleNamespace(
            sides=("motor", "joint"), coulomb=Coulomb(), chain=SimpleNamespace(joint_names=("one", "two"))
        ),
        drive=lambda: {"Fcm": np.full(2, FRICTION), "Fcl": np.zeros(2)},
        torque=lambda q, qd, qdd, **_: FRICTION * np.sign(qd),
    )
    session: Any = SimpleNamespace(motor=one, joint=SimpleNamespace(effort=np.zeros((1, 2))))
    used = np.ones(one.torque.shape, dtype=bool)
    monkeypatch.setattr(turning, "_channels", lambda *_: [(one, used, None)])
    return friction_turning(model, [session])


def test_the_length_is_found_in_the_drive_that_has_one(monkeypatch: pytest.MonkeyPatch) -> None:
    found = told(channel(lambda q, _: FRICTION * dahl(np.ascontiguousarray(q), LENGTH, 1.0)), monkeypatch)
    assert found is not None
    assert found.names == ("two",)
    (entry,) = found.entries
    length, amplitude = (entry["parameters"][name] for name in ("length", "amplitude"))
    assert abs(length["value"] - LENGTH) < 3.0 * length["std"] < LENGTH
    assert amplitude["value"] == pytest.approx(FRICTION, rel=0.05)
    assert found.after < 0.6 * found.before
    assert "two 3.2" in str(found)


def test_no_more_turns_than_the_coulomb_friction(monkeypatch: pytest.MonkeyPatch) -> None:
    found = told(
        channel(lambda q, _: 3.0 * FRICTION * dahl(np.ascontiguousarray(q), LENGTH, 1.0)), monkeypatch
    )
    assert found is not None
    assert found.entries[0]["parameters"]["amplitude"]["value"] <= FRICTION


def test_friction_that_turns_at_once_has_no_length(monkeypatch: pytest.MonkeyPatch) -> None:
    assert told(channel(lambda _, qd: FRICTION * np.sign(qd)), monkeypatch) is None


def test_a_few_seconds_tell_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    slow = channel(lambda q, _: FRICTION * dahl(np.ascontiguousarray(q), LENGTH, 1.0), duration_s=10.0)
    assert told(slow, monkeypatch) is None


@pytest.mark.slow
def test_the_model_of_an_arm_with_presliding_predicts_reversals(tmp_path: Path) -> None:
    plant = {"robot.plant": {"type": "tests.hidden_physics.arm:HiddenArm", "options": {}}}
    fitted = record_pair(tmp_path, 41, period_s=10.0, settings=plant)
    other, _ = record_pair(tmp_path, 42, period_s=10.0, settings=plant)
    chain = Chain.from_urdf(find("lwr4plus.urdf"))
    errors = {}
    for estimator in ("physical", AUTO):
        settings = IdentificationSettings(estimator=estimator, essential=None)
        found = identify(fitted, chain, settings, known=Known())
        errors[estimator] = validate(found.model, [other], known=Known()).scores[0].relative["motor"]
        turns = [one for one in found.effects if one["cause"] == "presliding_hysteresis"]
        assert bool(turns) == (estimator == AUTO)
    print(errors)
    assert errors[AUTO] < 0.9 * errors["physical"]
