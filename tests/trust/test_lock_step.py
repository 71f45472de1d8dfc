"""Lock step goes on, and repeats itself, whatever the computer does to it."""

from __future__ import annotations

import contextlib
import dataclasses
import signal
import subprocess
import sys
import threading
import time

import numpy as np
import pytest

from benchmarks.trust.relay import Relay
from benchmarks.trust.stand import the_arm
from lwr_driver.control import Control, Job, Mode, Result, Text, Word
from lwr_driver.loop import Loop, LoopSettings
from lwr_driver.motion import move_to
from sim_backend.configuration import load_configuration
from sim_backend.pendant import Pendant
from sim_backend.service import Service


class Ends:
    """Loop and emulator in threads, with a relay in between that loses what `lose` says."""

    def __init__(self, lose, **settings):
        arm = the_arm()
        self.control = Control.create(5000)
        self.words = self.control.words
        self.loop_settings = LoopSettings("127.0.0.1", 0, None, True, "stanford", 0.1, 0.2, arm.joint_names)
        self.loop = Loop(self.loop_settings, arm.limits, self.control)
        self.relay = Relay(self.loop.remote.address[1], lose)
        overrides = {"fri.period_ms": 5, "controller.settle_s": 0.2, **settings}
        config = load_configuration("emulator/default.yaml", overrides)
        self.service = Service(config, ("127.0.0.1", self.relay.port))
        self.threads = [
            threading.Thread(target=self.service.run, args=(True,)),
            threading.Thread(target=self.loop.run),
        ]

    def __enter__(self):
        self.relay.__enter__()
        for thread in self.threads:
            thread.start()
        return self

    def __exit__(self, *error):
        self.words[Word.QUIT] = 1
        self.service.stop()
        for thread in self.threads:
            thread.join()
        self.relay.__exit__()
        self.service.close()
        self.control.close()

    def do(self, job, a=0, b=0):
        self.control.post(job, a, b)
        deadline = time.monotonic() + 120.0
        while not self.control.done:
            assert time.monotonic() < deadline, f"{job.name} waits for ever"
            time.sleep(0.001)
        assert self.control.result is Result.DONE, self.control.text(Text.REASON)

    def session(self):
        self.do(Job.CYCLES, 30)
        self.do(Job.START)
        here = self.loop.remote.command["jnt_pos"].astype(float)
        motion = move_to(the_arm(), here, here + 0.2, 0.005, speed_scale=0.5)
        self.control.put_motion(motion.q, [])
        self.do(Job.MOTION, len(motion))
        self.do(Job.LEAVE)
        # The loop has answered its last packet; the emulator may still be on the cycle of that answer.
        with Pendant(self.service.pendant.port) as pendant:
            status, last = pendant.status(), None
            while last is None or status["cycle"] != last["cycle"]:
                time.sleep(0.1)
                last, status = status, pendant.status()
            return status


@pytest.fixture
def quick_to_remind(monkeypatch):
    monkeypatch.setattr("lwr_driver.loop._REMIND_S", 0.03)


def told(status):
    return status["cycle"], status["position"], status["joint_torque"], status["setpoint"]


def test_datagrams_lost_on_either_way_change_nothing(quick_to_remind):
    with Ends(lambda number, to_pc: False) as whole:
        expected = whole.session()
    random = np.random.default_rng(1)
    lost = set(random.choice(np.arange(5, 450), 12, replace=False).tolist())
    ways = set()

    def lose(number, to_pc):
        if number in lost:
            ways.add(to_pc)
        return number in lost

    with Ends(lose) as ends:
        found = ends.session()
        assert ends.relay.lost == len(lost)
        assert ways == {True, False}
        assert ends.loop.remote.lost == 0
    assert told(found) == told(expected)
    assert found["session"]["missed"] == 0


def test_driver_that_thinks_for_long_in_command_mode_is_waited_for(quick_to_remind):
    with Ends(lambda number, to_pc: False, **{"fri.patience_s": 0.2}) as ends:
        ends.do(Job.CYCLES, 30)
        ends.do(Job.START)
        # The emulator may still be on the cycle of the last answer.
        time.sleep(0.2)
        cycle = ends.service.cabinet.cycle
        thought = time.monotonic() + 0.7
        while time.monotonic() < thought:
            time.sleep(0.05)
        assert ends.service.cabinet.cycle == cycle
        ends.do(Job.CYCLES, 10)
        assert ends.loop.mode is Mode.HOLD
        ends.do(Job.LEAVE)


def test_driver_that_has_died_in_command_mode_is_not_waited_for(quick_to_remind):
    with Ends(lambda number, to_pc: False, **{"fri.patience_s": 0.2}) as ends:
        ends.do(Job.CYCLES, 30)
        ends.do(Job.START)
        ends.words[Word.QUIT] = 1
        ends.threads[1].join()
        deadline = time.monotonic() + 60.0
        while ends.service.cabinet.session.counters()["missed"] == 0:
            assert time.monotonic() < deadline
            time.sleep(0.01)


def test_driver_that_was_started_anew_finds_the_emulator_where_it_waits(quick_to_remind, monkeypatch):
    monkeypatch.setattr("sim_backend.service._RESEND_HEARD_S", 0.1)
    with Ends(lambda number, to_pc: False) as ends:
        ends.do(Job.CYCLES, 30)
        port = ends.loop.remote.address[1]
        ends.words[Word.QUIT] = 1
        ends.threads[1].join()
        ends.words[Word.QUIT] = 0
        settings = dataclasses.replace(ends.loop_settings, port=port)
        ends.loop = Loop(settings, the_arm().limits, ends.control)
        ends.threads[1] = threading.Thread(target=ends.loop.run)
        ends.threads[1].start()
        ends.do(Job.CYCLES, 30)
        ends.do(Job.START)
        ends.do(Job.LEAVE)


def test_emulator_that_follows_another_process_does_not_end_by_ctrl_c():
    command = [sys.executable, "-m", "sim_backend", "--lock-step", "--follow-stdin", "--announce"]
    process = subprocess.Popen(
        [*command, "--fri-port", "9"], stdin=subprocess.PIPE, stdout=subprocess.PIPE, start_new_session=True
    )
    try:
        assert process.stdout.readline()
        process.send_signal(signal.SIGINT)
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(0.3)
        assert process.poll() is None
        process.stdin.close()
        assert process.wait(60.0) == 0
    finally:
        process.kill()
        process.wait()
        process.stdout.close()
