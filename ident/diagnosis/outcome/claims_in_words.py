"""A claim in words: a finding, two causes side by side, the answer of a discriminating experiment."""

from __future__ import annotations

import math
import re
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from ident.diagnosis.gain.rivals import margin
from ident.effects import EFFECTS, described, summary_of
from ident.effects.words import MODELS, joints_text, named, quantity_text, spoken

Plain = Mapping[str, Any]

SURE = 0.8
"""Default confidence below which a finding with alternatives is open between look-alikes."""
WIDTH = 100
"""Characters of a line."""

_SESSION = re.compile(r"\bsession ([1-9]\d*)\b")
_SEEN = {
    "motor": "Seen in the motor torque only.",
    "joint": "Acts on the links.",
    "sensor": "An error of the joint torque sensor.",
}
_SEEN_BY_BOTH = "Acts on the links, so both torques see it."


@dataclass(frozen=True)
class Comparison:
    """Two causes side by side. place : in the list of `look_alikes`, from 0; finding : number from 1, 0 if asked for.

    decides : empty for causes separated by these sessions.
    """

    place: int
    finding: int
    title: str
    overlap: str
    decides: str


@dataclass(frozen=True)
class FindingStatement:
    """One finding. facts : error, alternatives, discriminating motion; statistics : parameters with their meaning and
    the figures behind the claim; both as (label, text). doubt : why it is open, empty for one that is not.
    """

    number: int
    cause: str
    title: str
    text: str
    confidence: str
    facts: tuple[tuple[str, str], ...]
    statistics: tuple[tuple[str, str], ...]
    doubt: str

    @property
    def is_open(self) -> bool:
        """Whether the cause is not sure and others are possible."""
        return bool(self.doubt)

    def lines(self) -> list[str]:
        """For the terminal."""
        found = [f"{self.number}. {capital(self.title)} [{self.cause}]: {self.confidence}"]
        found += wrapped(self.text, "     ", "     ") if self.text else []
        for label, text in self.facts:
            if self.is_open or label.startswith("error"):
                found += wrapped(f"{label}: {text}", "     ", "        ")
        return found


def is_open(confidence: float | None, alternatives: Sequence[Any] | None, sure: float = SURE) -> bool:
    """Whether a finding is open between look-alikes."""
    return confidence is not None and confidence < sure and bool(alternatives)


def values_of(finding: Plain) -> dict[str, tuple[float, float, str]]:
    """Value, standard deviation and unit by parameter."""
    return {
        name: (float(one.get("value", math.nan)), float(one.get("std") or 0.0), str(one.get("unit", "1")))
        for name, one in (finding.get("parameters") or {}).items()
    }


def finding_statement(
    number: int,
    finding: Plain,
    names: Sequence[str],
    sure: float = SURE,
    *,
    both: bool = False,
    compared: bool = False,
    told_apart: bool = False,
    sessions: Sequence[str] = (),
) -> FindingStatement:
    """A finding in words. both : whether the sessions have both torques. compared : with a healthy arm. told_apart :
    from all its alternatives by the motion of these sessions. sessions : names, by their numbers."""
    cause, mode, side = str(finding["cause"]), finding.get("mode"), str(finding.get("side", ""))
    detail = finding.get("detail")
    meaning = ""
    if detail:
        meaning = f"{summary_of(cause)}: {detail}."
    elif finding.get("parameters"):
        meaning = f"{summary_of(cause)}: {described(cause, values_of(finding), finding.get('form'), names)}"
        meaning += f", {mode} sessions" if mode == "between" else ""
        meaning += f"{_carried(finding)}."
        meaning = meaning.replace(MODELS, "the healthy arm's") if compared else meaning
        meaning = _SESSION.sub(
            lambda found: sessions[int(found[1]) - 1] if int(found[1]) <= len(sessions) else found[0], meaning
        )
    seen = _SEEN_BY_BOTH if both and side == "joint" else _SEEN.get(side, "")
    confidence, others = finding.get("confidence"), finding.get("alternatives") or []
    doubt = ""
    if is_open(confidence, others, sure):
        doubt = "open: the cause may be none of the look-alikes" if told_apart else "open between look-alikes"
    known = "no confidence given" if confidence is None else f"confidence {confidence:.2f}"
    facts = []
    evidence = finding.get("evidence") or {}
    before, after = evidence.get("test_rms_before"), evidence.get("test_rms_after")
    if before and after is not None:
        rows = [f"{joints_text([joint], names)} {side}" for side, joint in evidence.get("rows") or ()]
        # Its own share: base and extended model differ by all causes, and without what differs from day to day.
        label = "error on held-out data, by this cause alone"
        label += f", {rows[0]}" if len(rows) == 1 else ""
        low, high = evidence.get("gain_interval_95") or (math.nan, math.nan)
        gain = f", less by {low:.3g} to {high:.3g} Nm (95 %)" if low < high else ""
        told = f"{before:.3g} -> {after:.3g} Nm{gain}"
        # A change between sessions shows as a change, and seldom in a further session.
        facts.append((label, f"{told}; they do not show it" if low <= 0.0 else told))
    facts += [("could also be", placed(other, names)) for other in others]
    if finding.get("tell_apart") and others:
        facts.append(("discriminating experiment", named(str(finding["tell_apart"]), names)))
    return FindingStatement(
        number,
        cause,
        placed(finding, names, always=True),
        " ".join(part for part in (capital(meaning), seen) if part),
        known + (f", {doubt}" if doubt else ""),
        tuple(facts),
        tuple(_statistics(finding)),
        doubt,
    )


def _carried(finding: Plain) -> str:
    """The sessions of a finding of some alone, with the payload that they state for a finding of it."""
    if not finding.get("sessions"):
        return ""
    payload = finding.get("payload")
    return f"; {f'payload {payload!r} ' if payload else ''}in {', '.join(finding['sessions'])}"


def _noises(times: float) -> str:
    """A size in units of the noise."""
    return f"{times:.2g} times" if times >= 0.01 else "less than 0.01 times"


def comparison(entry: Plain, names: Sequence[str], place: int = 0, *, neither: bool = False) -> Comparison:
    """Two causes side by side, from the plain content of a `LookAlikes`. neither : of an unsure finding that is told
    apart from all its alternatives."""
    first, second = (
        f"{spoken(one['cause'])} ({joints_text(one['joints'], names)})" for one in entry["causes"]
    )
    if not entry["told_apart"]:
        verdict = "not with these sessions"
    elif entry["shape_alone"]:
        verdict = (
            "their shapes differ enough, but without a motor torque a sensor error cannot be separated from a torque "
            "of the arm of the same shape"
        )
    else:
        verdict = "these sessions do" + ("; the cause may be neither" if neither else "")
    overlap = (
        f"overlap {entry['overlap']:.3f}: beside a refitted base model, {first} leaves "
        f"{_noises(entry['strength'][0])} the noise; {_noises(entry['apart'])} of it {second} cannot leave as well. "
        f"Telling them apart takes {entry['needed']:.2g} times: {verdict}"
    )
    decides, seen = "", entry.get("foreseen")
    if not entry["told_apart"] or entry["shape_alone"]:
        decides = " or ".join(dict.fromkeys(named(text, names) for text in entry["decides"]))
    if seen is not None:
        needed = math.sqrt(margin(seen["strength"] ** 2))
        decides += (
            f"{'; ' * bool(decides)}with {seen['file']} recorded as well, the expected overlap is "
            f"{seen['overlap']:.3f} and the expected rest {seen['apart']:.2g} times the noise, of {needed:.2g} needed: "
            + ("enough" if seen["apart"] > needed else "not enough")
        )
    return Comparison(place, int(entry.get("finding") or 0), f"{first} or {second}", overlap, decides)


def answer_statement(answer: Plain, names: Sequence[str]) -> str:
    """The answer of the discriminating experiments to one open finding."""

    def said(place: Plain) -> str:
        return f"{spoken(place['cause'])} ({joints_text(place['joints'], names)})"

    asked, found = " or ".join(map(said, answer["rivals"])), answer.get("named")
    named_one, confidence = "nothing" if found is None else said(found), f"{answer['confidence']:.2f}"
    if answer["outcome"] == "decided":
        return f"Decided: {named_one}, confidence {confidence}; the question was {asked}"
    if answer["outcome"] == "open":
        return (
            f"Still open after the discriminating experiments: {asked}; {named_one} is the better now, "
            f"confidence {confidence}"
        )
    return f"Decided against all candidates ({asked}); found instead: {named_one}"


def _statistics(finding: Plain) -> list[tuple[str, str]]:
    cause, evidence = str(finding["cause"]), finding.get("evidence") or {}
    meanings = {p.name: p.meaning for p in EFFECTS[cause].parameters} if cause in EFFECTS else {}
    rows = []
    for name, one in values_of(finding).items():
        meaning = meanings.get(name, "").replace("`", "")
        rows.append((spoken(name), quantity_text(*one) + (f" ({meaning})" if meaning else "")))
    for key, label in (("delta_bic", "ΔBIC"), ("p_value", "p-value")):
        if evidence.get(key) is not None:
            rows.append((label, f"{evidence[key]:.3g}"))
    return rows + [
        (f"ΔBIC with {spoken(other['cause'])} instead", f"{other['delta_bic']:.3g}")
        for other in finding.get("alternatives") or []
        if other.get("delta_bic") is not None
    ]


def beside(one: Comparison) -> list[str]:
    """Lines of a comparison below its finding."""
    found = wrapped(one.overlap, "     ", "        ")
    return found + (wrapped(f"to decide: {one.decides}", "     ", "        ") if one.decides else [])


def placed(entry: Plain, names: Sequence[str], *, always: bool = False) -> str:
    """A cause with its joints, in words. always : say `whole arm`, too."""
    joints = entry.get("joints", [])
    return spoken(str(entry["cause"])) + (f", {joints_text(joints, names)}" if joints or always else "")


def capital(text: str) -> str:
    """The text with a capital letter in front."""
    return text[:1].upper() + text[1:]


def wrapped(text: str, first: str, later: str) -> list[str]:
    """Lines of a text. first, later : indents."""
    wrapper = textwrap.TextWrapper(WIDTH, first, later, break_long_words=False, break_on_hyphens=False)
    return wrapper.wrap(text)
