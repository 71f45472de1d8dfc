"""A scatter plot as SVG, without a plotting library."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

WIDTH, HEIGHT = 640, 400
LEFT, BOTTOM, TOP, RIGHT = 70, 60, 40, 20


def ticks(low: float, high: float) -> list[float]:
    """Four to ten round numbers between two values."""
    size = 10.0 ** np.floor(np.log10((high - low) / 4.0))
    step = next(size * factor for factor in (10.0, 5.0, 2.0, 1.0) if (high - low) / (size * factor) >= 4.0)
    return [round(step * k, 10) for k in range(int(np.ceil(low / step)), int(np.floor(high / step)) + 1)]


def scatter(
    path: Path, points: Sequence[tuple[float, float]], x_label: str, y_label: str, title: str
) -> None:
    """Write points joined by a line, with axes and labels."""
    values = np.array(sorted(points))
    low, high = values.min(axis=0), values.max(axis=0)
    room = np.where(high > low, 0.08 * (high - low), 1.0)
    low, high = low - room, high + room

    def place(point: np.ndarray) -> tuple[float, float]:
        share = (point - low) / (high - low)
        return LEFT + share[0] * (WIDTH - LEFT - RIGHT), HEIGHT - BOTTOM - share[1] * (HEIGHT - TOP - BOTTOM)

    places = [place(point) for point in values]
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{WIDTH}" height="{HEIGHT}" font-family="sans-serif" '
        'font-size="12">',
        f'<rect width="{WIDTH}" height="{HEIGHT}" fill="white"/>',
        f'<text x="{WIDTH / 2}" y="22" text-anchor="middle" font-size="14">{title}</text>',
        f'<path d="M{LEFT} {TOP}V{HEIGHT - BOTTOM}H{WIDTH - RIGHT}" fill="none" stroke="black"/>',
        f'<text x="{WIDTH / 2}" y="{HEIGHT - 14}" text-anchor="middle">{x_label}</text>',
        f'<g transform="rotate(-90 18 {HEIGHT / 2})"><text x="18" y="{HEIGHT / 2}" text-anchor="middle">'
        f"{y_label}</text></g>",
    ]
    for at in ticks(low[0], high[0]):
        x, _ = place(np.array([at, low[1]]))
        parts.append(f'<path d="M{x:.1f} {HEIGHT - BOTTOM}v5" stroke="black"/>')
        parts.append(f'<text x="{x:.1f}" y="{HEIGHT - BOTTOM + 19}" text-anchor="middle">{at:g}</text>')
    for at in ticks(low[1], high[1]):
        _, y = place(np.array([low[0], at]))
        parts.append(f'<path d="M{LEFT} {y:.1f}h-5" stroke="black"/>')
        parts.append(f'<path d="M{LEFT} {y:.1f}H{WIDTH - RIGHT}" stroke="#dddddd"/>')
        parts.append(f'<text x="{LEFT - 9}" y="{y + 4:.1f}" text-anchor="end">{at:g}</text>')
    line = " ".join(f"{x:.1f},{y:.1f}" for x, y in places)
    parts.append(f'<polyline points="{line}" fill="none" stroke="#4878a8"/>')
    parts += [f'<circle cx="{x:.1f}" cy="{y:.1f}" r="4" fill="#204a87"/>' for x, y in places]
    path.write_text("\n".join([*parts, "</svg>"]) + "\n", encoding="utf-8")
