"""What a diagnosis found, with its evidence, as a part of the report of a run or as a page of its own."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape
from typing import Any

from ident.effects import EFFECTS, described, summary_of
from ident.effects.words import joints_text, named, quantity_text
from runner.diagnosis.look_alikes import LookAlikes
from runner.report.diagnosis_folder import DiagnosisFolder, values_of
from runner.report.figures import pretty_unit
from runner.report.folder import ResultFolder
from runner.report.look_alike_figures import look_alike_figure
from runner.report.markup import Cell, Number, figure_html, fold, paragraph, section, table
from runner.report.residual_figures import finding_figure, replay_figures, residual_figures
from runner.report.verdicts import error_change, extension_gain

__all__ = ["diagnosis_parts", "diagnosis_section"]

_SURE = 0.8
_SEEN = {
    "motor": "Seen in the motor torque only.",
    "joint": "Acts on the links, so both torques see it.",
    "sensor": "An error of the joint torque sensor.",
}


def diagnosis_section(results: ResultFolder) -> str:
    """The diagnosis as a part of the report of a run."""
    diagnosis = DiagnosisFolder.of(results)
    if diagnosis is None:
        return section(
            "diagnosis",
            "Diagnosis",
            "<p>This folder holds no diagnosis. <code>lwr-run diagnose SESSION... --out "
            f"{escape(results.path.name)}/diagnosis</code> looks for what the model lacks, and the next "
            "<code>lwr-run report</code> shows it here.</p>",
        )
    parts = (
        html if anchor == "findings" else f"<h3>{title}</h3>{html}"
        for anchor, title, html in diagnosis_parts(diagnosis)
    )
    return section("diagnosis", "Diagnosis", *parts)


def diagnosis_parts(diagnosis: DiagnosisFolder) -> list[tuple[str, str, str]]:
    """Anchor, title and HTML of each part that there is: findings, what would decide, gains, limits, residuals."""
    names = diagnosis.joint_names
    answers = "".join(paragraph(_answer(answer, names)) for answer in diagnosis.answers)
    found = "".join(_finding(diagnosis, number) for number in range(1, len(diagnosis.findings) + 1))
    if not diagnosis.findings:
        found = paragraph("Nothing found: the data carry no claim about a cause.")
    parts = [
        ("findings", "Findings", answers + found),
        ("side-by-side", "Side by side", _asked(diagnosis)),
        ("deciding", "Motions that would decide", _offers(diagnosis)),
        ("unexplained", "Seen, but without a name", _unexplained(diagnosis.unexplained, names)),
        ("gain", "Gain", _gain(diagnosis)),
        ("replay", "Replay in simulation", _simulated(diagnosis)),
        ("absorbed", "What the base parameters had absorbed", _absorbed(diagnosis)),
        ("limits", "What these data cannot show", _notes(diagnosis)),
        ("residuals-held-out", "Held-out residuals", _plots(diagnosis)),
    ]
    return [part for part in parts if part[2]]


def _finding(diagnosis: DiagnosisFolder, number: int) -> str:
    finding, names = diagnosis.findings[number - 1], diagnosis.joint_names
    cause, joints = str(finding["cause"]), finding.get("joints", [])
    side, parameters = str(finding.get("side", "")), finding.get("parameters") or {}
    confidence = finding.get("confidence")
    open_ = confidence is not None and confidence < _SURE and finding.get("alternatives")
    sure = (
        "" if confidence is None else f"Confidence {100 * confidence:.0f} %" + (", open." if open_ else ".")
    )
    title = f"{_words(cause).capitalize()}, {joints_text(joints, names)}"
    intro = (
        f"{summary_of(cause).capitalize()}: {described(cause, values_of(finding), finding.get('form'), names)}."
        if parameters
        else ""
    )
    seen = _SEEN.get(side, "")
    parts = [f"<h3>{escape(title)}</h3>", paragraph(" ".join(part for part in (intro, seen, sure) if part))]
    rows: list[list[Cell]] = []
    evidence = finding.get("evidence") or {}
    before, after = evidence.get("test_rms_before"), evidence.get("test_rms_after")
    if before is not None and after is not None and before > 0.0:
        interval = evidence.get("gain_interval_95")
        gain = f"; less by {interval[0]:.3g} to {interval[1]:.3g} Nm (95 %)" if interval else ""
        rows.append(["error on unseen motions", f"{before:.3g} Nm without it, {after:.3g} Nm with it{gain}"])
    for other in finding.get("alternatives") or []:
        place = f", {joints_text(other['joints'], names)}" if other.get("joints") else ""
        rows.append(
            [
                "could also be",
                f"{_words(other['cause'])}{place}",
            ]
        )
    if finding.get("tell_apart") and finding.get("alternatives"):
        rows.append(["what would decide", named(str(finding["tell_apart"]), names)])
    parts.append(table(("", ""), rows, f"Evidence: {title}", classes="facts"))
    if diagnosis.residuals is not None and side != "timing":
        numbers = {name: value for name, (value, _, _) in values_of(finding).items()}
        others = [
            j for k, one in enumerate(diagnosis.findings) if k + 1 != number for j in one.get("joints", [])
        ]
        figure = finding_figure(diagnosis.residuals, cause, side, joints, numbers, others)
        if figure is not None:
            parts.append(figure_html(figure))
    parts += [_beside(pair, names) for pair in diagnosis.look_alikes if pair.finding == number]
    parts.append(
        fold(
            "Parameters and statistics",
            table(("", ""), _statistics(finding), f"Statistics: {title}", classes="facts"),
        )
    )
    return "".join(parts)


def _statistics(finding: Mapping[str, Any]) -> list[list[Cell]]:
    """Parameters with their meaning, and what the claim rests on."""
    evidence = finding.get("evidence") or {}
    rows: list[list[Cell]] = [
        [name.replace("_", " "), f"{value} ({meaning.replace('`', '')})" if meaning else value]
        for name, value, meaning in parameter_rows(finding)
    ]
    for key, label in (("delta_bic", "ΔBIC"), ("p_value", "p-value")):
        if evidence.get(key) is not None:
            rows.append([label, f"{evidence[key]:.3g}"])
    for other in finding.get("alternatives") or []:
        if other.get("delta_bic") is not None:
            rows.append([f"ΔBIC with {_words(other['cause'])} instead", f"{other['delta_bic']:.3g}"])
    return rows


def parameter_rows(finding: Mapping[str, Any]) -> list[tuple[str, str, str]]:
    """Name, value with standard deviation and unit, and meaning of each parameter."""
    cause = str(finding["cause"])
    meanings = {p.name: p.meaning for p in EFFECTS[cause].parameters} if cause in EFFECTS else {}
    return [(name, quantity_text(*one), meanings.get(name, "")) for name, one in values_of(finding).items()]


def _beside(pair: LookAlikes, names: Sequence[str]) -> str:
    """Two causes side by side, what it means, and the motion that decides."""

    def plain(text: str) -> str:
        """With causes in words, and the names of joints as they are."""
        for cause, _ in (pair.first, pair.second):
            text = text.replace(cause, _words(cause))
        return text

    said, motion = pair.sentences(names)
    figure = look_alike_figure(pair, names)
    motion += "" if pair.foreseen is None else f"; {pair.foreseen.sentence()}"
    return (
        f"<h4>Side by side: {escape(plain(pair.title(names)))}</h4>"
        f"{paragraph(plain(said[:1].upper() + said[1:]) + '.')}"
        f"{paragraph(f'What would decide: {motion}.') if pair.open else ''}"
        f"{figure_html(figure)}"
    )


def _asked(diagnosis: DiagnosisFolder) -> str:
    pairs = [pair for pair in diagnosis.look_alikes if not pair.finding]
    return "".join(_beside(pair, diagnosis.joint_names) for pair in pairs)


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
    if not rows:
        return ""
    head = ("where", "depends on", "error on unseen motions [Nm]", "noise floor [Nm]")
    return table(head, rows, "Unexplained residuals")


def _gain(folder: DiagnosisFolder) -> str:
    diagnosis, details, names = folder.content, folder.details, folder.joint_names
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
    text = "" if whole is None else paragraph(f"Mean over joints and sides: {error_change(whole)} error.")
    worse = [one for one in details.get("rows", []) if named and one["gain_interval_95"][1] < 0.0]
    if worse:
        places = ", ".join(f"{one['side']} torque of {joints_text([one['joint']], names)}" for one in worse)
        text += paragraph(f"Worse than the base model there, by more than chance: {places}.")
    sessions = (diagnosis.get("sessions") or {}).get("test") or []
    unseen = ", ".join(sessions) or "each part of the motion, predicted from the others"
    text = paragraph(f"Root mean square errors on what was not fitted: {unseen}.", "soft") + text
    middle = ("extended [Nm]", "change %", "gain [Nm], 95 % interval") if named else ()
    head = ("joint", "noise floor [Nm]", "base model [Nm]", *middle, "avoidable % of its power")
    title = "Gain of the extended model on unseen motions" if named else "Error on unseen motions"
    return text + table(head, rows, title)


def _span(interval: Sequence[float]) -> str:
    text = f"{interval[0]:+.4f} to {interval[1]:+.4f}"
    return text.replace("-", "\N{MINUS SIGN}")


def _simulated(folder: DiagnosisFolder) -> str:
    """Error of the replay with the same commands, before and after."""
    diagnosis, names = folder.content, folder.joint_names
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
    figures = [] if folder.replayed is None else replay_figures(folder.replayed, names)
    plots = "".join(fold(figure.caption, figure_html(figure)) for figure in figures)
    return text + table(("", *names), rows, title) + plots


def _scaled(values: Sequence[float | None], scale: float) -> list[Cell]:
    return [Number(None if value is None else scale * value, ".3f") for value in values]


def _absorbed(diagnosis: DiagnosisFolder) -> str:
    """Base parameters that were wrong because they had taken up what the findings now say."""
    entries = diagnosis.details.get("base_parameters") or []
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
    text = paragraph(
        "Wrong in the base model, because they stood for what is now in the model by name.", "soft"
    )
    return text + table(head, rows, title)


def _notes(diagnosis: DiagnosisFolder) -> str:
    notes = [str(note) for note in diagnosis.details.get("notes", [])]
    items = "".join(f"<li>{escape(note[:1].upper() + note[1:])}.</li>" for note in notes)
    return f"<ul>{items}</ul>" if notes else ""


def _offers(diagnosis: DiagnosisFolder) -> str:
    """The motions that would decide, as files that can be run."""
    offers = diagnosis.details.get("deciding_motions") or []
    if not offers:
        return ""
    parts = [
        paragraph(
            f"{offer['kind'].capitalize()}, {offer['duration_s']:.0f} s: `{offer['file']}`, about "
            f"{' or '.join(dict.fromkeys(_words(rival['cause']) for rival in offer['rivals']))}."
        )
        for offer in offers
    ]
    if diagnosis.experiment is not None:
        name = diagnosis.experiment.name
        run = f"`lwr-run experiment --resume {name} --decide` runs them and concludes."
    else:
        run = (
            "Each is a plan that has passed every check: name it in an experiment file, `excitation: {plan: FILE}`, "
            "run it, and give its session to `lwr-run diagnose` beside these."
        )
    return "".join([*parts, paragraph(run)])


def _plots(diagnosis: DiagnosisFolder) -> str:
    """Residuals against everything, folded."""
    residuals = diagnosis.residuals
    if residuals is None:
        return ""
    parts = [
        fold(figure.caption, figure_html(figure))
        for side in residuals.sides
        for figure in residual_figures(residuals, side)
    ]
    return "".join(parts)


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


def _words(cause: str) -> str:
    return cause.replace("_", " ")
