"""Wrong torques in one session, or in one half of it: a plug pulled, a driver restarted with another scale.

The parameters of the arm come from all sessions. An error of one part (a gain, a zero, a drift of the zero) adds to its
torque its size times z. Its share in the residual e of a class follows from the vectors W^T z, z^T z and z^T e of that
part.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from ident.dynamics.parameters import Floats
from ident.screening.normal_equations import DEVIATIONS, Class, Fit, Normal, Part, factored
from ident.screening.redundancy import Redundancy, SampledRows, Size

GAIN = 0.18
"""Least error of a gain of interest: sensors are calibrated to a few per cent."""
LEFT = 0.75
"""Largest share of the residual left by a true error."""
# Least share of an error in its class's squared residual; least size of a zero or a drift over the rms of the torque,
# and over the largest torque of the side.
_EXPLAINED, _ZERO, _OF_LARGEST = 0.25, 0.18, 0.02
# A share of these sizes is enough where half of the residual goes with the error: nothing else looks so.
_SMALL, _PLAIN = 0.45, 0.5
_NOTHING = 1e-9

ErrorKind = Literal["gain", "zero", "drift"]
_KINDS: tuple[ErrorKind, ...] = ("gain", "zero", "drift")


@dataclass(frozen=True)
class PartError:
    """A torque of some parts of the data against the torque computed from all other rows.

    kind : "gain", measured over computed torque; "zero", their difference [Nm]; "drift", its change from start to end
    of the session. left : share (rms) of the residual of the parts with the error undone.
    """

    key: Class
    parts: tuple[Part, ...]
    kind: ErrorKind
    value: float
    std: float
    left: float


def part_errors(data: Redundancy, fit: Fit, normal: Normal) -> list[PartError]:
    """Gains and zeros of single sessions and of halves of them, beyond calibration and chance."""
    asked = _suspects(data, fit, normal)
    if not asked:
        return []
    shared = data.shared(fit)
    computed = [data.matrix(rows) @ shared for rows in data.rows]

    def columns(key: Class, parts: Sequence[Part], kind: ErrorKind) -> list[Floats]:
        found = []
        for rows, torque in zip(data.rows, computed, strict=True):
            column = np.zeros_like(torque)
            if rows.side == key[0] and rows.part in parts:
                column[key[1]] = _added(rows, torque[key[1]])[_KINDS.index(kind)]
            found.append(column)
        return found

    sizes: Iterator[Size] = data.along(fit, normal, (columns(*one) for one in asked))
    return [
        PartError(key, parts, kind, size.value + (kind == "gain"), size.std, size.left)
        for (key, parts, kind), size in zip(asked, sizes, strict=True)
        if abs(size.value) > DEVIATIONS * size.std
        and size.left < (LEFT if abs(size.value) > asked[key, parts, kind] else _PLAIN)
        # A torque that is nothing there is no gain: `channels` finds it.
        and (kind != "gain" or abs(size.value + 1.0) > _NOTHING)
    ]


def _suspects(
    data: Redundancy, fit: Fit, normal: Normal
) -> dict[tuple[Class, tuple[Part, ...], ErrorKind], float]:
    """Errors of a part with much of the residual of their class, and of a size of interest."""
    found = {}
    place = {part: k for k, part in enumerate(normal.parts)}
    classes = {key: k for k, key in enumerate(normal.classes)}
    bodies = data.shared(fit)
    # W^T z, z^T z and z^T e by class, part and kind.
    shared = np.zeros((len(classes), len(place), len(_KINDS), data.width))
    power, product = np.zeros((2, len(classes), len(place), len(_KINDS)))
    for rows in data.rows:
        matrix, measured = data.matrix(rows), data.true_torque(rows)
        computed = matrix @ bodies
        for joint, own in enumerate(matrix):
            if (row_class := classes.get((rows.side, joint))) is None:
                continue
            error = measured[:, joint] - own @ fit.parameters
            added = _added(rows, computed[joint]) * rows.moving[:, joint]
            where = row_class, place[rows.part]
            shared[where] += added @ own
            power[where] += np.sum(added**2, axis=1)
            product[where] += added @ error
    solution = factored(normal.total(fit))
    chosen = [
        np.array([data.map_of(side, part)[joint] for part in normal.parts]) for side, joint in normal.classes
    ]
    squares = [float(np.einsum("on,onm,om->", c, s, c)) for c, s in zip(chosen, normal.square, strict=True)]
    counts = power[:, :, _KINDS.index("zero")].sum(axis=1)
    rms = np.sqrt(np.array(squares) / np.maximum(counts, 1.0))
    for key, k in classes.items():
        weight = fit.weight[key]
        largest = max(rms[other] for (side, _), other in classes.items() if side == key[0])
        zero = max(_ZERO * float(rms[k]), _OF_LARGEST * largest)
        least = {"gain": GAIN, "zero": zero, "drift": zero}
        for number, kind in enumerate(_KINDS):
            # A sensor that warms up does so in each session.
            whole = dict.fromkeys([*sessions_of(normal.parts), normal.parts])
            for parts in whole if kind == "drift" else scopes(normal.parts):
                at = [place[part] for part in parts]
                vector = weight * shared[k, at, number].sum(axis=0)
                left = weight * power[k, at, number].sum() - vector @ solution(vector)
                if left <= 1e-9 * weight * power[k, at, number].sum():
                    continue
                size = weight * product[k, at, number].sum() / left
                if abs(size) > _SMALL * least[kind] and size**2 * left > _EXPLAINED:
                    found[key, parts, kind] = least[kind]
    return found


def _added(rows: SampledRows, computed: Floats) -> Floats:
    """Torques (3, K) of an error of size one of each kind, beside the computed torque (K,)."""
    return np.array([computed, np.ones(len(computed)), rows.time])


def scopes(parts: Sequence[Part]) -> list[tuple[Part, ...]]:
    """Each session of several, and each half of one."""
    sessions = sessions_of(parts)
    halves = [(part,) for session in sessions if len(session) > 1 for part in session]
    return [*(sessions if len(sessions) > 1 else []), *halves]


def sessions_of(parts: Sequence[Part]) -> list[tuple[Part, ...]]:
    """The parts of each session."""
    return [
        tuple(part for part in parts if part[0] == record) for record in sorted({part[0] for part in parts})
    ]
