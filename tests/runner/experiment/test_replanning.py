"""Plan, estimate, plan again: a second round on the emulator, driven by the runner."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import yaml

from ident.excitation import ExcitationPlan
from ident.excitation.problem import PlanProblem
from ident.model.model_file import read_model
from lwr_driver.arm import Arm
from lwr_driver.arm.cell import Cell
from lwr_driver.configuration import find
from lwr_driver.session import read_session
from runner import replanning
from runner.experiment_file import DEFAULT, Experiment, SessionPlan
from runner.preflight import Item, Preflight
from tests.runner.experiment.experiment_rig import Finished, experiment_file, messages, run

pytestmark = pytest.mark.slow

PROBLEM = {
    "name": "second",
    "motion": {"period_s": 6.0, "harmonics": 3},
    "objective": {"criterion": "mean_rsd"},
    # The first seed whose motion passes the preflight.
    "search": {"starts": 1, "hops": 0, "seed": 4},
}


@pytest.fixture(scope="module")
def twice(tmp_path_factory: pytest.TempPathFactory) -> Finished:
    folder = tmp_path_factory.mktemp("replanning")
    (folder / "second.yaml").write_text(yaml.safe_dump(PROBLEM), encoding="utf-8")
    file = experiment_file(folder, replan={"problem": "second.yaml"})
    done = run("experiment", str(file), "--replan", "1", "--yes", "--out", str(folder / "results"))
    assert done.code == 0, done.text
    return done


def test_the_second_round_is_another_motion_in_logs_of_its_own(twice: Finished) -> None:
    logs = {path.name for path in twice.folder.glob("*.mcap")}
    assert logs == {"unloaded.mcap", "loaded.mcap", "unloaded-round2.mcap", "loaded-round2.mcap"}
    first, second = (read_session(twice.folder / f"loaded{suffix}.mcap") for suffix in ("", "-round2"))
    assert second.metadata["payload"] == first.metadata["payload"] == "paper_load"
    assert second.end is not None
    assert second.end["exit_status"] == "success"
    assert second.start > int(first.joint.log_time[-1])
    plans = [ExcitationPlan.load(twice.folder / name) for name in ("plan.yaml", "round-2.plan.yaml")]
    assert not np.allclose(plans[0].sample(2.0).q, plans[1].sample(2.0).q)


def test_it_is_planned_with_the_first_estimate_its_covariance_noise_and_sessions(twice: Finished) -> None:
    plan = ExcitationPlan.load(twice.folder / "round-2.plan.yaml")
    assert plan.check.ok
    problem = plan.provenance["problem"]
    assert [Path(entry["session"]).name for entry in problem["prior"]] == ["unloaded.mcap", "loaded.mcap"]
    assert Path(problem["knowledge"]["file"]) == (twice.folder / "round-1.known.yaml").resolve()
    before, known = (read_model(twice.folder / f"round-1.{name}.yaml") for name in ("model", "known"))
    assert before.covariance is not None
    assert known.covariance is not None
    # No motion tells errors of the torque channels.
    assert np.all(np.diag(known.covariance) <= np.diag(before.covariance))
    assert np.any(np.diag(known.covariance) < np.diag(before.covariance))
    assert problem["knowledge"]["payload"] == "paper_load"
    # the emulator's torque noise after filtering, far below the published rows' and not a constant
    noise = np.array(problem["knowledge"]["noise_joint"])
    assert noise.shape == (7,)
    assert np.all((noise > 0.0) & (noise < 1.0))
    assert np.ptp(noise) > 0.0
    assert 10 < len(problem["parameters"]) < 102


def test_the_joint_estimate_is_sharper_than_that_of_the_first_round(twice: Finished) -> None:
    before, after = (read_model(twice.folder / name) for name in ("round-1.model.yaml", "model.yaml"))
    assert before.covariance is not None
    assert after.covariance is not None
    spread = {
        name: np.sqrt(value) for name, value in zip(before.names, np.diag(before.covariance), strict=True)
    }
    ratios = [
        np.sqrt(value) / spread[name]
        for name, value in zip(after.names, np.diag(after.covariance), strict=True)
        if name in spread
    ]
    # the same motion once more would give 0.71
    assert np.median(ratios) < 0.7
    summary = json.loads((twice.folder / "summary.json").read_text(encoding="utf-8"))
    assert [entry["name"] for entry in summary["sessions"]][2:] == ["unloaded-round2", "loaded-round2"]
    assert len(summary["prepared"]) == 4


@pytest.mark.long
def test_resume_keeps_a_begun_round_and_repeats_nothing_that_is_finished(twice: Finished) -> None:
    lost = twice.folder / "loaded-round2.mcap"
    kept = {path: messages(path) for path in twice.folder.glob("*.mcap") if path != lost}
    lost.unlink()
    again = run("experiment", "--resume", str(twice.folder), "--yes")
    assert again.code == 0, again.text
    assert lost.is_file()
    for path, before in kept.items():
        assert messages(path) == before


@pytest.mark.parametrize(("fit", "searches"), [(3, [2, 3]), (99, [2, 3, 4, 5])])
def test_a_motion_that_the_preflight_refuses_is_planned_again(
    fit: int, searches: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    seeds, checked = list[int](), list[str]()
    experiment, arm = Experiment.load(DEFAULT), Arm.load()
    refused, passed = (Preflight((Item("clearance of a stop", "", "", ok, ""),)) for ok in (False, True))

    def search(problem: PlanProblem, show: object) -> ExcitationPlan:
        seeds.append(problem.search.seed)
        return ExcitationPlan.load(find("plans/default.plan.yaml"))

    def prepared(experiment: Experiment, arm: Arm, cell: Cell, session: SessionPlan, *rest: object) -> object:
        checked.append("none" if session.payload is None else session.payload.name)
        return None, passed if seeds[-1] == fit else refused

    monkeypatch.setattr(replanning, "plan", search)
    monkeypatch.setattr(replanning, "session_motion", prepared)
    problem, cell = PlanProblem.load(find("plans/replan.yaml")), Cell.load(experiment.cell)
    replanning.planned_to_run(experiment, arm, cell, problem, lambda now: None)
    assert seeds == searches
    # With each payload of the experiment.
    assert set(checked) == {"none", "paper_load"} if fit in seeds else {"none"}
