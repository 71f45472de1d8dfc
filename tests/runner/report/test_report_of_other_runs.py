"""The report where a run is not the usual one: from logs alone, without motor torques, aborted."""

from __future__ import annotations

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from click.testing import CliRunner
from playwright.sync_api import Browser

from fri.errors import ConfigurationError
from ident.dynamics.base_set import numeric_base
from ident.dynamics.structure import Coulomb
from ident.model import read_model, write_model
from lwr_driver.session import read_session
from runner.cli import main
from runner.published import is_published_arm
from runner.report.figures import STRONG, correlation_figure, parameter_figure
from runner.report.folder import ResultFolder
from runner.report.latex import save_tables
from runner.report.page import report_html, write_report
from runner.report.verdicts import headline, verdicts
from tests.runner.report.view_rig import NARROW, opened

pytestmark = pytest.mark.slow


def lwr_run(*arguments: str | Path) -> str:
    done = CliRunner().invoke(main, [str(word) for word in arguments])
    assert done.exit_code == 0, done.output
    return done.output


@pytest.fixture(scope="module")
def imported(finished: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Results from a recording with positions and joint torques only, made elsewhere."""
    place = tmp_path_factory.mktemp("imported")
    joint = read_session(finished / "loaded.mcap").joint
    seconds = (joint.publish_time - joint.publish_time[0]) * 1e-9
    np.savez(place / "recording.npz", t=seconds, q=joint.position, tau=joint.effort)
    mapping = {
        "robot": "KUKA LWR4+",
        "joints": ["A1", "A2", "E1", "A3", "A4", "A5", "A6"],
        "urdf": "lwr4plus.urdf",
        "time": {"column": "t", "file": "recording.npz"},
        "position": {"file": "recording.npz", "array": "q", "unit": "rad"},
        "joint_torque": {"file": "recording.npz", "array": "tau", "unit": "Nm"},
    }
    (place / "mapping.yaml").write_text(yaml.safe_dump(mapping))
    lwr_run(
        "import",
        place / "mapping.yaml",
        place / "recording.npz",
        place / "log.mcap",
        "--payload",
        "paper_load",
    )
    options = ["--model", "1", "--test", finished / "check.mcap", "--results", place / "results"]
    lwr_run("identify", place / "log.mcap", *options)
    return place / "results"


def test_logs_alone_have_a_report_without_an_experiment(imported: Path, chrome: Browser) -> None:
    with opened(chrome, imported / "report.html", NARROW) as seen:
        seen.wait_drawn()
        assert seen.errors == []
        assert seen.page.inner_text("h1").startswith("Identification from logs · KUKA LWR4+ · results")
        subjects = seen.page.locator("table.verdicts tbody th").all_inner_texts()
        assert {"torque error (estimate)", "torque error (held-out motion)", "assumptions"} <= set(subjects)
        assert not {"link quality", "tracking error", "truth of the emulated arm"} & set(subjects)
        seen.page.evaluate(
            "document.querySelectorAll('details.part').forEach((part) => { part.open = true; })"
        )
        table = seen.page.inner_text("#table-2")
        assert "no motor torques in the estimate" in table
        assert "no session without the payload" in table
        head = seen.page.locator("#sessions table").first.locator("thead th").all_text_contents()
        assert head == ["session", "for", "ended", "payload", "lasted [s]"]
        titles = seen.page.locator("#torque details:not(.part) > summary").all_inner_texts()
        assert [title.split(":")[0] for title in titles] == [
            "check, joint torque, held out",
            "log, joint torque",
        ]


@pytest.mark.parametrize(
    ("change", "same"),
    [
        ({}, True),
        ({"r": [0.0, 0.0, 0.4, 0.0, 0.39, 0.0, 0.078], "gravity": [0.0, 9.81, 0.0]}, True),
        ({"r": [0.36, 0.0, 0.42, 0.0, 0.4, 0.0, 0.0]}, False),
    ],
)
def test_the_arm_of_the_paper_is_known_by_its_joints(finished: Path, change: dict, same: bool) -> None:
    chain = read_model(finished / "model.yaml").structure.chain
    arrays = {name: np.array(values) for name, values in change.items()}
    assert is_published_arm(replace(chain, **arrays)) == same


def test_another_arm_is_not_compared_with_the_published_tables(
    finished: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    results = ResultFolder.load(finished)
    assert "#table-2" in report_html(results)
    assert "published" in {role for role, _, _ in parameter_figure(results).legend}
    monkeypatch.setitem(vars(results), "published_arm", False)
    text = report_html(results)
    assert "id='parameters'" in text
    assert "Table 1" not in text
    assert "table-2" not in text
    assert "published" not in {role for role, _, _ in parameter_figure(results).legend}
    assert [path.name for path in save_tables(results, tmp_path)] == ["parameters.tex"]


def test_the_summary_of_logs_is_that_of_an_experiment(imported: Path) -> None:
    summary = json.loads((imported / "summary.json").read_text())
    assert summary["model"] == 1
    assert [(s["name"], s["validation"]) for s in summary["sessions"]] == [("log", False), ("check", True)]
    assert summary["validation"][0]["torque_error"]["joint"] < 0.1
    assert ResultFolder.load(imported).sessions["log"].metadata["payload"] == "paper_load"
    levels = {line.subject: line.level for line in verdicts(ResultFolder.load(imported))}
    assert levels["exit status"] == "good"


def test_results_go_into_an_empty_folder_only(imported: Path) -> None:
    done = CliRunner().invoke(main, ["identify", str(imported / "summary.json"), "--results", str(imported)])
    assert done.exit_code == 2
    assert "is not empty" in done.output


def test_a_session_that_was_tested_was_not_fitted(finished: Path) -> None:
    log = str(finished / "loaded.mcap")
    done = CliRunner().invoke(main, ["identify", log, "--model", "1", "--test", log])
    assert done.exit_code == 7
    assert "proves nothing" in done.output
    assert "estimated from 1 session" in done.output


@pytest.mark.parametrize(("status", "reason"), [("abort", "stopped by the operator"), ("fail", "drives off")])
def test_an_unfinished_run_says_so_and_shows_what_there_is(
    finished: Path, tmp_path: Path, status: str, reason: str
) -> None:
    folder = Path(shutil.copytree(finished, tmp_path / "unfinished"))
    summary = json.loads((folder / "summary.json").read_text())
    kept = {key: summary[key] for key in ("schema_version", "experiment", "link", "versions")}
    sessions = summary["sessions"][:2]
    sessions[1] |= {"exit_status": status, "reason": reason}
    kept |= {"exit_status": status, "reason": reason, "sessions": sessions}
    (folder / "summary.json").write_text(json.dumps(kept))
    (folder / "model.yaml").unlink()
    text = write_report(folder).read_text()
    lines = verdicts(ResultFolder.load(folder))
    assert headline(lines) == ("bad", "Not a good run: exit status")
    assert f"{status}: {reason}; sessions finished: unloaded" in lines[0].found
    assert f"lwr-run experiment --resume {folder}" in lines[0].wanted
    assert "(emulated)" in text
    assert "id='sessions'" in text
    assert "id='torque'" not in text


def test_the_friction_of_resting_joints_is_allowed_for(finished: Path, tmp_path: Path) -> None:
    folder = Path(shutil.copytree(finished, tmp_path / "sign"))
    model = read_model(folder / "model.yaml")
    assert model.structure.coulomb.kind == "tanh"
    structure = replace(model.structure, coulomb=Coulomb())
    assert model.base is not None
    base = numeric_base(structure, model.base.conditions)
    write_model(replace(model, structure=structure, base=base), folder / "model.yaml")

    def errors(place: Path) -> tuple[float, float, str]:
        lines = verdicts(ResultFolder.load(place))
        line = next(one for one in lines if one.subject == "torque error (held-out motion)")
        found, wanted = (re.search(r"otor (\S+) %", text) for text in (line.found, line.wanted))
        assert found is not None
        assert wanted is not None
        return float(found[1]), float(wanted[1]), line.level

    (sign, limit, _), (smooth, same, level) = errors(folder), errors(finished)
    # The sign of a noisy speed is the worst law at rest; static friction stays with any law of the motion.
    assert smooth < 0.8 * sign
    assert smooth < same
    assert limit == pytest.approx(same, rel=0.05)
    assert same > 5.5
    assert level == "good"


def test_lost_packets_are_looked_at(finished: Path, tmp_path: Path) -> None:
    folder = Path(shutil.copytree(finished, tmp_path / "lossy"))
    summary = json.loads((folder / "summary.json").read_text())
    summary["link"]["loaded"] |= {"missed": 12, "lost": 7}
    (folder / "summary.json").write_text(json.dumps(summary))
    line = next(one for one in verdicts(ResultFolder.load(folder)) if one.subject == "link quality")
    assert line.level == "look"
    assert line.found.startswith("12 missed, 7 lost")


def test_what_the_deviations_cover_is_told_from_what_they_do_not(finished: Path, tmp_path: Path) -> None:
    folder = Path(shutil.copytree(finished, tmp_path / "assumed"))
    summary = json.loads((folder / "summary.json").read_text())
    for name, check in summary["assumptions"].items():
        check["verdict"] = "VIOLATED" if name in ("serially uncorrelated", "equal variance") else "holds"

    def assumptions(covariance: str) -> tuple[str, str]:
        (folder / "summary.json").write_text(json.dumps(summary | {"covariance": covariance}))
        lines = verdicts(ResultFolder.load(folder))
        line = next(one for one in lines if one.subject == "assumptions")
        return line.level, line.found

    level, found = assumptions(summary["covariance"])
    assert level == "good"
    assert found.endswith("covered by the deviations: serially uncorrelated, equal variance")
    level, found = assumptions("textbook, equation (14)")
    assert level == "look"
    assert found.endswith("violated: serially uncorrelated, equal variance")
    summary["assumptions"]["lack of fit"]["verdict"] = "VIOLATED"
    level, found = assumptions("jackknife")
    assert level == "look"
    assert found.endswith("not covered: lack of fit")


def test_the_correlation_matrix_is_a_figure_too(finished: Path, tmp_path: Path) -> None:
    results = ResultFolder.load(finished)
    figure = correlation_figure(results)
    count = len(figure.names)
    np.testing.assert_allclose(figure.values, figure.values.T)
    np.testing.assert_allclose(np.diag(figure.values), 1.0)
    magnitudes = [abs(value) for _, _, value in figure.strongest(12)]
    assert magnitudes == sorted(magnitudes, reverse=True)
    strong = sum(abs(figure.values[i, j]) > STRONG for i in range(count) for j in range(i))
    assert f"{count} parameters. {strong} pairs" in figure.alt
    (axes,) = figure.plot()
    assert [text.get_text() for text in axes.get_yticklabels()] == list(figure.names)
    np.testing.assert_array_equal(axes.images[0].get_array(), figure.values)
    chart = figure.plotly()
    np.testing.assert_allclose(np.asarray(chart.data[0].z), figure.values, atol=1e-6)
    (tmp_path / "empty").mkdir()
    (tmp_path / "empty" / "summary.json").write_text('{"exit_status": "fail", "sessions": []}')
    with pytest.raises(ConfigurationError, match="no model with a covariance"):
        correlation_figure(tmp_path / "empty")
