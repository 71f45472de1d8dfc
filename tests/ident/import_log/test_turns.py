"""Angles that wrap are unwrapped, and nothing else is touched."""

from __future__ import annotations

import numpy as np
import pytest

from ident.import_log.turns import unwrapped

TIME = np.arange(2000) * 0.004


def swing(noise: float = 0.0) -> np.ndarray:
    """One joint (2000, 1) that swings across half a turn."""
    random = np.random.default_rng(4)
    return (3.1 + 0.6 * np.sin(2.0 * TIME) + noise * random.normal(size=len(TIME)))[:, None]


def wrapped(angle: np.ndarray) -> np.ndarray:
    return np.asarray((angle + np.pi) % (2.0 * np.pi) - np.pi)


@pytest.mark.parametrize("noise", [0.0, 1e-3])
def test_a_wrapped_angle_is_that_of_the_joint_again(noise: float) -> None:
    """Noise makes an angle near half a turn wrap from sample to sample."""
    found, (places,) = unwrapped(wrapped(swing(noise)))
    np.testing.assert_allclose(found, swing(noise), atol=1e-12)
    assert len(places) == np.count_nonzero(np.abs(np.diff(wrapped(swing(noise)), axis=0)) > 3.0)


def test_a_joint_at_rest_on_the_line_is_unwrapped() -> None:
    rest = np.pi + 1e-5 * np.random.default_rng(1).normal(size=(500, 1))
    found, (places,) = unwrapped(wrapped(rest))
    assert len(places) > 100
    assert np.ptp(found) < 1e-4


@pytest.mark.parametrize("size", [0.5, 4.0, 5.9, 4.0 * np.pi])
def test_other_steps_stay(size: float) -> None:
    angle = swing()
    angle[700:] += size
    angle[1200] += 5.0
    found, (places,) = unwrapped(angle)
    assert found is angle
    assert not len(places)


def test_a_motor_too_fast_for_its_samples_stays() -> None:
    angle = np.cumsum(np.random.default_rng(2).uniform(-9.0, 9.0, (400, 1)), axis=0)
    found, _ = unwrapped(angle)
    np.testing.assert_array_equal(found, angle)


def test_columns_are_unwrapped_by_themselves() -> None:
    both = np.hstack([wrapped(swing()), swing()])
    found, places = unwrapped(both)
    np.testing.assert_allclose(found, np.hstack([swing(), swing()]), atol=1e-12)
    assert [len(own) > 0 for own in places] == [True, False]
