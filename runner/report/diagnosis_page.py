"""`report.html` of `lwr-run diagnose`: a diagnosis of logs as a page of its own."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any

from ident.effects import described
from ident.effects.words import joints_text
from runner.computer import versions
from runner.report.diagnosis import diagnosis_parts
from runner.report.diagnosis_folder import DiagnosisFolder, values_of
from runner.report.markup import section
from runner.report.page import page_html, write_page
from runner.report.verdicts import Level, Verdict, error_change, extension_gain, largest_gain

__all__ = ["diagnosis_html", "diagnosis_verdicts", "write_diagnosis_report"]

_SURE = 0.8


def write_diagnosis_report(folder: str | Path) -> Path:
    """Write `report.html` into a folder of `lwr-run diagnose`; returns its path.

    ConfigurationError where the folder holds no diagnosis or the extra `view` is not installed.
    """
    diagnosis = DiagnosisFolder.load(folder)
    return write_page(diagnosis_html(diagnosis), diagnosis.path)


def diagnosis_html(diagnosis: DiagnosisFolder) -> str:
    """The text of the page."""
    parts = diagnosis_parts(diagnosis)
    sessions = diagnosis.content.get("sessions") or {}
    about = f"Diagnosis of {', '.join(sessions.get('train', []))} · {diagnosis.path.resolve().name}"
    lines = diagnosis_verdicts(diagnosis)
    return page_html(
        "Diagnosis",
        escape(about),
        _headline(diagnosis, lines),
        lines,
        "".join(section(anchor, title, html) for anchor, title, html in parts),
        [(anchor, title) for anchor, title, _ in parts],
        str(versions()["software"]),
    )


def _headline(diagnosis: DiagnosisFolder, lines: Sequence[Verdict]) -> tuple[Level, str]:
    count, rest = len(diagnosis.findings), len(diagnosis.unexplained)
    if count:
        in_doubt = sum(_in_doubt(finding) for finding in diagnosis.findings)
        doubt = (
            ""
            if not in_doubt
            else f", {'one' if in_doubt == 1 else in_doubt} of them open between look-alikes"
        )
        if count == 1:
            return "look", "One cause found" + (", open between look-alikes" if in_doubt else "")
        return "look", f"{count} causes found{doubt}"
    if rest:
        return "look", "No cause can be named, but the model misses something"
    return "good", "Nothing is wrong that these data could show"


def _in_doubt(finding: Mapping[str, Any]) -> bool:
    return bool(finding.get("alternatives")) and float(finding.get("confidence", 1.0)) < _SURE


def diagnosis_verdicts(diagnosis: DiagnosisFolder) -> list[Verdict]:
    """One line for each finding, then what stays unexplained, what was gained, and what could not be seen."""
    names, content = diagnosis.joint_names, diagnosis.content
    lines = [_found(finding, names) for finding in diagnosis.findings]
    if not diagnosis.findings:
        lines.append(Verdict("causes", "none that the data carry", "none", "good", "findings"))
    rest = ", ".join(f"{names[u['joint'] - 1]} {u['side']}" for u in diagnosis.unexplained)
    lines.append(
        Verdict("without a name", rest or "nothing", "nothing", "look" if rest else "good", "unexplained")
    )
    gain = extension_gain(content)
    if gain is not None:
        place, best = largest_gain(content, names)
        text = f"{error_change(gain)} error on unseen motions on average, {place} {error_change(best)}"
        rows = diagnosis.details.get("rows", [])
        worse = [f"{names[r['joint'] - 1]} {r['side']}" for r in rows if r["gain_interval_95"][1] < 0.0]
        text += f"; worse: {', '.join(worse)}" if worse else ""
        lines.append(
            Verdict("extended model", text, "less", "look" if worse or gain <= 0.0 else "good", "gain")
        )
    replay = _replayed(content, names)
    if replay is not None:
        lines.append(replay)
    notes = diagnosis.details.get("notes", [])
    if notes:
        text = f"{len(notes)} notes on what these data cannot show" if len(notes) > 1 else "one note"
        lines.append(Verdict("limits of the data", text, "", "look", "limits"))
    return lines


def _found(finding: Mapping[str, Any], names: Sequence[str]) -> Verdict:
    cause = str(finding["cause"])
    evidence = finding.get("evidence") or {}
    text = described(cause, values_of(finding), finding.get("form"), names)
    if evidence.get("test_rms_before"):
        text += f"; error {evidence['test_rms_before']:.3g} to {evidence['test_rms_after']:.3g} Nm"
    text += f"; confidence {100 * finding['confidence']:.0f} %"
    if _in_doubt(finding):
        other = finding["alternatives"][0]
        place = f", {joints_text(other['joints'], names)}" if other.get("joints") else ""
        text += f", or {other['cause'].replace('_', ' ')}{place}"
    subject = f"{cause.replace('_', ' ')}, {joints_text(finding.get('joints', []), names)}"
    return Verdict(subject, text, "", "look", "findings")


def _replayed(content: Mapping[str, Any], names: Sequence[str]) -> Verdict | None:
    """How much better or worse the extended model is simulated, over all joints."""
    gain = content.get("gain") or {}
    before, after = gain.get("simulation_error_base") or {}, gain.get("simulation_error_extended") or {}
    parts, worse = [], False
    for key, label, unit, scale in (
        ("position", "position", "mrad", 1e3),
        ("motor", "motor torque", "Nm", 1.0),
        ("joint", "joint torque", "Nm", 1.0),
    ):
        if not before.get(key) or not after.get(key):
            continue
        sizes = [math.hypot(*(v for v in side[key] if v is not None)) * scale for side in (before, after)]
        worse = worse or sizes[1] > 1.1 * sizes[0]
        change = f"{sizes[0]:.3g} to {sizes[1]:.3g}" if content.get("findings") else f"{sizes[0]:.3g}"
        parts.append(f"{label} {change} {unit}")
    if not parts:
        return None
    text = f"off over all joints together: {', '.join(parts)}"
    return Verdict("replay in simulation", text, "less", "look" if worse else "good", "replay")
