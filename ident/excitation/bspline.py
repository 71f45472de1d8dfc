"""B-spline motions at rest at both ends, after Rackl, Lampariello and Hirzinger (2012).

Degree 5 on uniform knots, so the jerk is continuous. The first three and last three control points are equal
and the same, which gives zero velocity and acceleration at both ends and closes the motion: it can be
repeated like a Fourier series.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt
from scipy.interpolate import BSpline, PPoly

from fri.errors import ConfigurationError
from ident.excitation.motion import Array, Extrema, ParametricMotion, Samples

__all__ = ["SplineBasis", "SplineMotion"]

DEGREE = 5
_REST = 3


@dataclass(frozen=True, eq=False)
class SplineMotion:
    """Clamped uniform B-spline: duration [s] and all control points (joints, k) [rad]."""

    duration_s: float
    points: Array

    def __post_init__(self) -> None:
        points = np.array(self.points, dtype=np.float64)
        if points.ndim != 2 or points.shape[1] < 2 * _REST + 1 or not np.all(np.isfinite(points)):
            raise ConfigurationError(
                f"spline control points of shape {points.shape}; expected (joints, {2 * _REST + 1} or more)"
            )
        if not (np.isfinite(self.duration_s) and self.duration_s > 0):
            raise ConfigurationError(f"spline duration {self.duration_s} s is not a positive number")
        points.flags.writeable = False
        object.__setattr__(self, "points", points)

    @property
    def duration(self) -> float:
        """Length of one run [s]."""
        return self.duration_s

    @property
    def joints(self) -> int:
        """Number of joints."""
        return int(self.points.shape[0])

    def _spline(self) -> BSpline:
        return BSpline(
            _knots(self.duration_s, self.points.shape[1]), self.points.T, DEGREE, extrapolate=False
        )

    def sample(self, t: npt.ArrayLike) -> Samples:
        """Positions, velocities, accelerations and jerks at the times t (n,) [s]; times wrap at the
        duration.
        """
        times = np.atleast_1d(np.asarray(t, dtype=np.float64))
        inside = np.where(times == self.duration_s, times, np.mod(times, self.duration_s))
        spline = self._spline()
        return Samples(*(np.asarray(spline(inside, nu=order)) for order in range(4)))

    def extrema(self, derivative: int) -> Extrema:
        """Exact extreme values: knots and the roots of the next derivative, piece by piece."""
        knots = _knots(self.duration_s, self.points.shape[1])
        edges = np.unique(knots)
        found = np.empty((4, self.joints))
        for joint in range(self.joints):
            single = PPoly.from_spline((knots, self.points[joint], DEGREE)).derivative(derivative)
            roots = single.derivative().roots(extrapolate=False)
            times = np.concatenate([edges, roots[np.isfinite(roots)]])
            values = np.asarray(single(times))
            low, high = int(np.argmin(values)), int(np.argmax(values))
            found[:, joint] = values[low], values[high], times[low], times[high]
        return Extrema(*found)


@dataclass(frozen=True)
class SplineBasis:
    """Splines with `control_points` free control points a joint: one for both ends, the rest in between."""

    duration_s: float
    control_points: int = 12
    _expand: Array = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        if not (np.isfinite(self.duration_s) and self.duration_s > 0):
            raise ConfigurationError(f"spline duration {self.duration_s} s is not a positive number")
        if self.control_points < 2:
            raise ConfigurationError(f"control_points {self.control_points} is below 2; nothing would move")
        inner = self.control_points - 1
        expand = np.zeros((inner + 2 * _REST, self.control_points))
        expand[:_REST, 0] = expand[-_REST:, 0] = 1.0
        expand[_REST : _REST + inner, 1:] = np.eye(inner)
        object.__setattr__(self, "_expand", expand)

    @property
    def duration(self) -> float:
        """Length of the motion [s]."""
        return self.duration_s

    @property
    def free(self) -> int:
        """Free coefficients of each joint."""
        return self.control_points

    def matrix(self, t: npt.ArrayLike, derivative: int = 0) -> Array:
        """Basis functions at t, (n, free)."""
        count = self._expand.shape[0]
        times = np.atleast_1d(np.asarray(t, dtype=np.float64))
        spline = BSpline(_knots(self.duration_s, count), self._expand, DEGREE)
        return np.asarray(spline(np.clip(times, 0.0, self.duration_s), nu=derivative))

    def motion(self, x: Array) -> SplineMotion:
        """The spline with the free control points x (joints, free)."""
        x = np.asarray(x, dtype=np.float64)
        if x.ndim != 2 or x.shape[1] != self.free:
            raise ConfigurationError(
                f"free control points of shape {x.shape}; expected (joints, {self.free})"
            )
        return SplineMotion(self.duration_s, x @ self._expand.T)

    def coefficients(self, motion: ParametricMotion) -> Array:
        """Free control points of a spline of this size; ConfigurationError for anything else."""
        if not isinstance(motion, SplineMotion) or motion.points.shape[1] != self._expand.shape[0]:
            raise ConfigurationError("the motion is no spline of this basis")
        if not np.isclose(motion.duration_s, self.duration_s, rtol=1e-12):
            raise ConfigurationError(
                f"spline of {motion.duration_s} s does not fit a basis of {self.duration_s} s"
            )
        return np.asarray(np.linalg.lstsq(self._expand, motion.points.T, rcond=None)[0].T)

    def grid_factor(self, n: int, derivative: int) -> float:
        """No bound is known from samples alone, so a small reserve; the exact extrema decide afterwards."""
        return 1.002


def _knots(duration: float, count: int) -> Array:
    inner = np.linspace(0.0, duration, count - DEGREE + 1)
    return np.concatenate([np.zeros(DEGREE), inner, np.full(DEGREE, duration)])
