"""Load data of a payload, checked before they reach the controller: a wrong mass makes the arm sag or rise."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fri.errors import ConfigurationError
from fri.handshake import same_load

HEAVIEST_KG = 14.0
FARTHEST_M = 0.5
_TOLERANCE = 1e-6


@dataclass(frozen=True)
class LoadInForce:
    """Mass [kg] and centre of mass in the flange frame [m] of load data."""

    mass: float
    com: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def agrees(self, other: LoadInForce) -> bool:
        """Whether these are the same load data but for rounding; false for NaN. Nothing has no centre of mass."""
        one, two = (np.array([load.mass, *(1e3 * value for value in load.com)]) for load in (self, other))
        return same_load(one, two)

    def __str__(self) -> str:
        if self.mass == 0.0:
            return "none (0 kg)"
        x, y, z = (1e3 * value for value in self.com)
        return f"{self.mass:.4g} kg at ({x:.4g}, {y:.4g}, {z:.4g}) mm from the flange"


def check_load(mass: float, com: Sequence[float], inertia: Sequence[float]) -> None:
    """Raise ConfigurationError for load data that no payload of an LWR4+ can have.

    mass : 0 to 14 kg, twice the rated payload. com : centre of mass [m], at most 0.5 m from the flange or link frame.
    inertia : about the centre of mass [kg m²], (3,) JX JY JZ or (6,) XX XY XZ YY YZ ZZ; all zero for unknown. Its
    principal moments are positive and keep the triangle inequality I1 + I2 >= I3; none exceeds mass (0.5 m)².
    """
    numbers = (mass, *com, *inertia)
    if not all(math.isfinite(number) for number in numbers):
        raise ConfigurationError(
            f"load data {numbers} contain a number that is not finite; give all in SI units"
        )
    if not 0.0 <= mass <= HEAVIEST_KG:
        grams = f"; it looks like g, write {mass * 1e-3:g}" if 0.0 < mass * 1e-3 <= HEAVIEST_KG else ""
        raise ConfigurationError(
            f"mass {mass:g} kg is outside 0 to {HEAVIEST_KG:g} kg{grams or '; weigh the payload'}"
        )
    distance = math.hypot(*com)
    if distance > FARTHEST_M:
        mm = ", ".join(f"{value * 1e-3:g}" for value in com)
        advice = (
            f"it looks like mm, write [{mm}]" if 5.0 < distance <= 1e3 * FARTHEST_M else "measure it again"
        )
        raise ConfigurationError(
            f"com: centre of mass {distance:.4g} m from the flange, limit {FARTHEST_M:g} m; {advice}"
        )
    if mass == 0.0 and any((*com, *inertia)):
        raise ConfigurationError(
            "a load without mass has no centre of mass and no inertia; give its mass or zeros"
        )
    if not any(inertia):
        return
    matrix = np.diag(inertia) if len(inertia) == 3 else _symmetric(inertia)
    moments = np.linalg.eigvalsh(matrix)
    listed = ", ".join(f"{moment:.3g}" for moment in moments)
    largest = mass * FARTHEST_M**2
    if moments[0] <= 0.0:
        raise ConfigurationError(
            f"inertia with principal moments {listed} kg m² is not positive definite; no body has it. Give it about "
            "the centre of mass, or zeros if it is unknown"
        )
    if moments[0] + moments[1] < moments[2] * (1.0 - _TOLERANCE):
        raise ConfigurationError(
            f"inertia with principal moments {listed} kg m² breaks I1 + I2 >= I3; no body has it. Give it about the "
            "centre of mass, or zeros if it is unknown"
        )
    if moments[2] > largest:
        raise ConfigurationError(
            f"inertia {moments[2]:.3g} kg m² is above {largest:.3g} kg m², that of {mass:g} kg at {FARTHEST_M:g} m; "
            "give it about the centre of mass, in kg m²"
        )


def _symmetric(inertia: Sequence[float]) -> np.ndarray:
    xx, xy, xz, yy, yz, zz = inertia
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
