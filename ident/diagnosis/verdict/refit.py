"""The models of a diagnosis without a healthy arm, estimated as `lwr-run identify` does.

Without a healthy arm, and without a motion that repeats, the least squares of the evidence lean on the drawing of the
arm, with equal trust in each body. `identify` chooses estimator, prior and tilt by what they predict, with physically
consistent bodies. So it makes both models: the base model from the torques as measured, the extended one from the
torques less those of the effects, which are added again. A leaning base and gains of the torque sensors are left to it:
it weighs both against all other parameters.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from ident.diagnosis.gain.held_out import HeldOut
from ident.diagnosis.gain.products import Floats
from ident.diagnosis.rows.nominal import Nominal
from ident.diagnosis.rows.recording import RecordStretch
from ident.diagnosis.verdict.task import Task
from ident.dynamics.structure import DriveMotion, Side
from ident.effects import BASE_TILT, SENSOR_GAIN, Column, effects_torque
from ident.effects.motion import ArmMotion
from ident.estimation.automatic import choose
from ident.estimation.choice import Choice
from ident.estimation.identification import Identification, IdentificationSettings, Known
from ident.estimators.names import AUTO
from ident.model import DynamicModel
from ident.rows.prepare import clock_ns
from lwr_driver.session import JointColumns, Session
from lwr_driver.session.spool import stored

Entries = tuple[Mapping[str, Any], ...]

BY_IDENTIFY = (BASE_TILT.cause, SENSOR_GAIN.cause)
"""Causes that `identify` looks for by itself, see `ident.estimation.automatic`."""


def refitted(task: Task, nominal: Nominal, effects: Entries) -> tuple[DynamicModel, Iterator[DynamicModel]]:
    """Base model by `identify`'s own choice of the estimator, and ways to the extended model with `effects`: by the
    same choice, for another prior or tilt changes the rows of all joints, then by a choice of its own.

    Raises DataError for sessions that `identify` refuses.
    """
    base = _identified(task, nominal, task.sessions)
    effects = tuple(e for e in effects if e["cause"] not in BY_IDENTIFY)
    return base.model, _extended(task, nominal, base, effects)


def _extended(task: Task, nominal: Nominal, base: Identification, effects: Entries) -> Iterator[DynamicModel]:
    if not effects:
        yield base.model
        return
    sessions = _without(task, nominal, effects)
    for like in (base.choice, None):
        found = _identified(task, nominal, sessions, like).model
        yield replace(found, effects=(*found.effects, *effects))


def _identified(
    task: Task, nominal: Nominal, sessions: Sequence[Session], like: Choice | None = None
) -> Identification:
    structure = nominal.structure
    settings = IdentificationSettings(
        model=structure.model,
        signals=task.settings.signals,
        estimator=AUTO,
        without=structure.without,
        couplings=structure.couplings,
        coulomb=task.settings.law,
        row_coulomb=task.settings.row_law,
        essential=None,
    )
    chosen = Known(signal_reasons=("signal settings of the diagnosis",))
    return choose(sessions, structure.chain, settings, known=chosen, like=like)


def _without(task: Task, nominal: Nominal, effects: Entries) -> list[Session]:
    """The fitted sessions with torques less those of the effects."""
    found = []
    for recording, session in zip(nominal.recordings, task.everything, strict=True):
        if recording.test:
            continue
        session = session.select(nominal.arm.chain.joint_names)
        origin = int(clock_ns(session.joint)[0])
        motions = [
            (stretch, motion)
            for motion, (owner, stretch) in zip(nominal.motions, nominal.stretches, strict=True)
            if owner is recording
        ]
        joint, motor = session.joint, session.motor
        if recording.has_effort:
            joint = _less(joint, "joint", origin, motions, effects)
        if motor is not None and recording.has_motor:
            motor = _less(motor, "motor", origin, motions, effects)
        found.append(replace(session, joint=joint, motor=motor))
    return found


def _less(
    columns: JointColumns,
    side: Side,
    origin: int,
    motions: Sequence[tuple[RecordStretch, ArmMotion]],
    effects: Entries,
) -> JointColumns:
    """The samples with torques less those of the effects, the ends of a stretch held beyond it."""
    times = (clock_ns(columns) - origin) * 1e-9
    starts = np.array([stretch.time[0] for stretch, _ in motions])
    own = np.maximum(np.searchsorted(starts, times, side="right") - 1, 0)
    effort = np.array(columns.effort)
    for number, (stretch, motion) in enumerate(motions):
        here = own == number
        torque = effects_torque(effects, motion, side=side, measured=True)
        for joint in np.flatnonzero(np.any(torque != 0.0, axis=0)):
            effort[here, joint] -= np.interp(times[here], stretch.time, torque[:, joint])
    return replace(columns, effort=stored([effort]))


def left_by(model: DynamicModel, nominal: Nominal, held: HeldOut) -> HeldOut:
    """Residual torque that a model leaves in the held-out rows `held`."""
    payloads = {r.number: r.payload for r in nominal.recordings}

    def predicted(name: str) -> Floats:
        side: Side = "motor" if name == "motor" else "joint"

        def made(motion: ArmMotion) -> tuple[Column, ...]:
            torque = model.linear_torque(
                motion.q,
                motion.qd,
                motion.qdd,
                payload=payloads[motion.session],
                side=side,
                drive=DriveMotion(motion.motor_speed, motion.motor_acceleration),
            ) + effects_torque(model.effects, motion, side=side, measured=True)
            return (Column(motor=torque) if side == "motor" else Column(joint=torque),)

        return nominal.columns(made, [side])[side][0]

    residual = {
        side: np.where(np.isfinite(values), nominal.rows[side].target - predicted(side), np.nan)
        for side, values in held.residual.items()
    }
    return HeldOut(residual, held.block)
