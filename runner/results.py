"""Results of an experiment, or of logs alone: model.yaml, summary.json and a short text report."""

from __future__ import annotations

import dataclasses
import json
import logging
import math
import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np

from fri.errors import LwrError, naming
from ident.dynamics.kinematics import Chain
from ident.dynamics.parameters import DRIVE, split_name
from ident.estimation.estimator_comparison import compared
from ident.estimation.identification import Identification, IdentificationSettings
from ident.estimation.identify import identify
from ident.estimation.scores import by_side
from ident.estimation.validate import validate
from ident.estimators.estimate import Estimate, two_digits
from ident.estimators.problem import condition_text
from ident.model import DynamicModel
from ident.model.model_file import write_model
from ident.rows.filters import SignalSettings
from lwr_driver.arm import Arm
from lwr_driver.listing import Piece, text_of
from lwr_driver.session import Session, read_session
from runner.computer import versions
from runner.estimation import named_model
from runner.experiment import Record
from runner.experiment_file import Experiment
from runner.file_names import MODEL, SUMMARY
from runner.published import characteristics
from runner.terminal import write_json
from sim_backend.configuration import load_configuration
from sim_backend.robot import Payload as Body
from sim_backend.robot import robot_file, truth

log = logging.getLogger(__name__)


def estimate(
    experiment: Experiment,
    arm: Arm,
    records: Sequence[Record],
    tell: Callable[[str], None] | None = None,
) -> Identification:
    """Identify the arm from the finished sessions of an experiment, those for validation left out.

    tell : is told the estimate in a sentence as soon as it stands; the comparison of estimators follows.
    """
    wanted = experiment.identification
    settings = IdentificationSettings(
        model=wanted.model,
        signals=SignalSettings(
            cutoff_hz=wanted.cutoff_hz,
            decimate_hz=wanted.decimate_hz,
            stiffness_nm_rad=tuple(arm.stiffness.tolist()),
        ),
        estimator=wanted.estimator,
        resonance_hz=arm.resonance_hz,
    )
    unseen = unseen_sessions(experiment)
    kept = [r.path for r in records if r.status == "success" and r.name not in unseen]
    sessions = [read_session(path, status=False) for path in kept]
    found = identify(sessions, Chain.from_urdf(arm.urdf), settings)
    if tell is not None:
        tell(_in_a_sentence(found))
    if found.choice is not None:
        return found
    # Beside the experiment's own estimator, what the others would predict.
    return dataclasses.replace(found, choice=compared(found, sessions, used=str(wanted.estimator)))


def _in_a_sentence(found: Identification) -> str:
    essential = "" if found.essential is None else f", {len(found.essential.names)} essential"
    return (
        f"estimate: {len(found.estimate.names)} base parameters{essential}, condition number "
        f"{condition_text(found.condition)}, median relative std {two_digits(found.median_rsd_percent)} %"
    )


def held_out_errors(summary: Mapping[str, Any], folder: Path) -> str:
    """The torque errors of the held-out sessions, or else of those of the estimate, and the place of the model."""
    scores = summary.get("validation") or summary.get("fit") or ()
    lines = [f"torque error of {score['session']}: {by_side(score['torque_error'])}" for score in scores]
    return "\n".join([*lines, f"model: {folder / 'model.yaml'}"])


def unseen_sessions(experiment: Experiment) -> frozenset[str]:
    """Names of the held-out sessions."""
    return frozenset(plan.name for plan in experiment.sessions if plan.validation)


def true_base(experiment: Experiment, found: Identification) -> dict[str, float]:
    """The emulated arm's true base parameters by name; empty for a real arm, and beside a sealed effect, which they
    would betray.
    """
    if experiment.backend != "emulator" or experiment.sealed:
        return {}
    structure = found.structure
    standard: dict[str, float] = {}
    try:
        config = load_configuration(experiment.emulator_path, experiment.emulator_settings)
        if config.robot.plant is not None or not _same_arm(config.beside(config.robot.urdf), structure.chain):
            return {}
        mounted = {
            plan.payload.name: plan.payload for plan in experiment.sessions if plan.payload is not None
        }
        known = robot_file(config).payloads
        for name in structure.payloads or (None,):
            body = known.get(name or "")
            if body is None and name in mounted:
                # The emulated person mounts it as the experiment announces it.
                announced = mounted[name]
                body = Body.from_centre_of_mass(announced.mass, announced.com, announced.inertia)
            link = structure.chain.n if name is None else structure.payload_link(name)
            assert link is not None
            standard |= truth(config, body or Body(0.0), link=link + 1)
    except LwrError as error:
        log.warning("the emulated arm has no true parameters to compare with: %s", error)
        return {}
    values = np.array([standard.get(name, 0.0) for name in structure.names])
    return dict(zip(found.base.names, found.base.reduce(values).tolist(), strict=True))


def _same_arm(urdf: Path, chain: Chain) -> bool:
    """Whether the emulated arm has the kinematics of the estimate, so that parameters mean the same."""
    other = Chain.from_urdf(urdf.read_text(encoding="utf-8"))
    pairs = ((getattr(other, name), getattr(chain, name)) for name in ("alpha", "d", "theta", "r", "gravity"))
    return other.n == chain.n and all(np.allclose(one, two, atol=1e-6) for one, two in pairs)


def agreement(parameters: Sequence[dict[str, Any]]) -> float:
    """Share of the estimates within three standard deviations of the truth."""
    inside = [within(entry) for entry in parameters if "truth" in entry]
    return sum(inside) / len(inside) if inside else math.nan


def within(entry: Mapping[str, Any], sigmas: float = 3.0) -> bool:
    """Whether a parameter's estimate is within `sigmas` standard deviations of the truth."""
    return bool(abs(entry["estimate"] - entry["truth"]) <= sigmas * entry["std"])


def interval_holds(entry: Mapping[str, Any]) -> bool:
    """Whether a parameter's 95 % interval holds the truth."""
    low, high = entry["interval_95"]
    return bool(low <= entry["truth"] <= high)


def coverage(
    parameters: Sequence[dict[str, Any]], joints: int, holds: Callable[[Mapping[str, Any]], bool]
) -> dict[str, dict[str, int]]:
    """By kind of parameter, of how many (`count`) the truth is where it `holds` (`inside`).

    parameters : with `truth`, and the keys of `holds`. joints : number of joints; links beyond are payloads.
    """
    found: dict[str, dict[str, int]] = {}
    for entry in parameters:
        if "truth" in entry:
            tally = found.setdefault(_kind(entry["name"], joints), {"inside": 0, "count": 0})
            tally["inside"] += holds(entry)
            tally["count"] += 1
    return found


def _kind(name: str, joints: int) -> str:
    symbol, link, _ = split_name(name)
    if symbol in DRIVE:
        return symbol
    if link > joints:
        return "payload"
    return "first moments" if symbol.startswith("M") else "inertias"


def summarise(
    experiment: Experiment, records: Sequence[Record], found: Identification | None
) -> dict[str, Any]:
    """Content of summary.json: end of the experiment, estimate, link."""
    last = records[-1]
    unseen = unseen_sessions(experiment)
    summary: dict[str, Any] = {
        "schema_version": 1,
        "experiment": experiment.name,
        "exit_status": last.status,
        "reason": last.reason if last.status != "success" else "",
        "sessions": [
            _entry(r.name, r.path.name, r.name in unseen, r.status, r.reason, r.warnings) for r in records
        ],
        "link": {
            record.name: dataclasses.asdict(record.link) for record in records if record.link is not None
        },
        "versions": versions(),
    }
    if experiment.backend == "emulator":
        summary["hidden"] = _hidden(experiment)
    if found is None:
        return summary
    logs: dict[bool, list[Session]] = {False: [], True: []}
    for record in records:
        if record.status == "success":
            logs[record.name in unseen].append(read_session(record.path, status=False))
    summary.update(estimated(found, found.model, logs[False], logs[True]))
    known = true_base(experiment, found)
    for entry in summary["parameters"]:
        if entry["name"] in known:
            entry["truth"] = known[entry["name"]]
    if known:
        n = found.structure.chain.n
        summary["within_3_sigma"] = agreement(summary["parameters"])
        summary["within_3_sigma_by_kind"] = coverage(summary["parameters"], n, within)
        summary["intervals_95_hold"] = coverage(summary["parameters"], n, interval_holds)
    return summary


def _hidden(experiment: Experiment) -> Literal["nothing", "sealed", "in the settings"]:
    """Effects beyond the model's equations in the emulated arm."""
    if experiment.sealed:
        return "sealed"
    robot = load_configuration(experiment.emulator_path, experiment.emulator_settings).robot
    return "in the settings" if robot.effects or robot.plant is not None else "nothing"


def estimated(
    found: Identification, model: DynamicModel, fitted: Sequence[Session], tested: Sequence[Session]
) -> dict[str, Any]:
    """Content of a summary from an estimate and its model. fitted : its sessions. tested : held-out sessions.

    A session that cannot be scored is listed with its reason in `unscored`.
    """
    content = found.to_dict()
    content["prepared"] = content.pop("sessions")
    content["excitation"] = characteristics(found)
    for entry, interval in zip(content["parameters"], found.estimate.interval().tolist(), strict=True):
        entry["interval_95"] = interval
    if found.essential is not None:
        content["essential"]["parameters"] = _estimates(found.essential.estimate)
    scores = {"fit": fitted, "validation": tested}
    content["unscored"] = []
    for key, sessions in scores.items():
        if sessions:
            known = found.known if key == "fit" else None
            scored = validate(
                model, sessions, allow_seen=known is not None, keep_going=True, known=known
            ).to_dict()
            content[key] = scored["sessions"]
            content["unscored"] += scored["unscored"]
    return content


def write_results(
    folder: Path, experiment: Experiment, arm: Arm, summary: dict[str, Any], found: Identification | None
) -> list[Piece]:
    """Write model.yaml, report.txt and summary.json into `folder`; returns the text of the report.

    Link statistics of sessions finished in an earlier run stay in the summary.
    """
    summary["link"] = {**_earlier_link(folder, summary), **summary["link"]}
    report = _report(experiment, summary, found)
    if found is not None:
        files = {file["path"]: file["sha256"] for file in summary.get("files", ())}
        write_model(named_model(found.model, arm.name, files), folder / MODEL)
    write_text(folder / "report.txt", text_of(report))
    write_json(folder / SUMMARY, summary)
    return report


def write_text(path: Path, text: str) -> None:
    """Write a text with one end of line behind it; FileError with the path where the disk refuses it."""
    with naming(path):
        path.write_text(f"{text.rstrip()}\n", encoding="utf-8")


def _earlier_link(folder: Path, summary: dict[str, Any]) -> dict[str, Any]:
    """Link statistics of the previous summary, for sessions finished there and here."""
    try:
        earlier = json.loads((folder / SUMMARY).read_text(encoding="utf-8"))
        kept = {entry["name"] for entry in earlier["sessions"] if entry["exit_status"] == "success"}
        link = dict(earlier["link"])
    except (OSError, ValueError, KeyError, TypeError):
        return {}
    names = [entry["name"] for entry in summary["sessions"] if entry["exit_status"] == "success"]
    return {name: link[name] for name in names if name in kept and name in link}


def _estimates(estimate: Estimate) -> list[dict[str, Any]]:
    columns = {
        "name": estimate.names,
        "unit": estimate.units or [""] * len(estimate.names),
        "estimate": estimate.values.tolist(),
        "std": estimate.std.tolist(),
        "rsd_percent": estimate.rsd_percent.tolist(),
    }
    return [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]


def _report(experiment: Experiment, summary: dict[str, Any], found: Identification | None) -> list[Piece]:
    lines: list[Piece] = [f"Experiment {experiment.name}: {summary['exit_status']}"]
    if summary["reason"]:
        lines.append(f"  reason: {summary['reason']}")
    for entry in summary["sessions"]:
        lines.append(f"  {entry['file']:<20} {entry['exit_status']}  {entry['reason']}".rstrip())
        lines += [f"    warning: {warning}" for warning in entry["warnings"]]
    for name, link in summary["link"].items():
        tracking = 1000 * max(link["worst_tracking_error_rad"])
        latency = ", ".join(f"{key} {1e6 * value:.0f} µs" for key, value in link["latency_s"].items())
        lines.append(
            f"  link of {name}: {link['cycles']} cycles, {link['missed']} missed, reply {latency}, "
            f"tracking error at most {tracking:.1f} mrad"
        )
    if found is None:
        return lines
    if "within_3_sigma" in summary:
        held = summary["intervals_95_hold"].values()
        inside, count = (sum(tally[key] for tally in held) for key in ("inside", "count"))
        lines.append(
            f"  against the emulated arm's true parameters: {100 * summary['within_3_sigma']:.1f} % of the "
            f"estimates within 3 standard deviations, {100 * inside / count:.1f} % of the 95 % intervals hold"
        )
    for score in (*summary.get("validation", ()), *summary.get("fit", ())):
        kind = "session of the estimate" if score["seen"] else "held out"
        lines.append(f"  torque error of {score['session']}, {kind}: {by_side(score['torque_error'])}")
    lines += [
        f"  no torque error of {one['session']}: {one['reason']}" for one in summary.get("unscored", ())
    ]
    return [*lines, "", *found.pieces()]


_ANNOUNCED = ("payload", "payload_mass")


def write_log_results(
    folder: Path,
    found: Identification,
    sessions: Sequence[Session],
    tested: Sequence[Session],
    model: DynamicModel,
    *,
    text: str,
) -> Path:
    """Write summary.json, model.yaml, report.txt and report.html into `folder`; returns the path of the page.

    sessions : of the estimate. tested : held-out sessions. The logs are not copied; the summary has their paths.
    """
    entries = []
    for index, (session, name) in enumerate(_named([*sessions, *tested])):
        file = os.path.relpath(session.path.resolve(), folder.resolve())
        # The command line may correct the payload of the log.
        announced = {key: session.metadata[key] for key in _ANNOUNCED if key in session.metadata}
        entries.append({**_entry(name, file, index >= len(sessions)), "metadata": announced})
    summary = {
        "schema_version": 1,
        "experiment": folder.resolve().name,
        "from_logs": True,
        "exit_status": "success",
        "reason": "",
        "sessions": entries,
        "link": {},
        "versions": versions(),
        **estimated(found, model, sessions, tested),
    }
    write_model(model, folder / MODEL)
    write_text(folder / "report.txt", text)
    write_json(folder / SUMMARY, summary)
    from runner.report.page import write_report

    return write_report(folder)


def _entry(
    name: str,
    file: str,
    unseen: bool,
    status: str = "success",
    reason: str = "",
    warnings: Sequence[str] = (),
) -> dict[str, Any]:
    return {
        "name": name,
        "file": file,
        "exit_status": status,
        "reason": reason,
        "validation": unseen,
        "warnings": list(warnings),
    }


def _named(sessions: Sequence[Session]) -> list[tuple[Session, str]]:
    """The sessions with their names: the file names, with the folder for equal names."""
    stems = [session.path.stem for session in sessions]
    return [
        (session, stem if stems.count(stem) == 1 else f"{session.path.resolve().parent.name}-{stem}")
        for session, stem in zip(sessions, stems, strict=True)
    ]
