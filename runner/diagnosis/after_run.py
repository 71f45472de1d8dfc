"""The diagnosis at the end of an experiment, and the motions that decide what it leaves open.

A failure of the diagnosis never spoils the experiment: it is said, and the results stand.
"""

from __future__ import annotations

import dataclasses
import json
import logging
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fri.errors import LwrError
from ident.dynamics.kinematics import Chain
from ident.model.model_file import read_model
from lwr_driver.arm import Arm
from lwr_driver.arm.cell import Cell
from lwr_driver.configuration import find
from lwr_driver.motion import Motion
from lwr_driver.session import JointColumns, Phase, Session, read_session
from runner.diagnosis.deciding import SURE, Deciding, offers, open_findings
from runner.diagnosis.decision import Answer, decision_text, decisions
from runner.diagnosis.study import DIAGNOSIS, Study, study
from runner.experiment import Bench, Progress, Record, Run
from runner.experiment_file import Experiment, SessionPlan
from runner.planning import Excitations, excitation_rows

__all__ = ["DECIDING", "DECISION", "FOLDER", "Conclusion", "conclude_run"]

log = logging.getLogger(__name__)

FOLDER = "diagnosis"
DECIDING = "deciding"
DECISION = "decision.json"
BEFORE = "before_deciding.json"
PAUSE_NS = 10_000_000_000

Laboratory = Callable[[Experiment], AbstractContextManager[Bench]]


@dataclass(frozen=True, eq=False)
class Conclusion:
    """How an experiment ends: the diagnosis or why there is none, and what the deciding motions said.

    asked : whether deciding motions were wanted. sure : confidence below which a finding is open.
    """

    study: Study | None
    failure: str = ""
    answers: tuple[Answer, ...] = ()
    asked: bool = False
    sure: float = SURE

    def text(self, folder: Path) -> str:
        """For the screen. folder : of the experiment, for what can be run next."""
        if self.study is None:
            return f"No diagnosis: {self.failure}. The results of the experiment stand."
        lines = [str(self.study)]
        if self.answers:
            names = self.study.diagnosis.base_model.structure.chain.joint_names
            lines.append(decision_text(self.answers, names))
        if self.failure:
            lines.append(f"The deciding motions came to no end: {self.failure}. The diagnosis above stands.")
        elif self.asked and not self.answers:
            still = open_findings(self.study.diagnosis, self.sure)
            reason = (
                "no deciding motion passes every check" if still else "no finding is open between look-alikes"
            )
            lines.append(f"Nothing was run to decide: {reason}.")
        elif self.study.offers and not self.answers:
            lines.append(
                f"`lwr-run experiment --resume {folder} --decide` runs what would decide and concludes."
            )
        return "\n".join(lines)

    def to_dict(self) -> dict[str, Any]:
        """Plain content: the diagnosis, the decision, the failure."""
        return {
            "diagnosis": None if self.study is None else self.study.diagnosis.to_dict(),
            "decision": [answer.to_dict() for answer in self.answers],
            "failure": self.failure,
        }


def conclude_run(
    experiment: Experiment,
    arm: Arm,
    cell: Cell,
    motions: Excitations,
    folder: Path,
    records: Sequence[Record],
    *,
    laboratory: Laboratory,
    decide: bool = False,
) -> Conclusion:
    """Diagnose the finished sessions of an experiment into `folder/diagnosis`.

    motions : of the experiment. laboratory : gives a bench for an experiment, for the deciding motions. decide :
    run the motions that would decide what is open, diagnose again with them, and say what was decided.
    """
    target = folder / FOLDER
    # What was decided once stays decided: its sessions are there and are not run again.
    decide = decide or (target / DECISION).is_file()
    (target / DECISION).unlink(missing_ok=True)
    try:
        first = _diagnosed(experiment, arm, folder, records)
        first = first.with_offers(offers(first.diagnosis, experiment, arm, cell, motions.exciting))
        first.write(target)
    # Whatever goes wrong here must not take the experiment with it.
    except Exception as error:
        return Conclusion(None, _reason(error))
    if not decide or not first.offers:
        return Conclusion(first, asked=decide, sure=experiment.diagnosis.sure)
    try:
        return _decided(experiment, arm, folder, records, first, laboratory)
    except Exception as error:
        return Conclusion(first, _reason(error))


def _decided(
    experiment: Experiment,
    arm: Arm,
    folder: Path,
    records: Sequence[Record],
    first: Study,
    laboratory: Laboratory,
) -> Conclusion:
    """Run the deciding motions, diagnose with them, and answer."""
    place = folder / FOLDER / DECIDING
    place.mkdir(parents=True, exist_ok=True)
    deciding = _with_sessions(experiment, first.offers)
    if not (place / "progress.json").is_file():
        Progress.create(place, experiment.folder)
    plans = {session.name: offer.plan for offer in first.offers for session in offer.sessions}

    def rows(session: SessionPlan, period_s: float) -> Motion:
        plan = plans[session.name]
        return excitation_rows(plan, plan.periods)(period_s)

    with laboratory(deciding) as bench:
        done = Run(deciding, place, bench, rows).sessions()
    finished = [record for record in done if record.status == "success"]
    if len(finished) < len(done):
        return Conclusion(first, f"session {done[-1].name}: {done[-1].reason}; `--decide` goes on from there")
    second = _diagnosed(experiment, arm, folder, records, finished)
    answers = decisions(first.diagnosis, second.diagnosis, experiment.diagnosis.sure)
    target = folder / FOLDER
    (target / DIAGNOSIS).replace(target / BEFORE)
    second = second.with_offers(())
    second.write(target)
    content = {"schema_version": 1, "answers": [answer.to_dict() for answer in answers]}
    (target / DECISION).write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
    return Conclusion(second, answers=answers)


def _diagnosed(
    experiment: Experiment,
    arm: Arm,
    folder: Path,
    records: Sequence[Record],
    further: Sequence[Record] = (),
) -> Study:
    """The diagnosis of all finished sessions; those for validation are only measured on."""
    unseen = {session.name for session in experiment.sessions if session.validation}
    logs: dict[bool, list[Session]] = {False: [], True: []}
    for record in records:
        logs[record.name in unseen].append(read_session(record.path, status=False))
    last = max(log.joint.log_time[-1] for log in (*logs[False], *logs[True]))
    for record in further:
        log = read_session(record.path, status=False)
        # The emulator's clock begins anew with it; what is run later is later.
        log = _later(log, max(0, int(last) + PAUSE_NS - log.start))
        last = log.joint.log_time[-1]
        logs[False].append(log)
    wanted = experiment.diagnosis.reference
    reference = None if wanted is None else read_model(find(wanted, beside=experiment.folder))
    return study(logs[False], Chain.from_urdf(arm.urdf), test=logs[True], arm=arm, reference=reference)


def _later(session: Session, shift_ns: int) -> Session:
    """The session at a later time, without the channels that no diagnosis needs."""

    def shifted(columns: JointColumns) -> JointColumns:
        return dataclasses.replace(
            columns, log_time=columns.log_time + shift_ns, publish_time=columns.publish_time + shift_ns
        )

    return dataclasses.replace(
        session,
        joint=shifted(session.joint),
        motor=None if session.motor is None else shifted(session.motor),
        command=None if session.command is None else shifted(session.command),
        phases=tuple(Phase(phase.log_time + shift_ns, phase.name) for phase in session.phases),
        status=None,
        controller_model=None,
    )


def _with_sessions(experiment: Experiment, motions: Sequence[Deciding]) -> Experiment:
    """The experiment with the sessions of the deciding motions instead of its own."""
    sessions = [session for motion in motions for session in motion.sessions]
    # As few swaps of the payload as can be.
    order = list(dict.fromkeys(session.payload for session in sessions))
    return experiment.changed(sessions=tuple(sorted(sessions, key=lambda one: order.index(one.payload))))


def _reason(error: Exception) -> str:
    log.info("the diagnosis failed", exc_info=error)
    return str(error) if isinstance(error, LwrError) else f"{type(error).__name__}: {error}"
