"""Discriminating experiments: motions to decide between look-alikes, planned, checked, and their effect foreseen."""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fri.errors import ConfigurationError, DataError, LwrError, RefusedError
from ident.diagnosis import ArmData, Diagnosis, Finding, Reference
from ident.diagnosis.outcome.claims_in_words import SURE, is_open
from ident.diagnosis.outcome.look_alikes import Foreseen, LookAlikes, Place
from ident.diagnosis.outcome.signatures import overlap, signature_bench, signatures
from ident.dynamics.kinematics import Chain
from ident.effects import EFFECTS, WEAR
from ident.effects import Discriminator as Kind
from ident.excitation import ExcitationPlan
from ident.excitation.motions import ParametricMotion
from ident.model import DynamicModel
from lwr_driver.arm import Arm
from lwr_driver.arm.cell import Cell
from lwr_driver.configuration import CONFIGS
from lwr_driver.session import JointColumns, Phase, Session
from runner.diagnosis.motions import chirp, poses, reversal_ladder, slow_sweep
from runner.experiment_file import Experiment, Payload, SessionPlan
from runner.planning import checker, excitation_rows, plan_excitation, session_motion

log = logging.getLogger(__name__)

Floats = NDArray[np.float64]

PAUSE_NS = 10_000_000_000
"""Between the sessions before and a further one, whose clock may begin anew."""

# Motions of the whole arm; the last two repeat the exciting motion.
_AGAIN = (Kind.REPEATED_RUN, Kind.HOT_AND_COLD)
_OF_THE_ARM = (Kind.STATIC_POSES, *_AGAIN)
_WARM_PERIODS = 4
_SPANS = (0.9, 0.6, 0.4, 0.25)
_SPREADS = (0.6, 0.4, 0.25)
_CHECK_S = 5e-3
_MOST = 3

_PERIOD_S = 5e-3
_ROW_S = 0.02
_LEAST_NM = 1e-3


@dataclass(frozen=True, eq=False)
class Discriminating:
    """A discriminating experiment.

    name : of its sessions and file. joint : from 1, None for the whole arm. payloads : one session with each.
    rivals : the causes to decide between.
    """

    name: str
    kind: Kind
    joint: int | None
    plan: ExcitationPlan
    payloads: tuple[Payload | None, ...]
    rivals: tuple[Place, ...]

    @property
    def file(self) -> str:
        """Name of the plan file."""
        return f"{self.name}.plan.yaml"

    @property
    def sessions(self) -> tuple[SessionPlan, ...]:
        """One session for each payload."""
        if len(self.payloads) == 1:
            return (SessionPlan(self.name, self.payloads[0]),)
        return tuple(
            SessionPlan(f"{self.name}-{'bare' if payload is None else payload.name}", payload)
            for payload in self.payloads
        )

    def to_dict(self) -> dict[str, Any]:
        """Plain content."""
        return {
            "file": self.file,
            "kind": self.kind.value,
            "joint": self.joint,
            "duration_s": self.plan.duration_s,
            "payloads": [None if payload is None else payload.name for payload in self.payloads],
            "rivals": [{"cause": cause, "joints": list(joints)} for cause, joints in self.rivals],
        }


def open_findings(diagnosis: Diagnosis, sure: float = SURE) -> tuple[Finding, ...]:
    """The findings open between look-alikes: with alternatives and of a confidence below `sure`."""
    return tuple(f for f in diagnosis.claims if is_open(f.confidence, f.alternatives, sure))


def offers(
    diagnosis: Diagnosis, experiment: Experiment, arm: Arm, cell: Cell, exciting: ExcitationPlan
) -> tuple[Discriminating, ...]:
    """Discriminating experiments for the open findings, checked against limits, torque, cell and guards.

    At most three. A motion without any acceptable size is left out, with a line in the log.
    """
    found: dict[str, Discriminating] = {}
    refused: list[tuple[str, tuple[Payload | None, ...]]] = []
    for finding in open_findings(diagnosis, experiment.diagnosis.sure):
        rivals = ((finding.cause, finding.joints), *((c, j) for c, j, _ in finding.alternatives))
        for cause, joints in rivals:
            if cause == WEAR:
                # Decided by the experiments of its rivals.
                continue
            kind = EFFECTS[cause].experiment
            joint = joints[0] if joints else None
            if len(found) >= _MOST:
                continue
            name = _name(kind, joint)
            if name in found:
                known = found[name]
                found[name] = replace(known, rivals=tuple(dict.fromkeys((*known.rivals, *rivals))))
                continue
            loads = _payloads(experiment, [c for c, _ in rivals])
            if (name, loads) in refused:
                continue
            plan = _plan(kind, joint, experiment, arm, cell, exciting, loads)
            if plan is None:
                refused.append((name, loads))
            else:
                found[name] = Discriminating(name, kind, joint, plan, loads, rivals)
    return tuple(found.values())


def offers_after_logs(diagnosis: Diagnosis, experiment: Experiment | None) -> tuple[Discriminating, ...]:
    """The same for logs of an experiment; none without its file."""
    if experiment is None or not any(finding.alternatives for finding in diagnosis.claims):
        return ()
    try:
        arm = Arm.load(experiment.arm, beside=CONFIGS)
        cell = Cell.load(experiment.cell, beside=CONFIGS)
        return offers(diagnosis, experiment, arm, cell, plan_excitation(experiment, arm, cell))
    except LwrError as error:
        log.info("no discriminating experiment: %s", error)
        return ()


def foresee(
    pairs: Sequence[LookAlikes],
    diagnosis: Diagnosis,
    sessions: Sequence[Session],
    chain: Chain,
    experiments: Sequence[Discriminating],
    arm: ArmData | None = None,
    reference: Reference | None = None,
) -> tuple[LookAlikes, ...]:
    """The pairs with their expected overlap once the discriminating experiments about them are recorded.

    The predicted sessions have the base model's torque and the noise of the sessions at hand.
    """
    found = list(pairs)
    for experiment in experiments:
        mine = [k for k, pair in enumerate(found) if pair.about(experiment.rivals)]
        if not mine:
            continue
        last = max(int(session.joint.log_time[-1]) for session in sessions)
        further: list[Session] = []
        for payload in experiment.payloads:
            start = last + PAUSE_NS
            further.append(made_up(diagnosis, diagnosis.base_model, experiment, payload, sessions, start))
            last = int(further[-1].joint.log_time[-1])
        try:
            bench = signature_bench(
                [*sessions, *further], chain, arm=arm, reference=reference, broken=diagnosis.data
            )
            for k in mine:
                pair = found[k]
                a, b = signatures(
                    bench, [pair.first, pair.second], parameters=pair.parameters, forms=pair.forms
                )
                seen = Foreseen(experiment.file, overlap(a, b), a.strength)
                if pair.foreseen is None or seen.apart > pair.foreseen.apart:
                    found[k] = replace(pair, foreseen=seen)
        except DataError as error:
            log.info("%s cannot be foreseen: %s", experiment.name, error)
    return tuple(found)


def made_up(
    diagnosis: Diagnosis,
    model: DynamicModel,
    experiment: Discriminating,
    payload: Payload | None,
    sessions: Sequence[Session],
    start: int,
) -> Session:
    """A session as predicted by a model, with the noise of a diagnosis, from `start` [ns] on."""
    names = model.structure.chain.joint_names
    name = "none" if payload is None else payload.name
    mounted = name if name in model.structure.payloads else None
    plan = experiment.plan
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
    return Session(Path(f"{experiment.name}.mcap"), metadata, {}, names, joint, motor, phases=phases)


def _name(kind: Kind, joint: int | None) -> str:
    plain = kind.value.replace(" ", "_")
    return plain if joint is None or kind in _OF_THE_ARM else f"{plain}_{joint}"


def _payloads(experiment: Experiment, causes: Sequence[str]) -> tuple[Payload | None, ...]:
    """Every payload of the experiment for causes that depend on the load, else the last one mounted."""
    used = list(dict.fromkeys(session.payload for session in experiment.sessions))
    last = experiment.sessions[-1].payload
    if not any(cause in EFFECTS and EFFECTS[cause].every_payload for cause in causes):
        return (last,)
    return (last, *(payload for payload in used if payload != last))


def _plan(
    kind: Kind,
    joint: int | None,
    experiment: Experiment,
    arm: Arm,
    cell: Cell,
    exciting: ExcitationPlan,
    loads: Sequence[Payload | None],
) -> ExcitationPlan | None:
    """The motion in its largest size with every check passed with every payload."""
    provenance = {"made_by": "diagnosis", "kind": kind.value, "joint": joint}
    if kind in _AGAIN:
        periods = _WARM_PERIODS if kind is Kind.HOT_AND_COLD else max(1, experiment.excitation.periods)
        return dataclasses.replace(exciting, periods=periods, provenance=provenance)
    home = experiment.home(len(arm.joint_names))
    for make in _sizes(kind, joint, arm, cell, experiment, home, loads):
        try:
            plan = ExcitationPlan(make(), arm.joint_names, 1, provenance=provenance)
            rows = excitation_rows(plan, 1)(_CHECK_S)
            checks = [SessionPlan("check", load) for load in loads]
            if all(session_motion(experiment, arm, cell, one, rows, home)[1].ok for one in checks):
                return plan
        except (RefusedError, ConfigurationError) as error:
            log.info("%s: %s", kind.value, error)
    log.info("no %s passes every check", kind.value)
    return None


def _sizes(
    kind: Kind,
    joint: int | None,
    arm: Arm,
    cell: Cell,
    experiment: Experiment,
    home: Floats,
    loads: Sequence[Payload | None],
) -> list[Callable[[], ParametricMotion]]:
    """The motion in several sizes, the largest first."""
    one = 3 if joint is None else joint - 1
    if kind is Kind.STATIC_POSES:
        margin = max(experiment.moves.clearance_m, cell.margin_m)
        watches = [checker(arm, cell, payload) for payload in loads]

        def free(pose: Floats) -> bool:
            return all(watch.clearance(pose).distance > margin for watch in watches)

        return [lambda spread=spread: poses(arm, home, spread, free) for spread in _SPREADS]  # type: ignore[misc]
    make = {Kind.SLOW_SWEEP: slow_sweep, Kind.REVERSAL_LADDER: reversal_ladder, Kind.CHIRP: chirp}[kind]
    return [lambda span=span: make(arm, home, one, span) for span in _SPANS]  # type: ignore[misc]
