"""The tables of the paper with a run in them, as rows: the page and the LaTeX tables show the same."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from runner.published import TABLE_1, TABLE_2
from runner.report.figures import interval_95, pretty_unit
from runner.report.folder import ResultFolder
from runner.report.markup import Cell, Number

_WORDS: dict[bool | None, str] = {True: "yes", False: "no", None: "–"}
TRUTH = "true (emulator)"
"""Head of the column of true values: the parameters set in the emulated arm."""


@dataclass(frozen=True)
class Table:
    """Head and rows of a table. strong : rows to stress."""

    head: tuple[str, ...]
    rows: tuple[Sequence[Cell], ...]
    strong: tuple[int, ...] = ()


def table_1(results: ResultFolder) -> Table:
    """Table 1 of the paper with this run: condition number, precision of the estimate, mean torques.

    Mean and worst RSD belong to the parameters of Table 2: a plan may be made for them instead of the condition number.
    """
    excitation = results.summary.get("excitation", {})
    condition, torque = excitation.get("condition", {}), excitation.get("mean_torque_nm", {})
    joints = results.joint_names
    names = {session.path.name: name for name, session in results.sessions.items()}
    kept = {name: all(item["ok"] for item in items) for name, items in results.preflights.items()}
    blank: list[Cell] = [Number(None), Number(None)]
    rows: list[list[Cell]] = [
        [one.name, one.constraints, Number(one.condition, ".2f"), *blank]
        + [Number(value, ".2f") for value in one.mean_torque]
        for one in TABLE_1
    ]
    published = [one.rsd_percent for one in TABLE_2]
    nothing: list[Cell] = [Number(None) for _ in TABLE_1[0].mean_torque]
    rows.append(["Published estimate, Table 2", "–", Number(None), *_mean_and_worst(published), *nothing])
    payloads = {s.path.name: s.metadata.get("payload", "none") for s in results.sessions.values()}
    of_run = _mean_and_worst([row[0]["rsd_percent"] for row in _entries(results).values()])
    for file, means in sorted(torque.items(), key=lambda item: payloads.get(item[0], "none") == "none"):
        rows.append(
            [
                f"This run, {file.removesuffix('.mcap')}",
                _WORDS[kept.get(names.get(file, ""))],
                Number(condition.get("paper"), ".2f", "excitation.condition.paper"),
                *of_run,
                *(Number(means.get(j), ".2f", f"excitation.mean_torque_nm.{file}.{j}") for j in joints),
            ]
        )
    torques = (f"|τ{k + 1}| [Nm]" for k in range(len(joints) or 7))
    head = ("motion", "constraints kept", "condition number", "mean RSD %", "worst RSD %", *torques)
    return Table(head, tuple(rows), tuple(range(len(TABLE_1) + 1, len(rows))))


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
                Number(entry["rsd_percent"] if entry else None, ".2f", f"{key}.rsd_percent"),
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
                Number(entry["rsd_percent"], ".2f", f"{key}.rsd_percent"),
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


def _mean_and_worst(rsd: Sequence[float]) -> list[Cell]:
    if not rsd:
        return [Number(None), Number(None)]
    return [Number(float(np.mean(rsd)), ".2f"), Number(float(np.max(rsd)), ".2f")]
