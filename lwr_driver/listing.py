"""Tables of a text: aligned in plain text, drawn by the terminal to fit its width."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import zip_longest

_GAP = 2
_WORDS_WIDTH = 18
"""Columns that a cell of words keeps at least; longer ones are wrapped."""


@dataclass(frozen=True)
class Listing:
    """Head and rows of a table as text; `str()` aligns them, columns of numbers to the right.

    The first column names the row. indent : spaces before each line.
    """

    head: Sequence[str]
    rows: Sequence[Sequence[str]]
    indent: int = 2

    def columns(self) -> list[tuple[str, ...]]:
        """The cells of each column, its head first."""
        return list(zip_longest(self.head, *self.rows, fillvalue=""))

    def numbers(self) -> list[bool]:
        """Whether a column holds numbers."""
        return [any(cells) and all(map(_is_number, filter(None, cells))) for _, *cells in self.columns()]

    def __str__(self) -> str:
        columns, numbers = self.columns(), self.numbers()
        widths = [max(map(len, cells)) for cells in columns]
        lines = []
        for row in zip(*columns, strict=True):
            cells = [
                cell.rjust(width) if right else cell.ljust(width)
                for cell, width, right in zip(row, widths, numbers, strict=True)
            ]
            lines.append((" " * self.indent + (" " * _GAP).join(cells)).rstrip())
        return "\n".join(lines)

    def fitted(self, width: int) -> list[Listing]:
        """Tables for a screen of `width` columns: those without room follow below, behind the first column again."""
        columns, numbers = self.columns(), self.numbers()
        needed = [
            max(map(len, cells)) if right else min(max(map(len, cells)), _WORDS_WIDTH)
            for cells, right in zip(columns, numbers, strict=True)
        ]
        groups: list[list[int]] = [[0]]
        left = room = width - self.indent - needed[0]
        for k in range(1, len(columns)):
            left -= _GAP + needed[k]
            if left < 0 and len(groups[-1]) > 1:
                groups.append([0])
                left = room - _GAP - needed[k]
            groups[-1].append(k)
        return [
            replace(
                self,
                head=[columns[k][0] for k in group],
                rows=list(zip(*(columns[k][1:] for k in group), strict=True)),
            )
            for group in groups
        ]


def in_units(
    head: Sequence[str], rows: Sequence[Sequence[str]], units: Sequence[str], indent: int = 2
) -> Listing:
    """A table with `{unit}` in its head where the unit stands; rows of several units have it in a last column.

    units : of each row.
    """
    if len(set(units)) <= 1:
        return Listing([name.format(unit=next(iter(units), "Nm")) for name in head], rows, indent)
    plain = [re.sub(r"[ \[]*\{unit\}\]?", "", name) for name in head]
    return Listing([*plain, "unit"], [[*row, unit] for row, unit in zip(rows, units, strict=True)], indent)


Piece = str | Listing
"""A piece of a text: lines, or a table."""


def text_of(pieces: Iterable[Piece]) -> str:
    """The plain text of all pieces, one below the other."""
    return "\n".join(map(str, pieces))


def _is_number(cell: str) -> bool:
    try:
        float(cell.split()[0].rstrip("%*"))
    except (ValueError, IndexError):
        return cell in ("-", "–")
    return True
