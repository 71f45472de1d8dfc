"""The end of a command on the screen: one sentence, a few numbers, and where to look next."""

from __future__ import annotations

import math
import sys
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING, Any

from ident.diagnosis.outcome.statements import LIMITS, Statements
from ident.estimation.scores import by_side
from ident.estimators.estimate import two_digits
from ident.estimators.problem import condition_text
from lwr_driver.listing import Piece
from runner import status
from runner.report.folder import ResultFolder
from runner.report.verdicts import Level, Verdict, estimate_lines, headline, verdicts
from runner.terminal import verbosity

if TYPE_CHECKING:  # a command imports its own alone
    from ident.diagnosis.outcome.look_alikes import LookAlikes
    from ident.estimation.compare import Comparison
    from ident.estimation.payload import PayloadEstimate
    from ident.estimation.validate import Validation
    from ident.excitation.lower_bound import LowerBound
    from ident.excitation.plan import ExcitationPlan
    from lwr_driver.session.summary import SessionSummary
    from runner.preflight import Preflight

_AT_ONCE = 0.1
"""Path [mrad, mm] below which friction turns at once."""


@dataclass(frozen=True)
class Ending:
    """The end of a command.

    numbers : name and value. look : verdicts to look at. advice : sentences before the next step. next_step : a shell
    command. shown : tables always there. tables : all of them instead, for `--verbose`.
    """

    level: Level
    sentence: str
    numbers: Sequence[tuple[str, str]] = ()
    look: Sequence[Verdict] = ()
    advice: Sequence[str] = ()
    next_step: str = ""
    tables: Sequence[Piece] = ()
    shown: Sequence[Piece] = ()

    def tell(self) -> None:
        """Write the end to standard output, the last line being the next step."""
        out = sys.stdout
        pieces = self.tables if verbosity() and self.tables else self.shown
        if pieces:
            status.answer(*pieces, "")
        status.write(self.sentence, f"bold {status.STYLES[self.level]}", stream=out)
        for verdict in self.look:
            good = f" (a good result: {verdict.wanted})" if verdict.wanted else ""
            text = f"  {verdict.subject}: {verdict.found}{good}"
            status.write(text, status.STYLES[verdict.level], stream=out)
        width = max((len(name) for name, _ in self.numbers), default=0)
        for name, value in self.numbers:
            status.write(f"  {name:<{width}}  {value}", stream=out)
        for text in () if verbosity() and self.advice == _VERBOSE else self.advice:
            status.write(text, stream=out)
        if self.next_step:
            status.next_step(self.next_step)


def numbers_of(summary: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Torque error, parameters, estimator and payload of a summary, as far as they are there.

    summary : content of summary.json, or `Identification.to_dict()` with `validation`.
    """
    found = []
    held = [one for one in summary.get("validation") or () if not one.get("seen")]
    scored = held or list(summary.get("fit") or ())
    if scored:
        worst = max(scored, key=lambda one: max(one["torque_error"].values()))
        kind = "held-out data" if held else "data of the estimate"
        found.append(("torque error", f"{by_side(worst['torque_error'])} on {kind}"))
    counts, essential = summary.get("counts"), summary.get("essential")
    if counts:
        text = f"{counts['base']} estimated"
        if essential:
            text += f", {essential['count']} essential"
        spread = summary.get("median_rsd_percent")
        text += f", median relative std {two_digits(spread)} %" if spread is not None else ""
        found.append(("parameters", text))
    found += estimate_lines(summary)
    real = summary.get("feasibility")
    if real and not real["real"] and real["possible"]:  # what is beyond chance is a warning
        found.append(("real bodies", real["text"]))
    turning = (summary.get("choice") or {}).get("friction_turns")
    if turning:
        kinds = (("mrad", turning["length_rad"]), ("mm", turning.get("length_m") or {}))
        lengths = [1e3 * one for _, own in kinds for one in own.values()]
        error = turning["torque_error_percent"]
        spans = " and ".join(_span(own, unit) for unit, own in kinds if own)
        # Over less than an encoder's noise it turns at once, and only rests are predicted better.
        turns = "stays at rest as it was" if max(lengths) < _AT_ONCE else f"turns over {spans}"
        drives = f"{len(lengths)} drives" if len(lengths) > 1 else "one drive"
        text = f"of {drives} {turns}, in the model: "
        text += f"motor torque error of the fit {error['without']:.3g} -> {error['with']:.3g} %"
        found.append(("friction", text))
    late = [text for text in (_delay_of(summary, "motor"), _delay_of(summary, "joint")) if text]
    if late:
        found.append(("delay", "; ".join(late)))
    masses = [one for one in summary.get("parameters", ()) if _is_mass(one["name"])]
    if masses:
        text = ", ".join(_spread(one["estimate"], one["std"]) for one in masses)
        found.append(("payload mass", text))
    elif "condition" in summary:
        text = condition_text(summary["condition"])
        text += ": the motion does not show all parameters" if text == "infinite" else ""
        found.append(("condition number", text))
    return found


def _span(lengths: Mapping[str, float], unit: str) -> str:
    """Lengths by joint [rad or m] in thousandths, from the least to the most."""
    sizes = [1e3 * one for one in lengths.values()]
    least, most = (f"{float(f'{one:.2g}'):g}" for one in (min(sizes), max(sizes)))
    return f"{most} {unit}" if least == most else f"{least} to {most} {unit}"


def _delay_of(summary: Mapping[str, Any], side: str) -> str:
    """Delay of a side's torques against the motion in words, empty where it is none."""
    sessions = summary.get("prepared", summary["sessions"])
    known = [
        (1e3 * one[f"{side}_delay_s"], 1e3 * (one.get(f"{side}_delay_std_s") or 0.0))
        for one in sessions or ()
        if one.get(f"{side}_delay_s") is not None
    ]
    if not any(delay for delay, _ in known):
        return ""
    delays, deviations = zip(*known, strict=True)
    sign, where = (-1.0, "before") if max(delays) <= 0.0 else (1.0, "after")
    least, most = sorted((sign * min(delays) + 0.0, sign * max(delays) + 0.0))
    size = f"{most:.1f}" if most - least < 0.05 else f"{least:.1f} to {most:.1f}"
    return f"{side} torques {size} ms {where} the positions, ± {max(deviations):.2g} ms"


def of_estimate(content: Mapping[str, Any], model: Path | None, tables: Sequence[Piece]) -> Ending:
    """The end of an estimate without a folder of results. content : of `Identification.to_dict`."""
    names = [one["name"] for one in content["sessions"]]
    sentence = f"Model {content['model']} estimated from {len(names)} session{'s' * (len(names) > 1)}."
    warnings = (*(content.get("warnings") or ()), *content.get("validation_warnings", ()))
    advice = ["`--verbose` shows every table, `--results FOLDER` writes a report."]
    next_step = "" if model is None else f"lwr-run validate {quote(str(model))} HELD_OUT.mcap"
    look = [Verdict("warning", text, "", "look") for text in warnings]
    return Ending("look" if look else "good", sentence, numbers_of(content), look, advice, next_step, tables)


def compared(pair: LookAlikes, joint_names: Sequence[str]) -> tuple[str, str]:
    """Name and value of a line on two causes side by side."""
    first, second = (
        cause + (f" {' '.join(joint_names[joint - 1] for joint in joints)}" if joints else "")
        for cause, joints in (pair.first, pair.second)
    )
    told = "told apart by these sessions" if pair.told_apart else "not told apart by these sessions"
    return (
        f"{first} or {second}",
        f"{told}: overlap {pair.alike:.3f}, rest {pair.apart:.1f}, needed {pair.needed:.1f}",
    )


def of_diagnosis(
    said: Statements, page: Path | None, folder: Path, asked: Sequence[tuple[str, str]] = ()
) -> Ending:
    """The end of a diagnosis with results in `folder`. asked : lines on the comparisons asked for."""
    shown = [line for line in said.lines if line.subject != LIMITS]
    numbers = [(line.subject, line.found) for line in shown if line.level == "good"]
    numbers += asked
    look = [
        Verdict(line.subject, line.found, line.wanted, line.level) for line in shown if line.level != "good"
    ]
    next_step = open_page(page if page is not None else folder / "diagnosis.txt")
    return Ending(said.level, f"{said.headline}.", numbers, look, said.answers, next_step, said.pieces())


def of_validation(
    found: Validation,
    tables: Sequence[Piece],
    sessions: Sequence[Path],
    asked: Sequence[tuple[str, str]] = (),
) -> Ending:
    """The end of a test of a model. tables : of all that was computed. asked : lines on further tests asked for."""
    worst = max(found.scores, key=lambda score: max(score.relative.values()))
    seen = " (seen by the estimate: no validation)" if worst.seen else " on held-out data"
    sentence = (
        f"The model of {found.robot} predicts the torque with an error of {by_side(worst.relative)}{seen}."
    )
    own = [max(score.relative.values()) for score in found.scores]
    joints = max(worst.scores, key=lambda score: -1.0 if math.isnan(score.relative) else score.relative)
    numbers = [
        ("sessions", f"{len(own)}" + (f", the best {100 * min(own):.2f} %" if len(own) > 1 else "")),
        (
            "largest",
            f"{joints.joint} {joints.side}, {100 * joints.relative:.1f} %, rms {joints.rms:.3f} {joints.unit}",
        ),
        ("compared with", ", ".join(dict.fromkeys(one.predictor for one in found.competitors)) or "nothing"),
        *asked,
    ]
    look = [Verdict("not validated", f"{one}", "", "bad") for one in found.unscored]
    look += [Verdict("warning", text, "", "look") for text in found.warnings]
    return Ending(
        _level(look),
        " ".join([sentence, *found.notes]),
        numbers,
        look,
        _VERBOSE,
        " ".join(["lwr-run diagnose", *(quote(str(path)) for path in sessions), "--out diagnosis"]),
        tables,
        found.comparison(),
    )


def of_comparison(found: Comparison, models: Sequence[Path], page: Path | None) -> Ending:
    """The end of a comparison of two models. page : its report, None without."""
    count, all_ = len(found.significant), len(found.differences)
    known = math.isfinite(found.p)
    if not known:
        sentence = f"{all_} parameters compared without significance: a model has no covariance."
    elif count:
        sentence = f"{count} of {all_} parameters differ by more than chance."
    else:
        sentence = f"No parameter of {all_} differs by more than chance."
    numbers = [("all together", f"p = {found.p:.2g} by chance" if known else "unknown")]
    if known:
        largest = max(found.differences, key=lambda one: abs(one.z) if math.isfinite(one.z) else -1.0)
        text = f"{largest.name} {largest.percent:+z.1f} %, {abs(largest.z):.1f} standard deviations"
        numbers.append(("largest", text))
    numbers.append(("level", f"{100 * found.level:g} % over all of them together"))
    shown: list[Piece] = []
    if 0 < count <= _SHORT:
        shown = [f"first   {found.first}", f"second  {found.second}", "", found.listing(all_rows=False)]
    ask = " ".join(["lwr-run compare", *(quote(str(path)) for path in models), "--report comparison.html"])
    level: Level = "good" if known and not count else "look"
    next_step = ask if page is None else open_page(page)
    return Ending(level, sentence, numbers, (), _VERBOSE, next_step, found.pieces(), shown)


def of_payload(
    found: PayloadEstimate, arm: Path, sessions: Sequence[Path], out: Path | None, known: Collection[str] = ()
) -> Ending:
    """The end of an estimate of a payload. arm : the model. out : the model written with the payload.

    known : payloads of the model, which it is not given again.
    """
    sure = not abs(found.mass_deviation) > 3.0
    sentence = f"Payload {found.payload} has {_spread(found.mass, found.mass_std)}."
    numbers = [
        ("centre of mass", found.centre),
        ("mass", found.verdict),
        ("residual rms", f"up to {found.largest_residual}"),
    ]
    again = ["lwr-run payload", *(quote(str(path)) for path in (arm, *sessions)), "--out with_payload.yaml"]
    next_step = " ".join(again) if out is None else f"lwr-run export {quote(str(out))} arm.urdf"
    if found.payload in known:
        # The model holds its own estimate of it: one from other sessions is a check.
        next_step = f"lwr-run export {quote(str(arm))} arm.urdf --payload {quote(found.payload)}"
    notes = [Verdict("note", text.removeprefix("WARNING: "), "", "look") for text in found.notes]
    level: Level = "good" if sure and not notes else "look"
    return Ending(level, sentence, numbers, notes, (), next_step, found.pieces(), [found.listing()])


def of_session(found: SessionSummary) -> Ending:
    """The end of a summary of a session log."""
    data, path = found.metadata, quote(str(found.path))
    ended = None if found.end is None else found.end.get("exit_status", "unknown")
    level: Level = "bad" if ended is None else "good" if ended == "success" else "look"
    how = "the recorder died" if ended is None else f"ended with {ended}"
    if found.foreign:
        level, how = "good", found.ended
    sentence = f"{found.duration_s:.1f} s of {data.get('robot', 'an unknown arm')}, {how}."
    numbers = [
        ("payload", found.payload),
        ("recorded", found.recorded),
        ("missing", "; ".join(found.missing) or "nothing"),
    ]
    next_step = f"lwr-run identify {path} --out model.yaml"
    if found.foreign:
        next_step = f"lwr-run identify {path} --urdf arm.urdf --out model.yaml"
    elif ended is None:
        next_step = f"lwr-run recover {path}"
    shown: list[Piece] = [found.topics(), "", found.joints()]
    return Ending(level, sentence, numbers, (), _VERBOSE, next_step, found.pieces(), shown)


def of_check(found: Mapping[str, Preflight], file: str, files: int) -> Ending:
    """The end of the checks of an experiment `file`, all held. found : by session. files : number of its files."""
    count = sum(len(one.items) for one in found.values())
    numbers = [
        ("sessions", ", ".join(found)),
        ("files", f"{files}, with their SHA-256 above"),
    ]
    sentence = f"Nothing moved; all {count} conditions hold."
    return Ending("good", sentence, numbers, next_step=f"lwr-run preview {quote(file)}")


def of_plan(found: ExcitationPlan, target: Path, bound: LowerBound | None) -> Ending:
    """The end of the planning of a motion, written to `target`; with the bound of its criterion, where it has one."""
    margins = sorted(found.check.margins, key=lambda one: one.share)
    worst = max(found.rsd_percent.items(), key=lambda item: item[1], default=("-", math.nan))
    numbers = [
        *((name, f"{value:.4g}") for name, value in list(found.objectives.items())[:1]),
        *(() if bound is None else ((bound.criterion, bound.text(found.objectives[bound.criterion])),)),
        *(("tightest", f"{margin}") for margin in margins[:1]),
        ("least certain", f"{worst[0]}, {worst[1]:.1f} % predicted"),
    ]
    kept = "within every limit" if found.check.ok else "OUTSIDE its limits"
    sentence = f"A motion of {found.period_s:g} s, {kept}."
    next_step = f"lwr-run preview {quote(str(target))}"
    from ident.excitation.plan import plan_pieces

    level: Level = "good" if found.check.ok else "bad"
    return Ending(level, sentence, numbers, (), _VERBOSE, next_step, plan_pieces(found))


_VERBOSE = ("`--verbose` shows every table.",)
_SHORT = 12
"""Rows of a table shown without `--verbose`."""


def _level(look: Sequence[Verdict]) -> Level:
    return next((one for one in ("bad", "look") if any(line.level == one for line in look)), "good")


def _is_mass(name: str) -> bool:
    return name[:1] == "M" and name[1:].isdigit()


def _spread(mass: float, std: float) -> str:
    digits = max(0, -math.floor(math.log10(std))) if std > 0.0 and math.isfinite(std) else 4
    return f"{mass:.{digits}f} ± {std:.{digits}f} kg"


def open_page(page: Path) -> str:
    """The shell command that opens a page."""
    return f"open {quote(str(page))}"


def of_folder(
    folder: Path,
    page: Path | None,
    tables: Sequence[Piece] = (),
    more: Sequence[str] = (),
    advice: Sequence[str] = (),
) -> Ending:
    """The end of a run with results in `folder`. page : its report. more : sentences after the verdict."""
    results = ResultFolder.load(folder)
    lines = verdicts(results)
    level, sentence = headline(lines)
    numbers = dict(numbers_of(results.summary))
    numbers |= {line.subject: line.found for line in lines if line.subject in numbers}
    return Ending(
        level,
        ". ".join([sentence, *more]) + ".",
        tuple(numbers.items()),
        [line for line in lines if line.level != "good"],
        advice,
        open_page(page if page is not None else folder / "report.txt"),
        tables,
    )
