"""The side of elastic joints that the positions come from, told by how well the base model predicts the torques.

A joint of stiffness k twists by tau_l / k. Encoders at the motors read the links' position plus that twist, ten
milliradians under the weight of a stretched arm: the lever of gravity is off by a per cent where the links are taken
to stand where the encoders say. With the joint torque measured, both are known.

Both models hold the same number of parameters. The log of the ratio of their errors in a block of held-back rows, the
mean over joints and sides, is one sample of a t test. Motor torques and joint torques are tested apart too: what makes
one side better and the other worse is no twist. Where the stiffness is the usual one of such joints, the error has to
be least at a twist of about its size, not at the smallest tried.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
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
# Stiffness over the usual one: that of strain-wave joints differs by a few times, on either side. The twist of the
# first is too small for any such joint.
_FACTORS = (8.0, 4.0, 2.0, 1.0, 0.5)
# Chance of positions of the links, below which they are the motors'; and of a side that is made worse.
_CHANCE = 0.001
# Least fall of the log of the held-back error: half a per cent.
_WORTH = 0.005
_LEAST_BLOCKS = 3


class AtMotors(NamedTuple):
    """Settings with the positions of the motors, the rows, and what tells it.

    fall : of the log of the held-back error. chance : of that fall with positions of the links. against : chance of the
    side with the higher error, were the positions the motors'.
    """

    settings: SignalSettings
    rows: ByClass
    fall: float
    chance: float
    against: float

    @property
    def told(self) -> bool:
        """Whether the data tell that the positions are the motors'."""
        return self.fall > _WORTH and self.chance < _CHANCE < self.against


def at_motors(
    rows_of: Callable[[SignalSettings], ByClass],
    rows: ByClass,
    settings: SignalSettings,
    efforts: Floats | None,
) -> AtMotors | None:
    """The rows with positions of the motors, where these are stated or told by the data; None where they are not.

    rows_of : rows by settings. rows : with positions of the links. settings : with the encoder "motor" where that is
    stated. efforts : (J,) largest torques [Nm], for the usual stiffness where the settings state none; that one is
    known to a factor, the best of a few is taken. None without joint torques, or without a stiffness of either kind.
    """
    if not any(side == "joint" for side, _ in rows):
        return None
    stated = settings.encoder == "motor"
    links = _Side.of(rows, settings)

    def with_stiffness(stiffness: Floats) -> AtMotors:
        wanted = replace(settings, encoder="motor", stiffness_nm_rad=tuple(stiffness.tolist()))
        return _against(links, rows_of(wanted), wanted)

    if settings.stiffness_nm_rad is not None:
        found = with_stiffness(np.array(settings.stiffness_nm_rad))
        return found if stated or found.told else None
    if efforts is None:
        return None
    tried: list[AtMotors] = []
    for factor in _FACTORS:
        tried.append(with_stiffness(factor * efforts / USUAL_TWIST_RAD))
        if len(tried) > 1 and tried[-1].fall < tried[-2].fall:
            break
    usual = tried[1:]
    if not stated:
        rises = usual[0].fall > tried[0].fall
        usual = [found for found in usual if rises and found.told]
    return max(usual, key=lambda found: found.fall, default=None)


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


def _against(links: _Side, rows: ByClass, settings: SignalSettings) -> AtMotors:
    """Rows with positions of the motors, by the settings, against those of the links."""
    motors = _Side.of(rows, settings)
    less: dict[str, dict[int, list[float]]] = {}
    for key, own in links.rows.items():
        both = links.used[key] & motors.used[key] & ~own.even
        numbers, place, count = np.unique(own.block[both], return_inverse=True, return_counts=True)
        of_links, of_motors = (
            np.bincount(place, side.squares(key, both)) + 1e-300 for side in (links, motors)
        )
        for number, many, change in zip(numbers, count >= LEAST, np.log(of_links / of_motors), strict=True):
            if many:
                less.setdefault(key[0], {}).setdefault(int(number), []).append(0.5 * float(change))
    every: dict[int, list[float]] = {}
    for blocks in less.values():
        for number, changes in blocks.items():
            every.setdefault(number, []).extend(changes)
    against = min(
        (_chance([-np.mean(some) for some in blocks.values()]) for blocks in less.values()), default=1.0
    )
    chance = _chance([np.mean(some) for some in every.values()])
    return AtMotors(settings, motors.rows, links.error - motors.error, chance, against)


def _chance(values: Sequence[np.floating]) -> float:
    """Chance of as large a mean of independent values of mean zero."""
    count = len(values)
    if count < _LEAST_BLOCKS:
        return 1.0
    spread = float(np.std(values, ddof=1)) / np.sqrt(count)
    return float(stdtr(count - 1, -float(np.mean(values)) / max(spread, 1e-300)))
