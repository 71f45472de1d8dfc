"""Motions side by side: table, random motions, and trade-offs between two criteria.

The table has the columns of the paper's Table 1. Fronts come from the epsilon-constraint method; the dominated volume
measures them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import reduce

import numpy as np
from joblib import Parallel, delayed

from fri.errors import ConfigurationError, RefusedError
from ident.excitation.arm_model import Mechanism, tip_path
from ident.excitation.assembly import Assembled
from ident.excitation.check import Check, Limits, Workspace, flange_bounds
from ident.excitation.criteria import Criterion
from ident.excitation.motions import Array, ParametricMotion, PointToPoint
from ident.excitation.program import Bound, Setup
from ident.excitation.search import Candidate, begin, hop, judge, polish
from lwr_driver.arm.collision import CollisionChecker
from lwr_driver.listing import Listing, text_of

_LINE = 60
_TRIES = 400


@dataclass(frozen=True, eq=False)
class TableRow:
    """One motion: limits kept, condition number, mean and worst predicted deviation [%], mean |torque| [Nm]."""

    label: str
    complies: bool
    duration_s: float
    condition: float
    rsd_mean: float
    rsd_worst: float
    torque: Array

    def __repr__(self) -> str:
        return table([self])


def table_row(
    label: str, assembled: Assembled, motion: ParametricMotion, check: Check | None = None
) -> TableRow:
    """The figures of one motion; checked against every limit unless a check is given."""
    verdict = assembled.check(motion, continuous=False) if check is None else check
    view = assembled.view(motion)
    criteria = assembled.criteria
    return TableRow(
        label=label,
        complies=verdict.ok,
        duration_s=motion.duration,
        condition=criteria.condition.exact(view),
        rsd_mean=criteria.rsd_mean.exact(view),
        rsd_worst=criteria.rsd_worst.exact(view),
        torque=np.mean(np.abs(view.torque), axis=0),
    )


def table(rows: Sequence[TableRow], title: str = "") -> str:
    """Aligned text, one line per motion; torques by joint."""
    joints = max((len(row.torque) for row in rows), default=0)
    head = ["trajectory", "limits", "T [s]", "cond", "mean RSD %", "worst RSD %"]
    body = [
        [
            row.label,
            "yes" if row.complies else "NO",
            f"{row.duration_s:.1f}",
            f"{row.condition:.2f}",
            f"{row.rsd_mean:.2f}",
            f"{row.rsd_worst:.2f}",
            *(f"{value:.2f}" for value in row.torque),
        ]
        for row in rows
    ]
    listing = Listing([*head, *(f"|tau{k + 1}| Nm" for k in range(joints))], body, 0)
    return text_of([title, listing] if title else [listing])


def random_points(
    mechanism: Mechanism,
    limits: Limits,
    *,
    count: int = 20,
    seed: int = 1,
    speed_scale: float = 1.0,
    a_max: Array | None = None,
    workspace: Workspace | None = None,
    checker: CollisionChecker | None = None,
    clearance_m: float = 0.0,
    duration_s: float | None = None,
) -> PointToPoint:
    """Motion through `count` random postures and back to the first, within workspace and clearance on every line.

    To compare optimal excitation with.

    speed_scale : share of the velocity limits; a_max : acceleration limits instead of the arm's [rad/s²]
    duration_s : total time, filled by a pause in each posture; None: no pauses

    Raises RefusedError without a next posture, ConfigurationError if the time is too short.
    """
    rng = np.random.default_rng(seed)
    space = workspace if workspace is not None else Workspace()

    def free(path: Array) -> bool:
        points = tip_path(mechanism, path)
        if any(measure(points).min() < limit for _, limit, measure in flange_bounds(space)):
            return False
        return checker is None or checker.check_path(path).distance >= clearance_m

    share = np.linspace(0.0, 1.0, _LINE)[:, None]

    def connected(posture: Array) -> bool:
        lines = [(1.0 - share) * postures[-1] + share * posture]
        if len(postures) == count - 1:
            lines.append((1.0 - share) * posture + share * postures[0])
        return all(free(line) for line in lines)

    refusal = f"no posture within the workspace and clear of collisions in {_TRIES} draws"
    postures = [_draw(rng, limits, lambda posture: free(posture[None, :]), refusal)]
    refusal = f"no further posture can be reached in a straight line in {_TRIES} draws; try another seed"
    while len(postures) < count:
        postures.append(_draw(rng, limits, connected, refusal))
    postures.append(postures[0])
    acceleration = limits.a_max if a_max is None else np.minimum(a_max, limits.a_max)
    motion = PointToPoint(np.array(postures), speed_scale * limits.v_max, acceleration, limits.j_max)
    if duration_s is None:
        return motion
    if motion.duration > duration_s:
        raise ConfigurationError(
            f"{count} postures take {motion.duration:.1f} s, longer than {duration_s} s; use fewer of them"
        )
    return replace(motion, dwell_s=(duration_s - motion.duration) / count)


def _draw(rng: np.random.Generator, limits: Limits, suits: Callable[[Array], bool], refusal: str) -> Array:
    for _ in range(_TRIES):
        posture = rng.uniform(limits.q_low, limits.q_high)
        if suits(posture):
            return posture
    raise RefusedError(refusal)


@dataclass(frozen=True, eq=False)
class FrontPoint:
    """One motion of a front: its bound, and both criteria in reported units."""

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
    """Minimise one criterion under an upper bound on another, for each of `limits` (on the bounded criterion's scale).

    The limits are worked from the loosest to the tightest and back. Each one also starts from the motions of its
    neighbours, against dents in the front. Only motions within every limit are returned.
    """
    order = sorted(range(len(limits)), key=lambda k: -limits[k])
    bounds = [(Bound(against, float(limit)),) for limit in limits]
    setups = [replace(assembled.setup, target=minimise, bounds=bound) for bound in bounds]
    tasks = [delayed(_first)(setups[k], list(first), (seed, k), starts) for k in order]
    pool: dict[int, Candidate] = dict(zip(order, Parallel(n_jobs=jobs)(tasks), strict=True))
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
            limit = against.report(float(limits[k]))
            points.append(FrontPoint(limit, minimise.exact(view), against.exact(view), outcome.motion))
    return points


def _first(setup: Setup, known: Sequence[Candidate], seed: tuple[int, ...], starts: int) -> Candidate:
    found = [begin(setup, (*seed, index)) for index in range(starts)]
    found += [judge(setup, candidate.x) for candidate in known]
    return reduce(lambda best, other: other if other.better_than(best) else best, found)


def not_dominated(values: Array) -> Array:
    """Pareto-optimal rows of values (n, k), all to be made small; boolean (n,)."""
    values = np.asarray(values, dtype=np.float64)
    keep = np.ones(len(values), dtype=bool)
    for row, value in enumerate(values):
        better = np.all(values <= value, axis=1) & np.any(values < value, axis=1)
        keep[row] = not better.any()
    return keep


def hypervolume(values: Array, reference: Array) -> float:
    """Volume between a front (n, k), all to be made small, and a reference point, worse in every column."""
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
