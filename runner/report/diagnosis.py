"""What the diagnosis of a run found, with its evidence, as a part of the report."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any

from runner.diagnosis.residuals import FILE as RESIDUALS
from runner.diagnosis.residuals import Residuals
from runner.diagnosis.words import CAUSES, joints_text, quantity_text
from runner.report.figures import pretty_unit
from runner.report.folder import ResultFolder
from runner.report.markup import Cell, Number, figure_html, fold, paragraph, section, table
from runner.report.residual_figures import residual_figures
from runner.report.verdicts import extension_gain

__all__ = ["diagnosis_section"]


def diagnosis_section(results: ResultFolder) -> str:
    """Findings with their evidence, what stays unexplained, the gain of the extended model, residual plots."""
    diagnosis = results.diagnosis
    if diagnosis is None:
        return section(
            "diagnosis",
            "Diagnosis",
            "<p>This folder holds no diagnosis. <code>lwr-run diagnose SESSION... --out "
            f"{escape(results.path.name)}/diagnosis</code> looks for what the model lacks, and the next "
            "<code>lwr-run report</code> shows it here.</p>",
        )
    names = results.joint_names
    findings: Sequence[Mapping[str, Any]] = diagnosis.get("findings", [])
    details = _json(results.diagnosis_folder / "details.json")
    decision = _json(results.diagnosis_folder / "decision.json")
    parts = [paragraph(_answer(answer, names)) for answer in decision.get("answers", [])]
    parts += [_finding(one, names) for one in findings]
    if not findings:
        parts.append(paragraph("Nothing found: the data carry no claim about a cause."))
    if diagnosis.get("unexplained"):
        parts.append(_unexplained(diagnosis["unexplained"], names))
    parts.append(_gain(diagnosis, details, names))
    parts.append(_simulated(diagnosis, names))
    parts.append(_absorbed(details))
    parts += [paragraph(str(note[:1]).upper() + str(note[1:]) + ".") for note in details.get("notes", [])]
    parts.append(_offers(details, results))
    parts.append(_plots(results))
    return section("diagnosis", "Diagnosis", *parts)


def _finding(finding: Mapping[str, Any], names: Sequence[str]) -> str:
    cause = str(finding["cause"])
    where = joints_text(finding.get("joints", []), names)
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
    if finding.get("tell_apart") and finding.get("alternatives"):
        rows.append(["what would decide", str(finding["tell_apart"])])
    title = f"{_words(cause).capitalize()}, {where}"
    explained = f"{CAUSES.get(cause, '')} ({finding.get('side', 'no')} side{sure})".strip()
    return f"<h3>{escape(title)}</h3>{paragraph(explained)}{table(('', ''), rows, f'Evidence: {title}')}"


def _unexplained(entries: Sequence[Mapping[str, Any]], names: Sequence[str]) -> str:
    rows: list[list[Cell]] = [
        [
            f"{joints_text([entry['joint']] if 'joint' in entry else [], names)}, {entry.get('side', '')} side",
            ", ".join(entry.get("depends_on", [])),
            Number(entry.get("test_rms"), ".3g"),
            Number(entry.get("noise_floor"), ".3g"),
        ]
        for entry in entries
    ]
    head = ("where", "depends on", "error on unseen motions [Nm]", "noise floor [Nm]")
    return f"<h3>Seen, but without a name</h3>{table(head, rows, 'Unexplained residuals')}"


def _gain(diagnosis: Mapping[str, Any], details: Mapping[str, Any], names: Sequence[str]) -> str:
    gain = diagnosis.get("gain") or {}
    base, extended = gain.get("test_rms_base") or {}, gain.get("test_rms_extended") or {}
    floor = (diagnosis.get("baseline") or {}).get("noise_floor") or {}
    measured = {(row["side"], row["joint"]): row for row in details.get("rows", [])}
    named = bool(diagnosis.get("findings"))
    rows: list[list[Cell]] = []
    for side in base:
        for k, before in enumerate(base[side] or ()):
            after = (extended.get(side) or [])[k] if extended.get(side) else None
            low = floor.get(side) or []
            row = measured.get((side, k + 1), {})
            cells: list[Cell] = [
                f"{names[k] if k < len(names) else k + 1} {side}",
                Number(low[k] if k < len(low) else None, ".4f"),
                Number(before, ".4f", f"gain.test_rms_base.{side}.{k}"),
            ]
            if named:
                change = None if not before or after is None else 100 * (after / before - 1)
                interval = row.get("gain_interval_95")
                cells += [
                    Number(after, ".4f", f"gain.test_rms_extended.{side}.{k}"),
                    Number(change, "+.1f"),
                    "–" if not interval else _span(interval),
                ]
            share = row.get("avoidable_share")
            rows.append([*cells, Number(None if share is None else 100 * share, ".0f")])
    if not rows:
        return ""
    whole = extension_gain(diagnosis)
    text = "" if whole is None else paragraph(f"Mean over joints and sides: {100 * whole:.0f} % less error.")
    middle = ("extended [Nm]", "change %", "gain [Nm], 95 % interval") if named else ()
    head = ("joint", "noise floor [Nm]", "base model [Nm]", *middle, "avoidable % of its power")
    title = "Gain of the extended model on unseen motions" if named else "Error on unseen motions"
    return f"<h3>{title}</h3>{text}{table(head, rows, title)}"


def _span(interval: Sequence[float]) -> str:
    text = f"{interval[0]:+.4f} to {interval[1]:+.4f}"
    return text.replace("-", "\N{MINUS SIGN}")


def _simulated(diagnosis: Mapping[str, Any], names: Sequence[str]) -> str:
    """Error of the replay with the same commands, before and after."""
    gain = diagnosis.get("gain") or {}
    before, after = gain.get("simulation_error_base") or {}, gain.get("simulation_error_extended") or {}
    named = bool(diagnosis.get("findings"))
    rows: list[list[Cell]] = []
    for key, label, scale in (
        ("position", "position [mrad]", 1e3),
        ("motor", "motor torque [Nm]", 1.0),
        ("joint", "joint torque [Nm]", 1.0),
    ):
        if not before.get(key):
            continue
        rows.append([f"{label}, base model", *_scaled(before[key], scale)])
        if named and after.get(key):
            rows.append([f"{label}, extended", *_scaled(after[key], scale)])
    if not rows:
        return ""
    title = "Replay in simulation"
    text = paragraph("The same commands to the simulated arm: measured less simulated, root mean square.")
    return f"<h3>{title}</h3>{text}{table(('', *names), rows, title)}"


def _scaled(values: Sequence[float | None], scale: float) -> list[Cell]:
    return [Number(None if value is None else scale * value, ".3f") for value in values]


def _absorbed(details: Mapping[str, Any]) -> str:
    """Base parameters that were wrong because they had taken up what the findings now say."""
    entries = details.get("base_parameters") or []
    if not entries:
        return ""
    rows: list[list[Cell]] = [
        [
            str(entry["name"]),
            Number(entry["base"]),
            Number(entry["extended"]),
            Number(entry["std"], ".2g"),
            Number(entry["change_in_std"], "+.1f"),
            pretty_unit(str(entry["unit"])),
        ]
        for entry in entries
    ]
    head = ("parameter", "base model", "extended", "std", "change [std]", "unit")
    title = "What the base parameters had absorbed"
    return f"<h3>{title}</h3>{table(head, rows, title)}"


def _offers(details: Mapping[str, Any], results: ResultFolder) -> str:
    """The motions that would decide, as files that can be run."""
    offers = details.get("deciding_motions") or []
    if not offers:
        return ""
    parts = [
        paragraph(
            f"{offer['kind'].capitalize()}, {offer['duration_s']:.0f} s: `{offer['file']}`, about "
            f"{' or '.join(dict.fromkeys(_words(rival['cause']) for rival in offer['rivals']))}."
        )
        for offer in offers
    ]
    run = paragraph(f"`lwr-run experiment --resume {results.path.name} --decide` runs them and concludes.")
    return f"<h3>Motions that would decide</h3>{''.join(parts)}{run}"


def _plots(results: ResultFolder) -> str:
    """Residuals against everything, folded."""
    file = results.diagnosis_folder / RESIDUALS
    if not file.is_file():
        return ""
    residuals = Residuals.load(file)
    parts = [
        fold(figure.caption, figure_html(figure))
        for side in residuals.sides
        for figure in residual_figures(residuals, side)
    ]
    return f"<h3>Held-out residuals</h3>{''.join(parts)}"


def _answer(answer: Mapping[str, Any], names: Sequence[str]) -> str:
    asked = " or ".join(
        f"{_words(rival['cause'])} ({joints_text(rival['joints'], names)})" for rival in answer["rivals"]
    )
    named = answer.get("named")
    said = "nothing" if named is None else f"{_words(named['cause'])} ({joints_text(named['joints'], names)})"
    if answer["outcome"] == "decided":
        return f"Deciding motions: {said}, confidence {answer['confidence']:.2f}; asked was {asked}."
    if answer["outcome"] == "open":
        return f"Deciding motions: still open between {asked}."
    return f"Deciding motions: none of {asked}; found instead: {said}."


def _json(path: Path) -> Mapping[str, Any]:
    """Content of a file that may be missing."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return content if isinstance(content, dict) else {}


def _words(cause: str) -> str:
    return cause.replace("_", " ")


def _quantity(value: Any) -> str:
    if not isinstance(value, Mapping):
        return f"{value:.4g}" if isinstance(value, float) else str(value)
    number = value.get("value")
    if not isinstance(number, (int, float)):
        return str(number)
    return quantity_text(float(number), float(value.get("std") or 0.0), str(value.get("unit", "1")))
