"""Further rounds of an experiment: plan with the estimate so far, drive, estimate from all rounds.

The motion of a round is planned with the present estimate (torque limits hold within its uncertainty), the noise of
the residuals, and the information of every session so far, so it adds the missing information. It passes the same
checks as any other motion.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np

from ident.estimation.channel_errors import of_exact_channels
from ident.estimation.identification import Identification
from ident.excitation import ExcitationPlan
from ident.excitation.arm_model import split_name
from ident.excitation.planner import Progress as SearchProgress
from ident.excitation.planner import plan
from ident.excitation.problem import Knowledge, PlanProblem, Prior
from ident.model.model_file import write_model
from lwr_driver.arm import Arm
from lwr_driver.arm.cell import Cell
from lwr_driver.configuration import find
from lwr_driver.motion import Motion
from runner.experiment import Record, Run
from runner.experiment_file import Experiment, Payload, SessionPlan
from runner.planning import excitation_rows, session_motion, store_plan, stored_plan
from runner.results import estimate, named_model, summarise, unseen_sessions, write_results
from runner.status import StatusLine

PLAN = "round-{}.plan.yaml"
MODEL = "round-{}.model.yaml"
KNOWN = "round-{}.known.yaml"
"""That model with the deviations that a further motion may reduce."""
# Searches for a motion with a start near home, and its row period for that check [s].
_SEARCHES, _ROW_S = 4, 0.005


def rounds_begun(folder: Path) -> int:
    """Number of further rounds with a plan in `folder`."""
    return next(k for k in itertools.count() if not (folder / PLAN.format(k + 2)).is_file())


def show_search(status: StatusLine, now: SearchProgress) -> None:
    """The progress of a search on the status line."""
    best = "none yet" if now.best is None else f"{now.best:.4g}"
    status.show(now.stage, now.done / max(now.total, 1), f"best feasible {best}")


@dataclass(frozen=True)
class Rounds:
    """The rounds after the first one, in the same folder: sessions NAME-round2, NAME-round3, ..."""

    experiment: Experiment
    arm: Arm
    cell: Cell
    folder: Path
    status: StatusLine

    def run(self, first: Run, records: Sequence[Record], rounds: int) -> list[Record]:
        """Run `rounds` further rounds after the `first` one with its `records`; returns all records.

        The results so far are written before each new round. An aborted or failed session ends the sequence and
        has the last record.
        """
        found, run = list(records), first
        for number in range(2, rounds + 2):
            if found[-1].status != "success":
                break
            motion = self._motion(number, found)
            again = tuple(
                replace(session, name=f"{session.name}-round{number}")
                for session in self.experiment.sessions
                if not session.validation
            )
            excite = _always(motion, self.experiment.excitation.periods)
            run = run.followed_by(self.experiment.changed(sessions=again), excite)
            found += run.sessions()
        return found

    def _motion(self, number: int, records: Sequence[Record]) -> ExcitationPlan:
        """The motion of a round, read from the folder, or planned now and stored there."""
        name = PLAN.format(number)
        stored = stored_plan(self.folder, name, self.arm)
        if stored is not None:
            return stored
        status = self.status
        status.show(f"estimate before round {number}")
        found = estimate(self.experiment, self.arm, records)
        summary = summarise(self.experiment, records, found)
        write_results(self.folder, self.experiment, self.arm, summary, found)
        write_model(named_model(found.model, self.arm.name), self.folder / MODEL.format(number - 1))
        # What no motion tells does not choose one.
        known, file = _known_but_for_channels(found), self.folder / KNOWN.format(number - 1)
        write_model(named_model(known.model, self.arm.name), file)
        problem = next_problem(self.experiment, self.cell, records, known, file)
        status.show(f"planning round {number}", None, "Ctrl-C keeps the best motion so far")
        motion = planned_to_run(
            self.experiment, self.arm, self.cell, problem, lambda now: show_search(status, now)
        )
        store_plan(self.folder, name, motion)
        status.clear()
        essential = known.estimate if known.essential is None else known.essential.estimate
        before = float(np.median(essential.rsd_percent))
        after = float(np.median(list(motion.rsd_percent.values())))
        status.say(
            f"round {number}: median relative deviation of {len(essential.names)} parameters {before:.2f} % now, "
            f"{after:.2f} % predicted after it"
        )
        return motion


def _known_but_for_channels(found: Identification) -> Identification:
    """An estimate with torque channels taken as exact."""
    essential = found.essential
    if essential is not None:
        essential = replace(essential, estimate=of_exact_channels(essential.estimate))
    return replace(found, estimate=of_exact_channels(found.estimate), essential=essential)


def planned_to_run(
    experiment: Experiment,
    arm: Arm,
    cell: Cell,
    problem: PlanProblem,
    show: Callable[[SearchProgress], None],
) -> ExcitationPlan:
    """The motion of a search. If the preflight refuses it from home (a start too far away, a stop too near to the
    cell), the next seed is searched.

    The motion of the last search is returned in any case; the preflight then refuses it with the reason.
    """
    search, home = problem.search, experiment.home(len(arm.joint_names))
    sessions = {session.payload: session for session in experiment.sessions if not session.validation}
    for seed in range(search.seed, search.seed + _SEARCHES):
        motion = plan(replace(problem, search=replace(search, seed=seed)), show)
        rows = excitation_rows(motion, experiment.excitation.periods)(_ROW_S)
        if all(session_motion(experiment, arm, cell, one, rows, home)[1].ok for one in sessions.values()):
            break
    return motion


def next_problem(
    experiment: Experiment, cell: Cell, records: Sequence[Record], found: Identification, model: Path
) -> PlanProblem:
    """The planning problem of the next round.

    Motion, objective, workspace and search come from the experiment's problem file. Arm, cell, sessions, payload,
    noise, present estimate (`model`, with its covariance) and the recorded sessions, as prior, come from the
    experiment.
    """
    wanted = PlanProblem.load(find(experiment.replan.problem, beside=experiment.folder))
    payload = experiment.heaviest
    loads: list[Literal["unloaded", "loaded"]] = [
        "unloaded" if session.payload is None else "loaded"
        for session in experiment.sessions
        if not session.validation
    ]
    unseen = unseen_sessions(experiment)
    prior = tuple(Prior(session=str(r.path.resolve())) for r in records if r.name not in unseen)
    clearance = 0.0 if wanted.clearance_m is None else wanted.clearance_m
    return replace(
        wanted,
        arm=str(find(experiment.arm, beside=experiment.folder)),
        cell=str(find(experiment.cell, beside=experiment.folder)),
        payload_shape=None if payload is None else payload.shape,
        motion=replace(wanted.motion, periods=experiment.excitation.periods),
        knowledge=_knowledge(wanted.knowledge, payload, found, model),
        parameters=_names(found, payload),
        sessions=tuple(dict.fromkeys(loads)),
        model=experiment.identification.model,
        clearance_m=max(clearance, experiment.moves.clearance_m, cell.margin_m),
        prior=prior,
    )


def _always(motion: ExcitationPlan, periods: int) -> Callable[[SessionPlan, float], Motion]:
    rows = excitation_rows(motion, periods)
    return lambda session, period_s: rows(period_s)


def _knowledge(wanted: Knowledge, payload: Payload | None, found: Identification, model: Path) -> Knowledge:
    """Present knowledge: the estimate with its covariance, and the noise of its residuals."""
    joints = found.structure.chain.joint_names
    fits = {(fit.side, fit.joint): fit for fit in found.estimate.classes}
    # rows of the difference of both sides are weighted as motor rows
    sides = {"joint": "joint", "motor": "difference" if found.settings.model == 3 else "motor"}
    noise = {
        side: tuple(fits[label, joint].sigma if (label, joint) in fits else 1.0 for joint in joints)
        for side, label in sides.items()
    }
    independent = float(np.median([fit.n_eff for fit in fits.values()]))
    return replace(
        wanted,
        file=str(model.resolve()),
        payload=None if payload is None else payload.name,
        noise_motor=noise["motor"],
        noise_joint=noise["joint"],
        samples=max(1.0, independent / len(found.prepared)),
    )


def _names(found: Identification, payload: Payload | None) -> tuple[str, ...]:
    names = found.base.names if found.essential is None else found.essential.names
    joints = found.structure.chain.n
    link = None if payload is None else found.structure.payload_link(payload.name)
    kept = []
    for name in names:
        kind, body = split_name(name)
        if body <= joints:
            kept.append(name)
        elif link is not None and body == link + 1:
            kept.append(f"{kind}{joints + 1}")
    return tuple(kept)
