"""A diagnosis against the truth, strictly; only the files that everybody can read are used."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

SURE = 0.8
"""Confidence from which a finding claims its cause; below it says what it may be."""


# Behind the names of what is written of a diagnosis without healthy days.
_ALONE = "_without_reference"
_SIGMAS = 3.0
_AFFECTED = 1.03

Finding = Mapping[str, Any]


def verdict_of(folder: Path, reference: bool = True) -> Path:
    """Where the verdict on a case is stored."""
    return folder / f"verdict{'' if reference else _ALONE}.json"


def diagnosis_of(folder: Path, reference: bool = True) -> Path:
    """Folder of the diagnosis of a case, or of its twin in `twin`."""
    return folder / f"diagnosis{'' if reference else _ALONE}"


def confidence(finding: Finding) -> float:
    """Of a finding; one that says none is taken as certain."""
    return float(finding.get("confidence", 1.0))


def label(finding: Finding) -> str:
    """`cause(joints) confidence`."""
    joints = ",".join(str(joint) for joint in finding.get("joints", ()))
    return f"{finding['cause']}({joints}) {confidence(finding):.2f}"


def same(cause: str, joints: Iterable[Any], hidden: Mapping[str, Any]) -> bool:
    """Whether a name and a place are those of the fault; where it is the whole arm's, the place is free."""
    if cause != hidden["cause"] and cause not in hidden["also"]:
        return False
    return not hidden["joints"] or {int(joint) for joint in joints} == set(hidden["joints"])


def names(finding: Finding, hidden: Mapping[str, Any]) -> bool:
    """Whether the finding is this fault by its own name and joint."""
    return same(finding["cause"], finding["joints"], hidden)


def lists(finding: Finding, hidden: Mapping[str, Any]) -> bool:
    """Whether an unsure finding has this fault, by name or as a look-alike."""
    if confidence(finding) >= SURE:
        return False
    others = finding.get("alternatives", ())
    return names(finding, hidden) or any(
        same(other["cause"], other.get("joints", finding["joints"]), hidden) for other in others
    )


def of_character(finding: Finding, traits: Mapping[str, Any]) -> bool:
    """Whether the healthy arm has this, at these joints, and of about this size where the size is known."""
    having = traits.get(finding["cause"], {})
    joints = [str(joint) for joint in finding["joints"]]
    if not joints or any(joint not in having for joint in joints):
        return False
    for name, value in having[joints[0]].items():
        stated = finding.get("parameters", {}).get(name)
        if stated is not None and abs(float(stated["value"]) - value) > max(
            abs(value), _SIGMAS * float(stated.get("std") or 0.0)
        ):
            return False
    return True


def judge(
    diagnosis: Mapping[str, Any], truth: Mapping[str, Any], twin: Mapping[str, Any] | None = None
) -> dict[str, Any]:
    """The verdict on `diagnosis.json`, plain content.

    sure : for each fault, whether the first finding names it and is sure (in a pair: any finding)
    listed : whether an unsure one has it. right : one of them, for all faults
    false : findings of nothing hidden and not of the character of the arm. character : those of it
    flagged : joints of the fault at which more is reported than of the healthy twin
    exact : right, and no finding is false. efficiency : error removed over error that the fault brought
    claims : (confidence, whether right) of all findings. deviations : of parameters, in their sigmas
    """
    hidden = list(truth["hidden"])
    findings = list(diagnosis["findings"])
    first = findings[:1] if len(hidden) == 1 else findings
    sure = [any(names(f, h) and confidence(f) >= SURE for f in first) for h in hidden]
    listed = [any(lists(f, h) for f in first) for h in hidden]
    right = [f for f in findings if any(names(f, h) or lists(f, h) for h in hidden)]
    rest = [f for f in findings if not any(f is r for r in right)]
    character = [f for f in rest if of_character(f, truth["traits"])]
    false = [f for f in rest if not any(f is c for c in character)]
    outside = any(not h["listed"] for h in hidden)
    verdict = {
        "sure": sure,
        "listed": listed,
        "right": bool(hidden) and all(a or b for a, b in zip(sure, listed, strict=True)),
        "anywhere": [any(names(f, h) or lists(f, h) for f in findings) for h in hidden],
        "findings": [label(f) for f in findings],
        "false": [label(f) for f in false],
        "character": [label(f) for f in character],
        "sure_false": [label(f) for f in rest if confidence(f) >= SURE],
        "silent": not findings,
        "unexplained": len(diagnosis.get("unexplained", ())),
        "nameless": len(diagnosis.get("nameless", ())),
        "character_listed": [label(f) for f in diagnosis.get("character", ())],
        "claims": [[confidence(f), any(names(f, h) or lists(f, h) for h in hidden)] for f in findings],
        "deviations": deviations(findings, hidden),
        "worse": _worse(diagnosis),
        "efficiency": None if twin is None else _efficiency(diagnosis, twin),
    }
    verdict["exact"] = verdict["right"] and not verdict["false"]
    if outside:
        verdict["flagged"] = bool(_beyond(diagnosis, twin or {}) & set(_places(truth)))
    return verdict


def deviations(findings: Sequence[Finding], hidden: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Error of each stated parameter in its standard deviations; `null` where the truth or the sigma lacks."""
    found: dict[str, Any] = {}
    for finding in findings:
        for one in hidden:
            if not names(finding, one):
                continue
            for name, stated in finding.get("parameters", {}).items():
                truth, sigma = one["parameters"].get(name), stated.get("std")
                known = truth is not None and sigma
                error = (float(stated["value"]) - truth["value"]) / float(sigma) if known else None
                found[f"{finding['cause']}.{name}"] = error
    return found


def _places(truth: Mapping[str, Any]) -> list[int]:
    """Joints at which the fault is seen."""
    stated = [int(joint) for one in truth["hidden"] for joint in one["joints"]]
    return stated or [int(joint) for joint in truth["affected"]]


def _entries(diagnosis: Mapping[str, Any]) -> set[tuple[str, int]]:
    """Reports by cause and joint: named, unsure, nameless or unexplained."""
    found = {(str(f["cause"]), int(joint)) for f in diagnosis.get("findings", ()) for joint in f["joints"]}
    found |= {(str(f["cause"]), 0) for f in diagnosis.get("findings", ()) if not f["joints"]}
    for kind in ("unexplained", "nameless"):
        found |= {(f"{kind} {e.get('side', '')}", int(e["joint"])) for e in diagnosis.get(kind, ())}
    return found


def _beyond(diagnosis: Mapping[str, Any], twin: Mapping[str, Any]) -> set[int]:
    """Joints of which more is reported than of the twin; 0 is the whole arm."""
    return {joint for _, joint in _entries(diagnosis) - _entries(twin)}


def _efficiency(diagnosis: Mapping[str, Any], twin: Mapping[str, Any]) -> float | None:
    """Of the held-out rows of the diagnosis where the base model is worse than the twin's by 3 %; None if there is
    none."""
    gain, healthy = diagnosis["gain"], twin["gain"]["rows_base"]
    removed = brought = 0.0
    for side in ("motor", "joint"):
        rows = (gain["rows_base"].get(side), gain["rows_extended"].get(side), healthy.get(side))
        for base, extended, without in zip(*(row or () for row in rows), strict=False):
            if None not in (base, extended, without) and base > _AFFECTED * without:
                removed, brought = removed + base - extended, brought + base - without
    return removed / brought if brought > 0.0 else None


def _worse(diagnosis: Mapping[str, Any]) -> list[str]:
    """Rows at which the extended model has a larger held-out error, by more than 1 %."""
    gain, rows = diagnosis.get("gain", {}), []
    base, extended = gain.get("test_rms_base", {}), gain.get("test_rms_extended", {})
    for side in ("motor", "joint"):
        for j, (one, other) in enumerate(
            zip(base.get(side) or (), extended.get(side) or (), strict=False), 1
        ):
            if one is not None and other is not None and other > 1.01 * one:
                rows.append(f"{side} {j} {one:.3g} to {other:.3g}")
    return rows
