"""The tables of the paper with a run in them, as rows: the page and the LaTeX tables show the same."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ident.diagnosis.outcome.statements import Number
from runner.published import REBUILT, TABLE_1, TABLE_2, PredictedMotion, planned, rebuilt
from runner.report.figures import interval_95, pretty_unit
from runner.report.folder import ResultFolder
from runner.report.markup import MOST_PERCENT, Cell

_WORDS: dict[bool | None, str] = {True: "yes", False: "no", None: "–"}
_OBJECTIVES = {
    "condition_number": "the condition number",
    "d_optimality": "the volume of the confidence region",
    "mean_rsd": "the mean RSD",
    "worst_rsd": "the worst RSD",
    "goal_attainment": "equation (10)",
}
TRUTH = "true (emulator)"
"""Head of the column of true values: the parameters set in the emulated arm."""


@dataclass(frozen=True)
class Table:
    """Head and rows of a table. strong : rows to stress."""

    head: tuple[str, ...]
    rows: tuple[Sequence[Cell], ...]
    strong: tuple[int, ...] = ()


def table_1(results: ResultFolder) -> Table:
    """Table 1 of the paper with this run: condition number, predicted relative standard deviations, mean torques.

    A plan may be made for the deviations instead of the condition number. They are predicted alike for all motions
    (`runner.published.PredictedMotion`); of the published motions, whose coefficients are unknown, for rebuilt ones.
    """
    excitation = results.summary.get("excitation", {})
    condition, torque = excitation.get("condition", {}), excitation.get("mean_torque_nm", {})
    joints = results.joint_names
    names = {session.path.name: name for name, session in results.sessions.items()}
    kept = {name: all(item["ok"] for item in items) for name, items in results.preflights.items()}
    blank: list[Cell] = [Number(None), Number(None)]
    rows: list[list[Cell]] = []
    for one in TABLE_1:
        figures = [Number(value, ".2f") for value in one.mean_torque]
        rows.append([one.name, one.constraints, Number(one.condition, ".2f"), *blank, *figures])
        rows.append(_predicted(f"{one.name}, rebuilt", rebuilt(one.name)))
    plan, published = planned(results.path), len(rows)
    if plan is not None:
        rows.append(_predicted("Plan of this run", plan[0]))
    payloads = {s.path.name: s.metadata.get("payload", "none") for s in results.sessions.values()}
    for file, means in sorted(torque.items(), key=lambda item: payloads.get(item[0], "none") == "none"):
        rows.append(
            [
                f"This run, {file.removesuffix('.mcap')}",
                _WORDS[kept.get(names.get(file, ""))],
                Number(condition.get("paper"), ".2f", "excitation.condition.paper"),
                *blank,
                *(Number(means.get(j), ".2f", f"excitation.mean_torque_nm.{file}.{j}") for j in joints),
            ]
        )
    torques = (f"|τ{k + 1}| [Nm]" for k in range(len(joints) or 7))
    head = ("motion", "limits kept", "condition number", "mean RSD %", "worst RSD %", *torques)
    width = len(head)
    rows = [(row + [Number(None)] * width)[:width] for row in rows]
    return Table(head, tuple(rows), tuple(range(published, len(rows))))


def better_than_published(results: ResultFolder) -> str:
    """A sentence on the plan of this run beside the rebuilt motions; empty without a plan."""
    plan = planned(results.path)
    if plan is None:
        return ""
    own, objective = plan
    better: list[str] = []
    worse: list[str] = []
    for key, name in (
        ("mean_rsd", "mean RSD"),
        ("worst_rsd", "worst RSD"),
        ("condition", "condition number"),
    ):
        value = getattr(own, key)
        others = ", ".join(f"{getattr(rebuilt(one), key):.2f}" for one in REBUILT)
        text = f"{name} ({value:.2f}; {others})"
        (better if all(value < getattr(rebuilt(one), key) for one in REBUILT) else worse).append(text)
    made = f", made for {_OBJECTIVES[objective]}," if objective in _OBJECTIVES else ""
    parts = [f"Beside the three rebuilt motions the plan of this run{made} is"]
    said = [f"better in {' and '.join(better)}"] if better else []
    said += [f"not the best in {' and '.join(worse)}"] if worse else []
    return f"{' '.join(parts)} {', and '.join(said)}."


def estimate_rsd(results: ResultFolder) -> str:
    """A sentence on the relative standard deviations of the estimates, by parameters common to run and Table 2."""
    found = [row[0]["rsd_percent"] for row in _entries(results).values()]
    published = [one.rsd_percent for one in TABLE_2]
    text = f"RSD of the published estimate (Table 2): mean {np.mean(published):.2f} %, worst {np.max(published):.2f} %"
    if found:
        text += f"; of the estimate of this run: mean {np.mean(found):.2f} %, worst {np.max(found):.2f} %"
    return f"{text}, each with its own noise and length of recording."


def table_2(results: ResultFolder) -> Table:
    """Table 2 of the paper beside the estimates of this run; * marks a parameter that is not essential here."""
    truth = "within_3_sigma" in results.summary
    base = {entry["name"]: entry for entry in results.summary.get("parameters", [])}
    entries = _entries(results)
    essential = bool(results.summary.get("essential"))
    rows: list[list[Cell]] = []
    for printed in TABLE_2:
        entry, key = entries.get(printed.name, (None, ""))
        mark = " *" if essential and entry is not None and key.startswith("parameters") else ""
        rows.append(
            [
                printed.name + mark,
                pretty_unit(entry["unit"]) if entry else "",
                Number(entry["estimate"] if entry else None, ".4f", f"{key}.estimate"),
                Number(entry["rsd_percent"] if entry else None, ".2f", f"{key}.rsd_percent", MOST_PERCENT),
                Number(printed.estimate, ".2f"),
                Number(printed.rsd_percent, ".2f"),
                Number(100 * (entry["estimate"] / printed.estimate - 1) if entry else None, "+.1f"),
                *([Number(base.get(printed.name, {}).get("truth"), ".4f")] if truth else []),
            ]
        )
    head = ("parameter", "unit", "this run", "RSD %", "published", "RSD %", "difference %")
    return Table(head + ((TRUTH,) if truth else ()), tuple(rows))


def parameters(results: ResultFolder) -> Table:
    """All base parameters with standard deviation, 95 % interval and RSD."""
    entries = results.summary.get("parameters", [])
    truth = any("truth" in entry for entry in entries)
    rows: list[list[Cell]] = []
    for index, entry in enumerate(entries):
        key = f"parameters.{index}"
        rows.append(
            [
                entry["name"],
                pretty_unit(entry["unit"]),
                Number(entry["estimate"], ".5g", f"{key}.estimate"),
                Number(entry["std"], ".3g", f"{key}.std"),
                *(Number(bound, ".5g") for bound in interval_95(entry)),
                Number(entry["rsd_percent"], ".2f", f"{key}.rsd_percent", MOST_PERCENT),
                *([Number(entry.get("truth"), ".5g", f"{key}.truth")] if truth else []),
            ]
        )
    head = ("parameter", "unit", "estimate", "std", "95 % from", "to", "RSD %")
    return Table(head + ((TRUTH,) if truth else ()), tuple(rows))


def _entries(results: ResultFolder) -> dict[str, tuple[Mapping[str, Any], str]]:
    """Entries of summary.json for the parameters of Table 2, with their keys; an essential estimate comes first."""
    essential = (results.summary.get("essential") or {}).get("parameters", [])
    found = {e["name"]: (e, f"parameters.{i}") for i, e in enumerate(results.summary.get("parameters", []))}
    found |= {e["name"]: (e, f"essential.parameters.{i}") for i, e in enumerate(essential)}
    return {printed.name: found[printed.name] for printed in TABLE_2 if printed.name in found}


def _predicted(name: str, motion: PredictedMotion) -> list[Cell]:
    values = (motion.condition, motion.mean_rsd, motion.worst_rsd, *motion.mean_torque)
    return [name, _WORDS[motion.complies], *(Number(value, ".2f") for value in values)]
