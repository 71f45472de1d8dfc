"""A motion: the joint positions to command, one row per FRI cycle, and the checks that it must pass first."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fri.errors import ConfigurationError
from lwr_driver.arm import JOINTS, Arm

__all__ = ["Excess", "Motion"]


@dataclass(frozen=True)
class Motion:
    """Rows of joint positions, one per FRI cycle, sent as float32.

    q : (n, 7) float64, joint positions [rad]; row 0 is sent in the cycle in which the motion begins
    period_s : time between rows [s]
    phases : (first row, name) in rising order of rows; rows before the first phase have no name
    """

    q: NDArray[np.float64]
    period_s: float
    phases: tuple[tuple[int, str], ...] = ()

    def __post_init__(self) -> None:
        q = np.array(self.q, dtype=np.float64)
        if q.ndim != 2 or q.shape[1] != JOINTS or q.shape[0] < 1:
            raise ConfigurationError(f"motion of shape {q.shape}; it must be (rows, {JOINTS}) with a row at least")
        if not np.all(np.isfinite(q)):
            row, joint = np.argwhere(~np.isfinite(q))[0]
            raise ConfigurationError(f"motion row {row}, joint {joint + 1} is {q[row, joint]}; it must be finite")
        if not 1e-3 - 1e-9 <= self.period_s <= 0.1 + 1e-9:
            raise ConfigurationError(f"motion period {self.period_s} s is not within 0.001 s to 0.1 s")
        rows = [row for row, _ in self.phases]
        if rows != sorted(set(rows)) or any(not 0 <= row < len(q) for row in rows):
            raise ConfigurationError(f"phases begin at rows {rows}; rows must rise and lie within 0 to {len(q) - 1}")
        q.flags.writeable = False
        object.__setattr__(self, "q", q)
        object.__setattr__(self, "phases", tuple((int(row), str(name)) for row, name in self.phases))

    def __len__(self) -> int:
        return len(self.q)

    @property
    def duration_s(self) -> float:
        """Time from the first row to the last [s]."""
        return (len(self.q) - 1) * self.period_s

    def join(self, other: Motion) -> Motion:
        """This motion followed at once by `other`, whose first row repeats our last and is dropped."""
        if other.period_s != self.period_s:
            raise ConfigurationError(f"motions of periods {self.period_s} s and {other.period_s} s cannot be joined")
        gap = float(np.max(np.abs(other.q[0] - self.q[-1])))
        if gap > 1e-9:
            raise ConfigurationError(f"motions are {gap:.3g} rad apart where they join; begin where the other ends")
        shift = len(self.q) - 1
        later = tuple((row + shift, name) for row, name in other.phases)
        kept = tuple(item for item in self.phases if not later or item[0] < later[0][0])
        return Motion(np.vstack([self.q, other.q[1:]]), self.period_s, kept + later)


@dataclass(frozen=True)
class Excess:
    """The worst excess of one limit: `str()` is a message with subject, value, limit and time."""

    quantity: str
    joint: str
    row: int
    time_s: float
    value: float
    limit: float

    def __str__(self) -> str:
        unit = {"position": "rad", "velocity": "rad/s", "acceleration": "rad/s²", "jerk": "rad/s³"}
        kind = self.quantity.split()[-1]
        return (
            f"{self.joint} {self.quantity} {self.value:.4g} {unit.get(kind, 'rad')} at t = {self.time_s:.3f} s "
            f"exceeds {self.limit:.4g}"
        )


def check_motion(arm: Arm, motion: Motion, *, start: NDArray[np.float64] | None = None) -> tuple[Excess, ...]:
    """Worst excess per limit and joint of the rows as they are really sent; empty if the motion may be executed."""
    raise NotImplementedError


def move_to(
    arm: Arm,
    start: NDArray[np.float64],
    goal: NDArray[np.float64],
    period_s: float,
    *,
    speed_scale: float = 0.2,
    phase: str = "move_to_start",
) -> Motion:
    """Jerk-limited straight line in joint space from rest at `start` to rest at `goal`."""
    raise NotImplementedError
