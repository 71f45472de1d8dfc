"""Parts of a motion to hold back, each unlike the rest.

An arm is asked for motions it has not made, so a part held back must differ from the rest. Neighbouring
rows are alike, and a motion repeats itself, within a session or in the next one. Hence the rows are cut into blocks of
time longer than the reach of the row filter and the correlation of the residual. Blocks with similar rows of the
normalised regressor make up a part (Ward's clustering, 1963), whatever their session and time: what is held back
then belongs to a region of the motion missing in the rest. The filters' leakage is kept out by dropping rows on both
sides of a block. Sessions with different payloads are cut into parts of their own, one of each held back together, so
that every payload stays in the training rows.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter1d

from ident.dynamics.parameters import Floats
from ident.estimators.problem import Problem

PARTS = 8
"""Number of parts. `python -m benchmarks.real_data` compares the held-back errors with those on other motions: with
fewer parts every candidate extrapolates beyond any use, with more of them a part has its like in the rest."""


def held_back_parts(problem: Problem, payloads: Sequence[str | None], block: int) -> list[NDArray[np.int64]]:
    """Number of the part of each row, for each row group; all -1 for a motion too short for two parts.

    block : rows of a block. With fewer than two blocks a part there are fewer parts.
    """
    labels = {c.label: k for k, c in enumerate(problem.classes)}
    size = len(problem.names)
    scale = np.sqrt(
        sum(np.einsum("ij,ij->j", c.factor.r[:, :-1], c.factor.r[:, :-1]) for c in problem.classes)
    )
    scale = np.where(scale > 0.0, scale / np.sqrt(problem.rows), 1.0)
    sums: dict[tuple[int, int], Floats] = {}
    rows: dict[tuple[int, int], NDArray[np.int64]] = {}
    for group in problem.groups:
        numbers = group.time_index // block
        edges = np.flatnonzero(np.diff(numbers, prepend=-1))
        if not len(edges):
            continue
        means = np.add.reduceat(group.matrix, edges, axis=0) / scale
        for place, total, n in zip(edges, means, np.diff(np.append(edges, len(numbers))), strict=True):
            key = group.record, int(numbers[place])
            sums.setdefault(key, np.zeros((len(labels), size)))[labels[group.label]] += total
            rows.setdefault(key, np.zeros(len(labels), dtype=np.int64))[labels[group.label]] += n
    from scipy.cluster.hierarchy import fcluster, linkage  # on use: slow imports
    from scipy.optimize import linear_sum_assignment

    table: dict[tuple[int, int], int] = {}
    centres: Floats | None = None
    conditions = list(dict.fromkeys(payloads[record] for record, _ in sums))
    members = {c: [key for key in sums if payloads[key[0]] == c] for c in conditions}
    count = min(PARTS, *(len(keys) // 2 for keys in members.values()))
    if count < 2:
        return [np.full(len(group.target), -1) for group in problem.groups]
    for keys in members.values():
        seen = np.array([rows[key] for key in keys])[:, :, None]
        features = np.array([sums[key] for key in keys]) / np.maximum(seen, 1)
        mean = (features * (seen > 0)).sum(axis=0) / np.maximum((seen > 0).sum(axis=0), 1)
        # A joint without rows in a block says nothing of where the block belongs.
        flat = np.where(seen > 0, features - mean, 0.0).reshape(len(keys), -1)
        part = fcluster(linkage(flat, "ward"), count, "maxclust") - 1
        own = np.array([(flat[part == k]).mean(axis=0) for k in range(int(part.max()) + 1)]) + mean.ravel()
        if centres is None:
            centres = own
        else:
            distance = np.linalg.norm(own[:, None] - centres[None], axis=2)
            like = distance.argmin(axis=1)
            matched, partner = linear_sum_assignment(distance)
            like[matched] = partner
            part = like[part]
        table |= dict(zip(keys, part.tolist(), strict=True))
    return [
        np.array([table[group.record, int(t)] for t in group.time_index // block], dtype=np.int64)
        for group in problem.groups
    ]


def beside(time_index: NDArray[np.int64], chosen: NDArray[np.bool_], reach: int) -> NDArray[np.bool_]:
    """Rows chosen or within `reach` time indices of one."""
    first = int(time_index[0]) if len(time_index) else 0
    line = np.zeros(int(time_index[-1]) - first + 1 if len(time_index) else 0, dtype=bool)
    line[time_index[chosen] - first] = True
    near: NDArray[np.bool_] = maximum_filter1d(line, 2 * reach + 1, mode="constant")[time_index - first]
    return near
