"""From the even grid of a motion to rows: each side at its own sample times, averaged over short bins.

A row is a weighted mean of samples of its bin, the same for torques and columns, so it adds no bias. Where the torques
were low-passed before, rows and columns pass through one more low-pass, which leaves no effect of the earlier one.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from ident.diagnosis.rows.recording import RecordStretch, SessionRecord, usual_step
from ident.effects.motion import Floats
from ident.rows.binned import bins
from ident.rows.filters import low_pass

# Length of the windows used of a long session [s].
_WINDOW_S = 10.0


@dataclass(frozen=True, eq=False)
class Sampling:
    """Samples of a side's torque in a stretch.

    stamp : (N,) [s]. delay_s : of the channel. width : samples in a bin.
    """

    stamp: Floats
    delay_s: float
    width: int

    @property
    def at(self) -> Floats:
        """Times (N,) [s] of the motion that the samples tell of."""
        return self.stamp - self.delay_s

    @cached_property
    def step_s(self) -> float:
        """Distance of the bins [s]."""
        return self.width * usual_step(self.stamp) if len(self.stamp) > 1 else 0.0


@dataclass(eq=False)
class RowGrid:
    """The rows of recordings.

    bin_s : length of a bin. most_s : longest time in rows, all recordings together. delay_s : of the channel of each
    side.
    """

    recordings: Sequence[SessionRecord]
    bin_s: float
    most_s: float
    delay_s: Mapping[str, float]
    _operators: dict[tuple[str, int], csr_array] = field(default_factory=dict, init=False, repr=False)
    _samplings: dict[tuple[str, int], Sampling] = field(default_factory=dict, init=False, repr=False)
    _chosen: dict[tuple[str, int], NDArray[np.bool_]] = field(default_factory=dict, init=False, repr=False)

    @cached_property
    def stretches(self) -> list[tuple[SessionRecord, RecordStretch]]:
        """Recording and stretch of each motion."""
        return [(r, s) for r in self.recordings for s in r.stretches]

    @cached_property
    def sides(self) -> tuple[str, ...]:
        """Sides with rows."""
        return tuple(s for s in ("motor", "joint") if any(s in r.sides for r in self.recordings))

    @cached_property
    def band_hz(self) -> dict[str, float | None]:
        """By side, the common cut-off of torques and columns where the torques were low-passed before, else None.
        Half of the remaining band leaves no effect of the earlier filter."""
        found: dict[str, float | None] = {}
        for side in self.sides:
            edges = [r.joint_band_hz if side == "joint" else r.motor_band_hz for r in self.recordings]
            least = min((edge for edge in edges if edge is not None), default=np.inf)
            found[side] = 0.5 * least if least < 0.5 / self.bin_s else None
        return found

    def holds(self, side: str, number: int) -> bool:
        """Whether a motion has rows of a side."""
        recording, stretch = self.stretches[number]
        return side in recording.sides and (side == "joint" or len(stretch.motor_time) > 1)

    def sampling(self, side: str, number: int) -> Sampling:
        """Samples of a side in a motion."""
        key = (side, number)
        if key not in self._samplings:
            self._samplings[key] = self._sampled(side, self.stretches[number][1])
        return self._samplings[key]

    def _sampled(self, side: str, stretch: RecordStretch) -> Sampling:
        if side == "joint":
            dt = float(stretch.time[1] - stretch.time[0])
            return Sampling(stretch.time, self.delay_s[side], max(1, round(self.bin_s / dt)))
        width, stamp = 1, stretch.motor_time
        if len(stamp) > 1 and usual_step(stamp) < 0.6 * self.bin_s:
            width = max(1, round(self.bin_s / usual_step(stamp)))
        return Sampling(stamp, self.delay_s[side], width)

    def operator(self, side: str, number: int) -> csr_array:
        """Matrix (m, N) from the grid of a motion to its rows, at the channel's delay.

        Without a low-pass across rows it makes the rows in use alone.
        """
        key = (side, number)
        if key not in self._operators:
            sampling, time = self.sampling(side, number), self.stretches[number][1].time
            width = sampling.width
            count = len(sampling.stamp) // width
            place = (sampling.at[: count * width] - time[0]) / usual_step(time)
            nearest = np.rint(place)
            place = np.where(np.abs(place - nearest) < 1e-4, nearest, place)
            place = np.clip(place, 0.0, len(time) - 1.000001)
            low = place.astype(np.int64)
            share = place - low
            row = np.arange(len(low)) // width
            weights = np.concatenate([1.0 - share, share]) / width
            places = np.concatenate([row, row]), np.concatenate([low, low + 1])
            matrix = csr_array((weights, places), shape=(count, len(time)))
            if self.band_hz[side] is None:
                matrix = matrix[np.flatnonzero(self.chosen(side, number))]
            self._operators[key] = matrix
        return self._operators[key]

    def reduce(self, side: str, values: Sequence[Floats]) -> Floats:
        """Rows (m,) or (m, k) of signals on the grid of each motion, (N,) or (N, k)."""
        held = [number for number in range(len(self.stretches)) if self.holds(side, number)]
        parts = [
            self.used(
                side, number, self.operator(side, number) @ values[number].reshape(len(values[number]), -1)
            )
            for number in held
        ]
        whole = np.concatenate(parts)
        return whole[:, 0] if values[0].ndim == 1 else whole

    def no_rows(self, side: str, number: int, shape: tuple[int, ...]) -> Floats:
        """Zeros (m, ...) in the rows of a motion's operator."""
        return np.zeros((self.operator(side, number).shape[0], *shape))

    def used(self, side: str, number: int, values: Floats) -> Floats:
        """The rows in use of the rows (m, ...) of a motion's operator, low-passed as the torques were."""
        if self.band_hz[side] is None:
            return values
        wide = self.slow(side, number, values.reshape(len(values), -1))[self.chosen(side, number)]
        return wide.reshape(len(wide), *values.shape[1:])

    def slow(self, side: str, number: int, rows: Floats, *, smooth: bool = True) -> Floats:
        """All rows (m, ...) of a motion, low-passed if `smooth`, thinned and without spoiled ends where the torques
        were low-passed before."""
        cutoff = self.band_hz[side]
        if cutoff is None:
            return rows
        dt = self.sampling(side, number).step_s
        if cutoff >= 0.4 / dt:
            return rows
        rows = low_pass(rows, dt, cutoff) if smooth else rows
        step, edge = max(1, int(0.4 / (cutoff * dt))), int(0.5 / (cutoff * dt))
        return rows[edge : len(rows) - edge : step]

    def stamps(self, side: str, number: int) -> Floats:
        """Times (m,) [s] of all rows of a motion."""
        sampling = self.sampling(side, number)
        return self.slow(side, number, bins(sampling.stamp[:, None], sampling.width)[:, 0], smooth=False)

    def chosen(self, side: str, number: int) -> NDArray[np.bool_]:
        """Rows (m,) of a motion in use. Of a long session: the beginning, two periods at least, and windows spread
        evenly, so that drifts are seen and the rows stay within memory."""
        key = (side, number)
        if key not in self._chosen:
            self._chosen[key] = self._spread(self.stretches[number][0], self.stamps(side, number))
        return self._chosen[key]

    def _spread(self, recording: SessionRecord, stamps: Floats) -> NDArray[np.bool_]:
        share = self.most_s / len(self.recordings)
        if recording.duration_s <= share:
            return np.ones(len(stamps), dtype=bool)
        since = stamps - recording.start_s
        lead = 2.0 * recording.period_s if recording.repeats else 0.0
        lead = lead if lead < 0.8 * share else _WINDOW_S
        every = _WINDOW_S * (recording.duration_s - lead) / (share - lead)
        return np.asarray((since < lead) | (np.mod(since - lead, every) < _WINDOW_S))
