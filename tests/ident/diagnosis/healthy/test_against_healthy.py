"""Torques that contradict the healthy arm's: turned, and those of two joints interchanged."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ident.diagnosis.healthy.against_healthy import against_healthy
from ident.diagnosis.rows.side_rows import SideRows
from ident.screening.doubts import Doubt

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
    # Currents come with the constant of the other drive.
    constants = swapped.target * [1.7, 1.0, 1.0 / 1.7]
    assert told(replace(rows, target=constants)) == [("motor torque", 1), ("motor torque", 3)]
    # A copy of another torque is no interchange.
    assert told(replace(rows, target=rows.target[:, [2, 1, 2]])) == []


def test_a_gain_that_the_other_channels_say_too_is_told(rows: SideRows) -> None:
    """A payload scales the torque of a light joint alike, and is no broken channel."""
    twice = {"motor": replace(rows, target=rows.target * [1.0, 2.0, 1.0])}
    doubt = Doubt("motor torque", ("A2",), "is 1.8 times the others", "a gain of 1.8", "", kind="gain")
    assert against_healthy(twice, VALUES, NAMES) == ()
    (found,) = against_healthy(twice, VALUES, NAMES, [doubt])
    assert (found.channel, found.joint) == ("motor torque", 2)
    assert "is 2.09 times the healthy arm's torque" in found.what
    # Another joint, another kind, or a gain that the healthy arm does not show.
    for other in (
        replace(doubt, joints=("A1",)),
        replace(doubt, kind=""),
        replace(doubt, channel="position"),
    ):
        assert against_healthy(twice, VALUES, NAMES, [other]) == ()
    assert against_healthy({"motor": rows}, VALUES, NAMES, [doubt]) == ()
