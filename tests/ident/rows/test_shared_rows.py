"""Rows two logs share: copies at other times and parts are known, another recording of the same motion is not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ident.rows.shared_rows import (
    SAME_ROWS,
    Cells,
    from_marks,
    marks,
    row_numbers,
    seen_before,
    shared,
)
from lwr_driver.session import Session
from tests.ident import estimation_arm as arm

SENSORS = arm.Sensors(position=2e-5, joint=0.03)
FIELDS = ("log_time", "publish_time", "sequence", "position", "velocity", "effort")


@pytest.fixture(scope="module")
def log() -> Session:
    return arm.session(seed=1, period_s=6.0, sensors=SENSORS)


def cut(session: Session, first: int, last: int) -> Session:
    """Rows `first` to `last` of the joint channel, a thousand seconds later."""
    columns = {name: getattr(session.joint, name)[first:last] for name in FIELDS}
    columns |= {name: columns[name] + 10**12 for name in ("log_time", "publish_time")}
    return replace(session, joint=replace(session.joint, **columns))


def test_a_copy_at_other_times_and_a_part_share_all_rows(log: Session) -> None:
    whole, count = row_numbers(log), len(log.joint)
    for first, last in ((0, count), (0, count // 5), (count // 2, count)):
        part = cut(log, first, last)
        assert shared(whole, row_numbers(part)) == 1.0
        # A part known by its marks, and marks of the whole held against a part.
        for one, other in ((log, part), (part, log)):
            known = from_marks(marks(one))
            assert len(known) == 64
            assert shared(known, row_numbers(other)) > 0.9
            assert seen_before(other, [np.zeros(0, dtype=np.uint64), known])


def test_another_recording_of_the_motion_shares_none(log: Session) -> None:
    again = arm.session(seed=2, period_s=6.0, sensors=SENSORS)
    assert shared(row_numbers(log), row_numbers(again)) == 0.0
    assert not seen_before(again, [from_marks(marks(log))])
    assert not seen_before(log, [])
    assert Cells(log).shared(log, again) == 0.0


def rounded(session: Session, digits: int) -> Session:
    """The session with positions and torques to some decimals."""
    joint = session.joint
    values = {name: np.round(getattr(joint, name), digits) for name in ("position", "effort")}
    return replace(session, joint=replace(joint, **values))


def test_a_copy_or_a_part_with_rounded_values_shares_most_rows(log: Session) -> None:
    for digits in (4, 6):
        copy = rounded(cut(log, 1000, 3000), digits)
        assert shared(row_numbers(log), row_numbers(copy)) < SAME_ROWS
        assert Cells(log).shared(log, copy) > 0.5
        assert Cells(copy).shared(copy, log) > 0.5


def test_marks_are_a_fair_sample(log: Session) -> None:
    """Half of the rows changed: about half of the marks are found."""
    effort = log.joint.effort.copy()
    effort[::2] += 1.0
    mixed = replace(log, joint=replace(log.joint, effort=effort))
    exact = shared(row_numbers(log), row_numbers(mixed))
    assert exact == pytest.approx(0.5, abs=0.01)
    assert shared(from_marks(marks(log)), row_numbers(mixed)) == pytest.approx(exact, abs=0.25)
    assert exact > SAME_ROWS


def test_other_texts_hold_no_marks() -> None:
    for text in ("", "no numbers", "f" * 17, "-1"):
        assert len(from_marks(text)) == 0
    assert shared(np.zeros(0, dtype=np.uint64), np.ones(1, dtype=np.uint64)) == 0.0
