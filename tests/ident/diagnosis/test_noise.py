"""The noise that claims are held against."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from scipy.signal import correlate

from ident.diagnosis import bench as benches
from ident.diagnosis.candidates import Candidate
from ident.diagnosis.noise import _misfit
from ident.diagnosis.selection import Claim, Selection
from ident.diagnosis.settings import DiagnosisSettings
from ident.diagnosis.signatures import signature_bench
from ident.dynamics.kinematics import Chain
from ident.effects import EFFECTS, Shape
from ident.estimators.covariance import correlation_time
from lwr_driver.session import Session

Make = Callable[..., Session]


def sticky(s: dict[str, np.ndarray]) -> None:
    v = s["qd"][:, 1]
    s["motor"][:, 1] += 0.5 * np.sign(v) * np.exp(-np.abs(v) / 0.15)


def test_a_longer_correlation_of_less_residual_counts_half(
    make: Make, chain: Chain, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench = signature_bench([make("a.mcap", 1, sticky), make("b.mcap", 2, sticky, 1)], chain)
    evidence = bench.evidence
    trial = bench.dictionary.trial(Candidate(EFFECTS["stribeck"], 1), Shape(velocity=0.15, exponent=1.0))
    assert trial is not None
    ((side, joint),) = trial.rows
    before = float(evidence.sigma[side][joint] ** 2 * evidence.variance_inflation[side][joint])

    def longer(*_: object) -> object:
        sigma = {key: 0.9 * values for key, values in evidence.sigma.items()}
        return sigma, {key: 5.0 * values for key, values in evidence.variance_inflation.items()}, sigma, True

    monkeypatch.setattr(benches, "_noise", longer)
    selection = Selection([Claim(trial, trial.score)], {}, {}, [])
    again = benches.again_with(bench, selection, DiagnosisSettings(), None)
    assert again is not None
    after = again.evidence
    assert after.sigma[side][joint] == pytest.approx(0.9 * evidence.sigma[side][joint])
    assert after.sigma[side][joint] ** 2 * after.variance_inflation[side][joint] == pytest.approx(
        before * np.sqrt(5.0 * 0.9**2)
    )


def test_noise_of_a_residual_follows_its_autocorrelation(make: Make, chain: Chain) -> None:
    bench = signature_bench([make("a.mcap", 1), make("b.mcap", 2, None, 1)], chain)
    rows, random = bench.nominal.rows["joint"], np.random.default_rng(2)
    white = random.normal(size=rows.target.shape)
    residual = np.array([np.convolve(column, np.ones(6) / 6.0, "same") for column in white.T]).T
    residual[random.uniform(size=residual.shape) < 0.1] = np.nan
    sigma, inflation = _misfit(rows, residual)
    total = np.zeros(0)
    for session in np.unique(rows.session):
        d = np.nan_to_num(residual[(rows.session == session) & ~rows.test, 0])
        part = correlate(d, d, method="direct")[len(d) - 1 :][: max(8, len(d) // 3)]
        total = part if not len(total) else total + part
    assert sigma[0] == pytest.approx(np.sqrt(np.nanmean(residual[~rows.test, 0] ** 2)))
    assert inflation[0] == pytest.approx(correlation_time(total))
    assert 4.0 < inflation[0] < 8.0
