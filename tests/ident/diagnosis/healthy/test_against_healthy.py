"""Torques that contradict the healthy arm's: turned, and those of two joints interchanged."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ident.diagnosis.healthy.against_healthy import against_healthy
from ident.diagnosis.rows.nominal import SideRows

NAMES = ("A1", "A2", "A3")
VALUES = np.array([2.0, -1.0, 0.5])


@pytest.fixture
def rows() -> SideRows:
    """Torques of three joints near the healthy arm's, at other zeros."""
    random = np.random.default_rng(3)
    matrix = random.normal(size=(3, 200, 3))
    target = np.stack([1.05 * table @ VALUES for table in matrix], axis=1)
    target += 0.1 * random.normal(size=target.shape) + [0.5, -3.0, 1.0]
    whole = np.ones((200, 3), dtype=bool)
    return SideRows(matrix, target, whole, np.zeros(200, dtype=int), np.arange(200.0), ~whole[:, 0])


def told(rows: SideRows) -> list[tuple[str, int | None]]:
    return [(one.channel, one.joint) for one in against_healthy({"motor": rows}, VALUES, NAMES)]


def test_a_healthy_day_contradicts_nothing(rows: SideRows) -> None:
    assert told(rows) == []
    # A gain is a cause, and an unknown payload a torque like no joint's.
    assert told(replace(rows, target=rows.target * [1.0, 1.9, 0.6])) == []
    noise = np.random.default_rng(4).normal(size=200)
    assert told(replace(rows, target=np.column_stack([rows.target[:, :2], 3.0 * noise]))) == []


def test_a_turned_torque_is_told_with_its_joint(rows: SideRows) -> None:
    turned = replace(rows, target=rows.target * [1.0, -1.0, 1.0])
    (found,) = against_healthy({"motor": turned}, VALUES, NAMES)
    assert (found.channel, found.joint) == ("motor torque", 2)
    assert "looks like a reversed sign" in found.what
    # Turned and twice as large is a payload as well as a wrong sign; few rows tell nothing.
    assert told(replace(turned, target=rows.target * [1.0, -2.0, 1.0])) == []
    few = np.zeros_like(rows.valid)
    few[:39] = True
    assert told(replace(turned, valid=few)) == []


def test_interchanged_torques_are_told_with_both_joints(rows: SideRows) -> None:
    swapped = replace(rows, target=rows.target[:, [2, 1, 0]])
    assert told(swapped) == [("motor torque", 1), ("motor torque", 3)]
    words = [one.what for one in against_healthy({"joint": swapped}, VALUES, NAMES)]
    assert "healthy arm's torque of A3" in words[0]
    assert "healthy arm's torque of A1" in words[1]
    # A copy of another torque is no interchange.
    assert told(replace(rows, target=rows.target[:, [2, 1, 2]])) == []
