"""A weak push stands out in its middle only."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from ident.diagnosis import diagnose
from ident.dynamics.kinematics import Chain
from lwr_driver.session import Session


@pytest.mark.parametrize("size", [0.07, 0.08, 0.09, 0.1, 0.11, 0.12, 0.13])
def test_scan(make: Callable[..., Session], chain: Chain, size: float) -> None:
    random = np.random.default_rng(3)

    def restless(s: dict[str, np.ndarray]) -> None:
        count = len(s["time"])
        wave = np.zeros(count)
        knots = np.arange(0.0, s["time"][-1] + 1.0, 0.15)
        for joint in range(3):
            wave = np.interp(s["time"], knots, 0.05 * random.normal(size=len(knots)))
            s["joint"][:, joint] += wave
            s["motor"][:, joint] += wave

    def leaning(s: dict[str, np.ndarray]) -> None:
        restless(s)
        since = s["time"] - 8.0
        course = np.where(np.abs(since) < 1.5, np.cos(np.pi * since / 3.0), 0.0)
        s["joint"][:, 1] += size * course
        s["motor"][:, 1] += size * course

    found = diagnose([make("a.mcap", 1, leaning), make("b.mcap", 2, restless, 1)], chain, causes=["contact"])
    print(
        size,
        [
            (f.cause, f.parameters["time"].value, f.parameters["duration"].value, f.confidence)
            for f in found.claims
        ],
    )
