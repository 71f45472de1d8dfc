"""Stated intervals and essential parameters against the emulator's true parameters.

A few pairs of sessions with fixed seeds; `benchmarks/coverage.py` draws as many as wanted.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import pytest

from ident.estimation.identification import Identification, IdentificationSettings
from ident.estimation.identify import identify
from runner.published import TABLE_2
from tests.ident.estimation.emulated_sessions import record_pair
from tests.ident.estimation_arm import chain, true_base

pytestmark = pytest.mark.slow

SEEDS = (11, 12, 13)


@pytest.fixture(scope="module")
def pairs(tmp_path_factory: pytest.TempPathFactory) -> list[Identification]:
    folder = tmp_path_factory.mktemp("pairs")
    return [
        identify(record_pair(folder, seed, period_s=12.0, cycle_ms=8), chain(), IdentificationSettings())
        for seed in SEEDS
    ]


@lru_cache
def published() -> set[str]:
    return {entry.name for entry in TABLE_2}


def test_stated_intervals_hold_the_truth_in_95_of_100_cases(pairs: list[Identification]) -> None:
    inside, textbook = [], []
    for found in pairs:
        truth = true_base(found)
        for shares, kind in ((inside, None), (textbook, "textbook")):
            low, high = found.estimate.interval(0.95, covariance=kind).T
            shares.append((low < truth) & (truth < high))
    # Three pairs of correlated parameters: the share scatters by some per cent.
    assert 0.88 <= np.mean(inside) <= 0.98
    assert np.mean(textbook) < np.mean(inside)


def test_essential_parameters_are_those_of_table_2_and_others_that_the_arm_really_has(
    pairs: list[Identification],
) -> None:
    for found in pairs:
        assert found.essential is not None
        truth = dict(zip(found.base.names, true_base(found), strict=True))
        essential = set(found.essential.names)
        # A random motion hides little of Table 2; nothing visible in gravity or friction is lost.
        assert len(published() - essential) <= 4
        zero = [name for name in essential - published() if truth[name] == 0.0]
        assert len(zero) <= 4
