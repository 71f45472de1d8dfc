"""Sessions on an even grid: measured torques beside filtered motion, before any model."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fri.errors import DataError
from ident.diagnosis.settings import DiagnosisSettings
from ident.dynamics.kinematics import Chain
from ident.dynamics.structure import Side
from ident.rows.data_quality import Stuck, clipped_at, held_times, passed_band, stuck_at
from ident.rows.filters import SignalSettings
from ident.rows.prepare import PreparedSession, prepare
from ident.rows.sessions import payload_name
from lwr_driver.session import Session

Floats = NDArray[np.float64]

# Distance from held samples within which the filtered positions are wrong too [s].
_HELD_S = 0.1


@dataclass(frozen=True, eq=False)
class RecordStretch:
    """An uninterrupted part of a session.

    time : (N,) even grid [s] from the first sample of the log; q, qd, qdd : (N, n).
    effort : (N, n) joint torque on the grid; usable : (N, n) samples neither bridged nor outliers.
    motor_time : (M,) times of the motor torque as published [s]; motor : (M, n); motor_usable : (M, n).
    """

    time: Floats
    q: Floats
    qd: Floats
    qdd: Floats
    effort: Floats
    usable: NDArray[np.bool_]
    motor_time: Floats
    motor: Floats
    motor_usable: NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class SessionRecord:
    """A session ready for rows.

    number : in the order of the sessions' beginnings. payload : mounted, None for none.
    period_s : of the excitation, or the duration without repetition; start_s : its beginning.
    has_effort, has_motor : existing channels. test : held-out session.
    clipped : (n,) torque [Nm] at the limit of a joint's sensor, NaN without a visible limit. stuck : values reported
    repeatedly as motor torque without being measurements.
    joint_band_hz, motor_band_hz : upper edge of an earlier low-pass on the torques, None without one.
    """

    name: str
    number: int
    payload: str | None
    stretches: tuple[RecordStretch, ...]
    start_s: float
    period_s: float
    duration_s: float
    has_effort: bool
    has_motor: bool
    test: bool
    joint_names: tuple[str, ...]
    clipped: Floats
    stuck: tuple[Stuck, ...]
    joint_band_hz: float | None = None
    motor_band_hz: float | None = None

    @property
    def repeats(self) -> bool:
        """Whether the excitation repeats within the session."""
        return self.period_s < 0.999 * self.duration_s

    @property
    def sides(self) -> tuple[Side, ...]:
        """Sides with recorded torque."""
        motor: tuple[Side, ...] = ("motor",) if self.has_motor else ()
        return (*motor, "joint") if self.has_effort else motor


def record(
    session: Session, number: int, chain: Chain, settings: DiagnosisSettings, *, test: bool = False
) -> SessionRecord:
    """Filter one session. Raises DataError for sessions without a stretch long enough."""
    chosen = session.select(chain.joint_names)
    rate = 1.0 / chosen.joint.period_s
    cutoff = min(settings.cutoff_hz, 0.2 * rate)
    decimate = min(10.0, 0.5 * cutoff)
    prepared = prepare(
        chosen,
        SignalSettings(cutoff_hz=cutoff, decimate_hz=decimate, motor_delay_s=0.0, standstill_share=1.0),
    )
    motor = chosen.motor
    stuck = () if motor is None else stuck_at(motor, chosen.joint)
    stretches = tuple(_stretches(prepared, rate, held_times(chosen.joint), stuck))
    if not stretches:
        raise DataError(f"{prepared.name}: no stretch of the session is long enough for a diagnosis")
    spans = chosen.spans("period")
    first, last = stretches[0].time[0], stretches[-1].time[-1]
    return SessionRecord(
        name=prepared.name,
        number=number,
        payload=payload_name(chosen),
        stretches=stretches,
        start_s=float(first),
        period_s=float(spans[0][1] - spans[0][0]) * 1e-9 if spans else last - first,
        duration_s=float(last - first),
        has_effort=bool(chosen.joint.effort.shape[1]),
        has_motor=prepared.has_motor,
        test=test,
        joint_names=prepared.joint_names,
        clipped=clipped_at(chosen.joint),
        stuck=stuck,
        # An earlier filter worked sample by sample, so its band is visible in the samples as published.
        joint_band_hz=passed_band(chosen.joint.effort, chosen.joint.period_s),
        motor_band_hz=None if motor is None else passed_band(motor.effort, motor.period_s),
    )


def _stretches(
    prepared: PreparedSession, rate: float, held: Floats, stuck: Sequence[Stuck]
) -> list[RecordStretch]:
    found = []
    for passage in prepared.passages:
        joint = passage.joint
        inside = (joint.times >= passage.rows[0]) & (joint.times <= passage.rows[-1])
        if inside.sum() < 32:
            continue
        # Sampling beyond 1 kHz adds nothing but cost.
        thin = max(1, round(rate / 1000.0))
        pick = np.flatnonzero(inside)[::thin]
        n = joint.q.shape[1]
        motor_time, motor, usable = np.zeros(0), np.zeros((0, n)), np.zeros((0, n), dtype=bool)
        if passage.motor is not None:
            m = passage.motor
            # A margin keeps the samples inside the grid when the channel is shifted.
            keep = (m.times >= joint.times[pick[0]] + 0.06) & (m.times <= joint.times[pick[-1]] - 0.06)
            motor_time, motor = m.times[keep], m.torque[keep]
            usable = ~m.flagged[keep] & _apart(motor_time, held)[:, None]
            for one in stuck:
                usable[:, one.joint] &= motor[:, one.joint] != one.value
        time, q, qd, qdd, effort = (
            x[pick] for x in (joint.times, joint.q, joint.qd, joint.qdd, joint.torque)
        )
        known = ~joint.flagged[pick] & _apart(time, held)[:, None]
        found.append(RecordStretch(time, q, qd, qdd, effort, known, motor_time, motor, usable))
    return found


def _apart(times: Floats, held: Floats) -> NDArray[np.bool_]:
    """Whether times (N,) are far enough from held samples."""
    if not len(held):
        return np.ones(len(times), dtype=bool)
    after = np.searchsorted(held, times)
    before, after = np.maximum(after - 1, 0), np.minimum(after, len(held) - 1)
    return np.minimum(np.abs(times - held[before]), np.abs(times - held[after])) > _HELD_S
