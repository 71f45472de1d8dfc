"""The diagnosis at the end of an experiment, and the discriminating experiments for its open findings.

A failure of the diagnosis is reported and leaves the results of the experiment alone.
"""

from __future__ import annotations

import dataclasses
import json
import logging
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from fri.errors import LwrError
from ident.diagnosis import Diagnosis, Finding
from ident.diagnosis.outcome.claims_in_words import SURE, answer_statement
from ident.diagnosis.outcome.look_alikes import Place
from ident.diagnosis.outcome.statements import run_advice
from ident.dynamics.kinematics import Chain
from ident.model.model_file import read_model
from lwr_driver.arm import Arm
from lwr_driver.arm.cell import Cell
from lwr_driver.configuration import find
from lwr_driver.listing import Piece
from lwr_driver.motion import Motion
from lwr_driver.session import JointColumns, Phase, Session, read_session
from runner.diagnosis.discriminating import PAUSE_NS, Discriminating, offers, open_findings
from runner.diagnosis.study import Study, study
from runner.experiment import Bench, ExperimentProgress, Record, Run
from runner.experiment_file import Experiment, SessionPlan
from runner.file_names import DECISION, DIAGNOSIS
from runner.planning import Excitations, excitation_rows

log = logging.getLogger(__name__)

FOLDER = "diagnosis"
DECIDING = "deciding"
BEFORE = "before_deciding.json"

Laboratory = Callable[[Experiment], AbstractContextManager[Bench]]


@dataclass(frozen=True)
class Answer:
    """The second diagnosis on one open finding of the first.

    rivals : the causes in question, the better one first. outcome : `decided` for one of them, still `open`, or
    `neither`. named : the cause named by the second diagnosis.
    """

    rivals: tuple[Place, ...]
    outcome: Literal["decided", "open", "neither"]
    named: Place | None
    confidence: float

    def to_dict(self) -> dict[str, Any]:
        """Plain content."""
        return {
            "rivals": [{"cause": cause, "joints": list(joints)} for cause, joints in self.rivals],
            "outcome": self.outcome,
            "named": None if self.named is None else {"cause": self.named[0], "joints": list(self.named[1])},
            "confidence": self.confidence,
        }


def decisions(before: Diagnosis, after: Diagnosis, sure: float = SURE) -> tuple[Answer, ...]:
    """One answer for each finding open before. sure : lowest confidence of a decision."""
    found = []
    for finding in open_findings(before, sure):
        rivals = (_place(finding), *((cause, joints) for cause, joints, _ in finding.alternatives))
        rivals = tuple(dict.fromkeys(rivals))
        mine = [f for f in after.claims if _place(f) in rivals]
        certain = [f for f in mine if f.confidence >= sure]
        if certain:
            found.append(Answer(rivals, "decided", _place(certain[0]), certain[0].confidence))
        elif mine:
            found.append(Answer(rivals, "open", _place(mine[0]), mine[0].confidence))
        else:
            joints = {joint for _, places in rivals for joint in places}
            other = next((f for f in after.claims if set(f.joints) & joints), None)
            named = None if other is None else _place(other)
            found.append(Answer(rivals, "neither", named, 0.0 if other is None else other.confidence))
    return tuple(found)


def _place(finding: Finding) -> Place:
    return finding.cause, tuple(finding.joints)


@dataclass(frozen=True, eq=False)
class Conclusion:
    """The end of an experiment: the diagnosis or the reason for none, and the answers of discriminating experiments.

    asked : whether discriminating experiments were wanted.
    """

    study: Study | None
    failure: str = ""
    answers: tuple[Answer, ...] = ()
    asked: bool = False

    def pieces(self, folder: Path) -> list[Piece]:
        """The diagnosis and `advice`. folder : of the experiment."""
        return [*([] if self.study is None else self.study.said.pieces()), *self.advice(folder)]

    def advice(self, folder: Path) -> list[str]:
        """A failure, answers, and what to do next. folder : of the experiment."""
        if self.study is None:
            return [f"No diagnosis: {self.failure}. The results of the experiment stand."]
        names = self.study.diagnosis.base_model.structure.chain.joint_names
        lines = [f"{answer_statement(answer.to_dict(), names)}." for answer in self.answers]
        if self.failure:
            lines.append(
                f"The discriminating experiments failed: {self.failure}. The diagnosis above stands."
            )
        elif self.asked and not self.answers:
            still = open_findings(self.study.diagnosis, self.study.sure)
            reason = "no motion passes every check" if still else "no finding is open between look-alikes"
            lines.append(f"No discriminating experiment was run: {reason}.")
        elif self.study.offers and not self.answers:
            lines.append(run_advice(str(folder)))
        return lines

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

    motions : of the experiment. laboratory : gives a bench for the discriminating experiments. decide : run the
    discriminating experiments, diagnose again with them, and report the decisions.
    """
    target = folder / FOLDER
    # A decision once made stands: its sessions exist and are not run again.
    decide = decide or (target / DECISION).is_file()
    (target / DECISION).unlink(missing_ok=True)
    try:
        first = _diagnosed(experiment, arm, folder, records)
        first = first.with_offers(offers(first.diagnosis, experiment, arm, cell, motions.exciting))
        first.write(target)
    # No error here may take the experiment with it.
    except Exception as error:
        return Conclusion(None, _reason(error))
    if not decide or not first.offers:
        return Conclusion(first, asked=decide)
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
    """Run the discriminating experiments, diagnose with them, and answer."""
    place = folder / FOLDER / DECIDING
    place.mkdir(parents=True, exist_ok=True)
    deciding = _with_sessions(experiment, first.offers)
    if not (place / "progress.json").is_file():
        ExperimentProgress.create(place, experiment.folder)
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
    """The diagnosis of all finished sessions; the ones for validation are only measured on."""
    unseen = {session.name for session in experiment.sessions if session.validation}
    logs: dict[bool, list[Session]] = {False: [], True: []}
    for record in records:
        logs[record.name in unseen].append(read_session(record.path, status=False))
    last = max(log.joint.log_time[-1] for log in (*logs[False], *logs[True]))
    for record in further:
        log = read_session(record.path, status=False)
        # The clock of every emulator begins anew; further sessions come later.
        log = _later(log, max(0, int(last) + PAUSE_NS - log.start))
        last = log.joint.log_time[-1]
        logs[False].append(log)
    wanted = experiment.diagnosis.reference
    return study(
        logs[False],
        Chain.from_urdf(arm.urdf),
        test=logs[True],
        arm=arm,
        reference=None if wanted is None else read_model(find(wanted, beside=experiment.folder)),
        sure=experiment.diagnosis.sure,
    )


def _later(session: Session, shift_ns: int) -> Session:
    """The session at a later time, without the channels unused by a diagnosis."""

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


def _with_sessions(experiment: Experiment, offered: Sequence[Discriminating]) -> Experiment:
    sessions = [session for one in offered for session in one.sessions]
    # With as few payload swaps as possible.
    order = list(dict.fromkeys(session.payload for session in sessions))
    return experiment.changed(sessions=tuple(sorted(sessions, key=lambda one: order.index(one.payload))))


def _reason(error: Exception) -> str:
    log.info("the diagnosis failed", exc_info=error)
    return str(error) if isinstance(error, LwrError) else f"{type(error).__name__}: {error}"
