"""Rows made again with other predictions: what these leave as it was is not computed anew."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from ident.diagnosis.gain.evidence import Evidence
from ident.diagnosis.gain.fitted_rows import FittedRows
from ident.diagnosis.outcome.signatures import signature_bench
from ident.diagnosis.rows.nominal import Nominal
from ident.dynamics.kinematics import Chain
from ident.effects.motion import Floats
from lwr_driver.session import Session


@pytest.fixture
def elastic(make: Callable[..., Session], chain: Chain) -> tuple[Nominal, Floats]:
    """Rows of an arm whose drives move otherwise than its links, and base parameters near those of the sessions."""
    bench = signature_bench([make("a.mcap", 1), make("b.mcap", 2, None, 1)], chain)
    whole, values = bench.nominal, bench.evidence.full.values[: bench.evidence.base_count]
    arm = replace(whole.arm, compliance=np.full(chain.n, 1e-3))
    nominal = Nominal(arm, whole.recordings, whole.settings, whole.structure, whole.base)
    nominal.refine(values)
    return nominal, 1.1 * values


def test_links_that_move_as_before_keep_their_rows(elastic: tuple[Nominal, Floats]) -> None:
    nominal, values = elastic
    joint, motor = nominal.rows["joint"], nominal.rows["motor"].matrix.copy()
    nominal.refine(values)
    anew = replace(nominal)
    assert nominal.rows["joint"] is joint
    assert np.any(nominal.rows["motor"].matrix != motor)
    for side in ("motor", "joint"):
        for name in ("matrix", "target", "valid", "time"):
            mine, other = getattr(nominal.rows[side], name), getattr(anew.rows[side], name)
            np.testing.assert_array_equal(mine, other, err_msg=f"{side} {name}")


def test_products_of_rows_that_stay_are_kept_for_any_noise(elastic: tuple[Nominal, Floats]) -> None:
    nominal, values = elastic
    before = FittedRows(nominal, nominal.settings)
    nominal.refine(values)
    again = FittedRows(nominal, nominal.settings, before)
    assert all((again.keys[key] is own) == (key[0] == "joint") for key, own in before.keys.items())
    noise = {side: np.array([0.05, 0.04, 0.03]) for side in nominal.rows}
    one = {side: np.ones(3) for side in nominal.rows}
    mine = Evidence(nominal, nominal.settings, noise, one, fitted_rows=again)
    other = Evidence(nominal, nominal.settings, noise, one)
    assert mine.fitted_rows is again
    np.testing.assert_array_equal(mine.full.values, other.full.values)
    each = np.arange(mine.blocks)
    for one_sum, other_sum in zip(mine.products.sums(each), other.products.sums(each), strict=True):
        np.testing.assert_array_equal(one_sum, other_sum)
    assert mine.chi_square == other.chi_square
