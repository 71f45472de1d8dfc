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
from numpy.typing import NDArray
from scipy.special import stdtr

from ident.dynamics.parameters import Floats
from ident.rows.class_rows import LEAST, ByClass, Masks, away, error, fit
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
    links = _Side.of(rows, settings)
    tried = []
    for factor in factors:
        stiffness = tuple((factor * usual).tolist())
        tried.append(_against(links, rows_of, replace(settings, encoder="motor", stiffness_nm_rad=stiffness)))
    return max(tried, key=lambda found: found.fall)


class _Side(NamedTuple):
    """Rows with the positions of one side, those in use, the parameters (p,) fitted to their even blocks, and the mean
    log of the held-back residual."""

    rows: ByClass
    used: Masks
    values: Floats
    error: float

    @classmethod
    def of(cls, rows: ByClass, settings: SignalSettings) -> _Side:
        """The rows by these settings."""
        used = away(rows, settings)
        values = fit(rows, used)
        return cls(rows, used, values, error(rows, values, used))

    def squares(self, key: tuple[str, int], where: NDArray[np.bool_]) -> Floats:
        """Squares of some residuals of a joint and side."""
        own = self.rows[key]
        return np.asarray((own.torque - own.fitted(self.values))[where] ** 2)


def _against(
    links: _Side, rows_of: Callable[[SignalSettings], ByClass], settings: SignalSettings
) -> AtMotors:
    """Positions of the motors, by the settings, against those of the links."""
    motors = _Side.of(rows_of(settings), settings)
    less: dict[int, list[float]] = {}
    for key, own in links.rows.items():
        both = links.used[key] & motors.used[key] & ~own.even
        numbers, place, count = np.unique(own.block[both], return_inverse=True, return_counts=True)
        of_links, of_motors = (
            np.bincount(place, side.squares(key, both)) + 1e-300 for side in (links, motors)
        )
        for number, many, change in zip(numbers, count >= LEAST, np.log(of_links / of_motors), strict=True):
            if many:
                less.setdefault(int(number), []).append(0.5 * float(change))
    chance = _chance(np.array([np.mean(block) for block in less.values()]))
    return AtMotors(settings, motors.rows, links.error - motors.error, chance)


def _chance(less: Floats) -> float:
    """Chance of as large a mean of independent values (B,) of mean zero."""
    count = len(less)
    if count < _LEAST_BLOCKS:
        return 1.0
    spread = float(np.std(less, ddof=1)) / np.sqrt(count)
    return float(stdtr(count - 1, -float(np.mean(less)) / max(spread, 1e-300)))
