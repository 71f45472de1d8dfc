"""Payloads that are not the announced ones, from the base parameters of a first fit.

A payload of the healthy arm is tied to its mass. A much heavier or lighter one, under the same label, would pull at
every other parameter and leave its torque to the gains of the sensors. So it is looked for first, by these sessions
alone, told as a finding, and then has a mass of its own.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from ident.diagnosis.bench import DiagnosisBench
from ident.diagnosis.confidence import LIMITS, Grounds, probability
from ident.diagnosis.reference import WEIGHED, Reference, announced_masses
from ident.diagnosis.result import Evident, Finding, Value
from ident.diagnosis.task import Task
from ident.dynamics.base_set import BaseSet
from ident.effects import PAYLOAD_ERROR
from ident.estimators.estimate import fisher_limit

# Least difference of a mass as a share of the expected one, and the largest probability of such a one by chance.
_OTHER, _ONE_IN = 0.05, 1e-3


@dataclass(frozen=True)
class OtherMass:
    """A payload whose mass by these sessions alone is not the expected one [kg]. std : of the difference; least :
    difference in squares of `std` that is hardly chance.
    """

    payload: str
    mass: float
    expected: float
    std: float
    least: float

    @property
    def square(self) -> float:
        """The difference in squares of `std`."""
        return ((self.mass - self.expected) / max(self.std, 1e-12)) ** 2

    @property
    def text(self) -> str:
        """For a note."""
        return (
            f"payload {self.payload!r}: {self.mass:.3f} ± {self.std:.3f} kg by these sessions alone, "
            f"{self.expected:.3f} kg expected; check the mounted payload first, a wrong one leads to false causes"
        )


def other_masses(bench: DiagnosisBench, reference: Reference | None) -> list[OtherMass]:
    """The payloads of another mass than the healthy arm's, or than the announced one."""
    evidence, base = bench.evidence, bench.nominal.base
    announced = announced_masses(base, bench.nominal.masses)
    if not announced:
        return []
    kept = list(evidence.extra)
    evidence.replace([])
    values, covariance = evidence.free()
    evidence.replace(kept)
    healthy = {} if reference is None else _healthy(bench, reference)
    freedom = bench.nominal.arm.chain.n * max(1 if reference is None else reference.sets, 1)
    least = fisher_limit(_ONE_IN, 1, freedom)
    found = []
    for k, (payload, stated) in announced.items():
        expected, usual = healthy.get(k, (stated, (WEIGHED * stated) ** 2))
        std = float(np.sqrt(max(covariance[k, k], 0.0) + usual))
        one = OtherMass(payload, float(values[k]), expected, std, least)
        if abs(one.mass - expected) > _OTHER * expected and one.square > least:
            found.append(one)
    return found


def unchecked_masses(base: BaseSet, masses: Mapping[str, float | None], reference: Reference) -> list[str]:
    """Payloads with a stated mass [kg] that nothing is held against: not the healthy arm's, and in one base parameter
    with the last link."""
    checked = {payload for payload, _ in announced_masses(base, masses).values()}
    own = reference.masses
    same = {name for name in own if masses.get(name) is None or own[name] in (None, masses[name])}
    return [name for name, mass in masses.items() if mass and name not in checked | same]


def _healthy(bench: DiagnosisBench, reference: Reference) -> dict[int, tuple[float, float]]:
    """Value and variance on the healthy arm of the base parameters shared with it, by place."""
    own = reference.model
    if own.covariance is None:
        return {}
    pairs = reference.common(bench.nominal.base, bench.nominal.masses)
    return {b: (float(own.values[a]), float(own.covariance[a, a])) for a, b in pairs}


def payload_finding(one: OtherMass) -> Finding:
    """The finding of a payload of another mass."""
    grounds = Grounds(
        gain=float(np.log(one.square / one.least)),
        significance=LIMITS["significance"][1],
        rivals=LIMITS["rivals"][1],
        held_out=0.0,
        untested=1.0,
        felt=0.0,
        one_block=0.0,
        worse=0.0,
    )
    return Finding(
        PAYLOAD_ERROR.cause,
        PAYLOAD_ERROR.side,
        (),
        {"mass": Value(one.mass - one.expected, one.std, "kg")},
        Evident(-one.square, 1e-12, 0.0, 0.0, (0.0, 0.0)),
        probability(grounds),
        (),
        PAYLOAD_ERROR.tell_apart,
        one.square,
        grounds=grounds.to_dict(),
    )


def with_masses(task: Task, found: Mapping[str, float]) -> Task:
    """The task with other masses [kg] of payloads, by name: none of their parameters is the healthy arm's."""
    recordings = tuple(
        replace(one, payload_mass=found.get(one.payload or "", one.payload_mass)) for one in task.recordings
    )
    return replace(task, recordings=recordings)
