"""Rivals of a cause explain its part of the error, not merely another part of the same rows."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from ident.diagnosis import DiagnosisSettings
from ident.diagnosis.causes.candidates import Candidate, Trial
from ident.diagnosis.causes.contest import Contest
from ident.diagnosis.gain.rivals import confidence, look_alikes
from ident.diagnosis.outcome.signatures import signature_bench
from ident.dynamics.kinematics import Chain
from ident.effects import EFFECTS, Shape
from lwr_driver.session import Session


def test_two_causes_in_the_same_rows_do_not_compete(make: Callable[..., Session], chain: Chain) -> None:
    def rough(s: dict[str, np.ndarray]) -> None:
        q, v = s["q"][:, 1], s["qd"][:, 1]
        s["motor"][:, 1] += 0.4 * np.sign(v) * np.exp(-np.abs(v) / 0.15) + 0.6 * np.sin(12.0 * q)

    bench = signature_bench([make("a.mcap", 1, rough), make("b.mcap", 2, rough, 1)], chain)
    contest = Contest(bench.dictionary, DiagnosisSettings())

    def trial(cause: str, **shape: float) -> Trial:
        found = bench.dictionary.trial(Candidate(EFFECTS[cause], 1), Shape(**shape))
        assert found is not None
        return found

    contest.tolerated.beside([])
    here = trial("stribeck", velocity=0.15, exponent=1.0)
    other_form = trial("stribeck", velocity=0.25, exponent=1.0)
    ripple = trial("gear_ripple", cycles_per_turn=12.0, gear_ratio=1.0)
    assert ripple.score.gain > here.score.gain > 0.0
    assert contest.competing(here, [ripple, other_form], []) == [other_form]


@pytest.mark.parametrize(("own", "left"), [(0.0, 1), (3.0, 2)])
def test_a_hose_leaves_a_spring_at_its_second_joint_only_what_it_does_not_explain(
    make: Callable[..., Session], chain: Chain, own: float, left: int
) -> None:
    def hose(s: dict[str, np.ndarray]) -> None:
        pull = 4.0 * (s["q"][:, 1] + 1.1 * s["q"][:, 2])
        for side in ("motor", "joint"):
            s[side][:, 1] += pull
            s[side][:, 2] += 1.1 * pull + own * s["q"][:, 2] ** 3

    bench = signature_bench([make("a.mcap", 1, hose), make("b.mcap", 2, hose, 1)], chain)
    contest = Contest(bench.dictionary, DiagnosisSettings())
    contest.tolerated.beside([])
    spring = Candidate(EFFECTS["cable_spring"], 2)
    alone = bench.dictionary.best(spring)
    assert alone is not None
    contest.tolerated.beside([alone])
    both = bench.dictionary.best(Candidate(EFFECTS["cable_spring"], 1))
    assert both is not None
    assert both.shape.form_name == "over two joints"
    kept = contest.merged([alone, both])
    assert [t.candidate.joint for t in kept] == [2, 1][-left:]


def test_best_shapes_are_found_once_beside_the_same_columns_and_anew_beside_others(
    make: Callable[..., Session], chain: Chain
) -> None:
    bench = signature_bench([make("a.mcap", 1), make("b.mcap", 2, None, 1)], chain)

    def contest() -> Contest:
        causes = bench.dictionary.of(["stribeck", "gear_ripple"])
        return Contest(causes, DiagnosisSettings())

    one, other = contest(), contest()
    one.tolerated.beside([])
    alone = one.simplest()
    one.tolerated.beside(alone[:1])
    beside = one.simplest()
    one.tolerated.beside([])
    assert one.simplest() is alone
    for accepted, found in (([], alone), (alone[:1], beside)):
        other.tolerated.beside(accepted)
        again = other.simplest()
        assert again is not found
        assert [t.candidate.key for t in again] == [t.candidate.key for t in found]
        assert [t.score.gain for t in again] == [t.score.gain for t in found]
    shared = {t.candidate.key: t.score.gain for t in alone}
    assert any(t.score.gain != shared[t.candidate.key] for t in beside if t.candidate.key in shared)


def test_what_two_look_alikes_share_counts_for_the_other_one(
    make: Callable[..., Session], chain: Chain
) -> None:
    def rough(s: dict[str, np.ndarray]) -> None:
        v = s["qd"][:, 1]
        s["motor"][:, 1] += 0.4 * np.sign(v) * np.exp(-np.abs(v) / 0.15)

    bench = signature_bench([make("a.mcap", 1, rough), make("b.mcap", 2, rough, 1)], chain)
    contest = Contest(bench.dictionary, DiagnosisSettings())
    stribeck = Candidate(EFFECTS["stribeck"], 1)
    shapes = [Shape(velocity=speed, exponent=1.0) for speed in (0.15, 0.2)]

    def trials() -> list[Trial]:
        return [t for t in (bench.dictionary.trial(stribeck, shape, 1) for shape in shapes) if t is not None]

    contest.tolerated.beside([])
    alone = trials()
    contest.tolerated.beside(alone[1:])
    beside = trials()[0].score.gain
    (other,) = contest.others(alone, 1)
    assert other.shape == shapes[0]
    assert np.isclose(other.score.gain, alone[0].score.gain)
    assert other.score.gain > 5.0 * max(beside, 1.0)


def test_a_claim_that_rivals_make_unsure_lists_the_nearest() -> None:
    first, second = (Candidate(EFFECTS[cause], 1) for cause in ("stribeck", "gear_ripple"))
    # Both beyond the margin of 112: each leaves it sure, both together do not.
    one, both = [(first, 885.0)], [(first, 885.0), (second, 880.0)]
    assert confidence(1000.0, [g for _, g in one]) > 0.8 > confidence(1000.0, [g for _, g in both])
    assert look_alikes(1000.0, one, confidence(1000.0, [885.0])) == ()
    assert look_alikes(1000.0, both, confidence(1000.0, [885.0, 880.0])) == ((first, 885.0),)
    assert look_alikes(1000.0, [(first, 900.0), (second, 895.0)], 0.7) == ((first, 900.0), (second, 895.0))
