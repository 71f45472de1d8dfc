"""Errors of the torque channels in the stated covariance: gains and crosstalk, by the disagreement of the channels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np
import pytest

from ident.estimation.channel_errors import EXACT_CHANNELS, beside_channel_errors
from ident.estimation.identification import Identification, IdentificationSettings, Known
from ident.estimation.identify import identify
from ident.estimators import CovarianceSettings
from lwr_driver.session import Session
from tests.ident.estimation_arm import Sensors, at_125_hz, chain, true_base

NOISE = Sensors(joint=0.2, motor=0.3)


@lru_cache
def recorded() -> tuple[Session, ...]:
    return tuple(at_125_hz(loaded=loaded, seed=3 + loaded, sensors=NOISE) for loaded in (False, True))


def with_channels(gain: float, crosstalk: float, seed: int) -> list[Session]:
    """The sessions with gains and crosstalk of these standard deviations."""
    random = np.random.default_rng(seed)
    found = list(recorded())
    for side in ("joint", "motor"):
        matrix = np.eye(7) * (1.0 + gain * random.normal(size=7))
        matrix += crosstalk * random.normal(size=(7, 7)) * (np.eye(7, k=1) + np.eye(7, k=-1))
        for k, one in enumerate(found):
            channel = getattr(one, side)
            changed: dict[str, Any] = {side: replace(channel, effort=channel.effort @ matrix.T)}
            found[k] = replace(one, **changed)
    return found


def identified(sessions: Sequence[Session], **more: Any) -> Identification:
    return identify(sessions, chain(), IdentificationSettings(essential=None, **more), known=Known())


def near(found: Identification, std: np.ndarray) -> float:
    """Share of the parameters within two standard deviations of the truth."""
    return float(np.mean(np.abs(found.estimate.values - true_base(found)) < 2.0 * std))


@pytest.mark.slow
@pytest.mark.parametrize(("gain", "crosstalk"), [(0.01, 0.0), (0.0, 0.01)])
def test_the_deviations_hold_with_channels_off_by_a_per_cent(gain: float, crosstalk: float) -> None:
    before, after = [], []
    for seed in (1, 2):
        found = identified(with_channels(gain, crosstalk, seed))
        before.append(near(found, found.estimate.covariances[EXACT_CHANNELS].std))
        after.append(near(found, found.estimate.std))
    assert np.mean(before) < 0.85
    assert np.mean(after) > 0.95


def test_exact_channels_hardly_widen_the_deviations() -> None:
    found = identified(recorded())
    ratio = found.estimate.std / found.estimate.covariances[EXACT_CHANNELS].std
    assert np.median(ratio) < 1.1
    assert "beside errors of the torque channels (gains 0.0" in found.estimate.covariance.kind


def test_the_estimate_and_the_textbook_covariance_stay() -> None:
    sessions = with_channels(0.006, 0.006, 1)
    found = identified(sessions)
    plain = identified(sessions, covariance=CovarianceSettings("textbook"))
    assert np.array_equal(found.estimate.values, plain.estimate.values)
    assert plain.estimate.covariance is plain.estimate.covariances["textbook"]


def test_rows_of_the_difference_of_two_channels_tell_none() -> None:
    found = identified(recorded(), model=3)
    assert beside_channel_errors(found.problem, found.estimate) is found.estimate


def test_data_without_noise_give_finite_deviations() -> None:
    found = identified([at_125_hz(loaded=loaded) for loaded in (False, True)])
    assert np.all(np.isfinite(found.estimate.std))
    assert np.all(np.linalg.eigvalsh(found.estimate.covariance.matrix) > -1e-12)
