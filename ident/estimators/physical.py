"""Physically consistent estimation: every body's pseudo-inertia positive definite, drives dissipative.

Standard parameters are fitted through their base parameters under linear matrix inequalities (Sousa and
Cortesao 2014; Wensing, Kim and Slotine 2018). A distance to a prior model determines the combinations unseen in
the data (Lee, Wensing and Park 2020). The convex program is solved by clarabel. `cad_prior` makes the prior from
the arm's own URDF.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from typing import ClassVar, Literal

import clarabel
import numpy as np
from scipy import sparse
from scipy.linalg import solve_triangular

from fri.errors import ConfigurationError, DataError
from ident.dynamics.base_set import BaseSet
from ident.dynamics.kinematics import Chain
from ident.dynamics.parameters import INERTIAL, PER_LINK, Floats, from_com, pseudo_inertia, split_name
from ident.estimators.covariance import CovarianceSettings, effective_rows
from ident.estimators.estimate import Estimate
from ident.estimators.least_squares import class_variances
from ident.estimators.prior import MaximumAPosteriori, Prior
from ident.estimators.problem import Problem

Metric = Literal["pullback", "entropic", "euclidean"]

_BODY = 10
_ROOT2 = np.sqrt(2.0)
_REWEIGHTINGS = 8
# The solver resolves eight digits: no class is trusted beyond 1e-5 of its torque.
_FINEST = 1e10
# Largest change of the constraints, in sizes of the prior's bodies, by a unit of a deviation.
_FELT = 10.0
# Tolerances of the conic program, the next one where the arithmetic does not reach the first.
_TOLERANCES = (1e-10, 1e-8, 1e-6)


@dataclass(frozen=True)
class BodyPrior:
    """Prior knowledge of the standard parameters.

    projection : K (p, n), base parameters = K standard parameters.
    bodies : (k, 10) int, positions of the inertial parameters of each rigid body, in the order of `INERTIAL`.
    nonnegative : positions of parameters without negative values (drive inertia, friction).
    inertial : (k, 10) consistent prior of the bodies, if need be from `nearest_consistent`.
    absent : positions of parameters left out of the model; they stay zero.
    relative_std : standard deviation of a body from its prior, as a share of itself, one for all or (k,). The
        default is the robot-to-robot variation in the paper, up to 20 %.
    """

    projection: Floats
    bodies: np.ndarray
    nonnegative: np.ndarray
    inertial: Floats
    absent: np.ndarray = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    relative_std: float | Floats = 0.2

    @property
    def firmness(self) -> Floats:
        """1 / relative_std^2 of each body (k,)."""
        return (
            1.0 / np.broadcast_to(np.asarray(self.relative_std, dtype=np.float64), (len(self.bodies),)) ** 2
        )

    def __post_init__(self) -> None:
        if self.bodies.shape != self.inertial.shape or self.bodies.shape[1:] != (_BODY,):
            raise ConfigurationError(
                f"bodies {self.bodies.shape} and their prior {self.inertial.shape} must both be (k, 10)"
            )
        if not np.all(np.asarray(self.relative_std) > 0.0):
            raise ConfigurationError(
                f"relative standard deviation {np.min(self.relative_std):g} of a prior is not positive; 0.2 is typical"
            )
        for number, body in enumerate(self.inertial):
            if np.linalg.eigvalsh(pseudo_inertia(body))[0] <= 0:
                raise ConfigurationError(
                    f"prior of body {number + 1} belongs to no rigid body; pass it through "
                    "`nearest_consistent`"
                )

    def hessian(self, metric: Metric) -> Floats:
        """(n, n) quadratic form of the distance to the prior at the prior; zero for the drive parameters.

        "pullback" (and "entropic", which agrees with it to second order): tr(J0^-1 dJ J0^-1 dJ) / 2,
        invariant to the choice of frames and units. "euclidean": each parameter relative to its body's size.
        """
        n = self.projection.shape[1]
        total = np.zeros((n, n))
        basis = pseudo_inertia(np.eye(_BODY))
        for places, body, firmness in zip(self.bodies, self.inertial, self.firmness, strict=True):
            if metric == "euclidean":
                block = np.diag(1.0 / _sizes(body) ** 2)
            else:
                inverse = np.linalg.inv(pseudo_inertia(body))
                moved = np.einsum("ab,kbc->kac", inverse, basis)
                block = 0.5 * np.einsum("kab,lba->kl", moved, moved)
            total[np.ix_(places, places)] += firmness * block
        return total

    def prior(self, metric: Metric) -> Prior:
        """The same as a normal prior of the base parameters; those with a drive parameter stay free."""
        n = self.projection.shape[1]
        inertial = np.zeros(n, dtype=bool)
        inertial[self.bodies.ravel()] = True
        inertial[self.absent] = False
        covariance = np.zeros((n, n))
        places = np.flatnonzero(inertial)
        block = self.hessian(metric)[np.ix_(places, places)]
        covariance[np.ix_(places, places)] = np.linalg.inv(block)
        known = np.array([not np.any(row[~inertial]) and bool(np.any(row)) for row in self.projection])
        return Prior.projected(self.standard, covariance, self.projection, known)

    @property
    def standard(self) -> Floats:
        """The prior's standard parameters (n,), zero for those of the drives."""
        found = np.zeros(self.projection.shape[1])
        found[self.bodies.ravel()] = self.inertial.ravel()
        return found


@dataclass(frozen=True)
class PhysicallyConsistent:
    """Minimises sum of (n_eff / n) ||e_c||^2 / sigma_c^2 + distance(x, x_0) / s over consistent x.

    metric : distance of a body from its prior: "pullback" (quadratic, invariant), "entropic"
        (log-determinant divergence, keeps away from the boundary), "euclidean".
    strength : s; 1 takes the prior as stated, "evidence" and "cross_validation" let the data choose, see
        `MaximumAPosteriori`. Data with model errors choose too loose a prior for other motions.
    margin : smallest eigenvalue of a pseudo-inertia relative to the prior's smallest. The result's
        `standard` holds the standard parameters (n,).
    """

    needs_rank: ClassVar[bool] = False

    prior: BodyPrior
    metric: Metric = "pullback"
    strength: Literal["evidence", "cross_validation"] | float = 1.0
    margin: float = 1e-3
    covariance: CovarianceSettings = field(default_factory=CovarianceSettings)

    def fit(self, problem: Problem) -> Estimate:
        """Estimate (p,) and `standard` (n,), with the standard deviations of the unconstrained problem."""
        normal = self.prior.prior(self.metric)
        linear = MaximumAPosteriori(normal, self.strength, self.covariance).fit(problem)
        assert linear.prior_scale is not None
        shares = effective_rows(problem, linear.residuals) / [max(c.rows, 1) for c in linear.classes]
        consumed = np.array([fit.parameters for fit in linear.classes])
        p, projection = len(problem.names), self.prior.projection
        # Friction and offsets that the rows leave open, as rows of their own.
        weak = np.sqrt(np.diag(normal.completed(problem).precision - normal.precision) / linear.prior_scale)
        open_, nothing = np.diag(weak)[weak > 0.0], np.zeros(int(np.count_nonzero(weak)))
        weights = np.minimum(linear.weights, _FINEST / _mean_squares(problem))
        for _ in range(_REWEIGHTINGS):
            # With active constraints the residual grows, so its weight must fall.
            factor = problem.weighted(weights * np.minimum(shares, 1.0))
            matrix = np.vstack([factor.r[:p, :p], open_])
            target = np.concatenate([factor.r[:p, p], nothing])
            standard = self.solve(linear.prior_scale, matrix @ projection, target)
            values = projection @ standard
            before = weights
            weights = 1.0 / class_variances(problem, values, consumed)
            weights = np.minimum(weights, _FINEST / _mean_squares(problem))
            if np.max(np.abs(weights / before - 1.0)) < 0.01:
                break
        touching = _touching(self.prior, standard, self.margin)
        notes = (
            *linear.notes,
            f"{touching} of {len(self.prior.bodies)} bodies at the boundary of consistency",
        )
        return replace(
            linear,
            method=f"physically consistent ({self.metric})",
            values=values,
            weights=weights,
            residuals=problem.residuals(values),
            classes=_refit(linear, problem, values),
            notes=notes,
            standard=standard,
        )

    def solve(self, scale: float, quadratic: Floats, target: Floats) -> Floats:
        """Standard parameters (n,) for ||quadratic x - target||^2 plus the distance to the prior over `scale`."""
        if self.metric == "entropic":
            return self._entropic(scale, quadratic, target)
        prior = self.prior
        root = np.zeros((prior.bodies.size, quadratic.shape[1]))
        hessian = self._hessian
        for number, places in enumerate(prior.bodies):
            here = slice(number * _BODY, (number + 1) * _BODY)
            root[here, places] = np.linalg.cholesky(hessian[np.ix_(places, places)] / scale).T
        matrix = np.vstack([quadratic, root])
        used = np.ones(quadratic.shape[1], dtype=bool)
        used[prior.absent] = False
        size = np.linalg.norm(matrix, axis=0)
        size = np.where(size > 0.0, size, 1.0)[used]
        # A trace of curvature makes the solution unique for parameters without effect and prior.
        stacked = np.vstack([matrix[:, used] / size, 1e-10 * np.eye(len(size))])
        wanted = np.concatenate([target, root @ prior.standard, np.zeros(len(size))])
        # The last column becomes Q^T wanted.
        whole = np.asarray(np.linalg.qr(np.column_stack([stacked, wanted]), mode="r"), dtype=np.float64)
        r, turned = whole[:-1, :-1], whole[:-1, -1]
        # Deviations from the minimiser, in units in which they cost the same: there the solver's digits suffice.
        spread = np.zeros((quadratic.shape[1], len(size)))
        spread[used] = solve_triangular(r, np.eye(len(size))) / size[:, None]
        best = np.asarray(spread @ turned)
        rows, offset = self._constraints
        left = offset - rows @ best
        # What nothing knows has no such unit: there it is one that the constraints feel.
        felt = np.linalg.norm(rows @ spread, axis=0)
        unit = np.minimum(1.0, _FELT / np.maximum(felt, 1e-300))
        try:
            moved = self._moved(sparse.diags(unit**2, format="csc"), rows @ (spread * unit), left)
            return np.asarray(best + (spread * unit) @ moved)
        except DataError:
            # So far from the possible that these units are of no use: each parameter in its own.
            own = np.zeros((quadratic.shape[1], len(size)))
            own[used] = np.diag(1.0 / size)
            curvature = sparse.csc_matrix(np.triu(r.T @ r))
            return np.asarray(best + own @ self._moved(curvature, rows @ own, left))

    def _moved(self, curvature: sparse.csc_matrix, rows: Floats, left: Floats) -> Floats:
        """The least x^T curvature x with left - rows x within all constraints.

        Most of them hold by themselves: only those that the least one so far breaks are in the program.
        """
        signs, bodies = len(self.prior.nonnegative), len(self.prior.bodies)
        used, x = np.zeros(signs + bodies, dtype=bool), np.zeros(rows.shape[1])
        while True:
            slack = left - rows @ x
            smallest = np.linalg.eigvalsh(_of_svec(slack[signs:].reshape(bodies, _BODY)))[:, 0]
            broken = (np.concatenate([slack[:signs], smallest]) < 0.0) & ~used
            if not broken.any():
                return x
            used |= broken
            chosen = np.repeat(used, [1] * signs + [_BODY] * bodies)
            count = int(used[:signs].sum())
            cones = [clarabel.NonnegativeConeT(count)] if count else []
            cones += [clarabel.PSDTriangleConeT(4)] * int(used[signs:].sum())
            x = _conic(curvature, np.zeros(len(x)), rows[chosen], left[chosen], cones)

    @cached_property
    def _hessian(self) -> Floats:
        return self.prior.hessian(self.metric)

    @cached_property
    def _constraints(self) -> tuple[Floats, Floats]:
        """Rows of A x + s = b: parameters without negative values, and each body's pseudo-inertia above its floor, as
        seen from the prior's own, where all bodies are of one size."""
        prior, n = self.prior, self.prior.projection.shape[1]
        sign = np.zeros((len(prior.nonnegative), n))
        sign[np.arange(len(prior.nonnegative)), prior.nonnegative] = -1.0
        parts, offsets = [sign], [np.zeros(len(sign))]
        basis = pseudo_inertia(np.eye(_BODY))
        for places, body in zip(prior.bodies, prior.inertial, strict=True):
            matrix = pseudo_inertia(body)
            inverse = np.linalg.inv(np.linalg.cholesky(matrix))
            rows = np.zeros((_BODY, n))
            rows[:, places] = -_svec(inverse @ basis @ inverse.T).T
            parts.append(rows)
            offsets.append(-_svec(inverse @ (self.margin * _smallest(matrix)) @ inverse.T))
        return np.vstack(parts), np.concatenate(offsets)

    def _entropic(self, scale: float, quadratic: Floats, target: Floats) -> Floats:
        """`solve` with the divergence -log det(J J0^-1) + tr(J0^-1 J) - 4 of each body."""
        prior, n, tightness = self.prior, quadratic.shape[1], 1.0 / scale
        extra = len(prior.bodies) * (_BODY + 4)
        hessian = 2.0 * quadratic.T @ quadratic
        linear = np.concatenate([-2.0 * quadratic.T @ target, np.zeros(extra)])
        parts, offsets, cones = [], [], []
        sign = np.zeros((len(prior.nonnegative), n + extra))
        sign[np.arange(len(prior.nonnegative)), prior.nonnegative] = -1.0
        zero = np.zeros((len(prior.absent), n + extra))
        zero[np.arange(len(prior.absent)), prior.absent] = 1.0
        for rows, cone in (
            (zero, clarabel.ZeroConeT(len(zero))),
            (sign, clarabel.NonnegativeConeT(len(sign))),
        ):
            if len(rows):
                parts.append(rows)
                offsets.append(np.zeros(len(rows)))
                cones.append(cone)
        for number, (places, body) in enumerate(zip(prior.bodies, prior.inertial, strict=True)):
            matrix = pseudo_inertia(body)
            first = n + number * (_BODY + 4)
            rows, offset, kinds = _entropic_rows(places, n + extra, first)
            # To second order the divergence is the pullback metric.
            slope = np.einsum("ab,kba->k", np.linalg.inv(matrix), pseudo_inertia(np.eye(_BODY)))
            strength = tightness * prior.firmness[number]
            linear[places] += strength * slope
            linear[first + _BODY : first + _BODY + 4] -= strength
            parts.append(rows)
            offsets.append(offset)
            cones += kinds
        full = np.zeros((n + extra, n + extra))
        full[:n, :n] = hessian
        full[np.arange(n), np.arange(n)] += 1e-12 * max(float(np.diag(hessian).max()), 1e-12)
        solution = _run(
            sparse.csc_matrix(np.triu(full)), linear, np.vstack(parts), np.concatenate(offsets), cones
        )
        return solution[:n]


def _mean_squares(problem: Problem) -> Floats:
    """Mean square torque of each class [Nm^2]."""
    return np.maximum([c.factor.mean_square for c in problem.classes], np.finfo(float).tiny)


def nearest_consistent(inertial: Floats, *, margin: float = 1e-2) -> Floats:
    """Consistent (k, 10) nearest to `inertial` in size-relative Euclidean distance.

    margin : smallest eigenvalue of each pseudo-inertia relative to a compact body of that mass.
    """
    bodies = np.atleast_2d(np.asarray(inertial, dtype=np.float64))
    return np.array([_nearest_body(tuple(body), margin) for body in bodies.tolist()])


# A convex program, and fits of one arm ask for the same bodies again and again.
@lru_cache(maxsize=64)
def _nearest_body(stated: tuple[float, ...], margin: float) -> Floats:
    body = np.array(stated)
    floor = margin * _compact(max(float(body[9]), 1e-3))
    weights = 1.0 / _sizes(body) ** 2
    rows, offset, cones = _psd_rows(np.arange(_BODY), _BODY, floor)
    return _run(sparse.diags(2.0 * weights).tocsc(), -2.0 * weights * body, rows, offset, cones)


def _run(quadratic: sparse.csc_matrix, linear: Floats, rows: Floats, offset: Floats, cones: list) -> Floats:
    # Columns scaled to the size of the curvature: masses and inertias differ by orders of magnitude.
    diagonal = np.sqrt(np.maximum(np.asarray(quadratic.diagonal()).ravel(), 0.0))
    typical = float(np.median(diagonal[diagonal > 0])) if np.any(diagonal > 0) else 1.0
    scale = 1.0 / np.where(diagonal > 1e-6 * typical, diagonal, typical)
    objective = float(np.max(np.abs(linear * scale), initial=1e-300))
    spread = sparse.diags(scale)
    curvature = sparse.csc_matrix(spread @ quadratic @ spread / objective)
    return scale * _conic(curvature, linear * scale / objective, rows * scale, offset, cones)


def _conic(curvature: sparse.csc_matrix, linear: Floats, rows: Floats, offset: Floats, cones: list) -> Floats:
    """The least x^T curvature x / 2 + linear^T x with offset - rows x in the cones."""
    status = ""
    for tolerance in _TOLERANCES:
        settings = clarabel.DefaultSettings()
        settings.verbose = False
        settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = tolerance
        solver = clarabel.DefaultSolver(curvature, linear, sparse.csc_matrix(rows), offset, cones, settings)
        try:
            result = solver.solve()
        except BaseException as error:  # the solver's panic is no Exception
            if type(error).__name__ != "PanicException":
                raise
            status = "a panic of the solver"
            continue
        status = str(result.status)
        if status in ("Solved", "AlmostSolved"):
            return np.array(result.x)
    raise DataError(
        f"the physically consistent program ended with {status}; check the prior's masses and the "
        "parameters' units, or raise `estimator.prior_strength`"
    )


def _svec(matrix: Floats) -> Floats:
    """Upper triangle (..., k (k + 1) / 2) column by column, off-diagonals times sqrt(2): clarabel's PSD cone."""
    size = matrix.shape[-1]
    entries = [matrix[..., i, j] * (1.0 if i == j else _ROOT2) for j in range(size) for i in range(j + 1)]
    return np.stack(entries, axis=-1)


def _of_svec(entries: Floats) -> Floats:
    """Symmetric matrices (..., 4, 4) of `_svec`."""
    matrix = np.empty((*entries.shape[:-1], 4, 4))
    places = [(i, j) for j in range(4) for i in range(j + 1)]
    for k, (i, j) in enumerate(places):
        matrix[..., i, j] = matrix[..., j, i] = entries[..., k] / (1.0 if i == j else _ROOT2)
    return matrix


def _psd_rows(places: np.ndarray, width: int, floor: Floats) -> tuple[Floats, Floats, list]:
    """Rows of A x + s = b for J(x) - floor in the PSD cone."""
    rows = np.zeros((_BODY, width))
    rows[:, places] = -_svec(pseudo_inertia(np.eye(_BODY))).T
    return rows, -_svec(floor), [clarabel.PSDTriangleConeT(4)]


def _entropic_rows(places: np.ndarray, width: int, first: int) -> tuple[Floats, Floats, list]:
    """log det J >= sum u: [[J, L], [L^T, diag L]] PSD and u_i <= log L_ii; L and u start at column `first`."""
    lower = [(i, j) for j in range(4) for i in range(j, 4)]
    psd = np.zeros((36, width))
    big = np.zeros((_BODY, 8, 8))
    big[:, :4, :4] = pseudo_inertia(np.eye(_BODY))
    psd[:, places] = -_svec(big).T
    exponential = np.zeros((12, width))
    offset = np.zeros(12)
    for k, (i, j) in enumerate(lower):
        block = np.zeros((8, 8))
        block[i, 4 + j] = block[4 + j, i] = 1.0
        if i == j:
            block[4 + i, 4 + i] = 1.0
            # Exponential cone (u, 1, L_ii): exp(u) <= L_ii.
            exponential[3 * i, first + _BODY + i] = -1.0
            exponential[3 * i + 2, first + k] = -1.0
            offset[3 * i + 1] = 1.0
        psd[:, first + k] = -_svec(block)
    cones = [clarabel.PSDTriangleConeT(8)] + [clarabel.ExponentialConeT()] * 4
    return np.vstack([psd, exponential]), np.concatenate([np.zeros(36), offset]), cones


def _compact(mass: float) -> Floats:
    """Pseudo-inertia of an aluminium ball of that mass, the scale of a real body."""
    radius = (3.0 * mass / (4.0 * np.pi * 2700.0)) ** (1.0 / 3.0)
    return np.diag([mass * radius**2 / 5.0] * 3 + [mass])


def _smallest(matrix: Floats) -> Floats:
    """Diagonal floor from a prior's own size, length and mass apart."""
    second = float(
        np.linalg.eigvalsh(matrix[:3, :3] - np.outer(matrix[:3, 3], matrix[:3, 3]) / matrix[3, 3])[0]
    )
    return np.diag([second] * 3 + [matrix[3, 3]])


def _sizes(body: Floats) -> Floats:
    """Natural size (10,) of each parameter of a body, with its radius of gyration as length."""
    mass = max(abs(float(body[9])), 1e-3)
    inertia = max(float(np.mean(np.abs(body[[0, 3, 5]]))), float(_compact(mass)[0, 0]) * 2.0)
    length = np.sqrt(inertia / mass)
    return np.array([inertia] * 6 + [mass * length] * 3 + [mass])


def _touching(prior: BodyPrior, standard: Floats, margin: float) -> int:
    count = 0
    for places, body in zip(prior.bodies, prior.inertial, strict=True):
        floor = margin * _smallest(pseudo_inertia(body))
        excess = np.linalg.eigvalsh(pseudo_inertia(standard[places]) - floor)[0]
        count += bool(excess < 1e-3 * np.linalg.eigvalsh(pseudo_inertia(body))[0])
    return count


def _refit(estimate: Estimate, problem: Problem, values: Floats) -> tuple:
    """Class table with the residuals of the constrained values."""
    squares = [row_class.factor.sum_of_squares(values) for row_class in problem.classes]
    return tuple(
        replace(
            fit,
            rms=float(np.sqrt(square / max(fit.rows, 1))),
            sigma=float(np.sqrt(square / max(fit.rows - fit.parameters, 1.0))),
        )
        for fit, square in zip(estimate.classes, squares, strict=True)
    )


# Prior of a payload of unknown inertia: mass, radius of gyration and relative standard deviation.
_PAYLOAD_KG = 3.0
_PAYLOAD_RADIUS_M = 0.1
_PAYLOAD_STD = 3.0
_DISSIPATIVE = ("Ia", "Fvl", "Fcl", "Fvm", "Fcm")


# Every fit of a diagnosis asks.
@lru_cache(maxsize=16)
def lacking_bodies(chain: Chain) -> str:
    """Why there is no prior of the arm's bodies, in words; empty if the URDF is one."""
    if chain.urdf is None:
        return "the chain comes from a table, not from a URDF"
    bodies = chain.urdf_inertials()
    names = [name for name, body in zip(chain.link_names, bodies, strict=True) if not body[9] > 0.0]
    if len(names) == chain.n:
        return "the URDF states no bodies"
    if names:
        return f"the URDF states no mass of {', '.join(names)}"
    try:
        nearest_consistent(bodies)
    except DataError as error:
        return f"the URDF's bodies are near no rigid ones ({error})"
    return ""


def cad_prior(
    base: BaseSet, *, relative_std: float = 0.2, payload_masses: Mapping[str, float] | None = None
) -> BodyPrior:
    """Prior of the base set's arm: the inertials of the URDF, within `relative_std` of themselves.

    payload_masses : stated mass [kg] by payload name; without it a payload is as good as unknown. Inconsistent
        inertials are replaced by the nearest consistent ones.

    Raises ConfigurationError where the URDF is no prior (`lacking_bodies`), and for a structure without rigid bodies
    (Model 3).
    """
    structure = base.structure
    if "difference" in structure.sides:
        raise ConfigurationError("Model 3 has no rigid bodies and so no prior of them; use `wls`")
    if lacking := lacking_bodies(structure.chain):
        raise ConfigurationError(
            f"{lacking}, so there is no prior for `physical` and `map`; give a URDF with the manufacturer's masses and "
            "inertias (`<inertial>`), or choose `--estimator wls`"
        )
    n = structure.chain.n
    masses = payload_masses or {}
    spheres = []
    for payload in structure.payloads:
        mass = masses.get(payload, _PAYLOAD_KG)
        inertia = np.eye(3) * mass * _PAYLOAD_RADIUS_M**2
        spheres.append(from_com(mass, np.zeros(3), inertia))
    links = nearest_consistent(structure.chain.urdf_inertials())
    inertial = np.vstack([links, *[sphere[None, :] for sphere in spheres]])
    bodies = np.array(
        [[len(PER_LINK) * k + i for i in range(len(INERTIAL))] for k in range(structure.n_links)],
        dtype=np.int64,
    )
    symbols = [split_name(name)[0] for name in structure.names]
    acts = np.any(base.matrix != 0.0, axis=0)
    rigid = np.zeros(structure.n_columns, dtype=bool)
    rigid[bodies.ravel()] = True
    return BodyPrior(
        projection=np.asarray(base.matrix),
        bodies=bodies,
        nonnegative=np.array(
            [k for k, s in enumerate(symbols) if s in _DISSIPATIVE and acts[k]], dtype=np.int64
        ),
        inertial=inertial,
        absent=np.flatnonzero((~rigid & ~acts) | ~structure.active),
        relative_std=np.array([relative_std] * n + [_PAYLOAD_STD] * len(spheres)),
    )
