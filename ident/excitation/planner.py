"""From a problem to a checked plan: set-up, search, polish, proof. The library function behind `lwr-run
plan`.
"""

from __future__ import annotations

import dataclasses
import importlib.metadata
import logging
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from joblib import Parallel, delayed

from fri.errors import OperatorError, RefusedError
from ident.excitation.assembly import Assembled, assemble
from ident.excitation.check import Check
from ident.excitation.infeasible import explain, refuse_impossible
from ident.excitation.motion import ParametricMotion
from ident.excitation.plan import ExcitationPlan
from ident.excitation.polish import polish
from ident.excitation.problem import PlanProblem
from ident.excitation.search import Candidate, begin, hop

__all__ = ["Progress", "plan", "search_candidates"]

_log = logging.getLogger(__name__)

_HOPS_PER_TASK = 5


@dataclass(frozen=True)
class Progress:
    """Where the search stands: stage, tasks done and planned, best value in reported units, seconds since
    start.
    """

    stage: str
    done: int
    total: int
    best: float | None
    feasible: bool
    elapsed_s: float


def plan(problem: PlanProblem, progress: Callable[[Progress], None] | None = None) -> ExcitationPlan:
    """Search for the best motion that keeps every limit, and return it with margins, values and provenance.

    Interrupted by Ctrl-C, the search ends and the best motion found so far is polished, checked and returned.

    Raises ConfigurationError for a problem that contradicts itself, RefusedError for one without a feasible
    motion (naming the limit and by how much), OperatorError if interrupted before anything feasible was
    found. A motion that violates anything is never returned.
    """
    problem, interrupted = _with_goal(problem, progress)
    assembled = assemble(problem)
    refuse_impossible(assembled)
    tracker = _Tracker(assembled, progress)
    tracker.interrupted = interrupted
    candidates = search_candidates(assembled, tracker)
    tracker.stage("polish", 1)
    motion, check, value = _first_that_passes(assembled, candidates, tracker.interrupted)
    result = _describe(assembled, motion, check, tracker, value)
    tracker.advance(None)
    return result


def _with_goal(problem: PlanProblem, progress: Callable[[Progress], None] | None) -> tuple[PlanProblem, bool]:
    """The problem with a goal for the condition number: given, or what a search for it alone reaches (Remark 4).

    Also tells whether that search was interrupted.
    """
    wanted = problem.objective
    if wanted.criterion != "goal_attainment" or wanted.goal_condition is not None:
        return problem, False
    alone = replace(problem, objective=replace(wanted, criterion="condition_number"))
    assembled = assemble(alone)
    refuse_impossible(assembled)
    tracker = _Tracker(assembled, progress)
    best = search_candidates(assembled, tracker)[0]
    if not best.feasible:
        raise RefusedError(explain(assembled, [polish(assembled, best, quick=True)]))
    goal = float(np.exp(best.value))
    _log.info("goal of the condition number from a search for it alone: %.2f", goal)
    return replace(problem, objective=replace(wanted, goal_condition=goal)), tracker.interrupted


class _Tracker:
    """Counts tasks, keeps the best value, tells the listener, and knows whether time is up."""

    def __init__(self, assembled: Assembled, listener: Callable[[Progress], None] | None) -> None:
        self.assembled, self.listener = assembled, listener
        self.begun = time.monotonic()
        self.interrupted = False
        self.evaluations = 0
        self.best: Candidate | None = None
        self.name, self.done, self.total = "", 0, 0

    def stage(self, name: str, total: int) -> None:
        """Begin a stage of `total` tasks."""
        self.name, self.done, self.total = name, 0, total
        self._tell()

    def advance(self, candidate: Candidate | None) -> None:
        """One task is done."""
        self.done += 1
        if candidate is not None:
            self.evaluations += candidate.evaluations
            if self.best is None or candidate.better_than(self.best):
                self.best = candidate
        self._tell()

    @property
    def out_of_time(self) -> bool:
        """True after the time limit of the search or an interruption."""
        limit = self.assembled.problem.search.time_limit_s
        return self.interrupted or (limit is not None and time.monotonic() - self.begun > limit)

    def _tell(self) -> None:
        if self.listener is None:
            return
        best = self.best
        feasible = best is not None and best.feasible
        target = self.assembled.setup.target
        value = target.report(best.value) if best is not None and feasible and target is not None else None
        elapsed = time.monotonic() - self.begun
        self.listener(Progress(self.name, self.done, self.total, value, feasible, elapsed))


def search_candidates(assembled: Assembled, tracker: _Tracker) -> list[Candidate]:
    """Starts, then hops with successive halving of the lanes; best first. Ends early on Ctrl-C or out of
    time.
    """
    search, setup = assembled.problem.search, assembled.setup
    found: list[Candidate] = []
    try:
        tracker.stage("starts", search.starts)
        tasks = [delayed(begin)(setup, (search.seed, index)) for index in range(search.starts)]
        found += _run(tasks, search.jobs, tracker)
        lanes = _ranked(found)[: search.lanes]
        left, round_ = search.hops, 0
        tracker.stage("hops", search.hops)
        stages = max(1, int(np.ceil(np.log2(max(len(lanes), 1)))) + 1)
        share = search.hops / stages
        while left > 0 and lanes and not tracker.out_of_time:
            batch = [lane for lane in range(len(lanes)) if left - lane * _HOPS_PER_TASK > 0]
            sizes = [min(_HOPS_PER_TASK, left - lane * _HOPS_PER_TASK) for lane in batch]
            tasks = [
                delayed(hop)(setup, lanes[lane], (search.seed, 1000 + round_, lane), size)
                for lane, size in zip(batch, sizes, strict=True)
            ]
            for lane, improved in zip(batch, _run(tasks, search.jobs, tracker, sizes), strict=False):
                lanes[lane] = improved
            found += lanes
            left -= sum(sizes)
            round_ += 1
            stage = int((search.hops - left) / share + 1e-9)
            lanes = _ranked(lanes)[: max(1, search.lanes >> min(stage, 30))]
    except KeyboardInterrupt:
        _log.warning("search interrupted; the best motion so far is kept")
        tracker.interrupted = True
        if tracker.best is not None:
            found.append(tracker.best)
    if not found:
        raise OperatorError("planning was interrupted before any motion was found; start it again")
    return _ranked(found)


def _run(
    tasks: Sequence[Any], jobs: int, tracker: _Tracker, sizes: Sequence[int] | None = None
) -> list[Candidate]:
    """Results in order, reported one by one; stops handing out tasks when time is up."""
    results: list[Candidate] = []
    for index, candidate in enumerate(Parallel(n_jobs=jobs, return_as="generator")(tasks)):
        results.append(candidate)
        if sizes is not None:
            tracker.done += sizes[index] - 1
        tracker.advance(candidate)
    return results


def _ranked(candidates: Sequence[Candidate]) -> list[Candidate]:
    """Best first, without repetitions."""
    unique: list[Candidate] = []
    for candidate in sorted(
        candidates, key=lambda c: (not c.feasible, c.value if c.feasible else c.violation)
    ):
        if all(candidate is not other and not np.array_equal(candidate.x, other.x) for other in unique):
            unique.append(candidate)
    return unique


def _first_that_passes(
    assembled: Assembled, candidates: Sequence[Candidate], interrupted: bool
) -> tuple[ParametricMotion, Check, float]:
    tries = 3 if interrupted else 6
    failures = []
    for candidate in candidates[:tries]:
        outcome = polish(assembled, candidate, quick=interrupted)
        if outcome.check.ok and outcome.bounds_kept:
            return outcome.motion, outcome.check, outcome.value
        failures.append(outcome)
    raise RefusedError(explain(assembled, failures))


def _describe(
    assembled: Assembled, motion: ParametricMotion, check: Check, tracker: _Tracker, value: float
) -> ExcitationPlan:
    problem = assembled.problem
    settings = dataclasses.asdict(problem)
    settings.pop("source")
    provenance = {
        "method": "plan",
        "problem": _plain(settings),
        "arm": assembled.arm_name,
        "evaluations": int(tracker.evaluations),
        "interrupted": bool(tracker.interrupted),
        "versions": {
            name: importlib.metadata.version(name)
            for name in ("lwr-identification", "numpy", "scipy", "numba")
        },
    }
    objectives, rsd = assembled.describe(motion)
    return ExcitationPlan(
        motion=motion,
        joint_names=assembled.setup.mechanism.joint_names,
        periods=problem.motion.periods,
        objectives=objectives,
        rsd_percent=rsd,
        check=check,
        provenance=provenance,
    )


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    if isinstance(value, np.generic):
        return value.item()
    return value
