"""Base parameters from the rank of observation matrices at random states (Gautier 1991).

Random states excite every combination that any motion can excite, so dependence among the columns of the
sampled matrix is dependence of the model. Rounding leaves dependent columns at 1e-15 of the independent ones,
and real dependence on the geometry (link lengths of a centimetre) leaves singular values above 1e-6: the gap
between the two is nine orders of magnitude wide, and the rank is read off at its widest place.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from fri.errors import DataError
from ident.base.base_set import BaseSet, base_set
from ident.structure import Condition, ModelStructure

__all__ = ["numeric_base", "random_states", "rank_at_gap"]

_FLOOR = 1e-8
_SMALLEST_GAP = 1e3
# Columns this small beside the largest are rounding, or an angle a billionth off the right one.
_ZERO = 1e-8

Floats = NDArray[np.float64]


def random_states(
    structure: ModelStructure, samples: int, rng: np.random.Generator
) -> tuple[Floats, Floats, Floats]:
    """q, qd, qdd (samples, n): positions all around, speeds to 2 and accelerations to 5 (rad or m, s)."""
    shape = (samples, structure.chain.n)
    q = rng.uniform(-np.pi, np.pi, shape)
    return q, rng.uniform(-2.0, 2.0, shape), rng.uniform(-5.0, 5.0, shape)


def numeric_base(
    structure: ModelStructure,
    conditions: Sequence[Condition] | None = None,
    *,
    samples: int | None = None,
    seed: int = 0,
) -> BaseSet:
    """Base parameters of the stack of `conditions` (default: the bare arm and every payload, all sides).

    samples : random states for each condition; the default gives three rows for each column.

    Columns are scaled to norm 1; the rank is where consecutive singular values, the smaller below 1e-8 of the
    largest, fall the most. Raises DataError when there is no clear gap (a factor of 1e3): the geometry is
    then nearly degenerate, and the message says by how much.
    """
    stack = tuple(conditions) if conditions is not None else structure.conditions()
    if not stack:
        raise DataError("no condition was given; at least one session's payload and sides are needed")
    rng = np.random.default_rng(seed)
    if samples is None:
        rows = structure.rows([(condition, 1) for condition in stack])
        samples = max(16, -(-3 * structure.n_columns // rows))
    parts = [
        structure.regressor(
            *random_states(structure, samples, rng),
            payload=condition.payload,
            sides=structure.condition_sides(condition),
        )
        for condition in stack
    ]
    matrix = np.concatenate([part.T for part in parts], axis=1).T
    norms = np.sqrt(np.einsum("ij,ij->j", matrix, matrix))
    used = norms > _ZERO * norms.max(initial=0.0)
    scaled = matrix[:, used] / norms[used]
    triangle = np.linalg.qr(scaled, mode="r")
    singular = np.linalg.svd(triangle, compute_uv=False)
    rank, gap, threshold = rank_at_gap(singular)
    reduced = np.zeros((len(triangle), structure.n_columns))
    reduced[:, used] = triangle * norms[used]
    found = base_set(
        structure,
        stack,
        reduced,
        tolerance=_FLOOR,
        zero=_ZERO,
        method="numeric",
        gap=gap,
        threshold=threshold,
    )
    if len(found) != rank:
        raise DataError(
            f"the singular values say rank {rank}, the columns {len(found)}; the geometry is nearly "
            "degenerate (an angle or a length that should be exact is not): check the modified-DH constants"
        )
    return found


def rank_at_gap(singular: Floats) -> tuple[int, float, float]:
    """Rank, gap and the geometric middle of the gap, relative to the first of descending singular values.

    Raises DataError when no gap below 1e-8 of the largest is a factor of 1e3 wide.
    """
    relative = singular / singular[0]
    # One more value at rounding level stands for full rank.
    floor = np.finfo(float).eps * len(singular) * 0.1
    padded = np.append(np.maximum(relative, floor), floor)
    ratios = padded[:-1] / padded[1:]
    ratios[padded[1:] > _FLOOR] = 1.0
    rank = int(np.argmax(ratios)) + 1
    gap = float(ratios[rank - 1])
    if gap < _SMALLEST_GAP:
        raise DataError(
            f"the singular values of the observation matrix fall by no more than {gap:.1e} anywhere, so its "
            "rank is not clear; the geometry is nearly degenerate: check the modified-DH constants"
        )
    return rank, gap, float(np.sqrt(padded[rank - 1] * padded[rank]))
