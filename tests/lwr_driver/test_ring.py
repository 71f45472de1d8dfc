from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule

from fri.errors import ConfigurationError
from fri.packets import CMD_SIZE, MSR_SIZE
from lwr_driver.ring import NO_PHASE, ROW, Ring


def test_rows_have_no_gaps():
    assert ROW.itemsize == sum(ROW[name].itemsize for name in ROW.names)
    assert ROW["msr"].itemsize == MSR_SIZE
    assert ROW["cmd"].itemsize == CMD_SIZE
    assert ROW.itemsize % 8 == 0


class RingAgainstQueue(RuleBasedStateMachine):
    """Any interleaving of writing, taking and releasing gives what a queue with a limit gives."""

    CAPACITY = 5

    def __init__(self) -> None:
        super().__init__()
        self.ring = Ring.create(self.CAPACITY)
        self.other = Ring.attach(self.ring.name)
        self.queue: list[int] = []
        self.dropped = 0
        self.number = 0
        self.released = 0

    @rule(count=st.integers(1, 7))
    def publish(self, count: int) -> None:
        for _ in range(count):
            self.number += 1
            self.ring.row["sequence"] = self.number
            self.ring.row["msr"]["msr_jnt_pos"] = self.number
            self.ring.row["cmd"]["krl_fill"] = self.number % 65536
            fits = len(self.queue) < self.CAPACITY
            assert self.ring.publish() == fits
            if fits:
                self.queue.append(self.number)
            else:
                self.dropped += 1

    @rule(limit=st.none() | st.integers(0, 8))
    def take(self, limit: int | None) -> None:
        upto = None if limit is None else self.released + limit
        rows = self.other.take(upto)
        wanted = self.queue if limit is None else self.queue[:limit]
        assert rows["sequence"].tolist() == wanted
        assert rows["msr"]["msr_jnt_pos"][:, 6].tolist() == wanted
        assert rows["cmd"]["krl_fill"].tolist() == wanted

    @precondition(lambda self: self.queue)
    @rule(data=st.data())
    def release(self, data: st.DataObject) -> None:
        count = data.draw(st.integers(1, len(self.queue)))
        self.other.release(count)
        del self.queue[:count]
        self.released += count

    @invariant()
    def counters_agree(self) -> None:
        assert self.ring.overruns == self.other.overruns == self.dropped
        assert self.ring.free == self.CAPACITY - len(self.queue)
        assert self.ring.head - self.other.tail == len(self.queue)

    def teardown(self) -> None:
        self.other.close()
        self.ring.unlink()


RingAgainstQueue.TestCase.settings = settings(max_examples=40, stateful_step_count=30, deadline=None)
TestRingAgainstQueue = RingAgainstQueue.TestCase


def test_taken_rows_are_copies():
    with Ring.create(4) as ring:
        ring.row["sequence"] = 7
        ring.publish()
        rows = ring.take()
        ring.release(1)
        for number in range(4):
            ring.row["sequence"] = number
            ring.publish()
        assert rows["sequence"].tolist() == [7]


def test_signs_of_life_pass_to_the_other_side():
    with Ring.create(4) as ring, Ring.attach(ring.name) as other:
        assert other.writer_pid == 0
        ring.start_writing()
        assert other.writer_pid == os.getpid()
        ring.beat(123_456)
        assert other.heartbeat_ns == 123_456
        ring.stop_writing()
        assert other.writer_pid == 0


def test_fresh_rows_belong_to_no_motion_and_no_phase():
    with Ring.create(4) as ring:
        assert ring.row["phase"][0] == NO_PHASE
        assert ring.row["plan_index"][0] == -1


def test_a_process_that_attaches_does_not_take_the_ring_with_it():
    with Ring.create(4) as ring:
        code = (
            "import sys; from lwr_driver.ring import Ring; r = Ring.attach(sys.argv[1]); "
            "r.row['sequence'] = 42; r.publish()"
        )
        done = subprocess.run(
            [sys.executable, "-c", code, ring.name], capture_output=True, text=True, check=True
        )
        assert done.stderr == ""
        assert ring.take()["sequence"].tolist() == [42]
        with Ring.attach(ring.name) as again:
            assert again.take()["sequence"].tolist() == [42]


def test_nothing_is_left_behind():
    ring = Ring.create(4)
    place = Path(ring.name)
    assert place.exists()
    ring.unlink()
    ring.unlink()
    assert not place.exists()
    with pytest.raises(ConfigurationError, match="cannot be opened"):
        Ring.attach(ring.name)


def test_other_memory_is_refused(tmp_path):
    other = tmp_path / "other"
    other.write_bytes(bytes(8192))
    with pytest.raises(ConfigurationError, match="is not a ring"):
        Ring.attach(str(other))


def test_a_killed_creator_leaves_nothing_and_takes_nothing_from_those_who_attached():
    code = (
        "import os, sys, time; from lwr_driver.ring import Ring; ring = Ring.create(4); "
        "ring.row['sequence'] = 9; ring.publish(); print(ring.name, flush=True); time.sleep(60)"
    )
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True) as creator:
        name = creator.stdout.readline().strip()
        before = set(os.listdir("/dev/shm"))
        with Ring.attach(name) as mine:
            creator.kill()
            creator.wait()
            assert mine.take()["sequence"].tolist() == [9]
        assert not Path(name).exists()
        assert not set(os.listdir("/dev/shm")) - before


def test_ring_of_one_row_is_refused():
    with pytest.raises(ConfigurationError, match="needs 2 at least"):
        Ring.create(1)


@pytest.mark.parametrize("batches", [(3, 4, 1, 5), (7, 2, 6)])
def test_rows_published_together_are_those_published_one_by_one(batches):
    with Ring.create(8) as single, Ring.create(8) as many:
        number = 0
        for batch in batches:
            rows = np.zeros(batch, dtype=ROW)
            rows["sequence"] = number + np.arange(batch)
            number += batch
            many.publish_rows(rows)
            for row in rows:
                single.row[0] = row
                assert single.publish()
            assert many.head == single.head
            assert many.take().tobytes() == single.take().tobytes() == rows.tobytes()
            for ring in (single, many):
                ring.release(batch)
