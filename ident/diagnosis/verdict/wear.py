"""Wear: drive parameters of the sessions beside those of the healthy arm.

A change of friction or drive inertia leaves no residual, for the base parameters absorb it. Against a reference it
shows in the parameters themselves: estimated by these sessions alone, beside all claims, their difference from the
healthy ones is compared with both uncertainties and with the arm's changes from day to day (`day_spread.habit`), joint
by joint (Hotelling's T^2). What a claim on the same torque moves in these parameters is no evidence, for its law and
theirs share the friction between them; nor is a change beside a larger remainder without a name: what leaves the
remainder bends the parameters, too. The sensors' gains differ from day to day, and a relative error of a joint's two
channels looks like friction and inertia: these gains are estimated beside, around zero. Friction at another level in
all sessions may be worn or warmer; the same motion cold and warm decides.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from ident.diagnosis.causes.claims import Claim
from ident.diagnosis.causes.probes import Remainder, find_remainders
from ident.diagnosis.causes.tolerances import gain_rows
from ident.diagnosis.gain.held_out import HeldOut
from ident.diagnosis.gain.products import Floats, Rows
from ident.diagnosis.healthy.bench import DiagnosisBench
from ident.diagnosis.healthy.reference import INERTIA_BY_PHASE, Reference, unsure
from ident.diagnosis.outcome.result import Finding, FindingEvidence, Value
from ident.diagnosis.rows.nominal_arm import NominalArm
from ident.diagnosis.verdict.confidence import HARDLY
from ident.effects import FRICTION_TEMPERATURE, WEAR
from ident.effects.course import Course
from ident.estimators.estimate import fisher_limit, fisher_tail

_PARAMETERS = {"Fcm": "coulomb", "Fvm": "viscous", "Ia": "inertia"}
_WORDS = {"inertia": "inertia", "viscous": "viscous friction", "coulomb": "Coulomb friction"}
# Largest probability of such a change in one of the joints on a healthy arm.
_ONE_IN = 0.01
# Least relative change that matters to a user, of the largest parameter.
_MATTERS = 0.03
# Healthy arms for an arm with wear, before the data.
_RARE = 10.0
# Least change of a drive's inertia for a claim of its own, in standard deviations.
_CLEAR = 4.0
# Confidence in wear of friction alone: a drive warmer or colder in all sessions looks the same. And in that of an
# inertia with an unknown stiffness of the joints, whose share in it changes with the motion.
_WORN_OR_WARM = 0.75
_TELL_APART = "the same motion with joint {joint} cold and warm: wear stays, warmth goes"


class Worn(NamedTuple):
    """Findings of changed drives, and the least relative change that could be one, by parameter: the median of the
    joints. sets : of the healthy arm."""

    findings: Sequence[Finding] = ()
    least: Mapping[str, float] = {}
    sets: int = 0

    def notes(self) -> list[str]:
        """What a healthy arm may change by as well."""
        if not self.least:
            return []
        listed = ", ".join(f"{_WORDS[label]} {100.0 * share:.2g} %" for label, share in self.least.items())
        return [
            f"wear of a drive would show from about {listed} on; a smaller change may be that of a healthy arm, as far "
            f"as the days of {self.sets} healthy set{'s' * (self.sets > 1)} tell"
        ]


def is_level(claim: Claim) -> bool:
    """Whether a claim is friction at another level in all sessions: told as wear."""
    same = claim.trial.candidate.cause == FRICTION_TEMPERATURE.cause
    return same and claim.trial.shape.form is Course.SINCE_REFERENCE


def wear(
    bench: DiagnosisBench,
    reference: Reference,
    after: HeldOut,
    claimed: Sequence[Rows],
    tolerated: Sequence[Rows],
    remainders: Sequence[Remainder],
) -> Worn:
    """Findings of changed drives beside claimed and tolerated columns. after : held-out rows with the claims."""
    nominal, evidence = bench.nominal, bench.evidence
    prior = reference.prior(nominal.base, nominal.masses, wider=1.0)
    if prior is None or not reference.sets or "motor" not in nominal.rows:
        return Worn()
    precision, healthy = prior
    known = np.flatnonzero(np.diag(precision) > 0.0)
    spread = np.zeros_like(precision)
    spread[np.ix_(known, known)] = np.linalg.inv(precision[np.ix_(known, known)])
    gains = list(gain_rows(bench.dictionary).values())

    def alone(beside: Sequence[Rows]) -> tuple[Floats, Floats]:
        """Parameters by these sessions beside some claims, and their covariance."""
        evidence.replace([*beside, *tolerated, *gains])
        return evidence.free(gains, reference.gain_std)

    # The shares are those of the friction as a whole.
    whole = nominal.whole_friction(healthy)
    values, covariance = alone(claimed)
    # Motor torques sampled at another phase of the commands show another inertia.
    other = ("Ia",) if nominal.arm.motor_delay_s != reference.motor_delay_s else ()
    found: list[Finding] = []
    least: dict[str, list[float]] = {}
    moving = np.flatnonzero(nominal.moving)
    for joint in moving.tolist():
        names = {
            f"{symbol}{joint + 1}": label for symbol, label in _PARAMETERS.items() if symbol not in other
        }
        places = [k for k in known.tolist() if nominal.base.names[k] in names and whole[k] > 0.0]
        if not places:
            continue
        change = values[places] - healthy[places]
        own = covariance[np.ix_(places, places)] + spread[np.ix_(places, places)]
        others = [rows for rows in claimed if ("motor", joint) not in rows]
        if len(others) < len(claimed):
            moved = values[places] - alone(others)[0][places]
            own = own + np.outer(moved, moved)
        if nominal.slow_motor_samples:
            # The phase of slow samples differs from day to day, evenly.
            drive = np.array([nominal.base.names[k].startswith("Ia") for k in places])
            own = own + np.diag(np.where(drive, INERTIA_BY_PHASE * whole[places], 0.0) ** 2 / 3.0)
        square = float(change @ np.linalg.solve(own, change))
        freedom = max(float(reference.sets * len(moving)), 2.0)
        p_value = min(1.0, len(moving) * fisher_tail(square / len(places), len(places), freedom))
        share, std = change / whole[places], np.sqrt(np.diag(own)) / whole[places]
        labels = [names[nominal.base.names[k]] for k in places]
        limit = np.sqrt(len(places) * fisher_limit(_ONE_IN / len(moving), len(places), freedom))
        for label, one in zip(labels, std.tolist(), strict=True):
            least.setdefault(label, []).append(max(float(limit) * one, _MATTERS))
        if p_value > _ONE_IN or np.max(np.abs(share)) < _MATTERS:
            continue
        sizes = dict(zip(labels, np.abs(share / std).tolist(), strict=True))
        stiff = _stiff(nominal.arm, joint)
        heavier = sizes.get("inertia", 0.0) > max(_CLEAR, 0.5 * max(sizes.values()))
        torque = nominal.rows["motor"].matrix[joint][:, places] @ change
        columns = [*claimed, *tolerated, {("motor", joint): torque[:, None]}]
        rest = _left(bench, reference, columns, remainders, joint)
        sure = max(1.0 - rest / square, 0.0) / (1.0 + _RARE * p_value)
        if sure < HARDLY:
            continue
        before, rms = _errors(bench, after, joint, np.array(places), change)
        found.append(
            Finding(
                WEAR,
                "motor",
                (joint + 1,),
                parameters={
                    label: Value(float(value), float(s), "1")
                    for label, value, s in zip(labels, share, std, strict=True)
                },
                evidence=FindingEvidence(
                    -square, p_value, before, rms, (before - rms, before - rms), (("motor", joint + 1),)
                ),
                confidence=sure if heavier and stiff else min(sure, _WORN_OR_WARM),
                alternatives=() if heavier else ((FRICTION_TEMPERATURE.cause, (joint + 1,), -square),),
                tell_apart=_TELL_APART.format(joint=joint + 1),
                gain=square,
            )
        )
    return Worn(found, {label: float(np.median(some)) for label, some in least.items()}, reference.sets)


def _stiff(arm: NominalArm, joint: int) -> bool:
    """Whether the stiffness is known that a joint's motor works against: its own; behind published motors that of all
    joints, for the links ring on all their springs together."""
    unknown = unsure(arm.compliance, arm.compliance_std)
    known = not (unknown.any() if arm.encoder == "motor" else unknown[joint])
    return known and bool(arm.compliance[joint] > 0.0)


def _left(
    bench: DiagnosisBench,
    reference: Reference,
    columns: Sequence[Rows],
    remainders: Sequence[Remainder],
    joint: int,
) -> float:
    """Gain of the remainders in a joint's torques beside columns with its wear: what its sensor shows acts on the
    drive, too."""

    def mine(found: Sequence[Remainder]) -> float:
        return sum(r.gain for r in found if r.joint - 1 == joint)

    if not mine(remainders):
        return 0.0
    evidence = bench.evidence
    evidence.replace(columns)
    return mine(find_remainders(bench.dictionary, evidence.settings, reference.limits()))


def _errors(
    bench: DiagnosisBench, after: HeldOut, joint: int, places: Floats, change: Floats
) -> tuple[float, float]:
    """Error [Nm] of the joint's motor torque on held-out rows with the healthy drive, and with the one found."""
    residual = after.residual["motor"][:, joint]
    keep = np.isfinite(residual)
    if not keep.any():
        return 0.0, 0.0
    torque = bench.nominal.rows["motor"].matrix[joint][keep][:, places.astype(int)] @ change
    rms = float(np.sqrt(np.mean(residual[keep] ** 2)))
    return float(np.sqrt(np.mean((residual[keep] + torque) ** 2))), rms
