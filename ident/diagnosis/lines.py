"""Lines: a torque that swings at a frequency of its own, whatever the arm does.

A machine beside the arm that shakes it, or a hum in a channel, depends on nothing that moves. It differs from period
to period of the motion, so it counts as noise; in the spectrum of what does not repeat it stands out as a line.
"""

from __future__ import annotations

import numpy as np

from ident.diagnosis.evidence import Evidence, Floats, Key, Rows

__all__ = ["find_line"]

# Of slower swings a session shows too few to tell them from a drift [Hz].
_LOWEST_HZ = 0.3
# Width of the spectrum beside a line that it is held against [Hz].
_BESIDE_HZ = 2.0
# Power of a line over the spectrum beside it; of a thousand frequencies chance makes ten of one.
_STANDS_OUT = 16.0
# The same in every session: what shakes the arm does not stop for one, what a wrong load leaves is in its own only.
_IN_EACH = 4.0
# Zero padding of the spectrum, so that a line falls between no two of its frequencies.
_PADDING = 4


def find_line(evidence: Evidence, side: str, joint: int, residual: Floats) -> tuple[float, Rows, int] | None:
    """Frequency [Hz] of the strongest line in the rows of a joint (from 0) and side, its columns, and the number of
    frequencies that it was chosen from; None where none stands out.

    residual : (m,) of these rows [Nm], NaN where a row is not used.
    Columns: a cosine and a sine for each session that is fitted, for nothing ties the phases of two together.
    """
    rows = evidence.nominal.rows[side]
    parts = [
        _not_repeating(evidence, side, residual, int(session))
        for session in np.unique(rows.session[~rows.test])
    ]
    even = [part for part in parts if part is not None]
    if not even:
        return None
    step = max(dt for _, dt in even)
    size = _PADDING * max(len(values) for values, _ in even)
    frequency: Floats = np.fft.rfftfreq(size, step).astype(np.float64)
    frequency = frequency[(frequency >= _LOWEST_HZ) & (frequency <= 0.4 / step)]
    if len(frequency) < 8 * _PADDING:
        return None
    each = np.array([_spectrum(values, dt, size, frequency) for values, dt in even])
    power = each.sum(axis=0)
    width = int(_BESIDE_HZ / (frequency[1] - frequency[0]))
    around = [slice(max(0, k - width), k + width + 1) for k in range(len(power))]
    beside = np.array([np.median(power[near]) for near in around])
    best = int(np.argmax(power / np.maximum(beside, 1e-300)))
    if power[best] < _STANDS_OUT * beside[best]:
        return None
    if np.any(each[:, best] < _IN_EACH * np.median(each[:, around[best]], axis=1)):
        return None
    top = float(frequency[best])
    if 0 < best < len(power) - 1:
        # The top of the parabola through the three largest.
        left, here, right = power[best - 1 : best + 2]
        top += 0.5 * float((left - right) / (left - 2.0 * here + right)) * float(frequency[1] - frequency[0])
    turn = 2.0 * np.pi * top * rows.time
    waves = [
        np.where((rows.session == session) & ~rows.test, wave(turn), 0.0)
        for session in np.unique(rows.session[~rows.test])
        for wave in (np.cos, np.sin)
    ]
    key: Key = (side, joint)
    return top, {key: np.column_stack(waves)}, len(frequency) // _PADDING


def _spectrum(values: Floats, dt: float, size: int, frequency: Floats) -> Floats:
    """Power of a session at the frequencies, over all its power."""
    power = np.abs(np.fft.rfft(values, size)) ** 2 / max(float(np.sum(values**2)), 1e-300)
    return np.interp(frequency, np.fft.rfftfreq(size, dt), power)


def _not_repeating(
    evidence: Evidence, side: str, residual: Floats, session: int
) -> tuple[Floats, float] | None:
    """What of a session's residual is another in every period, on an even grid with zeros in gaps, and the grid's
    step [s]; without repetition all of it. None where there is too little.
    """
    rows = evidence.nominal.rows[side]
    recording = next(r for r in evidence.nominal.recordings if r.number == session)
    mine = (rows.session == session) & np.isfinite(residual)
    if mine.sum() < 200:
        return None
    time, values = rows.time[mine] - recording.start_s, residual[mine]
    step = float(np.median(np.diff(rows.time[rows.session == session])))
    place = np.round((time - time[0]) / step).astype(np.int64)
    even, known = np.zeros(place[-1] + 1), np.zeros(place[-1] + 1, dtype=bool)
    even[place], known[place] = values, True
    even[known] -= even[known].mean()
    period = round(recording.period_s / step)
    if recording.repeats and 0 < period < len(even) / 1.5:
        phase = np.arange(len(even)) % period
        count = np.bincount(phase[known], minlength=period)
        mean = np.bincount(phase[known], even[known], minlength=period) / np.maximum(count, 1)
        known &= count[phase] > 1
        even = np.where(known, even - mean[phase], 0.0)
    return even, step
