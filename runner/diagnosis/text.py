"""A diagnosis on one screen."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from typing import TYPE_CHECKING

from ident.diagnosis import Diagnosis, Finding, SimulationError
from ident.effects import described, find_effect, summary_of
from ident.effects.words import joints_text, named, quantity_text
from runner.diagnosis.measures import Moved, RowGain

if TYPE_CHECKING:
    from runner.diagnosis.look_alikes import LookAlikes
    from runner.diagnosis.study import Study

__all__ = ["study_text"]

_WIDTH = 100
_SURE = 0.8
_MOST_MOVED = 5
_UNEXPLAINED_SHARE = 0.3
_MOST_UNEXPLAINED = 4


def study_text(study: Study) -> str:
    """Findings first, then what was gained, then what could not be seen."""
    diagnosis = study.diagnosis
    names = diagnosis.base_model.structure.chain.joint_names
    lines = [f"Diagnosis of {', '.join(diagnosis.train)}"]
    unseen = ", ".join(diagnosis.test) or "each part of the motion, predicted from the others"
    lines.append(f"  errors below are on what was not fitted: {unseen}")
    lines += _headline(study)
    for number, finding in enumerate(diagnosis.findings, start=1):
        lines += _finding(number, finding, names)
        lines += [line for pair in study.pairs if pair.finding == number for line in _beside(pair, names)]
    for u in diagnosis.unexplained[:_MOST_UNEXPLAINED]:
        lines.append(
            f"  seen but unnamed: {u.side} torque of {names[u.joint - 1]} depends on {', '.join(u.depends_on)} "
            f"({u.test_rms:.3g} Nm, noise {u.noise_floor:.3g} Nm)"
        )
    more = len(diagnosis.unexplained) - _MOST_UNEXPLAINED
    if more > 0:
        lines.append(f"  ... and {more} more of that kind, in diagnosis.json")
    for pair in study.pairs:
        if not pair.finding:
            lines.append(f"Side by side: {pair.title(names)}")
            lines += _beside(pair, names, decides=True)
    lines += _table(study.gains, names, bool(diagnosis.findings))
    lines += _simulated(diagnosis, names)
    lines += _moved(study.moved)
    lines += [line for note in study.notes for line in _wrapped(note, "note: ", "      ")]
    lines += [line for offer in study.offers for line in _wrapped(str(offer), "to decide: ", "      ")]
    return "\n".join(lines)


def _headline(study: Study) -> list[str]:
    found, rest = study.diagnosis.findings, study.diagnosis.unexplained
    if not found and not rest:
        worst = max((gain.avoidable_share for gain in study.gains), default=0.0)
        if worst < _UNEXPLAINED_SHARE:
            return ["Nothing is wrong that these data could show."]
        return [
            "No cause is claimed: these data do not carry one. Yet what was not fitted is predicted worse than",
            f"noise explains (up to {100 * worst:.0f} % of the error's power is avoidable): more motions, or repeated "
            "ones, would tell.",
        ]
    if not found:
        return ["No cause can be named, but the model misses something that these data show:"]
    many = f"{len(found)} findings, the one that matters most first" if len(found) > 1 else "One finding"
    doubtful = sum(f.confidence < _SURE for f in found)
    doubt = f" ({doubtful} of them open between look-alikes)" if doubtful and len(found) > 1 else ""
    return [f"{many}{doubt}:"]


def _finding(number: int, finding: Finding, names: Sequence[str]) -> list[str]:
    sure = f"{finding.confidence:.2f}" + ("" if finding.confidence >= _SURE else ", open")
    place = joints_text(finding.joints, names)
    mode = f", {finding.mode}" if finding.mode and not find_effect(finding.cause).counted else ""
    lines = [f"{number}. {finding.cause}, {place} ({finding.side} side{mode}): confidence {sure}"]
    lines.append(f"     {summary_of(finding.cause)}")
    if find_effect(finding.cause).counted and finding.mode:
        lines.append(f"     {finding.mode}")
    else:
        lines += _wrapped(described(finding.cause, finding.values, finding.form, names), "     ", "     ")
        e = finding.evidence
        low, high = e.gain_interval_95
        lines.append(
            f"     error {e.test_rms_before:.3g} -> {e.test_rms_after:.3g} Nm, less by {low:.2g} to {high:.2g} "
            "(95 %)"
        )
    if finding.confidence < _SURE and finding.alternatives:
        rivals = "; ".join(
            ", ".join([cause, joints_text(joints, names)] if joints else [cause])
            for cause, joints, _ in finding.alternatives[:3]
        )
        decides = named(finding.tell_apart, names)
        lines += _wrapped(f"{rivals}. What would decide: {decides}", "     or ", "        ")
    return lines


def _beside(pair: LookAlikes, names: Sequence[str], *, decides: bool = False) -> list[str]:
    said, motion = pair.sentences(names)
    lines = _wrapped(said, "     ", "        ")
    if pair.foreseen is not None:
        lines += _wrapped(pair.foreseen.sentence(), "     ", "        ")
    return (
        lines + _wrapped(f"what would decide: {motion}", "     ", "        ")
        if decides and pair.open
        else lines
    )


def _table(gains: Sequence[RowGain], names: Sequence[str], found: bool) -> list[str]:
    if not gains:
        return []
    lines = ["Torque error on what was not fitted [Nm]", " " * 18 + "".join(f"{name:>11}" for name in names)]
    for side in ("motor", "joint"):
        mine = {gain.joint: gain for gain in gains if gain.side == side}
        if not mine:
            continue

        def row(label: str, cells: dict[int, str]) -> str:
            return f"  {label:<16}" + "".join(f"{cells.get(j + 1, ''):>11}" for j in range(len(names)))

        lines.append(row(f"{side}, noise", {j: f"{g.noise:.4f}" for j, g in mine.items()}))
        lines.append(row("  base model", {j: f"{g.base:.4f}" for j, g in mine.items()}))
        if found:
            lines.append(row("  extended", {j: f"{g.extended:.4f}" for j, g in mine.items()}))
            lines.append(row("  gain, 95 % from", {j: f"{g.interval_95[0]:+.4f}" for j, g in mine.items()}))
            lines.append(row("              to", {j: f"{g.interval_95[1]:+.4f}" for j, g in mine.items()}))
        lines.append(row("  avoidable", {j: f"{100 * g.avoidable_share:.0f} %" for j, g in mine.items()}))
    worse = [f"{names[g.joint - 1]} ({g.side})" for g in gains if g.interval_95[1] < 0.0]
    if worse and found:
        lines.append(f"  worse than the base model by more than chance: {', '.join(worse)}")
    return lines


def _simulated(diagnosis: Diagnosis, names: Sequence[str]) -> list[str]:
    base, extended = diagnosis.simulation_base, diagnosis.simulation_extended
    if base is None:
        return []
    lines = ["Replayed in simulation, measured less simulated (rms)"]
    for label, key, scale in (
        ("position [mrad]", "position", 1e3),
        ("motor [Nm]", "motor", 1.0),
        ("joint [Nm]", "joint", 1.0),
    ):
        before = getattr(base, key)
        if before is None:
            continue
        lines.append(f"  {label:<16}" + "".join(f"{scale * v:>11.3f}" for v in before))
        after = None if extended is None or not diagnosis.findings else _values(extended, key)
        if after is not None:
            lines.append(f"  {'  extended':<16}" + "".join(f"{scale * v:>11.3f}" for v in after))
    return lines


def _values(error: SimulationError, key: str) -> Sequence[float] | None:
    values = getattr(error, key)
    return None if values is None else list(values)


def _moved(moved: Sequence[Moved]) -> list[str]:
    if not moved:
        return []
    texts = [
        f"{m.name} {m.base:.4g} -> {quantity_text(m.extended, m.std, m.unit)}" for m in moved[:_MOST_MOVED]
    ]
    return _wrapped(", ".join(texts), "The base model had absorbed it in: ", "  ")


def _wrapped(text: str, first: str, later: str) -> list[str]:
    return textwrap.wrap(
        text,
        _WIDTH,
        initial_indent=first,
        subsequent_indent=later,
        break_long_words=False,
        break_on_hyphens=False,
    )
