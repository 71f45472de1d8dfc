"""Blocks of held-out rows: windows of a session, the same on all sides."""

from __future__ import annotations

import numpy as np

from ident.diagnosis.gain.held_out import _blocks_of
from ident.diagnosis.rows.side_rows import SideRows


def rows(session: list[int], time: list[float]) -> SideRows:
    none = np.zeros((0, 0))
    return SideRows(none, none, none > 0.0, np.array(session), np.array(time), np.ones(len(time), dtype=bool))


def test_blocks_are_windows_of_a_session_with_one_number_on_all_sides() -> None:
    sides = {
        "motor": rows([0, 0, 0, 1], [0.2, 0.9, 1.1, 0.2]),
        "joint": rows([0, 1, 1], [1.9, 0.8, 7.0]),
    }
    blocks = _blocks_of(sides, 1.0)
    assert blocks["motor"].tolist() == [0, 0, 1, 2]
    assert blocks["joint"].tolist() == [1, 2, 3]
    assert _blocks_of(sides, 2.0)["motor"].tolist() == [0, 0, 0, 1]
