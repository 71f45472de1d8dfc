"""Friction that turns over a path after a reversal becomes an effect of the identified model."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from ident.dynamics.kinematics import Chain
from ident.dynamics.structure import Coulomb
from ident.effects.motion import dahl, turned_friction
from ident.estimation import turning
from ident.estimation.identification import IdentificationSettings, Known
from ident.estimation.identify import identify
from ident.estimation.turning import friction_turning
from ident.estimation.validate import validate
from ident.estimators.names import AUTO
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


def told(
    one: TorqueChannel, monkeypatch: pytest.MonkeyPatch, prismatic: tuple[bool, bool] = (False, False)
) -> turning.Turning | None:
    model: Any = SimpleNamespace(
        effects=(),
        structure=SimpleNamespace(
            sides=("motor", "joint"),
            coulomb=Coulomb(),
            chain=SimpleNamespace(joint_names=("one", "two"), prismatic=prismatic),
        ),
        drive=lambda: {"Fcm": np.full(2, FRICTION), "Fcl": np.zeros(2)},
        torque=lambda q, qd, qdd, **_: FRICTION * np.sign(qd),
    )
    session: Any = SimpleNamespace(motor=one, joint=SimpleNamespace(effort=np.zeros((1, 2))))
    used = np.ones(one.torque.shape, dtype=bool)
    monkeypatch.setattr(turning, "_channels", lambda *_: [(one, used, None)])
    return friction_turning(model, [session])


def test_the_path_of_a_sliding_joint_is_in_metres_and_its_friction_in_newtons(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    slides = channel(lambda q, _: FRICTION * dahl(np.ascontiguousarray(q), LENGTH, 1.0))
    found = told(slides, monkeypatch, (False, True))
    assert found is not None
    assert found.to_dict()["length_m"] == found.lengths
    assert not found.to_dict()["length_rad"]
    assert "two 2.9 mm;" in str(found)
    units = {name: one["unit"] for name, one in found.entries[0]["parameters"].items()}
    assert (units["amplitude"], units["length"]) == ("N", "m")


def test_the_length_is_found_in_the_drive_that_has_one(monkeypatch: pytest.MonkeyPatch) -> None:
    found = told(channel(lambda q, _: FRICTION * dahl(np.ascontiguousarray(q), LENGTH, 1.0)), monkeypatch)
    assert found is not None
    assert found.names == ("two",)
    (entry,) = found.entries
    length, amplitude = (entry["parameters"][name] for name in ("length", "amplitude"))
    assert abs(length["value"] - LENGTH) < 3.0 * length["std"] < LENGTH
    assert amplitude["value"] == pytest.approx(FRICTION, rel=0.05)
    assert found.after < 0.6 * found.before
    assert "two 2.9" in str(found)


def test_a_drive_at_rest_keeps_its_friction() -> None:
    # It stops within a thousandth of a second, and a low-pass swings back by a few micrometres at a radius of 1 m.
    speed = np.array([0.1, 0.1, 0.1, -1e-3, -1e-3, -1e-3, 1e-3])
    state = turned_friction(np.cumsum(speed) * 1e-2, speed, 1e-5)
    assert state[2:] == pytest.approx(1.0)
    assert turned_friction(np.cumsum(-speed) * 1e-2, -speed, 1e-5)[2:] == pytest.approx(-1.0)
    assert turned_friction(np.array([0.0, -1e-4, 0.0]), np.array([0.1, -0.1, 0.1]), 1e-5) == pytest.approx(
        [1.0, -1.0, 1.0], abs=1e-3
    )


def stop_and_go(stiction: Callable[[np.random.Generator, float], float]) -> TorqueChannel:
    """The second drive moves to and fro in steps of a second with a second of rest between, in which its friction is
    `stiction` of a generator and the last friction [Nm]."""
    rng, times, places = np.random.default_rng(5), np.arange(0.0, 60.0, 2e-3), [0.0]
    q, friction, course = np.zeros((len(times), 2)), np.zeros(len(times)), np.linspace(0.0, 1.0, 500)
    last = 1.0
    for start in range(0, len(times), 1000):
        goal = rng.uniform(-0.8, 0.8)
        q[start : start + 500, 1] = places[-1] + (goal - places[-1]) * course**3 * (
            10.0 - 15.0 * course + 6.0 * course**2
        )
        q[start + 500 : start + 1000, 1] = goal
        last = float(np.sign(goal - places[-1]))
        friction[start : start + 500] = FRICTION * last
        friction[start + 500 : start + 1000] = stiction(rng, FRICTION * last)
        places.append(goal)
    one = channel(lambda *_: friction, duration_s=60.0)
    qd = np.gradient(q, 2e-3, axis=0)
    return replace(one, q=q, qd=qd, torque=one.torque * [0.0, 1.0])


def test_all_friction_is_held_at_rest(monkeypatch: pytest.MonkeyPatch) -> None:
    found = told(stop_and_go(lambda _, last: last), monkeypatch)
    assert found is not None
    assert found.names == ("two",)
    parameters = found.entries[0]["parameters"]
    assert parameters["amplitude"]["value"] == FRICTION
    assert parameters["length"]["value"] < 1e-4
    assert found.after < 0.3 * found.before


def test_any_friction_at_rest_is_not_followed_at_the_cost_of_motion(monkeypatch: pytest.MonkeyPatch) -> None:
    found = told(stop_and_go(lambda rng, last: rng.uniform(-0.9, 0.3) * last), monkeypatch)
    assert found is None or found.entries[0]["parameters"]["length"]["value"] < 1e-3


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
    (other,) = record_pair(tmp_path, 42, period_s=10.0, settings=plant, payloads=("none",))
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
