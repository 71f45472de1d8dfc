"""Verdicts on a run: one line per question, with finding, requirement and verdict."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal

import numpy as np

from ident.diagnosis.outcome.claims_in_words import capital
from ident.diagnosis.outcome.statements import NOTHING, in_short
from ident.estimation.assumptions import HARMLESS
from ident.estimators.estimate import two_digits
from ident.model import DynamicModel
from runner.report.folder import Curves, ResultFolder

Level = Literal["good", "look", "bad"]

_TRACKING_LOOK_RAD = 0.02
_LATE_LOOK = 1e-3
_SLOWEST_S = 2e-3
_MOVING_LIMIT = 0.05
# What a model is for: without these a run is not called usable.
_ON_ESTIMATE, _ON_HELD_OUT, _ESTIMATOR = (
    "torque error (estimate)",
    "torque error (held-out motion)",
    "estimate",
)
_USE = frozenset((_ON_ESTIMATE, _ON_HELD_OUT, _ESTIMATOR))
_LISTED = 2
_NAMED = 3
"""Sessions listed in a verdict, and parameters named in a line."""
# Torque error of a model that predicts zero.
_NOTHING = 1.0
_WITHIN_3_SIGMA = 0.99
"""Least share within 3 standard deviations; nominal for a normal error: 99.7 %."""

_CHANCE = 0.01
"""Chance of a false `look` on the 95 % intervals of all kinds together, and on their 3 standard deviations."""

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
    return [*(verdict for verdict in found if verdict is not None), *_warnings(results)]


def headline(lines: list[Verdict]) -> tuple[Level, str]:
    """The whole run in one sentence."""
    bad = [line.subject for line in lines if line.level == "bad"]
    look = [line.subject for line in lines if line.level == "look"]
    if bad:
        return "bad", f"Not a good run: {_listed(bad)}"
    if look:
        things = "one thing" if len(look) == 1 else f"{len(look)} things"
        kind = "A doubtful" if _USE.intersection(look) else "A usable"
        return "look", f"{kind} run, with {things} to look at: {_listed(look)}"
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


def _torque_error(subject: str, unseen: bool, results: ResultFolder) -> Verdict | None:
    """The largest torque error of the sessions, by side. unseen : of the held-out motions."""
    model = results.model
    shown = [one for one in results.curves if one.unseen == unseen]
    if model is None or not shown:
        return None
    parts, wanted = [], []
    level: Level = "good"
    for side in (side for side in model.structure.sides if any(one.side == side for one in shown)):
        sought = {one: _torque_limit(one, model) for one in shown if one.side == side}
        mine = sorted(sought, key=lambda one: -one.relative / sought[one])
        limits = [sought[one] for one in mine]
        named = [f"{100 * one.relative:.2f} %" + f" ({one.session})" * (len(mine) > 1) for one in mine]
        listed = ", ".join(named) if len(mine) <= _LISTED else f"at most {named[0]}"
        samples, squares = (
            100 * max(shares[side] for shares in (getattr(one.whole, key) for one in mine))
            for key in ("standstill", "standstill_error")
        )
        parts.append(
            f"{side} {listed}; at standstill {samples:.1f} % of the samples, {squares:.0f} % of the squared error"
        )
        shown_limits = limits if len(mine) <= _LISTED else [limits[0]]
        wanted.append(f"{side} {', '.join(dict.fromkeys(f'{100 * limit:.1f} %' for limit in shown_limits))}")
        if any(one.relative >= _NOTHING for one in sought):
            level = "bad"
        elif not all(one.relative <= limit for one, limit in sought.items()) and level == "good":
            level = "look"
    return Verdict(subject, ". ".join(map(capital, parts)), f"below {'; '.join(wanted)}", level, "torque")


def _torque_limit(one: Curves, model: DynamicModel) -> float:
    """Largest torque error of a good model of this session.

    Moving real arms are predicted to a few per cent by their identified models (docs/real_data.md). A resting joint
    holds any torque up to its Coulomb friction, so that friction in its share of the samples comes on top.
    """
    drive = model.drive()
    coulomb = np.abs(drive["Fcl"] + (drive["Fcm"] if one.side == "motor" else 0.0))
    held = sum(c**2 * score.standstill for c, score in zip(coulomb, one.scores, strict=True) if score.samples)
    torque = sum((score.rms / score.relative) ** 2 for score in one.scores if score.relative > 0.0)
    return math.hypot(_MOVING_LIMIT, math.sqrt(held / torque)) if torque > 0.0 else _MOVING_LIMIT


def _unscored(results: ResultFolder) -> Verdict | None:
    unscored = results.summary.get("unscored")
    if not unscored:
        return None
    text = "; ".join(f"{one['session']}: {one['reason']}" for one in unscored)
    return Verdict("sessions without torque error", text, "none", "look", "sessions")


def estimate_lines(summary: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Name and text of what was chosen for an estimate: estimator, gains of sensors, tilt, prior, URDF; as far as
    there is something to say."""
    choice: Mapping[str, Any] = summary.get("choice") or {}
    found = [("estimator", _estimator(choice))] if choice else []
    gains = choice.get("sensor_gains") or {}
    if gains:
        texts = (
            f"{joint} {100 * one['error']:+.1f} ± {100 * one['std']:.1f} %" for joint, one in gains.items()
        )
        found.append(("sensor gains", f"too much by {', '.join(texts)}, stated as effects of the model"))
    mounting = choice.get("mounting") or summary.get("mounting")
    if mounting:
        size, std = math.degrees(math.hypot(*mounting["tilt_rad"])), math.degrees(max(mounting["std_rad"]))
        found.append(("tilt of the base", f"{size:.2f} ± {std:.2f} deg"))
    known = list(summary.get("prior_only") or ())
    if known:
        more = f" and {len(known) - _NAMED} more" if len(known) > _NAMED else ""
        parameters = "1 parameter" if len(known) == 1 else f"{len(known)} parameters"
        found.append(("prior alone", f"tells {parameters}: {', '.join(known[:_NAMED])}{more}"))
    if choice.get("urdf_doubt"):
        found.append(("URDF", choice["urdf_doubt"].removeprefix("the URDF ")))
    return found


def _estimator(choice: Mapping[str, Any]) -> str:
    """The estimator in use with its held-back error, beside the best one and the plain ones."""
    error = {one["title"]: one["held_back_percent"] for one in choice["candidates"]}
    best, used = choice["chosen"], choice["used"]
    if error[best] is None:
        return f"{used}, not compared: the motion is too short"
    others = [title for title in dict.fromkeys((best, "wls", "physical")) if title in error and title != used]
    listed = ", ".join(f"{_short(title)} {error[title]:.2f}" for title in others)
    text = _short(used) + (f": {error[used]:.2f} % held back" if used in error else "")
    return text + (f" ({'best: ' if best != used else ''}{listed})" if listed else "")


def _short(title: str) -> str:
    return title.replace("sensor gain of", "gain of")


def _estimate(results: ResultFolder) -> Verdict | None:
    lines = dict(estimate_lines(results.summary))
    shown = [f"{name} {lines[name]}" for name in ("sensor gains", "tilt of the base") if name in lines]
    if "estimator" in lines:
        shown.insert(0, lines["estimator"])
    if not shown:
        return None
    wanted = _better_estimator(results.summary.get("choice") or {})
    return Verdict(_ESTIMATOR, "; ".join(shown), wanted, "look" if wanted else "good", "parameters")


def _better_estimator(choice: Mapping[str, Any]) -> str:
    """What an estimate that does not predict its own motion should be; empty for one that does."""
    error = {one["title"]: one["held_back_percent"] for one in choice.get("candidates", ())}
    limit, own = 100.0 * _MOVING_LIMIT, error.get(choice.get("used"))
    if own is None or own < limit:
        return ""
    best = error[choice["chosen"]]
    other = "the estimator `auto`, or " if best is not None and best < limit else ""
    return f"below {limit:g} % on parts of the motion held back; {other}a longer or richer motion"


def _assumptions(results: ResultFolder) -> Verdict | None:
    checks: Mapping[str, Any] | None = results.summary.get("assumptions")
    if not checks:
        return None
    violated = [name for name, check in checks.items() if check["verdict"] == "VIOLATED"]
    words = ("holds", HARMLESS, "not tested")
    held, departed, untested = (sum(check["verdict"] == word for check in checks.values()) for word in words)
    hold = f"{held} of {len(checks)} hold"
    hold += f", {departed} with harmless departures" if departed else ""
    hold += f", {untested} not tested" if untested else ""
    text = hold + (f"; violated: {_listed(violated)}" if violated else "")
    if violated and not str(results.summary.get("covariance", "")).startswith("textbook"):
        covered = [name for name in violated if name in _COVERED]
        open_ones = [name for name in violated if name not in _COVERED]
        text = hold
        text += f"; covered by the deviations: {_listed(covered)}" if covered else ""
        text += f"; not covered: {_listed(open_ones)}" if open_ones else ""
        violated = open_ones
    return Verdict("assumptions", text, "none uncovered", "look" if violated else "good", "assumptions")


def _real_bodies(results: ResultFolder) -> Verdict | None:
    real = results.summary.get("feasibility")
    if not real or real["real"] or not real["possible"]:  # what is beyond chance is a warning
        return None
    return Verdict("real bodies", real["text"], "", "good", "parameters")


def _warnings(results: ResultFolder) -> list[Verdict]:
    """What the estimate warns of, a line each."""
    texts = results.summary.get("warnings", ())
    return [Verdict("warning", text, "", "look", "assumptions") for text in texts]


def _essential(results: ResultFolder) -> Verdict | None:
    essential = results.summary.get("essential")
    if not essential:
        return None
    rsd = results.summary.get("median_rsd_percent")
    spread = f", median relative std {two_digits(rsd)} %" if rsd is not None else ""
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
    near: Mapping[str, Any] = results.summary.get("within_3_sigma_by_kind", {})
    held: Mapping[str, Any] = results.summary.get("intervals_95_hold", {})
    far, few = _too_few(near, _WITHIN_3_SIGMA), _too_few(held, 0.95)
    text = f"{100 * share:.1f} % of the estimates within 3 standard deviations"
    if far:
        text += f" (too few: {_tallies(near, far)})"
    if held:
        inside, count = (sum(tally[key] for tally in held.values()) for key in ("inside", "count"))
        text += f"; {100 * inside / count:.0f} % of the 95 % intervals hold"
        text += f" ({'too few' if few else 'least'}: {_tallies(held, few or held)})"
    whole = {key: sum(tally[key] for tally in near.values()) for key in ("inside", "count")}
    enough = share >= _WITHIN_3_SIGMA or (bool(near) and not _too_few({"all": whole}, _WITHIN_3_SIGMA))
    good = enough and not far and not few
    wanted = f"{100 * _WITHIN_3_SIGMA:.0f} % of all and of each kind, 95 % of each kind; but for chance"
    return Verdict("truth of the emulated arm", text, wanted, "good" if good else "look", "parameters")


def _too_few(tallies: Mapping[str, Mapping[str, int]], share: float) -> list[str]:
    """Kinds of which so few are inside by chance in less than 1 % of all runs, over all kinds (binomial)."""

    def tail(inside: int, count: int) -> float:
        return sum(math.comb(count, k) * share**k * (1.0 - share) ** (count - k) for k in range(inside + 1))

    return [kind for kind, tally in tallies.items() if tail(**tally) < _CHANCE / len(tallies)]


def _tallies(tallies: Mapping[str, Mapping[str, int]], kinds: Iterable[str]) -> str:
    """The three kinds with the least inside, and their numbers."""
    worst = sorted(kinds, key=lambda kind: tallies[kind]["inside"] / tallies[kind]["count"])[:3]
    return ", ".join(f"{kind} {tallies[kind]['inside']} of {tallies[kind]['count']}" for kind in worst)


def _diagnosis(results: ResultFolder) -> Verdict | None:
    diagnosis = results.diagnosis
    if diagnosis is None:
        return None
    level, text = in_short(diagnosis, results.joint_names)
    if text.startswith(NOTHING):
        # On use: it comes with the records of a replay, and these with the physics.
        from runner.report.diagnosis import DiagnosisFolder

        # What is left without a cause is a part of the answer.
        folder = DiagnosisFolder.of(results)
        assert folder is not None
        level, text = folder.statements.level, folder.statements.headline + text.removeprefix(NOTHING)
    return Verdict("diagnosis", text, "", level, "diagnosis")


_QUESTIONS: tuple[Callable[[ResultFolder], Verdict | None], ...] = (
    _exit,
    _link,
    _limits,
    _tracking,
    partial(_torque_error, _ON_ESTIMATE, False),
    partial(_torque_error, _ON_HELD_OUT, True),
    _unscored,
    _estimate,
    _assumptions,
    _real_bodies,
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
