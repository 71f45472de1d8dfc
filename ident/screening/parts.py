"""Torques that are wrong in one session, or in one half of it: a plug pulled, a driver restarted with another scale.

The parameters of the arm come from all sessions. What a gain or a zero of a part alone explains of a class's residual
follows from the vectors W^T z, z^T z and z^T e of that part, with the torque z that a gain or a zero by one adds.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from ident.dynamics.parameters import Floats
from ident.screening.redundancy import Class, Fit, Normal, Part, Redundancy, Size, solve

GAIN, DEVIATIONS = 0.18, 5.0
"""Least error of a gain of interest, and in its standard deviations: sensors are calibrated to a few per cent."""
LEFT = 0.75
"""Largest share of the residual left by a true error."""
# Share of a class's squared residual that an error of one part explains, and size of a zero over the torque's rms, or
# over the largest of the side.
_EXPLAINED, _ZERO, _OF_LARGEST = 0.25, 0.18, 0.02
_NOTHING = 1e-9


@dataclass(frozen=True)
class PartError:
    """A torque of some parts of the data against the torque computed from all other rows.

    kind : "gain", measured over computed torque; "zero", their difference [Nm]. left : share (rms) of the residual of
    the parts with the error undone.
    """

    key: Class
    parts: tuple[Part, ...]
    kind: Literal["gain", "zero"]
    value: float
    std: float
    left: float


def part_errors(data: Redundancy, fit: Fit, normal: Normal) -> list[PartError]:
    """Gains and zeros of single sessions, and of halves of them, beyond what a calibration and chance explain."""
    asked = list(_suspects(data, fit, normal))
    if not asked:
        return []
    shared = data.shared(fit)
    computed = [data.matrix(rows) @ shared for rows in data.rows]

    def columns(key: Class, parts: Sequence[Part], kind: str) -> list[Floats]:
        found = []
        for rows, torque in zip(data.rows, computed, strict=True):
            column = np.zeros_like(torque)
            if rows.side == key[0] and rows.part in parts:
                column[key[1]] = torque[key[1]] if kind == "gain" else 1.0
            found.append(column)
        return found

    sizes: Iterator[Size] = data.along(fit, normal, (columns(*one) for one in asked))
    return [
        PartError(key, parts, kind, size.value + (kind == "gain"), size.std, size.left)
        for (key, parts, kind), size in zip(asked, sizes, strict=True)
        if abs(size.value) > DEVIATIONS * size.std
        and size.left < LEFT
        # A torque that is nothing there is no gain: `channels` finds it.
        and (kind == "zero" or abs(size.value + 1.0) > _NOTHING)
    ]


def _suspects(
    data: Redundancy, fit: Fit, normal: Normal
) -> Iterator[tuple[Class, tuple[Part, ...], Literal["gain", "zero"]]]:
    """Errors of a part that explain much of the residual of their class."""
    place = {part: k for k, part in enumerate(normal.parts)}
    classes = {key: k for k, key in enumerate(normal.classes)}
    kinds: tuple[Literal["gain", "zero"], ...] = ("gain", "zero")
    bodies = data.shared(fit)
    # W^T z, z^T z and z^T e by class, part and kind.
    shared = np.zeros((len(classes), len(place), 2, data.width))
    power, product = np.zeros((2, len(classes), len(place), 2))
    for rows in data.rows:
        matrix, measured = data.matrix(rows), data.true_torque(rows)
        computed = matrix @ bodies
        for joint, own in enumerate(matrix):
            if (row_class := classes.get((rows.side, joint))) is None:
                continue
            error = measured[:, joint] - own @ fit.parameters
            added = np.array([computed[joint], np.ones(len(error))])
            where = row_class, place[rows.part]
            shared[where] += added @ own
            power[where] += np.sum(added**2, axis=1)
            product[where] += added @ error
    total = normal.total(fit.weight)
    chosen = [
        np.array([data.map_of(side, part)[joint] for part in normal.parts]) for side, joint in normal.classes
    ]
    squares = [float(np.einsum("on,onm,om->", c, s, c)) for c, s in zip(chosen, normal.square, strict=True)]
    counts = power[:, :, 1].sum(axis=1)
    rms = np.sqrt(np.array(squares) / np.maximum(counts, 1.0))
    for key, k in classes.items():
        weight = fit.weight[key]
        largest = max(rms[other] for (side, _), other in classes.items() if side == key[0])
        least = {"gain": GAIN, "zero": max(_ZERO * float(rms[k]), _OF_LARGEST * largest)}
        for parts in scopes(normal.parts):
            at = [place[part] for part in parts]
            for number, kind in enumerate(kinds):
                vector = weight * shared[k, at, number].sum(axis=0)
                left = weight * power[k, at, number].sum() - vector @ solve(total, vector)
                if left <= 1e-9 * weight * power[k, at, number].sum():
                    continue
                size = weight * product[k, at, number].sum() / left
                if abs(size) > least[kind] and size**2 * left > _EXPLAINED:
                    yield key, parts, kind


def scopes(parts: Sequence[Part]) -> list[tuple[Part, ...]]:
    """Each session of several, and each half of one."""
    records = sorted({record for record, _ in parts})
    whole = [tuple(part for part in parts if part[0] == record) for record in records]
    halves = [(part,) for part in parts if sum(other[0] == part[0] for other in parts) > 1]
    return [*(whole if len(records) > 1 else []), *halves]
