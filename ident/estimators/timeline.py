"""The rows of a problem in the order in which they were measured, for estimators that run along."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from ident.estimators.problem import FloatArray, Problem

__all__ = ["Instant", "instants"]


@dataclass(frozen=True)
class Instant:
    """All rows of one instant: matrix (k, p), target (k,), class of
    each row (k,), number of the record and time.
    """

    record: int
    time_index: int
    matrix: FloatArray
    target: FloatArray
    classes: np.ndarray


def instants(problem: Problem) -> Iterator[Instant]:
    """Rows of each instant, record after record, in time."""
    records = sorted({group.record for group in problem.groups})
    for record in records:
        members = [
            (group, number)
            for group, number in zip(problem.groups, problem.class_of_group, strict=True)
            if group.record == record and len(group.target)
        ]
        matrix = np.concatenate([group.matrix for group, _ in members])
        target = np.concatenate([group.target for group, _ in members])
        time = np.concatenate([group.time_index for group, _ in members])
        classes = np.concatenate([np.full(len(group.target), number) for group, number in members])
        order = np.argsort(time, kind="stable")
        values, starts = np.unique(time[order], return_index=True)
        bounds = np.append(starts, len(order))
        for k, value in enumerate(values):
            rows = order[bounds[k] : bounds[k + 1]]
            yield Instant(record, int(value), matrix[rows], target[rows], classes[rows])
