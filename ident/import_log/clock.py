"""The times of a recording: the column that holds them, their unit, and why another does not."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from fri.errors import DataError
from ident.import_log.fields import Field
from ident.import_log.mapping import TimeBase
from ident.import_log.rates import ALIKE, compare
from ident.import_log.tables import Floats
from ident.import_log.units import RATES, TURNS, close

# Beyond this share of steps back in time the order of the rows is in doubt.
_STEPS_BACK = 0.001
_SHORTEST_S, _LONGEST_S = 1e-4, 0.1
# Longest step of a rate below 10 Hz, where the velocities say so, or a joint would turn faster than this on average
# [rad/s] in the unit of a rate above.
_SLOWEST_S, _FASTEST = 1.0, 20.0
_UNIX_S = 1e9


@dataclass(frozen=True, eq=False)
class Clock:
    """base : of the mapping. times : of the samples (n,) [s] after the first. field : that they are read from.

    unit : of the column, "" without one. why : the reason.
    """

    base: TimeBase
    times: Floats
    field: Field | None
    unit: str
    why: str


class Clocks:
    """The columns of times among the fields of a recording.

    numbers : by the number of samples the rows of the file that they are. rate_hz : of the samples, if the user knows.
    """

    def __init__(
        self,
        source: Path,
        fields: Sequence[Field],
        numbers: Mapping[int, NDArray[np.int64]],
        rate_hz: float | None,
    ) -> None:
        self._source, self._numbers, self._rate_hz = source, numbers, rate_hz
        self._fields = [one for one in fields if one.quantity == "time"]

    def of(self, angle: Floats, velocity: Field | None, unit: str) -> Clock:
        """The times of the angles (n, k) [rad]: of the given rate, of a column, or from velocities.

        unit : of the positions, and so of the velocities. Raises DataError if nothing tells them.
        """
        count = len(angle)
        if self._rate_hz is not None:
            return self._even(self._rate_hz, count, "as given")
        if (column := self._column(count)) is not None:
            return self._read(column, angle, velocity)
        if velocity is not None:
            steps = compare(angle, velocity.values, np.arange(count, dtype=np.float64))
            period = (RATES["deg/s"] if unit == "deg" else 1.0) / max(steps.ratio, 1e-9)
            if steps.alike > ALIKE and _SHORTEST_S <= period <= _LONGEST_S:
                rate = float(f"{1.0 / period:.3g}")
                why = f"from the positions against {velocity.shown}{self._going_back(count)}"
                return self._even(rate, count, why)
        for one, rows in self._falls(count):
            raise DataError(f"{self._source}: {self._fall(one, rows)}")
        raise DataError(
            f"{self._source}: no rising column of times; give the rate of the samples with --rate-hz"
        )

    def seconds(self, position: Field, velocity: Field) -> Floats | None:
        """Times (n,) [s] of the samples after the first, None without a column or a rate."""
        count = len(position.values)
        if self._rate_hz is not None:
            return np.arange(count) / self._rate_hz
        column = self._column(count)
        unit = None if column is None else _unit(column, position.values, velocity)
        return None if column is None or unit is None else _seconds(column, TimeBase(1, unit=unit))

    def _column(self, count: int) -> Field | None:
        """The column of times of `count` samples; of a date split in two, the finer part."""
        rising = [
            one
            for one in self._fields
            if len(one.values) == count
            if (np.diff(one.values[:, 0]) >= 0).all() and np.ptp(one.values) > 0
        ]
        return min(rising, key=lambda one: int(np.sum(np.diff(one.values[:, 0]) == 0)), default=None)

    @staticmethod
    def _even(rate_hz: float, count: int, why: str) -> Clock:
        times = np.arange(count) / rate_hz
        return Clock(TimeBase(rate_hz=rate_hz), times, None, "", f"{rate_hz:g} Hz, {why}")

    def _read(self, column: Field, angle: Floats, velocity: Field | None) -> Clock:
        """The times of a rising column. DataError if no unit makes a rate of them."""
        times = column.values[:, 0]
        step = _step(times)
        unit = _unit(column, angle, velocity)
        if unit is None:
            raise DataError(
                f"{self._source}: the times {column.shown} are {step:.4g} apart, in no unit a rate from 10 Hz to "
                "10 kHz; give the rate with --rate-hz"
            )
        size = TimeBase(1, unit=unit)
        again = np.flatnonzero(np.diff(times) == 0) + 1
        found = TimeBase(
            column=column.array or (column.columns[0] if column.columns else 1),
            file=column.file if isinstance(column.file, str) else None,
            unit=unit,
            zero="unix" if times[0] * size.seconds > _UNIX_S else "start",
            equal="spread" if len(again) else "refuse",
        )
        why = f"steps of {step:.4g} on average"
        if len(again):
            first = self._numbers[len(times)][again[0]]
            why += f", equal times spread: {in_rows(len(again))}, first row {first} (counted from 0)"
        return Clock(found, _seconds(column, size), column, unit, why)

    def _falls(self, count: int) -> list[tuple[Field, NDArray[np.int64]]]:
        """Decreasing columns of times of `count` samples with the rows of their steps back; the fewest first."""
        falls = [
            (one, np.flatnonzero(np.diff(one.values[:, 0]) < 0.0) + 1)
            for one in self._fields
            if len(one.values) == count
        ]
        return sorted((pair for pair in falls if len(pair[1])), key=lambda pair: len(pair[1]))

    def _going_back(self, count: int) -> str:
        """Why a column of times is not used, for the table. DataError where the order of the samples is in doubt."""
        for one, rows in self._falls(count):
            if len(rows) > max(1.0, _STEPS_BACK * count):
                raise DataError(f"{self._source}: {self._fall(one, rows)}")
            row = self._numbers[count][rows[0]]
            return f"; {one.shown} goes back in row {row} (counted from 0) and is not used"
        return ""

    def _fall(self, column: Field, rows: NDArray[np.int64]) -> str:
        """The steps back of a column of times, in `rows`, with the remedy."""
        times, row = column.values[:, 0], int(rows[0])
        numbers = self._numbers[len(times)]
        said = (
            f"the times of {column.shown} go back in {len(rows)} of {in_rows(len(times))}, first in row "
            f"{numbers[row]} (counted from 0), {times[row]:.12g} after {times[row - 1]:.12g}"
        )
        before = np.flatnonzero(times[:row] == times[row])
        if len(before):
            advice = f"the time of row {numbers[before[0]]} again: remove the rows that repeat others"
        else:
            advice = "sort the rows by their times, or correct a wrong time"
        return f"{said}; {advice}, or give the rate of the samples with --rate-hz if the rows are in order"


def in_rows(count: int) -> str:
    """Number of rows in words."""
    return "1 row" if count == 1 else f"{count} rows"


def _seconds(column: Field, size: TimeBase) -> Floats:
    """The times (n,) [s] of a column after the first."""
    times = column.values[:, 0]
    seconds: Floats = (times - times[0]) * size.seconds
    # Coarse stamps show the way on average only.
    return np.linspace(0.0, seconds[-1], len(times)) if (np.diff(times) == 0).any() else seconds


def _step(times: Floats) -> float:
    """Mean step of the times (n,), in their unit."""
    return float(times[-1] - times[0]) / (len(times) - 1)


def _unit(column: Field, positions: Floats, velocity: Field | None) -> Literal["s", "ms", "us", "ns"] | None:
    """The unit in which a column's times are of a rate from 10 Hz to 10 kHz, or of one from 1 Hz by the motion.

    positions : (n, k), in any unit.
    """
    units: tuple[Literal["s", "ms", "us", "ns"], ...] = ("s", "ms", "us", "ns")
    step = _step(column.values[:, 0])
    sizes = {u: step * TimeBase(1, unit=u).seconds * (1.0 + 1e-9) for u in units}
    usual = next((u for u, size in sizes.items() if _SHORTEST_S <= size < _LONGEST_S), None)
    slow = next((u for u, size in sizes.items() if _LONGEST_S <= size < _SLOWEST_S), None)
    if usual is None or slow is None:
        return usual
    times, rate = _seconds(column, TimeBase(1, unit=usual)), RATES["deg/s"]
    if velocity is not None and len(velocity.values) == len(positions) and np.isfinite(velocity.values).all():
        ratios = np.abs(compare(positions, velocity.values, times).by_channel)
        ratio = float(np.nanmedian(ratios)) if np.isfinite(ratios).any() else 0.0
        for unit in (usual, slow):
            factor = sizes[unit] / sizes[usual]
            if ratio > 0.0 and any(
                close(ratio * factor, one) for one in (1.0, rate, 1.0 / rate, RATES["rpm"])
            ):
                return unit
    speed = np.sqrt(np.mean(np.diff(positions, axis=0) ** 2, axis=0)).max() / sizes[usual]
    degrees = np.abs(positions).max() >= TURNS
    return slow if speed > _FASTEST * (rate if degrees else 1.0) else usual
