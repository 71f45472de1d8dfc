"""Sessions of the emulated arm with known true parameters: controller, link and log in one process."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from ident.excitation import FourierBasis
from lwr_driver.arm import Arm
from lwr_driver.motion import Motion, check_motion
from lwr_driver.session import Session, read_session
from tests.hidden_physics.recording import Order, record

__all__ = ["random_motion", "record_pair"]

_HARMONICS = 5
_REST_S = 0.4


@lru_cache
def _arm() -> Arm:
    return Arm.load()


def random_motion(seed: int, period_s: float, periods: int, cycle_s: float) -> Motion:
    """Rest, periods of a random Fourier series, rest: three quarters of the limits at most.

    Nothing stands around the emulated arm, so there is nothing to collide with.
    """
    limits = _arm().limits
    basis = FourierBasis(period_s, _HARMONICS)
    series = basis.motion(np.random.default_rng(seed).normal(size=(7, basis.free)))
    time = np.linspace(0.0, period_s, 2000)
    swing = series.derivative(time, 0)
    middle, reach = 0.5 * (swing.max(axis=0) + swing.min(axis=0)), 0.5 * np.ptp(swing, axis=0)
    shares = [0.75 * 0.5 * (limits.q_high - limits.q_low) / reach]
    for order, bound in ((1, limits.v_max), (2, limits.a_max)):
        shares.append(0.75 * bound / np.abs(series.derivative(time, order)).max(axis=0))
    scale = np.min(shares, axis=0)
    count = round(period_s / cycle_s)
    q = (series.derivative(np.arange(periods * count + 1) * cycle_s, 0) - middle) * scale
    q += 0.5 * (limits.q_high + limits.q_low)
    rest = round(_REST_S / cycle_s)
    rows = np.vstack([np.tile(q[:1], (rest, 1)), q, np.tile(q[-1:], (rest, 1))])
    marks = [(rest + k * count, f"period {k + 1}") for k in range(periods)]
    motion = Motion(rows, cycle_s, ((0, "settle"), *marks, (rest + periods * count, "brake")))
    check_motion(_arm(), motion)
    return motion


def record_pair(
    folder: Path,
    seed: int,
    *,
    period_s: float = 20.0,
    periods: int = 2,
    cycle_ms: int = 4,
    settings: Mapping[str, Any] | None = None,
    payloads: Sequence[str] = ("none", "paper_load"),
) -> list[Session]:
    """A session of the bare arm and one with the payload, or those of `payloads`, with one random motion and fresh
    noise."""
    motion = random_motion(seed, period_s, periods, 1e-3 * cycle_ms)
    sessions = []
    for number, payload in enumerate(payloads):
        order = Order(
            motion,
            folder / f"{seed}_{payload}.mcap",
            {"fri.period_ms": cycle_ms, **(settings or {})},
            uid=f"{seed}-{payload}",
            seed=2 * seed + number,
            payload=payload,
        )
        sessions.append(read_session(record(order)))
    return sessions
