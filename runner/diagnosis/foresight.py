"""What a deciding motion is to bring: its session is made up from the model, and the overlap measured with it."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from fri.errors import DataError
from ident.diagnosis import ArmData, Diagnosis, Reference
from ident.diagnosis.signatures import overlap, signature_bench, signatures
from ident.dynamics.kinematics import Chain
from ident.model import DynamicModel
from lwr_driver.session import JointColumns, Phase, Session
from runner.diagnosis.look_alikes import Foreseen, LookAlikes
from runner.experiment_file import Payload

if TYPE_CHECKING:
    from runner.diagnosis.deciding import Deciding

__all__ = ["foresee", "made_up"]

log = logging.getLogger(__name__)

Floats = NDArray[np.float64]

_PERIOD_S = 5e-3
_ROW_S = 0.02
_PAUSE_NS = 10_000_000_000
_LEAST_NM = 1e-3


def foresee(
    pairs: Sequence[LookAlikes],
    diagnosis: Diagnosis,
    sessions: Sequence[Session],
    chain: Chain,
    motions: Sequence[Deciding],
    *,
    arm: ArmData | None = None,
    reference: Reference | None = None,
) -> tuple[LookAlikes, ...]:
    """The pairs with the overlap that is to be expected once the motions that are about them were recorded.

    The made-up sessions have the base model's torque and the noise of the sessions at hand.
    """
    found = list(pairs)
    for motion in motions:
        mine = [k for k, pair in enumerate(found) if pair.about([*motion.rivals])]
        if not mine:
            continue
        last = max(int(session.joint.log_time[-1]) for session in sessions)
        further: list[Session] = []
        for payload in motion.payloads:
            further.append(
                made_up(diagnosis, diagnosis.base_model, motion, payload, sessions, last + _PAUSE_NS)
            )
            last = int(further[-1].joint.log_time[-1])
        try:
            bench = signature_bench([*sessions, *further], chain, arm=arm, reference=reference)
            for k in mine:
                pair = found[k]
                a, b = signatures(
                    bench, [pair.first, pair.second], parameters=pair.parameters, forms=pair.forms
                )
                seen = Foreseen(motion.file, overlap(a, b), a.strength)
                if pair.foreseen is None or seen.apart > pair.foreseen.apart:
                    found[k] = replace(pair, foreseen=seen)
        except DataError as error:
            log.info("%s cannot be foreseen: %s", motion.name, error)
    return tuple(found)


def made_up(
    diagnosis: Diagnosis,
    model: DynamicModel,
    motion: Deciding,
    payload: Payload | None,
    sessions: Sequence[Session],
    start: int,
) -> Session:
    """A session of a motion as a model predicts it, with the noise of a diagnosis, from `start` [ns] on."""
    names = model.structure.chain.joint_names
    name = "none" if payload is None else payload.name
    mounted = name if name in model.structure.payloads else None
    plan = motion.plan
    time = np.arange(0.0, plan.periods * plan.duration_s, _PERIOD_S)
    state = plan.sample(np.mod(time, plan.duration_s))
    random = np.random.default_rng(1)
    stamps = start + np.round(time * 1e9).astype(np.int64)
    sequence = np.arange(1, len(time) + 1)
    empty = np.zeros((len(time), 0))
    effort: dict[str, Floats] = {}
    for side in model.structure.sides:
        if side == "difference":
            continue
        floor = np.nan_to_num(np.asarray(diagnosis.noise_floor[side], dtype=float), nan=_LEAST_NM)
        noise = np.maximum(floor, _LEAST_NM) * np.sqrt(_ROW_S / _PERIOD_S)
        torque = model.torque(state.q, state.qd, state.qdd, payload=mounted, side=side, time=time)
        effort[side] = torque + noise * random.normal(size=torque.shape)
    joint = JointColumns(
        "/joint_states", names, stamps, stamps, sequence, state.q, empty, effort.get("joint", empty)
    )
    motor = None
    if "motor" in effort:
        motor = JointColumns("/motor_states", names, stamps, stamps, sequence, empty, empty, effort["motor"])
    length = round(plan.duration_s * 1e9)
    phases = tuple(Phase(start + k * length, f"period {k + 1}") for k in range(plan.periods))
    metadata = {**sessions[0].metadata, "payload": name}
    return Session(Path(f"{motion.name}.mcap"), metadata, {}, names, joint, motor, phases=phases)
