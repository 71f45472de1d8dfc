"""Products of columns beside others: remembered, forgotten and made again, and what follows from them."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from ident.diagnosis.causes.candidates import Candidate
from ident.diagnosis.gain import block_products
from ident.diagnosis.gain.products import Rows
from ident.diagnosis.healthy.bench import DiagnosisBench
from ident.diagnosis.outcome.signatures import signature_bench
from ident.dynamics.kinematics import Chain
from ident.effects import EFFECTS
from lwr_driver.session import Session


@pytest.fixture
def bench(make: Callable[..., Session], chain: Chain) -> DiagnosisBench:
    return signature_bench([make("a.mcap", 1), make("b.mcap", 2, None, 1)], chain)


def of(bench: DiagnosisBench, cause: str, joint: int) -> Rows:
    shape = EFFECTS[cause].shapes(bench.dictionary.setting, max(joint, 0))[0]
    return bench.dictionary.rows(Candidate(EFFECTS[cause], joint), shape)


def columns_of(bench: DiagnosisBench) -> list[Rows]:
    causes = ("viscous_nonlinear", 0), ("joint_torque_delay", -1), ("sensor_gain", 1)
    return [of(bench, cause, joint) for cause, joint in causes]


@pytest.mark.parametrize("spare_bytes", [0, 2**27])
def test_remembered_products_are_those_of_the_present_columns(
    bench: DiagnosisBench, spare_bytes: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(block_products, "_SPARE_BYTES", spare_bytes)
    evidence, rows = bench.evidence, columns_of(bench)
    columns = of(bench, "base_tilt", -1)
    known = evidence.products.alone(columns)
    numbers, fits = [], []
    for extra in ([rows[0], rows[1]], [rows[1]], [rows[2], rows[0], rows[1]], [], [rows[0], rows[1]]):
        evidence.replace(extra)
        numbers.append(evidence.beside_what)
        fits.append(evidence.full.values)
        again, fresh = evidence.products.beside(columns, known), evidence.products.beside(columns)
        for here, there in zip(again.sums, fresh.sums, strict=True):
            np.testing.assert_allclose(here, there, atol=1e-12 * np.abs(there).max())
        blocks = evidence.products.in_blocks(again)
        np.testing.assert_allclose(again.sums[0], np.einsum("pb,bkl->pkl", evidence.parts, blocks))
        further = sum(next(iter(r.values())).shape[1] for r in extra)
        assert blocks.shape[2] == evidence.base_count + further
    np.testing.assert_allclose(fits[-1], fits[0], rtol=1e-9)
    # Forgotten columns come back as others.
    assert (numbers[-1] == numbers[0]) == (spare_bytes > 0)
    assert (len(evidence.products._groups) == 2) == (spare_bytes == 0)
    assert set(known.crossed) <= {group.number for group in evidence.products._groups.values()}


def test_sums_over_parts_and_covariances_are_those_of_all_products_of_blocks(bench: DiagnosisBench) -> None:
    evidence, rows = bench.evidence, columns_of(bench)
    evidence.replace(rows)
    gram, target = evidence.products.sums(np.arange(evidence.blocks))
    fit = evidence.full
    np.testing.assert_allclose(gram.sum(axis=0) @ fit.values, target.sum(axis=0), rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(gram, gram.transpose(0, 2, 1))
    of_parts = evidence.products.sums(np.argmax(evidence.parts, axis=0))
    for found, expected in zip(of_parts, (evidence._part_gram, evidence._part_target), strict=True):
        np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-9 * np.abs(expected).max())

    def covariance(scores: np.ndarray, inverse: np.ndarray) -> np.ndarray:
        middle = len(scores) / (len(scores) - 1) * scores.T @ scores
        return np.asarray(inverse @ middle @ inverse)

    whole = covariance(target - gram @ fit.values, fit.inverse)
    larger = np.diag(whole) > np.diag(fit.inverse)
    assert larger.any()
    np.testing.assert_allclose(np.diag(evidence.covariance())[larger], np.diag(whole)[larger], rtol=1e-6)

    # Of one group beside the others, from the fit with all of them.
    evidence.replace(rows[:2])
    score = evidence.score(rows[2])
    place = slice(len(fit.values) - len(score.coefficients), None)
    np.testing.assert_allclose(score.coefficients, fit.values[place], rtol=1e-6)
    active = score.uncertainty[1] / (score.uncertainty[1] - 1)
    expected = np.diag(whole)[place] * active / (evidence.blocks / (evidence.blocks - 1))
    expected = np.maximum(expected, np.diag(fit.inverse)[place])
    np.testing.assert_allclose(np.diag(score.covariance), expected, rtol=1e-5)
