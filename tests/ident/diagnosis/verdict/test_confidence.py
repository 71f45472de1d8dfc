"""Confidence as a function of grounds: monotone, complete, and fitted again by one command."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.confidence import fit, judged, reliability
from ident.diagnosis.causes.candidates import _scan
from ident.diagnosis.outcome.claims_in_words import SURE
from ident.diagnosis.verdict.confidence import LIMITS, OPEN, SIGNS, Grounds, believable, probability, scaled

USUAL = Grounds(
    gain=3.0,
    significance=8.0,
    rivals=4.0,
    held_out=2.5,
    untested=0.0,
    felt=0.15,
    one_block=0.0,
    worse=0.0,
    rest=0.2,
    replaceable=0.2,
    habitual=0.0,
    company=1.0,
)


@pytest.mark.parametrize("ground", [name for name, sign in SIGNS.items() if sign])
def test_more_for_a_finding_never_lowers_its_confidence(ground: str) -> None:
    low, high = LIMITS[ground]
    course = [
        probability(replace(USUAL, **{ground: float(value)}))
        for value in np.linspace(low - 1.0, high + 1.0, 9)
    ]
    assert np.all(SIGNS[ground] * np.diff(course) >= 0.0)
    assert 0.0 < min(course) <= max(course) < 1.0


def test_grounds_beyond_their_range_count_as_its_end() -> None:
    assert scaled(replace(USUAL, gain=1e9).to_dict())[0] == 1.0
    assert scaled(replace(USUAL, gain=-5.0).to_dict())[0] == 0.0
    assert tuple(USUAL.to_dict()) == (*LIMITS, "alone")
    assert tuple(LIMITS) == tuple(SIGNS)


def test_no_weights_make_a_claim_sure_that_a_test_leaves_open() -> None:
    sure = replace(
        USUAL, gain=6.0, significance=12.0, rivals=6.0, held_out=5.0, felt=0.3, rest=0.0, company=0.0
    )
    assert probability(sure) > SURE > OPEN >= probability(replace(sure, held=1.0))


def test_a_finding_is_told_if_one_of_its_causes_is_more_likely_right_than_none() -> None:
    assert believable({})
    plain = replace(USUAL, gain=2.4, rest=0.0, replaceable=0.0)
    assert believable(plain.to_dict())
    assert not believable(replace(plain, gain=0.0, significance=3.0, felt=0.0).to_dict())
    # Even odds between two names are no doubt about both.
    between = replace(plain, rivals=-1.0)
    assert probability(between) < 0.5 < probability(replace(between, rivals=6.0))
    assert believable(between.to_dict())


def test_the_fit_finds_the_odds_behind_findings() -> None:
    rng = np.random.default_rng(1)
    points = rng.uniform(0.0, 1.0, (4000, len(LIMITS)))
    odds = -1.0 + 4.0 * points[:, 0] - 2.0 * points[:, list(LIMITS).index("rest")]
    right = (rng.uniform(size=4000) < 1.0 / (1.0 + np.exp(-odds))).astype(float)
    theta = fit(points, right, np.ones(4000), 0.1)
    assert theta[0] == pytest.approx(-1.0, abs=0.5)
    assert theta[1] == pytest.approx(4.0, abs=0.4)
    assert theta[1 + list(LIMITS).index("rest")] == pytest.approx(-2.0, abs=0.4)
    p = 1.0 / (1.0 + np.exp(-theta[0] - points @ theta[1:]))
    assert reliability(p, right)[1] < 0.02
    assert reliability(np.full(4000, 0.99), right)[1] > 0.2


def test_a_fit_onward_stays_near_the_earlier_one_where_findings_are_few() -> None:
    rng = np.random.default_rng(3)
    points = rng.uniform(0.0, 1.0, (4000, len(LIMITS)))
    start = judged()
    start[1] = 5.0
    few = fit(points[:4], np.zeros(4), np.ones(4), 1.0, start)
    many = fit(points, np.zeros(4000), np.ones(4000), 1.0, start)
    assert np.max(np.abs(few - start)) < 1.0
    assert many[0] < start[0] - 2.0


def test_a_weak_push_of_two_seconds_stands_out_in_no_window_and_is_found() -> None:
    rng = np.random.default_rng(2)
    counts = np.full(300, 35.0)
    sums = rng.chisquare(35, 300)
    assert list(_scan(counts, sums)) == []
    sums[120:140] *= 1.8
    (low, length, excess), *_ = _scan(counts, sums)
    assert low + length / 2 == pytest.approx(130, abs=6)
    assert excess > 0.5 * 20 * 35 * 0.8
    # A model's error that grows along the whole session is no burst.
    assert list(_scan(counts, rng.chisquare(35, 300) * np.linspace(0.5, 2.0, 300))) == []
