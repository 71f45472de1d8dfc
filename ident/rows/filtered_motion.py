"""Filtered motion of the stretches of a session, whole or block after block, and the torque channels on it."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ident.dynamics.parameters import Floats
from ident.dynamics.structure import DriveMotion
from ident.rows.content import Recall
from ident.rows.delay import DELAY_DB, DELAY_HZ
from ident.rows.filters import (
    Excitation,
    SignalSettings,
    ahead,
    differentiate,
    enough,
    half_width,
    interpolate_uniform,
    low_pass,
    median_step,
    settling,
    thinning,
)
from ident.rows.prepared import BoolArray, TorqueChannel
from ident.rows.reversals import away_of_drives, turning_reach
from ident.rows.timebase import Stretch
from lwr_driver.session.spool import LEAST_BYTES, release, shelved

# Longest block [s].
_BLOCK_S = 120.0
# Latest filtered motions of stretches: two sessions at two cut-offs.
_MOST_MOTIONS = 4


@dataclass(frozen=True)
class WideMotion:
    """Filtered motion of the samples of a stretch from number `low` on, and their joint torque.

    q, qd, qdd, torque, flagged : (n, J). drive : as in `TorqueChannel`.
    """

    low: int
    q: Floats
    qd: Floats
    qdd: Floats
    torque: Floats
    flagged: BoolArray
    drive: DriveMotion | None
    _away: dict[tuple[Any, ...], BoolArray] = field(default_factory=dict, repr=False)

    def away(self, dt: float, settings: SignalSettings, coupled: tuple[tuple[int, int], ...]) -> BoolArray:
        """Samples (n, J) of `away_of_drives` by the settings, found once."""
        beside = settings.reversal, settings.standstill_rad_s, settings.turning
        key = (dt, *beside, settings.slow, coupled)
        if key not in self._away:
            self._away[key] = away_of_drives(self.qd, dt, *beside, slow_rad_s=settings.slow, coupled=coupled)
        return self._away[key]

    @classmethod
    def of(
        cls,
        part: Stretch,
        low: int,
        high: int,
        effort_flags: BoolArray,
        times: Floats,
        settings: SignalSettings,
        stiffness: Floats | None,
    ) -> WideMotion:
        """The samples from `low` to before `high`."""
        joints = effort_flags.shape[1]
        values = part.part(low, high)
        release(*part.columns)
        q = low_pass(values[:, :joints], part.dt, settings.cutoff, settings.order)
        qd, qdd = differentiate(q, part.dt)
        torque = values[:, joints:].copy()
        flagged = np.repeat(part.bridged[low:high, None], joints, axis=1)
        grid = part.start + part.dt * np.arange(low, high, dtype=np.float64)
        for joint in np.flatnonzero(effort_flags.any(axis=0)):
            hit = np.rint((times[effort_flags[:, joint]] - part.start) / part.dt).astype(np.int64) - low
            spread = np.unique(np.concatenate([hit - 1, hit, hit + 1])) if part.resampled else np.unique(hit)
            flagged[spread[(spread >= 0) & (spread < len(grid))], joint] = True
            good = ~flagged[:, joint]
            torque[~good, joint] = np.interp(grid[~good], grid[good], torque[good, joint])
        drive = None
        if stiffness is not None:
            present = ahead(torque, part.dt, settings.joint_delay)
            twist = low_pass(present / stiffness, part.dt, settings.cutoff, settings.order)
            rate, change = differentiate(twist, part.dt)
            if settings.encoder == "motor":
                drive, q, qd, qdd = DriveMotion(qd, qdd), q - twist, qd - rate, qdd - change
            else:
                drive = DriveMotion(qd + rate, qdd + change)
        return cls(low, q, qd, qdd, torque, flagged, drive)


def short(samples: int, joints: int) -> bool:
    """Whether arrays of all samples of all joints stay in memory: what is recalled of a longer session fills it."""
    return 8 * joints * samples < LEAST_BYTES


def recalled(
    effort_flags: BoolArray,
    times: Floats,
    settings: SignalSettings,
    stiffness: Floats | None,
    recall: Recall,
    same: tuple[Any, ...],
    part: Stretch,
    low: int,
    high: int,
) -> WideMotion:
    """`WideMotion.of`, recalled for a short stretch. same : what the motion of a session depends on."""
    make = partial(WideMotion.of, part, low, high, effort_flags, times, settings, stiffness)
    if high - low < part.count or not short(part.count, effort_flags.shape[1]):
        return make()
    springs = (
        () if stiffness is None else (*stiffness.tolist(), settings.encoder == "motor", settings.joint_delay)
    )
    return recall.of(make, *same, *springs, part.start, most=_MOST_MOTIONS)


@dataclass(frozen=True)
class Motion:
    """Filtered motion of a block of one stretch and its joint torque.

    start, end : times of the whole stretch's first and last sample [s]. low : number of the first sample here. core :
    times of the block [s].
    """

    start: float
    end: float
    dt: float
    low: int
    core: tuple[float, float]
    q: Floats
    qd: Floats
    qdd: Floats
    torque: Floats
    flagged: BoolArray
    away: BoolArray
    drive: DriveMotion | None

    @classmethod
    def of(
        cls,
        part: Stretch,
        span: tuple[int, int],
        core: tuple[float, float],
        wide: WideMotion,
        settings: SignalSettings,
        coupled: tuple[tuple[int, int], ...],
    ) -> Motion:
        """The samples from span[0] to before span[1] of `wide`. coupled : pairs of joints with a drive in common."""
        away = wide.away(part.dt, settings, coupled)
        kept = slice(span[0] - wide.low, span[1] - wide.low)
        states = wide.q[kept], wide.qd[kept], wide.qdd[kept], wide.torque[kept]
        drive = None if wide.drive is None else wide.drive.at(kept)
        return cls(
            part.start, part.end, part.dt, span[0], core, *states, wide.flagged[kept], away[kept], drive
        )

    @property
    def arrays(self) -> tuple[Floats | BoolArray, ...]:
        """All arrays by sample."""
        drive = () if self.drive is None else (self.drive.speed, self.drive.acceleration)
        return (self.q, self.qd, self.qdd, self.torque, self.flagged, self.away, *drive)

    def on(self, arrays: Sequence[NDArray[Any]]) -> Motion:
        """The same with other arrays."""
        names = ("q", "qd", "qdd", "torque", "flagged", "away")
        drive = None if self.drive is None else DriveMotion(arrays[6], arrays[7])
        found: dict[str, Any] = dict(zip(names, arrays, strict=False))
        return replace(self, **found, drive=drive)

    @property
    def first(self) -> float:
        """Time of the first sample here [s]."""
        return self.start + self.dt * self.low

    @property
    def times(self) -> Floats:
        """Sample times (n,) [s]."""
        return self.start + self.dt * np.arange(self.low, self.low + len(self.q), dtype=np.float64)

    @property
    def of_motors(self) -> tuple[Floats, Floats]:
        """Speed and acceleration (n, J) of the motors."""
        return (self.qd, self.qdd) if self.drive is None else (self.drive.speed, self.drive.acceleration)

    def usable(self, settings: SignalSettings) -> tuple[float, float]:
        """First and last time of the stretch unaffected by the filter's start and end [s]."""
        return self.start + settings.edge, self.end - settings.edge

    def channel(self, settings: SignalSettings) -> TorqueChannel:
        """The joint torque with the motion at its own times minus its delay, without the filter's ends."""
        cut, count = int(np.ceil(settings.edge / self.dt)), round((self.end - self.start) / self.dt) + 1
        late, end = settings.joint_delay / self.dt, self.low + len(self.q)
        first, here = max(cut + int(np.ceil(late)), 0), self.low + int(np.ceil(max(late, 0.0)))
        if first < here:
            # Samples averaged before a low-pass are the same in all blocks.
            together = thinning(self.dt, settings.decimate)
            first += -(-(here - first) // together) * together
        last = min(count - cut + int(np.floor(late)), count, end + int(np.floor(min(late, 0.0))))
        part = slice(first - self.low, max(last, first) - self.low)
        times, flagged = self.times[part] - settings.joint_delay, self.flagged[part]
        q, qd, qdd, away = self._at(times)
        return TorqueChannel(
            "joint",
            times,
            q,
            qd,
            qdd,
            self.torque[part],
            flagged,
            away & ~flagged,
            period_s=self.dt,
            taken_back=self._taken_back(settings),
        )

    def _taken_back(self, settings: SignalSettings) -> bool:
        """Whether q, qd and qdd are those of the links behind published motors."""
        return settings.takes_links_back and self.drive is not None

    def _at(self, times: Floats) -> tuple[Floats, Floats, Floats, BoolArray]:
        """q, qd, qdd and whether away from reversals at other times."""
        q, qd, qdd = (
            interpolate_uniform(state, self.first, self.dt, times) for state in (self.q, self.qd, self.qdd)
        )
        nearest = np.rint((times - self.first) / self.dt).astype(np.int64)
        return q, qd, qdd, self.away[np.clip(nearest, 0, len(self.q) - 1)]

    def present_torque(self, settings: SignalSettings) -> Floats:
        """Joint torque (n, J) of the motion's own times."""
        return ahead(self.torque, self.dt, settings.joint_delay)

    def motor_channel(
        self, times: Floats, torque: Floats, flags: BoolArray, delay: float, settings: SignalSettings
    ) -> TorqueChannel | None:
        """The motor torque with the motion at its own times minus the delay.

        Lost positions are bridged, at this bandwidth as good as measured ones.
        """
        first, last = self.usable(settings)
        actual = times - delay
        low, high = int(np.searchsorted(actual, first)), int(np.searchsorted(actual, last, side="right"))
        if high - low < 16:
            return None
        period = median_step(actual[low:high])
        # Samples averaged before a low-pass are the same in all blocks.
        together = thinning(period, settings.decimate)
        if not enough(high - low, period, settings.decimate):
            return None
        if self.core[0] > -np.inf:
            since = int(np.searchsorted(actual, self.first)) - low
            low += max(-(-since // together), 0) * together
        if self.core[1] < np.inf:
            until = int(np.searchsorted(actual, self.first + self.dt * (len(self.q) - 1), side="right"))
            high = min(high, until)
        inside = slice(low, high)
        actual, flagged = actual[inside], flags[inside]
        q, qd, qdd, away = self._at(actual)
        drive = None
        if self.drive is not None:
            moved = (self.drive.speed, self.drive.acceleration)
            drive = DriveMotion(*(interpolate_uniform(state, self.first, self.dt, actual) for state in moved))
        known, taken_back = away & ~flagged, self._taken_back(settings)
        return TorqueChannel(
            "motor", actual, q, qd, qdd, torque[inside], flagged, known, drive, period, taken_back
        )


def filtered_motions(
    parts: list[Stretch],
    wide: Callable[[Stretch, int, int], WideMotion],
    settings: SignalSettings,
    coupled: tuple[tuple[int, int], ...],
    blocks: bool,
) -> Iterator[Motion]:
    """The motions of all stretches, block after block.

    wide : the samples of a stretch between two numbers. coupled : pairs of joints with a drive in common.
    """
    seen = turning_reach(settings.reversal, settings.standstill_rad_s, settings.turning)
    for part in parts:
        needed = settling(settings.cutoff, settings.order) + seen + abs(settings.joint_delay)
        around = int(np.ceil(needed / part.dt)) + 16
        for span, core in _cut(part, settings, blocks):
            low, high = max(span[0] - around, 0), min(span[1] + around, part.count)
            yield Motion.of(part, span, core, wide(part, low, high), settings, coupled)


def excitation_hz(motions: Sequence[Motion], part: Stretch, dt: float, cutoff_hz: float) -> float:
    """Upper frequency of the motion of a stretch [Hz], its velocities low-passed at `cutoff_hz`."""
    spectrum = Excitation(part.count, dt)
    for motion in motions:
        if motion.start == part.start:
            mine = (motion.times >= motion.core[0]) & (motion.times < motion.core[1])
            spectrum.add(motion.qd[mine])
            release(*motion.arrays)
    return spectrum.frequency(cutoff_hz=cutoff_hz)


def _cut(
    part: Stretch, settings: SignalSettings, blocks: bool
) -> Iterator[tuple[tuple[int, int], tuple[float, float]]]:
    """Samples of each block of a stretch, with those in reach of its filters, and its core [s]."""
    together = thinning(part.dt, settings.decimate)
    size = max(1, round(_BLOCK_S / part.dt / together)) * together
    cut = int(np.ceil(settings.edge / part.dt))
    count = (part.count - 2 * cut) // size
    if not blocks or count < 2:
        yield (0, part.count), (-np.inf, np.inf)
        return
    delay_hz = min(DELAY_HZ, settings.cutoff)
    reach_s = max(
        half_width(settings.decimate, settings.attenuation_db) + settling(2.5 * settings.decimate),
        half_width(delay_hz, DELAY_DB) + settings.delay_search_s + settling(3.0 * delay_hz),
    )
    reach = -(-round((reach_s + abs(settings.joint_delay) + 0.5) / part.dt) // together) * together
    for k in range(count):
        first, last = cut + k * size, cut + (k + 1) * size
        low = first - reach if k and first - reach > cut else 0
        high = last + reach if k < count - 1 and last + reach < part.count - cut else part.count
        # A core ends between two samples.
        ends = (part.start + part.dt * (sample - 0.5) for sample in (first, last))
        begin, end = (
            edge if inner else limit
            for edge, inner, limit in zip(ends, (k > 0, k < count - 1), (-np.inf, np.inf), strict=True)
        )
        yield (low, high), (begin, end)


def motions_shelved(motions: Iterable[Motion]) -> list[Motion]:
    """The same motions with their arrays in files where they are long."""
    bare: list[Motion] = []

    def arrays() -> Iterator[tuple[NDArray[Any], ...]]:
        for motion in motions:
            bare.append(motion.on([array[:0].copy() for array in motion.arrays]))
            yield motion.arrays

    found = shelved(arrays())
    return [motion.on(arrays) for motion, arrays in zip(bare, found, strict=True)]
