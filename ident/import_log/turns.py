"""Angles that wrap: steps of one turn from one sample to the next, taken back."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ident.import_log.tables import Floats

_TURN = 2.0 * math.pi
# Share of the steps taken for usual, and largest step of a joint that only wraps over the usual ones.
_NEARLY_ALL, _LARGER = 0.999, 3.0
# Largest usual step: an angle that turns faster shows no turns.
_FASTEST = 0.5 * math.pi
# Step of an encoder of 12 bits [rad].
_GRAIN = _TURN / 4096.0


def unwrapped(angle: Floats) -> tuple[Floats, list[NDArray[np.int64]]]:
    """Angles (n, k) [rad] without the steps of one turn, and by column the numbers of the samples behind such steps.

    A step is one of a turn if what it has beside the turn is no larger than the usual steps of its column. Others stay:
    a wrong sample, a joint zeroed anew.
    """
    whole, places = angle, []
    for k in range(angle.shape[1]):
        steps = np.diff(angle[:, k])
        turns = np.rint(steps / _TURN)
        usual = np.abs(steps[turns == 0.0])
        if not turns.any() or not len(usual):
            places.append(np.zeros(0, dtype=np.int64))
            continue
        limit = max(_LARGER * float(np.quantile(usual, _NEARLY_ALL)), _GRAIN)
        wraps = (np.abs(turns) == 1.0) & (np.abs(steps - _TURN * turns) <= limit) & (limit < _FASTEST)
        places.append(np.flatnonzero(wraps) + 1)
        if wraps.any():
            whole = angle.copy() if whole is angle else whole
            whole[1:, k] -= _TURN * np.cumsum(np.where(wraps, turns, 0.0))
    return whole, places
