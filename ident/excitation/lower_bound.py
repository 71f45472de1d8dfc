"""How good an exciting motion can be at all: a lower bound of its criterion by relaxation.

The information of a motion is the mean over its states x = (q, qd, qdd) of A(x)^T W A(x). The relaxation lets the
states be distributed in any way over a set that holds those of every motion within the limits, so its least value is a
lower bound. Torque, clearance, workspace and rest at the ends are left out, which can only lower it.

**States.** Position, velocity and acceleration of each joint keep their limits. A Fourier series of order n within
+-R about the middle also obeys the inequality of Bernstein and Szegő, qd² + (n w0 q)² <= (n w0 R)², and its derivative
the same one with the largest velocity in the place of R.

**Bound.** A convex criterion F of the information M lies above its tangent: F(M) >= F(M0) + <F'(M0), M - M0>, least at
a single state (Kiefer and Wolfowitz 1960). For the condition number take any positive semidefinite X, Y of trace one:
the largest eigenvalue of M is at least <Y, M>, the smallest at most <X, M>, and the ratio of the means is at least the
least ratio of a state.

**M0** minimises the criterion over distributions on a finite set of states. The states that bound it most join the
set, round after round, until bound and minimum meet (Fedorov 1972). They are sought from many starts and not proven, so
the bound is as sure as this search.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.optimize import minimize

from fri.errors import ConfigurationError
from ident.excitation.assembly import assemble
from ident.excitation.criteria import ConditionNumber, DOptimality, RelativeDeviation
from ident.excitation.information import ConstantBasis, Evaluator, View
from ident.excitation.motions import Array, FourierBasis
from ident.excitation.problem import Objective, PlanProblem
from ident.excitation.program import Setup

# States at first, tried in each round, improved of them, and steps of that.
_STATES, _TRIED, _IMPROVED, _STEPS = 1000, 4000, 200, 60
_ROUNDS = 30
# Searches that confirm the bound at last.
_AGAIN = 5
# Relative distance of bound and minimum at which the rounds end.
_CLOSE = 0.01
# Order of the norms in the place of extremes, and share of a round's new states in the distribution.
_SHARPNESS, _NEW = 64.0, 0.3
# Share of the coordinates changed in a step, and the first change, in halves of their range.
_CHANGED, _CHANGE = 0.2, 0.2
_LEAST_SHARE = 1e-5

Floor = Callable[[Array], Array]
"""Signals (n, N, c) of states to the bound that each of them alone allows, (N,), in reported units."""


@dataclass(frozen=True)
class LowerBound:
    """What no motion within the limits can fall below.

    criterion : its name. value : the bound, in reported units. reached : by the best distribution of states, which no
    motion need have. logarithm : whether the criterion itself is the logarithm of a size, -log det per parameter.
    """

    criterion: str
    value: float
    reached: float
    logarithm: bool = False

    def times(self, found: float) -> float:
        """How many times a motion with the value `found` is at most off the best one, by deviation or condition."""
        return float(np.exp(0.5 * (found - self.value))) if self.logarithm else found / self.value

    def text(self, found: float) -> str:
        """The same in words."""
        return f"{found:.4g}, at most {self.times(found):.2f} times the best possible, above {self.value:.4g}"


def can_bound(objective: Objective) -> bool:
    """Whether the relaxation bounds this objective: all but goal attainment and columns of length one."""
    columns = objective.criterion == "condition_number" and objective.scaling == "columns"
    return objective.criterion != "goal_attainment" and not columns


def lower_bound(problem: PlanProblem | str | Path, *, seed: int = 0) -> LowerBound:
    """Lower bound of the criterion of a planning problem, over all motions within its limits.

    problem : a problem or the path of its file. seed : of the search for states.

    Raises ConfigurationError for an objective without a bound (`can_bound`).
    """
    problem = problem if isinstance(problem, PlanProblem) else PlanProblem.load(problem)
    objective = problem.objective
    if not can_bound(objective):
        raise ConfigurationError(
            f"objective {objective.criterion}, scaling {objective.scaling}: no lower bound by relaxation; choose "
            "mean_rsd, worst_rsd, d_optimality, or condition_number with scaling none or parameters"
        )
    setup = assemble(problem).setup
    target = setup.target
    assert target is not None
    states, rng = _States(setup), np.random.default_rng(seed)
    places = states.random(rng, _STATES)
    shares = np.full(_STATES, 1.0 / _STATES)
    best: tuple[float, Floor, Array] | None = None
    least = np.inf
    for _ in range(_ROUNDS):
        signals = states.signals(places)
        shares = _best_shares(setup, signals, shares)
        least = min(least, target.exact(_view(setup, signals, shares)))
        floor = _floor(setup, signals, shares)
        near = places[np.argsort(-shares)[:_IMPROVED]]
        found, values = states.worst(floor, near, rng)
        value = min(float(values.min()), float(floor(signals).min()))
        best = (value, floor, near) if best is None or value > best[0] else best
        if best[0] >= least - _CLOSE * (2.0 if isinstance(target, DOptimality) else least):
            break
        kept = shares > _LEAST_SHARE
        places = np.vstack([places[kept], found])
        shares = np.append(
            (1.0 - _NEW) * shares[kept] / shares[kept].sum(), np.full(len(found), _NEW / len(found))
        )
    assert best is not None
    # The best of many rounds may be the one with the poorest search.
    again = [states.worst(best[1], best[2], rng)[1].min() for _ in range(_AGAIN)]
    value = float(min(best[0], *again))
    return LowerBound(target.name, value, least, isinstance(target, DOptimality))


class _States:
    """Position, velocity and acceleration of each joint on all motions within the limits, by places in [-1, 1]."""

    def __init__(self, setup: Setup) -> None:
        limits, basis = setup.limits, setup.basis
        self.setup = setup
        self.middle, self.half = 0.5 * (limits.q_high + limits.q_low), 0.5 * (limits.q_high - limits.q_low)
        # Angular frequency of the highest harmonic [rad/s].
        self.fastest = (
            2.0 * np.pi * basis.harmonics / basis.period_s if isinstance(basis, FourierBasis) else np.inf
        )
        self.speed = np.minimum(limits.v_max, self.fastest * self.half)
        self.change = np.minimum(limits.a_max, self.fastest * self.speed)

    def random(self, rng: np.random.Generator, count: int) -> Array:
        """Places (count, 3 n), half of them near the ends of their ranges."""
        places = rng.uniform(-1.0, 1.0, (count, 3 * len(self.middle)))
        places[::2] = np.sign(places[::2]) * np.abs(places[::2]) ** 0.2
        return places

    def signals(self, places: Array) -> Array:
        """Signals (n, N, c) of the rows at the places (N, 3 n)."""
        angle, rate, turn = np.split(places, 3, axis=1)
        speed, change = self.speed, self.change
        if np.isfinite(self.fastest):
            speed = np.minimum(speed, self.fastest * self.half * np.sqrt(1.0 - angle**2))
            change = np.minimum(change, self.fastest * np.sqrt(self.speed**2 - (speed * rate) ** 2))
        motion = [self.middle + self.half * angle, speed * rate, change * turn]
        evaluator = Evaluator(
            self.setup.mechanism,
            ConstantBasis(1.0, free=0),
            self.setup.estimate,
            self.setup.columns,
            samples=len(places),
            refine=1,
        )
        evaluator.view([np.ascontiguousarray(one) for one in motion], exact_sign=True)
        return evaluator.z

    def worst(self, floor: Floor, near: Array, rng: np.random.Generator) -> tuple[Array, Array]:
        """Places (k, 3 n) of the least floors found, from random places and places `near` by, and their floors (k,)."""
        moved = np.repeat(near, max(1, _TRIED // (4 * len(near))), axis=0)
        moved = np.clip(moved + 0.5 * _CHANGE * rng.standard_normal(moved.shape), -1.0, 1.0)
        places = np.vstack([self.random(rng, _TRIED), moved])
        values = floor(self.signals(places))
        first = np.argsort(values)[:_IMPROVED]
        places, values = places[first], values[first]
        for step in range(_STEPS):
            size = _CHANGE * 0.5 ** (4 * step // _STEPS)
            changes = size * rng.standard_normal(places.shape) * (rng.uniform(size=places.shape) < _CHANGED)
            tried = np.clip(places + changes, -1.0, 1.0)
            found = floor(self.signals(tried))
            better = found < values
            places[better], values[better] = tried[better], found[better]
        return places, values


def _view(setup: Setup, signals: Array, shares: Array) -> View:
    """View of states with their shares (N,) of the time; without torques, which no criterion here reads."""
    first = setup.columns.first
    gram = np.zeros((len(signals), signals.shape[2], signals.shape[2]))
    for joint, rows in enumerate(signals):
        used = rows[:, first[joint] :]
        gram[joint, first[joint] :, first[joint] :] = used.T @ (used * shares[:, None])
    return View(gram, np.zeros((1, len(signals))))


def _along(setup: Setup, signals: Array, gram_bar: Array) -> Array:
    """<gram_bar, Gram matrices> of each state, (N,)."""
    first = setup.columns.first
    total = np.zeros(signals.shape[1])
    for joint, rows in enumerate(signals):
        used = rows[:, first[joint] :]
        total += np.sum((used @ gram_bar[joint, first[joint] :, first[joint] :]) * used, axis=1)
    return total


def _best_shares(setup: Setup, signals: Array, shares: Array) -> Array:
    """Shares (N,) of the states in the distribution with the least criterion, from those given."""
    target = setup.target
    assert target is not None

    def of(logs: Array) -> Array:
        found = np.exp(logs - logs.max())
        return np.asarray(found / found.sum())

    def value(logs: Array) -> tuple[float, Array]:
        now = of(logs)
        view = _view(setup, signals, now)
        result, pull = target.evaluate(view, _SHARPNESS)
        pull(1.0)
        slope = _along(setup, signals, view.gram_bar)
        return result, now * (slope - now @ slope)

    return of(minimize(value, np.log(shares), jac=True, method="L-BFGS-B", options={"maxiter": 200}).x)


def _floor(setup: Setup, signals: Array, shares: Array) -> Floor:
    """The bound at a distribution of states, as a function of the state that is taken for the worst."""
    target, view = setup.target, _view(setup, signals, shares)
    if isinstance(target, ConditionNumber):
        return _ratio(setup, target, view)
    assert target is not None
    value, pull = target.evaluate(view, _SHARPNESS)
    pull(1.0)
    bar = view.gram_bar
    here = float(shares @ _along(setup, signals, bar))
    if not target.logarithmic:
        return lambda states: value - here + _along(setup, states, bar)
    # The norm in the place of the largest deviation is at most this many times as large.
    excess = 1.0
    if isinstance(target, RelativeDeviation) and target.statistic == "worst":
        excess = float(target.values.size) ** (1.0 / _SHARPNESS)
    size = target.report(value) / excess
    return lambda states: size * (1.0 - here + _along(setup, states, bar))


def _ratio(setup: Setup, target: ConditionNumber, view: View) -> Floor:
    """Root of <Y, M> / <X, M> of each state, with the slopes of the norms of M and of its inverse."""
    scale = 1.0 if target.values is None else np.outer(target.values, target.values)
    sizes, vectors = np.linalg.eigh(target.information(view) * scale)
    sizes = np.maximum(sizes, 1e-300)
    parts = []
    for power in ((sizes / sizes[-1]) ** (_SHARPNESS - 1.0), (sizes[0] / sizes) ** (_SHARPNESS + 1.0)):
        bar = (vectors * (power / power.sum())) @ vectors.T * scale
        view.clear()
        target.pullback(view, bar)(1.0)
        known = 0.0 if target.prior is None else float(np.sum(bar * target.prior))
        parts.append((view.gram_bar.copy(), known))
    (high, high_known), (low, low_known) = parts

    def floor(states: Array) -> Array:
        above = high_known + _along(setup, states, high)
        below = low_known + _along(setup, states, low)
        return np.asarray(np.sqrt(np.maximum(above, 0.0) / np.maximum(below, 1e-300)))

    return floor
