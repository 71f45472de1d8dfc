"""Rows that a cause makes worse, on which it acts or not."""

from __future__ import annotations

import numpy as np
import pytest

from ident.diagnosis.gain.held_out import HeldOut, worse_rows

ROWS, BLOCKS = 2000, 40


def errors(scale: float, *, one_block: bool = False) -> HeldOut:
    """Errors of two joints, the second one's larger by `scale`, in all blocks or in the first."""
    rng = np.random.default_rng(5)
    residual, block = rng.standard_normal((ROWS, 2)), np.arange(ROWS) // (ROWS // BLOCKS)
    residual[:, 1] *= np.where((block == 0) | (not one_block), scale, 1.0)
    return HeldOut({"motor": residual}, {"motor": block})


@pytest.mark.parametrize(
    ("scale", "one_block", "anywhere", "elsewhere"),
    [
        (1.03, False, True, False),
        (3.0, True, True, False),
        (1.08, False, True, True),
        (0.9, False, False, False),
    ],
)
def test_a_row_without_the_cause_has_to_be_much_worse_beyond_chance(
    scale: float, one_block: bool, anywhere: bool, elsewhere: bool
) -> None:
    before, after = errors(1.0), errors(scale, one_block=one_block)
    assert bool(worse_rows(before, after, 1)) == anywhere
    assert bool(worse_rows(before, after, 1, {("motor", 1)})) == anywhere
    assert bool(worse_rows(before, after, 1, {("motor", 0)})) == elsewhere


def test_a_row_without_the_cause_may_be_as_wrong_as_on_a_healthy_day() -> None:
    before, after, elsewhere = errors(1.0), errors(1.08), {("motor", 0)}
    level = after.rms()["motor"]
    assert worse_rows(before, after, 1, elsewhere, {"motor": 0.99 * level}) == [("motor", 1)]
    assert worse_rows(before, after, 1, elsewhere, {"motor": 1.01 * level}) == []
    assert worse_rows(before, after, 1, {("motor", 1)}, {"motor": 1.01 * level}) == [("motor", 1)]
    assert worse_rows(before, after, 1, elsewhere, {"joint": level}) == [("motor", 1)]
