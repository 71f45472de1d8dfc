"""Point-to-point motion through random postures: the baseline that optimal excitation is compared with.

Between two postures all joints move in proportion along one profile s(t) from 0 to 1, so the path is a
straight line in joint space. The profile is a trapezoid in velocity, smoothed by a moving average that bounds
the jerk; every joint keeps its velocity, acceleration and jerk limit, and one of them is reached.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np
import numpy.typing as npt
from scipy.interpolate import PPoly

from fri.errors import ConfigurationError, RefusedError
from ident.excitation.check import Limits, PathChecker, Workspace
from ident.excitation.mechanism import Mechanism, tip_path
from ident.excitation.motion import Array, Extrema, Samples

__all__ = ["PointToPoint", "random_points"]

_LINE = 60
_TRIES = 400
_INSTANT = 1e-9


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
        if end - 2.0 * ramp <= _INSTANT * end:  # a triangle: full speed is reached for an instant only
            times, coefficients = np.delete(times, 3), np.delete(coefficients, 2, axis=1)
        return PPoly(coefficients, times)


@dataclass(frozen=True, eq=False)
class PointToPoint:
    """Rest-to-rest straight lines in joint space through postures (k, joints), with a dwell at each [s].

    v_max, a_max, j_max (joints,): limits that the profiles keep [rad/s], [rad/s²], [rad/s³]
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


def random_points(
    mechanism: Mechanism,
    limits: Limits,
    *,
    count: int = 20,
    seed: int = 1,
    speed_scale: float = 1.0,
    a_max: Array | None = None,
    workspace: Workspace | None = None,
    checker: PathChecker | None = None,
    clearance_m: float = 0.0,
    duration_s: float | None = None,
) -> PointToPoint:
    """Motion through `count` random postures and back to the first; every straight line keeps every limit in
    space.

    speed_scale : share of the velocity limits; a_max : acceleration limits instead of the arm's [rad/s²]
    duration_s : total time, reached by a pause in each posture; None: no pauses

    Raises RefusedError where no next posture can be found, ConfigurationError if the time is too short.
    """
    rng = np.random.default_rng(seed)
    space = workspace if workspace is not None else Workspace()

    def free(path: Array) -> bool:
        points = tip_path(mechanism, path)
        if space.radius_m is not None and np.hypot(points[:, 0], points[:, 1]).min() < space.radius_m:
            return False
        if space.height_m is not None and points[:, 2].min() < space.height_m:
            return False
        return checker is None or checker.check_path(path).distance >= clearance_m

    postures = [_draw(rng, limits, free)]
    while len(postures) < count:
        postures.append(_reachable(rng, limits, free, postures, last=len(postures) == count - 1))
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


def _draw(rng: np.random.Generator, limits: Limits, free: Callable[[Array], bool]) -> Array:
    for _ in range(_TRIES):
        posture = rng.uniform(limits.q_low, limits.q_high)
        if free(posture[None, :]):
            return posture
    raise RefusedError(f"no posture within the workspace and clear of collisions in {_TRIES} draws")


def _reachable(
    rng: np.random.Generator,
    limits: Limits,
    free: Callable[[Array], bool],
    postures: list[Array],
    *,
    last: bool,
) -> Array:
    share = np.linspace(0.0, 1.0, _LINE)[:, None]
    for _ in range(_TRIES):
        posture = rng.uniform(limits.q_low, limits.q_high)
        lines = [(1.0 - share) * postures[-1] + share * posture]
        if last:
            lines.append((1.0 - share) * posture + share * postures[0])
        if all(free(line) for line in lines):
            return posture
    raise RefusedError(
        f"no further posture can be reached in a straight line in {_TRIES} draws; try another seed"
    )
