"""Figures as data: thinning, axes, SVG."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from runner.report.markup import Number, paragraph, table
from runner.report.plot import STYLES, Band, Line, Panel, Points, thin
from runner.report.svg import Figure, ticks

SVG = "{http://www.w3.org/2000/svg}"


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


@given(st.floats(-1e4, 1e4), st.floats(1e-3, 1e4))
def test_ticks_are_few_round_and_inside(low: float, span: float) -> None:
    found = ticks(low, low + span)
    assert 1 <= len(found) <= 8
    assert all(low - 1e-6 * span <= tick <= low + span * (1 + 1e-6) for tick in found)


def panel(**changes: object) -> Panel:
    x = np.linspace(0.0, 1.0, 50)
    marks = (
        Line("measured", "measured", x, np.sin(x)),
        Band("spread", "spread", x, x - 1, x + 1),
        Points("estimate", "estimate", x[:3], x[:3], np.column_stack([x[:3] - 1, x[:3] + 1])),
        Line("error", "error", x, x, lower=True),
    )
    return replace(Panel("A1 <b>", "time [s]", "[Nm]", marks, "A & B"), **changes)  # type: ignore[arg-type]


def test_svg_holds_every_mark_and_escapes_texts() -> None:
    root = ElementTree.fromstring(Figure("f", "caption & more", (panel(), panel())).svg())
    assert root.findtext(f"{SVG}title") == "caption & more"
    assert root.findtext(f"{SVG}desc") == "A & B A & B"
    colours = [node.get("stroke") or node.get("fill") for node in root.iter(f"{SVG}path")]
    for role in ("measured", "error"):
        assert colours.count(STYLES[role].colour) >= 2  # type: ignore[index]
    assert len(list(root.iter(f"{SVG}circle"))) == 3 * 2 + 1
    texts = ["".join(node.itertext()) for node in root.iter(f"{SVG}text")]
    assert any("A1 <b>" in text for text in texts)
    assert {"measured", "spread", "estimate", "error"} <= set(texts)


def test_lines_stay_inside_their_frame() -> None:
    x = np.linspace(3.0, 9.0, 40)
    one = panel(marks=(Line("measured", "m", x, 1e3 * np.cos(x)),))
    root = ElementTree.fromstring(Figure("f", "c", (one,)).svg(columns=1, width=400.0))
    frame = next(node for node in root.iter(f"{SVG}rect") if node.get("fill") == "none")
    left, top, width, height = (float(frame.get(key, "")) for key in ("x", "y", "width", "height"))
    line = next(
        node
        for node in root.iter(f"{SVG}path")
        if node.get("stroke") == STYLES["measured"].colour and node.get("stroke-linejoin")
    )
    points = np.array([pair.split() for pair in line.get("d", "").lstrip("M").split("L")], dtype=np.float64)
    assert len(points) == 40
    assert points[:, 0].min() >= left - 0.1
    assert points[:, 0].max() <= left + width + 0.1
    assert points[:, 1].min() >= top
    assert points[:, 1].max() <= top + height


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
    assert shown in number.html()


def test_a_number_keeps_all_its_digits_in_the_markup() -> None:
    assert "value='0.1234567890123'" in Number(0.1234567890123, ".2f", "a.b").html()
    assert "data-key='a.b'" in Number(0.1, ".2f", "a.b").html()


def test_text_cannot_become_markup() -> None:
    assert "<script>" not in table(("<script>",), [["<script>"]], "<script>")
    assert paragraph("run `a<b` now") == "<p>run <code>a&lt;b</code> now</p>"
