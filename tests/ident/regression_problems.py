"""Small regressions with known truth."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.signal import lfilter

from ident.dynamics.parameters import from_com
from ident.estimators import BodyPrior, Problem, RowGroup

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


CHI = np.linspace(-2.0, 2.5, 12)


def noisy(seed: int = 1, scale: tuple[float, ...] = (0.05, 0.3, 1.0), **changes: int) -> Problem:
    matrices = design(**changes)
    random = np.random.default_rng(seed)
    noise = [scale[k % 3] * random.normal(size=len(m)) for k, m in enumerate(matrices)]
    return problem(matrices, CHI, noise)


def stack(case: Problem) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """All rows, targets and the class of each row."""
    matrix = np.vstack([group.matrix for group in case.groups])
    target = np.concatenate([group.target for group in case.groups])
    return matrix, target, np.repeat(case.class_of_group, [len(g.target) for g in case.groups])


BODY = from_com(2.0, [0.05, -0.02, 0.1], np.diag([0.02, 0.018, 0.006]))


def body_prior(relative_std: float = 0.2, **changes: np.ndarray) -> BodyPrior:
    """Two bodies and two drive parameters, seen as they are."""
    inertial = np.array([BODY, 0.5 * BODY])
    settings = {
        "projection": np.eye(22),
        "bodies": np.arange(20).reshape(2, 10),
        "nonnegative": np.array([20, 21]),
        "inertial": inertial,
    }
    return BodyPrior(**{**settings, **changes}, relative_std=relative_std)  # type: ignore[arg-type]
