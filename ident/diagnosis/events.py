"""Bursts: short times in which the residual of many joints is far beyond its usual size."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ident.diagnosis.evidence import Evidence

__all__ = ["Burst", "find_bursts"]

_WINDOW_S = 0.1
_FAR = 8.0
_LONGEST_S = 4.0
_MOST = 4
# Filters and wide bins are at a loss so near to the ends of a session.
_EDGE_S = 0.6


@dataclass(frozen=True)
class Burst:
    """session : number. start_s, duration_s : from the start of the session. excess : chi-square
    above usual.
    """

    session: int
    start_s: float
    duration_s: float
    excess: float


def find_bursts(evidence: Evidence) -> tuple[Burst, ...]:
    """The strongest bursts, at most four, strongest first; none where the residual is even."""
    found = []
    side = "joint" if "joint" in evidence.nominal.rows else "motor"
    rows = evidence.nominal.rows[side]
    normal = (evidence.residuals()[side] / evidence.sigma[side]) ** 2
    for session in np.unique(rows.session):
        mine = (rows.session == session) & ~rows.test
        if not mine.any():
            continue
        ends = rows.time[mine].min() + _EDGE_S, rows.time[mine].max() - _EDGE_S
        mine &= (rows.time >= ends[0]) & (rows.time <= ends[1])
        if mine.sum() < 3:
            continue
        time, values = rows.time[mine], normal[mine]
        window = ((time - time[0]) / _WINDOW_S).astype(int)
        counts = np.bincount(window, np.isfinite(values).sum(axis=1))
        sums = np.bincount(window, np.nansum(values, axis=1))
        usual = float(np.median(sums[counts > 0] / counts[counts > 0])) if np.any(counts > 0) else 1.0
        scatter = usual * np.sqrt(2.0 * np.maximum(counts, 1.0))
        far = (counts > 0) & ((sums - usual * counts) > _FAR * scatter)
        edges = np.flatnonzero(np.diff(np.concatenate([[0], _closed(far).astype(int), [0]])))
        for low, high in zip(edges[::2], edges[1::2], strict=True):
            duration = (high - low) * _WINDOW_S
            if duration <= _LONGEST_S:
                excess = float((sums - usual * counts)[low:high].sum())
                found.append(Burst(int(session), float(time[0] + low * _WINDOW_S), duration, excess))
    return tuple(sorted(found, key=lambda b: -b.excess)[:_MOST])


def _closed(far: np.ndarray) -> np.ndarray:
    """The same with holes of up to two windows filled."""
    out = far.copy()
    for k in range(1, len(far) - 1):
        if not far[k] and far[max(0, k - 2) : k].any() and far[k + 1 : k + 3].any():
            out[k] = True
    return out
