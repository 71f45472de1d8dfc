"""From the verdicts of a campaign to a table."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Sequence
from statistics import median
from typing import Any

Result = dict[str, Any]

BINS = ((1.0, 1.03), (1.03, 1.1), (1.1, 1.3), (1.3, 1e9))
CLAIMS = ((0.0, 0.5), (0.5, 0.8), (0.8, 0.9), (0.9, 0.95), (0.95, 1.01))
_SIGMAS = 3.0


def rho_of(result: Result) -> float:
    """How visible the case is: against the reference days too where base parameters take a fault up."""
    truth = result["truth"]
    absorbed = any(one["absorbed"] for one in truth["hidden"])
    return float(max(truth["rho"], truth["rho_reference"]) if absorbed else truth["rho"])


def table(results: Sequence[Result]) -> str:
    """All figures as text."""
    judged = [r for r in results if "verdict" in r]
    crashed = [r for r in results if "crash" in r]
    kinds = Counter(r["truth"]["kind"] for r in results)
    lines = [
        f"cases: {', '.join(f'{n} {kind}' for kind, n in sorted(kinds.items()))}; {len(crashed)} crashes",
        "",
        f"{'':<46}{'< 1.03':>9}{'1.03-1.1':>9}{'1.1-1.3':>9}{'>= 1.3':>9}{'all':>9}",
    ]
    for kind in ("single", "wear", "pair"):
        of = [r for r in judged if r["truth"]["kind"] == kind]
        if of:
            what = "all named" if kind == "pair" else "first"
            lines += [
                _row(f"{kind}: {what} and sure", of, lambda r: all(r["verdict"]["sure"])),
                _row(
                    f"{kind}: unsure and listed",
                    of,
                    lambda r: r["verdict"]["right"] and not all(r["verdict"]["sure"]),
                ),
                _row(f"{kind}: right", of, lambda r: r["verdict"]["right"]),
                _row(f"{kind}: right and nothing false", of, lambda r: r["verdict"]["exact"]),
            ]
    outside = [r for r in judged if r["truth"]["kind"] == "outside"]
    if outside:
        lines.append(_row("outside: never surely named", outside, lambda r: not r["verdict"]["sure_false"]))
        lines.append(_row("outside: seen beyond the twin", outside, lambda r: r["verdict"]["flagged"]))
    healthy = [r for r in judged if r["truth"]["kind"] == "healthy"]
    if healthy:
        silent = sum(r["verdict"]["silent"] for r in healthy)
        rest = sum(r["verdict"]["unexplained"] + r["verdict"]["nameless"] for r in healthy) / len(healthy)
        lines.append(
            f"healthy, no finding: {silent} of {len(healthy)}; nameless or unexplained: {rest:.1f} a case"
        )
    lines += [
        "",
        *_findings(judged),
        "",
        *_calibration(judged),
        "",
        *_parameters(judged),
        "",
        *_causes(judged),
    ]
    lines += [
        f"crash: {r['truth']['kind']} {r['truth']['seed']}: {r['crash'].splitlines()[-1]}" for r in crashed
    ]
    return "\n".join(lines)


def _row(name: str, results: Sequence[Result], good: Any) -> str:
    cells = []
    for low, high in (*BINS, (0.0, 1e9)):
        of = [bool(good(r)) for r in results if low <= rho_of(r) < high]
        cells.append(f"{sum(of)}/{len(of)}" if of else ".")
    return f"{name:<46}" + "".join(f"{cell:>9}" for cell in cells)


def _findings(judged: Sequence[Result]) -> list[str]:
    within = [r["verdict"] for r in judged if r["truth"]["kind"] != "outside"]
    count = sum(len(v["findings"]) for v in within)
    false = Counter(f.split("(")[0] for v in within for f in v["false"])
    character = Counter(f.split("(")[0] for v in within for f in v["character"])
    removed = sorted(e for r in judged if (e := r["verdict"]["efficiency"]) is not None)
    worse = [r for r in judged if r["verdict"]["worse"]]
    return [
        f"findings: {count}; of nothing hidden {sum(false.values())} ({_counts(false)}); "
        f"of the character of the arm {sum(character.values())} ({_counts(character)})",
        f"extended model worse by more than 1 % at a joint: {len(worse)} of {len(judged)} cases",
        *(
            [f"error removed of what the fault brought, median of {len(removed)}: {median(removed):.2f}"]
            if removed
            else ()
        ),
        f"processor time of a diagnosis, median: {median([r['seconds'] for r in judged]):.0f} s"
        if judged
        else "",
    ]


def _counts(counter: Counter[str]) -> str:
    return ", ".join(f"{name} {n}" for name, n in counter.most_common()) or "none"


def _calibration(judged: Sequence[Result]) -> list[str]:
    claims = [claim for r in judged for claim in r["verdict"]["claims"]]
    lines = ["confidence      claims   right   share"]
    error = 0.0
    for low, high in CLAIMS:
        of = [(p, good) for p, good in claims if low <= p < high]
        if of:
            right, mean = sum(good for _, good in of), sum(p for p, _ in of) / len(of)
            error += abs(right / len(of) - mean) * len(of) / len(claims)
            lines.append(f"{low:.2f} to {min(high, 1.0):.2f}{len(of):>9}{right:>8}{right / len(of):>8.2f}")
    return [*lines, f"expected calibration error {error:.3f}"]


def _parameters(judged: Sequence[Result]) -> list[str]:
    values: dict[str, list[float | None]] = defaultdict(list)
    for r in judged:
        for name, value in r["verdict"]["deviations"].items():
            values[name].append(value)
    known = [v for vs in values.values() for v in vs if v is not None]
    good = sum(abs(v) <= _SIGMAS for v in known)
    lines = [f"parameters within 3 sigma: {good} of {len(known)}"]
    for name, found in sorted(values.items()):
        text = " ".join("-" if v is None else f"{v:.1f}" for v in found)
        lines.append(f"  {name:<44}{text}")
    return lines


def _causes(judged: Sequence[Result]) -> list[str]:
    lines = ["case                rho  said"]
    for r in sorted(judged, key=lambda r: (r["truth"]["kind"], r["truth"]["seed"])):
        hidden = " + ".join(f"{h['cause']}({','.join(map(str, h['joints']))})" for h in r["truth"]["hidden"])
        verdict = r["verdict"]
        mark = "ok" if (verdict["right"] if r["truth"]["hidden"] else verdict["silent"]) else "--"
        said = "; ".join(verdict["findings"]) or "silent"
        name = f"{r['truth']['kind']} {r['truth']['seed']}"
        lines.append(f"{name:<16}{rho_of(r):>7.2f} {mark} {hidden or 'nothing'}: {said}")
    return lines
