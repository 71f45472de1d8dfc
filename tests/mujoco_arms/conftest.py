"""A case that several tests look at."""

from __future__ import annotations

import pytest


@pytest.fixture(scope="session")
def lwr():
    """The first seconds of a healthy LWR4+ with encoders at its links."""
    from benchmarks.mujoco_arms.cases import draw
    from tests.mujoco_arms.motions import shortened

    return shortened(draw(9, "healthy", arm="lwr4plus"), 8.0)


@pytest.fixture(scope="session")
def bench(lwr):
    """Its healthy sessions, run once."""
    from benchmarks.mujoco_arms.cases import Bench

    return Bench(lwr)
