"""What the diagnosis of a run found, with its evidence, as a part of the report."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape
from typing import Any

from runner.report.folder import ResultFolder
from runner.report.markup import Cell, Number, paragraph, section, table
from runner.report.verdicts import extension_gain

__all__ = ["diagnosis_section"]

CAUSES = {
    "stribeck": "friction rises as the velocity falls towards zero",
    "viscous_nonlinear": "viscous friction is not proportional to velocity",
    "friction_asymmetry": "friction depends on the direction",
    "friction_load": "friction grows with the transmitted torque",
    "friction_temperature": "friction drifts as the joint warms up",
    "friction_position": "friction depends on the joint angle",
    "presliding_hysteresis": "hysteresis around reversals",
    "gear_ripple": "torque periodic in the motor angle",
    "motor_torque_gain": "wrong torque constant",
    "backlash": "lost motion when the torque reverses",
    "joint_elasticity": "the link is not where the motor encoder says",
    "cable_spring": "a torque that depends on the joint angle (hoses, cables)",
    "base_tilt": "gravity is not along the assumed axis",
    "payload_error": "the payload is not the announced one",
    "payload_change": "the payload changes or comes loose during a session",
    "joint_zero_offset": "the zero of the encoder is off",
    "contact": "an outside force during an interval",
    "sensor_gain": "scale of the joint torque sensor",
    "sensor_crosstalk": "the torque of another joint leaks in",
    "sensor_hysteresis": "hysteresis of the joint torque sensor",
    "sensor_saturation": "clipped torque",
    "sensor_offset_drift": "the zero of a sensor moves",
    "sensor_ripple": "sensor error periodic in the angle",
    "motor_torque_delay": "motor torque late against the position",
    "joint_torque_delay": "joint torque late against the position",
    "lost_samples": "dropped, repeated or held samples",
}


def diagnosis_section(results: ResultFolder) -> str:
    """Findings with their evidence, what stays unexplained, and the gain of the extended model."""
    diagnosis = results.diagnosis
    if diagnosis is None:
        return section(
            "diagnosis",
            "Diagnosis",
            "<p>This folder holds no diagnosis. <code>lwr-run diagnose SESSION... --out FOLDER</code> looks "
            "for "
            "what the model lacks, and the next <code>lwr-run report</code> shows it here.</p>",
        )
    findings: Sequence[Mapping[str, Any]] = diagnosis.get("findings", [])
    parts = [_finding(one, results.joint_names) for one in findings]
    if not findings:
        parts.append(paragraph("Nothing found: the data carry no claim about a cause."))
    if diagnosis.get("unexplained"):
        parts.append(_unexplained(diagnosis["unexplained"], results.joint_names))
    parts.append(_gain(diagnosis, results.joint_names))
    return section("diagnosis", "Diagnosis", *parts)


def _finding(finding: Mapping[str, Any], names: Sequence[str]) -> str:
    cause = str(finding["cause"])
    where = _joints(finding.get("joints", []), names)
    confidence = finding.get("confidence")
    sure = "" if confidence is None else f", confidence {100 * confidence:.0f} %"
    rows: list[list[Cell]] = []
    for name, value in (finding.get("parameters") or {}).items():
        rows.append([name, _quantity(value)])
    evidence = finding.get("evidence") or {}
    before, after = evidence.get("test_rms_before"), evidence.get("test_rms_after")
    if before is not None and after is not None:
        interval = evidence.get("gain_interval_95")
        gain = f"; 95 % interval of the gain {interval[0]:.3g} to {interval[1]:.3g} Nm" if interval else ""
        rows.append(["error on unseen motions", f"{before:.3g} Nm without, {after:.3g} Nm with it{gain}"])
    for key, label in (("delta_bic", "change of the Bayesian information criterion"), ("p_value", "p-value")):
        if evidence.get(key) is not None:
            rows.append([label, f"{evidence[key]:.3g}"])
    for other in finding.get("alternatives") or []:
        rows.append(
            ["could also be", f"{_words(other['cause'])} (ΔBIC {other.get('delta_bic', float('nan')):.3g})"]
        )
    if finding.get("tell_apart"):
        rows.append(["what would decide", str(finding["tell_apart"])])
    title = f"{_words(cause).capitalize()}, {where}"
    explained = f"{CAUSES.get(cause, '')} ({finding.get('side', 'no')} side{sure})".strip()
    return f"<h3>{escape(title)}</h3>{paragraph(explained)}{table(('', ''), rows, f'Evidence: {title}')}"


def _unexplained(entries: Sequence[Mapping[str, Any]], names: Sequence[str]) -> str:
    rows: list[list[Cell]] = [
        [
            f"{_joints([entry['joint']] if 'joint' in entry else [], names)}, {entry.get('side', '')} side",
            ", ".join(entry.get("depends_on", [])),
            Number(entry.get("test_rms"), ".3g"),
            Number(entry.get("noise_floor"), ".3g"),
        ]
        for entry in entries
    ]
    head = ("where", "depends on", "error on unseen motions [Nm]", "noise floor [Nm]")
    return f"<h3>Seen, but without a name</h3>{table(head, rows, 'Unexplained residuals')}"


def _gain(diagnosis: Mapping[str, Any], names: Sequence[str]) -> str:
    gain = diagnosis.get("gain") or {}
    base, extended = gain.get("test_rms_base") or {}, gain.get("test_rms_extended") or {}
    floor = (diagnosis.get("baseline") or {}).get("noise_floor") or {}
    rows: list[list[Cell]] = []
    for side in base:
        for k, (before, after) in enumerate(zip(base[side], extended.get(side, []), strict=False)):
            change = None if not before or after is None else 100 * (after / before - 1)
            low = floor.get(side, [])
            rows.append(
                [
                    f"{names[k] if k < len(names) else k + 1} {side}",
                    Number(before, ".4f", f"gain.test_rms_base.{side}.{k}"),
                    Number(after, ".4f", f"gain.test_rms_extended.{side}.{k}"),
                    Number(change, "+.1f"),
                    Number(low[k] if k < len(low) else None, ".4f"),
                ]
            )
    if not rows:
        return ""
    whole = extension_gain(diagnosis)
    text = "" if whole is None else paragraph(f"Mean over joints and sides: {100 * whole:.0f} % less error.")
    head = ("joint", "base model [Nm]", "extended [Nm]", "change %", "noise floor [Nm]")
    lines = table(head, rows, "Gain of the extended model")
    return f"<h3>Gain of the extended model on unseen motions</h3>{text}{lines}"


def _joints(joints: Sequence[int], names: Sequence[str]) -> str:
    if not joints:
        return "whole arm"
    known = [names[j - 1] if 0 < j <= len(names) else str(j) for j in joints]
    return ("joint " if len(known) == 1 else "joints ") + ", ".join(known)


def _words(cause: str) -> str:
    return cause.replace("_", " ")


def _quantity(value: Any) -> str:
    if not isinstance(value, Mapping):
        return f"{value:.4g}" if isinstance(value, float) else str(value)
    std = value.get("std")
    spread = "" if std is None else f" ± {std:.2g}"
    number = value.get("value")
    shown = f"{number:.4g}" if isinstance(number, (int, float)) else str(number)
    return f"{shown}{spread} {value.get('unit', '')}".strip()
