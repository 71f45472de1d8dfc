"""Exciting motions: Fourier series, B-splines and point-to-point motion behind one interface.

Fourier series with rest at both ends, equation (9), are the standard form:

    q_i(t) = q_i0 + sum_k a_ik sin(k w0 t) + b_ik cos(k w0 t),   w0 = 2 pi / T0,   k = 1 .. n_f

Zero velocity at t = 0 requires sum_k k a_ik = 0, zero acceleration sum_k k² b_ik = 0. The free coefficients span
the null space of these two conditions; periodicity carries both to T0. (Swevers, Ganseman, Tükel, De Schutter and
Van Brussel 1997; Park 2006 for the rest conditions.)

B-splines follow Rackl, Lampariello and Hirzinger (2012): degree 5 on uniform knots for a continuous jerk. The first
three and the last three control points are equal, for rest at both ends and a closed motion.

Point-to-point motion: between two postures all joints move in proportion along one profile s(t) from 0 to 1, a
straight line in joint space. The profile is a trapezoid in velocity, smoothed by a moving average to bound the jerk.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import pairwise
from typing import NamedTuple, Protocol

import numpy as np
import numpy.typing as npt
from scipy.interpolate import BSpline, PPoly
from scipy.linalg import null_space

from fri.errors import ConfigurationError

Array = npt.NDArray[np.float64]
_REST_TOLERANCE = 1e-9
DEGREE = 5
_REST = 3
_INSTANT = 1e-9


class Samples(NamedTuple):
    """A motion at n times; each array (n, joints) float64."""

    q: Array
    """Joint positions [rad]."""
    qd: Array
    """Joint velocities [rad/s]."""
    qdd: Array
    """Joint accelerations [rad/s²]."""
    qddd: Array
    """Joint jerks [rad/s³]."""


class Extrema(NamedTuple):
    """Smallest and largest value of each joint on the continuous motion, and when; arrays (joints,)."""

    low: Array
    high: Array
    t_low: Array
    t_high: Array


class ParametricMotion(Protocol):
    """A motion defined at every instant: Fourier series, B-spline, point to point."""

    @property
    def duration(self) -> float:
        """Length of one run [s], the period of a periodic motion."""

    @property
    def joints(self) -> int:
        """Number of joints."""

    def sample(self, t: npt.ArrayLike) -> Samples:
        """Positions and three derivatives at the times t (n,) [s]."""

    def extrema(self, derivative: int) -> Extrema:
        """Exact extreme values of a derivative (0 to 3) on the continuous motion."""


class Basis(Protocol):
    """Parametrisation linear in its free coefficients: q(t) = matrix(t) @ x.T, x of shape (joints, free).

    Rest conditions are part of the basis: every x gives zero velocity and acceleration at both ends.
    """

    @property
    def duration(self) -> float:
        """Length of the motion [s]."""

    @property
    def free(self) -> int:
        """Free coefficients of each joint."""

    def matrix(self, t: npt.ArrayLike, derivative: int = 0) -> Array:
        """Values of the basis functions or their derivatives at t, (n, free)."""

    def motion(self, x: Array) -> ParametricMotion:
        """The motion with the free coefficients x (joints, free)."""

    def grid_factor(self, n: int, derivative: int) -> float:
        """Upper bound of (true maximum) / (maximum on n equidistant samples), centred signals."""


@dataclass(frozen=True, eq=False)
class FourierSeries:
    """Equation (9) with numbers: bias q0 (joints,), a and b (joints, n_f) [rad], base period T0 [s].

    Rest at the ends is not enforced here but by `FourierBasis`; see `at_rest`.
    """

    period_s: float
    bias: Array
    a: Array
    b: Array

    def __post_init__(self) -> None:
        bias, a, b = (np.array(part, dtype=np.float64) for part in (self.bias, self.a, self.b))
        _require_positive("base period", self.period_s)
        if bias.ndim != 1 or a.shape != b.shape or a.ndim != 2 or a.shape[0] != bias.size or a.shape[1] < 1:
            raise ConfigurationError(
                f"Fourier coefficients of shapes {bias.shape}, {a.shape}, {b.shape}; "
                "expected (joints,), (joints, n_f), (joints, n_f)"
            )
        for name, part in (("bias", bias), ("a", a), ("b", b)):
            if not np.all(np.isfinite(part)):
                raise ConfigurationError(f"Fourier coefficients `{name}` contain a number that is not finite")
            part.flags.writeable = False
            object.__setattr__(self, name, part)

    def __repr__(self) -> str:
        return f"FourierSeries({self.joints} joints, n_f = {self.harmonics}, T0 = {self.period_s:g} s)"

    @property
    def duration(self) -> float:
        """One base period T0 [s]."""
        return self.period_s

    @property
    def joints(self) -> int:
        """Number of joints."""
        return int(self.bias.size)

    @property
    def harmonics(self) -> int:
        """Order n_f."""
        return int(self.a.shape[1])

    @property
    def at_rest(self) -> bool:
        """True if velocity and acceleration vanish at t = 0 (and so at every multiple of T0)."""
        k = np.arange(1, self.harmonics + 1)
        scale = 1.0 + np.max(np.abs(self.a)) + np.max(np.abs(self.b))
        residual = max(float(np.max(np.abs(self.a @ k))), float(np.max(np.abs(self.b @ k**2))))
        return residual < _REST_TOLERANCE * scale * self.harmonics**2

    def derivative(self, t: npt.ArrayLike, order: int) -> Array:
        """Derivative of the given order (0 is the position) at t (n,), as (n, joints)."""
        sine, cosine = _trigonometric(self.period_s, self.harmonics, t, order)
        values = sine @ self.a.T + cosine @ self.b.T
        return values + self.bias if order == 0 else values

    def sample(self, t: npt.ArrayLike) -> Samples:
        """Positions, velocities, accelerations and jerks at the times t (n,) [s]."""
        return Samples(*(self.derivative(t, order) for order in range(4)))

    def extrema(self, derivative: int) -> Extrema:
        """Exact extreme values of a derivative on the whole period.

        The stationary points of a trigonometric polynomial of order n are the roots on the unit circle of an
        algebraic polynomial of degree 2n. The angles of all roots are tried, and 8 n equidistant points besides:
        a root moved off the circle by rounding then costs an error of second order only.
        """
        order, joints = self.harmonics, self.joints
        w0 = 2.0 * np.pi / self.period_s
        found = np.empty((4, joints))
        for joint in range(joints):
            sine, cosine = self._harmonics(joint, derivative + 1)
            polynomial = np.zeros(2 * order + 1, dtype=np.complex128)
            polynomial[order + 1 :] = 0.5 * (cosine - 1j * sine)
            polynomial[:order] = 0.5 * (cosine + 1j * sine)[::-1]
            peak = np.max(np.abs(polynomial))
            angles = np.linspace(0.0, 2.0 * np.pi, 8 * order, endpoint=False)
            if peak > 0.0:
                roots = np.polynomial.polynomial.polyroots(np.trim_zeros(polynomial / peak, "b"))
                angles = np.concatenate([angles, np.angle(roots[roots != 0.0]) % (2.0 * np.pi)])
            times = angles / w0
            values = self.derivative(times, derivative)[:, joint]
            low, high = int(np.argmin(values)), int(np.argmax(values))
            found[:, joint] = values[low], values[high], times[low], times[high]
        return Extrema(*found)

    def _harmonics(self, joint: int, order: int) -> tuple[Array, Array]:
        """Sine and cosine coefficients of the derivative of one joint, (n_f,) each."""
        k = 2.0 * np.pi / self.period_s * np.arange(1, self.harmonics + 1)
        sine, cosine = np.array(self.a[joint]), np.array(self.b[joint])
        for _ in range(order):
            sine, cosine = -k * cosine, k * sine
        return sine, cosine


@dataclass(frozen=True)
class FourierBasis:
    """Fourier series of order n_f and period T0 with zero velocity and acceleration at both ends.

    Each joint has 2 n_f - 1 free coefficients: bias, n_f - 1 sines, n_f - 1 cosines.
    """

    period_s: float
    harmonics: int = 5
    _null: tuple[Array, Array] = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        _require_positive("base period", self.period_s)
        if self.harmonics < 2:
            raise ConfigurationError(
                f"harmonics {self.harmonics} is below 2; rest at both ends takes one sine and one cosine, "
                "so nothing would move"
            )
        k = np.arange(1.0, self.harmonics + 1.0)
        null = (null_space(k[None, :]), null_space((k**2)[None, :]))
        object.__setattr__(self, "_null", null)

    @property
    def duration(self) -> float:
        """One base period T0 [s]."""
        return self.period_s

    @property
    def free(self) -> int:
        """Free coefficients of each joint, 2 n_f - 1."""
        return 2 * self.harmonics - 1

    def matrix(self, t: npt.ArrayLike, derivative: int = 0) -> Array:
        """Basis functions at t: constant, n_f - 1 sine, n_f - 1 cosine combinations; (n, free)."""
        sine, cosine = _trigonometric(self.period_s, self.harmonics, t, derivative)
        constant = np.full((sine.shape[0], 1), 1.0 if derivative == 0 else 0.0)
        return np.hstack([constant, sine @ self._null[0], cosine @ self._null[1]])

    def motion(self, x: Array) -> FourierSeries:
        """The series with the free coefficients x (joints, free)."""
        x = np.asarray(x, dtype=np.float64)
        if x.ndim != 2 or x.shape[1] != self.free:
            raise ConfigurationError(
                f"free coefficients of shape {x.shape}; expected (joints, {self.free}) "
                f"for n_f = {self.harmonics}"
            )
        split = self.harmonics
        return FourierSeries(
            self.period_s, x[:, 0], x[:, 1:split] @ self._null[0].T, x[:, split:] @ self._null[1].T
        )

    def grid_factor(self, n: int, derivative: int) -> float:
        """Upper bound of (true maximum) / (grid maximum) of |q - bias| or a derivative."""
        return _ehlich_zeller(self.harmonics, n)


def _trigonometric(period_s: float, order: int, t: npt.ArrayLike, derivative: int) -> tuple[Array, Array]:
    """Derivatives of sin(k w0 t) and cos(k w0 t), k = 1 .. order, at t; (n, order) each."""
    if not 0 <= derivative <= 6:
        raise ConfigurationError(f"derivative of order {derivative} asked for; 0 to 6 are available")
    times = np.atleast_1d(np.asarray(t, dtype=np.float64))
    k = 2.0 * np.pi / period_s * np.arange(1, order + 1)
    phase = np.outer(times, k) + 0.5 * np.pi * derivative
    scale = k**derivative
    return np.sin(phase) * scale, np.cos(phase) * scale


def _ehlich_zeller(order: int, n: int) -> float:
    """Factor from a grid maximum to a bound of the true maximum (Ehlich and Zeller 1964).

    max |p| <= max_grid |p| / cos(pi order / n) for a trigonometric polynomial p, n > 2 order.
    """
    if n <= 2 * order:
        raise ConfigurationError(
            f"{n} samples are too few for {order} harmonics; more than {2 * order} are needed"
        )
    return float(1.0 / np.cos(np.pi * order / n))


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
        _require_positive("spline duration", self.duration_s)
        points.flags.writeable = False
        object.__setattr__(self, "points", points)

    def __repr__(self) -> str:
        joints, count = self.points.shape
        return f"SplineMotion({joints} joints, {count} control points, {self.duration_s:g} s)"

    @property
    def duration(self) -> float:
        """Length of one run [s]."""
        return self.duration_s

    @property
    def joints(self) -> int:
        """Number of joints."""
        return int(self.points.shape[0])

    def sample(self, t: npt.ArrayLike) -> Samples:
        """Positions, velocities, accelerations and jerks at t (n,) [s]; times wrap at the duration."""
        times = np.atleast_1d(np.asarray(t, dtype=np.float64))
        inside = np.where(times == self.duration_s, times, np.mod(times, self.duration_s))
        spline = BSpline(
            _knots(self.duration_s, self.points.shape[1]), self.points.T, DEGREE, extrapolate=False
        )
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
        _require_positive("spline duration", self.duration_s)
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

    def grid_factor(self, n: int, derivative: int) -> float:
        """A small reserve instead of a bound, for lack of one; the exact extrema decide in the final check."""
        return 1.002


def _require_positive(subject: str, seconds: float) -> None:
    if not (np.isfinite(seconds) and seconds > 0):
        raise ConfigurationError(f"{subject} {seconds} s is not a positive number")


def _knots(duration: float, count: int) -> Array:
    inner = np.linspace(0.0, duration, count - DEGREE + 1)
    return np.concatenate([np.zeros(DEGREE), inner, np.full(DEGREE, duration)])


@dataclass(frozen=True)
class _Profile:
    """s(t) of one segment: speed and ramp of the trapezoid, width of the moving average [s]."""

    cruise: float
    ramp: float
    blend: float

    @property
    def trapezoid_s(self) -> float:
        """Duration of the trapezoid alone."""
        return 1.0 / self.cruise + self.ramp

    @property
    def duration(self) -> float:
        """Duration with the moving average."""
        return self.trapezoid_s + self.blend

    def pieces(self) -> PPoly:
        """Velocity of the trapezoid, extended by rest before and after."""
        end, ramp, blend = self.trapezoid_s, self.ramp, self.blend
        times = np.array([-blend - 1.0, 0.0, ramp, end - ramp, end, end + blend + 1.0])
        slope = self.cruise / ramp
        coefficients = np.array([[0.0, slope, 0.0, -slope, 0.0], [0.0, 0.0, self.cruise, self.cruise, 0.0]])
        if end - 2.0 * ramp <= _INSTANT * end:  # a triangle: full speed for an instant only
            times, coefficients = np.delete(times, 3), np.delete(coefficients, 2, axis=1)
        return PPoly(coefficients, times)


@dataclass(frozen=True, eq=False)
class PointToPoint:
    """Rest-to-rest straight lines in joint space through postures (k, joints), with a dwell at each [s].

    v_max, a_max, j_max (joints,): limits of the profiles [rad/s], [rad/s²], [rad/s³], one of them attained
    """

    postures: Array
    v_max: Array
    a_max: Array
    j_max: Array
    dwell_s: float = 0.0
    _profiles: tuple[_Profile, ...] = field(init=False, repr=False)
    _begins: Array = field(init=False, repr=False)

    def __post_init__(self) -> None:
        postures = np.array(self.postures, dtype=np.float64)
        if postures.ndim != 2 or len(postures) < 2 or not np.all(np.isfinite(postures)):
            raise ConfigurationError(
                f"postures of shape {postures.shape}; expected (2 or more, joints), finite"
            )
        postures.flags.writeable = False
        object.__setattr__(self, "postures", postures)
        profiles = []
        for start, stop in pairwise(postures):
            way = np.abs(stop - start)
            if not np.any(way > 0.0):
                raise ConfigurationError("two postures in a row are the same; leave one out")
            moving = way > 1e-12
            speed = float(np.min(np.asarray(self.v_max)[moving] / way[moving]))
            acceleration = float(np.min(np.asarray(self.a_max)[moving] / way[moving]))
            jerk = float(np.min(np.asarray(self.j_max)[moving] / way[moving]))
            cruise = min(speed, float(np.sqrt(acceleration)))
            profiles.append(_Profile(cruise, cruise / acceleration, acceleration / jerk))
        begins = np.cumsum([0.0] + [profile.duration + self.dwell_s for profile in profiles])
        object.__setattr__(self, "_profiles", tuple(profiles))
        object.__setattr__(self, "_begins", begins)

    def __repr__(self) -> str:
        return f"PointToPoint({self.joints} joints, {len(self.postures)} postures, {self.duration:.1f} s)"

    @property
    def duration(self) -> float:
        """Length of one run [s]."""
        return float(self._begins[-1])

    @property
    def joints(self) -> int:
        """Number of joints."""
        return int(self.postures.shape[1])

    def sample(self, t: npt.ArrayLike) -> Samples:
        """Positions, velocities, accelerations and jerks at the times t (n,) [s], clipped to the motion."""
        times = np.clip(np.atleast_1d(np.asarray(t, dtype=np.float64)), 0.0, self.duration)
        out = [np.zeros((times.size, self.joints)) for _ in range(4)]
        segment = np.clip(np.searchsorted(self._begins, times, side="right") - 1, 0, len(self._profiles) - 1)
        for index, profile in enumerate(self._profiles):
            inside = segment == index
            if not inside.any():
                continue
            s = _smoothed(profile, times[inside] - self._begins[index])
            way = self.postures[index + 1] - self.postures[index]
            for order in range(4):
                out[order][inside] = np.outer(s[order], way)
            out[0][inside] += self.postures[index]
        return Samples(*out)

    def extrema(self, derivative: int) -> Extrema:
        """Exact extreme values: every derivative is monotonic between the breaks of the profiles."""
        times = []
        for begin, profile in zip(self._begins[:-1], self._profiles, strict=True):
            end, ramp, blend = profile.trapezoid_s, profile.ramp, profile.blend
            breaks = np.array([0.0, ramp, end - ramp, end])
            breaks = np.unique(np.clip(np.concatenate([breaks, breaks + blend]), 0.0, profile.duration))
            middles = 0.5 * (breaks[1:] + breaks[:-1])
            times.append(begin + np.sort(np.concatenate([breaks, middles])))
        at = np.concatenate(times)
        values = self.sample(at)[derivative]
        low, high = np.argmin(values, axis=0), np.argmax(values, axis=0)
        each = np.arange(self.joints)
        return Extrema(values[low, each], values[high, each], at[low], at[high])


def _smoothed(profile: _Profile, t: Array) -> list[Array]:
    """s and its three derivatives: the trapezoid averaged over the last `blend` seconds."""
    velocity = profile.pieces()
    position = velocity.antiderivative()
    twice = position.antiderivative()
    acceleration = velocity.derivative()
    t = np.clip(t, 0.0, profile.duration)
    before = t - profile.blend
    origin = float(position(0.0))
    pairs = ((twice, t, before), (position, t, before), (velocity, t, before), (acceleration, t, before))
    found = [np.asarray((f(late) - f(early)) / profile.blend) for f, late, early in pairs]
    found[0] = found[0] - origin
    return found
