"""From a problem to a checked plan: early refusal, search, polish, proof. The function behind `lwr-run plan`.

`feasible_fourier` is the quick alternative: a safe motion in a second, without optimisation of a criterion.
"""

from __future__ import annotations

import dataclasses
import importlib.metadata
import json
import logging
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from joblib import Parallel, delayed
from threadpoolctl import threadpool_limits

from fri.errors import ConfigurationError, OperatorError, RefusedError
from ident.excitation.arm_model import ArmEstimate, Mechanism
from ident.excitation.assembly import Assembled, arm_limits, assemble, sampling
from ident.excitation.check import Check, Workspace, check_motion
from ident.excitation.clearance import space_of
from ident.excitation.information import Columns, ConstantBasis
from ident.excitation.motions import Array, FourierBasis, ParametricMotion
from ident.excitation.plan import ExcitationPlan
from ident.excitation.problem import PlanProblem, Search
from ident.excitation.program import Row, Setup
from ident.excitation.search import (
    Candidate,
    Outcome,
    begin,
    hop,
    polish,
    random_start,
    restore,
    shortfall,
    tighten,
)
from ident.excitation.sqp import minimise
from lwr_driver.arm import Arm
from lwr_driver.arm.collision import CollisionChecker

_log = logging.getLogger(__name__)
_HOPS_PER_TASK = 5
_STATIC_STARTS = 12
_STARTS = 12
_ROUNDS = 4
_RESERVE = 3e-3
_NEAR = 5e-3
# Candidates polished at most, until one passes every check.
_TRIES = 6


@dataclass(frozen=True)
class Progress:
    """State of the search: stage, tasks done and planned, best value in reported units, seconds since the start."""

    stage: str
    done: int
    total: int
    best: float | None
    feasible: bool
    elapsed_s: float


def plan(
    problem: PlanProblem | str | Path, progress: Callable[[Progress], None] | None = None
) -> ExcitationPlan:
    """Search for the best motion within every limit, and return it with margins, values and provenance.

    problem : a problem or the path of its file.

    Ctrl-C ends the search; the best motion found so far is polished, checked and returned. A motion outside a limit is
    never returned, and none before one within every limit is found.

    Raises ConfigurationError for a contradictory problem, RefusedError for a problem without a feasible motion (with
    limit and excess), OperatorError for an interruption before the first motion within them.
    """
    if isinstance(problem, (str, Path)):
        problem = PlanProblem.load(problem)
    elif not isinstance(problem, PlanProblem):
        raise ConfigurationError(
            f"`problem` must be of type PlanProblem or the path of a problem file, not {type(problem).__name__} "
            f"{problem!r:.60}; read one with `PlanProblem.load`"
        )
    problem, interrupted = _with_goal(problem, progress)
    assembled = assemble(problem)
    refuse_impossible(assembled)
    tracker = _Tracker(assembled.setup, problem.search, progress, interrupted)
    candidates = search_candidates(assembled.setup, problem.search, tracker)
    tracker.stage("polish", 1)
    try:
        outcome = _first_that_passes(assembled, candidates, tracker.interrupted)
    except RefusedError as error:
        if not tracker.interrupted:
            raise
        raise OperatorError(
            f"interrupted before a motion within every limit was found, so none is kept; plan again and give it more "
            f"time. The best so far: {error}"
        ) from error
    result = _describe(assembled, outcome, tracker)
    tracker.advance(None)
    return result


def _with_goal(problem: PlanProblem, progress: Callable[[Progress], None] | None) -> tuple[PlanProblem, bool]:
    """The problem with a goal for the condition number, and whether its search was interrupted.

    The goal is given or comes from a search for the condition number alone (Remark 4).
    """
    objective = problem.objective
    if objective.criterion != "goal_attainment" or objective.goal_condition is not None:
        return problem, False
    alone = replace(problem, objective=replace(objective, criterion="condition_number"))
    assembled = assemble(alone)
    refuse_impossible(assembled)
    tracker = _Tracker(assembled.setup, alone.search, progress)
    best = search_candidates(assembled.setup, alone.search, tracker)[0]
    if not best.feasible:
        raise RefusedError(explain(assembled, [polish(assembled, best, quick=True)]))
    goal = float(np.exp(best.value))
    _log.info("goal of the condition number from a search for it alone: %.2f", goal)
    return replace(problem, objective=replace(objective, goal_condition=goal)), tracker.interrupted


class _Tracker:
    """Counts tasks, keeps the best value, reports to the listener, and checks the time limit."""

    def __init__(
        self,
        setup: Setup,
        search: Search,
        listener: Callable[[Progress], None] | None,
        interrupted: bool = False,
    ) -> None:
        self.target, self.search = setup.target, search
        self.listener, self.interrupted = listener, interrupted
        self.begun = time.monotonic()
        self.evaluations = 0
        # Best value of each independent search, in reported units, infinite without a feasible motion.
        self.values: list[float] = []
        self.best: Candidate | None = None
        self.name, self.done, self.total = "", 0, 0

    def stage(self, name: str, total: int) -> None:
        """Begin a stage of `total` tasks."""
        self.name, self.done, self.total = name, 0, total
        self._report()

    def advance(self, candidate: Candidate | None, done: int = 1) -> None:
        """Count finished tasks."""
        self.done += done
        if candidate is not None:
            self.evaluations += candidate.evaluations
            if self.best is None or candidate.better_than(self.best):
                self.best = candidate
        self._report()

    @property
    def out_of_time(self) -> bool:
        """True after the time limit of the search or an interruption."""
        limit = self.search.time_limit_s
        return self.interrupted or (limit is not None and time.monotonic() - self.begun > limit)

    def reported(self, candidate: Candidate) -> float | None:
        """Value of a candidate in reported units, None for an infeasible one."""
        return self.target.report(candidate.value) if candidate.feasible and self.target is not None else None

    def _report(self) -> None:
        if self.listener is None:
            return
        best = self.best
        feasible = best is not None and best.feasible
        value = None if best is None else self.reported(best)
        elapsed = time.monotonic() - self.begun
        self.listener(Progress(self.name, self.done, self.total, value, feasible, elapsed))


def search_candidates(setup: Setup, search: Search, tracker: _Tracker) -> list[Candidate]:
    """Candidates of one search or of several independent ones, best first. Ends early on Ctrl-C or out of time."""
    found: list[Candidate] = []
    try:
        for candidates in (
            _single(setup, search, tracker) if search.searches == 1 else _several(setup, search, tracker)
        ):
            found += candidates
    except KeyboardInterrupt:
        kept = "the best motion so far is taken"
        if tracker.best is None or not tracker.best.feasible:
            kept = "no motion within every limit was found yet"
        _log.warning("search interrupted; %s", kept)
        tracker.interrupted = True
        if tracker.best is not None:
            found.append(tracker.best)
    if not found:
        raise OperatorError("planning was interrupted before any motion was found; start it again")
    return _ranked(found)


def _single(setup: Setup, search: Search, tracker: _Tracker) -> Iterator[list[Candidate]]:
    """Starts, then hops with successive halving of the lanes; the candidates of each round."""
    tracker.stage("starts", search.starts)
    tasks = [delayed(begin)(setup, (search.seed, index)) for index in range(search.starts)]
    found = _run(tasks, search.jobs, tracker)
    yield found
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
        yield list(lanes)
        left -= sum(sizes)
        round_ += 1
        stage = int((search.hops - left) / share + 1e-9)
        lanes = _ranked(lanes)[: max(1, search.lanes >> min(stage, 30))]


def _several(setup: Setup, search: Search, tracker: _Tracker) -> Iterator[list[Candidate]]:
    """Independent searches, one a task: none waits for another. Search k is that of seed `seed` + k by itself."""
    tracker.stage("searches", search.searches)
    tasks = [
        delayed(one_search)(setup, replace(search, seed=search.seed + k, searches=1, jobs=1))
        for k in range(search.searches)
    ]
    for candidates, evaluations in Parallel(n_jobs=search.jobs, return_as="generator")(tasks):
        value = tracker.reported(candidates[0])
        tracker.values.append(np.inf if value is None else value)
        tracker.evaluations += evaluations
        tracker.advance(replace(candidates[0], evaluations=0))
        yield candidates


def one_search(setup: Setup, search: Search) -> tuple[list[Candidate], int]:
    """The best candidates of a search, and its evaluations: a task for one process."""
    tracker = _Tracker(setup, search, None)
    return search_candidates(setup, search, tracker)[:_TRIES], tracker.evaluations


def _run(
    tasks: Sequence[Any], jobs: int, tracker: _Tracker, sizes: Sequence[int] | None = None
) -> list[Candidate]:
    results: list[Candidate] = []
    finished = Parallel(n_jobs=jobs, return_as="generator")(tasks)
    for candidate, size in zip(finished, sizes or [1] * len(tasks), strict=True):
        results.append(candidate)
        tracker.advance(candidate, size)
    return results


def _ranked(candidates: Sequence[Candidate]) -> list[Candidate]:
    unique: list[Candidate] = []
    for candidate in sorted(
        candidates, key=lambda c: (not c.feasible, c.value if c.feasible else c.violation)
    ):
        if all(candidate is not other and not np.array_equal(candidate.x, other.x) for other in unique):
            unique.append(candidate)
    return unique


def _first_that_passes(assembled: Assembled, candidates: Sequence[Candidate], interrupted: bool) -> Outcome:
    tries = 3 if interrupted else _TRIES
    failures = []
    for candidate in candidates[:tries]:
        outcome = polish(assembled, candidate, quick=interrupted)
        if outcome.check.ok and outcome.bounds_kept:
            return outcome
        failures.append(outcome)
    raise RefusedError(explain(assembled, failures))


def _describe(assembled: Assembled, outcome: Outcome, tracker: _Tracker) -> ExcitationPlan:
    problem = assembled.problem
    settings = dataclasses.asdict(problem)
    settings.pop("source")
    provenance = {
        "method": "plan",
        "problem": json.loads(json.dumps(settings, default=np.generic.item)),
        "arm": assembled.arm_name,
        "evaluations": int(tracker.evaluations),
        "interrupted": bool(tracker.interrupted),
        "searches": sorted(value for value in tracker.values if np.isfinite(value)),
        "versions": {
            name: importlib.metadata.version(name)
            for name in ("lwr-identification", "numpy", "scipy", "numba")
        },
    }
    objectives, rsd = assembled.describe(outcome.motion)
    return ExcitationPlan(
        motion=outcome.motion,
        joint_names=assembled.setup.mechanism.joint_names,
        periods=problem.motion.periods,
        objectives=objectives,
        rsd_percent=rsd,
        check=outcome.check,
        provenance=provenance,
    )


def refuse_impossible(assembled: Assembled) -> None:
    """Raise at once for problems without a solution.

    Checked: the highest frequency against the arm's lowest resonance (n_f w0 < w_r), workspace bounds against the arm's
    reach, and the existence of a posture within every limit (small motions around it are always feasible).
    """
    basis = assembled.setup.basis
    if isinstance(basis, FourierBasis) and basis.harmonics / basis.period_s >= assembled.resonance_hz:
        raise ConfigurationError(
            f"n_f w0 = {basis.harmonics} / {basis.period_s} s = {basis.harmonics / basis.period_s:.3g} Hz reaches "
            f"the arm's lowest resonance, {assembled.resonance_hz:.3g} Hz; lower `harmonics` or lengthen "
            "`period_s`"
        )
    mechanism, work = assembled.setup.mechanism, assembled.problem.workspace
    lengths = np.linalg.norm(mechanism.translation[1:], axis=1)
    reach = float(lengths.sum() + np.linalg.norm(mechanism.tip))
    for name, bound in (("radius_m", work.radius_m), ("height_m", work.height_m)):
        if bound is not None and bound >= reach:
            raise RefusedError(
                f"workspace: {name} {bound:.3f} m is {bound - reach:.3f} m beyond reach, {reach:.3f} m"
            )
    _refuse_static(assembled)


def _refuse_static(assembled: Assembled) -> None:
    setup = assembled.setup
    basis = ConstantBasis(setup.basis.duration)
    still = replace(setup, basis=basis, target=None, bounds=(), samples=1, refine=1)
    rng = np.random.default_rng(0)
    middle = 0.5 * (setup.limits.q_low + setup.limits.q_high)
    half = 0.5 * (setup.limits.q_high - setup.limits.q_low)
    best, blame = np.inf, ""
    for _ in range(_STATIC_STARTS):
        posture = middle + half * rng.uniform(-0.7, 0.7, size=middle.size)
        program = still.program(feasibility=True)
        program.anchor = posture
        program.constraints.refresh_deviation(program.signals(posture))
        found = restore(still, posture, iterations=60)
        if found.violation < 1e-3:
            return
        if found.violation < best:
            best = found.violation
            program.values(found.x)
            blame = _blame(assembled, program.constraints.rows, program.constraints.latest)
    raise RefusedError(
        f"no posture can be held within the limits: {blame}; widen that limit or lighten the payload"
    )


def _blame(assembled: Assembled, rows: Sequence[Row], values: Array) -> str:
    worst = int(np.argmin(values))
    row = rows[worst]
    setup, excess = assembled.setup, -float(values[worst])
    if row.constraint == "distance":
        name = assembled.row_names[row.index]
        scale = 0.3 if row.index < 2 else 0.1
        return f"{name} falls short by {excess * scale:.3g} m"
    joint = setup.mechanism.joint_names[row.index]
    if row.constraint == "torque":
        limit = setup.limits.tau_max[row.index]
        return f"{joint} torque exceeds {limit:.4g} Nm by {excess * limit:.3g} Nm"
    return f"{joint} {row.constraint} exceeds its limit by {100.0 * excess:.3g} %"


def explain(assembled: Assembled, outcomes: Sequence[Outcome]) -> str:
    """Reasons for the failure of every candidate: the violations of the nearest one."""
    nearest = min(outcomes, key=shortfall)
    reasons = [str(margin) for margin in nearest.check.violations[:3]]
    if not nearest.bounds_kept:
        view = assembled.view(nearest.motion)
        for bound in assembled.setup.bounds:
            if bound.criterion.evaluate(view, np.inf)[0] > bound.limit:
                reasons.append(
                    f"{bound.criterion.name} {bound.criterion.exact(view):.4g} exceeds the bound "
                    f"{bound.criterion.report(bound.limit):.4g}"
                )
    return (
        "no motion within every limit was found; the nearest one: "
        + "; ".join(reasons)
        + "; widen that limit, lengthen `period_s`, or raise `search.starts`"
    )


def feasible_fourier(
    arm: Arm,
    checker: CollisionChecker | None,
    *,
    period_s: float = 20.0,
    harmonics: int = 5,
    periods: int = 1,
    seed: int = 1,
    speed_scale: float = 1.0,
    workspace: Workspace | None = None,
    estimate: ArmEstimate | None = None,
    clearance_m: float = 0.02,
) -> ExcitationPlan:
    """Random Fourier motion of moderate size, shifted as little as possible to pass every check.

    `estimate` defaults to the URDF's inertias without friction. Raises RefusedError after a dozen random starts
    without a passing motion, naming the most frequent obstacle.
    """
    mechanism = Mechanism.from_urdf(arm.urdf)
    space, _ = space_of(mechanism, getattr(checker, "geometry", None))
    work = workspace if workspace is not None else Workspace()
    basis = FourierBasis(period_s, harmonics)
    setup = Setup(
        mechanism=mechanism,
        basis=basis,
        limits=arm_limits(arm, speed_scale),
        space=space,
        floor=space.floor(clearance_m + _RESERVE, (work.radius_m, work.height_m), _RESERVE),
        estimate=estimate if estimate is not None else ArmEstimate.nominal(mechanism),
        columns=Columns.of(mechanism.joints, ()),
        target=None,
        **sampling(basis),
    )
    against = partial(
        check_motion,
        mechanism=mechanism,
        limits=setup.limits,
        workspace=work,
        estimate=setup.estimate,
        checker=checker,
        clearance_m=clearance_m,
    )
    blocked: Counter[str] = Counter()
    for start in range(_STARTS):
        plan, check = _from_start(setup, np.random.default_rng([seed, start]), against)
        if plan is not None:
            _log.info("feasible excitation found from start %d of %d", start + 1, _STARTS)
            provenance = {
                "method": "feasible_fourier",
                "seed": seed,
                "speed_scale": speed_scale,
                "arm": arm.name,
            }
            return ExcitationPlan(plan, arm.joint_names, periods, check=check, provenance=provenance)
        worst = (check.violations or check.tightest())[0]
        blocked[f"{worst.subject} {worst.constraint}"] += 1
    culprit = blocked.most_common(1)[0][0]
    raise RefusedError(
        f"no feasible exciting motion found from {_STARTS} random starts; most frequent obstacle: {culprit}; choose "
        "another `seed`, a longer `period_s`, or a smaller `speed_scale` or `clearance_m`"
    )


def _from_start(
    setup: Setup, rng: np.random.Generator, against: Callable[..., Check]
) -> tuple[ParametricMotion | None, Check]:
    """The motion nearest to one random start, tightened until it passes; None without success."""
    with threadpool_limits(1):
        program = setup.program()
        program.constraints.rate = 200.0
        x = random_start(setup, rng)
        program.anchor = x.copy()
        for _ in range(_ROUNDS):
            program.constraints.refresh_deviation(program.signals(x))
            solution = minimise(program, x, iterations=40, tolerance=1e-6)
            x = solution.x
            near = float(solution.constraints.min()) > -_NEAR
            motion = setup.basis.motion(x.reshape(setup.mechanism.joints, -1))
            step_s, collision_step_s = (1e-3, 1e-2) if near else (0.05, 0.1)
            check = against(motion, step_s=step_s, collision_step_s=collision_step_s, continuous=near)
            if check.ok or not near:
                break
            tighten(program.constraints, check, setup.mechanism.joint_names)
        return (motion if check.ok and near else None), check
