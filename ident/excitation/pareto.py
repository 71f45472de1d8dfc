"""Trade-offs between criteria: fronts by the epsilon-constraint method, and the volume that a front
dominates.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from joblib import Parallel, delayed

from ident.excitation.assembly import Assembled
from ident.excitation.constraints import Bound
from ident.excitation.motion import Array, ParametricMotion
from ident.excitation.objectives import Criterion
from ident.excitation.polish import polish
from ident.excitation.search import Candidate, Setup, begin, hop, judge

__all__ = ["FrontPoint", "hypervolume", "not_dominated", "trade_off"]


@dataclass(frozen=True, eq=False)
class FrontPoint:
    """One motion of a front: the bound that it was found under, and both criteria in reported units."""

    limit: float
    minimised: float
    bounded: float
    motion: ParametricMotion


def trade_off(
    assembled: Assembled,
    minimise: Criterion,
    against: Criterion,
    limits: Sequence[float],
    *,
    seed: int = 1,
    starts: int = 4,
    hops: int = 10,
    jobs: int = 1,
    first: Sequence[Candidate] = (),
) -> list[FrontPoint]:
    """Minimise one criterion with another kept at or below each of `limits` (on the bounded criterion's own
    scale).

    Limits are worked from the loosest to the tightest and back; each takes over what its neighbours found, so
    the front has no dents that a neighbour could fill. Only motions that pass every check are returned.
    """
    order = sorted(range(len(limits)), key=lambda k: -limits[k])
    setups = {
        k: replace(assembled.setup, target=minimise, bounds=(Bound(against, float(limits[k])),))
        for k in order
    }
    pool: dict[int, Candidate] = {}
    tasks = [delayed(_first)(setups[k], list(first), (seed, k), starts) for k in order]
    for k, found in zip(order, Parallel(n_jobs=jobs)(tasks), strict=True):
        pool[k] = found
    for sweep, sequence in enumerate((order, order[::-1])):
        for position, k in enumerate(sequence):
            candidates = [pool[k]]
            if position:
                candidates.append(pool[sequence[position - 1]])
            tasks = [
                delayed(hop)(
                    setups[k], judge(setups[k], candidate.x), (seed, 7000 + sweep, k, which), hops // 2
                )
                for which, candidate in enumerate(candidates)
            ]
            for improved in Parallel(n_jobs=jobs)(tasks):
                if improved.better_than(pool[k]):
                    pool[k] = improved
    points = []
    for k in order[::-1]:
        problem = replace(assembled, setup=setups[k])
        outcome = polish(problem, pool[k])
        if outcome.check.ok and outcome.bounds_kept:
            view = problem.view(outcome.motion)
            values = [c.report(c.evaluate(view, np.inf)[0]) for c in (minimise, against)]
            points.append(FrontPoint(against.report(float(limits[k])), values[0], values[1], outcome.motion))
    return points


def _first(setup: Setup, known: Sequence[Candidate], seed: tuple[int, ...], starts: int) -> Candidate:
    found = [begin(setup, (*seed, index)) for index in range(starts)]
    found += [judge(setup, candidate.x) for candidate in known]
    best = found[0]
    for candidate in found[1:]:
        if candidate.better_than(best):
            best = candidate
    return best


def not_dominated(values: Array) -> Array:
    """Rows of values (n, k), all to be made small, that no other row beats in everything; boolean (n,)."""
    values = np.asarray(values, dtype=np.float64)
    keep = np.ones(len(values), dtype=bool)
    for row, value in enumerate(values):
        better = np.all(values <= value, axis=1) & np.any(values < value, axis=1)
        keep[row] = not better.any()
    return keep


def hypervolume(values: Array, reference: Array) -> float:
    """Volume between a front (n, k), all to be made small, and a reference point that is worse in
    everything.
    """
    points = np.asarray(values, dtype=np.float64)
    corner = np.asarray(reference, dtype=np.float64)
    points = points[np.all(points < corner, axis=1)]
    if len(points) == 0:
        return 0.0
    if points.shape[1] == 1:
        return float(corner[0] - points[:, 0].min())
    order = np.argsort(points[:, -1])
    points = points[order]
    heights = np.append(points[1:, -1], corner[-1]) - points[:, -1]
    return float(
        sum(
            height * hypervolume(points[: row + 1, :-1], corner[:-1])
            for row, height in enumerate(heights)
            if height > 0.0
        )
    )
