"""Verdicts on a run: one line per question, with finding, requirement and verdict."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal

import numpy as np

from ident.diagnosis.statements import in_short
from runner.report.folder import ResultFolder

Level = Literal["good", "look", "bad"]

_TRACKING_LOOK_RAD = 0.02
_LATE_LOOK = 1e-3
_SLOWEST_S = 2e-3
_RESIDUAL_LOOK = 0.05
_TRUTH_WANTED = 0.95
_MASS_TOLERANCE = 0.01
# Covered by all standard deviations except the textbook's.
_COVERED = ("serially uncorrelated", "equal variance", "normality")


@dataclass(frozen=True)
class Verdict:
    """One line of the first table. section : anchor of the details in the report."""

    subject: str
    found: str
    wanted: str
    level: Level
    section: str = ""


def verdicts(results: ResultFolder) -> list[Verdict]:
    """The verdicts on a folder, in the order of importance."""
    found = (question(results) for question in _QUESTIONS)
    return [verdict for verdict in found if verdict is not None]


def headline(lines: list[Verdict]) -> tuple[Level, str]:
    """The whole run in one sentence."""
    bad = [line.subject for line in lines if line.level == "bad"]
    look = [line.subject for line in lines if line.level == "look"]
    if bad:
        return "bad", f"Not a good run: {_listed(bad)}"
    if look:
        things = "one thing" if len(look) == 1 else f"{len(look)} things"
        return "look", f"A usable run, with {things} to look at: {_listed(look)}"
    return "good", "A good run"


def _exit(results: ResultFolder) -> Verdict:
    summary = results.summary
    status = summary["exit_status"]
    done = [entry["name"] for entry in summary["sessions"] if entry["exit_status"] == "success"]
    reason = f": {summary['reason']}" if summary.get("reason") else ""
    kind = "logs" if summary.get("from_logs") else "sessions finished"
    text = f"{status}{reason}; {kind}: {', '.join(done) or 'none'}"
    done_well = status == "success"
    wanted = "success" if done_well else f"success; lwr-run experiment --resume {results.path} goes on"
    return Verdict("exit status", text, wanted, "good" if done_well else "bad", "sessions")


def _link(results: ResultFolder) -> Verdict | None:
    links = results.summary.get("link", {}).values()
    if not links:
        return None
    cycles, missed, lost, late = (
        sum(int(link[key]) for link in links) for key in ("cycles", "missed", "lost", "late")
    )
    reply = max((link["latency_s"].get("p99", 0.0) for link in links), default=0.0)
    # The histogram of the loop ends at 2 ms.
    replies = f"99 % of replies within {1e6 * reply:.0f} µs"
    if results.lock_step:
        replies = "lock step, so the emulator waited for every reply"
    elif reply >= _SLOWEST_S:
        replies = "replies take over 2 ms"
    text = f"{missed} missed, {lost} lost, {late} late of {cycles} cycles; {replies}"
    level: Level = "good" if missed + lost == 0 and late <= _LATE_LOOK * cycles else "look"
    return Verdict("link quality", text, "none missed or lost", level, "sessions")


def _limits(results: ResultFolder) -> Verdict | None:
    items = [item for list_ in results.preflights.values() for item in list_]
    if not items:
        return None
    failed = [item["subject"] for item in items if not item["ok"]]
    clearance = [item for item in items if item["subject"] == "clearance"]
    tightest = min(clearance, key=lambda item: _leading(item["value"]), default=None)
    margin = "" if tightest is None else f"; tightest: {tightest['value']} (limit {tightest['limit']})"
    unknown = [name for name in results.sessions if name not in results.preflights]
    margin += f"; no record of {_listed(unknown)}" if unknown else ""
    text = f"not held: {_listed(failed)}" if failed else f"all {len(items)} conditions held{margin}"
    return Verdict("limits", text, "every condition held", "bad" if failed else "good", "sessions")


def _tracking(results: ResultFolder) -> Verdict | None:
    worst, where = -1.0, ""
    for name, link in results.summary.get("link", {}).items():
        errors = link["worst_tracking_error_rad"]
        joint = int(np.argmax(errors))
        if errors[joint] > worst:
            worst = float(errors[joint])
            known = results.joint_names
            where = f"{known[joint] if joint < len(known) else f'joint {joint + 1}'}, {name}"
    if worst < 0.0:
        return None
    level: Level = "good" if worst <= _TRACKING_LOOK_RAD else "look"
    wanted = f"below {1000 * _TRACKING_LOOK_RAD:.0f} mrad"
    return Verdict("tracking error", f"at most {1000 * worst:.1f} mrad ({where})", wanted, level, "sessions")


def _share(subject: str, unseen: bool, results: ResultFolder) -> Verdict | None:
    """How much of the measured torque is not computed, by side. unseen : of the held-out motions."""
    parts, worst = [], 0.0
    shown = [one for one in results.curves if one.unseen == unseen]
    for side in dict.fromkeys(one.side for one in shown):
        mine = [one for one in shown if one.side == side]
        squares = np.array([[score.band_rms**2 for score in one.scores] for one in mine])
        torque = np.array([np.nanmean(one.measured**2, axis=0) for one in mine])
        share = math.sqrt(float(np.nansum(squares)) / float(np.nansum(torque)))
        worst = max(worst, share)
        parts.append(f"{side} {100 * share:.2f} %")
    if not parts:
        return None
    text = f"{', '.join(parts)} of the torque unexplained, in the band of the estimation"
    level: Level = "good" if worst <= _RESIDUAL_LOOK else "look"
    return Verdict(subject, text, f"below {100 * _RESIDUAL_LOOK:.0f} %", level, "torque")


def _assumptions(results: ResultFolder) -> Verdict | None:
    checks: Mapping[str, Any] | None = results.summary.get("assumptions")
    if not checks:
        return None
    violated = [name for name, check in checks.items() if check["verdict"] == "VIOLATED"]
    held = sum(check["verdict"] == "holds" for check in checks.values())
    text = f"{held} of {len(checks)} hold" + (f"; violated: {_listed(violated)}" if violated else "")
    if violated and not str(results.summary.get("covariance", "")).startswith("textbook"):
        covered = [name for name in violated if name in _COVERED]
        open_ones = [name for name in violated if name not in _COVERED]
        text = f"{held} of {len(checks)} hold"
        text += f"; covered by the deviations: {_listed(covered)}" if covered else ""
        text += f"; not covered: {_listed(open_ones)}" if open_ones else ""
        violated = open_ones
    return Verdict("assumptions", text, "none uncovered", "look" if violated else "good", "assumptions")


def _essential(results: ResultFolder) -> Verdict | None:
    essential = results.summary.get("essential")
    if not essential:
        return None
    rsd = [entry["rsd_percent"] for entry in essential.get("parameters", [])]
    spread = f", median RSD {float(np.median(rsd)):.2f} %" if rsd else ""
    total = results.summary["counts"]["base"]
    text = (
        f"{essential['count']} of {total} base parameters{spread}; leaving out the others costs "
        f"{essential['loss_percent']:.2f} %"
    )
    return Verdict("essential parameters", text, "", "good" if essential["count"] else "bad", "parameters")


def _payload(results: ResultFolder) -> Verdict | None:
    masses = [e for e in results.summary.get("parameters", []) if re.fullmatch(r"M\d+", e["name"])]
    announced = {
        session.metadata.get("payload", "none"): session.metadata.get("payload_mass")
        for session in results.sessions.values()
    }
    weighed = [float(mass) for name, mass in announced.items() if name != "none" and mass]
    if len(weighed) != 1 or not masses:
        return None
    entry = max(masses, key=lambda one: int(one["name"][1:]))
    gap = entry["estimate"] - weighed[0]
    ok = abs(gap) <= max(3.0 * entry["std"], _MASS_TOLERANCE * weighed[0])
    digits = max(0, -math.floor(math.log10(entry["std"]))) if entry["std"] > 0 else 4
    spread = f"{entry['estimate']:.{digits}f} ± {entry['std']:.{digits}f} kg"
    text = f"{spread} identified, {weighed[0]:g} kg announced"
    return Verdict("payload mass", text, "the same", "good" if ok else "look", "table-2")


def _truth(results: ResultFolder) -> Verdict | None:
    share = results.summary.get("within_3_sigma")
    if share is None:
        return None
    text = f"{100 * share:.1f} % of the estimates within 3 standard deviations"
    level: Level = "good" if share >= _TRUTH_WANTED else "look"
    wanted = f"at least {100 * _TRUTH_WANTED:.0f} %"
    return Verdict("truth of the emulated arm", text, wanted, level, "parameters")


def _diagnosis(results: ResultFolder) -> Verdict | None:
    diagnosis = results.diagnosis
    if diagnosis is None:
        return None
    level, text = in_short(diagnosis, results.joint_names)
    return Verdict("diagnosis", text, "", level, "diagnosis")


_QUESTIONS: tuple[Callable[[ResultFolder], Verdict | None], ...] = (
    _exit,
    _link,
    _limits,
    _tracking,
    partial(_share, "unexplained torque", False),
    partial(_share, "held-out motion", True),
    _assumptions,
    _essential,
    _payload,
    _truth,
    _diagnosis,
)


def _leading(text: str) -> float:
    """The number at the beginning of a text, or infinity."""
    match = re.match(r"\s*([-+]?\d+(?:\.\d+)?)", text)
    return float(match.group(1)) if match else math.inf


def _listed(names: list[str]) -> str:
    return ", ".join(dict.fromkeys(names))
