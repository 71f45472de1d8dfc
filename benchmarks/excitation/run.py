"""Excitation: results of planning, their time and their safety. One command:

    python -m benchmarks.excitation.run                  # everything, about an hour on one core
    python -m benchmarks.excitation.run --section table1 --section gradient
    python -m benchmarks.excitation.run --seeds 3 --budget 10

Budgets are CPU seconds of this process (one BLAS thread, one job). Limits are those of the arm file, with its
position margin. Every motion is checked at exact extrema, on a 1 ms grid, and proven in between,
self-collision and ground included. `urdf speeds`: the same arm with the higher wrist velocities of the
published URDF files.
"""

from __future__ import annotations

import json
import logging
import os
import subprocess
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import click
import numpy as np
from threadpoolctl import threadpool_limits

from benchmarks.excitation.front_plot import front_figure
from fri.errors import LwrError
from ident.excitation import (
    Assembled,
    ExcitationPlan,
    Objective,
    PlanProblem,
    Progress,
    Search,
    assemble,
    check_motion,
    hypervolume,
    not_dominated,
    plan,
    random_points,
    table,
    table_row,
    trade_off,
)
from ident.excitation.check import Limits
from ident.excitation.criteria import Criterion, Pullback, torque_magnitude
from ident.excitation.information import View, samples_view
from ident.excitation.motions import Samples
from ident.excitation.search import begin, random_start
from lwr_driver.arm import Arm

HERE = Path(__file__).resolve().parent
PLOT = HERE.parents[1] / "docs/images/excitation_front.svg"
FAST_ARM = str(HERE / "lwr4plus_urdf_speeds.yaml")
CONDITION = "condition number, essential 49, unscaled"
MANY = 100_000
FIGAROH_PYTHON: str | None = None


class Budget:
    """Ends a search after some CPU seconds, like Ctrl-C, and keeps the course of the best value."""

    def __init__(self, seconds: float) -> None:
        self.seconds, self.begun = seconds, time.process_time()
        self.course: list[tuple[float, float]] = []

    def __call__(self, progress: Progress) -> None:
        spent = time.process_time() - self.begun
        if progress.best is not None:
            self.course.append((spent, progress.best))
        if spent > self.seconds and progress.stage != "polish" and progress.feasible:
            raise KeyboardInterrupt


def base_problem(period_s: float = 20.0, arm: str = "lwr4plus.yaml", **changes: Any) -> PlanProblem:
    """The default problem at full speed, condition number of the essential columns as objective."""
    default = PlanProblem.load("plans/default.yaml")
    settings: dict[str, Any] = {
        "arm": arm,
        "speed_scale": 1.0,
        "motion": replace(default.motion, period_s=period_s, periods=1),
        "objective": Objective(criterion="condition_number"),
        "search": Search(starts=8, hops=MANY),
    }
    return replace(default, **(settings | changes))


def solve(problem: PlanProblem, seed: int, seconds: float) -> tuple[ExcitationPlan, float]:
    """A plan within a CPU budget (the polish at the end comes on top), and its real CPU seconds."""
    begun = time.process_time()
    found = plan(replace(problem, search=replace(problem.search, seed=seed)), Budget(seconds))
    assert found.check.ok
    return found, time.process_time() - begun


def condition(seeds: int, budget: float) -> dict[str, Any]:
    """Condition number of the 49 essential columns: median of several seeds."""
    few = max(1, seeds // 3)
    return _conditions_of(
        [
            ("T0 = 20 s, 49 columns", base_problem(20.0), 27.0, seeds),
            ("T0 = 25 s, 49 columns", base_problem(25.0), 30.0, seeds),
            ("T0 = 20 s, 49 columns, urdf speeds", base_problem(20.0, FAST_ARM), 27.0, few),
        ],
        budget,
    )


def base(seeds: int, budget: float) -> dict[str, Any]:
    """Condition number of all 102 base columns; hops are expensive here, so one lane gets all of them."""
    problem = base_problem(20.0, parameters="base", search=Search(starts=6, hops=MANY, lanes=1))
    return _conditions_of([("T0 = 20 s, 102 columns", problem, 64.0, max(1, seeds // 3))], budget)


def _conditions_of(cases: list[tuple[str, PlanProblem, float, int]], budget: float) -> dict[str, Any]:
    results = {}
    click.echo(f"{'condition number, unscaled, stacked':40s}  best  median  worst   aim  CPU s")
    for label, problem, aim, count in cases:
        found, spent = [], []
        for seed in range(1, count + 1):
            result, seconds = solve(problem, seed, budget - 2.0)
            found.append(next(v for k, v in result.objectives.items() if k.endswith("unscaled")))
            spent.append(seconds)
        results[label] = {"values": found, "cpu_s": spent}
        middle, cost = np.median(found), np.median(spent)
        click.echo(f"{label:40s} {min(found):5.1f} {middle:7.1f} {max(found):6.1f} {aim:5.0f} {cost:6.1f}")
    return results


def table1(seeds: int, budget: float) -> dict[str, Any]:
    """The paper's Table 1 rebuilt, and ours beside it; T0 = 25 s."""
    problem = base_problem(25.0)
    assembled = assemble(problem)
    rows = [
        table_row(f"random points, {name}", assembled, _random(assembled, speed, seed=4))
        for name, speed in (("full speed", 1.0), ("0.55 of it", 0.55))
    ]
    wanted = [
        ("Alg. 1: condition number", Objective(criterion="condition_number")),
        ("Alg. 2: equation (10)", Objective(criterion="goal_attainment", goal_condition=35.0)),
        ("mean RSD, condition <= 35", Objective(criterion="mean_rsd", condition_at_most=35.0)),
        ("mean RSD alone", Objective(criterion="mean_rsd")),
        ("D-optimal", Objective(criterion="d_optimality")),
    ]
    for label, objective in wanted:
        found, _ = solve(replace(problem, objective=objective), 1, budget - 2.0)
        rows.append(table_row(label, assembled, found.motion, found.check))
    click.echo(table(rows, "Table 1 rebuilt (T0 = 25 s; paper: 84.21, 34.01, 37.23)"))
    click.echo("paper, mean torques: random  3.05 45.09  6.78 18.58  2.17  2.28  1.04")
    click.echo("                     Alg. 1  3.12 41.71  9.30 13.24  2.12  1.56  0.92")
    click.echo("                     Alg. 2  4.63 42.26 10.23 14.05  1.56  1.64  1.64")
    return {row.label: {"condition": row.condition, "torque": row.torque.tolist()} for row in rows}


def goal(seeds: int, budget: float) -> dict[str, Any]:
    """Equation (10) with g = 35 and k_tau = 0.9."""
    results = {}
    click.echo(f"{'gamma of equation (10), g = 35, k = 0.9':40s}  best  median  (paper 0.0637)")
    for label, period in (("T0 = 20 s", 20.0), ("T0 = 25 s", 25.0)):
        problem = base_problem(period, objective=Objective(criterion="goal_attainment", goal_condition=35.0))
        values = []
        for seed in range(1, max(2, seeds // 3 + 1)):
            found, _ = solve(problem, seed, budget - 2.0)
            values.append(next(v for k, v in found.objectives.items() if k.startswith("goal attainment")))
        results[label] = values
        click.echo(f"{label:40s} {min(values):.4f} {np.median(values):.4f}")
    return results


def deviation(seeds: int, budget: float) -> dict[str, Any]:
    """Predicted relative deviations at equal data (100 samples a session) and noise."""
    results: dict[str, Any] = {}
    assembled = assemble(base_problem(20.0))
    floor = _floor(assembled)
    lines = []
    for label, speed, ramp in (("fast", 1.0, 0.3), ("medium", 1.0, 1.0), ("slow", 0.6, 1.3)):
        draws = [_random(assembled, speed, seed, ramp) for seed in range(1, 2 + seeds)]
        found = np.array([_deviations(assembled, motion) for motion in draws])
        lines.append((f"random points, {label} (median of {len(draws)})", found))
    usual = "lwr4plus.yaml"
    for label, objective, arm in (
        ("A: condition number", Objective(criterion="condition_number"), usual),
        ("B: equation (10)", Objective(criterion="goal_attainment", goal_condition=35.0), usual),
        ("mean RSD, condition <= 35", Objective(criterion="mean_rsd", condition_at_most=35.0), usual),
        ("mean RSD", Objective(criterion="mean_rsd"), usual),
        ("mean RSD, urdf speeds", Objective(criterion="mean_rsd"), FAST_ARM),
        ("worst RSD", Objective(criterion="worst_rsd"), usual),
    ):
        motion = solve(base_problem(20.0, arm, objective=objective), 1, budget - 2.0)[0].motion
        lines.append((label, _deviations(assembled, motion)[None]))
    click.echo(f"RSD [%], T0 = 20 s: mean, worst | the {np.sum(~floor)} without a floor: mean, worst")
    for label, found in lines:
        free = found[:, ~floor]
        parts = (found.mean(axis=1), found.max(axis=1), free.mean(axis=1), free.max(axis=1))
        figures = [float(np.median(part)) for part in parts]
        results[label] = figures
        click.echo(f"  {label:40s} {figures[0]:6.2f} {figures[1]:6.2f} | {figures[2]:6.2f} {figures[3]:6.2f}")
    return results


@dataclass(frozen=True)
class TorqueLevel(Criterion):
    """-sum of weighted logs of the mean |joint torque| of some joints: raises all of them, the low ones first."""

    joints: tuple[int, ...]
    weights: tuple[float, ...]
    joint_names: tuple[str, ...]

    @property
    def name(self) -> str:
        """Joints and weights."""
        parts = ", ".join(f"{w:g} log {name}" for w, name in zip(self.weights, self.joint_names, strict=True))
        return f"- level of mean |joint torque| ({parts})"

    def evaluate(self, view: View, sharpness: float) -> tuple[float, Pullback]:
        """The weighted sum."""
        value, slopes = 0.0, []
        for joint, weight in zip(self.joints, self.weights, strict=True):
            torque = view.torque[:, joint]
            magnitude = torque_magnitude(torque, sharpness)
            level = float(magnitude.mean())
            value -= weight * float(np.log(level))
            slopes.append((joint, -weight / level * torque / np.maximum(magnitude, 1e-300) / torque.size))

        def pull(scale: float) -> None:
            for joint, slope in slopes:
                view.torque_bar[:, joint] += scale * slope

        return value, pull


def front(seeds: int, budget: float) -> dict[str, Any]:
    """Fronts: condition number against wrist torques (hypervolume) and mean predicted deviation (plot)."""
    results: dict[str, Any] = {}
    assembled = assemble(base_problem(20.0))
    criteria = assembled.criteria
    points = []
    limits = np.log([28.0, 30.0, 32.0, 35.0, 40.0, 46.0, 54.0, 64.0, 75.0]).tolist()
    for weights in ((1.0, 1.0), (1.0, 0.3), (0.3, 1.0)):
        level = TorqueLevel((5, 6), weights, ("A5", "A6"))
        for point in trade_off(assembled, level, criteria.condition, limits, starts=2, hops=8):
            torque = np.mean(np.abs(assembled.view(point.motion).torque), axis=0)
            points.append((point.bounded, -torque[5], -torque[6]))
    values = np.array(points)
    values = values[not_dominated(values)]
    volume = hypervolume(values, np.array([84.21, 0.0, 0.0]))
    results["hypervolume"] = volume
    results["condition, wrist torques"] = (values * [1.0, -1.0, -1.0]).tolist()
    click.echo(f"hypervolume to (84.21; 0; 0), T0 = 20 s: {volume:.0f} (aim 375, the paper's A and B 131)")
    for point in values[np.all(values <= [37.23, -1.64, -1.64], axis=1)]:
        click.echo(f"  dominates (37.23; 1.64; 1.64): ({point[0]:.2f}; {-point[1]:.2f}; {-point[2]:.2f})")
    limits = np.log([28.0, 30.0, 32.0, 35.0, 40.0, 48.0, 60.0, 80.0]).tolist()
    trade = trade_off(assembled, criteria.rsd_mean, criteria.condition, limits, starts=3, hops=10)
    pairs = [(point.bounded, point.minimised) for point in trade]
    results["condition against mean RSD"] = pairs
    front_figure(
        PLOT,
        pairs,
        "condition number, 49 columns",
        "mean predicted RSD [%]",
        "Condition number against predicted deviation, T0 = 20 s",
    )
    click.echo("condition number; mean RSD [%]: " + "  ".join(f"({a:.1f}; {b:.2f})" for a, b in pairs))
    click.echo(f"plot: {PLOT}")
    return results


def robustness(seeds: int, budget: float) -> dict[str, Any]:
    """Share of feasible random starts; plans under random limits, checked on a 1 ms grid."""
    assembled = assemble(base_problem(20.0))
    starts = [begin(assembled.setup, (77, index)) for index in range(20)]
    feasible = sum(start.feasible for start in starts)
    click.echo(f"random starts feasible at the end: {feasible} of 20")
    rng = np.random.default_rng(5)
    violated, planned, refused = 0, 0, 0
    count = 10 * seeds
    for index in range(count):
        problem = base_problem(
            float(rng.uniform(8.0, 30.0)),
            speed_scale=float(rng.uniform(0.3, 1.0)),
            clearance_m=float(rng.uniform(0.01, 0.06)),
            workspace=replace(
                PlanProblem("x").workspace,
                radius_m=float(rng.uniform(0.1, 0.45)),
                height_m=float(rng.uniform(-0.3, 0.1)),
            ),
            objective=Objective(criterion=str(rng.choice(["condition_number", "mean_rsd"]))),  # type: ignore[arg-type]
            search=Search(seed=index, starts=1, hops=0),
        )
        try:
            found = plan(problem)
        except LwrError as error:
            refused += 1
            click.echo(f"  plan {index}: {error}")
            continue
        planned += 1
        violated += not _clean(assemble(problem), found)
    click.echo(
        f"plans under random limits: {planned} of {count} found, {refused} refused, {violated} violate"
    )
    return {"feasible_starts": feasible, "planned": planned, "violations": violated, "refused": refused}


def gradient(seeds: int, budget: float) -> dict[str, Any]:
    """CPU time of one value and gradient at 200 samples, against central differences."""
    results = {}
    with threadpool_limits(1):
        for label, parameters in (("49 columns", None), ("102 columns", "base")):
            problem = base_problem(20.0)
            if parameters is not None:
                problem = replace(problem, parameters=parameters)
            setup = replace(assemble(problem).setup, samples=200, refine=1)
            program = setup.program()
            evaluator, target = program.evaluator, setup.target
            assert target is not None
            x = random_start(setup, np.random.default_rng(1))

            def value_and_gradient(
                at: np.ndarray = x, evaluator: Any = evaluator, target: Any = target
            ) -> float:
                view = evaluator.view(evaluator.signals(at.reshape(7, -1)))
                value, pull = target.evaluate(view, 16.0)
                pull(1.0)
                evaluator.gradient(view)
                return float(value)

            def value_only(at: np.ndarray, evaluator: Any = evaluator, target: Any = target) -> float:
                return float(target.evaluate(evaluator.view(evaluator.signals(at.reshape(7, -1))), 16.0)[0])

            def differences(x: np.ndarray = x, value_only: Any = value_only) -> None:
                for k in range(x.size):
                    step = np.zeros(x.size)
                    step[k] = 1e-6
                    value_only(x + step)
                    value_only(x - step)

            exact, slow = _cpu(value_and_gradient, 300), _cpu(differences, 5)
            results[label] = (exact, slow)
            click.echo(
                f"{label}, 200 samples: value, gradient {1e3 * exact:.2f} ms; differences {1e3 * slow:.0f} ms"
            )
    return results


def figaroh(seeds: int, budget: float) -> dict[str, Any]:
    """FIGAROH's own planner beside ours: 43 rigid base columns, 24 s, the same arm and limits."""
    knowledge = replace(PlanProblem.load("plans/default.yaml").knowledge, payload=None)
    problem = base_problem(
        24.0, FAST_ARM, model=1, sessions=("unloaded",), knowledge=knowledge, parameters="base"
    )
    names = assemble(problem).criteria.condition.assembly.names
    rigid = tuple(name for name in names if not name.startswith(("Ia", "F", "off")))
    problem = replace(problem, parameters=rigid)
    assembled = assemble(problem)
    found, seconds = solve(problem, 1, budget - 2.0)
    results = {"ours": (*_conditions(assembled, assembled.view(found.motion)), seconds)}
    if FIGAROH_PYTHON is not None:
        arm = Arm.load(FAST_ARM)
        for seed in range(max(1, seeds // 10)):
            with tempfile.TemporaryDirectory() as folder:
                output = Path(folder) / "figaroh.npz"
                speeds = ",".join(f"{speed:.6f}" for speed in arm.v_max)
                script, urdf = str(HERE / "figaroh_run.py"), str(arm.urdf_path)
                command = [FIGAROH_PYTHON, script, urdf, str(output), str(seed), speeds]
                environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1"}
                done = subprocess.run(command, capture_output=True, env=environment, check=False)
                if done.returncode != 0:
                    click.echo(f"FIGAROH, seed {seed}: no trajectory")
                    continue
                with np.load(output) as data:
                    q, qd, qdd, spent = data["q"], data["qd"], data["qdd"], float(data["cpu_s"])
            setup = assembled.setup
            view = samples_view(
                Samples(q, qd, qdd, np.zeros_like(q)), setup.mechanism, setup.estimate, setup.columns
            )
            results[f"FIGAROH, seed {seed}"] = (*_conditions(assembled, view), spent)
    else:
        click.echo("FIGAROH: give its interpreter by --figaroh-python to run it too")
    click.echo(f"{'43 rigid columns, 24 s':24s} condition  normalised  CPU s   (aim: 50, 12, 60 s)")
    for label, (plain, normalised, spent) in results.items():
        click.echo(f"{label:24s} {plain:9.1f} {normalised:11.1f} {spent:6.1f}")
    return results


def _conditions(assembled: Assembled, view: Any) -> tuple[float, float]:
    criteria = assembled.criteria
    both = (criteria.condition, criteria.condition_columns)
    plain, normalised = (float(np.exp(criterion.evaluate(view, np.inf)[0])) for criterion in both)
    return plain, normalised


def _random(assembled: Assembled, speed: float, seed: int, ramp_s: float | None = None) -> Any:
    """Random points; `ramp_s` is the time to reach full velocity, None: acceleration 4 rad/s²."""
    limits = assembled.setup.limits
    ramp = np.full(7, 4.0) if ramp_s is None else limits.v_max * speed / ramp_s
    return random_points(
        assembled.setup.mechanism,
        limits,
        seed=seed,
        speed_scale=speed,
        a_max=ramp,
        workspace=assembled.problem.workspace,
        checker=assembled.checker,
        clearance_m=assembled.clearance_m,
    )


def _deviations(assembled: Assembled, motion: Any) -> np.ndarray:
    return assembled.criteria.rsd_mean.deviations(assembled.view(motion))


def _floor(assembled: Assembled) -> np.ndarray:
    """Offsets and Coulomb terms: their signals are constants of magnitude one for any motion."""
    names = assembled.criteria.rsd_mean.assembly.names
    return np.array([name.startswith(("off", "Fc")) for name in names])


def _clean(assembled: Assembled, found: ExcitationPlan) -> bool:
    """Every limit on the 1 ms grid by plain samples, without the exact extrema."""
    times = np.arange(0.0, found.period_s, 1e-3)
    samples = found.motion.sample(times)
    limits: Limits = assembled.setup.limits
    kinematic = (
        np.all(samples.q >= limits.q_low)
        and np.all(samples.q <= limits.q_high)
        and np.all(np.abs(samples.qd) <= limits.v_max)
        and np.all(np.abs(samples.qdd) <= limits.a_max)
        and np.all(np.abs(samples.qddd) <= limits.j_max)
    )
    rest = check_motion(
        found.motion,
        assembled.setup.mechanism,
        limits,
        workspace=assembled.problem.workspace,
        estimate=assembled.setup.estimate,
        checker=assembled.checker,
        clearance_m=assembled.clearance_m,
    )
    return bool(kinematic) and rest.ok


def _cpu(work: Callable[[], Any], repeats: int) -> float:
    work()
    begun = time.process_time()
    for _ in range(repeats):
        work()
    return (time.process_time() - begun) / repeats


SECTIONS: dict[str, Callable[[int, float], dict[str, Any]]] = {
    "gradient": gradient,
    "table1": table1,
    "condition": condition,
    "base": base,
    "goal": goal,
    "deviation": deviation,
    "front": front,
    "robustness": robustness,
    "figaroh": figaroh,
}


@click.command(help=__doc__.splitlines()[0] if __doc__ else "")
@click.option(
    "--section", "sections", multiple=True, type=click.Choice(list(SECTIONS)), help="Default: all of them."
)
@click.option("--seeds", default=10, show_default=True, help="Searches per case.")
@click.option("--budget", default=30.0, show_default=True, help="CPU seconds of a search.")
@click.option("--figaroh-python", help="Interpreter of an environment with figaroh and cyipopt-wheels.")
@click.option(
    "--json",
    "output",
    type=click.Path(path_type=Path),
    help="Write the figures to a file as well; its other sections stay.",
)
def main(
    sections: tuple[str, ...], seeds: int, budget: float, figaroh_python: str | None, output: Path | None
) -> None:
    """Run the sections and print their figures."""
    global FIGAROH_PYTHON
    FIGAROH_PYTHON = figaroh_python
    logging.getLogger("ident").setLevel(logging.ERROR)
    results = {}
    if output is not None and output.exists():
        results = json.loads(output.read_text(encoding="utf-8"))
    for name in sections or tuple(SECTIONS):
        begun = time.process_time()
        click.echo(f"\n== {name} ==")
        results[name] = SECTIONS[name](seeds, budget)
        click.echo(f"({time.process_time() - begun:.0f} CPU s)")
        if output is not None:
            output.write_text(json.dumps(results, indent=1, default=float), encoding="utf-8")


if __name__ == "__main__":
    main()
