"""Channels in doubt that nothing confirms as broken: what a diagnosis may still claim beside them.

Their rows stay, for a doubt may be wrong. No cause that they take part in is sure then, and no payload is claimed: it
is told by all torques together, and one wrong torque looks like a mass. An error of the channel itself is what the
doubt says, too.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

from ident.diagnosis.outcome.result import Diagnosis, Finding
from ident.diagnosis.rows.broken_data import BrokenChannel
from ident.diagnosis.verdict.confidence import OPEN
from ident.diagnosis.verdict.task import Task
from ident.effects import (
    DELAYS,
    ECCENTRICITY,
    EFFECTS,
    LOST_SAMPLES,
    MOTOR_GAIN,
    PAYLOAD_CHANGE,
    PAYLOAD_ERROR,
    SENSOR_SATURATION,
    ZERO_OFFSET,
)
from ident.screening.doubts import Doubt, late_positions

# Causes that are an error of the channel itself.
_OWN: Mapping[str, tuple[str, ...]] = {
    "motor torque": (MOTOR_GAIN.cause, DELAYS["motor"].cause),
    "joint torque": tuple(cause for cause, effect in EFFECTS.items() if effect.side == "sensor"),
    "position": (ZERO_OFFSET.cause, ECCENTRICITY.cause),
    "time": tuple(effect.cause for effect in DELAYS.values()),
}
# Counted in the samples, not told by torques.
_COUNTED = (LOST_SAMPLES.cause, SENSOR_SATURATION.cause)
_PAYLOADS = (PAYLOAD_ERROR.cause, PAYLOAD_CHANGE.cause)


def bending(doubts: Sequence[Doubt]) -> tuple[Doubt, ...]:
    """Those that would bend the rows: of torques, positions and time. Samples at a limit are left out already."""
    return tuple(one for one in doubts if one.channel in _OWN and one.kind != "saturation")


def unconfirmed(
    doubts: Sequence[Doubt], broken: Sequence[BrokenChannel], names: Sequence[str]
) -> tuple[Doubt, ...]:
    """Those about another channel than the broken ones. names : of the joints."""
    known = {(one.channel, names[one.joint - 1]) for one in broken if one.joint is not None}
    return tuple(
        one
        for one in doubts
        if not one.joints or not any((one.channel, joint) in known for joint in one.joints)
    )


def without_payloads(task: Task) -> Task:
    """The task without a claim of a payload."""
    return replace(task, causes=[cause for cause in task.causes or EFFECTS if cause not in _PAYLOADS])


def held_back(found: Diagnosis, doubts: Sequence[Doubt], names: Sequence[str]) -> Diagnosis:
    """The diagnosis with no sure claim from the channels in doubt, and a note on each. names : of the joints."""

    def less_sure(finding: Finding) -> Finding:
        unsure = any(_bears(one, finding, names) for one in bending(doubts))
        return replace(finding, confidence=min(finding.confidence, OPEN)) if unsure else finding

    notes = [f"{one}. The channel stays, and no cause beside it is sure" for one in bending(doubts)]
    notes += [str(one) for one in doubts if one not in bending(doubts)]
    return replace(
        found,
        findings=tuple(map(less_sure, found.findings)),
        character=tuple(map(less_sure, found.character)),
        notes=(*found.notes, *dict.fromkeys(notes)),
    )


def _bears(doubt: Doubt, finding: Finding, names: Sequence[str]) -> bool:
    """Whether a finding rests on the channel in doubt, and is no error of it."""
    # Positions that are late by the torques are torques that are early.
    of_time = _OWN["time"] if late_positions([doubt]) else ()
    if finding.cause in (*_OWN[doubt.channel], *of_time, *_COUNTED):
        return False
    return not doubt.joints or not finding.joints or any(names[j - 1] in doubt.joints for j in finding.joints)
