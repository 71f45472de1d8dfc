"""A weak push stands out in its middle only."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from ident.diagnosis import diagnose
from ident.dynamics.kinematics import Chain
from lwr_driver.session import Session


@pytest.mark.parametrize("size", [0.02, 0.03,0.04,0.05, 0.06,0.08, 0.1])
def test_scan(make: Callable[..., Session], chain: Chain, size: float) -> None:
    def leaning(s: dict[str, np.ndarray]) -> None:
        since = s["time"] - 8.0
        course = np.where(np.abs(since) < 1.5, np.cos(np.pi * since / 3.0), 0.0)
        s["joint"][:, 1] += size * course
        s["motor"][:, 1] += size * course

    found = diagnose([make("a.mcap", 1, leaning), make("b.mcap", 2, None, 1)], chain, causes=["contact"])
    print(size, [(f.cause, f.parameters["time"].value, f.parameters["duration"].value, f.confidence) for f in found.claims])
