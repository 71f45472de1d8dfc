"""How many cases of a campaign change their verdict if a number of the diagnosis is doubled or halved.

    python -m benchmarks.discovery --cases 40 --days 2 --out campaign
    python -m benchmarks.sensitivity campaign --cases 40 --jobs 2
    python -m benchmarks.sensitivity campaign --report

The numbers are the constants of `ident/diagnosis` and the settings of `DiagnosisSettings`. A verdict is the cause and
joint named first and whether it is said for sure; silence is one, too. Logs and references are those of the campaign,
but for the numbers of the commissioning, which make the reference anew; a number with its result in
`sensitivity.jsonl` is not tried again.
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import ast
import dataclasses
import importlib
import json
import logging
import pkgutil
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

import click
from joblib import Parallel, delayed

import ident.diagnosis
from benchmarks.discovery.campaign import store_of
from benchmarks.discovery.tally import read_results
from ident.diagnosis.settings import DiagnosisSettings
from tests.hidden_physics.cases import draw
from tests.hidden_physics.engine import commissioned, diagnosed
from tests.hidden_physics.verdict import SURE

FACTORS = (0.5, 2.0)
_SETTINGS = "settings"
# Not decisions: seeds, the size of a piece of work, and what only the text shows.
_LEFT_OUT = (
    "seed",
    "jobs",
    "SCHEMA_VERSION",
    "_WIDTH",
    "_REPR_LINES",
    "_BLOCK",
    "_TOGETHER",
    "_DENSE",
    "_LATEST",
)
_IN_WORDS = ("claims_in_words", "look_alikes", "statements")
_OF_REFERENCE = ("character", "commission", "size", "tuning", "usual_sizes")


@dataclass(frozen=True)
class Number:
    """A number by module (`settings` for a default of `DiagnosisSettings`) and name."""

    module: str
    name: str
    value: float

    def __str__(self) -> str:
        return f"{self.module}.{self.name}"


def numbers() -> Iterator[Number]:
    """All of them; tuples, texts and counts of zero aside."""
    for field in dataclasses.fields(DiagnosisSettings):
        value = field.default
        if isinstance(value, (int, float)) and not isinstance(value, bool) and field.name not in _LEFT_OUT:
            yield Number(_SETTINGS, field.name, value)
    for module, loaded in _modules():
        if module in _IN_WORDS:
            continue
        for name, value in vars(loaded).items():
            own = name.isupper() and name not in _LEFT_OUT and _is_own(loaded, name)
            if own and isinstance(value, (int, float)) and not isinstance(value, bool) and value:
                yield Number(module, name, value)


def _modules() -> Iterator[tuple[str, ModuleType]]:
    """All modules of the diagnosis by name, in every room."""
    for module in pkgutil.walk_packages(ident.diagnosis.__path__, "ident.diagnosis."):
        yield module.name.rpartition(".")[2], importlib.import_module(module.name)


def _is_own(module: Any, name: str) -> bool:
    """Whether a module assigns the name, unlike an imported one."""
    tree = ast.parse(Path(module.__file__).read_text(encoding="utf-8"))
    targets = (t for node in tree.body if isinstance(node, ast.Assign) for t in node.targets)
    return any(isinstance(n, ast.Name) and n.id == name for t in targets for n in ast.walk(t))


def verdict(findings: Sequence[dict[str, Any]]) -> str:
    """What a user takes from a diagnosis: the first name, its joints, and whether it is sure."""
    if not findings:
        return "silent"
    first = findings[0]
    sure = "" if first["confidence"] >= SURE else "?"
    return f"{first['cause']}({','.join(map(str, first['joints']))}){sure}"


def _tried(
    number: Number, factor: float, cases: Sequence[dict[str, Any]], out: Path, days: int
) -> dict[str, Any]:
    """Cases with another verdict with a number times a factor."""
    logging.getLogger("ident").setLevel(logging.ERROR)
    value = number.value * factor
    changed = type(number.value)(max(round(value), 1)) if isinstance(number.value, int) else value
    with _changed(number, changed), tempfile.TemporaryDirectory() as folder:
        place = Path(folder) if number.module in _OF_REFERENCE else None
        flips = []
        for result in cases:
            store = store_of(out, result.get("era", 0))
            _, kind, cause, encoder = result["id"].split()
            case = draw(
                result["truth"]["seed"],
                kind,
                store,
                causes=None if cause == "any" else [cause],
                encoder=encoder,
            )
            try:
                told, _ = diagnosed(
                    store.sessions(case), commissioned(store, case.day.encoder, days, folder=place)
                )
                now = verdict(told["findings"])
            except Exception as error:
                now = f"{type(error).__name__}: {error}"
            before = verdict(result["diagnosis"]["findings"])
            if now != before:
                flips.append([result["id"], before, now])
    return {
        "number": str(number),
        "value": number.value,
        "factor": factor,
        "cases": len(cases),
        "flips": flips,
    }


class _changed:
    """A number with another value for a while."""

    def __init__(self, number: Number, value: float) -> None:
        self.number, self.value = number, value

    def __enter__(self) -> None:
        self._set(self.value)

    def __exit__(self, *_: object) -> None:
        self._set(self.number.value)

    def _set(self, value: float) -> None:
        name = self.number.name
        if self.number.module != _SETTINGS:
            for module, loaded in _modules():
                if module == self.number.module or (not name.startswith("_") and hasattr(loaded, name)):
                    setattr(loaded, name, value)
            return
        names = [field.name for field in dataclasses.fields(DiagnosisSettings)]
        init = DiagnosisSettings.__init__
        defaults = list(init.__defaults__ or ())
        defaults[names.index(name) - (len(names) - len(defaults))] = value
        init.__defaults__ = tuple(defaults)


@click.command()
@click.argument("out", type=click.Path(path_type=Path, exists=True, file_okay=False))
@click.option("--cases", default=20, show_default=True, help="Number of cases of the campaign.")
@click.option("--case", "seeds", type=int, multiple=True, help="These cases in place of the first, by seed.")
@click.option("--days", default=2, show_default=True, help="Days of its reference.")
@click.option("--only", default="", help="Only numbers with this in their name.")
@click.option("--jobs", default=1, show_default=True)
@click.option("--report", is_flag=True, help="Run nothing.")
def main(
    out: Path, cases: int, seeds: tuple[int, ...], days: int, only: str, jobs: int, report: bool
) -> None:
    """Double and halve every number of the diagnosis."""
    path = out / "sensitivity.jsonl"
    done = [json.loads(line) for line in path.read_text().splitlines()] if path.is_file() else []
    if not report:
        results = [r for r in read_results(out / "results.jsonl") if "crash" not in r]
        chosen = [r for r in results if r["truth"]["seed"] in seeds] if seeds else results[:cases]
        known = {(one["number"], one["factor"]) for one in done}
        wanted = [(n, f) for n in numbers() for f in FACTORS if only in str(n) and (str(n), f) not in known]
        work = Parallel(n_jobs=jobs, return_as="generator_unordered")
        with path.open("a", encoding="utf-8") as stream:
            for one in work(delayed(_tried)(n, f, chosen, out, days) for n, f in wanted):
                stream.write(json.dumps(one) + "\n")
                stream.flush()
                done.append(one)
                click.echo(f"{one['number']} x {one['factor']}: {len(one['flips'])} of {one['cases']}")
    click.echo(table(done))


def table(done: Sequence[dict[str, Any]]) -> str:
    """The results as a table in Markdown, those with most changes first."""
    by_number: dict[str, dict[float, dict[str, Any]]] = {}
    for one in done:
        by_number.setdefault(one["number"], {})[one["factor"]] = one
    order = sorted(by_number.items(), key=lambda pair: -sum(len(one["flips"]) for one in pair[1].values()))
    lines = [
        "| number | value | halved | doubled | verdicts that change |",
        "| --- | --- | --- | --- | --- |",
    ]
    for name, tried in order:
        counts = [f"{len(tried[f]['flips'])} of {tried[f]['cases']}" if f in tried else "–" for f in FACTORS]
        flips = sorted({f"{before} → {now}" for one in tried.values() for _, before, now in one["flips"]})
        value = next(iter(tried.values()))["value"]
        lines.append(f"| {name} | {value:g} | {counts[0]} | {counts[1]} | {'; '.join(flips)} |")
    return "\n".join(lines)


if __name__ == "__main__":
    # Processes get what belongs to an imported module, by its name.
    importlib.import_module("benchmarks.sensitivity").main()
