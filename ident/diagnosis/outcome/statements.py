"""A diagnosis in words: one list of statements for terminal, report and notebook.

The statements are made from plain content, that of `diagnosis.json` (`content`) and of `details.json` (`details`);
each part of either may be missing.
"""

from __future__ import annotations

import math
import textwrap
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from ident.diagnosis.gain.held_out import FELT_WORSE
from ident.diagnosis.outcome.claims_in_words import (
    SURE,
    WIDTH,
    Comparison,
    FindingStatement,
    Plain,
    answer_statement,
    beside,
    capital,
    comparison,
    finding_statement,
    wrapped,
)
from ident.effects.words import spoken
from lwr_driver.listing import Listing, Piece, text_of

_MOST_ROWS = {"unexplained": 4, "absorbed": 5}
_REPR_LINES = 10
_AVOIDABLE_LOOK = 0.3
_WORSE_REPLAY = 1.1
REPLAYED = (
    ("position", "position", "mrad", 1e3),
    ("motor", "motor torque", "Nm", 1.0),
    ("joint", "joint torque", "Nm", 1.0),
)
"""Replayed quantities: key, words, unit, scale from SI."""
LIMITS = "limits of the data"
"""Subject of the line that counts the notes."""


@dataclass(frozen=True)
class Number:
    """A number in a table. key : its place in the file. most : largest size shown on a page; of a larger number only
    that it is larger."""

    value: float | None
    form: str = ".4g"
    key: str = ""
    most: float = math.inf

    def __str__(self) -> str:
        return "–" if self.value is None or math.isnan(self.value) else format(self.value, self.form)


Row = Sequence[str | Number]
Level = Literal["good", "look"]


@dataclass(frozen=True)
class Line:
    """One line of the summary. wanted : the value of a good result; anchor : of the part with the details."""

    subject: str
    found: str
    wanted: str
    level: Level
    anchor: str


@dataclass(frozen=True)
class Part:
    """Sentences and a table under a title. rows : of the table, each with its heading first."""

    anchor: str
    title: str
    sentences: Sequence[str] = ()
    head: Sequence[str] = ()
    rows: Sequence[Row] = ()

    def lines(self) -> list[Piece]:
        """For the terminal."""
        if self.anchor == "limits":
            return [line for note in self.sentences for line in wrapped(note, "note: ", "      ")]
        if self.anchor == "healthy":
            return [line for sentence in self.sentences for line in wrapped(sentence, "", "  ")]
        found: list[Piece] = [self.title]
        for sentence in self.sentences:
            found += wrapped(sentence, "  ", "    ")
        if not self.rows:
            return found
        most = _MOST_ROWS.get(self.anchor, len(self.rows))
        rows = [[str(cell) for cell in row] for row in self.rows[:most]]
        found.append(Listing(self.head, rows))
        more = len(self.rows) - most
        return [*found, f"  ... and {more} more"] if more > 0 else found


@dataclass(frozen=True)
class Statements:
    """All that a diagnosis says.

    character : what every such drive has, numbered on behind the findings. lines : the summary. answers : of the
    discriminating experiments already run. comparisons : causes side by side, of a finding or on
    request, besides those of a finding. parts : in their order, empty ones left out.
    """

    about: str
    level: Level
    headline: str
    lines: tuple[Line, ...]
    answers: tuple[str, ...]
    findings: tuple[FindingStatement, ...]
    character: tuple[FindingStatement, ...]
    comparisons: tuple[Comparison, ...]
    parts: tuple[Part, ...]

    def text(self) -> str:
        """The whole as plain text."""
        return text_of(self.pieces())

    def pieces(self) -> list[Piece]:
        """The whole, for the terminal."""
        found: list[Piece] = [*wrapped(self.about, "", "  "), *wrapped(f"{self.headline}.", "", "")]
        found += [f"{answer}." for answer in self.answers]
        found += [line for part in self.parts if part.anchor == "data" for line in part.lines()]
        for finding in (*self.findings, *self.character):
            if self.character and finding is self.character[0]:
                found.append("Character of the arm, as drives of its kind have it:")
            found += finding.lines()
            found += [x for one in self.comparisons if one.finding == finding.number for x in beside(one)]
        for one in self.comparisons:
            if not one.finding:
                found += [f"Side by side: {one.title}", *beside(one)]
        rest = (part for part in self.parts if part.anchor != "data")
        return [*found, *(line for part in rest for line in part.lines())]

    def brief(self) -> str:
        """Headline and summary, at most ten lines."""
        found = [self.about, f"{self.headline}.", *(f"{line.subject}: {line.found}" for line in self.lines)]
        more = len(found) - _REPR_LINES
        kept = [*found[: _REPR_LINES - 1], f"... and {more + 1} more lines"] if more > 0 else found
        return "\n".join(textwrap.shorten(line, 2 * WIDTH, placeholder=" ...") for line in kept)


def statements(
    content: Plain, details: Plain, names: Sequence[str], answers: Sequence[Plain] = ()
) -> Statements:
    """The statements of a diagnosis. names : of the joints. answers : of decision.json."""
    sure = float(details.get("sure", SURE))
    claims = [*content.get("findings", []), *content.get("character", [])]
    both = sum(map(bool, ((content.get("baseline") or {}).get("noise_floor") or {}).values())) > 1
    pairs = details.get("look_alikes") or []
    apart = Counter(p["finding"] for p in pairs if p["told_apart"] and not p["shape_alone"])
    told_apart = {
        number
        for number, one in enumerate(claims, start=1)
        if apart[number] >= len(one.get("alternatives") or ()) > 0
    }
    compared = bool(details.get("reference"))
    said = [
        finding_statement(
            number,
            one,
            names,
            sure,
            both=both,
            compared=compared,
            told_apart=number in told_apart,
            sessions=details.get("sessions") or (),
        )
        for number, one in enumerate(claims, start=1)
    ]
    unsure = {one.number for one in said if one.is_open} & told_apart
    count = len(content.get("findings", []))
    findings, character = said[:count], said[count:]
    level, headline = _headline(content, details, findings)
    parts = (
        _data(content, names),
        _healthy(content, names),
        _experiments(details, names),
        _nameless(content, names),
        _unexplained(content, names),
        _gain(content, details, names),
        _replay(content, names),
        _absorbed(details),
        Part("limits", "Limits of these data", details.get("notes", ())),
    )
    return Statements(
        f"Diagnosis of {', '.join((content.get('sessions') or {}).get('train', []))}",
        level,
        headline,
        tuple(_lines(content, details, findings, character, names)),
        tuple(answer_statement(answer, names) for answer in answers),
        tuple(findings),
        tuple(character),
        tuple(comparison(one, names, k, neither=one["finding"] in unsure) for k, one in enumerate(pairs)),
        tuple(part for part in parts if part.sentences or part.rows),
    )


def run_advice(experiment: str | None) -> str:
    """How to run discriminating experiments. experiment : folder of the experiment, None for a diagnosis of logs."""
    if experiment is not None:
        return f"`lwr-run experiment --resume {experiment} --decide` runs the discriminating experiments and concludes."
    return (
        "Each is a plan with all checks passed: name it in an experiment file, `excitation: {plan: FILE}`, run it, "
        "and give its session to `lwr-run diagnose` beside these."
    )


def error_change(gain: float) -> str:
    """A share of the error removed, as the change of the error; small ones with a decimal, none without a sign."""
    percent = round(-100.0 * gain, 0 if abs(gain) >= 0.01 else 1)
    return f"{percent:+g} %" if percent else "0 %"


def extension_gain(content: Plain) -> float | None:
    """Share of the error on held-out data removed by the extended model, mean over joints and sides."""
    shares = [share for share, _ in _shares(content, ())]
    return sum(shares) / len(shares) if shares and is_extended(content) else None


def is_extended(content: Plain) -> bool:
    """Whether the extended model holds anything beyond the base model."""
    return any(content.get(key) for key in ("extension", "findings", "character", "nameless"))


NOTHING = "nothing found"
"""Beginning of a diagnosis in short without a cause."""


def in_short(content: Plain, names: Sequence[str]) -> tuple[Level, str]:
    """The whole diagnosis in one line of a run's summary."""
    causes = [spoken(str(finding["cause"])) for finding in content.get("findings", [])]
    unexplained = len(content.get("unexplained", []))
    text = f"found: {', '.join(dict.fromkeys(causes))}" if causes else NOTHING
    character = [spoken(str(one["cause"])) for one in content.get("character", [])]
    text += f"; character of the arm: {', '.join(dict.fromkeys(character))}" if character else ""
    text += f"; terms without a name: {len(content['nameless'])}" if content.get("nameless") else ""
    text += f"; {unexplained} unexplained" if unexplained else ""
    gain = extension_gain(content)
    if gain is not None:
        best, place = max(_shares(content, names))
        text += (
            f"; the extended model: {place} {error_change(best)} error on held-out data, {error_change(gain)} on "
            "average"
        )
    return ("look" if causes or unexplained else "good"), text


def _shares(content: Plain, names: Sequence[str]) -> list[tuple[float, str]]:
    """Share of the error removed by the extended model, and its joint and side."""
    gain = content.get("gain") or {}
    base, extended = gain.get("test_rms_base") or {}, gain.get("test_rms_extended") or {}
    return [
        (1.0 - after / before, f"{_name(k + 1, names)} {side}")
        for side in base
        for k, (before, after) in enumerate(zip(base[side] or (), extended.get(side) or (), strict=False))
        if before and after is not None
    ]


def _data(content: Plain, names: Sequence[str]) -> Part:
    sentences = []
    for one in content.get("data", []):
        subject = (
            f"{_name(one['joint'], names)} {one['channel']}" if one.get("joint") else str(one["channel"])
        )
        sentences.append(f"{capital(subject)}: {one['what']}; {one['advice']}")
    return Part("data", "Channels that cannot be what they say", tuple(dict.fromkeys(sentences)))


def _healthy(content: Plain, names: Sequence[str]) -> Part:
    """What the reference has of its own: cause and joints, once each."""
    joints: dict[str, dict[str, None]] = {}
    for entry in content.get("healthy", []):
        own = joints.setdefault(spoken(str(entry["cause"])), {})
        own.update(dict.fromkeys(_name(joint, names) for joint in entry["joints"]))
    listed = "; ".join(f"{cause} ({', '.join(own)})" if own else cause for cause, own in joints.items())
    return Part("healthy", "Healthy arm", [f"The healthy arm has: {listed}."] * bool(listed))


def _headline(content: Plain, details: Plain, findings: Sequence[FindingStatement]) -> tuple[Level, str]:
    if content.get("data") and not findings:
        return (
            "look",
            "Channels of these data cannot be what they say: mend them first; no cause is named from them",
        )
    doubts, count = [finding.doubt for finding in findings if finding.is_open], len(findings)
    doubt = doubts[0] if len(set(doubts)) == 1 else "open"
    if count == 1:
        return "look", "One cause found" + (f", {doubt}" if doubts else "")
    if count:
        doubtful = f", {'one' if len(doubts) == 1 else len(doubts)} of them {doubt}"
        return "look", f"{count} causes found, the largest effect first" + (doubtful if doubts else "")
    if details.get("in_doubt"):
        return "look", "No cause found, but channels of these data are in doubt: check them first"
    if content.get("character"):
        return "good", "No cause found beyond the character of such an arm, which the extended model now has"
    rest = [*content.get("nameless", []), *content.get("unexplained", [])]
    if rest:
        if not any(one["depends_on"] for one in rest):
            return "look", "The data support no cause, but the error is far beyond that of the healthy days"
        of_time = all(one["depends_on"] in ([], ["time"]) for one in rest)
        on = "change with the time and not with the motion" if of_time else "depend on the motion"
        return "look", f"The data support no cause, but the residuals {on}"
    rows = details.get("rows", [])
    beyond = max(map(_beyond_healthy, rows), default=0.0)
    if max((row["avoidable_share"] for row in rows), default=0.0) < _AVOIDABLE_LOOK > beyond:
        return "good", "No model error is detectable in these data"
    if beyond < _AVOIDABLE_LOOK:
        more = "hardly" if beyond > 0.0 else "no"
        return "good", f"No cause found, and {more} more error on held-out data than on the healthy days"
    than = "that of the healthy days" if any(row.get("healthy") for row in rows) else "the noise"
    return "look", (
        f"The data support no cause, but up to {100 * beyond:.0f} % of the error's power on held-out data is above "
        f"{than}; more or repeated motions may show the cause"
    )


def _beyond_healthy(row: Plain) -> float:
    """Share of power of the base model's error above the noise, and above its error on the healthy arm."""
    share, healthy = float(row["avoidable_share"]), row.get("healthy")
    if not healthy or row["test_rms_base"] <= 0.0:
        return share
    return min(share, 1.0 - float(healthy / row["test_rms_base"]) ** 2)


def _channels(told: Sequence[Plain], names: Sequence[str]) -> str:
    """Broken or doubtful channels, those of one kind together with what they look like."""
    alike: dict[tuple[str, str], dict[str, None]] = {}
    for one in told:
        _, _, looks = str(one["what"]).rpartition("looks like ")
        joint = _name(one["joint"], names) if one.get("joint") else ""
        alike.setdefault((one["channel"], looks), {})[joint] = None
    return "; ".join(
        f"{', '.join(joints)} {channel}{f' ({looks})' * bool(looks)}".strip()
        for (channel, looks), joints in alike.items()
    )


def _lines(
    content: Plain,
    details: Plain,
    findings: Sequence[FindingStatement],
    character: Sequence[FindingStatement],
    names: Sequence[str],
) -> list[Line]:
    found = []
    for subject, channels, anchor in (
        ("broken channels", content.get("data", ()), "data"),
        ("channels in doubt", details.get("in_doubt", ()), "limits"),
    ):
        found += [Line(subject, _channels(channels, names), "none", "look", anchor)] * bool(channels)
    for finding in findings:
        parts = [finding.text, *(f"{label} {text}" for label, text in finding.facts[:1]), finding.confidence]
        text = "; ".join(part.rstrip(".") for part in parts if part)
        found.append(Line(finding.title, text, "", "look", "findings"))
    if not findings:
        found.append(Line("causes", "none supported by the data", "none", "good", "findings"))
    if character:
        titles = "; ".join(one.title for one in character)
        found.append(Line("character of the arm", titles, "", "good", "findings"))
    nameless = ", ".join(f"{_name(u['joint'], names)} {u['side']}" for u in content.get("nameless", []))
    if nameless:
        found.append(Line("terms without a name", nameless, "none", "look", "nameless"))
    rest = ", ".join(f"{_name(u['joint'], names)} {u['side']}" for u in content.get("unexplained", []))
    level: Level = "look" if rest else "good"
    found.append(Line("unexplained residuals", rest or "none", "none", level, "unexplained"))
    gain = extension_gain(content)
    if gain is not None:
        best, place = max(_shares(content, names))
        text = f"{error_change(gain)} error on held-out data on average, {place} {error_change(best)}"
        worse = _worse(details, names)
        text += f"; worse: {', '.join(worse)}" if worse else ""
        if findings and content.get("extension") == []:
            text = (
                "the base model: no cause here is a term that lasts and lessens the error of further sessions"
            )
            found.append(Line("extended model", text, "", "good", "gain"))
        else:
            found.append(
                Line("extended model", text, "less", "look" if worse or gain <= 0.0 else "good", "gain")
            )
    found += _replay_line(content)
    count = len(details.get("notes", []))
    if count:
        text = f"{count} notes on limits of these data" if count > 1 else "one note"
        found.append(Line(LIMITS, text, "", "look", "limits"))
    return found


def _replay_line(content: Plain) -> list[Line]:
    before, after = _simulated(content)
    parts, worse = [], False
    for key, label, unit, scale in REPLAYED:
        if not before.get(key) or not after.get(key):
            continue
        sizes = [math.hypot(*(v for v in side[key] if v is not None)) * scale for side in (before, after)]
        worse = worse or sizes[1] > _WORSE_REPLAY * sizes[0]
        change = f"{sizes[0]:.3g} -> {sizes[1]:.3g}" if is_extended(content) else f"{sizes[0]:.3g}"
        parts.append(f"{label} {change} {unit}")
    text = f"error over all joints together: {', '.join(parts)}"
    return [Line("replay in simulation", text, "less", "look" if worse else "good", "replay")] * bool(parts)


def _worse(details: Plain, names: Sequence[str]) -> list[str]:
    """Rows with a larger error by more than chance, and by more than anyone would feel."""
    felt = (
        row
        for row in details.get("rows", [])
        if row["gain_interval_95"][1] < 0.0
        and row["test_rms_extended"] > (1.0 + FELT_WORSE) * row["test_rms_base"]
    )
    return [f"{_name(row['joint'], names)} {row['side']}" for row in felt]


def _experiments(details: Plain, names: Sequence[str]) -> Part:
    sentences = []
    for offer in details.get("deciding_motions") or []:
        where = "" if offer["joint"] is None else f" of {_name(offer['joint'], names)}"
        loads = " and ".join("bare" if load is None else f"with {load}" for load in offer["payloads"])
        causes = " or ".join(dict.fromkeys(spoken(rival["cause"]) for rival in offer["rivals"]))
        sentences.append(
            f"{capital(offer['kind'])}{where}, {offer['duration_s']:.0f} s, {loads}, for {causes}: `{offer['file']}`"
        )
    return Part("deciding", "Discriminating experiments", sentences)


def _nameless(content: Plain, names: Sequence[str]) -> Part:
    rows = [
        (
            f"{_name(entry['joint'], names)} {entry['side']}",
            ", ".join(entry.get("depends_on", [])),
            Number(entry.get("test_rms_before"), ".3g"),
            Number(entry.get("test_rms_after"), ".3g"),
        )
        for entry in content.get("nameless", [])
    ]
    sentence = (
        "No cause of the catalogue fits here. The extended model holds a smooth function of these variables; they are "
        "all that is claimed."
    )
    head = ("torque", "depends on", "error before [Nm]", "after [Nm]")
    return Part("nameless", "Terms without a name", [sentence] * bool(rows), head, rows)


def _unexplained(content: Plain, names: Sequence[str]) -> Part:
    rows = [
        (
            f"{_name(entry['joint'], names)} {entry['side']}",
            ", ".join(entry.get("depends_on", [])) or "no single variable",
            Number(entry.get("test_rms"), ".3g"),
            Number(entry.get("noise_floor"), ".3g"),
        )
        for entry in content.get("unexplained", [])
    ]
    head = ("torque", "depends on", "error on held-out data [Nm]", "noise floor [Nm]")
    return Part("unexplained", "Unexplained residuals", (), head, rows)


def _gain(content: Plain, details: Plain, names: Sequence[str]) -> Part:
    """Errors by joint and side: of test sessions first with all samples, then in the rows of the diagnosis."""
    gain = content.get("gain") or {}
    floor = (content.get("baseline") or {}).get("noise_floor") or {}
    measured = {(row["side"], row["joint"]): row for row in details.get("rows", [])}
    is_named = is_extended(content)
    sessions = ", ".join((content.get("sessions") or {}).get("test") or [])
    both = bool(sessions) and "rows_base" in gain
    usual = ["healthy, at most"] * any(row.get("healthy") is not None for row in measured.values())
    rows: list[Row] = []
    for side, errors in (gain.get("rows_base" if both else "test_rms_base") or {}).items():
        for k in range(len(errors or ())):
            row = measured.get((side, k + 1), {})
            share, span = row.get("avoidable_share"), row.get("gain_interval_95")
            noise = [Number(_at(floor, side, k), ".4f")]
            noise += [Number(row.get("healthy"), ".4f")] * bool(usual)
            shown = _models(gain, "test_rms", side, k)[: 1 + is_named]
            change = [_change(*shown)] if is_named else []
            cells: list[str | Number] = [*noise, *shown, *change]
            if both:
                cells = [*shown, *change, *noise, *_models(gain, "rows", side, k)[: 1 + is_named]]
            if is_named:
                text = "–" if not span else f"{span[0]:+.4f} to {span[1]:+.4f}"
                cells.append(text.replace("-", "\N{MINUS SIGN}"))
            cells.append(Number(None if share is None else 100 * share, ".0f"))
            rows.append((f"{_name(k + 1, names)} {side}", *cells))
    if not rows:
        return Part("gain", "Gain")
    held_out = sessions or "each part of the motion, predicted from the others"
    sentences = [f"Root mean square errors below are on held-out data: {held_out}."]
    if both:
        sentences.append(
            "First with all samples, as `validate` measures them; then in the rows of the diagnosis, without reversals."
        )
    whole, worse = extension_gain(content), _worse(details, names) if is_named else []
    if whole is not None:
        sentences.append(f"Mean over joints and sides: {error_change(whole)} error.")
    if worse:
        sentences.append(f"Worse than the base model by more than chance: {', '.join(worse)}.")
    for entry in details.get("torque_errors", []):
        parts = [_percents(side, errors, is_named) for side, errors in entry["by_side"].items()]
        sentences.append(
            f"Torque error of {entry['session']} (all samples, as of `validate`): {', '.join(parts)}."
        )
    more, inside = ["extended [Nm]", "change %"] * is_named, ["gain [Nm], 95 %"] * is_named
    head = ["torque", "noise [Nm]", *usual, "base model [Nm]", *more, *inside, "avoidable %"]
    if both:
        more, inside = ["extended", "change %"] * is_named, ["rows: extended", "gain, 95 %"] * is_named
        head = ["rms [Nm]", "base", *more, "rows: noise", *usual, "rows: base", *inside, "avoidable %"]
    return Part("gain", "Gain" if is_named else "Error on held-out data", sentences, head, rows)


def _models(gain: Plain, kind: str, side: str, joint: int) -> list[Number]:
    """Errors [Nm] of base and extended model at a joint (from 0), `kind` with all samples (`test_rms`) or in the
    rows."""
    keys = (f"{kind}_base", f"{kind}_extended")
    return [
        Number(_at(gain.get(key) or {}, side, joint), ".4f", f"gain.{key}.{side}.{joint}") for key in keys
    ]


def _change(before: Number, after: Number) -> Number:
    """Change of an error in percent."""
    if not before.value or after.value is None:
        return Number(None)
    return Number(100 * (after.value / before.value - 1), "+.1f")


def _at(table: Plain, side: str, joint: int) -> float | None:
    values = table.get(side) or ()
    return values[joint] if joint < len(values) else None


def _percents(side: str, errors: Plain, is_named: bool) -> str:
    base, extended = (100.0 * errors[name] for name in ("base", "extended"))
    present = errors.get("present")
    return (
        f"{side} {base:.2f} %"
        + (f", extended {extended:.2f} %" if is_named else "")
        + ("" if present is None else f", present model {100.0 * present:.2f} %")
    )


def _simulated(content: Plain) -> tuple[Plain, Plain]:
    gain = content.get("gain") or {}
    return gain.get("simulation_error_base") or {}, gain.get("simulation_error_extended") or {}


def _replay(content: Plain, names: Sequence[str]) -> Part:
    """Error of the replay along the measured positions, without and with the extension."""
    before, after = _simulated(content)
    rows: list[Row] = []
    for key, label, unit, scale in REPLAYED:
        for model, errors in (("base model", before), ("extended", after)):
            if errors.get(key) and (model == "base model" or (is_extended(content) and before.get(key))):
                cells = [Number(None if v is None else scale * v, ".3f") for v in errors[key]]
                rows.append((f"{label} [{unit}], {model}", *cells))
    said = ["No controller enters: measured minus simulated, root mean square."]
    method = (content.get("gain") or {}).get("simulation") or {}
    said += [f"{capital(what)}: {how}." for what, how in method.items()]
    return Part("replay", "Replay in simulation", said * bool(rows), ("", *names), rows)


def _absorbed(details: Plain) -> Part:
    """Base parameters with errors in the base model, for they had absorbed the findings."""
    forms = {"base": ".4g", "extended": ".4g", "std": ".2g", "change_in_std": "+.1f"}
    rows: list[Row] = [
        (str(entry["name"]), *(Number(entry[key], form) for key, form in forms.items()), str(entry["unit"]))
        for entry in details.get("base_parameters") or []
    ]
    head = ("parameter", "base model", "extended", "std", "change [std]", "unit")
    sentence = "Wrong in the base model: they had absorbed the causes now in the extended model."
    return Part("absorbed", "Base parameters affected by the findings", [sentence] * bool(rows), head, rows)


def _name(joint: int, names: Sequence[str]) -> str:
    return names[joint - 1] if 0 < joint <= len(names) else str(joint)
