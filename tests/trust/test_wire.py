"""A fixed part of the campaign on the wire, and the faults that it has found, each as a case of its own."""

from __future__ import annotations

import socket
import struct

import numpy as np
import pytest

from benchmarks.trust.reaction import CAUSES, measure
from benchmarks.trust.stand import Stand, the_motion
from benchmarks.trust.wire import FAULTS, PHASES, plan, run
from fri.controller_end import ControllerEnd
from fri.packets import Fault
from fri.states import State
from lwr_driver.control import Job, Mode, Result, Word
from lwr_driver.link import advise_command, advise_connect, silence_in_lock_step, snapshot
from lwr_driver.session import read_session

SEED = 1
BLOCK = 18


@pytest.fixture
def stand(ring, tmp_path):
    stands = []

    def make(**settings):
        stands.append(Stand(np.random.SeedSequence(3), ring, tmp_path, **settings))
        return stands[-1]

    yield make
    for each in stands:
        each.__exit__()


def in_motion(stand: Stand, rows: int) -> None:
    while not stand.loop.remote.received:
        stand.cycle()
    stand.post(Job.START, limit=700)
    assert stand.until_done(700)
    stand.start_motion(the_motion(stand.period_ms, 0))
    stand.until_done(rows)
    assert stand.loop.mode is Mode.MOTION


def spoil_once(stand: Stand, offset: int, layout: str, *values: float) -> None:
    """Change a field of the next packet only."""

    def alter(packet: bytes, number: int) -> bytes:
        stand.alter = None
        changed = bytearray(packet)
        struct.pack_into(layout, changed, offset, *values)
        return bytes(changed)

    stand.alter = alter


@pytest.mark.parametrize("first", range(0, 9 * BLOCK, BLOCK))
def test_runs_of_the_campaign_keep_every_promise(ring, tmp_path, first):
    for number in range(first, first + BLOCK):
        result = run(SEED, number, ring, tmp_path)
        assert not result.complaints, f"run {number} of seed {SEED}: {result}"


@pytest.mark.long
@pytest.mark.parametrize("first", range(1000, 3000, 100))
def test_more_runs_of_the_campaign(ring, tmp_path, first):
    for number in range(first, first + 100):
        assert not run(SEED, number, ring, tmp_path).complaints, number


def test_a_run_repeats_itself(ring, tmp_path):
    assert run(SEED, 7, ring, tmp_path) == run(SEED, 7, ring, tmp_path)


def test_every_fault_meets_every_phase():
    count = len(FAULTS) * len(PHASES)
    met = {(chosen.faults[0].name, chosen.phase) for chosen, _ in (plan(SEED, n) for n in range(count))}
    assert len(met) == count


@pytest.mark.parametrize(
    ("offset", "layout", "value"),
    [(184, "<H", 0x20), (180, "<H", 0), (144, "<H", 1), (182, "<H", 3), (152, "<f", 0.007)],
    ids=["error", "power", "state", "control", "sample time"],
)
def test_one_damaged_packet_that_would_end_command_mode_does_not_jerk_the_arm(stand, offset, layout, value):
    s = stand()
    in_motion(s, 60)
    spoil_once(s, offset, layout, value)
    assert s.until_done(400)
    assert s.result is Result.DONE
    assert not s.monitor.violations.any(), s.monitor.first_violation


def test_set_point_that_was_lost_in_motion_is_brought_to_rest_within_the_limits(stand):
    forgiving = {"bridged_cycles": 100_000, "hold_quality": 0}
    s = stand(period_ms=10, policy=forgiving)
    in_motion(s, 30)
    moving = s.session.setpoint
    s.silent = 12
    s.cycles(14)
    assert s.result is Result.NETWORK
    assert np.abs(s.session.setpoint - moving).max() > 0.01
    s.cycles(60)
    assert not s.monitor.violations.any(), s.monitor.first_violation
    rest = s.session.setpoint
    s.cycles(20)
    assert np.array_equal(s.session.setpoint, rest)


def test_damaged_set_point_is_not_taken_over_as_command_mode_begins(stand):
    s = stand()
    while not s.loop.remote.received:
        s.cycle()
    s.post(Job.START, limit=700)

    def alter(packet: bytes, number: int) -> bytes:
        if packet[144] != State.CMD:
            return packet
        s.alter = None
        changed = bytearray(packet)
        struct.pack_into("<f", changed, 292, 1.5)
        return bytes(changed)

    s.alter = alter
    s.until_done(100)
    s.cycles(5)
    assert not s.monitor.violations.any(), s.monitor.first_violation


def test_log_is_readable_after_the_controller_changed_its_cycle(stand):
    s = stand(period_ms=10)
    in_motion(s, 30)
    s.reopen(2)
    s.cycles(60)
    s.close_log("fail", "another cycle")
    joint = read_session(s.path).joint
    assert set(np.unique(np.diff(joint.publish_time)[-20:])) == {2_000_000}


def test_measurement_with_an_impossible_measuring_time_is_malformed(stand):
    s = stand()
    in_motion(s, 10)
    spoil_once(s, 148, "<f", -0.005)
    s.cycles(2)
    assert s.loop.remote.malformed_by[Fault.FIELD] == 1


def test_reason_tells_what_the_link_saw(stand):
    s = stand(lock_step=False)
    in_motion(s, 20)

    def alter(packet: bytes, number: int) -> bytes:
        changed = bytearray(packet)
        struct.pack_into("<H", changed, 6, 0x2007)
        return bytes(changed)

    s.alter = alter
    assert s.until_done(100)
    assert "malformed, most for its datagram id" in s.reason


def test_packets_of_another_version_are_told_before_any_good_one_came(stand):
    s = stand()
    s.alter = lambda packet, number: packet[:-4]
    s.post(Job.CYCLES, a=1)
    s.cycles(60)
    state = snapshot(s.control, s.clock.now_ns, 0)
    assert int(s.control.words[Word.MALFORMED]) > 20
    assert "not FRI 1.0" in advise_connect(state)
    assert "malformed" in silence_in_lock_step(state, 15.0)


def test_advice_names_the_stranger_who_was_taken_for_the_controller(stand):
    s = stand()
    s.beside = lambda packet, number: s.other("127.0.0.3").sendto(packet, s.end.remote)
    while not s.loop.remote.received:
        s.cycle()
    s.beside = None
    s.cycles(1000)
    assert "check `controller`" in advise_command(snapshot(s.control, s.clock.now_ns, 0))


def test_strangers_at_the_controllers_port_do_not_hide_the_answer():
    with ControllerEnd(("127.0.0.1", 9)) as end, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as pc:
        pc.bind(("127.0.0.1", 0))
        end.remote = pc.getsockname()
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
            stranger.bind(("127.0.0.3", 0))
            for _ in range(5):
                stranger.sendto(b"x", end.address)
        pc.sendto(b"answer", end.address)
        assert end.receive(0.0) == b"answer"
        assert end.foreign == 5


def test_burst_of_late_packets_is_no_restart(stand):
    s = stand()
    in_motion(s, 20)
    s.inject(kind="delay", direction="to_pc", length=20, cycles=12)
    s.cycles(60)
    assert s.loop.remote.restarts == 0
    assert s.loop.remote.reordered > 8


@pytest.mark.parametrize("cause", list(CAUSES))
def test_reaction_is_within_the_limits_and_told(ring, tmp_path, cause):
    found = measure(cause, 1, ring, tmp_path)
    assert not found["bad"]
    assert found["reason"]
    assert found["sent"] <= 4


@pytest.mark.parametrize("program", ["stanford", "ros_control", "lwr_identification"])
def test_command_mode_that_fell_back_unseen_is_asked_for_anew(stand, program):
    s = stand(program=program)
    while not s.loop.remote.received:
        s.cycle()
    s.post(Job.START, limit=2000)

    def deaf_in_command_mode(packet: bytes, number: int) -> bytes:
        return packet[:-4] if packet[144] == State.CMD else packet

    s.alter = deaf_in_command_mode
    while s.session.counters()["drops"] == 0:
        s.cycle()
    # Until the program, too, has noticed.
    s.silent = 30
    s.cycles(30)
    s.alter = None
    assert s.until_done(2000)
    assert s.result is Result.DONE


def test_command_mode_lost_while_it_begins_ends_the_waiting_with_the_cause(stand):
    s = stand()
    while not s.loop.remote.received:
        s.cycle()
    s.post(Job.START, limit=2000)
    while s.loop.mode is not Mode.HOLD:
        assert not s.done
        s.cycle()
    s.session.set_drives(0)
    assert s.until_done(5)
    assert s.result is Result.ROBOT
    assert "drives are off" in s.reason
