"""Times of samples behind stamps that jitter, such as those of a network: counted by the motion itself.

A controller samples with a fixed period. A log written elsewhere stamps a sample on arrival, so samples come early or
late, twice or not at all. A stamp off by 1 ms moves a joint at 1 rad/s by 1 mrad; in the acceleration that is a
disturbance of some 1 rad/s^2 at 5 Hz. The progress of all moving joints from one sample to the next, over their
speed, counts the periods in between: 0 for a repeated sample, 2 after a lost one. Counts near whole numbers show that
the source does sample evenly, and give the times without jitter. Otherwise the stamps stand.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_opening, uniform_filter1d

from ident.dynamics.parameters import Floats

# Share of intervals off a whole number of periods by more than `_UNEVEN` periods, from which stamps jitter.
_UNEVEN, _JITTERS = 0.05, 0.05
# Samples behind a local speed; counts wander within them little.
_AROUND = 15
# Counts are whole if most fast samples lie this close to a whole number; chance alone puts 30 % there.
_CLOSE, _MOST = 0.15, 0.9
# Counts this far from a whole number are ambiguous; least number of counts in a row that stand.
_AMBIGUOUS, _LEAST = 0.25, 30
# Largest standard deviation of a count that is rounded [periods].
_ROUNDED = 0.15
# Largest distance of counted times from the stamps [periods], beside five times the stamps' own jitter.
_LARGEST_LAG = 20.0


@dataclass(frozen=True, eq=False)
class SampleClock:
    """Times of the samples as counted.

    times : (N,) [s], from the first stamp on, increasing; a repeated sample lies just behind its original.
    repeated : (N,) samples without progress, older than their stamp. period_s : of the source.
    jitter_s : rms of the stamps about the counted times [s].
    """

    times: Floats
    repeated: NDArray[np.bool_]
    period_s: float
    jitter_s: float

    def at(self, stamps: Floats, own: Floats) -> Floats:
        """Times (M,) [s] of another channel with stamps (M,) by the same clock; own : (N,) stamps of this one."""
        late = own - self.times
        return stamps - np.interp(stamps, own, late)


def sample_clock(stamps: Floats, position: Floats) -> SampleClock | None:
    """The clock behind stamps (N,) [s] of positions (N, J) [rad]; None for even stamps and for uncountable samples."""
    step = np.diff(stamps)
    if len(step) < 4 * _AROUND or np.any(step <= 0.0):
        return None
    period = float(np.median(step))
    share = step / period
    if np.mean(np.abs(share - np.rint(share)) > _UNEVEN) < _JITTERS:
        return None
    progress = np.diff(position, axis=0)
    count = np.ones(len(step))
    for _ in range(3):
        # Progress a period over the samples around, by the counts of the pass before.
        around = uniform_filter1d(count, _AROUND, mode="nearest")
        speed = uniform_filter1d(progress, _AROUND, axis=0, mode="nearest") / np.maximum(around, 0.1)[:, None]
        power = np.einsum("ij,ij->i", speed, speed)
        exact = np.einsum("ij,ij->i", progress, speed) / np.maximum(power, 1e-300)
        count = np.maximum(np.rint(exact), 0.0)
    pace = np.sqrt(power)
    off = np.abs(exact - np.rint(exact))
    fast = pace > np.median(pace)
    if not fast.any() or np.mean(off[fast] < _CLOSE) < _MOST:
        return None
    noise = 1.4826 * float(np.median(off[fast] * pace[fast]))
    known = binary_opening((pace > noise / _ROUNDED) & (off < _AMBIGUOUS), np.ones(_LEAST))
    whole = _whole(count, known, stamps)
    if whole is None:
        return None
    fit = np.polyfit(whole, stamps, 1)
    late = stamps - np.polyval(fit, whole)
    spread = 1.4826 * float(np.median(np.abs(late - np.median(late))))
    if np.max(np.abs(late - np.median(late))) > max(_LARGEST_LAG * period, 5.0 * spread):
        return None
    repeated = np.append(False, np.diff(whole) == 0.0)
    # Repeated samples keep their order within a small part of a period.
    place = np.arange(len(whole), dtype=np.float64)
    since = place - np.maximum.accumulate(np.where(repeated, 0.0, place))
    times = stamps[0] + fit[0] * (whole + 1e-3 * since)
    return SampleClock(times, repeated, float(fit[0]), float(np.std(late)))


def _whole(count: Floats, known: NDArray[np.bool_], stamps: Floats) -> Floats | None:
    """Periods (N,) since the first sample from the counts (N-1,) of the known intervals, None without any.

    Known stretches give the period by regression and their place by the median of their stamps: stamps are as late in
    one stretch as in another. Between them the joints are too slow to count, and each stamp is rounded.
    """
    edges = np.flatnonzero(np.diff(np.concatenate([[False], known, [False]]).astype(np.int8)))
    stretches = [(slice(a, b + 1), np.append(0.0, np.cumsum(count[a:b]))) for a, b in edges.reshape(-1, 2)]
    if not stretches:
        return None
    centred = [(w - w.mean(), stamps[part] - stamps[part].mean()) for part, w in stretches]
    period = float(sum(w @ t for w, t in centred) / max(sum(w @ w for w, _ in centred), 1.0))
    if period <= 0.0:
        return None
    first, counted = max(stretches, key=lambda stretch: stretch[1][-1])
    late = float(np.median(stamps[first] - period * counted))
    whole = np.rint((stamps - late) / period)
    for part, w in stretches:
        whole[part] = w + np.rint((np.median(stamps[part] - period * w) - late) / period)
    whole = np.maximum.accumulate(whole)
    return np.asarray(whole - whole[0])
