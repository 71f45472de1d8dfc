"""The noise that claims are held against."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from scipy.signal import correlate

from ident.diagnosis.noise import _misfit
from ident.diagnosis.signatures import signature_bench
from ident.dynamics.kinematics import Chain
from ident.estimators.covariance import correlation_time
from lwr_driver.session import Session

Make = Callable[..., Session]


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
