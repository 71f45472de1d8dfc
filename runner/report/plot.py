"""Panels as data: marks in named roles, drawn by plotly for the page and by matplotlib for papers.

The roles carry the colours (Okabe and Ito, distinguishable with every common colour vision) and the line
styles of the paper: measured solid blue, computed dotted red, error dashed black.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Role = Literal[
    "logged", "measured", "computed", "error", "limit", "forward", "backward", "estimate", "truth",
    "published", "spread",
]  # fmt: skip
Symbol = Literal["circle", "cross", "diamond"]


@dataclass(frozen=True)
class Style:
    """How a role looks: colour, width [px], dash pattern in px ("" for solid), symbol of points."""

    colour: str
    width: float = 1.4
    dash: str = ""
    symbol: Symbol = "circle"


STYLES: dict[Role, Style] = {
    "logged": Style("#9ecae9", 0.8),
    "measured": Style("#0072b2", 1.8),
    "computed": Style("#d55e00", 1.8, "3 4"),
    "error": Style("#000000", 0.8, "5 3"),
    "limit": Style("#767676", 1.2, "4 4"),
    "forward": Style("#0072b2", 1.8),
    "backward": Style("#d55e00", 1.8, "4 3"),
    "estimate": Style("#0072b2", 1.6, symbol="circle"),
    "truth": Style("#000000", 1.6, symbol="cross"),
    "published": Style("#d55e00", 1.6, symbol="diamond"),
    "spread": Style("#9ecae9", 0.0),
}


@dataclass(frozen=True, eq=False)
class Line:
    """y over x, both (k,). lower : drawn in the lower part of the panel, on a scale of its own."""

    role: Role
    label: str
    x: Floats
    y: Floats
    lower: bool = False


@dataclass(frozen=True, eq=False)
class Band:
    """The area between low and high (k,) over x (k,)."""

    role: Role
    label: str
    x: Floats
    low: Floats
    high: Floats
    lower: bool = False


@dataclass(frozen=True, eq=False)
class Points:
    """Single points, (k,), with intervals (k, 2) or None, and a text for each."""

    role: Role
    label: str
    x: Floats
    y: Floats
    interval: Floats | None = None
    texts: tuple[str, ...] = ()
    lower: bool = False


Mark = Line | Band | Points


@dataclass(frozen=True)
class Panel:
    """One plot. alt : description in a sentence, for screen readers.

    title : short, above the plot; note : a statistic beside it, on paper only if asked for. lower_label : of the lower
    part; lower_log : its axis is logarithmic on paper if intervals are too different to be seen otherwise.
    x_names : texts in place of numbers at x = 1, 2, ...
    """

    title: str
    x_label: str
    y_label: str
    marks: tuple[Mark, ...]
    alt: str
    note: str = ""
    lower_label: str = ""
    x_names: tuple[str, ...] = ()
    lower_log: bool = False

    @property
    def split(self) -> bool:
        """Whether there is a lower part."""
        return any(mark.lower for mark in self.marks)


def limits(values: Sequence[Floats], *, pad: float = 0.04) -> tuple[float, float]:
    """Range of an axis, a little wider than the values; 0 to 1 without values."""
    finite = [v[np.isfinite(v)] for v in values]
    finite = [v for v in finite if len(v)]
    if not finite:
        return 0.0, 1.0
    low, high = min(float(v.min()) for v in finite), max(float(v.max()) for v in finite)
    room = pad * (high - low) if high > low else 0.5 * abs(high) or 0.5
    return low - room, high + room


def thin(x: Floats, y: Floats, points: int = 1000) -> tuple[Floats, Floats]:
    """At most `points` of the samples (n,), n > points, in their order: both extremes of each stretch.

    The samples are cut into points / 2 stretches at most, of equal number; of each, the lowest and the highest sample
    stay at their own x, so a spike of a single sample survives. The first and the last sample stay too.
    Non-finite samples are left out.
    """
    good = np.isfinite(x) & np.isfinite(y)
    if not good.all():
        x, y = x[good], y[good]
    if len(x) <= points:
        return x, y
    width = -(-len(x) // max((points - 2) // 2, 1))
    first = np.arange(0, len(x), width)
    # The last stretch is filled up with its last sample.
    table = np.append(y, np.full(len(first) * width - len(y), y[-1])).reshape(-1, width)
    extremes = [first + table.argmin(axis=1), first + table.argmax(axis=1)]
    kept = np.unique(np.minimum(np.concatenate([*extremes, [0, len(x) - 1]]), len(x) - 1))
    return x[kept], y[kept]
