"""Changes of the sessions of the three-joint arm that several tests make."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from lwr_driver.session import Session

Make = Callable[..., Session]
Signals = dict[str, np.ndarray]


def pair(make: Make, change: Callable[[Signals], None] | None = None, seed: int = 1) -> list[Session]:
    return [make("a.mcap", seed, change), make("b.mcap", seed + 1, change, 1)]


def stribeck(s: Signals) -> None:
    v = s["qd"][:, 1]
    s["motor"][:, 1] += 0.3 * np.sign(v) * np.exp(-np.abs(v) / 0.15)
