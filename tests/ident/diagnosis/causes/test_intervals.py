from __future__ import annotations

from collections.abc import Callable
from copy import copy
from dataclasses import replace

import numpy as np
import pytest

from ident.diagnosis.causes.candidates import Candidate, Trial
from ident.diagnosis.causes.intervals import estimated, phases_of
from ident.diagnosis.causes.tolerances import usual_change
from ident.diagnosis.healthy.bench import DiagnosisBench
from ident.diagnosis.outcome.signatures import signature_bench
from ident.diagnosis.verdict.findings import _parameters
from ident.dynamics.kinematics import Chain
from ident.effects import EFFECTS, SENSOR_GAIN, Shape
from lwr_driver.session import Session

AMPLITUDE, VELOCITY = 0.4, 0.15


@pytest.fixture(scope="module")
def bench(make: Callable[..., Session], chain: Chain) -> DiagnosisBench:
    def stribeck(s: dict[str, np.ndarray]) -> None:
        v = s["qd"][:, 1]
        s["motor"][:, 1] += AMPLITUDE * np.sign(v) * np.exp(-np.abs(v) / VELOCITY)

    return signature_bench([make("a.mcap", 1, stribeck), make("b.mcap", 2, stribeck, 1)], chain)


def trial(bench: DiagnosisBench, velocity: float) -> Trial:
    candidate = Candidate(EFFECTS["stribeck"], 1)
    found = bench.dictionary.trial(candidate, Shape(velocity=velocity, exponent=1.0))
    assert found is not None
    return found


@pytest.mark.parametrize("begin", [0.13, 0.17])
def test_values_are_those_of_all_parameters_at_a_time(bench: DiagnosisBench, begin: float) -> None:
    before = list(bench.evidence.extra)
    values, deviations = estimated(bench.dictionary, bench.evidence, trial(bench, begin))
    assert abs(values["velocity"] - VELOCITY) < min(2.0 * deviations["velocity"], 0.04)
    assert abs(values["amplitude"] - AMPLITUDE) < 3.0 * deviations["amplitude"]
    assert 0.005 < deviations["velocity"] < 0.06
    assert 0.01 < deviations["amplitude"] < 0.2
    assert bench.evidence.extra == before


def test_beside_a_reference_a_scale_has_its_change_from_day_to_day(bench: DiagnosisBench) -> None:
    found = bench.dictionary.trial(Candidate(SENSOR_GAIN, 1), Shape())
    assert found is not None
    alone = _parameters(found, bench)["error"]
    evidence = copy(bench.evidence)
    evidence.compared = True
    beside = _parameters(found, replace(bench, evidence=evidence))["error"]
    # The reference is the mean of two days, of which each differs as well.
    change = bench.nominal.arm.gain_std * np.sqrt(1.5)
    assert beside.std == pytest.approx(float(np.hypot(alone.std, change)))
    assert usual_change(EFFECTS["stribeck"], bench.nominal.arm) == 0.0


def test_far_from_the_best_shape_no_step_is_made(bench: DiagnosisBench) -> None:
    values, _ = estimated(bench.dictionary, bench.evidence, trial(bench, 0.02))
    assert values["velocity"] == 0.02


def test_phases_repeat_with_the_motion(bench: DiagnosisBench) -> None:
    phases = phases_of(bench.evidence)
    counts = np.bincount(phases)
    assert len(counts) < 0.65 * len(phases)
    assert np.median(counts) == 2
    sessions = [set(phases[bench.evidence.block_session == k].tolist()) for k in (0, 1)]
    assert not sessions[0] & sessions[1]


def test_a_law_that_is_coarse_says_so(bench: DiagnosisBench) -> None:
    contact = EFFECTS["contact"]
    shape = Shape(time=8.0, duration=1.5, session=1.0, link=3.0)
    found = bench.dictionary.trial(Candidate(contact, -1), shape)
    assert found is not None
    _, deviations = estimated(bench.dictionary, bench.evidence, found)
    assert deviations["time"] >= contact.law_std({"duration": 1.5}, None)["time"] > 0.1
    assert not EFFECTS["stribeck"].law_std({"amplitude": 1.0}, None)
