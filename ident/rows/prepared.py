"""Sessions ready for any regressor: filtered motion and torque at their own sample times, and the times of the rows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ident.dynamics.parameters import Floats
from ident.dynamics.structure import DriveMotion
from ident.rows.delay import Delay
from ident.rows.filters import SignalSettings
from lwr_driver.session.spool import release

BoolArray = NDArray[np.bool_]

_SAMPLED = ("times", "q", "qd", "qdd", "torque", "flagged", "known")


@dataclass(frozen=True)
class TorqueChannel:
    """Torque of one side as measured, and the filtered motion at its sample times.

    times : (m,) [s], delay removed. q, qd, qdd, torque : (m, J). flagged : (m, J), bridged or outliers.
    known : (m, J), neither flagged nor beside a reversal of their joint. drive : motion of the motors
    where it is known to differ from the links', else None. period_s : median time between samples [s]. taken_back :
    whether the motion is that of the links, taken back from positions of the motors.
    """

    side: str
    times: Floats
    q: Floats
    qd: Floats
    qdd: Floats
    torque: Floats
    flagged: BoolArray
    known: BoolArray
    drive: DriveMotion | None = None
    period_s: float = float("nan")
    taken_back: bool = False

    @property
    def arrays(self) -> tuple[Floats | BoolArray, ...]:
        """All arrays by sample."""
        drive = () if self.drive is None else (self.drive.speed, self.drive.acceleration)
        return (*(getattr(self, name) for name in _SAMPLED), *drive)

    def on(self, arrays: Sequence[NDArray[Any]]) -> TorqueChannel:
        """The channel with other arrays."""
        drive = None if self.drive is None else DriveMotion(arrays[len(_SAMPLED)], arrays[len(_SAMPLED) + 1])
        found: dict[str, Any] = dict(zip(_SAMPLED, arrays, strict=False))
        return replace(self, **found, drive=drive)

    def at(self, samples: NDArray[np.bool_] | NDArray[np.int64]) -> TorqueChannel:
        """The channel at some of its samples."""
        drive = None if self.drive is None else self.drive.at(samples)
        return replace(self, **{name: getattr(self, name)[samples] for name in _SAMPLED}, drive=drive)


@dataclass(frozen=True)
class Passage:
    """An uninterrupted stretch with the times of its rows, or a block of it.

    rows : (K,) times of the rows [s]; index : (K,) int64, their numbers within the session.
    joint_valid, motor_valid : (K, J), usable rows. core : times of the block [s]; its samples overlap those of its
    neighbours by the reach of the filters. stretch_rows : times of all rows of the stretch.
    """

    rows: Floats
    index: NDArray[np.int64]
    joint: TorqueChannel
    joint_valid: BoolArray
    motor: TorqueChannel | None
    motor_valid: BoolArray | None
    core: tuple[float, float] = (-np.inf, np.inf)
    stretch_rows: Floats = field(default_factory=lambda: np.zeros(0))

    @property
    def continues(self) -> bool:
        """Whether it goes on where the block before ends."""
        return self.core[0] > -np.inf

    def own(self, times: Floats) -> BoolArray:
        """Samples (m,) of this block alone."""
        return np.asarray((times >= self.core[0]) & (times < self.core[1]))

    def release(self) -> None:
        """Give the memory of its samples back, as far as they are in files."""
        for channel in (self.joint, self.motor):
            release(*(() if channel is None else channel.arrays))


@dataclass(frozen=True)
class PreparedSession:
    """A session ready for any regressor.

    row_time_s : time between rows. period_rows : rows in a period of the excitation, None without periods.
    delay, joint_delay : of the motor and of the joint torques, None without them. counts : lost samples, outliers,
        dropped rows.
    moving : moving joints. warnings : sentences for the report. uid : of the session, from its metadata.
    mean_torque : (J,) mean of |joint torque| from the first row to the last [Nm]; empty without the sensors.
    jitter_s : rms of the stamps about the counted times [s] (`sample_clock`), None where the stamps stand.
    """

    name: str
    joint_names: tuple[str, ...]
    settings: SignalSettings
    passages: Sequence[Passage]
    row_time_s: float
    period_rows: int | None
    periods: int
    delay: Delay | None
    excitation_hz: float
    cutoff_hz: float
    moving: tuple[str, ...]
    counts: dict[str, int]
    warnings: tuple[str, ...]
    uid: str = ""
    mean_torque: tuple[float, ...] = ()
    jitter_s: float | None = None
    joint_delay: Delay | None = None

    def __repr__(self) -> str:
        return (
            f"Prepared session {self.name}: {self.counts['rows']} rows, cut-off {self.cutoff_hz:.3g} Hz, "
            f"excitation up to {self.excitation_hz:.3g} Hz"
        )

    def without_samples(self) -> PreparedSession:
        """The same without its passages, to save memory; enough for the report."""
        return replace(self, passages=())

    @property
    def signals(self) -> SignalSettings:
        """The settings with the delays in use stated."""
        stated: dict[str, Any] = {name: one.seconds for name, one in self.delays.items()}
        return replace(self.settings, **stated)

    @property
    def delays(self) -> dict[str, Delay]:
        """The delays of its torques, by their names in the settings."""
        found = {"motor_delay_s": self.delay, "joint_delay_s": self.joint_delay}
        return {name: one for name, one in found.items() if one is not None}

    @property
    def has_motor(self) -> bool:
        """Whether the session has motor torques."""
        return any(passage.motor is not None for passage in self.passages)
