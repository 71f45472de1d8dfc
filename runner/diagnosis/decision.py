"""What the deciding motions said about causes that looked alike before."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

from ident.diagnosis import Diagnosis, Finding
from ident.effects.words import joints_text
from runner.diagnosis.deciding import SURE, open_findings

__all__ = ["Answer", "decision_text", "decisions"]

Place = tuple[str, tuple[int, ...]]


@dataclass(frozen=True)
class Answer:
    """One question of the first diagnosis and what the second one says.

    rivals : (cause, joints from 1) that were open, the better one first. outcome : `decided` for one of them,
    still `open`, or `neither`. named : the one that the second diagnosis names, or what it names instead.
    """

    rivals: tuple[Place, ...]
    outcome: Literal["decided", "open", "neither"]
    named: Place | None
    confidence: float

    def text(self, names: Sequence[str]) -> str:
        """The answer in a sentence."""
        asked = " or ".join(_said(place, names) for place in self.rivals)
        if self.outcome == "decided" and self.named is not None:
            return f"decided: {_said(self.named, names)}, confidence {self.confidence:.2f}; asked was {asked}"
        if self.outcome == "open" and self.named is not None:
            better = f"{_said(self.named, names)} is the better now, confidence {self.confidence:.2f}"
            return f"still open after the deciding motions: {asked}; {better}"
        instead = "nothing" if self.named is None else _said(self.named, names)
        return f"decided against all that was asked ({asked}); found instead: {instead}"

    def to_dict(self) -> dict[str, Any]:
        """Plain content."""
        return {
            "rivals": [{"cause": cause, "joints": list(joints)} for cause, joints in self.rivals],
            "outcome": self.outcome,
            "named": None if self.named is None else {"cause": self.named[0], "joints": list(self.named[1])},
            "confidence": self.confidence,
        }


def decisions(before: Diagnosis, after: Diagnosis, sure: float = SURE) -> tuple[Answer, ...]:
    """One answer for each finding that was open before. sure : confidence that decides."""
    found = []
    for finding in open_findings(before, sure):
        rivals = (_place(finding), *((cause, joints) for cause, joints, _ in finding.alternatives))
        rivals = tuple(dict.fromkeys(rivals))
        mine = [f for f in after.findings if _place(f) in rivals]
        certain = [f for f in mine if f.confidence >= sure]
        if certain:
            found.append(Answer(rivals, "decided", _place(certain[0]), certain[0].confidence))
        elif mine:
            found.append(Answer(rivals, "open", _place(mine[0]), mine[0].confidence))
        else:
            joints = {joint for _, places in rivals for joint in places}
            other = next((f for f in after.findings if set(f.joints) & joints), None)
            named = None if other is None else _place(other)
            found.append(Answer(rivals, "neither", named, 0.0 if other is None else other.confidence))
    return tuple(found)


def decision_text(answers: Sequence[Answer], names: Sequence[str]) -> str:
    """All answers, a line each."""
    return "\n".join(answer.text(names) for answer in answers)


def _place(finding: Finding) -> Place:
    return finding.cause, tuple(finding.joints)


def _said(place: Place, names: Sequence[str]) -> str:
    return f"{place[0]} ({joints_text(place[1], names)})"
