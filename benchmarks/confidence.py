"""Fits the confidence of findings to cases of known truth, and checks it on cases that it was not fitted to.

    python -m benchmarks.confidence campaign/results.jsonl mujoco_cases
    python -m benchmarks.confidence campaign/results.jsonl mujoco_cases --write
    python -m benchmarks.confidence --alone campaign/results_without_reference.jsonl mujoco_cases --write
    python -m benchmarks.confidence --onward campaign/results.jsonl other_arms/results.jsonl --write
    python -m benchmarks.confidence --check other/results.jsonl --check other_cases --diagram confidence.svg

Reads the findings of campaigns of `benchmarks.discovery` (their `results.jsonl`) and of `benchmarks.mujoco_arms` (their
folder), for the fit with the names that were doubted. The weights of `ident/diagnosis/verdict/confidence.yaml`, or with
`--alone` of `confidence_alone.yaml`, are those of a logistic regression with the signs of
`ident.diagnosis.verdict.confidence.SIGNS`, each generator with the same weight, and a pull to `START` chosen by
cross-validation over whole cases. With `--onward` the pull is to the stored weights and not weak, for these know
findings of arms that are in none of the campaigns. The reliability printed for the fit is that of cross-validation too.
`--check` judges the confidence as the diagnoses stated it.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import click
import numpy as np
import yaml
from numpy.typing import NDArray
from scipy.optimize import minimize

import ident.diagnosis.verdict.confidence as stored
from benchmarks.discovery.tally import read_results
from benchmarks.mujoco_arms.judging import diagnosis_of, names, of_character, verdict_of

Floats = NDArray[np.float64]

_RIDGES = (0.03, 0.1, 0.3, 1.0, 3.0)
# Of a fit onward from another one: of some hundred findings, as those of the campaigns.
_ONWARD = (1.0, 3.0, 10.0)
_PARTS = 10
# Findings of a generator for its full weight.
_ENOUGH = 50
_INTERCEPT = -1.5
_BINS = (0.0, 0.2, 0.4, 0.6, 0.8, 0.9, 0.95, 1.0001)


@dataclass(frozen=True)
class Said:
    """A finding of a case. grounds : as stored, empty for findings that are counted. right : named truly."""

    source: str
    case: str
    label: str
    confidence: float
    grounds: Mapping[str, float]
    right: bool


def read(path: Path, *, doubted: bool = False, reference: bool = True) -> list[Said]:
    """All findings of a campaign on effects of the catalogue, those of the healthy arm's character left out.

    Findings on healthy twins count, too.

    doubted : with the names that were more likely wrong. reference : whether the arm's healthy days were given.
    """
    said = []
    for case, hidden, traits, told in _mujoco(path, reference) if path.is_dir() else _own(path):
        for finding in [*told["findings"], *(told.get("doubted", ()) if doubted else ())]:
            right = any(names(finding, one) for one in hidden)
            if right or not of_character(finding, traits):
                label = f"{finding['cause']}{finding['joints']}"
                grounds = finding.get("grounds", {})
                said.append(Said(path.as_posix(), case, label, float(finding["confidence"]), grounds, right))
    return said


Content = tuple[str, list[dict[str, Any]], Mapping[str, Any], dict[str, Any]]


def _own(path: Path) -> list[Content]:
    found: list[Content] = []
    for result in read_results(path):
        if "crash" not in result:
            hidden = [{**one, "also": one.get("also", ())} for one in result["truth"]["hidden"]]
            for one in hidden:
                # A joint of 0 is the whole arm.
                one["joints"] = [joint for joint in one["joints"] if joint]
            found.append((result["id"], hidden, {}, result["diagnosis"]))
    return found


def _mujoco(path: Path, reference: bool) -> list[Content]:
    found: list[Content] = []
    for verdict in sorted(path.glob(f"*/{verdict_of(path, reference).name}")):
        folder = verdict.parent
        truth = json.loads((folder / "truth.json").read_text(encoding="utf-8"))
        for place, hidden in ((folder, truth["hidden"]), (folder / "twin", [])):
            file = diagnosis_of(place, reference) / "diagnosis.json"
            if file.is_file():
                told = json.loads(file.read_text(encoding="utf-8"))
                details = file.with_name("details.json")
                if details.is_file():
                    told["doubted"] = json.loads(details.read_text(encoding="utf-8")).get("doubted", [])
                found.append((folder.name, hidden, truth["traits"], told))
    return found


def judged() -> Floats:
    """Intercept and weights (1 + k,) before any finding."""
    return np.array([_INTERCEPT, *(stored.START[name] for name in stored.LIMITS)])


def fit(points: Floats, right: Floats, weight: Floats, ridge: float, start: Floats | None = None) -> Floats:
    """Intercept and weights (1 + k,) of the logistic regression; points (n, k) from 0 to 1. start : the same of the
    pull, default `judged`."""
    signs = [stored.SIGNS[name] for name in stored.LIMITS]
    columns = np.column_stack([np.ones(len(points)), points])
    start = judged() if start is None else start

    def loss(theta: Floats) -> tuple[float, Floats]:
        odds = columns @ theta
        away = theta - start
        value = float(weight @ (np.logaddexp(0.0, odds) - right * odds)) + 0.5 * ridge * float(away @ away)
        slope = columns.T @ (weight * (1.0 / (1.0 + np.exp(-odds)) - right)) + ridge * away
        return value, slope

    bounds = [(None, None), *((0.0 if s > 0 else None, 0.0 if s < 0 else None) for s in signs)]
    return np.asarray(minimize(loss, start, jac=True, bounds=bounds).x)


def held_back(
    said: Sequence[Said], points: Floats, right: Floats, weight: Floats, ridge: float, start: Floats
) -> Floats:
    """Probability (n,) of each finding by a fit to the cases of other parts."""
    cases = [f"{one.source} {one.case}" for one in said]
    order = {case: k for k, case in enumerate(np.random.default_rng(1).permutation(sorted(set(cases))))}
    part = np.array([order[case] % _PARTS for case in cases])
    found = np.zeros(len(said))
    for k in range(_PARTS):
        out = part == k
        if out.any():
            theta = fit(points[~out], right[~out], weight[~out], ridge, start)
            found[out] = 1.0 / (1.0 + np.exp(-(theta[0] + points[out] @ theta[1:])))
    return found


def log_loss(p: Floats, right: Floats, weight: Floats) -> float:
    """Mean of -log p of what is true."""
    p = np.clip(p, 1e-6, 1.0 - 1e-6)
    return float(-(weight @ (right * np.log(p) + (1.0 - right) * np.log(1.0 - p))) / weight.sum())


def reliability(p: Floats, right: Floats) -> tuple[list[tuple[float, float, int]], float]:
    """Of each range of confidence its mean, the share that is right and the number; the expected calibration error."""
    rows, error = [], 0.0
    for low, high in pairwise(_BINS):
        mine = (p >= low) & (p < high)
        if mine.any():
            rows.append((float(p[mine].mean()), float(right[mine].mean()), int(mine.sum())))
            error += mine.mean() * abs(rows[-1][0] - rows[-1][1])
    return rows, float(error)


def table(sources: Sequence[str], p: Floats, right: Floats) -> str:
    """The reliability of each source and of all as text."""
    lines, places = [], np.array(sources)
    for source in [*dict.fromkeys(sources), "all"]:
        mine = (places == source) | (source == "all")
        rows, error = reliability(p[mine], right[mine])
        sure = p[mine] >= 0.9
        share = f"{right[mine][sure].sum():.0f} of {sure.sum()}"
        lines.append(
            f"{source}: {mine.sum()} findings, calibration error {error:.3f}; said with 0.9 or more: {share} right"
        )
        lines += [f"   said {a:.2f}  right {b:.2f}  of {n}" for a, b, n in rows]
    return "\n".join(lines)


@click.command()
@click.argument("campaigns", nargs=-1, type=click.Path(path_type=Path, exists=True))
@click.option("--alone", is_flag=True, help="Of diagnoses without a reference, whose weights are apart.")
@click.option("--onward", is_flag=True, help="Pull towards the stored weights.")
@click.option("--write", is_flag=True, help="Store the weights.")
@click.option(
    "--check",
    multiple=True,
    type=click.Path(path_type=Path, exists=True),
    help="Campaign for the reliability of the confidence as it was said.",
)
@click.option("--diagram", type=click.Path(path_type=Path), help="Draw the reliability of --check.")
def main(
    campaigns: tuple[Path, ...],
    alone: bool,
    onward: bool,
    write: bool,
    check: tuple[Path, ...],
    diagram: Path | None,
) -> None:
    """Fit the confidence to campaigns, or check it on others."""
    if campaigns:
        said = [one for path in campaigns for one in read(path, doubted=True, reference=not alone)]
        _fit(said, stored.ALONE if alone else stored.WEIGHTS, onward=onward, write=write)
    if check:
        said = [one for path in check for one in read(path, reference=not alone)]
        p, right = (np.array([getattr(one, key) for one in said], float) for key in ("confidence", "right"))
        click.echo(table([one.source for one in said], p, right))
        if diagram is not None:
            _draw([one.source for one in said], p, right, diagram)


def _fit(said: Sequence[Said], name: str, *, onward: bool, write: bool) -> None:
    said = [one for one in said if one.grounds]
    if any(not stored.LIMITS.keys() <= one.grounds.keys() for one in said):
        raise click.ClickException(
            "diagnoses of an earlier version lack a ground; diagnose their cases again"
        )
    if any(bool(one.grounds.get("alone")) != (name == stored.ALONE) for one in said):
        raise click.ClickException("diagnoses with and without a reference have weights apart; see --alone")
    if not said:
        raise click.ClickException("no finding with grounds in these campaigns; diagnose their cases again")
    points = np.array([stored.scaled(one.grounds) for one in said])
    right = np.array([one.right for one in said], float)
    count = {source: sum(one.source == source for one in said) for source in {one.source for one in said}}
    # A handful of findings says little about its generator.
    weight = np.array([1.0 / max(count[one.source], _ENOUGH) for one in said])
    weight *= len(said) / weight.sum()
    path = Path(stored.__file__).with_name(name)
    intercept, before = stored.fitted(name)
    start = np.array([intercept, *before]) if onward else judged()
    apart = {
        ridge: held_back(said, points, right, weight, ridge, start)
        for ridge in (_ONWARD if onward else _RIDGES)
    }
    losses = {ridge: log_loss(p, right, weight) for ridge, p in apart.items()}
    ridge = min(losses, key=lambda r: losses[r])
    p = apart[ridge]
    click.echo(f"ridge {ridge}: -log p of what is true {losses[ridge]:.3f} in cross-validation")
    click.echo(table([one.source for one in said], p, right))
    theta = fit(points, right, weight, ridge, start)
    weights = dict(zip(stored.LIMITS, (round(float(v), 3) for v in theta[1:]), strict=True))
    content = {
        "findings": len(said),
        "cases": len({(one.source, one.case) for one in said}),
        "ridge": ridge,
        "intercept": round(float(theta[0]), 3),
        "weights": weights,
    }
    if onward:
        earlier = yaml.safe_load(path.read_text(encoding="utf-8"))
        content["findings_before"] = earlier["findings"] + earlier.get("findings_before", 0)
    text = yaml.safe_dump(content, sort_keys=False)
    click.echo(text)
    if write:
        path.write_text(f"# Written by `python -m benchmarks.confidence`.\n{text}", encoding="utf-8")


def _draw(sources: Sequence[str], p: Floats, right: Floats, path: Path) -> None:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(4.2, 4.0), layout="constrained")
    axes = figure.add_subplot()
    axes.plot([0, 1], [0, 1], color="0.7", lw=1)
    places = np.array(sources)
    for source in dict.fromkeys(sources):
        rows, error = reliability(p[places == source], right[places == source])
        said, share, count = (np.array(column) for column in zip(*rows, strict=True))
        # Interval of a share by Wilson, one standard deviation.
        middle = (share + 0.5 / count) / (1.0 + 1.0 / count)
        half = np.sqrt(share * (1.0 - share) / count + 0.25 / count**2) / (1.0 + 1.0 / count)
        label = f"{Path(source).name or source}: {count.sum()} findings, error {error:.3f}"
        axes.errorbar(
            said, share, [share - middle + half, middle + half - share], fmt="o-", capsize=3, label=label
        )
    axes.set(xlabel="confidence stated", ylabel="share right", xlim=(0, 1.02), ylim=(0, 1.02))
    axes.legend(fontsize="small", loc="lower right")
    figure.savefig(path, metadata={"Date": None})


if __name__ == "__main__":
    main()
