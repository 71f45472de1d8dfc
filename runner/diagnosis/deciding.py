"""Where causes look alike: the motion that would decide, as a plan that is checked like any other."""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from fri.errors import ConfigurationError, LwrError, RefusedError
from ident.diagnosis import Diagnosis, Finding
from ident.effects import EFFECTS
from ident.effects import Experiment as Discriminating
from ident.excitation import ExcitationPlan
from ident.excitation.motions import ParametricMotion
from lwr_driver.arm import Arm
from lwr_driver.arm.cell import Cell
from lwr_driver.configuration import parse
from lwr_driver.motion import Motion
from lwr_driver.session import Session
from runner.diagnosis.deciding_motions import chirp, poses, reversal_ladder, slow_sweep
from runner.experiment_file import Experiment, Payload, SessionPlan
from runner.planning import checker, excitation_rows, plan_excitation, session_motion

__all__ = ["SURE", "Deciding", "offers", "offers_of_sessions", "open_findings"]

log = logging.getLogger(__name__)

Floats = NDArray[np.float64]

SURE = 0.8
"""Confidence below which a finding is open between look-alikes."""

# Motions of the whole arm, and those that run the exciting motion itself.
_AGAIN = (Discriminating.REPEATED_RUN, Discriminating.HOT_AND_COLD)
_OF_THE_ARM = (Discriminating.STATIC_POSES, *_AGAIN)
_WARM_PERIODS = 4
_REACHES = (0.9, 0.6, 0.4, 0.25)
_SPREADS = (0.6, 0.4, 0.25)
_CHECK_S = 5e-3
_MOST = 3


@dataclass(frozen=True, eq=False)
class Deciding:
    """A motion that would decide between causes.

    name : of its sessions and file. joint : from 1, None for the whole arm. payloads : it is run with each.
    rivals : (cause, joints) that it is about.
    """

    name: str
    kind: Discriminating
    joint: int | None
    plan: ExcitationPlan
    payloads: tuple[Payload | None, ...]
    rivals: tuple[tuple[str, tuple[int, ...]], ...]

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

    def __str__(self) -> str:
        where = "" if self.joint is None else f" of {self.plan.joint_names[self.joint - 1]}"
        loads = " and ".join("bare" if p is None else f"with {p.name}" for p in self.payloads)
        causes = " or ".join(dict.fromkeys(cause for cause, _ in self.rivals))
        return f"{self.kind.value}{where}, {self.plan.duration_s:.0f} s, {loads} ({causes}): {self.file}"

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
    """The findings that these data leave open between look-alikes: of a confidence below `sure`."""
    return tuple(f for f in diagnosis.findings if f.confidence < sure and f.alternatives)


def offers(
    diagnosis: Diagnosis, experiment: Experiment, arm: Arm, cell: Cell, exciting: ExcitationPlan
) -> tuple[Deciding, ...]:
    """The motions that would decide the open findings, each checked against limits, torque, cell and guards.

    A motion that no size of passes is left out, with a line in the log. At most three.
    """
    found: dict[str, Deciding] = {}
    for finding in open_findings(diagnosis, experiment.diagnosis.sure):
        rivals = ((finding.cause, finding.joints), *((c, j) for c, j, _ in finding.alternatives))
        for cause, joints in rivals:
            kind = EFFECTS[cause].experiment
            joint = joints[0] if joints else None
            if len(found) >= _MOST:
                continue
            name = _name(kind, joint)
            if name in found:
                known = found[name]
                merged = tuple(dict.fromkeys((*known.rivals, *rivals)))
                found[name] = dataclasses.replace(known, rivals=merged)
                continue
            loads = _payloads(experiment, [c for c, _ in rivals])
            plan = _plan(kind, joint, experiment, arm, cell, exciting, loads)
            if plan is not None:
                found[name] = Deciding(name, kind, joint, plan, loads, rivals)
    return tuple(found.values())


def offers_of_sessions(diagnosis: Diagnosis, sessions: Sequence[Session]) -> tuple[Deciding, ...]:
    """The same for logs of an experiment that carry its file; none for others."""
    text = next(
        (s.attachments["experiment.yaml"] for s in sessions if "experiment.yaml" in s.attachments), None
    )
    if text is None or not any(finding.alternatives for finding in diagnosis.findings):
        return ()
    try:
        experiment = parse(Experiment, yaml.safe_load(text), "experiment.yaml")
        arm, cell = Arm.load(experiment.arm), Cell.load(experiment.cell)
        return offers(diagnosis, experiment, arm, cell, plan_excitation(experiment, arm, cell))
    except (LwrError, yaml.YAMLError) as error:
        log.info("no deciding motion: %s", error)
        return ()


def _name(kind: Discriminating, joint: int | None) -> str:
    plain = kind.value.replace(" ", "_")
    return plain if joint is None or kind in _OF_THE_ARM else f"{plain}_{joint}"


def _payloads(experiment: Experiment, causes: Sequence[str]) -> tuple[Payload | None, ...]:
    """What to run with: every payload of the experiment where the load decides, else the last one mounted."""
    used = list(dict.fromkeys(session.payload for session in experiment.sessions))
    last = experiment.sessions[-1].payload
    if not any(EFFECTS[cause].every_payload for cause in causes):
        return (last,)
    return (last, *(payload for payload in used if payload != last))


def _plan(
    kind: Discriminating,
    joint: int | None,
    experiment: Experiment,
    arm: Arm,
    cell: Cell,
    exciting: ExcitationPlan,
    loads: Sequence[Payload | None],
) -> ExcitationPlan | None:
    """The first size of the motion that passes every check with every payload."""
    provenance = {"made_by": "diagnosis", "kind": kind.value, "joint": joint}
    if kind in _AGAIN:
        periods = (
            _WARM_PERIODS if kind is Discriminating.HOT_AND_COLD else max(1, experiment.excitation.periods)
        )
        return dataclasses.replace(exciting, periods=periods, provenance=provenance)
    home = experiment.home(len(arm.joint_names))
    for make in _sizes(kind, joint, arm, cell, experiment, home, loads):
        try:
            plan = ExcitationPlan(make(), arm.joint_names, 1, provenance=provenance)
            rows = excitation_rows(plan, 1)(_CHECK_S)
            if all(_passes(experiment, arm, cell, payload, rows, home) for payload in loads):
                return plan
        except (RefusedError, ConfigurationError) as error:
            log.info("%s: %s", kind.value, error)
    log.info("no %s passes every check", kind.value)
    return None


def _sizes(
    kind: Discriminating,
    joint: int | None,
    arm: Arm,
    cell: Cell,
    experiment: Experiment,
    home: Floats,
    loads: Sequence[Payload | None],
) -> list[Callable[[], ParametricMotion]]:
    """The motion in several sizes, the largest first."""
    one = 3 if joint is None else joint - 1
    if kind is Discriminating.STATIC_POSES:
        margin = max(experiment.moves.clearance_m, cell.margin_m)
        watches = [checker(arm, cell, payload) for payload in loads]

        def free(pose: Floats) -> bool:
            return all(watch.clearance(pose).distance > margin for watch in watches)

        return [lambda spread=spread: poses(arm, home, spread, free) for spread in _SPREADS]  # type: ignore[misc]
    make = {
        Discriminating.SLOW_SWEEP: slow_sweep,
        Discriminating.REVERSAL_LADDER: reversal_ladder,
        Discriminating.CHIRP: chirp,
    }[kind]
    return [lambda reach=reach: make(arm, home, one, reach) for reach in _REACHES]  # type: ignore[misc]


def _passes(
    experiment: Experiment, arm: Arm, cell: Cell, payload: Payload | None, rows: Motion, home: Floats
) -> bool:
    _, preflight = session_motion(experiment, arm, cell, SessionPlan("check", payload), rows, home)
    return preflight.ok
