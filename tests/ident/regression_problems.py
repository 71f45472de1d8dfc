"""Small regressions with known truth."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.signal import lfilter

from ident.estimators import Problem, RowGroup

Array = np.ndarray


def ar1(random: np.random.Generator, n: int, rho: float) -> Array:
    """Unit-variance AR(1) noise."""
    start = [rho * random.normal()]
    return lfilter([np.sqrt(1 - rho**2)], [1, -rho], random.normal(size=n), zi=np.array(start))[0]


def design(
    p: int = 12, joints: int = 3, records: int = 2, samples: int = 200, seed: int = 0, dt: float = 0.2
) -> list[Array]:
    """One smooth (samples, p) matrix for each record and joint; column k belongs mostly to joint
    k % joints.
    """
    random = np.random.default_rng(seed)
    time = np.arange(samples) * dt
    matrices = []
    for _ in range(records):
        for joint in range(joints):
            matrix = np.zeros((samples, p))
            for k in range(p):
                if k % joints == joint or random.random() < 0.4:
                    waves = [
                        random.normal() * np.sin(2 * np.pi * f * time + random.uniform(0, 6)) for f in WAVES
                    ]
                    matrix[:, k] = np.sum(waves, axis=0)
            matrix[:, joint] = 1.0
            matrix[:, [k for k in range(joints) if k != joint]] = 0.0
            matrices.append(matrix)
    return matrices


WAVES = np.arange(1, 9) / 25.0


def problem(
    matrices: Sequence[Array],
    chi: Array,
    noise: Sequence[Array],
    *,
    joints: int = 3,
    dt: float = 0.2,
    measured: Sequence[Array] | None = None,
) -> Problem:
    """Rows matrices @ chi + noise; `measured` replaces the regressor of the estimator."""
    seen = matrices if measured is None else measured
    groups = tuple(
        RowGroup(
            f"A{k % joints + 1}",
            "joint",
            k // joints,
            seen[k],
            matrix @ chi + noise[k],
            np.arange(len(matrix)),
        )
        for k, matrix in enumerate(matrices)
    )
    return Problem(tuple(f"p{k}" for k in range(len(chi))), groups, dt)
