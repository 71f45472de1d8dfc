from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import coal
import distributed
import joblib
import numpy as np
import pinocchio as pin
import pytest

from fri.errors import ConfigurationError, OperatorError, RefusedError
from ident.dynamics.base_closed_form import closed_form_base
from ident.dynamics.structure import ModelStructure
from ident.excitation import (
    ExcitationPlan,
    Knowledge,
    MotionForm,
    Objective,
    PlanProblem,
    Prior,
    Progress,
    Search,
    Workspace,
    assemble,
    hypervolume,
    not_dominated,
    plan,
    plan_pieces,
    planner,
    table,
    table_row,
    trade_off,
)
from ident.excitation.arm_model import ArmEstimate, Mechanism, rigid_torque, torque_bounds
from ident.excitation.comparison import random_points
from ident.excitation.motions import Samples
from ident.excitation.plan import spread_text
from ident.excitation.search import judge, polish
from ident.model import DynamicModel
from ident.model.model_file import write_model
from lwr_driver.arm import Arm
from lwr_driver.arm.cell import Box, Cell
from lwr_driver.configuration import CONFIGS
from lwr_driver.listing import text_of
from lwr_driver.session import SessionWriter, session_metadata

CONDITION = "condition number, essential 49, unscaled"


@pytest.fixture(scope="module")
def problem() -> PlanProblem:
    default = PlanProblem.load("plans/default.yaml")
    return replace(
        default,
        objective=Objective(criterion="condition_number"),
        search=Search(seed=3, starts=2, hops=4, lanes=2),
    )


@pytest.fixture(scope="module")
def brief(problem: PlanProblem) -> PlanProblem:
    """The same with a motion of half the length and fewer coefficients, for what any motion shows."""
    return replace(problem, motion=replace(problem.motion, period_s=10.0, harmonics=3))


@pytest.fixture(scope="module")
def solved(problem: PlanProblem) -> ExcitationPlan:
    return plan(problem)


def test_plan_is_good_and_keeps_every_limit_by_an_independent_check(
    arm: Arm, problem: PlanProblem, solved: ExcitationPlan
) -> None:
    """Pinocchio, coal and plain differences; nothing of the planner but the samples."""
    assert solved.objectives[CONDITION] < 50.0
    assert all(margin.ok and margin.proven for margin in solved.check.margins)
    t = np.arange(0.0, 20.0, 1e-3)
    q = solved.sample(t).q
    qd, qdd = (np.gradient(part, 1e-3, axis=0, edge_order=2) for part in (q, solved.sample(t).qd))
    assert np.all((q >= arm.q_low) & (q <= arm.q_high))
    assert np.all(np.abs(qd) <= 0.95 * arm.v_max + 1e-5)
    assert np.all(np.abs(qdd) <= arm.a_max)
    model = pin.buildModelFromXML(arm.urdf)
    data = model.createData()
    geometry = pin.buildGeomFromUrdfString(model, arm.urdf, pin.GeometryType.COLLISION)
    ground = pin.GeometryObject(
        "ground", 0, pin.SE3.Identity(), coal.Halfspace(np.array([0.0, 0.0, 1.0]), 0.0)
    )
    index = geometry.addGeometryObject(ground)
    for first, a in enumerate(geometry.geometryObjects):
        for second, b in enumerate(geometry.geometryObjects):
            far = b.parentJoint - a.parentJoint >= 3 and index not in (first, second)
            if far or (second == index and a.parentJoint >= 2):
                geometry.addCollisionPair(pin.CollisionPair(first, second))
    found = geometry.createData()
    flange = model.getFrameId("flange")
    for posture in q[::20]:
        pin.framesForwardKinematics(model, data, posture)
        x, y, z = data.oMf[flange].translation
        assert np.hypot(x, y) >= 0.3
        assert z - 0.3105 >= -0.2
        nearest = pin.computeDistances(model, data, geometry, found, posture)
        assert found.distanceResults[nearest].min_distance >= 0.02


@pytest.mark.long
def test_seed_and_counts_decide_not_the_number_of_processes(
    problem: PlanProblem, solved: ExcitationPlan
) -> None:
    again = plan(replace(problem, search=replace(problem.search, jobs=2)))
    np.testing.assert_array_equal(again.sample(3.3).q, solved.sample(3.3).q)


def test_the_search_runs_on_a_dask_cluster(brief: PlanProblem) -> None:
    small = replace(brief, search=Search(seed=3, starts=2, hops=0, jobs=-1))
    alone = plan(replace(small, search=replace(small.search, jobs=1)))
    with (
        distributed.Client(n_workers=1, threads_per_worker=1, processes=False, dashboard_address=None),
        joblib.parallel_config(backend="dask"),
    ):
        spread = plan(small)
    np.testing.assert_array_equal(spread.sample(3.3).q, alone.sample(3.3).q)


@pytest.mark.slow
def test_independent_searches_are_those_of_their_seeds_and_the_best_one_counts(brief: PlanProblem) -> None:
    few = Search(seed=3, starts=1, hops=0)
    alone = [plan(replace(brief, search=replace(few, seed=seed))) for seed in (3, 4)]
    heard: list[Progress] = []
    together = [
        plan(replace(brief, search=replace(few, searches=2, jobs=jobs)), heard.append) for jobs in (1, 2)
    ]
    best = min(alone, key=lambda one: one.objectives[CONDITION])
    for found in together:
        np.testing.assert_array_equal(found.sample(3.3).q, best.sample(3.3).q)
        values = found.provenance["searches"]
        assert values == sorted(values)
        assert len(values) == 2
        assert values[0] == pytest.approx(best.objectives[CONDITION], rel=0.05)
        assert spread_text(values) in text_of(plan_pieces(found))
    assert [event.stage for event in heard if event.done == 0] == 2 * ["searches", "polish"]
    assert "independent" not in text_of(plan_pieces(best))


def test_the_spread_of_searches_says_whether_another_confirms_the_best() -> None:
    assert spread_text([25.0, 25.2, 27.0, 30.0]) == (
        "4 independent searches: best 25, median 26.1, worst 30; 2 within 1 % of the best"
    )
    assert spread_text([25.0, 25.3]).endswith(
        "1 within 1 % of the best: no other confirms the best one, more may find a better motion"
    )


def test_progress_counts_up_and_only_improves(brief: PlanProblem) -> None:
    heard: list[Progress] = []
    plan(replace(brief, search=Search(seed=3, starts=2, hops=2, lanes=1)), heard.append)
    assert [event.stage for event in heard if event.done == 0] == ["starts", "hops", "polish"]
    best = [event.best for event in heard if event.best is not None]
    assert best == sorted(best, reverse=True)
    assert heard[-1].done == heard[-1].total == 1


def test_interruption_returns_the_best_so_far_and_says_so(brief: PlanProblem) -> None:
    def interrupt(event: Progress) -> None:
        if event.stage == "starts" and event.done == 1:
            raise KeyboardInterrupt

    found = plan(brief, interrupt)
    assert found.check.ok
    assert found.provenance["interrupted"] is True

    def at_once(event: Progress) -> None:
        raise KeyboardInterrupt

    with pytest.raises(OperatorError, match="before any motion was found"):
        plan(brief, at_once)


def test_interruption_before_a_motion_within_the_limits_keeps_none_and_says_so(
    brief: PlanProblem, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: Any) -> Any:
        raise RefusedError("A4 is outside")

    def interrupt(event: Progress) -> None:
        if event.done == 1:
            raise KeyboardInterrupt

    monkeypatch.setattr(planner, "_first_that_passes", refuse)
    with pytest.raises(OperatorError, match=r"none is kept; plan again.*A4 is outside"):
        plan(brief, interrupt)


def test_a_quick_polish_still_ends_inside_every_limit(problem: PlanProblem, solved: ExcitationPlan) -> None:
    """What an interruption leaves may be some way outside; the nearest motion inside is handed out."""
    assembled = assemble(problem)
    setup = assembled.setup
    times = np.linspace(0.0, setup.basis.duration, 400, endpoint=False)
    x = np.linalg.lstsq(setup.basis.matrix(times), solved.sample(times).q, rcond=None)[0].T.ravel()
    outside = judge(setup, 1.06 * x)
    assert outside.violation > 0.03
    outcome = polish(assembled, outside, quick=True)
    assert outcome.check.ok, outcome.check.violations


@pytest.mark.slow
def test_bounds_on_other_criteria_are_kept(
    problem: PlanProblem, brief: PlanProblem, solved: ExcitationPlan
) -> None:
    mean = "mean predicted relative deviation, essential 49 [%]"
    objective = Objective(criterion="mean_rsd", condition_at_most=45.0)
    bounded = plan(replace(problem, objective=objective, search=Search(starts=1, hops=0)))
    assert bounded.objectives[CONDITION] <= 45.0 * (1 + 1e-9)
    assert bounded.objectives[mean] < solved.objectives[mean]
    with pytest.raises(RefusedError, match=r"condition number.*exceeds the bound 10"):
        plan(
            replace(
                brief,
                objective=Objective(criterion="mean_rsd", condition_at_most=10.0),
                search=Search(starts=1, hops=0),
            )
        )


@pytest.mark.slow
def test_goal_attainment_meets_its_goals_together_and_finds_the_one_not_given(
    problem: PlanProblem, brief: PlanProblem
) -> None:
    few = Search(seed=1, starts=3, hops=6, lanes=1)
    wanted = Objective(criterion="goal_attainment", goal_condition=35.0)
    found = plan(replace(problem, objective=wanted, search=few))
    (gamma,) = (value for name, value in found.objectives.items() if name.startswith("goal attainment"))
    # the paper's solution: 37.23 with the goal 35, and mean wrist torques of 1.64 Nm
    assert gamma < 0.08
    assert found.objectives[CONDITION] <= 35.0 * (1.0 + gamma) * (1.0 + 1e-9)
    for joint in ("A5", "A6"):
        assert (
            38.0 - found.objectives[f"mean |joint torque| {joint} [Nm]"] <= 0.9 * 38.0 * (1.0 + gamma) + 1e-9
        )
    alone = plan(
        replace(brief, objective=Objective(criterion="goal_attainment"), search=Search(starts=1, hops=0))
    )
    (name,) = (name for name in alone.objectives if name.startswith("goal attainment"))
    assert f"{CONDITION} -> " in name
    goal = float(name.split(f"{CONDITION} -> ")[1].split(";")[0])
    assert 25.0 < goal < 50.0


def test_a_spline_plan_keeps_every_limit(problem: PlanProblem) -> None:
    spline = replace(
        problem, motion=MotionForm(type="bspline", control_points=8), search=Search(starts=1, hops=0)
    )
    assert plan(spline).check.ok


def test_a_motion_run_before_makes_the_next_one_complement_it(
    problem: PlanProblem, solved: ExcitationPlan, tmp_path: Path
) -> None:
    follow = assemble(replace(problem, prior=(Prior(plan=str(_saved(solved, tmp_path))),)))
    alone = assemble(problem)
    view = alone.view(solved.motion)
    single = alone.criteria.rsd_mean.deviations(view)
    double = follow.criteria.rsd_mean.deviations(follow.view(solved.motion))
    # the prior ran the same motion for the same time: the same information once more
    np.testing.assert_allclose(double, single / np.sqrt(2.0), rtol=1e-6)


def test_a_recorded_session_counts_as_much_as_the_motion_it_recorded(
    problem: PlanProblem, solved: ExcitationPlan, tmp_path: Path
) -> None:
    path, times = tmp_path / "unloaded.mcap", np.arange(0.0, 40.0, 0.004)
    metadata = session_metadata(robot="KUKA LWR4+")
    with SessionWriter(path, solved.joint_names, metadata) as writer:
        position = solved.sample(times).q
        stamps = np.rint(times * 1e9).astype(np.int64) + 10**18
        writer.write_joint_states(stamps, position, np.ones_like(position))
    recorded = assemble(replace(problem, prior=(Prior(session=str(path)),)))
    whole = replace(problem, prior=(Prior(plan=str(_saved(solved, tmp_path)), sessions=("unloaded",)),))
    planned = assemble(whole)
    for criteria in ("condition", "rsd_mean"):
        found, expected = (getattr(a.criteria, criteria).prior for a in (recorded, planned))
        # two periods less the ends that filtering drops
        np.testing.assert_allclose(np.diag(found), np.diag(expected), rtol=0.12, atol=0.05 * np.max(expected))


def _saved(plan_: ExcitationPlan, folder: Path) -> Path:
    path = folder / "before.plan.yaml"
    plan_.save(path)
    return path


def test_an_identified_model_is_the_knowledge_of_the_next_plan(
    problem: PlanProblem, mechanism: Mechanism, estimate: ArmEstimate, tmp_path: Path
) -> None:
    structure = ModelStructure(mechanism.chain, 2, payloads=("weight",))
    base = closed_form_base(structure)
    standard = np.zeros(structure.n_columns)
    for column, name in enumerate(structure.names):
        if not (name.endswith("8") and name[0] in "IFo"):
            standard[column] = estimate.value(name)
    values = base.reduce(standard)
    covariance = np.diag((0.01 + 0.05 * np.abs(values)) ** 2)
    model = DynamicModel("KUKA LWR4+", structure, base.names, values, covariance, base)
    write_model(model, tmp_path / "model.yaml")
    knowledge = Knowledge(file=str(tmp_path / "model.yaml"), payload="weight")
    assembled = assemble(replace(problem, knowledge=knowledge, parameters="model"))
    np.testing.assert_allclose(dict(zip(base.names, values, strict=True))["MY2R"], 3.46, atol=0.005)
    assert {"ZZ1", "XX2", "Ia3", "M8"} <= set(assembled.setup.estimate.covariance_names)
    samples = Samples(*(0.5 * np.random.default_rng(1).normal(size=(20, 7)) for _ in range(4)))
    for found, true in zip(
        rigid_torque(mechanism, samples, assembled.setup.estimate.loads),
        rigid_torque(mechanism, samples, estimate.loads),
        strict=True,
    ):
        np.testing.assert_allclose(found, true, atol=1e-9)
    wide = torque_bounds(mechanism, samples, assembled.setup.estimate)
    narrow = torque_bounds(mechanism, samples, estimate)
    assert np.all(wide.motor > narrow.motor)


@pytest.mark.parametrize(
    ("changes", "error", "message"),
    [
        ({"motion": MotionForm(period_s=0.5)}, ConfigurationError, r"n_f w0 = 5 / 0\.5 s = 10 Hz reaches"),
        ({"workspace": Workspace(radius_m=1.2)}, RefusedError, r"radius_m 1\.200 m is 0\.332 m beyond reach"),
        (
            {"workspace": Workspace(radius_m=0.8, height_m=0.8)},
            RefusedError,
            "no posture can be held.*falls short by",
        ),
        ({"clearance_m": 0.4}, RefusedError, "no posture can be held.*falls short by"),
    ],
)
def test_impossible_problems_are_refused_at_once_with_limit_and_amount(
    problem: PlanProblem, changes: dict, error: type[Exception], message: str
) -> None:
    with pytest.raises(error, match=message):
        plan(replace(problem, **changes))


def test_a_payload_too_heavy_to_hold_is_refused_with_joint_and_torque(
    problem: PlanProblem, tmp_path: Path
) -> None:
    heavy = tmp_path / "heavy.yaml"
    text = (CONFIGS / "emulator/table2.yaml").read_text(encoding="utf-8")
    heavy.write_text(text.replace("M: 3.34", "M: 60.0"), encoding="utf-8")
    with pytest.raises(RefusedError, match=r"A\d torque exceeds|E1 torque exceeds"):
        plan(replace(problem, knowledge=Knowledge(file=str(heavy)), workspace=Workspace(radius_m=0.6)))


def test_obstacles_of_the_cell_are_avoided(brief: PlanProblem, tmp_path: Path) -> None:
    cell = tmp_path / "cell.yaml"
    cell.write_text(
        "schema_version: 1\nname: tight\nboxes:\n"
        "  - {name: cabinet, size_m: [0.4, 2.0, 1.0], centre_m: [0.75, 0.0, 0.5]}\n"
    )
    found = plan(replace(brief, cell=str(cell), search=Search(seed=5, starts=2, hops=0)))
    cabinet = Box("cabinet", (0.4, 2.0, 1.0), (0.75, 0.0, 0.5))
    assert Cell.load(str(cell)).boxes == (cabinet,)
    assert found.check.ok


def test_problem_file_is_strict(tmp_path: Path) -> None:
    path = tmp_path / "problem.yaml"
    path.write_text("name: x\nobjective: {criterion: condition_numbr}\n")
    with pytest.raises(ConfigurationError, match="condition_numbr"):
        PlanProblem.load(path)
    path.write_text("name: x\nhopps: 3\n")
    with pytest.raises(ConfigurationError, match="unknown key `hopps`"):
        PlanProblem.load(path)
    path.write_text("name: x\nparameters: [ZZ9]\n")
    with pytest.raises(ConfigurationError, match="ZZ9"):
        assemble(PlanProblem.load(path))


def test_default_parameters_are_the_102_base_parameters(problem: PlanProblem) -> None:
    assembled = assemble(replace(problem, parameters="base"))
    assert len(assembled.criteria.condition.assembly.names) == 102
    values = dict(
        zip(assembled.criteria.rsd_mean.assembly.names, assembled.criteria.rsd_mean.values, strict=True)
    )
    # Table 2 of the paper, to its two digits
    for name, published in {"MY2R": 3.46, "XX2R": 1.36, "ZZ4R": 0.45, "MY4R": 1.37, "M8": 3.34}.items():
        assert values[name] == pytest.approx(published, abs=0.005)


def test_table_and_report_name_what_they_show(problem: PlanProblem, solved: ExcitationPlan) -> None:
    assembled = assemble(problem)
    setup = assembled.setup
    random = random_points(setup.mechanism, setup.limits, count=4, workspace=problem.workspace)
    rows = [
        table_row("random", assembled, random),
        table_row("planned", assembled, solved.motion, solved.check),
    ]
    text = table(rows, "Table 1")
    assert text.splitlines()[0] == "Table 1"
    assert "planned" in text
    assert f"{solved.objectives[CONDITION]:.2f}" in text
    assert rows[1].condition < rows[0].condition
    report = text_of(plan_pieces(solved))
    assert CONDITION in report
    assert "tightest margins" in report


@pytest.mark.slow
def test_trade_off_gives_motions_within_their_bounds(brief: PlanProblem) -> None:
    assembled = assemble(brief)
    criteria = assembled.criteria
    limits = [np.log(45.0), np.log(60.0)]
    points = trade_off(assembled, criteria.rsd_mean, criteria.condition, limits, starts=1, hops=0)
    assert len(points) == 2
    for point in points:
        assert point.bounded <= point.limit * (1 + 1e-9)
        assert assembled.check(point.motion).ok
    assert points[0].minimised >= points[1].minimised - 0.05, "a looser bound is no worse"


def test_hypervolume_of_boxes() -> None:
    assert hypervolume(np.array([[1.0, 2.0]]), np.array([3.0, 4.0])) == pytest.approx(4.0)
    two = np.array([[0.0, 2.0], [2.0, 0.0]])
    assert hypervolume(two, np.array([3.0, 3.0])) == pytest.approx(3.0 + 3.0 - 1.0)
    # the paper's two trajectories with the random one as reference
    paper = np.array([[34.01, -1.56, -0.92], [37.23, -1.64, -1.64]])
    assert hypervolume(paper, np.array([84.21, 0.0, 0.0])) == pytest.approx(131.0, abs=1.0)
    np.testing.assert_array_equal(not_dominated(np.array([[1, 2], [2, 1], [2, 2]])), [True, True, False])


@pytest.mark.long
def test_planning_the_default_problem_gives_the_stored_plan() -> None:
    stored = ExcitationPlan.load(CONFIGS / "plans/default.plan.yaml")
    found = plan(PlanProblem.load("plans/default.yaml"))
    # rounding differs between processors, and the search carries it on; the quality must not differ
    for name, value in stored.objectives.items():
        if "deviation" in name or name == CONDITION:
            assert found.objectives[name] == pytest.approx(value, rel=0.03)


def test_the_stored_default_plan_solves_the_default_problem() -> None:
    assembled = assemble(PlanProblem.load("plans/default.yaml"))
    stored = ExcitationPlan.load(CONFIGS / "plans/default.plan.yaml")
    check = assembled.check(stored.motion)
    assert check.ok, check
    assert all(margin.proven for margin in check.margins)
    values, deviations = assembled.describe(stored.motion)
    assert values[CONDITION] <= 35.0
    assert values == pytest.approx(dict(stored.objectives), rel=1e-6)
    assert deviations == pytest.approx(dict(stored.rsd_percent), rel=1e-6)


@pytest.mark.parametrize("name", ["algorithm_1", "algorithm_2", "random_points"])
def test_the_rebuilt_published_motions_keep_every_limit_and_their_figures(name: str) -> None:
    folder = CONFIGS / "plans/published"
    problem = folder / f"{'algorithm_1' if name == 'random_points' else name}.yaml"
    assembled = assemble(PlanProblem.load(problem))
    stored = ExcitationPlan.load(folder / f"{name}.plan.yaml")
    assert assembled.check(stored.motion).ok
    values, deviations = assembled.describe(stored.motion)
    assert values == pytest.approx(dict(stored.objectives), rel=1e-6)
    assert deviations == pytest.approx(dict(stored.rsd_percent), rel=1e-6)
