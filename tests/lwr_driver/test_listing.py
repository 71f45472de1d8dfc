"""Tables as text: aligned, and in parts that fit a width."""

from __future__ import annotations

import pytest

from lwr_driver.listing import Listing, in_units, text_of

TABLE = Listing(
    ("joint", "error %", "rms Nm", "verdict"),
    [("A1 joint", "1.25", "0.1", "ok"), ("E1", "-10.5", "-", "look")],
)


def test_numbers_stand_right_and_words_left() -> None:
    assert text_of(["title", TABLE]).splitlines() == [
        "title",
        "  joint     error %  rms Nm  verdict",
        "  A1 joint     1.25     0.1  ok",
        "  E1          -10.5       -  look",
    ]


def test_columns_without_room_follow_behind_the_first_one() -> None:
    assert len(TABLE.fitted(40)) == 1
    parts = TABLE.fitted(20)
    assert [list(part.head) for part in parts] == [
        ["joint", "error %"],
        ["joint", "rms Nm"],
        ["joint", "verdict"],
    ]
    assert [row[0] for part in parts for row in part.rows] == ["A1 joint", "E1"] * 3


def test_rows_of_several_units_have_them_in_a_column() -> None:
    head, rows = ("joint", "rms {unit}", "bias [{unit}]"), [("A1", "0.1", "0.0"), ("z", "3.1", "0.2")]
    assert in_units(head, rows, ["N", "N"]) == Listing(["joint", "rms N", "bias [N]"], rows)
    mixed = in_units(head, rows, ["Nm", "N"])
    assert mixed.head == ["joint", "rms", "bias", "unit"]
    assert mixed.rows == [["A1", "0.1", "0.0", "Nm"], ["z", "3.1", "0.2", "N"]]


@pytest.mark.parametrize("width", [1, 10, 30, 200])
def test_every_cell_is_kept_at_any_width(width: int) -> None:
    cells = {cell for part in TABLE.fitted(width) for row in (part.head, *part.rows) for cell in row}
    assert cells == {cell for row in (TABLE.head, *TABLE.rows) for cell in row}


def test_a_short_row_is_filled_up() -> None:
    assert str(Listing(("a", "b"), [("1",)], 0)).splitlines() == ["a  b", "1"]
