"""Rows of the cycles: their content, the latency, the counters of the link."""

from __future__ import annotations

import numpy as np

from lwr_driver.control import BIN_NS, Mode, Word
from lwr_driver.ring import NO_PHASE, ROW, Ring
from tests.lwr_driver.driver_rig import START, in_motion


def test_rows_say_what_was_received_and_sent(rig):
    with Ring.create(4096) as ring:
        r = rig(ring=ring)
        motion = in_motion(r, 1)
        r.until_done()
        r.cycles(3)
        rows = ring.take()
        history = r.control.last_rows(50)
        r.loop.remote.close()
    assert len(rows) == r.control.words[Word.RECEIVED]
    assert np.array_equal(np.diff(rows["sequence"]), np.ones(len(rows) - 1))
    assert np.all(rows["answered"] == 1)
    assert np.array_equal(rows["t_recv"], rows["sequence"] * 1_000_000)
    sent = rows[rows["plan_index"] >= 0]
    assert np.array_equal(sent["plan_index"], np.arange(len(motion)))
    assert np.array_equal(sent["cmd"]["jnt_pos"], motion.q.astype(np.float32))
    assert np.all(sent["phase"] == 2)
    assert rows["phase"][0] == NO_PHASE
    assert rows["phase"][-1] == 0
    assert history.dtype == ROW
    assert np.array_equal(history["sequence"], rows["sequence"][-50:])


def test_same_run_gives_the_same_rows_to_the_last_bit(rig):
    def record() -> bytes:
        with Ring.create(4096) as ring:
            r = rig(ring=ring)
            in_motion(r, 200)
            r.stop()
            r.until_done()
            content = ring.take().tobytes()
            r.loop.remote.close()
            return content

    assert record() == record()


def test_counters_of_the_link_are_published(rig):
    r = rig()
    r.enter()
    words = r.control.words
    before = {
        name: int(words[Word[name]]) for name in ("RECEIVED", "ANSWERED", "LOST", "CYCLES", "MALFORMED")
    }
    r.cycle(lose_packet=True)
    r.cycles(4)
    r.end.send(b"x")
    r.cycle()
    after = {name: int(words[Word[name]]) for name in before}
    assert after["RECEIVED"] - before["RECEIVED"] == 5
    assert after["ANSWERED"] - before["ANSWERED"] == 5
    assert after["LOST"] - before["LOST"] == 1
    assert after["MALFORMED"] - before["MALFORMED"] == 1
    assert after["CYCLES"] - before["CYCLES"] == 5
    assert words[Word.MODE] == Mode.HOLD
    assert words[Word.INDEX] == -1


def test_latencies_are_counted_in_bins_of_the_time_from_packet_to_answer(rig):
    r = rig(lock_step=False)
    r.cycles(50)
    latency = r.control.latency
    latency[:] = 0
    received = r.loop.remote.received_ns
    for bins in (0.5, 3.2, 3.9, 1e9):
        r.loop._rows.write(True, received + int(bins * BIN_NS))
    r.loop._rows.write(False, received)
    assert latency[0] == 1
    assert latency[3] == 2
    assert latency[-1] == 1
    assert latency.sum() == 4
    assert r.control.words[Word.HEARD_NS] == received


def test_rows_without_an_answer_have_no_time_of_sending(rig):
    with Ring.create(128) as ring:
        r = rig(ring=ring, lock_step=False)
        r.cycles(50)
        received = r.loop.remote.received_ns
        r.loop._rows.write(True, received + 7)
        r.loop._rows.write(False, received + 7)
        rows = ring.take()[-2:]
        r.loop.remote.close()
    assert rows["t_recv"].tolist() == [received, received]
    assert rows["t_send"].tolist() == [received + 7, 0]
    assert rows["answered"].tolist() == [1, 0]
    np.testing.assert_array_equal(rows["msr"]["cmd_jnt_pos"], [START.astype(np.float32)] * 2)
