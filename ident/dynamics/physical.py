"""Physically consistent bodies nearest to identified base parameters.

Base parameters fix only combinations of the standard ones; the free combinations are chosen here. With P(x)
the pseudo-inertia of a body (`parameters.pseudo_inertia`) the program over the inertial parameters x is::

    minimise    (K x - chi)' W (K x - chi) / 2  +  w sum_bodies tr[(P0^-1 (P(x) - P0))^2] / 2
    subject to  P(x) >= margin P0   for every body

The first attempt has K x = chi exactly: the torques are the identified ones, and only the free combinations
follow the reference bodies P0. If no consistent bodies have these base parameters, the base parameters move in
units of their standard deviations (W is the inverse covariance), and the result reports the shift.

Reference: Sousa and Cortesao, Physical feasibility of robot base inertial parameter identification, 2014 (the
linear matrix inequality); Wensing, Kim and Slotine 2018 (pseudo-inertia); Lee, Wensing and Park 2020 (the
metric of P0).
"""

from __future__ import annotations

import logging
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy import sparse

from fri.errors import ConfigurationError, DataError
from ident.dynamics import parameters
from ident.dynamics.parameters import Floats

logger = logging.getLogger(__name__)

_SQRT2 = float(np.sqrt(2.0))
# Rows and columns of the upper triangle, column after column: the order of the solver's cone.
_TRIANGLE = ((0, 0), (0, 1), (1, 1), (0, 2), (1, 2), (2, 2), (0, 3), (1, 3), (2, 3), (3, 3))


_TOUCH = 1e-9
"""Weight of the bodies beside that of the base parameters, in units of the best known of these."""
_ON_FACE = 1e-4
"""Share of the reference below which a quantity counts as zero: the solver stops at 1e-8, and an eigenvalue there errs
by the root of it."""


@dataclass(frozen=True, eq=False)
class Projection:
    """Consistent bodies for base parameters.

    bodies : (k, 10) inertial parameters. base : (b,) their base parameters.
    exact : whether these are the identified ones.
    shift : (b,) shift of each base parameter in its standard deviations; zero when exact.
    """

    bodies: Floats
    base: Floats
    exact: bool
    shift: Floats

    @property
    def worst(self) -> float:
        """Largest shift of a base parameter in standard deviations."""
        return float(np.max(np.abs(self.shift), initial=0.0))


def project(
    matrix: ArrayLike,
    base: ArrayLike,
    reference: ArrayLike,
    *,
    covariance: ArrayLike | None = None,
    margin: float = 1e-3,
    firmness: float = 0.1,
) -> Projection:
    """Consistent bodies for base parameters, see the head of the module.

    matrix : (b, 10 k), K: base parameters of the bodies' inertial parameters. base : (b,), chi.
    reference : (k, 10) consistent bodies P0.
    covariance : (b, b) of `base`; without it a parameter's scale is the reference bodies' contribution.
    margin : smallest pseudo-inertia allowed, as a share of that of the reference body.
    firmness : weight w of the reference bodies when the base parameters must move; with 0.1 a body differs by
        three times its own size for one standard deviation.

    Raises ConfigurationError for wrong shapes or an inconsistent reference body, DataError without a solution.
    """
    bodies = np.atleast_2d(np.asarray(reference, dtype=np.float64))
    k_matrix, chi = np.asarray(matrix, dtype=np.float64), np.asarray(base, dtype=np.float64)
    if k_matrix.shape != (len(chi), bodies.size):
        raise ConfigurationError(f"matrix has shape {k_matrix.shape}; expected ({len(chi)}, {bodies.size})")
    roots = _roots(bodies)
    # x = x0 + T z, with z the entries of L^-1 (P - P0) L^-T: every body has the size of one.
    step = _steps(roots)
    slope, missing = k_matrix @ step, chi - k_matrix @ bodies.ravel()
    if covariance is not None and np.shape(covariance) != (len(slope), len(slope)):
        raise ConfigurationError(f"covariance has shape {np.shape(covariance)}; expected {(len(slope),) * 2}")
    # Change of each base parameter when a body changes by its own size.
    scale = np.linalg.norm(slope, axis=1)
    used = scale > 0.0
    found = None
    for closeness in (margin, 1e-3 * margin):
        found = _solve_exact(
            slope[used] / scale[used, None], missing[used] / scale[used], len(bodies), closeness
        )
        if found is not None:
            break
    exact = found is not None
    if found is None:
        logger.info(
            "no real bodies have the identified base parameters; moving these within their uncertainty"
        )
        weight = _root_weight(scale, covariance)
        found = _solve_nearest(weight @ slope, weight @ missing, len(bodies), margin, firmness)
    x = bodies.ravel() + step @ found
    if exact:
        # The solver stops at 1e-9; least squares gives the last digits, far inside the margin.
        x = x + step @ np.linalg.lstsq(slope, chi - k_matrix @ x, rcond=1e-12)[0]
    reached = k_matrix @ x
    sigma = scale if covariance is None else np.sqrt(np.maximum(np.diag(np.asarray(covariance)), 0.0))
    moved = np.where(sigma > 0.0, (reached - chi) / np.where(sigma > 0.0, sigma, 1.0), 0.0)
    return Projection(x.reshape(-1, 10), reached, exact, np.zeros_like(moved) if exact else moved)


@dataclass(frozen=True, eq=False)
class Nearest:
    """The real arm nearest to base parameters, in the metric of their covariance.

    base : (b,) its base parameters. shift : (b,) from the given ones, in standard deviations. distance : of all
    together, in standard deviations. conditions : number of conditions on the base parameters that it just meets.
    """

    base: Floats
    shift: Floats
    distance: float
    conditions: int


def nearest_real(
    matrix: ArrayLike,
    base: ArrayLike,
    reference: ArrayLike,
    covariance: ArrayLike,
    *,
    nonnegative: ArrayLike | None = None,
    free: ArrayLike | None = None,
) -> Nearest:
    """The real arm nearest to base parameters::

        minimise (K x + N u + F v - chi)' C^-1 (K x + N u + F v - chi)   subject to  P(x) >= 0 of every body,  u >= 0

    matrix : (b, 10 k) K. base : (b,) chi. reference : (k, 10) real bodies, for scale. covariance : (b, b) C, with a
        diagonal above zero. nonnegative : (b, m) N, of parameters with zero as their least value. free : (b, f) F.

    Raises ConfigurationError for wrong shapes, DataError without a solution.
    """
    bodies = np.atleast_2d(np.asarray(reference, dtype=np.float64))
    chi, c = np.asarray(base, dtype=np.float64), np.asarray(covariance, dtype=np.float64)
    parts = [
        np.asarray(part if part is not None else np.zeros((len(chi), 0)), dtype=np.float64)
        for part in (matrix, nonnegative, free)
    ]
    if c.shape != (len(chi),) * 2 or any(len(part) != len(chi) for part in parts):
        raise ConfigurationError(f"shapes do not fit: {len(chi)} base parameters, covariance {c.shape}")
    k, n, f = parts
    std = np.sqrt(np.diag(c))
    white = _root_weight(std, c)
    slope = k @ _steps(_roots(bodies))
    size, m = 10 * len(bodies), n.shape[1]
    # Columns without a bound are fitted beforehand: the rest is what they leave.
    rest = np.eye(len(chi))
    if f.shape[1]:
        q = np.linalg.qr(white @ f)[0]
        rest -= q @ q.T
    columns = rest @ white @ np.hstack([slope, n])
    missing = rest @ white @ (chi - k @ bodies.ravel())
    own = columns[:, :size] if np.any(columns[:, :size]) else columns
    unit = max(float(np.linalg.norm(own, axis=1).max(initial=0.0)), 1e-300)
    length = np.concatenate([np.ones(size), np.linalg.norm(columns[:, size:], axis=0) / unit])
    length[length <= 0.0] = 1.0
    columns, missing = columns / length / unit, missing / unit
    b = len(chi)
    # The bodies' own weight only chooses among those that are equally near.
    p = sparse.diags(np.concatenate([np.full(size, _TOUCH), np.zeros(m), np.ones(b)]))
    link = sparse.hstack([sparse.csc_matrix(columns), -sparse.identity(b)], format="csc")
    x = _solve(p, link, missing, len(bodies), 0.0, m)
    if x is None:
        raise DataError("no nearest bodies were found for these parameters; check the estimate")
    residual = unit * x[size + m :]
    z, u = x[:size], x[size : size + m]
    values = [np.eye(4) + _matrix(one) for one in z.reshape(-1, 10)]
    bound = [*_face(values, slope), *(n[:, j] for j in range(m) if u[j] > _ON_FACE), *f.T]
    fixed = np.array(bound).reshape(-1, b) * std
    norms = np.linalg.norm(fixed, axis=1)
    fixed = fixed[norms > 0.0] / norms[norms > 0.0, None]
    conditions = b - (int(np.linalg.matrix_rank(fixed, tol=_ON_FACE)) if len(fixed) else 0)
    shift = np.asarray(np.linalg.solve(white * std, residual), dtype=np.float64)
    return Nearest(np.asarray(chi + std * shift), shift, float(np.linalg.norm(residual)), conditions)


def _matrix(entries: Floats) -> Floats:
    """(4, 4) symmetric matrix of its scaled upper triangle."""
    matrix = np.zeros((4, 4))
    for value, (i, j) in zip(entries, _TRIANGLE, strict=True):
        matrix[i, j] = matrix[j, i] = value if i == j else value / _SQRT2
    return matrix


def _face(bodies: list[Floats], slope: Floats) -> list[Floats]:
    """Directions (b,) in which the base parameters move freely: those of bodies within their face.

    bodies : (4, 4) each, as a share of the reference. Moves U A + A' U' of a body with range U keep its rank.
    """
    found = []
    for number, body in enumerate(bodies):
        values, vectors = np.linalg.eigh(body)
        own = vectors[:, values > _ON_FACE * max(values[-1], 1.0)]
        for column in own.T:
            for axis in np.eye(4):
                move = np.outer(column, axis) + np.outer(axis, column)
                entries = [move[i, j] * (1.0 if i == j else _SQRT2) for i, j in _TRIANGLE]
                found.append(slope[:, 10 * number : 10 * number + 10] @ np.array(entries))
    return found


def reference_bodies(
    bodies: ArrayLike, *, smallest_mass_kg: float = 0.05, gyration_m: float = 0.01
) -> Floats:
    """Consistent bodies (k, 10) near the given ones, for inconsistent CAD models and published parameters.

    Masses are raised to `smallest_mass_kg`, principal second moments of mass to mass x `gyration_m`^2.
    """
    found = []
    for body in np.atleast_2d(np.asarray(bodies, dtype=np.float64)):
        mass = max(float(body[9]), smallest_mass_kg)
        com = body[6:9] / mass
        pseudo = parameters.pseudo_inertia(body)
        second = pseudo[:3, :3] - mass * np.outer(com, com)
        values, vectors = np.linalg.eigh(0.5 * (second + second.T))
        second = (vectors * np.maximum(values, mass * gyration_m**2)) @ vectors.T
        full = np.empty((4, 4))
        full[:3, :3] = second + mass * np.outer(com, com)
        full[:3, 3] = full[3, :3] = mass * com
        full[3, 3] = mass
        found.append(parameters.from_pseudo_inertia(full))
    return np.array(found)


def _roots(bodies: Floats) -> Floats:
    try:
        return np.asarray(np.linalg.cholesky(parameters.pseudo_inertia(bodies)), dtype=np.float64)
    except np.linalg.LinAlgError as error:
        bad = [verdict for verdict in parameters.consistency(bodies) if not verdict.consistent]
        reason = bad[0].reason if bad else "a pseudo-inertia is singular"
        raise ConfigurationError(
            f"a reference body cannot exist: {reason}; see `reference_bodies`"
        ) from error


def _steps(roots: Floats) -> Floats:
    """(10 k, 10 k) block diagonal T of x = x0 + T z, z the scaled upper triangles of L^-1 (P - P0) L^-T."""
    count = len(roots)
    steps = np.zeros((10 * count, 10 * count))
    for k, root in enumerate(roots):
        for column, (i, j) in enumerate(_TRIANGLE):
            unit = np.zeros((4, 4))
            unit[i, j] = unit[j, i] = 1.0 if i == j else 1.0 / _SQRT2
            body = parameters.from_pseudo_inertia(root @ unit @ root.T)
            steps[10 * k : 10 * k + 10, 10 * k + column] = body
    return steps


def _root_weight(scale: Floats, covariance: ArrayLike | None) -> Floats:
    """Square root of the weight W; directions without variance are held to 1e-6 of the scale."""
    if covariance is None:
        return np.diag(1.0 / np.where(scale > 0.0, scale, 1.0))
    matrix = np.asarray(covariance, dtype=np.float64)
    size = np.where(scale > 0.0, scale, 1.0)
    values, vectors = np.linalg.eigh(matrix / np.outer(size, size))
    floor = max(1e-12, 1e-12 * float(values.max(initial=0.0)))
    return (vectors / np.sqrt(np.maximum(values, floor))).T / size


def _solve_exact(slope: Floats, missing: Floats, bodies: int, margin: float) -> Floats | None:
    """min |z|^2 / 2 with slope z = missing and all bodies real; None if there are none."""
    # The rows of the base set are independent but badly scaled: take orthonormal ones.
    left, values, right = np.linalg.svd(slope, full_matrices=False)
    keep = values > 1e-10 * values.max(initial=0.0)
    rows, target = right[keep], (left.T @ missing)[keep] / values[keep]
    return _solve(sparse.identity(10 * bodies), sparse.csc_matrix(rows), target, bodies, margin)


def _solve_nearest(slope: Floats, missing: Floats, bodies: int, margin: float, firmness: float) -> Floats:
    """min |slope z - missing|^2 / 2 + firmness |z|^2 / 2 with all bodies real."""
    size = 10 * bodies
    _, triangle = np.linalg.qr(np.column_stack([slope, missing]))
    rows = triangle[:, :size]
    right = triangle[:, size]
    unit = max(float(np.linalg.norm(rows, axis=1).max()), 1e-300)
    rows, right = rows / unit, right / unit
    # Residuals r = rows z - right are variables, for better scaling.
    p = sparse.diags(np.concatenate([np.full(size, firmness / unit**2 + 1e-12), np.ones(len(rows))]))
    link = sparse.hstack([sparse.csc_matrix(rows), -sparse.identity(len(rows))], format="csc")
    solution = _solve(p, link, right, bodies, margin)
    if solution is None:
        raise DataError(
            "no consistent bodies were found for these parameters; check the estimate and the prior bodies"
        )
    return solution[:size]


def _solve(
    p: sparse.spmatrix,
    rows: sparse.csc_matrix,
    target: Floats,
    bodies: int,
    margin: float,
    nonnegative: int = 0,
) -> Floats | None:
    """min z' p z / 2 with rows z = target, 1 + mat(z) - margin 1 >= 0 of each body, and z >= 0 in as many entries
    behind the bodies' as `nonnegative`; None without any z."""
    import clarabel

    size, columns = 10 * bodies, rows.shape[1]
    identity = np.array([1.0 if i == j else 0.0 for i, j in _TRIANGLE])
    a = sparse.vstack([rows, -sparse.eye(size + nonnegative, columns)], format="csc")
    b = np.concatenate([target, np.tile((1.0 - margin) * identity, bodies), np.zeros(nonnegative)])
    cones = [clarabel.ZeroConeT(len(target)), *[clarabel.PSDTriangleConeT(4)] * bodies]
    if nonnegative:
        cones.append(clarabel.NonnegativeConeT(nonnegative))
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    settings.max_iter = 200
    solution = clarabel.DefaultSolver(sparse.csc_matrix(p), np.zeros(columns), a, b, cones, settings).solve()
    status = str(solution.status)
    logger.debug("cone program: %s after %s iterations", status, solution.iterations)
    return np.array(solution.x) if status in ("Solved", "AlmostSolved") else None
