"""Sessions on an even grid: measured torques beside filtered motion, before any model."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from fri.errors import DataError
from ident.diagnosis.settings import DiagnosisSettings
from ident.dynamics.base_set import numeric_base
from ident.dynamics.kinematics import Chain
from ident.dynamics.structure import Coupling, ModelStructure, Side
from ident.rows.content import Recall
from ident.rows.data_quality import Stuck, clipped_at, passed_band, stuck_at
from ident.rows.prepare import prepare
from ident.rows.prepared import PreparedSession
from ident.rows.sessions import payload_name, stated_mass
from ident.rows.signal_choice import choose_signals
from lwr_driver.session import Session
from lwr_driver.session.spool import stored

Floats = NDArray[np.float64]

logger = logging.getLogger(__name__)

TRAVEL_RAD = 0.1
"""A joint within this range carries no information on its friction, gears and cables."""

# Least period of motor samples over that of positions, for a clock of their own.
_OWN_CLOCK = 1.5
# Largest relative difference of one sensor's limit between sessions.
_ONE_LIMIT = 1e-3


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

    @property
    def own_clock(self) -> bool:
        """Whether motor torques come with a clock of their own, slower than that of the positions."""
        if len(self.motor_time) < 2:
            return False
        return usual_step(self.motor_time) > _OWN_CLOCK * usual_step(self.time)


def usual_step(time: Floats) -> float:
    """Usual distance [s] of stamps, from those around the middle of a long record."""
    middle = len(time) // 2
    return float(np.median(np.diff(time[max(middle - 500, 0) : middle + 500])))


@dataclass(frozen=True, eq=False)
class SessionRecord:
    """A session ready for rows.

    number : in the order of the sessions' beginnings. begun_s : beginning of the log [s], by its clock.
    payload : mounted, None for none; payload_mass : as announced [kg].
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
    payload_mass: float | None = None
    begun_s: float = 0.0

    @property
    def repeats(self) -> bool:
        """Whether the excitation repeats within the session."""
        return self.period_s < 0.999 * self.duration_s

    @property
    def sides(self) -> tuple[Side, ...]:
        """Sides with recorded torque."""
        motor: tuple[Side, ...] = ("motor",) if self.has_motor else ()
        return (*motor, "joint") if self.has_effort else motor


def some_joint_moves(recordings: Sequence[SessionRecord]) -> None:
    """Raises DataError if no joint moves in the fitted sessions."""
    if not _moving([one for one in recordings if not one.test]).any():
        raise DataError(
            f"no joint moves by more than {TRAVEL_RAD} rad; a static pose excites no dynamics. Record an "
            "excitation"
        )


def every_joint_moves(recordings: Sequence[SessionRecord], chain: Chain) -> None:
    """Raises DataError for joints without motion."""
    still = [name for name, moves in zip(chain.joint_names, _moving(recordings), strict=True) if not moves]
    if still:
        raise DataError(
            f"no motion of more than {TRAVEL_RAD} rad: {', '.join(still)}; a baseline needs motion of every joint. "
            "Record an excitation, or use a chain in which such a joint is fixed"
        )


def _moving(recordings: Sequence[SessionRecord]) -> NDArray[np.bool_]:
    """Joints (n,) that move within a stretch."""
    return np.any([np.ptp(s.q, axis=0) > TRAVEL_RAD for one in recordings for s in one.stretches], axis=0)


def settled(
    settings: DiagnosisSettings,
    sessions: Sequence[Session],
    chain: Chain,
    couplings: Sequence[Coupling] = (),
    *,
    healthy: bool,
    recall: Recall | None = None,
) -> DiagnosisSettings:
    """The settings with signals and friction law from the fitted sessions, as `identify` chooses them.

    couplings : of the arm. healthy : with sets of a healthy arm, which tell the side of the positions and the stiffness
    themselves; the positions are then taken as published. recall : as for `prepare`.
    """
    signals = settings.signals.of_coupled(couplings)
    settings = replace(settings, signals=replace(signals, encoder="link") if healthy else signals)
    chosen = [session.select(chain.joint_names) for session in sessions]
    payloads = [payload_name(session) for session in chosen]
    sensed = any(bool(session.joint.effort.shape[1]) for session in chosen)
    motor = any(session.motor is not None for session in chosen)
    structure = ModelStructure(
        chain,
        2 if motor else 1,
        tuple(dict.fromkeys(p for p in payloads if p is not None)),
        couplings=tuple(couplings),
        sides=() if sensed else ("motor",),
    )
    try:
        base = numeric_base(structure)
        laws = (settings.law, settings.row_law)
        found = choose_signals(
            chosen, payloads, structure, base.columns, settings.signals, laws, recall=recall
        )
    except DataError as error:
        # The records say what is wrong with a session.
        logger.info("signal settings of the paper, because: %s", error)
        return settings
    return replace(settings, signals=found.settings, law=found.coulomb, row_law=found.row_coulomb)


def settled_for_all(
    settings: DiagnosisSettings,
    sets: Sequence[Sequence[Session]],
    chain: Chain,
    couplings: Sequence[Coupling] = (),
) -> DiagnosisSettings:
    """`settled` for the first of several sets of one arm, leaving out what any of them asks for.

    Presliding and the friction of slow motion are the drives'; a set whose motion does not show them leaves nothing
    out.
    """
    first, *others = [settled(settings, sessions, chain, couplings, healthy=True) for sessions in sets]
    chosen = [one.signals for one in (first, *others)]
    signals = replace(
        first.signals,
        reversal_s=max(one.reversal for one in chosen),
        turning_rad=max(one.turning for one in chosen),
        slow_rad_s=max(one.slow for one in chosen),
    )
    return replace(first, signals=signals)


def record(
    session: Session,
    number: int,
    chain: Chain,
    settings: DiagnosisSettings,
    *,
    test: bool = False,
    recall: Recall | None = None,
) -> SessionRecord:
    """Filter one session. recall : as for `prepare`. Raises DataError for sessions without a stretch long enough."""
    chosen = session.select(chain.joint_names)
    rate = 1.0 / chosen.joint.period_s
    # A diagnosis chooses the settings of its signals itself.
    prepared = prepare(chosen, settings.signals.punctual, advise=False, recall=recall)
    motor = chosen.motor
    stuck = () if motor is None else stuck_at(motor, chosen.joint)
    stretches = tuple(_stretches(prepared, rate, stuck))
    if not stretches:
        raise DataError(f"{prepared.name}: no stretch of the session is long enough for a diagnosis")
    spans = chosen.spans("period")
    first, last = stretches[0].time[0], stretches[-1].time[-1]
    return SessionRecord(
        name=prepared.name,
        number=number,
        payload=payload_name(chosen),
        payload_mass=stated_mass(chosen),
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
        begun_s=chosen.start * 1e-9,
    )


def _stretches(prepared: PreparedSession, rate: float, stuck: Sequence[Stuck]) -> list[RecordStretch]:
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
            usable = ~m.flagged[keep]
            for one in stuck:
                usable[:, one.joint] &= motor[:, one.joint] != one.value
        time, q, qd, qdd, effort = (
            x[pick] for x in (joint.times, joint.q, joint.qd, joint.qdd, joint.torque)
        )
        known = ~joint.flagged[pick]
        q, qd, qdd, effort = (stored([x]) for x in (q, qd, qdd, effort))
        found.append(RecordStretch(time, q, qd, qdd, effort, known, motor_time, motor, usable))
    return found


def sensor_limits(records: Sequence[SessionRecord], joints: int) -> Floats:
    """Torque (n,) [Nm] at the limit of each joint's sensor, equal in the sessions with a limit, else NaN."""
    limits = np.array([r.clipped for r in records if r.has_effort])
    if not limits.size:
        return np.full(joints, np.nan)
    low = np.min(np.where(np.isfinite(limits), limits, np.inf), axis=0)
    high = np.max(np.where(np.isfinite(limits), limits, -np.inf), axis=0)
    return np.where((high > 0.0) & (high - low <= _ONE_LIMIT * high), high, np.nan)
