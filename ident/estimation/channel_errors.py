"""What small errors of the torque channels do to an estimate: gains and crosstalk, known by their disagreement.

A gain off by half a per cent bends the parameters in the same way all through a motion, so no comparison of parts of
the motion shows it. But joints and sides share their bodies, and tell the errors of one channel from those of another.
With the torques tau = A chi of all channels, the residual of the channel of joint j is, to first order,

    rest = gain_j tau_j + sum over other joints i of crosstalk_ji tau_i + noise,

with gains and crosstalks normal about zero, each kind with one standard deviation, of the greatest likelihood given
the residual (empirical Bayes; the fixed point of expectation and maximisation, Dempster, Laird and Rubin 1977). What
the channels do not tell, such as a gain common to all, has the standard deviation of what they do. The mean square of
the error that the channels leave in the estimate, its mean and its uncertainty, is added to the stated covariance. The
estimate itself stays.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular

from ident.dynamics.parameters import Floats
from ident.effects import SENSOR_GAIN
from ident.estimators.estimate import Estimate
from ident.estimators.problem import Problem, RowGroup, TriangularFactor

EXACT_CHANNELS = "exact channels"
"""Name of the covariance without errors of the channels: that of further sessions with the same channels."""
_KINDS = ("gains", "crosstalk")
_STEPS = 200
# Change of a standard deviation in a step that is none.
_SETTLED = 1e-5
# Least standard deviation.
_LEAST = 1e-6


@dataclass(frozen=True)
class ChannelErrors:
    """Errors of the torque channels. std : standard deviation by kind. spread : (p, p) mean square error of the
    estimate by them."""

    std: Mapping[str, float]
    spread: Floats

    def __str__(self) -> str:
        return ", ".join(f"{kind} {100.0 * std:.2g} %" for kind, std in self.std.items())


def beside_channel_errors(problem: Problem, estimate: Estimate) -> Estimate:
    """The estimate with the errors of the torque channels in its stated covariance."""
    found = channel_errors(problem, estimate)
    if found is None:
        return estimate
    stated = estimate.covariance
    kind = f"{stated.kind}; beside errors of the torque channels ({found})"
    return replace(
        estimate,
        covariance=replace(stated, matrix=stated.matrix + found.spread, kind=kind),
        covariances={**estimate.covariances, EXACT_CHANNELS: stated},
    )


def of_exact_channels(estimate: Estimate) -> Estimate:
    """The estimate without the errors of the torque channels in its stated covariance: no motion tells them, and they
    are the same on each day."""
    return replace(estimate, covariance=estimate.covariances.get(EXACT_CHANNELS, estimate.covariance))


def channel_errors(problem: Problem, estimate: Estimate) -> ChannelErrors | None:
    """The errors that residuals of an estimate tell; None for rows of the difference of two channels."""
    if any(group.side == "difference" for group in problem.groups):
        return None
    torques = [group.matrix @ estimate.values for group in problem.groups]
    names = list(dict.fromkeys((group.side, group.joint) for group in problem.groups))
    pairs = [(name, name) for name in names]
    pairs += [(a, b) for a in names for b in names if a != b and a[0] == b[0]]
    kinds = np.array([int(a != b) for a, b in pairs])
    p, k = len(problem.names), len(pairs)
    moments, factors = np.zeros((p, k)), []
    for number, group in enumerate(problem.groups):
        own = [place for place, (a, _) in enumerate(pairs) if a == (group.side, group.joint)]
        columns = _columns(problem, torques, number, [pairs[place][1][1] for place in own])
        moments[:, own] += estimate.score_weights[problem.class_of_group[number]] * (group.matrix.T @ columns)
        factors.append(_placed(group, columns, p, k, own))
    # Serial correlation makes the rows tell less: as many as are independent.
    shares = [fit.n_eff / max(fit.rows, 1) for fit in estimate.classes]
    weights = [estimate.weights[c] * shares[c] for c in problem.class_of_group]
    # Orthogonal to all parameters.
    rest = TriangularFactor.combine(factors, weights).r[p:, p:]
    mean, covariance, std = _posterior(rest[:, :k], rest[:, k], kinds)
    shift = estimate.bread @ moments
    spread = shift @ (covariance + np.outer(mean, mean)) @ shift.T
    return ChannelErrors(dict(zip(_KINDS, std.tolist(), strict=False)), spread)


def _columns(problem: Problem, torques: list[Floats], number: int, joints: list[str]) -> Floats:
    """Torques (m, k) of these joints at the rows of a group; zero where the other joint has no row."""
    group = problem.groups[number]
    found = np.zeros((len(group.target), len(joints)))
    for other, torque in zip(problem.groups, torques, strict=True):
        if (other.side, other.record) == (group.side, group.record) and other.joint in joints:
            _, mine, theirs = np.intersect1d(
                group.time_index, other.time_index, assume_unique=True, return_indices=True
            )
            found[mine, joints.index(other.joint)] = torque[theirs]
    return found


def _placed(group: RowGroup, columns: Floats, p: int, k: int, own: list[int]) -> TriangularFactor:
    """Factor of a group's rows with these columns of all further ones."""
    part = TriangularFactor.of(np.column_stack([group.matrix, columns]), group.target)
    places = np.array([*range(p), *(p + place for place in own), p + k])
    whole = np.zeros((p + k + 1, p + k + 1))
    whole[np.ix_(places, places)] = part.r
    return TriangularFactor(whole, part.rows)


def _posterior(matrix: Floats, target: Floats, kinds: NDArray[np.int64]) -> tuple[Floats, Floats, Floats]:
    """Mean (k,) and covariance (k, k) of the errors, from rows (m, k) of unit variance; deviation of each kind."""
    std = np.full(int(kinds.max()) + 1, SENSOR_GAIN.usual_change)
    for _ in range(_STEPS):
        # Scaled by the deviations, and without normal equations: no row may tell an error, or all of them exactly.
        scale = std[kinds]
        root = np.linalg.qr(np.vstack([matrix * scale, np.eye(len(scale))]), mode="r")
        half = scale[:, None] * solve_triangular(root, np.eye(len(scale)))
        covariance = half @ half.T
        mean = half @ (half.T @ (matrix.T @ target))
        square = mean**2 + np.diag(covariance)
        before = std
        std = np.array([max(np.sqrt(np.mean(square[kinds == kind])), _LEAST) for kind in range(len(std))])
        if np.max(np.abs(std - before)) < _SETTLED:
            break
    return mean, covariance, std
