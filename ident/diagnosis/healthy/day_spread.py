"""How much a healthy arm differs from day to day, from a few days and what is usual."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from scipy import special

from ident.diagnosis.gain.products import Floats
from ident.diagnosis.gain.size import USUAL_CHANGES
from ident.diagnosis.healthy.reference import (
    DELAY_STD_S,
    ELSE,
    USUAL,
    USUAL_DAYS,
    joint_of,
    symbol_of,
)
from ident.diagnosis.rows.nominal_arm import GAIN_STD

# Share of healthy sets with a row above the largest error of the healthy ones.
_ABOVE = 0.05
# Offsets have no size of their own: share of the rms torque in their rows.
_OFFSETS = ("offl", "offm")
# Weight of the scatter of a symbol beside that of a parameter, and of the expected scatter beside the symbol's, in
# changes.
_ALIKE = 4.0


def compliance_std(sets: Sequence[Floats], own: Sequence[Floats] = ()) -> Floats | None:
    """Standard error (n,) [rad/Nm] of the mean of the compliances (n,) of healthy sets, from their scatter and the
    standard deviation by each one's rows; None for a single set without the latter.

    A few sets may agree by chance, or by what their fits are held to.
    """
    if len(sets) < 2 and not own:
        return None
    scatter = np.std(sets, axis=0, ddof=1) if len(sets) > 1 else np.zeros(len(sets[0]))
    alone = np.sqrt(np.mean(np.square(own), axis=0)) if own else np.zeros(len(sets[0]))
    return np.asarray(np.maximum(scatter, alone) / np.sqrt(len(sets)))


def delay_std(late: Sequence[tuple[float, float]]) -> float:
    """Standard deviation [s] of a healthy channel's delay on a further day around the mean of these, from values with
    standard deviations.

    The scatter of a few days is uncertain, so the usual one counts as further days.
    """
    values, deviations = np.array(late).T
    own = float(np.sum((values - values.mean()) ** 2 - (1.0 - 1.0 / len(values)) * deviations**2))
    days = len(values) - 1
    variance = (USUAL_DAYS * DELAY_STD_S**2 + max(own, 0.0)) / (USUAL_DAYS + days)
    return float(np.sqrt(variance * (1.0 + 1.0 / len(values))))


def gain_std(days: Sequence[Floats]) -> float:
    """Standard deviation of the torque sensors' gains from day to day, from errors with standard deviations (2, n) of
    each. All sensors of an arm have the same habits, and the usual one counts as some further changes.
    """
    table = np.array(days)
    values, own = table[:, 0], table[:, 1] ** 2
    known = np.isfinite(values) & (own < GAIN_STD**2)
    count = known.sum(axis=0)
    several = count > 1
    if not several.any():
        return GAIN_STD
    values, own = (np.where(known, x, np.nan)[:, several] for x in (values, own))
    changes = count[several] - 1
    scatter = np.nansum((values - np.nanmean(values, axis=0)) ** 2, axis=0) - changes * np.nanmean(
        own, axis=0
    )
    total = USUAL_CHANGES * GAIN_STD**2 + max(float(scatter.sum()), 0.0)
    return float(np.sqrt(total / (USUAL_CHANGES + changes.sum())))


def largest_left(sets: Sequence[Mapping[str, Floats]]) -> dict[str, Floats]:
    """Largest rms (n,) by side that a further healthy set leaves: all its rows stay below in 19 of 20; of a single set
    its own.

    The logarithms scatter about the mean of their row, alike in all rows: two sets tell too little of one row alone.
    """
    logs = {side: np.log([one[side] for one in sets]) for side in sets[0]}
    away = np.concatenate([(rows - rows.mean(axis=0)).ravel() for rows in logs.values()])
    found = int(np.isfinite(away).sum())
    rows, freedom = found // len(sets), found * (1.0 - 1.0 / len(sets))
    if freedom < 1.0:
        return dict(sets[0])
    spread = np.sqrt(np.nansum(away**2) / freedom * (1.0 + 1.0 / len(sets)))
    more = float(special.stdtrit(freedom, 1.0 - _ABOVE / rows)) * spread
    return {side: np.exp(values.mean(axis=0) + more) for side, values in logs.items()}


def habit(
    names: Sequence[str],
    days: Sequence[Floats],
    covariances: Sequence[Floats],
    torque_rms: Mapping[str, Floats],
    efforts: Floats | None = None,
    sizes: Floats | None = None,
) -> Floats:
    """Variance (p,) of healthy parameters from day to day around their mean.

    days, covariances : parameters (p,) and covariance (p, p) of each day, NaN for the parameters of another payload.
    torque_rms : of the rows by side, (n,) [Nm]. efforts : (n,) largest torques [Nm]; a sensor's zero may go with its
        range and not with the torque of a motion. sizes : (p,) of which the changes are shares, default the mean: the
        friction of a law of several columns changes as a whole.
    Joints of an arm have the same habits, so all parameters of a symbol share one relative variance: the scatter of the
    days beyond their own uncertainty, and the usual change as some further changes. Two days of a 7-joint arm are
    seven changes of its Coulomb friction. What the model lacks bends the parameters differently with each motion, those
    of small value too: where they scatter by more than that, their variance grows with their uncertainty, by a factor
    shared by the symbol and refined for each parameter by its own days.
    """
    values = np.array(days)
    count = np.isfinite(values).sum(axis=0)
    mean, own = np.nanmean(values, axis=0), np.nanmean([np.diag(c) for c in covariances], axis=0)
    of = mean if sizes is None else sizes
    symbols = [symbol_of(name) for name in names]
    # With motor torques alone their rows show the offsets of the links' friction.
    sides = {"offm": "motor", "offl": "joint" if "joint" in torque_rms else "motor"}
    scale = np.array(
        [
            float(torque_rms[sides[symbol]][joint_of(name)]) if symbol in _OFFSETS else abs(value)
            for name, symbol, value in zip(names, symbols, of, strict=True)
        ]
    )
    usual = np.array([USUAL.get(symbol, ELSE) for symbol in symbols])
    groups = [symbol if symbol in (*USUAL, *_OFFSETS, "Ia") else "" for symbol in symbols]
    squares, variance = np.nansum((values - mean) ** 2, axis=0), np.zeros(len(names))
    for group in dict.fromkeys(groups):
        mine = np.array([g == group for g in groups])
        # A parameter less certain than its usual change tells nothing of habits.
        telling = mine & (own < (usual * scale) ** 2) & (scale > 0.0)
        changes = int(np.sum(count[telling] - 1))
        scatter = squares[telling] - (count[telling] - 1) * own[telling]
        total = max(float(np.sum(scatter / scale[telling] ** 2)), 0.0)
        share = (USUAL_CHANGES * usual[mine][0] ** 2 + total) / (USUAL_CHANGES + changes)
        variance[mine] = share * scale[mine] ** 2
        if group in _OFFSETS and efforts is not None:
            ranges = efforts[[joint_of(name) for name, at in zip(names, mine, strict=True) if at]]
            beyond = squares[mine] - (count[mine] - 1) * own[mine]
            if of_ranges := _share_of_ranges(beyond, scale[mine], ranges):
                by_range = of_ranges / int(np.sum(count[mine] - 1)) * ranges**2
                least = USUAL_CHANGES * usual[mine] ** 2 / (USUAL_CHANGES + changes) * scale[mine] ** 2
                variance[mine] = np.maximum(by_range, least)
        expected = own[mine] + variance[mine]
        excess = squares[mine] / np.maximum(expected, 1e-300)
        common = max((_ALIKE + excess.sum()) / (_ALIKE + np.sum(count[mine] - 1)), 1.0)
        each = (_ALIKE * common + excess) / (_ALIKE + count[mine] - 1)
        variance[mine] += np.maximum(each - 1.0, 0.0) * own[mine]
    return variance


def _share_of_ranges(beyond: Floats, scale: Floats, ranges: Floats) -> float:
    """Scatter (k,) of offsets beyond their uncertainty, summed in shares of the sensors' ranges (k,); 0 if shares of
    the torques `scale` (k,) are more likely."""
    if np.min(scale) <= 0.0:
        return 0.0
    of_ranges, of_torques = (float(np.sum(beyond / sizes**2)) for sizes in (ranges, scale))
    if min(of_ranges, of_torques) <= 0.0:
        return 0.0
    likelier = np.sum(np.log(of_ranges * ranges**2)) < np.sum(np.log(of_torques * scale**2))
    return of_ranges if likelier else 0.0
