"""Figures as data: thinning, matplotlib axes, formats, and their data on the page."""

from __future__ import annotations

import base64
import gzip
import json
import subprocess
import sys
import xml.etree.ElementTree as ElementTree
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from fri.errors import ConfigurationError
from ident.diagnosis.outcome.statements import Number, Part
from ident.estimators.estimate import percent
from runner.report.diagnosis import _part
from runner.report.figure import Figure, MatrixFigure, inline_svg
from runner.report.figures import pretty_unit
from runner.report.interactive import chart_json, lighter_charts, panel_chart, zipped
from runner.report.latex import tabular
from runner.report.markup import (
    MOST_PERCENT,
    figure_html,
    number_html,
    paragraph,
    table,
    take_charts,
    with_code,
)
from runner.report.paper import FONTS, WIDTHS_MM, draw_panels, joint_labels
from runner.report.plot import Band, Line, Panel, Points, thin
from runner.report.tables import Table

MM = 25.4


@given(
    arrays.arrays(np.float64, st.integers(1, 600), elements=st.floats(-1e6, 1e6)),
    st.integers(4, 120),
)
def test_thinning_keeps_extremes_and_ends_in_order(y: np.ndarray, points: int) -> None:
    x = np.arange(len(y), dtype=np.float64)
    kept_x, kept_y = thin(x, y, points)
    assert len(kept_x) <= max(points, 4)
    assert kept_y.min() == y.min()
    assert kept_y.max() == y.max()
    assert np.all(np.diff(kept_x) > 0)
    assert {0.0, float(len(y) - 1)} <= set(kept_x.tolist())
    np.testing.assert_array_equal(kept_y, y[kept_x.astype(int)])


@pytest.mark.parametrize("place", [0, 1, 777, 40_321, 49_999])
def test_a_spike_of_one_sample_survives(place: int) -> None:
    y = np.zeros(50_000)
    y[place] = 12.0
    assert thin(np.arange(50_000.0), y, 900)[1].max() == 12.0


def test_samples_that_do_not_exist_are_left_out() -> None:
    x, y = thin(np.arange(4.0), np.array([1.0, np.nan, np.inf, 2.0]))
    assert (x.tolist(), y.tolist()) == ([0.0, 3.0], [1.0, 2.0])


def panel(**changes: object) -> Panel:
    x = np.linspace(0.0, 1.0, 50)
    marks = (
        Line("measured", "measured", x, np.sin(x)),
        Band("spread", "spread", x, x - 1, x + 1),
        Points("estimate", "estimate", x[:3], x[:3], np.column_stack([x[:3] - 1, x[:3] + 1])),
        Line("error", "error", x, x, lower=True),
    )
    return replace(Panel("A1 <b>", "time [s]", "[Nm]", marks, "A & B"), **changes)  # type: ignore[arg-type]


def figure(count: int = 2) -> Figure:
    return Figure("f", "caption & more", tuple(panel(title=f"joint {k + 1}") for k in range(count)))


@pytest.mark.parametrize(
    ("suffix", "begin"),
    [(".pdf", b"%PDF"), (".pgf", b"%% Creator"), (".svg", b"<?xml"), (".png", b"\x89PNG")],
)
def test_the_suffix_chooses_the_format_and_the_same_figure_gives_the_same_file(
    tmp_path: Path, suffix: str, begin: bytes
) -> None:
    written = [figure().save(tmp_path / f"{name}{suffix}", "ieee").read_bytes() for name in "ab"]
    assert written[0].startswith(begin)
    assert written[0] == written[1]
    assert sorted(path.name for path in tmp_path.iterdir()) == [f"a{suffix}", f"b{suffix}"]


def test_pgf_takes_the_fonts_of_the_document_without_latex_here(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PATH", "")
    text = figure().save(tmp_path / "f.pgf").read_text()
    assert "\\begin{pgfpicture}" in text
    assert "\\setmainfont" not in text
    assert "Joint 1" in text


def test_an_image_in_pgf_goes_to_a_file_beside_it_without_latex_here(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PATH", "")
    matrix = MatrixFigure("m", "correlations", tuple("abc"), np.eye(3))
    text = matrix.save(tmp_path / "m.pgf").read_text()
    assert "{m-img0.png}" in text
    assert sorted(path.name for path in tmp_path.iterdir()) == ["m-img0.png", "m.pgf"]


@pytest.mark.parametrize(
    ("name", "width", "message"),
    [
        ("f.jpg", "ieee", r"suffix '.jpg' is no format; end the name in .pdf, .pgf, .svg or .png"),
        ("f", "ieee", r"suffix 'none' is no format"),
        ("absent/f.pdf", "ieee", r"folder .*absent does not exist"),
        ("f.pdf", "nature", r"width 'nature' is unknown; choose ieee, ieee-wide, ifac, ifac-wide"),
        ("f.pdf", 3.5, r"width 3.5 mm is outside 30 to 400 mm"),
    ],
)
def test_a_wrong_name_or_width_is_refused_and_leaves_nothing(
    tmp_path: Path, name: str, width: str | float, message: str
) -> None:
    with pytest.raises(ConfigurationError, match=message):
        figure().save(tmp_path / name, width)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("width", WIDTHS_MM)
def test_a_figure_has_the_width_of_the_column_and_a_font_of_its_papers(width: str) -> None:
    axes = draw_panels(figure(7).panels, width)
    assert axes.shape == (7, 2)
    whole = axes[0, 0].figure
    assert MM * whole.get_figwidth() == pytest.approx(WIDTHS_MM[width])
    assert MM * whole.get_figheight() < 240.0
    assert axes[0, 0].get_xlabel() == ""
    assert {text.get_fontsize() for text in (axes[0, 0].title, axes[0, 0].yaxis.label)} == {8.0}
    assert axes[0, 0].title.get_fontname() in FONTS


def test_nothing_reaches_beyond_the_figure_and_ticks_are_more_than_two() -> None:
    x = np.linspace(3.0, 9.0, 40)
    one = panel(marks=(Line("measured", "m", x, 1e3 * np.cos(x)), Line("computed", "c", x, -1e3 * np.cos(x))))
    axes = draw_panels([one] * 7, "ieee")
    whole = axes[0].figure
    whole.canvas.draw()
    box, frame = whole.get_tightbbox(), whole.bbox_inches
    assert box.x0 >= -0.02
    assert box.y0 >= -0.02
    assert box.x1 <= frame.x1 + 0.02
    assert box.y1 <= frame.y1 + 0.02
    for each in axes:
        low, high = each.get_xlim()
        assert sum(low <= tick <= high for tick in each.get_xticks()) >= 3


def test_the_caller_gets_axes_with_the_numbers_and_no_statistics_unless_asked() -> None:
    shown = Figure("f", "c", (panel(note="0.3 Nm rms"),))
    (pair,) = shown.plot("ieee")
    x = np.linspace(0.0, 1.0, 50)
    np.testing.assert_array_equal(pair[0].lines[0].get_ydata(), np.sin(x))
    np.testing.assert_array_equal(pair[1].lines[0].get_ydata(), x)
    assert pair[0].get_title(loc="left") == "A1 <b>"
    assert shown.plot("ieee", statistics=True)[0, 0].get_title(loc="left") == "A1 <b>\n0.3 Nm rms"


def test_intervals_of_very_different_size_are_all_to_be_seen() -> None:
    half = np.array([1e-4, 1e-2, 1.0])
    marks = (
        Points("estimate", "e", np.arange(1.0, 4.0), np.zeros(3), np.column_stack([-half, half]), lower=True),
        Points("estimate", "e", np.arange(1.0, 4.0), half),
    )
    one = panel(marks=marks, x_names=("1", "2", "3"), lower_log=True)
    (pair,) = draw_panels([one], "ieee")
    pair[1].figure.canvas.draw()
    ends = pair[1].transData.transform(np.column_stack([np.arange(1.0, 4.0), half]))
    middle = pair[1].transData.transform(np.column_stack([np.arange(1.0, 4.0), 0.0 * half]))
    points = (ends - middle)[:, 1] * 72.0 / pair[1].figure.dpi
    assert points.min() > 1.0


def test_joints_are_numbers_or_names() -> None:
    assert joint_labels(("A1", "E1"), "numbers") == ("joint 1", "joint 2")
    assert joint_labels(("A1", "E1"), "names") == ("A1", "E1")
    with pytest.raises(ConfigurationError, match="choose numbers or names"):
        joint_labels(("A1",), "letters")


def test_svg_carries_caption_and_description(tmp_path: Path) -> None:
    root = ElementTree.parse(figure().save(tmp_path / "f.svg")).getroot()
    texts = {node.text for node in root.iter() if node.tag.startswith("{http://purl.org/dc")}
    assert {"caption & more", "A & B A & B"} <= texts
    inside = inline_svg(panel())
    assert inside.startswith("<svg")
    assert "aria-label='A &amp; B'" in inside


def test_a_matrix_has_its_names_and_colours() -> None:
    names, values = ("a", "b"), np.array([[1.0, -0.5], [-0.5, 1.0]])
    (axes,) = MatrixFigure("m", "c", names, values, "alt").plot("ieee")
    assert [text.get_text() for text in axes.get_yticklabels()] == ["a", "b"]
    np.testing.assert_array_equal(axes.images[0].get_array(), values)


def test_matplotlib_is_imported_only_to_draw() -> None:
    code = "import runner.cli, runner.report.figures, runner.commands.logs, sys; sys.exit('matplotlib' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], check=False)
    assert done.returncode == 0


def unpacked(column: dict[str, object]) -> np.ndarray:
    return column["low"] + column["step"] * np.cumsum(column["moves"])  # type: ignore[operator]


def test_labels_leave_room_for_long_numbers_of_their_axis() -> None:
    x = np.linspace(0.0, 1.0, 5)
    layout = panel_chart(panel(marks=(Line("measured", "m", x, -0.05 * x),)))["layout"]
    assert layout["yaxis"]["automargin"] is True


@pytest.mark.parametrize(("unit", "printed"), [("Nm/rad^3", "Nm/rad³"), ("kg m^2", "kg\N{NO-BREAK SPACE}m²")])
def test_powers_of_units_are_raised(unit: str, printed: str) -> None:
    assert pretty_unit(unit) == printed


def test_the_page_has_the_lines_to_a_ten_thousandth_of_their_range() -> None:
    x = np.linspace(0.0, 40.0, 700)
    y = np.random.default_rng(1).normal(size=700)
    line = json.loads(chart_json(panel_chart(panel(marks=(Line("measured", "m", x, y),)))))["data"][0]
    np.testing.assert_allclose(unpacked(line["y"]), y, atol=1e-4 * np.ptp(y))
    np.testing.assert_allclose(unpacked(line["x"]), x, atol=1e-4 * 40.0)


def test_charts_too_large_for_the_page_lose_points_but_no_extremes() -> None:
    x = np.arange(700.0)
    y = np.random.default_rng(2).normal(size=700)
    y[333] = 40.0
    one = Figure("f", "c", tuple(panel(marks=(Line("measured", "m", x, y),)) for _ in range(5)))
    content, charts = take_charts(figure_html(one))
    assert "application/json" not in content
    assert content.count("class='chart") == 5
    budget = len(zipped(charts)) // 2
    lighter = lighter_charts(charts, budget)
    assert len(zipped(lighter)) <= budget
    for chart in json.loads(lighter):
        assert unpacked(chart["data"][0]["y"]).max() == pytest.approx(40.0, rel=1e-3)
    assert gzip.decompress(base64.b64decode(zipped(charts))).decode() == charts


def test_tables_are_latex_with_booktabs() -> None:
    rows = (
        ["XX2R", "kg\N{NO-BREAK SPACE}m²", Number(1.36, ".2f"), Number(None)],
        ["Fcm1 *", "Nm", Number(-1.5e-5, ".3g"), Number(float("inf"))],
        ["50 % & more", "", Number(-0.0001, ".2f"), Number(2.0)],
    )
    text = tabular(Table(("parameter", "unit", "|τ1| [Nm]", "RSD %"), rows))
    assert text.splitlines()[1:4] == [
        r"\begin{tabular}{@{}llrr@{}}",
        r"\toprule",
        r"parameter & unit & $|\tau_1|$ & RSD \% \\",
    ]
    assert r"$\mathit{XX}_{2}^\mathrm{R}$ & kg~m$^2$ & 1.36 & -- \\" in text
    assert r"$F_{\mathrm{c,m}1}$$^*$ & Nm & $-1.5\cdot 10^{-5}$ & $\infty$ \\" in text
    assert r"50 \% \& more &  & 0.00 & 2 \\" in text
    assert tabular(Table(("a", "b", "c", "d"), rows), columns=2).splitlines()[6].count("&") == 7
    with pytest.raises(ConfigurationError, match="0 blocks side by side"):
        tabular(Table(("a",), rows), columns=0)


@pytest.mark.parametrize(
    ("number", "shown"),
    [
        (Number(-0.00001, ".2f"), ">0.00<"),
        (Number(-1.5, ".1f"), ">\N{MINUS SIGN}1.5<"),
        (Number(None), "–"),
        (Number(float("inf")), "∞"),
    ],
)
def test_numbers_are_shown_as_a_person_writes_them(number: Number, shown: str) -> None:
    assert shown in number_html(number)


def test_a_number_keeps_all_its_digits_in_the_markup() -> None:
    assert "value='0.1234567890123'" in number_html(Number(0.1234567890123, ".2f", "a.b"))
    assert "data-key='a.b'" in number_html(Number(0.1, ".2f", "a.b"))


def test_a_percentage_of_nothing_is_not_shown_in_all_its_digits() -> None:
    html = number_html(Number(2.84e15, ".2f", "rsd", MOST_PERCENT))
    assert html == "<data value='2840000000000000.0' data-key='rsd'>&gt; 1000</data>"
    assert "&lt; \N{MINUS SIGN}1000<" in number_html(Number(-3e12, ".1f", most=MOST_PERCENT))
    assert ">999.0<" in number_html(Number(999.0, ".1f", most=MOST_PERCENT))
    assert percent(2.84e15, ".2f") == "> 1000"
    assert percent(12.25, ".2f") == "12.25"


def test_code_between_backticks_is_marked_in_lists_too() -> None:
    assert with_code("run `lwr-run <x>`") == "run <code>lwr-run &lt;x&gt;</code>"
    folder: Any = None
    html = _part(folder, Part("limits", "Limits", ["without a reference; run `lwr-run commission`"]))
    assert html == "<ul><li>Without a reference; run <code>lwr-run commission</code>.</li></ul>"


def test_text_cannot_become_markup() -> None:
    assert "<script>" not in table(("<script>",), [["<script>"]], "<script>")
    assert paragraph("run `a<b` now") == "<p>run <code>a&lt;b</code> now</p>"
