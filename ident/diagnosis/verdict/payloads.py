"""Payloads that are not the announced ones, from the base parameters of a first fit.

A payload of the healthy arm is tied to its mass. A much heavier or lighter one, under the same label, would pull at
every other parameter and leave its torque to the gains of the sensors. So it is looked for first, by these sessions
alone, told as a finding, and then has a mass of its own. So is a body on the flange in all sessions that none of them
states: held-out rows cannot show it, for the last link's parameters take it up.

A payload counts from what the sessions without one carry. So a body in these alone makes the last link heavier and the
payload lighter by as much: what a session carries beyond what it says is the sum of both.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from ident.diagnosis.gain.products import Floats
from ident.diagnosis.healthy.bench import DiagnosisBench
from ident.diagnosis.healthy.reference import WEIGHED, Reference, announced_masses, last_body
from ident.diagnosis.outcome.result import Finding, FindingEvidence, Value
from ident.diagnosis.rows.recording import SessionRecord
from ident.diagnosis.verdict.confidence import LIMITS, Grounds, probability
from ident.diagnosis.verdict.task import Task
from ident.dynamics.base_set import BaseSet
from ident.effects import PAYLOAD_ERROR
from ident.estimators.estimate import fisher_limit

# Least difference of a mass as a share of the expected one, and the largest probability of such a one by chance.
_OTHER, _ONE_IN = 0.05, 1e-3
# Largest mass, first moments and inertias of an unstated body, as standard deviations [kg, kg m, kg m^2].
_USUAL = np.array([5.0, 1.0, 1.0, 1.0, *[0.3] * 6])
_TOLD = 4
# Least mass of such a body [kg], and in its standard deviations.
_BODY, _CLEAR = 0.1, 2.0
# Least size of a combination of a cause's columns, as a share of its largest one.
_LEAST = 1e-6


@dataclass(frozen=True)
class OtherMass:
    """A payload whose mass by these sessions alone is not the expected one [kg]. std : of the difference; least :
    difference in squares of `std` that is hardly chance. fall : of the chi-square of the rows by the other mass.
    """

    payload: str
    mass: float
    expected: float
    std: float
    least: float
    fall: float

    @property
    def square(self) -> float:
        """The difference in squares of `std`."""
        return ((self.mass - self.expected) / max(self.std, 1e-12)) ** 2

    @property
    def clear(self) -> bool:
        """Whether the difference is of interest, and hardly chance."""
        return abs(self.mass - self.expected) > _OTHER * self.expected and self.square > self.least

    def with_body(self, body: UnstatedBody) -> OtherMass:
        """The same with an unstated body on the last link, which the payload counts from."""
        off = self.mass - self.expected
        both = off + float(body.values[0])
        return replace(
            self,
            mass=self.expected + both,
            std=float(np.hypot(self.std, np.sqrt(body.covariance[0, 0]))),
            fall=self.fall * (both / off) ** 2 if off else self.fall,
        )

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
    with evidence.beside([]):
        values, covariance = evidence.free()
        inverse = evidence.free_inverse()
    healthy = {} if reference is None else _healthy(bench, reference)
    freedom = bench.nominal.arm.chain.n * max(1 if reference is None else reference.sets, 1)
    least = fisher_limit(_ONE_IN, 1, freedom)
    found = []
    for k, (payload, stated) in announced.items():
        expected, usual = healthy.get(k, (stated, (WEIGHED * stated) ** 2))
        std = float(np.sqrt(max(covariance[k, k], 0.0) + usual))
        fall = (float(values[k]) - expected) ** 2 / max(float(inverse[k, k]), 1e-300)
        one = OtherMass(payload, float(values[k]), expected, std, least, fall)
        if one.clear:
            found.append(one)
    return found


@dataclass(frozen=True, eq=False)
class UnstatedBody:
    """A body on the last link in all sessions that neither the healthy arm had nor a session states.

    values : (10,) of `LAST_BODY`, covariance (10, 10). square : mass and first moments in squares of their uncertainty;
    least : the one that is hardly chance. fall : of the chi-square of the rows, held against the arm without it.
    """

    values: Floats
    covariance: Floats
    square: float
    least: float
    fall: float


def unstated_body(bench: DiagnosisBench, reference: Reference) -> UnstatedBody | None:
    """The body by which the base parameters of these sessions alone differ from the healthy arm's, None without one.

    The base parameters take all of it up, so no row shows it. It must be beyond chance beside every other cause that
    would turn the same parameters, in proportion to what these sessions make of it. Where a cause explains more of the
    differences than the body, its values are those beside that cause. What neither explains widens their deviations.
    """
    evidence, base = bench.evidence, bench.nominal.base
    # The limit itself accounts for the few days behind the variances.
    prior = reference.prior(base, bench.nominal.masses, wider=1.0)
    if prior is None or not evidence.compared:
        return None
    with evidence.beside([]):
        values, covariance = evidence.free()
        inverse = evidence.free_inverse()
    precision, healthy = prior
    tied = np.flatnonzero(np.diag(precision) > 0.0)
    spread = covariance[np.ix_(tied, tied)] + np.linalg.inv(precision[np.ix_(tied, tied)])
    white = np.linalg.inv(np.linalg.cholesky(spread))
    body, off = white @ last_body(base)[tied], white @ (values - healthy)[tied]
    freedom = bench.nominal.arm.chain.n * max(reference.sets, 1)
    least = _TOLD * fisher_limit(_ONE_IN, _TOLD, freedom)
    if not _clear(*_solved(body, off), least):
        return None
    others = [
        white @ (inverse @ products.alone.sum(axis=0).T)[tied]
        for candidate in bench.dictionary.candidates
        if candidate.effect is not PAYLOAD_ERROR
        for products in bench.dictionary.products(candidate)
    ]
    strongest = max(others, key=partial(_explained, off), default=None)
    if strongest is not None and _explained(off, strongest) <= _explained(off, body):
        strongest = None
    both = body if strongest is None else np.hstack([body, strongest])
    left = float(off @ off) - _explained(off, both)
    # Days differ by more than the variances of few of them say.
    wider = max(left / max(len(off) - both.shape[1], 1), 1.0)
    found, uncertain = _solved(body, off, strongest)
    uncertain = wider * uncertain
    if not _clear(found, uncertain, least):
        return None
    for turned in others:
        values, covariance = _solved(body, off, turned)
        if _square(values, wider * covariance) <= least:
            return None
    change = last_body(base) @ found
    fall = float(change @ np.linalg.solve(inverse, change))
    return UnstatedBody(found, uncertain, _square(found, uncertain), least, fall)


def _clear(values: Floats, covariance: Floats, least: float) -> bool:
    """Whether a body is beyond chance, and its mass told from zero: first moments alone are as well those of an error
    of sensors or positions."""
    told_from_zero = abs(values[0]) >= max(_BODY, _CLEAR * float(np.sqrt(covariance[0, 0])))
    return told_from_zero and _square(values, covariance) > least


def _explained(off: Floats, columns: Floats) -> float:
    """Fall of the square of differences (p,) of unit variance by columns (p, k)."""
    return float(np.sum(np.square(_directions(columns).T @ off)))


def _directions(columns: Floats) -> Floats:
    """Orthonormal directions (p, r) of columns (p, k)."""
    directions, sizes, _ = np.linalg.svd(columns, full_matrices=False)
    return np.asarray(directions[:, sizes > _LEAST * sizes[0]])


def _solved(body: Floats, off: Floats, beside: Floats | None = None) -> tuple[Floats, Floats]:
    """Parameters (10,) of a body and their covariance, from differences `off` (p,) of unit variance and their columns
    `body` (p, 10); beside : further columns (p, k)."""
    if beside is not None:
        # What another cause explains is left out of both.
        other = _directions(beside)
        body, off = body - other @ (other.T @ body), off - other @ (other.T @ off)
    covariance: Floats = np.asarray(np.linalg.inv(body.T @ body + np.diag(_USUAL**-2.0)), dtype=np.float64)
    return np.asarray(covariance @ (body.T @ off)), covariance


def _square(values: Floats, covariance: Floats) -> float:
    told = values[:_TOLD]
    return float(told @ np.linalg.solve(covariance[:_TOLD, :_TOLD], told))


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


def payload_findings(
    others: Sequence[OtherMass], body: UnstatedBody | None, records: Sequence[SessionRecord]
) -> list[Finding]:
    """The findings of payloads of another mass and of a body that no session states, each with the sessions that carry
    it. others : masses on a last link without the body."""
    mounted = {name: [r.name for r in records if r.payload == name] for name in {r.payload for r in records}}
    if body is None:
        return [payload_finding(one, mounted.get(one.payload, ())) for one in others]
    carried = [one.with_body(body) for one in others]
    found = [payload_finding(one, mounted.get(one.payload, ())) for one in carried if one.clear]
    known = {one.payload for one in others}
    bearing = [r.name for r in records if r.payload not in known]
    # Each of the payloads is told by itself, and none of the sessions is left with the body.
    return [*found, payload_finding(body, bearing)] if bearing else found


def payload_finding(one: OtherMass | UnstatedBody, sessions: Sequence[str] = ()) -> Finding:
    """The finding of a payload of another mass, or of a body that no session states. sessions : that carry it."""
    if isinstance(one, OtherMass):
        parameters = {"mass": Value(one.mass - one.expected, one.std, "kg")}
    else:
        stds = np.sqrt(np.diag(one.covariance)).tolist()
        known = zip(PAYLOAD_ERROR.parameters, one.values.tolist(), stds, strict=False)
        parameters = {p.name: Value(value, std, p.unit) for p, value, std in known}
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
        parameters=parameters,
        evidence=FindingEvidence.counted(-one.square),
        confidence=probability(grounds),
        tell_apart=PAYLOAD_ERROR.tell_apart,
        gain=one.fall,
        grounds=grounds.to_dict(),
        sessions=tuple(sessions),
        payload=one.payload if isinstance(one, OtherMass) else None,
    )


def with_masses(task: Task, found: Mapping[str, float]) -> Task:
    """The task with other masses [kg] of payloads, by name: none of their parameters is the healthy arm's."""
    recordings = tuple(
        replace(one, payload_mass=found.get(one.payload or "", one.payload_mass)) for one in task.recordings
    )
    return replace(task, recordings=recordings)
