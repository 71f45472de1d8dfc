"""Ranges beside the keys: what keeps them, what does not, and units mistaken for others."""

from __future__ import annotations

import dataclasses
from typing import Annotated

import pytest

from fri.errors import ConfigurationError
from fri.quantities import (
    FileName,
    Name,
    Share,
    Version,
    check,
    check_value,
    described,
    entries,
    metas,
    within,
)


@dataclasses.dataclass(frozen=True)
class Body:
    """Numbers with ranges."""

    mass: Annotated[float, within(0.0, 14.0, "kg", above=True)] = 1.0
    place: tuple[Annotated[float, within(-0.5, 0.5, "m")], ...] = (0.0, 0.0, 0.0)
    speed: Annotated[float, within(0.0, 1.0, "share")] | None = None
    name: Annotated[str, entries(1, 8)] = "body"
    count: Annotated[int, within(1, 100)] = 1

    def __post_init__(self) -> None:
        check(self)


def test_values_within_their_ranges_pass() -> None:
    Body(14.0, (0.5, -0.5, 0.0), 1.0, "12345678", 100)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"mass": 0.0}, "`mass`: 0.0 kg is outside above 0 to 14 kg; give a value in this range"),
        ({"mass": 3340.0}, "`mass`: .* it looks like g; write it in kg: 3.34"),
        ({"mass": float("nan")}, "`mass`: nan kg is outside"),
        (
            {"place": (0.0, -66.0, 144.0)},
            r"`place`\[1\]: .*looks like mm; write it in m: \[0, -0.066, 0.144\]",
        ),
        (
            {"place": (0.0, -6.6, 14.4)},
            r"looks like mm or cm; write it in m: \[0, -0.0066, 0.0144\] or \[0, -0.066, 0.144\]",
        ),
        ({"place": (0.0, 1e9, 0.0)}, r"`place`\[1\]: .*give a value in this range"),
        ({"speed": 50.0}, "`speed`: .*looks like percent; write it as a share of 1: 0.5"),
        ({"name": ""}, "`name`: 0 characters, limits 1 and 8; give more"),
        ({"name": "123456789"}, "`name`: 9 characters, limits 1 and 8; shorten it"),
        ({"count": 10**400}, "`count`: a number of 400 digits is outside 1 to 100"),
    ],
)
def test_others_are_named_with_value_range_and_advice(values: dict[str, object], message: str) -> None:
    with pytest.raises(ConfigurationError, match=message):
        Body(**values)  # type: ignore[arg-type]


def test_a_range_in_words() -> None:
    assert described(within(0.5, 60.0, "s")) == "0.5 to 60 s"
    assert described(within(0.0, 1.0, "share", above=True, below=True)) == "above 0 to below 1"
    assert described(within(1, 1)) == "1"


@pytest.mark.parametrize(
    ("hint", "inside", "outside"),
    [
        (Version, [1], [0, 2, -1]),
        (Share, [1e-9, 0.5, 1.0], [0.0, -0.1, 1.001, 2.0]),
        (Name, ["a", "a" * 64], ["", "a" * 65]),
        (FileName, ["a", "a" * 1000], ["", "a" * 1001]),
    ],
)
def test_common_kinds_have_their_ranges(hint: object, inside: list[object], outside: list[object]) -> None:
    _, ranges = metas(hint)
    for value in inside:
        check_value(value, ranges, "`key`")
    for value in outside:
        with pytest.raises(ConfigurationError, match="`key`"):
            check_value(value, ranges, "`key`")
