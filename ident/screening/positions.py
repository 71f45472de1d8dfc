"""Slightly wrong positions: a zero a few degrees off, a gain of some per cent, a channel late by some samples.

The search of `explanations` has the large errors. A small one is estimated: a change of one joint's position changes
the torques of the present bodies, and this change is a column beside all parameters of `Redundancy`. The joint's own
parameters take most of it, so it shows only where other joints turn, too.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.linalg import null_space

from ident.dynamics.parameters import Floats
from ident.screening.doubts import LATE_S
from ident.screening.normal_equations import Fit, Normal, Part
from ident.screening.parts import sessions_of
from ident.screening.redundancy import Redundancy, SampledRows

_DEVIATIONS = 6.0
_STEP = 1e-3

_Asked = tuple[int, str, tuple[Part, ...]]
"""Joint, kind and parts of an error, none for all."""


class _Kind(NamedTuple):
    """A kind of error: least size of interest, largest of a small one, least fall of the score with it undone, and the
    size in words.

    Five real arms and forty simulated ones without a known error reach these falls: 0.1 for offsets beyond 3 degrees,
    0.8 for gains beyond 10 %, 0.2 for delays beyond 10 ms. A short recording of one real arm with small torques
    reaches 0.43 for a delay.
    """

    least: float
    most: float
    drop: float
    words: Callable[[float, float], str]


KINDS: Mapping[str, _Kind] = {
    "offset": _Kind(
        float(np.radians(3.0)),
        1.0,
        0.2,
        lambda size, std: f"a zero offset of {np.degrees(size):.1f} ± {np.degrees(std):.1g} deg",
    ),
    "gain": _Kind(0.1, 1.0, 1.0, lambda size, std: f"a gain of {1.0 + size:.3g} ± {std:.1g}"),
    "delay": _Kind(
        LATE_S, 0.1, 0.6, lambda size, std: f"positions {1e3 * size:.0f} ± {1e3 * std:.1g} ms late"
    ),
}
"""Kinds of errors; their sizes in rad, recorded over true less one, and s."""


@dataclass(frozen=True)
class PositionError:
    """An error of a joint's recorded position: its kind, size and standard deviation, and the fall of the score.

    mended : the data with it undone. parts : of the data with it; none for all.
    """

    joint: int
    kind: str
    size: float
    std: float
    drop: float
    mended: Redundancy
    parts: tuple[Part, ...] = ()

    @property
    def looks_like(self) -> str:
        """In words."""
        return KINDS[self.kind].words(self.size, self.std)


def position_errors(data: Redundancy, fit: Fit, normal: Normal) -> list[PositionError]:
    """The strongest error, if it is strong enough and stronger than a leaning base."""
    asked: list[_Asked] = [
        (joint, kind, ())
        for joint in range(data.chain.n)
        for kind in KINDS
        if not (data.chain.prismatic[joint] and kind == "offset")
    ]
    found = _errors(data, fit, normal, [*asked, *_by_session(data, normal)])
    best = max(found, key=lambda one: one.drop, default=None)
    return [] if best is None or best.drop <= leaning(data, fit, normal) else [best]


def session_offsets(data: Redundancy, fit: Fit, normal: Normal) -> list[PositionError]:
    """Zeros of positions different in one of several sessions."""
    return list(_errors(data, fit, normal, _by_session(data, normal)))


def _by_session(data: Redundancy, normal: Normal) -> list[_Asked]:
    sessions = sessions_of(normal.parts)
    turning = [joint for joint in range(data.chain.n) if not data.chain.prismatic[joint]]
    return [(joint, "offset", parts) for parts in sessions for joint in turning] if len(sessions) > 1 else []


def _errors(data: Redundancy, fit: Fit, normal: Normal, asked: Sequence[_Asked]) -> Iterator[PositionError]:
    """Errors beyond chance and the least of interest."""
    torques = [data.rigid(rows, fit) for rows in data.rows]

    def added(joint: int, kind: str, parts: tuple[Part, ...]) -> list[Floats]:
        """Change (n, K) of the bodies' torques by an error of size one, for all sets of rows."""
        found = [
            (data.rigid(after, fit) - torque) / _STEP if after is not before else np.zeros_like(torque)
            for before, after, torque in zip(
                data.rows, _changed(data, joint, kind, _STEP, parts).rows, torques, strict=True
            )
        ]
        if kind == "delay" and "joint" not in data.sides:
            # In its own motor torque, friction that follows no simple law looks like late positions.
            for column in found:
                column[joint] = 0.0
        return found

    sizes = data.along(fit, normal, (added(*one) for one in asked))
    for (joint, kind, parts), (size, std, _) in zip(asked, sizes, strict=True):
        # Beyond the largest the column says nothing.
        if not max(KINDS[kind].least, _DEVIATIONS * std) < abs(size) < KINDS[kind].most:
            continue
        mended = _changed(data, joint, kind, size, parts)
        drop = fit.score - mended.fit(doubtful=False).score
        if drop > KINDS[kind].drop:
            recorded = {"offset": -size, "gain": 1.0 / (1.0 + size) - 1.0}.get(kind, size)
            yield PositionError(joint, kind, recorded, std, drop, mended, parts)


def _changed(data: Redundancy, joint: int, kind: str, size: float, parts: tuple[Part, ...]) -> Redundancy:
    rows = (
        changed(rows, joint, kind, size) if not parts or rows.part in parts else rows for rows in data.rows
    )
    return replace(data, rows=tuple(rows))


def leaning(data: Redundancy, fit: Fit, normal: Normal) -> float:
    """Fall of the score with the base leaning as it explains most."""
    gravity = np.asarray(data.chain.gravity, dtype=np.float64)
    size = float(np.linalg.norm(gravity))
    if not size:
        return 0.0
    sideways = size * null_space(gravity[None]).T
    still = [replace(rows, qd=0.0 * rows.qd, qdd=0.0 * rows.qdd) for rows in data.rows]
    turned = [replace(data, chain=replace(data.chain, gravity=one)) for one in sideways]
    columns = ([one.rigid(rows, fit) for rows in still] for one in turned)
    tilt = [found.value for found in data.along(fit, normal, columns)]
    down = gravity + tilt @ sideways
    down *= size / np.linalg.norm(down)
    return fit.score - replace(data, chain=replace(data.chain, gravity=down)).fit(doubtful=False).score


def changed(rows: SampledRows, joint: int, kind: str, size: float) -> SampledRows:
    """The rows with an offset added to a joint's position, a gain of 1 + size, or taken `size` seconds later."""
    q, qd, qdd, sign = rows.q.copy(), rows.qd.copy(), rows.qdd.copy(), rows.sign.copy()
    if kind == "offset":
        q[:, joint] += size
    elif kind == "gain":
        for values in (q, qd, qdd):
            values[:, joint] *= 1.0 + size
    else:
        rates = (rows.qd, rows.qdd, rows.jerk, rows.turn)
        for values, rate in zip((q, qd, qdd, sign), rates, strict=True):
            values[:, joint] += size * rate[:, joint]
    return replace(rows, q=q, qd=qd, qdd=qdd, sign=sign)
