"""Identify and diagnose each arm's each day, in parallel, and keep the results in a store.

A task is one arm's one day. The first day of an arm goes before its others: its signal settings hold for all days, so
their parameters differ by the arm and not by filters. joblib spreads the tasks; inside its context
`parallel_config(backend="dask")` they run on a cluster.
"""

from __future__ import annotations

import logging
import traceback
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from fri.errors import LwrError
from ident.diagnosis import Reference, commission, diagnose
from ident.dynamics.known_arm import known_arm
from ident.dynamics.session_chain import session_chain
from ident.estimation.channel_errors import of_exact_channels
from ident.estimation.identification import Identification, IdentificationSettings
from ident.estimation.identify import identify, known_settings
from ident.estimators.least_squares import factor_of
from ident.model.model_file import read_model, write_model
from ident.model.signals import signal_settings
from lwr_driver.session import Session, read_session
from runner.diagnosis import arm_data
from runner.fleet.days import ArmDay
from runner.fleet.store import ArmStore, FleetStore, Row
from runner.fleet.together import write_together
from runner.fleet.trend import arm_trend, usual_scatter

Diagnosed = Literal["changed", "all", "none"]


@dataclass(frozen=True)
class Order:
    """How a batch works.

    diagnose : days with a diagnosis: `changed` (the first day after a change, and the newest one), `all`, `none`.
    reference_days : first days of an arm for its healthy-arm baseline. jobs : processes.
    """

    settings: IdentificationSettings
    diagnose: Diagnosed = "changed"
    reference_days: int = 3
    jobs: int = 1


@dataclass(frozen=True)
class Progress:
    """One finished task: `what` it was, and `error`, empty if it succeeded."""

    arm: str
    day: str
    what: Literal["identified", "diagnosed", "joined"]
    error: str = ""


def run_batch(
    store: FleetStore, days: Sequence[ArmDay], order: Order, report: Callable[[Progress], None]
) -> list[Progress]:
    """Work on the days, and then on the diagnoses that their changes ask for. One bad log never stops it."""
    done: list[Progress] = []

    def take(found: Iterable[Progress]) -> None:
        for one in found:
            report(one)
            done.append(one)

    days = [_next_part(store, day) for day in days]
    rest = list(days)
    while opening := _opening(store, rest):
        take(_parallel([(_identified, (store.folder, day, order)) for day in opening], order.jobs))
        rest = [day for day in rest if day not in opening]
    take(_parallel([(_identified, (store.folder, day, order)) for day in rest], order.jobs))
    touched = sorted({day.arm for day in days})
    usual = usual_scatter(store)
    if order.diagnose != "none":
        take(_parallel([(_diagnosed_arm, (store.folder, arm, order, usual)) for arm in touched], order.jobs))
    for arm in touched:
        try:
            write_together(ArmStore(store.folder / arm), usual)
        except (LwrError, OSError, ValueError) as error:
            take([Progress(arm, "", "joined", _words(error))])
    return done


def _parallel(
    tasks: Sequence[tuple[Callable[..., list[Progress]], tuple[Any, ...]]], jobs: int
) -> Iterable[Progress]:
    from joblib import Parallel, delayed

    if not tasks:
        return
    # The number of processes is this one's, or the cluster's.
    found = Parallel(n_jobs=jobs, return_as="generator_unordered")(
        delayed(task)(*arguments) for task, arguments in tasks
    )
    for progress in found:
        yield from progress


def _opening(store: FleetStore, days: Sequence[ArmDay]) -> list[ArmDay]:
    """The first of the days of each arm without a model: its signal settings hold for all others."""
    first: dict[str, ArmDay] = {}
    for day in sorted(days, key=lambda day: day.key):
        if not ArmStore(store.folder / day.arm).model.is_file():
            first.setdefault(day.arm, day)
    return list(first.values())


def _next_part(store: FleetStore, day: ArmDay) -> ArmDay:
    # The files of a failed day are written anew.
    taken = {
        row["key"] for row in ArmStore(store.folder / day.arm).read("sessions") if row["status"] == "taken"
    }
    while day.key in taken:
        day = replace(day, part=day.part + 1)
    return day


@contextmanager
def _quiet() -> Iterator[None]:
    """Without the warnings of each estimate; a task may run in the process of its caller."""
    logger = logging.getLogger("ident")
    before = logger.level
    logger.setLevel(logging.ERROR)
    try:
        yield
    finally:
        logger.setLevel(before)


@_quiet()
def _identified(folder: Path, day: ArmDay, order: Order) -> list[Progress]:
    """Identify one day and write it; an error is a result too."""
    store = ArmStore(folder / day.arm)
    sessions, rows = _read(day)
    error = ""
    try:
        if sessions:
            _write_day(store, day, _identification(store, sessions, order))
        else:
            error = "no usable log"
    except Exception as failure:
        error = _words(failure)
        for row in rows:
            if row["status"] == "taken":
                row |= {"status": "failed", "note": error}
    store.write(day.key, "sessions", rows)
    return [Progress(day.arm, day.key, "identified", error)]


def _read(day: ArmDay) -> tuple[list[Session], list[dict[str, Any]]]:
    """The usable logs of a day, and a row of the table for every one."""
    sessions: list[Session] = []
    rows: list[dict[str, Any]] = []
    for log in day.logs:
        row = {"uid": log.uid, "file": str(log.path.resolve()), "payload": "", "status": "taken", "note": ""}
        try:
            session = read_session(log.path, status=False)
            row["payload"] = session.metadata.get("payload", "")
            end = (session.end or {}).get("exit_status", "success")
            if end in ("success", ""):
                sessions.append(session)
            else:
                row |= {"status": "left out", "note": f"the session ended with {end}"}
        except Exception as error:
            row |= {"status": "unreadable", "note": _words(error)}
        rows.append(row)
    return sessions, rows


def _identification(store: ArmStore, sessions: Sequence[Session], order: Order) -> Identification:
    chain = session_chain(sessions[0])
    settings = known_settings(sessions, chain, order.settings)
    if store.model.is_file():
        model = read_model(store.model)
        signals = signal_settings(model)
        if signals is not None:
            settings = replace(
                settings,
                model=model.structure.model,
                signals=signals,
                coulomb=model.structure.coulomb,
                row_coulomb=model.structure.coulomb,
            )
    return identify(sessions, chain, settings)


def _write_day(store: ArmStore, day: ArmDay, found: Identification) -> None:
    estimate = of_exact_channels(found.estimate)
    weights = np.array([fit.sigma**-2 * fit.n_eff / max(fit.rows, 1) for fit in estimate.classes])
    store.write_factor(day.key, found.base.names, factor_of(found.problem, weights))
    store.write(
        day.key,
        "parameters",
        [
            {"name": name, "unit": unit, "value": float(value), "std": float(std)}
            for name, unit, value, std in zip(
                found.base.names, found.base.units, estimate.values, estimate.std, strict=True
            )
        ],
    )
    store.write(
        day.key,
        "errors",
        [
            {"joint": f.joint, "side": f.side, "rms": f.rms, "sigma": f.sigma, "rows": f.rows}
            for f in estimate.classes
        ],
    )
    if not store.model.is_file():
        write_model(found.model, store.model)


@_quiet()
def _diagnosed_arm(folder: Path, arm: str, order: Order, usual: Mapping[str, float]) -> list[Progress]:
    """The diagnoses that an arm's days ask for."""
    store = ArmStore(folder / arm)
    try:
        return _diagnoses(store, order, usual)
    except Exception as failure:
        return [Progress(arm, "", "diagnosed", _words(failure))]


def _diagnoses(store: ArmStore, order: Order, usual: Mapping[str, float]) -> list[Progress]:
    arm = store.name
    sessions: dict[str, list[Path]] = {}
    for row in store.read("sessions"):
        if row["status"] == "taken":
            sessions.setdefault(row["key"], []).append(Path(row["file"]))
    keys = sorted(sessions)
    healthy, later = keys[: order.reference_days], keys[order.reference_days :]
    done = {path.stem for path in (store.folder / "findings").glob("*.parquet")}
    wanted = later
    if order.diagnose == "changed":
        changed = arm_trend(store, usual).first_days
        if not changed:
            return []
        wanted = [key for key in keys if key in changed or (key == keys[-1] and key > min(changed))]
    wanted = [key for key in wanted if key not in done and key not in healthy]
    if not wanted:
        return []
    try:
        reference = _reference(store, [sessions[key] for key in healthy])
    except Exception as failure:
        return [Progress(arm, healthy[-1] if healthy else "", "diagnosed", f"baseline: {_words(failure)}")]
    return [_diagnosed(store, key, sessions[key], reference) for key in wanted]


def _reference(store: ArmStore, sets: Sequence[Sequence[Path]]) -> Reference:
    found = Reference.of(read_model(store.reference)) if store.reference.is_file() else None
    # Some stores have a model in its place, which tells nothing of healthy days.
    if found is None or not found.sets:
        read = [[read_session(path, status=False) for path in one] for one in sets]
        chain = session_chain(read[0][0])
        data = arm_data(known_arm(chain), chain)
        found = commission(read, chain, arm=data, robot=store.name)
        found.save(store.reference)
    return found


def _diagnosed(store: ArmStore, key: str, files: Sequence[Path], reference: Reference) -> Progress:
    try:
        sessions = [read_session(path, status=False) for path in files]
        chain = session_chain(sessions[0])
        data = arm_data(known_arm(chain), chain)
        found = diagnose(sessions, chain, arm=data, reference=reference)
    except Exception as failure:
        return Progress(store.name, key, "diagnosed", _words(failure))
    rows: list[Row] = [
        {
            "cause": one["cause"],
            "joints": ",".join(map(str, one["joints"])),
            "confidence": float(one["confidence"]),
            "delta_bic": float(one["evidence"]["delta_bic"]),
            "statement": f"{said.title}: {said.text}".rstrip(": "),
        }
        for one, said in zip(found.to_dict()["findings"], found.statements().findings, strict=True)
    ]
    store.write(key, "findings", rows)
    return Progress(store.name, key, "diagnosed")


def _words(error: BaseException) -> str:
    """An error in a line; of an unexpected one its kind and place as well."""
    if isinstance(error, (LwrError, OSError)):
        return str(error)
    last = traceback.extract_tb(error.__traceback__)[-1]
    return f"{type(error).__name__} in {Path(last.filename).name}:{last.lineno}: {error}"
