"""The noise that claims are held against."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from scipy.signal import correlate

import ident.diagnosis.healthy.bench as bench_module
from ident.diagnosis.causes.candidates import Candidate, Trial
from ident.diagnosis.causes.claims import Claim
from ident.diagnosis.causes.selection import Selection
from ident.diagnosis.healthy.bench import again_with
from ident.diagnosis.outcome.signatures import signature_bench
from ident.diagnosis.rows.noise import misfit
from ident.diagnosis.settings import DiagnosisSettings
from ident.dynamics.kinematics import Chain
from ident.effects import EFFECTS, Shape
from ident.estimators.covariance import correlation_time
from lwr_driver.session import Session

Make = Callable[..., Session]


def test_noise_of_a_residual_follows_its_autocorrelation(make: Make, chain: Chain) -> None:
    bench = signature_bench([make("a.mcap", 1), make("b.mcap", 2, None, 1)], chain)
    rows, random = bench.nominal.rows["joint"], np.random.default_rng(2)
    white = random.normal(size=rows.target.shape)
    residual = np.array([np.convolve(column, np.ones(6) / 6.0, "same") for column in white.T]).T
    residual[random.uniform(size=residual.shape) < 0.1] = np.nan
    sigma, inflation = misfit(rows, residual)
    total = np.zeros(0)
    for session in np.unique(rows.session):
        d = np.nan_to_num(residual[(rows.session == session) & ~rows.test, 0])
        part = correlate(d, d, method="direct")[len(d) - 1 :][: max(8, len(d) // 3)]
        total = part if not len(total) else total + part
    assert sigma[0] == pytest.approx(np.sqrt(np.nanmean(residual[~rows.test, 0] ** 2)))
    assert inflation[0] == pytest.approx(correlation_time(total))
    assert 4.0 < inflation[0] < 8.0


def test_noise_beside_a_healthy_arm_is_what_the_model_leaves(
    make: Make, chain: Chain, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Periods tell that of the sensors alone, and what a model lacks differs from motion to motion."""
    bench = signature_bench([make("a.mcap", 1), make("b.mcap", 2, None, 1)], chain)
    of_periods = np.full(chain.n, 1e-6), np.ones(chain.n), True
    monkeypatch.setattr(bench_module, "noise_floor", lambda *_: of_periods)
    residual = bench.evidence.residuals()
    for compared in (False, True):
        sigma, inflation, floor, repeats = bench_module._noise(bench.nominal, residual, compared=compared)
        for side, rows in bench.nominal.rows.items():
            expected = misfit(rows, residual[side]) if compared else of_periods[:2]
            np.testing.assert_array_equal((sigma[side], inflation[side]), expected)
            assert repeats
            assert np.nanmax(floor[side]) == 1e-6


def test_what_a_coarse_law_leaves_of_a_fault_is_no_noise(
    make: Make, chain: Chain, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A drift told as a step leaves more than the noise, and for long: counted as noise, it would hide the fault."""
    bench = signature_bench([make("a.mcap", 1), make("b.mcap", 2, None, 1)], chain)
    side, joint = "joint", 1
    rows = {(side, joint): np.sin(np.arange(len(bench.nominal.rows[side].time)))[:, None]}
    score = bench.evidence.score(rows)
    trial = Trial(Candidate(EFFECTS["sensor_ripple"], joint), Shape(), score, rows)
    selection = Selection([Claim(trial, score)])
    sigma, inflation = bench.evidence.sigma[side], bench.evidence.variance_inflation[side]
    sigma[:], inflation[:] = 0.1, 10.0
    for left, lasting, kept in (
        (0.5, 10.0, (0.2, 10.0)),
        (0.1, 90.0, (0.1, 40.0)),
        (0.05, 300.0, (0.05, 160.0)),
        (0.05, 20.0, (0.05, 20.0)),
    ):
        told = {name: (np.full(chain.n, left), np.full(chain.n, lasting)) for name in bench.nominal.rows}
        sizes, counts = ({name: pair[k] for name, pair in told.items()} for k in (0, 1))
        monkeypatch.setattr(bench_module, "_noise", lambda *_, compared, s=sizes, c=counts: (s, c, s, False))
        again = again_with(bench, selection, DiagnosisSettings(), None)
        assert again is not None
        found = again.evidence.sigma[side], again.evidence.variance_inflation[side]
        assert (found[0][joint], found[1][joint]) == pytest.approx(kept)
        assert (found[0][0], found[1][0]) == (0.1, 10.0)
