"""From the results of a campaign to its figures."""

from __future__ import annotations

import json
import math
from collections import Counter, defaultdict
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

__all__ = ["BINS", "figures", "read_results", "summary", "tables"]

Result = dict[str, Any]

BINS = ((0.0, 1.03), (1.03, 1.1), (1.1, 1.3), (1.3, math.inf))
"""Ranges of rho."""

_VISIBLE = 1.1
_OUTSIDE_VISIBLE = 1.2
GOALS = {
    "single, rho >= 1.1": 0.98,
    "single, 1.03 <= rho < 1.1": 0.80,
    "nothing hidden, no finding": 0.99,
    "pairs exactly right": 0.65,
    "pairs, at least one right": 0.98,
    "outside, rho >= 1.2, flagged": 0.90,
    "parameters within 3 standard deviations": 0.95,
}


def read_results(path: Path) -> list[Result]:
    """Results of a file, none if it is not there."""
    if not path.is_file():
        return []
    return [json.loads(line) for line in path.read_text().splitlines() if line.strip()]


def _kind(results: Iterable[Result], *kinds: str) -> list[Result]:
    return [r for r in results if r["truth"]["kind"] in kinds and "crash" not in r]


def _rate(values: Sequence[bool]) -> tuple[int, int]:
    return sum(values), len(values)


def _first(result: Result) -> bool:
    return bool(result["verdict"]["first"])


def _passing(result: Result) -> bool:
    """Whether the hidden cause differs from session to session, unpredictable by any model."""
    return any(hidden["passing"] for hidden in result["truth"]["hidden"])


def figures(results: Sequence[Result]) -> dict[str, Any]:
    """Every figure of the campaign, plain content."""
    singles, healthy = _kind(results, "single"), _kind(results, "none")
    pairs, outside = _kind(results, "pair"), _kind(results, "outside")
    judged = [r for r in results if "crash" not in r]
    findings = sum(len(r["verdict"]["findings"]) for r in judged)
    false = sum(len(r["verdict"]["false"]) for r in judged if r["truth"]["kind"] != "outside")
    listed = sum(len(r["verdict"]["findings"]) for r in judged if r["truth"]["kind"] != "outside")
    gained = [r for r in singles if _first(r) and r["verdict"]["efficiency"] is not None]
    efficiency = {
        passing: [r["verdict"]["efficiency"] for r in gained if _passing(r) == passing]
        for passing in (False, True)
    }
    deviations = {
        f"{key}": value
        for r in judged
        for key, value in ((f"{k} {r['id']}", v) for k, v in r["verdict"]["deviations"].items())
    }
    seconds = [r["seconds"] for r in judged]
    rates = {
        "single, rho >= 1.1": _rate([_first(r) for r in singles if r["rho"] >= _VISIBLE]),
        "single, 1.03 <= rho < 1.1": _rate([_first(r) for r in singles if 1.03 <= r["rho"] < 1.1]),
        "of those named with rho >= 1.03, not as look-alikes": _rate(
            [r["verdict"]["outright"] for r in singles if r["rho"] >= 1.03 and _first(r)]
        ),
        "nothing hidden, no finding": _rate([r["verdict"]["silent"] for r in healthy]),
        "pairs exactly right": _rate([r["verdict"]["exact"] for r in pairs]),
        "pairs, at least one right": _rate([any(r["verdict"]["named"]) for r in pairs]),
        "the same, rho >= 1.1": _rate([any(r["verdict"]["named"]) for r in pairs if r["rho"] >= _VISIBLE]),
        "outside, rho >= 1.2, flagged": _rate(
            [r["verdict"]["flagged"] for r in outside if r["rho"] >= _OUTSIDE_VISIBLE]
        ),
        "parameters within 3 standard deviations": _rate([abs(v) <= 3.0 for v in deviations.values()]),
    }
    members = [
        (rho, named)
        for r in _kind(results, "pair", "triple")
        for rho, named in zip(r.get("rho_alone", ()), r["verdict"]["named"], strict=False)
    ]
    rates["members of pairs and triples with rho >= 1.1 alone"] = _rate(
        [named for rho, named in members if rho >= _VISIBLE]
    )
    by_parameter: dict[str, list[float]] = defaultdict(list)
    for key, value in deviations.items():
        by_parameter[key.split(" ")[0]].append(value)
    return {
        "cases": dict(Counter(r["truth"]["kind"] for r in results)),
        "crashes": sum("crash" in r for r in results),
        "rates": {name: list(rate) for name, rate in rates.items()},
        "false_findings": [false, listed],
        "findings": findings,
        "by_cause": _by_cause(singles),
        "confusion": _confusion(singles),
        "healthy_findings": Counter(
            f.split(" ")[0].split("(")[0] for r in healthy for f in r["verdict"]["findings"]
        ),
        "false_by_cause": Counter(
            f.split("(")[0] for r in judged if r["truth"]["kind"] != "outside" for f in r["verdict"]["false"]
        ),
        "unexplained_in_healthy": float(np.mean([r["verdict"]["unexplained"] for r in healthy]))
        if healthy
        else None,
        "outside": _outside(outside),
        "efficiency": _quantiles(efficiency[False]),
        "efficiency_passing": _quantiles(efficiency[True]),
        "parameters": {
            name: {"n": len(values), "rms_sigmas": float(np.sqrt(np.mean(np.square(values))))}
            for name, values in sorted(by_parameter.items())
        },
        "seconds": _quantiles(seconds),
    }


def _quantiles(values: Sequence[float]) -> dict[str, float] | None:
    if not values:
        return None
    low, middle, high = np.quantile(values, [0.1, 0.5, 0.9])
    return {"n": len(values), "p10": float(low), "median": float(middle), "p90": float(high)}


def _by_cause(singles: Sequence[Result]) -> dict[str, list[list[int]]]:
    """First finding right, and cases, by cause and range of rho."""
    table: dict[str, list[list[int]]] = defaultdict(lambda: [[0, 0] for _ in BINS])
    for result in singles:
        cell = table[result["truth"]["hidden"][0]["cause"]][_bin(result["rho"])]
        cell[0] += _first(result)
        cell[1] += 1
    return dict(table)


def _bin(rho: float) -> int:
    return next(k for k, (low, high) in enumerate(BINS) if low <= rho < high)


def _confusion(singles: Sequence[Result]) -> dict[str, dict[str, int]]:
    """The first finding of each case with a cause hidden at rho >= 1.03."""
    table: dict[str, Counter[str]] = defaultdict(Counter)
    for result in singles:
        if result["rho"] < BINS[0][1]:
            continue
        hidden, verdict = result["truth"]["hidden"][0], result["verdict"]
        said = verdict["findings"][0].split("(")[0] if verdict["findings"] else "silent"
        if verdict["first"]:
            said = "right"
        elif said == hidden["cause"]:
            said = f"{said} elsewhere"
        table[hidden["cause"]][said] += 1
    return {cause: dict(counts) for cause, counts in table.items()}


def _outside(results: Sequence[Result]) -> dict[str, dict[str, Any]]:
    table: dict[str, dict[str, Any]] = {}
    for result in results:
        hidden, verdict = result["truth"]["hidden"][0], result["verdict"]
        entry = table.setdefault(hidden["cause"], {"n": 0, "visible": 0, "flagged": 0, "named": []})
        entry["n"] += 1
        entry["visible"] += result["rho"] >= _OUTSIDE_VISIBLE
        entry["flagged"] += verdict["flagged"] and result["rho"] >= _OUTSIDE_VISIBLE
        entry["named"] += verdict["sure_wrong"]
    return table


def summary(results: Sequence[Result]) -> str:
    """The figures as JSON."""
    return json.dumps(figures(results), indent=1) + "\n"


def tables(results: Sequence[Result]) -> str:
    """The figures as text."""
    f = figures(results)
    kinds = ", ".join(f"{n} {kind}" for kind, n in f["cases"].items())
    lines = [f"cases: {kinds}; {f['crashes']} crashes", ""]
    for name, (right, count) in f["rates"].items():
        goal = f"goal {100 * GOALS[name]:.0f} %" if name in GOALS else ""
        lines.append(f"{name:<52}{_share(right, count):>18}  {goal}")
    lines.append(f"{'findings beyond the truth':<52}{_share(*f['false_findings']):>18}  goal at most 3 %")
    for name, key, unit, goal in (
        ("gain efficiency where the cause is right", "efficiency", "", "goal median 0.95"),
        ("the same of what is another in each session", "efficiency_passing", "", "no model predicts it"),
        ("processor time of a diagnosis", "seconds", " s", "goal 60 s"),
    ):
        if f[key] is not None:
            q = f[key]
            text = f"{q['median']:.2f} ({q['p10']:.2f} to {q['p90']:.2f}){unit}"
            lines.append(f"{name:<44}{text:>26}  {goal}")
    lines += ["", _cause_table(f["by_cause"], f["confusion"])]
    for title, counts in (
        ("findings where nothing is hidden", f["healthy_findings"]),
        ("findings beyond the truth", f["false_by_cause"]),
    ):
        if counts:
            lines.append(f"{title}: {', '.join(f'{name} {n}' for name, n in counts.most_common())}")
    if f["unexplained_in_healthy"] is not None:
        lines.append(f"unexplained entries where nothing is hidden: {f['unexplained_in_healthy']:.2f} a case")
    if f["outside"]:
        lines += ["", "outside the catalogue        cases  rho >= 1.2  flagged  surely named"]
        for name, entry in f["outside"].items():
            lines.append(
                f"{name:<36}{entry['n']:>4}{entry['visible']:>8}{entry['flagged']:>9}  "
                f"{', '.join(entry['named'])}"
            )
    if f["parameters"]:
        lines += ["", "errors of named parameters, RMS in their standard deviations"]
        lines += [f"  {name:<44}{e['rms_sigmas']:>8.1f}  ({e['n']})" for name, e in f["parameters"].items()]
    return "\n".join(lines)


def _share(part: int, whole: int) -> str:
    return f"{part} of {whole} ({100 * part / whole:.0f} %)" if whole else "none"


def _cause_table(by_cause: dict[str, list[list[int]]], confusion: dict[str, dict[str, int]]) -> str:
    heads = "".join(f"{head:>10}" for head in ("< 1.03", "1.03-1.1", "1.1-1.3", ">= 1.3"))
    lines = [f"{'first finding right, by rho':<28}{heads}   else (rho >= 1.03)"]
    for cause in sorted(by_cause):
        said = {name: n for name, n in confusion.get(cause, {}).items() if name != "right"}
        others = ", ".join(f"{name} {n}" for name, n in sorted(said.items(), key=lambda item: -item[1]))
        lines.append(f"{cause:<28}{_cells(by_cause[cause])}   {others}")
    total = [[sum(row[k][i] for row in by_cause.values()) for i in (0, 1)] for k in range(len(BINS))]
    lines.append(f"{'all':<28}{_cells(total)}")
    return "\n".join(lines)


def _cells(row: Sequence[Sequence[int]]) -> str:
    return "".join(f"{f'{right}/{count}' if count else '.':>10}" for right, count in row)
