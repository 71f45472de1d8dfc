"""The report and the preview of a run, as a browser shows them."""

from __future__ import annotations

import io
import json
import re
import shutil
import signal
import socket
import subprocess
import sys
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner
from PIL import Image
from playwright.sync_api import Browser, Page

from ident.diagnosis.outcome.statements import error_change
from ident.excitation import ExcitationPlan, PlanProblem, assemble, table_row
from lwr_driver.configuration import find
from lwr_driver.session import Session
from runner.cli import main
from runner.published import TABLE_1, TABLE_2, rebuilt
from runner.report.figures import torque_figure
from runner.report.folder import ResultFolder
from runner.report.latex import table_1
from runner.report.markup import MOST_PERCENT
from runner.report.page import write_report
from runner.report.tables import better_than_published
from runner.report.verdicts import headline, verdicts
from runner.scene import start_server, stop_server
from tests.runner.report.view_rig import CLIPPED, CONTRAST, NARROW, WIDE, Seen, flaws, opened

pytestmark = pytest.mark.slow

DIAGNOSIS: dict[str, Any] = {
    "schema_version": 1,
    "findings": [
        {
            "cause": "stribeck",
            "side": "motor",
            "joints": [2],
            "parameters": {"amplitude": {"value": 1.9, "std": 0.2, "unit": "Nm"}},
            "evidence": {
                "delta_bic": -412.0,
                "p_value": 1e-9,
                "test_rms_before": 0.61,
                "test_rms_after": 0.34,
                "gain_interval_95": [0.22, 0.31],
            },
            "confidence": 0.97,
            "alternatives": [{"cause": "presliding_hysteresis", "delta_bic": -102.0}],
            "tell_apart": "a slow sweep of <joint 2>",
        }
    ],
    "unexplained": [
        {"side": "joint", "joint": 5, "depends_on": ["q5"], "test_rms": 0.2, "noise_floor": 0.03}
    ],
    "gain": {
        "test_rms_base": {"motor": [0.5, 0.8, 0.5, 0.5, 0.5, 0.5, 0.5]},
        "test_rms_extended": {"motor": [0.5, 0.4, 0.5, 0.5, 0.5, 0.5, 0.5]},
    },
}


@pytest.fixture(scope="module")
def report(finished: Path, chrome: Browser) -> Iterator[Seen]:
    """The report in a wide window, every visible chart drawn; `scrolled` is how far it was scrolled until then."""
    with opened(chrome, finished / "report.html") as seen:
        seen.wait_drawn()
        seen.page.evaluate("window.scrolled = window.scrollY")
        yield seen


def copy(finished: Path, target: Path) -> Path:
    return Path(shutil.copytree(finished, target))


def test_the_report_opens_without_errors_and_without_a_network(report: Seen) -> None:
    assert report.page.title().startswith("short: ")
    assert report.errors == []
    assert report.external == []


def test_the_first_screen_says_whether_the_run_was_good(report: Seen) -> None:
    page = report.page
    assert "run" in page.inner_text("p.verdict")
    rows = page.locator("table.verdicts tbody tr")
    subjects = rows.locator("th").all_inner_texts()
    assert subjects[:4] == ["exit status", "link quality", "limits", "tracking error"]
    assert {"assumptions", "essential parameters", "payload mass"} <= set(subjects)
    box = page.locator("table.verdicts").bounding_box()
    assert box is not None
    assert box["y"] + box["height"] <= WIDE[1]


def test_every_number_of_the_tables_is_that_of_the_summary(finished: Path, report: Seen) -> None:
    summary = json.loads((finished / "summary.json").read_text())
    cells = report.page.evaluate(
        "[...document.querySelectorAll('data[data-key]')].map(d => [d.dataset.key, d.value, d.textContent])"
    )
    assert len(cells) > 500
    for key, value, text in cells:
        expected = looked_up(summary, key)
        assert float(value) == expected, key
        if text == f"> {MOST_PERCENT:g}":
            assert expected > MOST_PERCENT, key
            continue
        shown = float(text.replace("\N{MINUS SIGN}", "-"))
        assert shown == pytest.approx(expected, rel=6e-3, abs=6e-3), key
    keys = {key for key, _, _ in cells}
    assert {f"parameters.{k}.estimate" for k in range(len(summary["parameters"]))} <= keys
    assert "excitation.condition.paper" in keys


def test_the_torque_error_has_one_value_in_terminal_page_and_json(finished: Path, report: Seen) -> None:
    summary = json.loads((finished / "summary.json").read_text())
    said = (finished / "report.txt").read_text()
    page = report.page
    first = " ".join(page.locator("table.verdicts tr", has_text="torque error").all_inner_texts())
    titles = page.locator("#torque details > summary").all_inner_texts()
    notes = page.locator("#torque figcaption").all_text_contents()
    rows = page.locator("#torque tbody tr").all_text_contents()
    assert len(summary["validation"]) == 1
    assert len(summary["fit"]) == 2
    for score in (*summary["fit"], *summary["validation"]):
        by_side = ", ".join(f"{side} {100 * value:.2f} %" for side, value in score["torque_error"].items())
        assert f"torque error of {score['session']}, " in said
        assert by_side in said
        name = score["session"].removesuffix(".mcap")
        for side, value in score["torque_error"].items():
            assert f"{100 * value:.2f} %" in first
            label = f"{name}, {side} torque{'' if score['seen'] else ', held out'}"
            assert f"{label}: torque error of all joints {100 * value:.2f} %" in titles
        for one in score["scores"]:
            value = f"{100 * one['torque_error']:.2f}"
            assert any(note.startswith(f"{one['joint']} torque error {value} %") for note in notes)
            assert any(row.startswith(f"{one['joint']}{value}{one['rms']:.3f}") for row in rows)
    done = CliRunner().invoke(
        main, ["validate", str(finished / "model.yaml"), str(finished / "check.mcap"), "--json"]
    )
    assert done.exit_code == 0, done.output
    again = json.loads(done.output)["sessions"][0]
    for key in ("torque_error", "moving_torque_error", "standstill", "standstill_error"):
        assert again[key] == pytest.approx(summary["validation"][0][key], rel=1e-9)
    # No other share of the torque on the page goes by that name.
    text = page.inner_text("body")
    assert "unexplained" not in text
    assert "relative error" not in text


def test_the_page_says_where_emulator_and_paper_agree_by_construction(report: Seen) -> None:
    second = report.page.inner_text("#table-2")
    assert "Agreement by construction: the emulated arm was built from this table" in second
    assert "49 of its 49 true values" in second
    assert "Agreement by construction" in report.page.inner_text("#table-1")


def looked_up(content: Any, key: str) -> float:
    """The entry of nested content under a dotted key; file names have dots of their own."""
    while key:
        head = next(
            part
            for part in (key.rsplit(".", n)[0] for n in range(key.count(".") + 1))
            if (isinstance(content, dict) and part in content) or part.isdigit()
        )
        content = content[int(head)] if isinstance(content, list) else content[head]
        key = key[len(head) + 1 :]
    return float(content)


def test_the_published_tables_stand_beside_the_run(report: Seen) -> None:
    first = report.page.inner_text("#table-1")
    for entry in TABLE_1:
        assert f"{entry.condition:.2f}" in first
    second = report.page.inner_text("#table-2")
    assert len(TABLE_2) == 49
    assert all(entry.name in second for entry in TABLE_2)


def test_table_1_says_what_the_plan_was_made_for(finished: Path, report: Seen) -> None:
    rows = report.page.locator("#table-1 tbody tr")
    cells = {row.locator("th").inner_text(): row.locator("td").all_inner_texts() for row in rows.all()}
    plan = ExcitationPlan.load(finished / "plan.yaml")
    assembled = assemble(PlanProblem.load("plans/default.yaml"))
    values = table_row("", assembled, plan.motion, plan.check)
    expected = [values.condition, values.rsd_mean, values.rsd_worst, *values.torque]
    assert cells["Plan of this run"][1:] == [f"{value:.2f}" for value in expected]
    for one in TABLE_1:
        assert cells[one.name][2:4] == ["–", "–"]
        motion = rebuilt(one.name)
        wanted = [motion.condition, motion.mean_rsd, motion.worst_rsd]
        assert cells[f"{one.name}, rebuilt"][1:4] == [f"{value:.2f}" for value in wanted]
    text = report.page.inner_text("#table-1")
    assert "Beside the three rebuilt motions the plan of this run" in text
    assert "RSD of the published estimate (Table 2): mean 3.00 %, worst 12.70 %" in text
    latex = table_1(finished)
    assert f"Plan of this run & yes & {expected[0]:.2f} & {expected[1]:.2f} & {expected[2]:.2f} &" in latex


def test_the_default_plan_is_better_where_it_was_meant_to_be(tmp_path: Path) -> None:
    shutil.copy(find("plans/default.plan.yaml"), tmp_path / "plan.yaml")
    text = better_than_published(ResultFolder(tmp_path, {}))
    assert "made for the mean RSD, is better in mean RSD (2.76;" in text
    assert "and worst RSD (8.84;" in text
    assert "not the best in condition number (34.30;" in text


def test_a_motion_that_the_estimate_has_not_seen_stands_first_in_figure_3(
    finished: Path, report: Seen
) -> None:
    summary = json.loads((finished / "summary.json").read_text())
    assert [entry["name"] for entry in summary["prepared"]] == ["unloaded.mcap", "loaded.mcap"]
    reasons = summary["signals"]["reasons"]
    assert reasons
    assert all(report.page.get_by_text(one).count() == 1 for one in reasons)
    assert [(score["session"], score["seen"]) for score in summary["validation"]] == [("check.mcap", False)]
    titles = report.page.locator("#torque details > summary").all_inner_texts()
    assert titles[0].startswith("check, joint torque, held out: ")
    shown = f"{100 * summary['validation'][0]['torque_error']['joint']:.2f} %"
    assert shown in titles[0]
    row = report.page.locator("table.verdicts tr", has_text="held-out motion").inner_text()
    assert "motor" in row
    assert torque_figure(finished).name == "torque-check-joint"
    plans = [np.load(io.BytesIO(log.attachments["plan.npz"]))["q"] for log in sessions(finished)]
    assert plans[0].shape != plans[-1].shape or np.abs(plans[0] - plans[-1]).max() > 0.1


def sessions(folder: Path) -> list[Session]:
    return list(ResultFolder.load(folder).sessions.values())


def test_every_chart_shows_a_line(report: Seen) -> None:
    drawn = report.page.evaluate(
        "[...document.querySelectorAll('.chart[data-drawn]')]"
        ".map(c => c.querySelectorAll('path.js-line, path.point, .hm image').length)"
    )
    assert len(drawn) > 40
    assert min(drawn) > 0


def test_charts_that_are_folded_away_are_drawn_when_opened(report: Seen) -> None:
    # A handle: the locator of a closed part would leave it once it is open.
    part = report.page.locator("#torque details:not([open])").first.element_handle()
    part.query_selector("summary").click()
    part.wait_for_selector(".chart .js-line", state="attached", timeout=60_000)


def test_pictures_have_alternative_texts_with_numbers(report: Seen) -> None:
    texts = report.page.evaluate(
        "[...document.querySelectorAll('.chart, svg[role=img]')].map(c => c.getAttribute('aria-label') || '')"
    )
    assert all(any(sign.isdigit() for sign in text) for text in texts)


@pytest.fixture(scope="module")
def pages(finished: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Report with a diagnosis, and comparison."""
    place = tmp_path_factory.mktemp("pages")
    folder = copy(finished, place / "diagnosed")
    (folder / "diagnosis.json").write_text(json.dumps(DIAGNOSIS))
    comparison = place / "comparison.html"
    done = CliRunner().invoke(main, ["compare", str(finished), str(folder), "--report", str(comparison)])
    assert done.exit_code == 0, done.output
    return {"report": write_report(folder), "comparison": comparison}


@pytest.fixture(scope="module")
def diagnosed(pages: dict[str, Path], chrome: Browser) -> Iterator[Seen]:
    """The report with a diagnosis in a wide window, every visible chart drawn."""
    with opened(chrome, pages["report"]) as seen:
        seen.wait_drawn()
        yield seen


def legible_and_accessible(seen: Seen) -> None:
    assert seen.page.evaluate(CONTRAST) >= 4.5
    assert flaws(seen) == []


@pytest.mark.parametrize("size", [WIDE, NARROW])
@pytest.mark.parametrize("name", ["report", "comparison"])
def test_a_page_is_legible_fits_the_window_and_is_accessible(
    pages: dict[str, Path], chrome: Browser, name: str, size: tuple[int, int], request: pytest.FixtureRequest
) -> None:
    if (name, size) == ("report", WIDE):
        legible_and_accessible(request.getfixturevalue("diagnosed"))
        return
    with opened(chrome, pages[name], size) as seen:
        seen.wait_drawn()
        legible_and_accessible(seen)


@pytest.mark.parametrize("size", [WIDE, NARROW])
def test_the_preview_is_legible_fits_the_window_and_is_accessible(
    previewed: Seen, size: tuple[int, int]
) -> None:
    previewed.page.set_viewport_size({"width": size[0], "height": size[1]})
    legible_and_accessible(previewed)


def test_a_diagnosis_is_shown_with_its_evidence(diagnosed: Seen) -> None:
    text = diagnosed.page.inner_text("#diagnosis")
    verdict = diagnosed.page.locator("table.verdicts tr", has_text="diagnosis").inner_text()
    for part in (
        "Stribeck, joint A2",
        "1.9 ± 0.2 Nm",
        "0.22 to 0.31 Nm",
        "presliding hysteresis",
        "<joint A2>",
    ):
        assert part in text
    assert "found: stribeck; 1 unexplained; the extended model: A2 motor -50 %" in verdict


def test_a_diagnosis_without_a_cause_says_in_the_first_table_what_is_left(
    finished: Path, tmp_path: Path
) -> None:
    folder = copy(finished, tmp_path / "open")
    (folder / "diagnosis.json").write_text(json.dumps(DIAGNOSIS | {"findings": []}))
    line = next(one for one in verdicts(ResultFolder.load(folder)) if one.subject == "diagnosis")
    assert line.level == "look"
    assert line.found.startswith(
        "The data support no cause, but the residuals depend on the motion; 1 unexplained"
    )


def test_a_run_that_failed_is_called_bad_and_still_has_a_report(finished: Path, tmp_path: Path) -> None:
    folder = copy(finished, tmp_path / "failed")
    summary = json.loads((folder / "summary.json").read_text())
    kept = {key: summary[key] for key in ("schema_version", "experiment", "sessions", "link", "versions")}
    kept["sessions"][1] |= {"exit_status": "fail", "reason": "drives <off>"}
    (folder / "summary.json").write_text(
        json.dumps({**kept, "exit_status": "fail", "reason": "drives <off>"})
    )
    for name in ("model.yaml", "loaded.mcap"):
        (folder / name).unlink()
    text = write_report(folder).read_text()
    results = ResultFolder.load(folder)
    assert headline(verdicts(results)) == ("bad", "Not a good run: exit status")
    assert results.unread == ("loaded",)
    assert "drives &lt;off&gt;" in text
    assert "drives <off>" not in text


def test_figures_and_tables_for_a_paper_are_written(finished: Path, tmp_path: Path) -> None:
    folder = copy(finished, tmp_path / "run")
    (folder / "unloaded.mcap").unlink()
    command = [
        "report",
        str(folder),
        "--figures",
        str(tmp_path / "paper"),
        "--format",
        "svg",
        "--width",
        "ifac",
    ]
    done = CliRunner().invoke(main, command)
    assert done.exit_code == 0, done.output
    files = sorted((tmp_path / "paper").iterdir())
    assert [str(path) for path in files] == sorted(done.output.split())
    names = {"torque-loaded-joint.svg", "torque-check-motor.svg", "parameters.svg", "correlation.svg"}
    assert names | {"table_1.tex", "table_2.tex", "parameters.tex"} <= {path.name for path in files}
    for path in files:
        if path.suffix == ".svg":
            assert ElementTree.parse(path).getroot().get("width", "").startswith("238.1")  # pt, 84 mm
            assert "nan" not in re.sub(r"base64,[\w+/=\s]*", "", path.read_text())
    assert "This run, loaded" in (tmp_path / "paper" / "table_1.tex").read_text()
    refused = CliRunner().invoke(main, [*command[:-1], "wide", "--force"])
    assert refused.exit_code == 2
    assert "width 'wide' is unknown" in refused.output


def test_a_figure_is_interactive_in_a_notebook(finished: Path) -> None:
    figure = torque_figure(finished, "loaded", "joint")
    assert figure._repr_png_().startswith(b"\x89PNG")
    assert [panel.title for panel in figure.panels] == [f"joint {k}" for k in range(1, 8)]
    chart = figure.plotly(columns=3)
    names = [trace.name for trace in chart.data]
    assert names.count("measured") == names.count("computed") == names.count("residual") == 7
    measured = next(trace for trace in chart.data if trace.name == "measured")
    assert np.ptp(measured.y) > 0.1


def test_the_page_is_light(finished: Path) -> None:
    assert (finished / "report.html").stat().st_size <= 4e6


@pytest.mark.parametrize("size", [WIDE, NARROW])
def test_no_column_of_a_table_is_cut_off(finished: Path, chrome: Browser, size: tuple[int, int]) -> None:
    cut = """() => {
      document.querySelectorAll('details').forEach((part) => { part.open = true; });
      window.dispatchEvent(new Event('resize'));
      return [...document.querySelectorAll('.scroll, pre')].filter((box) => box.scrollWidth > box.clientWidth + 1)
        .map((box) => box.getAttribute('aria-label'));
    }"""
    with opened(chrome, finished / "report.html", size) as seen:
        assert seen.page.evaluate(cut) == []


def test_a_narrow_page_folds_its_long_parts_and_links_open_them(finished: Path, chrome: Browser) -> None:
    with opened(chrome, finished / "report.html", NARROW) as seen:
        page = seen.page
        seen.wait_drawn()
        assert page.evaluate("document.documentElement.scrollHeight") < 5 * NARROW[1]
        for anchor in ("torque", "parameters"):
            part = page.locator(f"#{anchor} > details.part")
            assert not part.evaluate("part => part.open")
            page.locator(f"nav a[href='#{anchor}']").click()
            page.wait_for_function(f"document.querySelector('#{anchor} > details.part').open")
        drawn = "document.querySelector('#torque .chart').dataset.drawn === 'yes'"
        page.wait_for_function(drawn, timeout=120_000)
        page.set_viewport_size({"width": WIDE[0], "height": WIDE[1]})
        page.wait_for_function("[...document.querySelectorAll('details.part')].every(part => part.open)")
        assert seen.errors == []


def test_a_wide_page_folds_none_of_its_parts(report: Seen) -> None:
    assert report.page.locator("details.part").count() == 0


def test_plots_are_drawn_without_scrolling(report: Seen) -> None:
    blank = "[...document.querySelectorAll('.chart:not([data-drawn])')].filter(c => !c.closest('details:not([open])'))"
    assert report.page.evaluate(f"{blank}.length") == 0
    assert report.page.evaluate("window.scrolled") == 0


def test_without_the_extra_one_line_says_so(finished: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "plotly.offline", None)
    done = CliRunner().invoke(main, ["report", str(finished)])
    assert done.exit_code == 2
    assert done.output.strip().count("\n") == 0
    assert "lwr-identification[view]" in done.output


def test_a_folder_without_results_is_refused(tmp_path: Path) -> None:
    done = CliRunner().invoke(main, ["report", str(tmp_path)])
    assert done.exit_code == 2
    assert "summary.json" in done.output


@pytest.fixture(scope="module")
def preview(finished: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("preview") / "preview.html"
    done = CliRunner().invoke(main, ["preview", str(finished), "--out", str(path)])
    assert done.exit_code == 0, done.output
    assert "tightest moment" in done.output
    return path


@pytest.fixture
def previewed(preview: Path, chrome: Browser) -> Iterator[Seen]:
    # Not kept open: it moves all the time. A low window: without a graphics card each pixel costs time.
    with opened(chrome, preview, (WIDE[0], 300)) as seen:
        yield seen


def test_the_preview_shows_the_arm_and_the_limits(previewed: Seen) -> None:
    page = previewed.page
    assert page.title() == "Preview of short, session loaded"
    for size in (WIDE[0], 300), (NARROW[0], 300):
        page.set_viewport_size({"width": size[0], "height": size[1]})
        assert page.evaluate("document.documentElement.scrollWidth") <= size[0]
        box = page.locator("iframe").bounding_box()
        assert box is not None
        assert box["height"] > 150
        assert colours(page) > 200
    facts = page.inner_text(".facts")
    assert "every condition holds" in facts
    assert "Tightest moment:" in facts
    assert page.locator(".joints svg").count() == 7
    assert previewed.errors == []
    assert previewed.external == []


def test_the_scene_is_lit_without_a_panorama() -> None:
    server = start_server()
    try:
        sent = [message for _, message in server.get_scene_serializer()._messages]
    finally:
        stop_server(server)
    (panorama,) = [one for one in sent if one["type"] == "EnvironmentMapMessage"]
    assert panorama["hdri_data"] is None


def colours(page: Page) -> int:
    """Number of colours in the picture of the scene, once there are more than a few or time is up."""
    page.frame_locator("iframe").locator("canvas").first.wait_for(timeout=120_000)
    return colours_of(page, page.locator("iframe").bounding_box())


def colours_of(page: Page, box: Any) -> int:
    assert box is not None
    count = 0
    for _ in range(30):
        picture = page.screenshot(timeout=120_000, clip={**box, "height": 0.7 * box["height"]})
        pixels = np.asarray(Image.open(io.BytesIO(picture)).convert("RGB")).reshape(-1, 3)
        count = len(np.unique(pixels, axis=0))
        if count > 200:
            break
    return count


def test_the_preview_server_shows_the_motion_until_ctrl_c(finished: Path, chrome: Browser) -> None:
    port = str(free_tcp_port())
    command = [sys.executable, "-m", "runner.cli", "preview", str(finished), "--serve", "--port", port]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        said = [process.stdout.readline().strip() for _ in range(2)]
        try:
            assert "tightest moment" in said[0]
            assert said[1] == f"http://127.0.0.1:{port}"
            second = CliRunner().invoke(main, ["preview", str(finished), "--serve", "--port", port])
            assert second.exit_code == 2
            assert f"port {port} of 127.0.0.1 is in use" in second.output
            with opened(chrome, said[1], (WIDE[0], 300)) as seen:
                seen.page.get_by_role("button", name="go to the tightest moment").click(timeout=120_000)
                seen.page.get_by_text("Tightest moment:").wait_for()
                text = seen.page.inner_text("body")
                assert colours_of(seen.page, seen.page.locator("canvas").first.bounding_box()) > 200
                for width in (WIDE[0], NARROW[0]):
                    seen.page.set_viewport_size({"width": width, "height": 300})
                    seen.page.wait_for_timeout(500)
                    assert flaws(seen) == []
                    assert seen.page.evaluate(CLIPPED) == []
            process.send_signal(signal.SIGINT)
            assert process.wait(60) == 0
        finally:
            process.kill()
    for part in (
        "Preview of short, session loaded",
        "clearance",
        "from its limit",
        "✓ velocity:",
        "must be kept",
    ):
        assert part in text


def free_tcp_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def test_the_preview_of_a_plan_marks_what_is_not_held(finished: Path, tmp_path: Path) -> None:
    done = CliRunner().invoke(
        main, ["preview", str(finished / "plan.yaml"), "--out", str(tmp_path / "plan.html")]
    )
    assert done.exit_code == 0, done.output
    assert "plan plan.yaml" in done.output
    assert "<title>Preview of plan plan.yaml</title>" in (tmp_path / "plan.html").read_text()


def test_a_session_that_is_not_there_is_named_with_those_that_are(finished: Path) -> None:
    done = CliRunner().invoke(main, ["preview", str(finished / "experiment.yaml"), "--session", "heavy"])
    assert done.exit_code == 2
    assert "unloaded, loaded" in done.output


@pytest.mark.parametrize(
    ("gain", "text"),
    [(0.084, "-8 %"), (0.0042, "-0.4 %"), (0.0001, "0 %"), (-0.0001, "0 %"), (-0.021, "+2 %")],
)
def test_a_change_of_the_error_too_small_to_show_has_no_sign(gain: float, text: str) -> None:
    assert error_change(gain) == text
