"""Cases are drawn from seeds, keep their shape when their size changes, and can be told apart by nobody."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest

from ident.effects import EFFECTS
from tests.hidden_physics import cases
from tests.hidden_physics.cases import Store, draw, twin
from tests.hidden_physics.causes import CAUSES
from tests.hidden_physics.hidden import Scene
from tests.hidden_physics.outside import OUTSIDE
from tests.hidden_physics.robots import SESSIONS, Day, Setting, session_settings
from tests.hidden_physics.variants import VARIANTS

CONTRACT = {
    "stribeck": "motor",
    "viscous_nonlinear": "motor",
    "friction_asymmetry": "motor",
    "friction_load": "motor",
    "friction_temperature": "motor",
    "friction_position": "motor",
    "presliding_hysteresis": "motor",
    "gear_ripple": "motor",
    "motor_torque_gain": "motor",
    "backlash": "joint",
    "joint_elasticity": "joint",
    "cable_spring": "joint",
    "base_tilt": "joint",
    "payload_error": "joint",
    "payload_change": "joint",
    "joint_zero_offset": "joint",
    "contact": "joint",
    "sensor_gain": "sensor",
    "sensor_crosstalk": "sensor",
    "sensor_hysteresis": "sensor",
    "sensor_saturation": "sensor",
    "sensor_offset_drift": "sensor",
    "sensor_ripple": "sensor",
    "motor_torque_delay": "timing",
    "joint_torque_delay": "timing",
    "lost_samples": "timing",
    "encoder_eccentricity": "joint",
}

PEAKS = (20.0, 60.0, 15.0, 40.0, 5.0, 12.0, 9.0)
SCENE = Scene(PEAKS, PEAKS, 1.0)


@pytest.fixture
def store(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Store:
    """A store that draws without recording anything."""
    monkeypatch.setattr(Store, "scene", lambda self, schedule, day: SCENE)
    return Store(tmp_path)


def test_every_cause_of_the_contract_can_be_hidden() -> None:
    assert {name: cause.side for name, cause in CAUSES.items()} == CONTRACT
    assert set(CAUSES) == set(EFFECTS)
    assert not set(OUTSIDE) & set(CAUSES)


def test_a_variant_is_of_a_listed_cause() -> None:
    assert {(variant.name, variant.side) for variant in VARIANTS.values()} <= set(CONTRACT.items())
    assert not set(VARIANTS) & (set(CAUSES) | set(OUTSIDE))


@pytest.mark.parametrize("name", [*CAUSES, *OUTSIDE, *VARIANTS])
def test_a_cause_turned_down_vanishes_and_keeps_its_shape(name: str) -> None:
    cause = (CAUSES | OUTSIDE | VARIANTS)[name]
    for joint in cause.joints:
        small, large = (cause.draw(np.random.default_rng(4), joint, SCENE)(size) for size in (1e-9, 2.0))
        assert small.cause == large.cause == cause.name
        assert small.joints == large.joints == ((joint,) if joint else ())
        assert small.variant == large.variant
        assert len(small.settings) == SESSIONS
        assert small.side == cause.side
        healthy = json.dumps(session_settings(Day(0), Setting()))
        assert any(json.dumps(session_settings(Day(0), s)) != healthy for s in large.settings)
        for setting in large.settings:
            assert math.isfinite(sum(map(abs, setting.tilt)))


def test_the_same_seed_gives_the_same_case(store: Store) -> None:
    for kind in cases.KINDS:
        assert draw(12, kind, store) == draw(12, kind, store)
        assert draw(12, kind, store) != draw(13, kind, store)


def test_pairs_and_triples_hide_different_causes_that_fit_together(store: Store) -> None:
    for seed in range(60):
        for kind, count in (("pair", 2), ("triple", 3)):
            case = draw(seed, kind, store)
            assert len({hidden.cause for hidden in case.hidden}) == count
            settings = [session_settings(case.day, setting) for setting in case.settings()]
            json.dumps(settings)
            joints = [hidden.joints[0] for hidden in case.hidden if hidden.joints]
            assert len(joints) == len(set(joints))


def test_names_tell_nothing(store: Store) -> None:
    seen = set()
    for seed in range(40):
        for kind in ("single", "none", "outside"):
            case = draw(seed, kind, store)
            assert set(case.name) <= set("0123456789abcdef")
            seen.add(case.name)
    assert len(seen) == 120


def test_a_twin_is_the_same_day_with_nothing_hidden(store: Store) -> None:
    case = draw(5, "single", store)
    other = twin(case.schedule, case.day)
    assert not other.hidden
    assert other.day == case.day
    assert [case.day.seed(k) for k in range(SESSIONS)] == [other.day.seed(k) for k in range(SESSIONS)]


def test_days_differ_within_their_tolerances() -> None:
    first, second = (Day(number).setting() for number in (1, 2))
    assert first != second
    for setting in (first, second):
        assert all(abs(value - 1.0) <= 0.03 for value in setting.traits["stiffness"].values())
        assert all(abs(value / 1e-4 - 1.0) <= 0.03 for value in setting.traits["presliding"].values())


def test_hidden_lateness_comes_on_top_of_the_days() -> None:
    late = Setting(faults={"motor_late": dict.fromkeys(range(1, 8), 5e-3)})
    options = session_settings(Day(1), late)["robot.effects"][0]["options"]
    own = Day(1).setting().faults["motor_late"][1]
    assert options["faults"]["motor_late"]["1"] == pytest.approx(5e-3 + own)
