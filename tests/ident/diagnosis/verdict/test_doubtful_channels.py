"""Channels in doubt stay, and no claim beside them is sure."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import pytest

from ident.diagnosis.outcome.result import Finding, FindingEvidence
from ident.diagnosis.rows.broken_data import BrokenChannel
from ident.diagnosis.verdict.confidence import OPEN
from ident.diagnosis.verdict.doubtful_channels import bending, held_back, unconfirmed, without_payloads
from ident.diagnosis.verdict.task import Task
from ident.screening.doubts import MEND_TIME, Doubt

NAMES = ("one", "two", "three")
GAIN = Doubt("motor torque", ("two",), "is 1.8 times the others", "a gain of 1.8", "check", kind="gain")
CLIPPED = Doubt("motor torque", ("one",), "stays at 9 Nm", "saturation", "move gently", kind="saturation")


@dataclass(frozen=True)
class Told:
    findings: tuple[Finding, ...]
    character: tuple[Finding, ...] = ()
    notes: tuple[str, ...] = ("first",)


def claim(cause: str, *joints: int) -> Finding:
    return Finding(
        cause,
        "motor",
        joints,
        parameters={},
        evidence=FindingEvidence.counted(-9.0),
        confidence=0.95,
        tell_apart="",
        gain=9.0,
    )


@pytest.mark.parametrize(
    ("finding", "sure"),
    [
        (claim("wear", 2), False),
        (claim("base_tilt"), False),
        # The other joints' own, what the doubt says itself, and what was counted.
        (claim("wear", 1), True),
        (claim("motor_torque_gain", 2), True),
        (claim("lost_samples"), True),
    ],
)
def test_no_claim_from_a_channel_in_doubt_is_sure(finding: Finding, sure: bool) -> None:
    told: Any = held_back(Told((finding,), (finding,)), [GAIN, CLIPPED], NAMES)  # type: ignore[arg-type]
    confidence = 0.95 if sure else OPEN
    assert [one.confidence for one in (*told.findings, *told.character)] == [confidence, confidence]
    assert told.notes[0] == "first"
    assert told.notes[1].startswith(f"{GAIN}. The channel stays")
    assert told.notes[2] == str(CLIPPED)


def test_late_positions_say_the_same_as_early_torques() -> None:
    late = Doubt("position", ("two",), "contradicts the torques", "positions -16 ms late", MEND_TIME)
    delay, tilt = claim("joint_torque_delay"), claim("base_tilt")
    told: Any = held_back(Told((delay, tilt), ()), [late], NAMES)  # type: ignore[arg-type]
    assert [one.confidence for one in told.findings] == [0.95, OPEN]


def test_samples_at_a_limit_bend_nothing_for_they_are_left_out() -> None:
    stopped = replace(CLIPPED, channel="position", kind="")
    label = Doubt("payload", (), "contradicts its label", "", "name it")
    assert bending([GAIN, CLIPPED, label, stopped]) == (GAIN, stopped)


def test_a_confirmed_doubt_is_told_once() -> None:
    broken = [BrokenChannel("motor torque", 2, "", "")]
    other = replace(GAIN, channel="joint torque")
    whole = replace(GAIN, joints=())
    assert unconfirmed([GAIN, other, whole], broken, NAMES) == (other, whole)


def test_no_payload_is_looked_for_beside_a_channel_in_doubt() -> None:
    task = Task((), (), None, (), None, None, ["wear", "payload_error"], None, None)  # type: ignore[arg-type]
    assert without_payloads(task).causes == ["wear"]
    everything = without_payloads(replace(task, causes=None)).causes
    assert everything is not None
    assert "stribeck" in everything
    assert not {"payload_error", "payload_change"} & set(everything)
