"""Saying no early and saying why: which limit cannot be kept, and by how much."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from fri.errors import ConfigurationError, RefusedError
from ident.excitation.assembly import Assembled
from ident.excitation.constraints import Row
from ident.excitation.fourier import FourierBasis
from ident.excitation.motion import Array, ParametricMotion
from ident.excitation.polish import Outcome, shortfall
from ident.excitation.search import Setup, restore

__all__ = ["explain", "refuse_impossible"]

_STATIC_STARTS = 12


def refuse_impossible(assembled: Assembled) -> None:
    """Raise at once for problems that no motion can solve.

    Checked: the highest frequency against the arm's lowest resonance (n_f w0 < w_r), workspace bounds against
    the arm's reach, and whether any posture at all can be held within every limit (a motion of small size
    around a posture that can is always feasible).
    """
    _refuse_resonance(assembled)
    _refuse_reach(assembled)
    _refuse_static(assembled)


def _refuse_resonance(assembled: Assembled) -> None:
    basis = assembled.setup.basis
    if isinstance(basis, FourierBasis) and basis.highest_frequency_hz >= assembled.resonance_hz:
        raise ConfigurationError(
            f"n_f w0 = {basis.harmonics} / {basis.period_s} s = {basis.highest_frequency_hz:.3g} Hz reaches "
            f"the arm's lowest resonance, {assembled.resonance_hz:.3g} Hz; lower `harmonics` or lengthen "
            "`period_s`"
        )


def _refuse_reach(assembled: Assembled) -> None:
    mechanism, work = assembled.setup.mechanism, assembled.problem.workspace
    lengths = np.linalg.norm(mechanism.translation[1:], axis=1)
    reach = float(lengths.sum() + np.linalg.norm(mechanism.tip))
    for name, bound in (("radius_m", work.radius_m), ("height_m", work.height_m)):
        if bound is not None and bound >= reach:
            raise RefusedError(
                f"workspace: {name} {bound:.3f} m is {bound - reach:.3f} m beyond reach, {reach:.3f} m"
            )


class _Still:
    """Postures held still: the basis of one constant."""

    free = 1

    def __init__(self, duration: float) -> None:
        self.duration = duration

    def matrix(self, t: np.typing.ArrayLike, derivative: int = 0) -> Array:
        """One, and zero for every derivative."""
        return np.full((np.size(t), 1), 1.0 if derivative == 0 else 0.0)

    def motion(self, x: Array) -> ParametricMotion:
        """Not asked for."""
        raise ConfigurationError("a posture is no motion")

    def coefficients(self, motion: ParametricMotion) -> Array:
        """The posture at the start."""
        return motion.sample(0.0).q.T

    def grid_factor(self, n: int, derivative: int) -> float:
        """A constant has its extremum everywhere."""
        return 1.0


def _refuse_static(assembled: Assembled) -> None:
    setup = assembled.setup
    still = Setup(
        mechanism=setup.mechanism,
        basis=_Still(setup.basis.duration),
        limits=setup.limits,
        space=setup.space,
        floor=setup.floor,
        estimate=setup.estimate,
        columns=setup.columns,
        target=None,
        coverage=setup.coverage,
        samples=1,
        refine=1,
    )
    rng = np.random.default_rng(0)
    middle = 0.5 * (setup.limits.q_low + setup.limits.q_high)
    half = 0.5 * (setup.limits.q_high - setup.limits.q_low)
    best, blame = np.inf, ""
    for _ in range(_STATIC_STARTS):
        posture = middle + half * rng.uniform(-0.7, 0.7, size=middle.size)
        program = still.program(target=None)
        program.anchor = posture
        program.constraints.refresh_deviation(program.signals(posture))
        found = restore(still, posture, iterations=60)
        if found.violation < 1e-3:
            return
        if found.violation < best:
            best = found.violation
            program.values(found.x)
            blame = _blame(assembled, program.constraints.rows, program.constraints.latest)
    raise RefusedError(
        f"no posture can be held within the limits: {blame}; widen that limit or lighten the payload"
    )


def _blame(assembled: Assembled, rows: Sequence[Row], values: Array) -> str:
    worst = int(np.argmin(values))
    row = rows[worst]
    setup, excess = assembled.setup, -float(values[worst])
    if row.constraint == "distance":
        name = assembled.row_names[row.index]
        scale = 0.3 if row.index < 2 else 0.1
        return f"{name} falls short by {excess * scale:.3g} m"
    joint = setup.mechanism.joint_names[row.index]
    if row.constraint == "torque":
        limit = setup.limits.tau_max[row.index]
        return f"{joint} torque exceeds {limit:.4g} Nm by {excess * limit:.3g} Nm"
    return f"{joint} {row.constraint} exceeds its limit by {100.0 * excess:.3g} %"


def explain(assembled: Assembled, outcomes: Sequence[Outcome]) -> str:
    """Why no candidate passed: the violations of the one that came nearest."""
    if not outcomes:
        return "no motion was found; raise `search.starts`"

    nearest = min(outcomes, key=shortfall)
    reasons = [str(margin) for margin in nearest.check.violations[:3]]
    if not nearest.bounds_kept:
        view = assembled.view(nearest.motion)
        for bound in assembled.setup.bounds:
            value = bound.criterion.evaluate(view, np.inf)[0]
            if value > bound.limit:
                reasons.append(
                    f"{bound.criterion.name} {bound.criterion.report(value):.4g} exceeds the bound "
                    f"{bound.criterion.report(bound.limit):.4g}"
                )
    return (
        "no motion within every limit was found; the nearest one: "
        + "; ".join(reasons)
        + "; widen that limit, lengthen `period_s`, or raise `search.starts`"
    )
