"""The diagnosis of sessions whose physics it does not know; it gets logs and a healthy reference, no more."""

from __future__ import annotations

import json
from typing import Any

import pytest
from click.testing import CliRunner

from runner.cli import main
from tests.hidden_physics.cases import Case, Store, draw, twin
from tests.hidden_physics.engine import REFERENCE, diagnosed
from tests.hidden_physics.verdict import judge

_PAIR = ("friction_asymmetry", "cable_spring")


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Store:
    return Store(tmp_path_factory.mktemp("hidden_cases"))


def by_command(store: Store, case: Case) -> dict[str, Any]:
    """What `lwr-run diagnose` writes about a case."""
    sessions = store.sessions(case)
    out = store.folder / "diagnosis"
    arguments = [*map(str, sessions.train), "--test", str(sessions.test[0])]
    arguments += ["--reference", str(REFERENCE), "--no-simulation", "--out", str(out), "--force"]
    result = CliRunner().invoke(main, ["diagnose", *arguments], catch_exceptions=False)
    assert result.exit_code == 0, result.output
    return dict(json.loads((out / "diagnosis.json").read_text()))


@pytest.mark.slow
def test_nothing_hidden_nothing_claimed_on_the_command_line(store: Store) -> None:
    # Of the day of a pair below, which is recorded beside it.
    pair = draw(2, "pair", store, causes=_PAIR, size=1.5)
    case = twin(pair.schedule, pair.day)
    verdict = judge(by_command(store, case), case.hidden)
    assert verdict.silent, verdict.findings


@pytest.mark.slow
@pytest.mark.parametrize(
    ("causes", "seed", "size"),
    [
        (_PAIR, 2, 1.5),
        pytest.param(("sensor_hysteresis", "motor_torque_delay"), 3, 3.0, marks=pytest.mark.long),
        pytest.param(("payload_change", "stribeck"), 4, 2.5, marks=pytest.mark.long),
    ],
)
def test_two_hidden_causes_are_named_and_nothing_else(
    store: Store, causes: tuple[str, ...], seed: int, size: float
) -> None:
    case = draw(seed, "pair", store, causes=causes, size=size)
    diagnosis, _ = diagnosed(store.sessions(case), REFERENCE)
    verdict = judge(diagnosis, case.hidden)
    assert verdict.exact, ([(h.cause, h.joints) for h in case.hidden], verdict.findings)


@pytest.mark.long
@pytest.mark.parametrize(
    ("cause", "seed"), [("viscous_nonlinear", 2), ("sensor_crosstalk", 3), ("friction_asymmetry", 4)]
)
def test_a_hidden_cause_is_named(store: Store, cause: str, seed: int) -> None:
    case = draw(seed, "single", store, causes=[cause], size=2.5)
    diagnosis, _ = diagnosed(store.sessions(case), REFERENCE)
    verdict = judge(diagnosis, case.hidden)
    assert verdict.first, (case.hidden[0].joints, verdict.findings)
    assert not verdict.sure_wrong


@pytest.mark.long
@pytest.mark.parametrize(
    ("cause", "seed", "size"),
    [
        ("presliding_hysteresis", 7, 1.5),
        ("cable_spring", 9, 2.5),
        ("payload_error", 10, 2.0),
        ("payload_change", 11, 2.5),
        ("sensor_ripple", 12, 1.5),
        ("joint_torque_delay", 14, 2.0),
    ],
)
def test_a_hidden_cause_is_named_and_nothing_else(store: Store, cause: str, seed: int, size: float) -> None:
    case = draw(seed, "single", store, causes=[cause], size=size)
    diagnosis, _ = diagnosed(store.sessions(case), REFERENCE)
    verdict = judge(diagnosis, case.hidden)
    assert verdict.exact, (case.hidden[0].joints, verdict.findings)


@pytest.mark.long
def test_what_no_catalogue_has_is_flagged_and_not_surely_named(store: Store) -> None:
    case = draw(2, "outside", store, causes=["drag by a neighbour's speed"], size=3.0)
    diagnosis, _ = diagnosed(store.sessions(case), REFERENCE)
    verdict = judge(diagnosis, case.hidden)
    assert not verdict.sure_wrong, verdict.findings
    assert verdict.unexplained


@pytest.mark.long
def test_how_late_the_motor_torques_are_is_told_between_whole_periods_of_the_commands(store: Store) -> None:
    """They are sampled every third command; 5 to 7 ms later they meet the ripple between two commands elsewhere."""
    case = draw(1, "single", store, causes=["motor_torque_delay"], size=1.5)
    assert case.hidden[0].parameters["delay"] == pytest.approx(6e-3)
    diagnosis, _ = diagnosed(store.sessions(case), REFERENCE)
    verdict = judge(diagnosis, case.hidden)
    assert verdict.exact, verdict.findings
    assert not verdict.unexplained
    assert abs(verdict.deviations["motor_torque_delay.delay"]) < 2.0
