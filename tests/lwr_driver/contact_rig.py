"""A quick motion, and what a watch of torque and contact says of it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lwr_driver.contact import Contact, ContactWatch

Floats = NDArray[np.float64]
HOME = np.array([0.0, 0.5, 0.0, -1.3, 0.0, 0.8, 0.0])
NOTHING = np.zeros(7, np.float32)


def swing(period_s: float, seconds: float = 1.5) -> tuple[Floats, Floats, Floats]:
    """A quick motion of all joints about home."""
    time = np.arange(0.0, seconds, period_s)[:, None]
    rate = 2.0 * np.pi * np.array([0.7, 0.8, 0.9, 1.0, 1.1, 1.2, 1.3])
    # The cosine is at rest in the beginning.
    size = 0.2
    return (
        HOME + size * (1.0 - np.cos(rate * time)),
        size * rate * np.sin(rate * time),
        size * rate**2 * np.cos(rate * time),
    )


def follow(
    made: ContactWatch, q: Floats, tau: Floats, estimate: Floats | None = None, gravity: Floats | None = None
) -> tuple[list[Contact | None], Floats]:
    """What the watch says in each cycle, and its estimate."""
    found, external = [], []
    for row in range(len(q)):
        other = NOTHING if estimate is None else estimate[row].astype(np.float32)
        weight = NOTHING if gravity is None else gravity[row].astype(np.float32)
        found.append(made.update(1, q[row].astype(np.float32), tau[row].astype(np.float32), other, weight))
        external.append(made.external.copy())
    return found, np.array(external)
