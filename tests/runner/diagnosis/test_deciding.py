"""Which motion would decide between causes that look alike, and what is made of its outcome."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from ident.diagnosis import Finding
from ident.diagnosis.outcome.claims_in_words import answer_statement
from ident.effects import EFFECTS
from ident.effects.words import quantity_text
from ident.excitation import ExcitationPlan
from lwr_driver.arm import Arm
from lwr_driver.arm.cell import Cell
from runner.diagnosis.after_run import decisions
from runner.diagnosis.discriminating import Discriminating, offers, open_findings
from runner.experiment_file import Experiment
from runner.planning import excitation_rows, plan_excitation, session_motion

Place = tuple[str, tuple[int, ...]]


@pytest.fixture(scope="module")
def arm() -> Arm:
    return Arm.load()


@pytest.fixture(scope="module")
def experiment() -> Experiment:
    return Experiment.load()


def finding(cause: str, joint: int, confidence: float, *others: Place) -> Finding:
    evidence: Any = SimpleNamespace()
    alternatives = tuple((name, joints, -20.0) for name, joints in others)
    return Finding(
        cause,
        "motor",
        (joint,),
        parameters={},
        evidence=evidence,
        confidence=confidence,
        alternatives=alternatives,
        tell_apart="a motion",
        gain=40.0,
    )


def diagnosis(*findings: Finding) -> Any:
    return SimpleNamespace(claims=findings)


def offered(found: Any, experiment: Experiment, arm: Arm) -> tuple[Discriminating, ...]:
    cell = Cell.load(experiment.cell)
    return offers(found, experiment, arm, cell, plan_excitation(experiment, arm, cell))


def test_every_cause_has_a_motion_that_decides() -> None:
    assert all(effect.experiment for effect in EFFECTS.values())


def test_only_open_findings_ask_for_a_motion(experiment: Experiment, arm: Arm) -> None:
    sure = finding("stribeck", 2, 0.97, ("viscous_nonlinear", (2,)))
    alone = finding("stribeck", 2, 0.7)
    assert open_findings(diagnosis(sure, alone)) == ()
    assert offered(diagnosis(sure, alone), experiment, arm) == ()


@pytest.mark.parametrize(
    ("cause", "other", "kind", "payloads"),
    [
        ("stribeck", "viscous_nonlinear", "slow sweep", ["paper_load"]),
        ("presliding_hysteresis", "sensor_hysteresis", "reversal ladder", ["paper_load"]),
        ("motor_torque_gain", "sensor_gain", "static poses", ["paper_load", None]),
        ("joint_elasticity", "motor_torque_delay", "chirp", ["paper_load"]),
        ("friction_temperature", "sensor_offset_drift", "hot and cold", ["paper_load"]),
        ("contact", "payload_change", "repeated run", ["paper_load"]),
    ],
)
def test_the_motion_suits_the_causes_and_passes_every_check(
    cause: str,
    other: str,
    kind: str,
    payloads: list[str | None],
    experiment: Experiment,
    arm: Arm,
    tmp_path: Path,
) -> None:
    (motion,) = offered(diagnosis(finding(cause, 2, 0.6, (other, (2,)))), experiment, arm)
    assert motion.kind == kind
    assert [None if p is None else p.name for p in motion.payloads] == payloads
    assert len(motion.sessions) == len(payloads)
    motion.plan.save(tmp_path / motion.file)
    plan = ExcitationPlan.load(tmp_path / motion.file)
    for period_s in (1e-3, 5e-3, 12e-3):
        if kind in ("repeated run", "hot and cold") and period_s == 12e-3:
            continue
        rows = excitation_rows(plan, plan.periods)(period_s)
        np.testing.assert_allclose(rows.q[0], rows.q[-1], atol=1e-9)
    home = experiment.home(7)
    rows = excitation_rows(plan, plan.periods)(5e-3)
    for session in motion.sessions:
        _, preflight = session_motion(experiment, arm, Cell.load(experiment.cell), session, rows, home)
        assert preflight.ok, str(preflight)


def test_a_slow_sweep_covers_the_low_speeds_both_ways(experiment: Experiment, arm: Arm) -> None:
    (motion,) = offered(diagnosis(finding("stribeck", 4, 0.6, ("viscous_nonlinear", (4,)))), experiment, arm)
    speed = motion.plan.sample(np.arange(0.0, motion.plan.duration_s, 0.01)).qd[:, 3]
    for wanted in (0.013, 0.02, 0.033, 0.055, 0.09, 0.15, 0.3):
        for direction in (1.0, -1.0):
            share = np.mean(np.abs(direction * speed - wanted) < 0.1 * wanted)
            assert share > 0.02, (wanted, direction)


def test_one_motion_serves_several_questions(experiment: Experiment, arm: Arm) -> None:
    first = finding("motor_torque_gain", 2, 0.6, ("sensor_gain", (2,)))
    second = finding("joint_zero_offset", 4, 0.5, ("base_tilt", ()))
    (motion,) = offered(diagnosis(first, second), experiment, arm)
    assert {cause for cause, _ in motion.rivals} == {
        "motor_torque_gain",
        "sensor_gain",
        "joint_zero_offset",
        "base_tilt",
    }


@pytest.mark.slow
def test_where_nothing_passes_nothing_is_offered(
    experiment: Experiment, arm: Arm, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("INFO")
    weak = replace(arm, tau_max=np.full(7, 1.0))
    cell = Cell.load(experiment.cell)
    plan = plan_excitation(experiment, arm, cell)
    found = diagnosis(finding("stribeck", 2, 0.6, ("viscous_nonlinear", (2,))))
    assert offers(found, experiment, weak, cell, plan) == ()
    # Both causes ask for this one.
    assert caplog.messages.count("no slow sweep passes every check") == 1


NAMES = ("A1", "A2", "E1", "A3", "A4", "A5", "A6")


def test_the_decision_names_the_one_that_stands() -> None:
    before = diagnosis(finding("stribeck", 2, 0.6, ("viscous_nonlinear", (2,))))
    after = diagnosis(finding("viscous_nonlinear", 2, 0.95))
    (answer,) = decisions(before, after)
    assert answer.outcome == "decided"
    assert answer.named == ("viscous_nonlinear", (2,))
    said = answer_statement(answer.to_dict(), NAMES)
    assert said.startswith("Decided: viscous nonlinear (joint A2), confidence 0.95")


def test_the_decision_says_that_it_is_still_open() -> None:
    before = diagnosis(finding("stribeck", 2, 0.6, ("viscous_nonlinear", (2,))))
    (answer,) = decisions(before, diagnosis(finding("stribeck", 2, 0.7, ("viscous_nonlinear", (2,)))))
    assert answer.outcome == "open"
    said = answer_statement(answer.to_dict(), NAMES)
    assert "Still open" in said
    assert "stribeck (joint A2) is the better now, confidence 0.70" in said


def test_the_decision_says_that_none_of_them_stands() -> None:
    before = diagnosis(finding("stribeck", 2, 0.6, ("viscous_nonlinear", (2,))))
    (other,) = decisions(before, diagnosis(finding("friction_load", 2, 0.9)))
    assert (other.outcome, other.named) == ("neither", ("friction_load", (2,)))
    (nothing,) = decisions(before, diagnosis())
    assert "found instead: nothing" in answer_statement(nothing.to_dict(), NAMES)


@pytest.mark.parametrize(
    ("value", "std", "unit", "text"),
    [
        (1.9, 0.2, "Nm", "1.9 ± 0.2 Nm"),
        (0.01021, 0.00074, "1", "0.01021 ± 0.00074"),
        (12.3456, 3.0, "s", "12.3 ± 3.0 s"),
        (100.0, 20.0, "kg m^2", "100 ± 20 kg m²"),
        (5.0, 0.0, "1", "5"),
        (2.5e-7, 3e-8, "rad/Nm", "2.5e-07 ± 3e-08 rad/Nm"),
    ],
)
def test_quantities_are_shown_to_what_is_known(value: float, std: float, unit: str, text: str) -> None:
    assert quantity_text(value, std, unit) == text
