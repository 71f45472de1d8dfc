"""What an extension gained, row by row, and what the base parameters had absorbed."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from ident.diagnosis import Diagnosis
from ident.diagnosis.held_out import HeldOut, interval

__all__ = ["Moved", "RowGain", "moved_parameters", "row_gains"]

_SEED = 1


@dataclass(frozen=True)
class RowGain:
    """Held-out torque error of a joint (from 1) and side [Nm], without and with the extension.

    noise : floor, what no model can predict. gain : base less extended, with its 95 % interval from blocks that
    are drawn with replacement.
    """

    side: str
    joint: int
    noise: float
    base: float
    extended: float
    gain: float
    interval_95: tuple[float, float]

    @property
    def avoidable(self) -> float:
        """The part of the base model's error that is not noise [Nm]."""
        return math.sqrt(max(0.0, self.base**2 - self.noise**2))

    @property
    def avoidable_share(self) -> float:
        """Share of the error's power that is not noise."""
        return self.avoidable**2 / self.base**2 if self.base > 0.0 else 0.0

    def to_dict(self) -> dict[str, Any]:
        """Plain content."""
        return {
            "side": self.side,
            "joint": self.joint,
            "noise_floor": self.noise,
            "test_rms_base": self.base,
            "test_rms_extended": self.extended,
            "gain": self.gain,
            "gain_interval_95": list(self.interval_95),
            "avoidable": self.avoidable,
            "avoidable_share": self.avoidable_share,
        }


@dataclass(frozen=True)
class Moved:
    """A base parameter that the base model had wrong because it absorbed what the extension now says."""

    name: str
    unit: str
    base: float
    extended: float
    std: float

    @property
    def sigmas(self) -> float:
        """The change in standard deviations of the extended estimate."""
        return (self.extended - self.base) / self.std if self.std > 0.0 else 0.0

    def to_dict(self) -> dict[str, Any]:
        """Plain content."""
        return {
            "name": self.name,
            "unit": self.unit,
            "base": self.base,
            "extended": self.extended,
            "std": self.std,
            "change_in_std": self.sigmas,
        }


def row_gains(diagnosis: Diagnosis) -> tuple[RowGain, ...]:
    """One for each joint and side with held-out rows."""
    found = []
    for side, base in diagnosis.residuals.get("base", {}).items():
        block = {side: diagnosis.states[side].block}
        before = HeldOut({side: base}, block)
        after = HeldOut({side: diagnosis.residuals["extended"][side]}, block)
        if after.residual[side].shape != base.shape:
            continue
        for joint in range(base.shape[1]):
            if not np.isfinite(base[:, joint]).any():
                continue
            rms_base, rms_extended, low, high = interval(before, after, [(side, joint)], _SEED)
            found.append(
                RowGain(
                    side,
                    joint + 1,
                    float(diagnosis.noise_floor[side][joint]),
                    rms_base,
                    rms_extended,
                    rms_base - rms_extended,
                    (low, high),
                )
            )
    return tuple(found)


def moved_parameters(diagnosis: Diagnosis) -> tuple[Moved, ...]:
    """Base parameters that the extension moved by more than two standard deviations, the furthest first."""
    base, extended = diagnosis.base_model, diagnosis.extended_model
    std = extended.std
    if std is None or not diagnosis.findings:
        return ()
    units = dict(zip(extended.names, extended.units, strict=True))
    spread = dict(zip(extended.names, std, strict=True))
    found = [
        Moved(name, units[name], base.value(name), extended.value(name), float(spread[name]))
        for name in diagnosis.changes
    ]
    return tuple(sorted(found, key=lambda moved: -abs(moved.sigmas)))
