"""Running a campaign: which cases, each once, in as many processes as wanted."""

from __future__ import annotations

import json
import logging
import shutil
import time
import traceback
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np
from joblib import Parallel, delayed

from tests.hidden_physics.cases import KINDS, Case, Store, draw, twin
from tests.hidden_physics.causes import CAUSES
from tests.hidden_physics.engine import commissioned, diagnosed
from tests.hidden_physics.inflation import inflation
from tests.hidden_physics.outside import OUTSIDE
from tests.hidden_physics.robots import Encoder
from tests.hidden_physics.verdict import error_rows, judge

__all__ = ["KINDS", "Plan", "run"]

# Out of twenty cases; the order spreads the kinds evenly.
_KINDS = (
    *("single", "single", "none", "single", "pair", "single", "single", "outside", "single", "none"),
    *("single", "single", "pair", "single", "single", "none", "single", "outside", "single", "triple"),
)
_MOTOR_SIDE = 4


@dataclass(frozen=True)
class Plan:
    """What to run, see the command's help.

    out : folder of everything. eras : numbers of references, each of other days, with days of its own for the cases,
    which take them in turn. kinds : of cases, in turn; by default as `_KINDS` mixes them
    """

    out: Path
    cases: int
    seed: int
    days: int
    reference: bool = True
    causes: tuple[str, ...] = ()
    kinds: tuple[str, ...] = ()
    discard: bool = False
    members: bool = True
    skip: int = 0
    eras: int = 1

    @property
    def results(self) -> Path:
        """One line of JSON a case."""
        return self.out / ("results.jsonl" if self.reference else "results_without_reference.jsonl")

    def store(self, seed: int) -> Store:
        """Where the sessions of a case are."""
        return store_of(self.out, seed % self.eras)

    def forget_references(self) -> None:
        """Delete the references, and what healthy twins showed by them."""
        for pattern in ("reference_*.yaml", "*/clean_rows_*.json"):
            for path in self.out.glob(f"sessions*/{pattern}"):
                path.unlink()

    def wanted(self) -> Iterator[tuple[int, str, str | None, Encoder]]:
        """Seed, kind, cause (None: drawn) and encoder of each case."""
        names, singles, healthy, mix = list(CAUSES), 0, 0, self.kinds or _KINDS
        for number in range(self.cases):
            seed, left_out = self.seed + number, number < self.skip
            if self.causes:
                name = self.causes[number % len(self.causes)]
                if left_out:
                    continue
                yield seed, "outside" if name in OUTSIDE else "single", name, "link"
                continue
            kind = mix[number % len(mix)]
            cause, encoder = None, cast(Encoder, "link")
            if kind == "single":
                # Every cause in turn.
                cause = names[singles % len(names)]
                singles += 1
            elif kind == "none":
                healthy += 1
                encoder = "motor" if healthy % _MOTOR_SIDE == 0 else "link"
            if not left_out:
                yield seed, kind, cause, encoder


def store_of(out: Path, era: int) -> Store:
    """The sessions of an era in the folder of a campaign."""
    return Store(out / ("sessions" if era == 0 else f"sessions_{era}"), era)


def run(plan: Plan, jobs: int, again: bool, say: Callable[[str], Any]) -> None:
    """Run what has no result yet (`again`: everything), printing a line a case."""
    plan.out.mkdir(parents=True, exist_ok=True)
    if again and plan.results.is_file():
        plan.results.replace(plan.results.with_suffix(".old.jsonl"))
    done = set()
    if plan.results.is_file():
        done = {json.loads(line)["id"] for line in plan.results.read_text().splitlines()}
    wanted = [entry for entry in plan.wanted() if _identity(*entry) not in done]
    if plan.reference and wanted:
        for era, encoder in sorted({(entry[0] % plan.eras, _encoder(entry)) for entry in wanted}):
            began = time.monotonic()
            path = commissioned(plan.store(era), encoder, plan.days)
            say(f"reference {path.relative_to(plan.out)}: {time.monotonic() - began:.0f} s")
    work = Parallel(n_jobs=jobs, return_as="generator_unordered")
    count = len(done)
    with plan.results.open("a", encoding="utf-8") as stream:
        for result in work(delayed(_one)(plan, *entry) for entry in wanted):
            stream.write(json.dumps(result) + "\n")
            stream.flush()
            count += 1
            say(f"{count:4d} of {plan.cases}  {_line(result)}")


def _encoder(entry: tuple[int, str, str | None, Encoder]) -> Encoder:
    """Side of the joints that a case publishes, as far as it is known before the draw."""
    _, _, cause, encoder = entry
    return (CAUSES[cause].encoder if cause in CAUSES else None) or encoder


def _identity(seed: int, kind: str, cause: str | None, encoder: str) -> str:
    return f"{seed} {kind} {cause or 'any'} {encoder}"


def _one(plan: Plan, seed: int, kind: str, cause: str | None, encoder: Encoder) -> dict[str, Any]:
    """Draw, record, diagnose, judge; a crash of the diagnosis is a result like any other."""
    logging.getLogger("ident").setLevel(logging.ERROR)
    store = plan.store(seed)
    case = draw(seed, kind, store, causes=None if cause is None else [cause], encoder=encoder)
    identity = _identity(seed, kind, cause, encoder)
    result: dict[str, Any] = {"id": identity, "era": store.era, "truth": case.truth()}
    healthy = twin(case.schedule, case.day)
    twin_error = store.error(healthy)
    result["rho"] = inflation(store.error(case), twin_error) if case.hidden else 1.0
    if len(case.hidden) > 1 and plan.members:
        result["rho_alone"] = [
            inflation(store.error(case.alone(index)), twin_error) for index in range(len(case.hidden))
        ]
    sessions = store.sessions(case)
    reference = commissioned(store, case.day.encoder, plan.days) if plan.reference else None
    try:
        diagnosis, seconds = diagnosed(sessions, reference)
        clean = _twin_errors(store, healthy, reference) if case.hidden else None
    except Exception:
        return {**result, "crash": traceback.format_exc()}
    result["seconds"] = seconds
    result["verdict"] = judge(diagnosis, case.hidden, clean).to_dict()
    result["diagnosis"] = {
        key: diagnosis[key] for key in ("findings", "doubted", "nameless", "unexplained", "extension", "gain")
    }
    if plan.discard and case.hidden:
        _discard(store, case)
    return result


def _twin_errors(store: Store, healthy: Case, reference: Path | None) -> np.ndarray:
    """Held-out errors of the base model in the diagnosis of the healthy twin, made once."""
    folder = store.folder / healthy.name
    kept = folder / f"clean_rows_{'with' if reference else 'without'}.json"
    if kept.is_file():
        return np.array(json.loads(kept.read_text()))
    diagnosis, _ = diagnosed(store.sessions(healthy), reference)
    errors = error_rows(diagnosis["gain"]["rows_base"])
    kept.write_text(json.dumps(errors.tolist()))
    return errors


def _discard(store: Store, case: Case) -> None:
    for name in (case.name, *(case.alone(index).name for index in range(len(case.hidden)))):
        shutil.rmtree(store.folder / name, ignore_errors=True)


def _line(result: dict[str, Any]) -> str:
    """A case in a line."""
    hidden = result["truth"]["hidden"]
    what = " + ".join(f"{h['cause']}({','.join(map(str, h['joints']))})" for h in hidden) or "nothing"
    if "crash" in result:
        return f"rho {result['rho']:5.2f}  {what:<44}  CRASH {result['crash'].splitlines()[-1]}"
    verdict = result["verdict"]
    found = "; ".join(verdict["findings"]) or "silent"
    if verdict["unexplained"]:
        found += f"; {verdict['unexplained']} unexplained"
    good = verdict["silent"] if not hidden else verdict["exact"] or verdict["flagged"]
    return f"rho {result['rho']:5.2f}  {'ok ' if good else '-- '} {what:<44}  {found}"
