"""Samples that were lost, repeated, held or clipped, seen in the channels themselves."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation

if TYPE_CHECKING:
    from lwr_driver.session import JointColumns, Session

__all__ = ["SampleLoss", "Stuck", "clipped_at", "held_times", "passed_band", "sample_loss", "stuck_at"]

# Number and share of samples amiss in a session from which on they are a finding.
_LEAST, _SHARE = 3, 0.0005
# Third difference of a position that is a jolt, over the usual one, which is at least so many steps of the encoder.
_JOLT, _STEPS = 16.0, 4.0
# Samples by which a jolt is away from a repeated sample that makes it.
_NEAR = 4
# Samples of the very same torque that a noisy channel does not have by chance, also over those of the values next to
# it; a coarse channel stays at its largest value about twice as long as at the next.
_FLAT, _OVER_NEXT = 10, 10
# Speed from which on a motor works.
_MOVING_RAD_S = 0.01


@dataclass(frozen=True)
class SampleLoss:
    """Samples of a channel of a session that are missing, repeat the one before, or are older than they say."""

    session: str
    channel: str
    lost: int
    repeated: int
    stale: int
    samples: int

    @property
    def amiss(self) -> int:
        """Lost, repeated and stale ones."""
        return self.lost + self.repeated + self.stale

    @property
    def share(self) -> float:
        """Of what was sent."""
        return self.amiss / max(self.samples + self.lost, 1)

    @property
    def matters(self) -> bool:
        """More than one or two, and more than one in two thousand."""
        return self.amiss >= _LEAST and self.share > _SHARE


@dataclass(frozen=True)
class Stuck:
    """A torque [Nm] that a channel reports for a joint (from 0) again and again: count of samples in motion."""

    joint: int
    value: float
    count: int
    samples: int


def sample_loss(sessions: list[Session]) -> tuple[SampleLoss, ...]:
    """The channels with the losses that matter, worst first."""
    found = []
    for session in sessions:
        found.append(_channel(session.path.name, "joint", session.joint))
        if session.motor is not None:
            found.append(_channel(session.path.name, "motor", session.motor))
    return tuple(sorted((loss for loss in found if loss.matters), key=lambda loss: -loss.share))


def held_times(columns: JointColumns) -> NDArray[np.float64]:
    """Times (k,) [s] from the first sample of samples that are older than they say.

    Where all joints repeat the torques of the sample before, and where all that move jolt at once, as positions do
    that are a part of a sample old. A few of them are no finding, but derivatives of the positions are wrong there.
    """
    old = _jolts(columns.position)
    if _repeated(columns.effort):
        old |= _same(columns.effort)
    return (columns.log_time[old] - columns.log_time[0]) * 1e-9


def clipped_at(columns: JointColumns) -> NDArray[np.float64]:
    """Torque (n,) [Nm] beyond which each joint's sensor says nothing, NaN where its samples show no such limit.

    What moves and is noisy does not have the very same largest torque many times. What stands still may, and so may
    all joints at once where samples are held.
    """
    effort, n = columns.effort, columns.effort.shape[1]
    found = np.full(n, np.nan)
    if len(effort) < 2:
        return found
    fresh = np.concatenate([[False], np.any(np.diff(columns.position, axis=0) != 0.0, axis=1)])
    fresh &= ~_same(effort)
    for joint in range(n):
        values = effort[fresh, joint]
        ends = [abs(v) for v, _ in _flat(values) if v in (values.min(), values.max())]
        if ends:
            found[joint] = max(ends)
    return found


def stuck_at(motor: JointColumns, joint: JointColumns) -> tuple[Stuck, ...]:
    """Values that motor torques of joints that move have again and again: what is small or large is not reported.

    A motor that works is as noisy at one torque as at another.
    """
    if len(motor) < 2 or len(joint) < 2:
        return ()
    found = []
    seconds = (motor.log_time - joint.log_time[0]) * 1e-9
    clock = (joint.log_time - joint.log_time[0]) * 1e-9
    held = _same(motor.effort)
    for k in range(motor.effort.shape[1]):
        angle = np.interp(seconds, clock, joint.position[:, k])
        speed = np.abs(np.diff(angle, prepend=angle[0])) / np.maximum(
            np.diff(seconds, prepend=seconds[0]), 1e-6
        )
        moving = (speed > _MOVING_RAD_S) & ~held
        values = motor.effort[moving, k]
        found += [Stuck(k, value, count, int(moving.sum())) for value, count in _flat(values)]
    return tuple(found)


def _flat(values: NDArray[np.float64]) -> list[tuple[float, int]]:
    """Values that a noisy channel has again and again, and how often: more often by far than the two next to each on
    either side.
    """
    values, counts = np.unique(values, return_counts=True)
    if len(values) < 3:
        return []
    found = []
    for k in np.flatnonzero(counts >= _FLAT):
        beside = np.concatenate([counts[max(0, k - 2) : k], counts[k + 1 : k + 3]])
        if counts[k] > _OVER_NEXT * beside.max():
            found.append((float(values[k]), int(counts[k])))
    return found


def _jolts(position: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Samples (N,) at which most of the joints that move differ from a smooth motion by far more than they usually
    do, in the third difference of their positions.
    """
    found = np.zeros(len(position), dtype=bool)
    moves = np.ptp(position, axis=0) > 0.0 if len(position) else np.zeros(0, dtype=bool)
    if len(position) < 4 or moves.sum() < 2:
        return found
    q = position[:, moves]
    third = np.abs(np.diff(q, 3, axis=0))
    steps = np.abs(np.diff(q, axis=0))
    step = np.min(np.where(steps > 0.0, steps, np.inf), axis=0)
    usual = np.maximum(np.median(third, axis=0), _STEPS * step)
    found[2:-1] = np.mean(third > _JOLT * usual, axis=1) > 0.5
    return found


def _channel(name: str, channel: str, columns: JointColumns) -> SampleLoss:
    repeated, jolts = _repeated(columns.effort), _jolts(columns.position)
    if repeated:
        # A repeated sample and the one after it jolt, too.
        jolts &= ~binary_dilation(_same(columns.effort), iterations=_NEAR)
    stale = int(np.count_nonzero(jolts[1:] & ~jolts[:-1])) if len(jolts) else 0
    return SampleLoss(name, channel, columns.lost, repeated, stale, len(columns))


def _same(effort: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Samples (N,) at which all joints have the torque of the one before; of one joint alone that means nothing."""
    if effort.shape[1] < 2:
        return np.zeros(len(effort), dtype=bool)
    return np.concatenate([[False], np.all(np.diff(effort, axis=0) == 0.0, axis=1)])


def _repeated(effort: NDArray[np.float64]) -> int:
    """Number of repeated samples beyond what chance gives.

    Smooth or coarse channels repeat by themselves; then equality of all joints at once means nothing.
    """
    if effort.shape[1] < 2 or len(effort) < 3:
        return 0
    same = _same(effort)[1:]
    each = np.mean(np.diff(effort, axis=0) == 0.0, axis=0)
    expected = float(np.prod(np.maximum(each - same.mean(), 0.0))) * len(same)
    return max(0, int(same.sum() - np.ceil(expected + 3.0 * np.sqrt(expected))))


Floats = NDArray[np.float64]

# Share of the power above a quarter of the sampling rate below which no sensor's noise is left: the step of
# a 17-bit converter makes more.
_SILENT = 1e-10
# Share of the power that lies above the band's edge.
_BEYOND = 1e-6
_LEAST = 64


def passed_band(values: Floats, dt: float) -> float | None:
    """Upper edge [Hz] of what a low-pass left of the signals (N, k), None where they were not filtered.

    A measured torque holds the noise of its sensor at every frequency. Where the upper half of the band is
    silent, somebody took it out, and with it whatever happened faster than the edge.
    """
    if len(values) < _LEAST:
        return None
    moving = np.ptp(values, axis=0) > 0.0
    if not moving.any():
        return None
    signal = values[:, moving] - values[:, moving].mean(axis=0)
    power = np.abs(np.fft.rfft(signal * np.hanning(len(signal))[:, None], axis=0)) ** 2
    above = np.cumsum(power[::-1], axis=0)[::-1] / power.sum(axis=0)
    frequency = np.fft.rfftfreq(len(signal), dt)
    if np.any(above[np.searchsorted(frequency, 0.25 / dt)] > _SILENT):
        return None
    return float(np.max(frequency[np.argmax(above < _BEYOND, axis=0)]))
