"""The stops of a motion, computed beforehand.

A stop brakes each joint by itself as fast as its limits allow (`lwr_driver.guard`), so the arm leaves the planned
path. After a contact it may go straight back to a row before. Stops are looked at from coarse rows first, then from
the rows around the worst of them.

Between two postures a distance changes by sum_j(R_j |dq_j|) at most, with the reach R_j of the arm from joint j. So the
distances along the planned path bound those of the stops beside it, and only stops near something are computed.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lwr_driver.arm import ArmLimits
from lwr_driver.arm.collision import Clearance, CollisionChecker
from lwr_driver.commander import BEFORE_CONTACT_S
from lwr_driver.guard import stop_paths
from lwr_driver.motion import Motion

COARSE_S, FINE_S = 0.04, 0.01  # between the rows where stops begin
_SAMPLE_S = 0.01
_GRID_M = 0.02  # no point of the arm moves further between two postures of the planned path
_STEP_M = 1e-2  # the same for two postures of a stop
# Between two coarse rows a stop may come nearer than theirs by half its second derivative, some 20 m/s², times the
# square of half their distance.
_SLACK_M = 5e-3
_ALWAYS = 20  # stops computed though they keep the limit, for the value to report
_BACK = np.linspace(0.0, 1.0, 12)[1:, np.newaxis]
AT_ONCE = 500  # stops, for the sake of memory

Floats = NDArray[np.float64]
Places = NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class NearestStop:
    """The tightest moment of all stops of a motion.

    clearance : its row and time are those of the motion where the stop begins
    after_s : time after that [s]; nan on the way back after a contact
    """

    clearance: Clearance
    after_s: float


@dataclass(frozen=True, eq=False)
class _Found:
    """Of some stops (m,): rows, smallest distances found [m], their postures (m, 7) [rad], times after the row [s]."""

    rows: Places
    distance: Floats
    q: Floats
    after_s: Floats

    def __add__(self, other: _Found) -> _Found:
        parts = zip(vars(self).values(), vars(other).values(), strict=True)
        return _Found(*(np.concatenate(pair) for pair in parts))


def nearest_stop(checker: CollisionChecker, motion: Motion, limit: float) -> NearestStop:
    """The tightest moment of the stops of a motion, and of the ways back after contacts.

    limit : [m]; stops nearer than that are found wherever they are, and of the others the nearest ones only. Postures
        looked at are as far apart as a point of the arm moves by 1 cm, at most.

    Some 40 ms lie between the coarse rows, 10 ms between those around the nearest stops.
    """
    search = _Search(checker, motion)
    coarse = search.over(begins(motion, COARSE_S), limit + _SLACK_M, _SLACK_M)
    least = float(coarse.distance.min())
    found = coarse
    if least < limit + _SLACK_M:
        near = coarse.rows[coarse.distance <= least + _SLACK_M]
        found += search.over(around(motion, near, COARSE_S, FINE_S), min(least, limit), 0.0)
    best = int(np.argmin(found.distance))
    row = int(found.rows[best])
    clearance = checker.clearance(found.q[best])
    clearance = dataclasses.replace(clearance, row=row, time_s=row * motion.period_s)
    return NearestStop(clearance, float(found.after_s[best]))


def begins(motion: Motion, step_s: float) -> Places:
    """Rows some `step_s` [s] apart where a stop is more than rest; the first row in any case."""
    moving = np.any(np.diff(motion.q, axis=0) != 0.0, axis=1)
    rows = np.flatnonzero(moving | np.append(False, moving[:-1])) + 1
    return np.append(0, rows[:: _rows(motion, step_s)])


def around(motion: Motion, rows: Places, width_s: float, step_s: float) -> Places:
    """Rows `step_s` [s] apart nearer than `width_s` to some of `rows`, without these."""
    width, step = _rows(motion, width_s), _rows(motion, step_s)
    steps = np.arange(step, width, step)
    near = (rows[:, np.newaxis] + np.concatenate([-steps, steps])).ravel()
    return np.setdiff1d(np.clip(near, 0, len(motion) - 1), rows)


def sampled_stops(limits: ArmLimits, motion: Motion, rows: Places) -> tuple[Floats, float]:
    """Stops begun at `rows` (m,), (m, k, 7) [rad], and the time between two of their entries, 10 ms or a row [s]."""
    every = _rows(motion, _SAMPLE_S)
    return stop_paths(limits, motion.period_s, motion.q, rows, every), every * motion.period_s


def _rows(motion: Motion, time_s: float) -> int:
    return max(1, round(time_s / motion.period_s))


class _Search:
    """Distances along the planned path, and the search for the nearest stops beside it."""

    def __init__(self, checker: CollisionChecker, motion: Motion) -> None:
        self._checker, self._motion = checker, motion
        # The length of the way bounds the movement of every point of the arm.
        self._length = _lengths(motion.q[np.newaxis], checker.reach)[0]
        self._grid = np.linspace(0.0, self._length[-1], int(self._length[-1] / _GRID_M) + 2)
        moved = np.append(True, np.diff(self._length) > 0.0)
        self._moved, self._places = motion.q[moved], self._length[moved]
        self._distances = np.array([checker.distance(q) for q in self._planned(self._grid)])

    def _planned(self, length: Floats) -> Floats:
        """Postures of the planned path at lengths of it, (..., 7) [rad]."""
        joints = [np.interp(length, self._places, joint) for joint in self._moved.T]
        return np.stack(joints, axis=-1)

    def over(self, rows: Places, below: float, slack: float) -> _Found:
        """Stops begun at `rows`; those without a distance up to `below` [m] are left out, but for the nearest ones.

        slack : [m]; distances up to `slack` above the smallest one are found as well
        """
        none = np.zeros(0)
        found = _Found(rows[:0], none, np.zeros((0, self._motion.q.shape[1])), none)
        for first in range(0, len(rows), AT_ONCE):
            found += self._batch(rows[first : first + AT_ONCE], below, slack)
            below = min(below, float(found.distance.min()) + slack)
        return found

    def _batch(self, rows: Places, below: float, slack: float) -> _Found:
        motion = self._motion
        stops, sample_s = sampled_stops(self._checker.arm.limits, motion, rows)
        origins = np.maximum(rows - round(BEFORE_CONTACT_S / motion.period_s), 0)
        back = stops[:, -1:] + _BACK * (motion.q[origins][:, np.newaxis] - stops[:, -1:])
        paths = np.concatenate([stops, back], axis=1)
        lengths = _lengths(paths, self._checker.reach)
        free = self._free(rows, origins, paths, lengths, stops.shape[1])
        order = np.argsort(free.min(axis=1))
        taken, distances, places = [], [], []
        best = np.inf
        for count, path in enumerate(order):
            most = min(best + slack, np.inf if count < _ALWAYS else below)
            if count >= _ALWAYS and free[path].min() >= most:
                break
            distance, place = self._walk(paths[path], lengths[path], free[path], most, slack)
            best = min(best, distance)
            taken.append(path)
            distances.append(distance)
            places.append(place)
        q = np.array([_between(paths[path], place) for path, place in zip(taken, places, strict=True)])
        at = np.array(places)
        after = np.where(at <= stops.shape[1] - 1, sample_s * at, np.nan)
        return _Found(rows[taken], np.array(distances), q, after)

    def _free(self, rows: Places, origins: Places, paths: Floats, lengths: Floats, stopping: int) -> Floats:
        """Lower bounds of the distance between the entries of the paths, (m, k - 1) [m]."""
        # A posture of a stop is compared with that of the planned path after the same length of way.
        along = self._length[rows][:, np.newaxis] + lengths[:, :stopping]
        back = along[:, -1:] + _BACK[:, 0] * (self._length[origins][:, np.newaxis] - along[:, -1:])
        along = np.concatenate([along, back], axis=1)
        aside = np.abs(paths - self._planned(along)) @ self._checker.reach
        step = self._grid[1] - self._grid[0]
        free = np.interp(along, self._grid, self._distances) - 0.5 * step - aside
        return 0.5 * (free[:, 1:] + free[:, :-1] - np.diff(lengths, axis=1))

    def _walk(
        self, path: Floats, lengths: Floats, free: Floats, most: float, slack: float
    ) -> tuple[float, float]:
        """Smallest distance of a path if it is below `most` [m], and its place in rows. free : bounds (k - 1,) [m]"""
        least, place, at = self._checker.distance(path[0]), 0.0, 0.0
        for part in np.flatnonzero(free < most):
            begin, end = lengths[part : part + 2]
            at = max(at, begin)
            while at < end:
                here = part + (at - begin) / (end - begin)
                distance = self._checker.distance(_between(path, here))
                if distance < least:
                    least, place = distance, here
                at += max(distance - min(most, least + slack), _STEP_M)
        return least, place


def _lengths(paths: Floats, reach: Floats) -> Floats:
    """Lengths of the ways to the entries of the paths (m, k, 7): no point of the arm moves further, (m, k) [m]."""
    steps = np.abs(np.diff(paths, axis=1)) @ reach
    return np.concatenate([np.zeros((len(paths), 1)), np.cumsum(steps, axis=1)], axis=1)


def _between(path: Floats, place: float) -> Floats:
    """The posture at a place of a path (k, 7), in rows, (7,) [rad]."""
    whole = min(int(place), len(path) - 2)
    return np.asarray(path[whole] + (place - whole) * (path[whole + 1] - path[whole]))
