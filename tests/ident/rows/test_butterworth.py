"""The low-pass and the spectrum against `scipy.signal`."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import butter, sosfilt_zi, sosfiltfilt, welch

from ident.rows.butterworth import forward_and_back, sections, spectrum, steady


@pytest.mark.parametrize("order", [2, 4, 6, 8])
@pytest.mark.parametrize("cutoff", [0.004, 0.02, 0.1, 0.35, 0.8, 0.99])
def test_sections_and_steady_state_are_those_of_scipy(order: int, cutoff: float) -> None:
    mine, theirs = sections(order, cutoff), butter(order, cutoff, output="sos")
    np.testing.assert_allclose(mine, theirs, rtol=1e-12, atol=1e-14)
    np.testing.assert_allclose(steady(mine), sosfilt_zi(theirs), rtol=1e-7, atol=1e-12)


@pytest.mark.parametrize("cutoff", [0.004, 0.02, 0.1, 0.35])
def test_the_filter_of_order_four_is_that_of_scipy_to_the_last_bit(cutoff: float) -> None:
    values = np.random.default_rng(1).normal(size=(3000, 7)).cumsum(axis=0)
    for pad in (0, 5, 700):
        theirs = sosfiltfilt(butter(4, cutoff, output="sos"), values, axis=0, padlen=pad)
        assert np.array_equal(forward_and_back(sections(4, cutoff), values, pad), theirs)


@pytest.mark.parametrize("order", [1, 3, 5, 6])
def test_filters_of_other_orders_are_those_of_scipy(order: int) -> None:
    values = np.random.default_rng(1).normal(size=(3000, 2)).cumsum(axis=0)
    theirs = sosfiltfilt(butter(order, 0.05, output="sos"), values, axis=0, padlen=100)
    np.testing.assert_allclose(
        forward_and_back(sections(order, 0.05), values, 100), theirs, rtol=1e-9, atol=1e-9
    )


@pytest.mark.parametrize("segment", [256, 301, 2000])
def test_the_spectrum_has_the_shares_of_scipy(segment: int) -> None:
    signal = np.random.default_rng(2).normal(size=2000).cumsum()
    frequency, power = spectrum(signal, 0.01, segment)
    theirs, density = welch(signal, fs=100.0, nperseg=segment, detrend="linear", window="blackmanharris")
    np.testing.assert_allclose(frequency, theirs, rtol=1e-12)
    np.testing.assert_allclose(power / power.sum(), density / density.sum(), rtol=1e-8, atol=1e-14)
