from __future__ import annotations

import numpy as np
import pytest

from fri.errors import ConfigurationError
from lwr_driver.control import BIN_NS, HISTORY, Control, Mode, Text, Word
from lwr_driver.link import snapshot
from lwr_driver.ring import ROW


@pytest.fixture
def control():
    memory = Control.create(100)
    yield memory
    memory.close()


def put_row(control: Control, sequence: int) -> None:
    row = np.zeros(1, dtype=ROW)
    row["sequence"] = sequence
    row["msr"]["msr_sample_time"] = 0.002
    row["msr"]["state"] = 2
    row["msr"]["msr_jnt_pos"] = np.arange(7) * 0.1
    row["msr"]["cmd_jnt_pos"] = 0.25
    row["msr"]["cmd_jnt_pos_fri_offset"] = 0.5
    cycles = int(control.words[Word.CYCLES])
    start = cycles % HISTORY * ROW.itemsize
    control.history_bytes[start : start + ROW.itemsize] = row.view(np.uint8).reshape(-1).data
    control.words[Word.CYCLES] = cycles + 1


def test_both_sides_see_the_same_memory(control):
    other = Control(control.descriptor, control.plan_rows)
    control.words[Word.STOP] = 7
    other.write_text(Text.REASON, "because")
    assert other.words[Word.STOP] == 7
    assert control.text(Text.REASON) == "because"


def test_texts_are_cut_and_replaced_whole(control):
    control.write_text(Text.NOTE, "x" * 5000)
    assert 1000 < len(control.text(Text.NOTE)) < 1100
    control.write_text(Text.NOTE, "gräßlich")
    assert control.text(Text.NOTE) == "gräßlich"
    control.write_text(Text.NOTE, "")
    assert control.text(Text.NOTE) == ""


def test_text_cut_within_a_letter_is_still_text(control):
    control.write_text(Text.NOTE, "ä" * 600)
    assert control.text(Text.NOTE).startswith("ää")


@pytest.mark.parametrize("written", [0, 1, 30, HISTORY, 3 * HISTORY + 5])
def test_last_rows_are_the_newest_in_order(control, written):
    for sequence in range(written):
        put_row(control, sequence)
    rows = control.last_rows(50)
    assert rows["sequence"].tolist() == list(range(max(0, written - 50), written))


def test_motion_and_phases_that_do_not_fit_are_refused(control):
    control.put_motion(np.ones((100, 7)), [(0, 2), (50, 3)])
    assert control.words[Word.PHASES] == 2
    assert control.phase_rows[1] == 50
    with pytest.raises(ConfigurationError, match="longest_motion_s"):
        control.put_motion(np.ones((101, 7)), [])
    with pytest.raises(ConfigurationError, match="phases"):
        control.put_motion(np.ones((100, 7)), [(0, 2)] * 5000)


def test_snapshot_before_the_first_packet_says_so(control):
    state = snapshot(control, 0, 0)
    assert (state.state, state.sequence, state.age_s) == ("OFF", -1, float("inf"))
    assert state.latency_s == {}
    assert "no packet yet" in state.summary


def test_snapshot_tells_the_last_packet(control):
    put_row(control, 41)
    put_row(control, 42)
    control.words[Word.MODE] = int(Mode.HOLD)
    control.words[Word.HEARD_NS] = 5_000_000_000
    control.latency[:] = 0
    control.latency[10] = 999
    control.latency[400] = 1
    state = snapshot(control, 7_000_000_000, 3)
    assert (state.state, state.mode, state.sequence, state.period_s) == ("CMD", "hold", 42, 0.002)
    assert state.age_s == pytest.approx(2.0)
    assert "no packet for 2.0 s" in state.summary
    assert np.allclose(state.q, np.arange(7) * 0.1)
    assert np.array_equal(state.setpoint, np.full(7, 0.75))
    assert state.overruns == 3
    assert state.latency_s == {q: pytest.approx(11 * BIN_NS * 1e-9) for q in (0.5, 0.99, 0.999)} | {
        1.0: pytest.approx(401 * BIN_NS * 1e-9)
    }


def test_closed_memory_can_be_closed_again():
    memory = Control.create(10)
    memory.close()
    memory.close()
