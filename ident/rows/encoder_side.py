"""The side of elastic joints that the positions come from, told by how well the base model predicts the torques.

A joint of stiffness k twists by tau_l / k. Encoders at the motors read the links' position plus that twist, ten
milliradians under the weight of a stretched arm: the lever of gravity is off by a per cent where the links are taken
to stand where the encoders say. With the joint torque measured, both are known.

Both models hold the same number of parameters. The log of the ratio of their errors in a block of held-back rows, the
mean over joints and sides, is one sample of a t test.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.special import stdtr

from ident.dynamics.parameters import Floats
from ident.rows.class_rows import LEAST, ByClass, away, error, fit
from ident.rows.filters import SignalSettings

USUAL_TWIST_RAD = 0.008
"""Twist of a geared joint under its largest torque: that of strain-wave gears and of torque sensors."""
# Stiffness over the usual one: that of strain-wave joints differs by a few times, on either side.
_FACTORS = (0.5, 1.0, 2.0, 4.0)
# Chance of positions of the links, below which they are the motors'.
_CHANCE = 0.001
# Least fall of the log of the held-back error: half a per cent.
_WORTH = 0.005
_LEAST_BLOCKS = 3


class AtMotors(NamedTuple):
    """Settings with the positions of the motors, the rows, and what tells it: fall of the log of the held-back error,
    and its chance with positions of the links."""

    settings: SignalSettings
    rows: ByClass
    fall: float
    chance: float

    @property
    def told(self) -> bool:
        """Whether the data tell that the positions are the motors'."""
        return self.fall > _WORTH and self.chance < _CHANCE


def at_motors(
    rows_of: Callable[[SignalSettings], ByClass],
    rows: ByClass,
    settings: SignalSettings,
    efforts: Floats | None,
) -> AtMotors | None:
    """The rows with positions of the motors, held against those with positions of the links.

    rows_of : rows by settings. rows : with positions of the links. efforts : (J,) largest torques [Nm], for the usual
    stiffness where the settings state none; that one is known to a factor, the best of a few is taken. None without
    joint torques, or without a stiffness of either kind.
    """
    if not any(side == "joint" for side, _ in rows):
        return None
    factors: tuple[float, ...] = _FACTORS
    if settings.stiffness_nm_rad is not None:
        usual, factors = np.array(settings.stiffness_nm_rad), (1.0,)
    elif efforts is not None:
        usual = efforts / USUAL_TWIST_RAD
    else:
        return None
    tried = []
    for factor in factors:
        stiffness = tuple((factor * usual).tolist())
        one = replace(settings, encoder="motor", stiffness_nm_rad=stiffness)
        tried.append(_against(rows, settings, rows_of(one), one))
    return max(tried, key=lambda found: found.fall)


def _against(links: ByClass, settings: SignalSettings, motors: ByClass, at_motor: SignalSettings) -> AtMotors:
    """Positions of the motors against those of the links."""
    used = [away(links, settings), away(motors, at_motor)]
    fitted = [fit(links, used[0]), fit(motors, used[1])]
    fall = error(links, fitted[0], used[0]) - error(motors, fitted[1], used[1])
    less: dict[int, list[float]] = {}
    for key, link in links.items():
        motor = motors[key]
        both = used[0][key] & used[1][key] & ~link.even
        numbers, place, count = np.unique(link.block[both], return_inverse=True, return_counts=True)
        squares = [
            np.bincount(place, (own.torque - own.fitted(values))[both] ** 2) + 1e-300
            for own, values in ((link, fitted[0]), (motor, fitted[1]))
        ]
        for number, many, change in zip(
            numbers, count >= LEAST, np.log(squares[0] / squares[1]), strict=True
        ):
            if many:
                less.setdefault(int(number), []).append(0.5 * float(change))
    return AtMotors(at_motor, motors, fall, _chance(np.array([np.mean(block) for block in less.values()])))


def _chance(less: Floats) -> float:
    """Chance of as large a mean of independent values (B,) of mean zero."""
    count = len(less)
    if count < _LEAST_BLOCKS:
        return 1.0
    spread = float(np.std(less, ddof=1)) / np.sqrt(count)
    return float(stdtr(count - 1, -float(np.mean(less)) / max(spread, 1e-300)))
