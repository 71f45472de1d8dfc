"""Fourier series with rest at both ends, equation (9): the standard exciting motion.

    q_i(t) = q_i0 + sum_k a_ik sin(k w0 t) + b_ik cos(k w0 t),   w0 = 2 pi / T0,   k = 1 .. n_f

Zero velocity at t = 0 asks for sum_k k a_ik = 0, zero acceleration for sum_k k² b_ik = 0. The free
coefficients live in the null space of these two conditions, so they hold for every choice, and by
periodicity at T0 as well. (Swevers, Ganseman, Tükel, De Schutter and Van Brussel 1997; Park 2006 for the
rest conditions.)
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt
from scipy.linalg import null_space

from fri.errors import ConfigurationError
from ident.excitation.motion import Array, Extrema, ParametricMotion, Samples

__all__ = ["FourierBasis", "FourierSeries"]

_REST_TOLERANCE = 1e-9


@dataclass(frozen=True, eq=False)
class FourierSeries:
    """Equation (9) with numbers: bias q0 (joints,), a and b (joints, n_f) [rad], base period T0 [s].

    Nothing here forces rest at the ends; `at_rest` tells, `FourierBasis` builds it in.
    """

    period_s: float
    bias: Array
    a: Array
    b: Array

    def __post_init__(self) -> None:
        bias, a, b = (np.array(part, dtype=np.float64) for part in (self.bias, self.a, self.b))
        if not (np.isfinite(self.period_s) and self.period_s > 0):
            raise ConfigurationError(f"base period {self.period_s} s is not a positive number")
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
    def highest_frequency_hz(self) -> float:
        """n_f / T0, the highest frequency in the positions [Hz]."""
        return self.harmonics / self.period_s

    @property
    def at_rest(self) -> bool:
        """True where velocity and acceleration vanish at t = 0 (and so at every multiple of T0)."""
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
        algebraic polynomial of degree 2n. The angles of all roots are tried (those off the circle do no
        harm), with 8 n equidistant points besides, so that a root that arithmetic moved off the circle costs
        second order only.
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

    def grid_bound(self, derivative: int, n: int) -> Array:
        """Upper bound of |derivative - bias| from n > 2 n_f samples alone (Ehlich and Zeller 1964),
        (joints,).

        max |p| <= max_grid |p| / cos(pi n_f / n) for a trigonometric polynomial p of order n_f.
        """
        values = self.derivative(np.arange(n) * (self.period_s / n), derivative)
        centred = values - self.bias if derivative == 0 else values
        return np.max(np.abs(centred), axis=0) * _ehlich_zeller(self.harmonics, n)

    def _harmonics(self, joint: int, order: int) -> tuple[Array, Array]:
        """Sine and cosine coefficients of a derivative of one joint, (n_f,) each."""
        k = 2.0 * np.pi / self.period_s * np.arange(1, self.harmonics + 1)
        sine, cosine = np.array(self.a[joint]), np.array(self.b[joint])
        for _ in range(order):
            sine, cosine = -k * cosine, k * sine
        return sine, cosine


@dataclass(frozen=True)
class FourierBasis:
    """Fourier series of order n_f and period T0 whose velocity and acceleration vanish at both ends.

    Each joint has 2 n_f - 1 free coefficients: bias, n_f - 1 sines, n_f - 1 cosines.
    """

    period_s: float
    harmonics: int = 5
    _null: tuple[Array, Array] = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        if not (np.isfinite(self.period_s) and self.period_s > 0):
            raise ConfigurationError(f"base period {self.period_s} s is not a positive number")
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

    @property
    def highest_frequency_hz(self) -> float:
        """n_f / T0 [Hz]."""
        return self.harmonics / self.period_s

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

    def coefficients(self, motion: ParametricMotion) -> Array:
        """Free coefficients of a series; ConfigurationError if it has another period, order, or no rest."""
        if not isinstance(motion, FourierSeries):
            raise ConfigurationError(f"a {type(motion).__name__} is not a Fourier series")
        if motion.harmonics != self.harmonics or not np.isclose(motion.period_s, self.period_s, rtol=1e-12):
            raise ConfigurationError(
                f"series with n_f = {motion.harmonics}, T0 = {motion.period_s} s does not fit a basis with "
                f"n_f = {self.harmonics}, T0 = {self.period_s} s"
            )
        if not motion.at_rest:
            raise ConfigurationError("the series does not start at rest, so this basis cannot represent it")
        return np.hstack([motion.bias[:, None], motion.a @ self._null[0], motion.b @ self._null[1]])

    def grid_factor(self, n: int, derivative: int) -> float:
        """True maximum over grid maximum of |q - bias| or a derivative, at most (Ehlich and Zeller 1964)."""
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
    """1 / cos(pi order / n), the factor from a grid maximum to a true maximum; n > 2 order."""
    if n <= 2 * order:
        raise ConfigurationError(
            f"{n} samples are too few for {order} harmonics; more than {2 * order} are needed"
        )
    return float(1.0 / np.cos(np.pi * order / n))
