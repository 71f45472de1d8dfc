"""The loop against a controller's session over real sockets, one thread, no clock."""

from __future__ import annotations

import dataclasses
import time
from types import SimpleNamespace

import numpy as np
import pytest

from fri.states import ALL_DRIVES, Control, EventKind, Quality, State
from lwr_driver.control import Job, Mode, Result, Text, Word
from lwr_driver.loop import Loop
from lwr_driver.motion import move_to
from lwr_driver.ring import Ring
from tests.lwr_driver.driver_rig import START, Rig, arm, check_sent, hop, in_motion


def test_outside_command_mode_the_controllers_set_point_is_mirrored(rig):
    r = rig()
    r.cycles(50)
    assert r.mode is Mode.MIRROR
    assert np.array_equal(r.target, r.session.krl_setpoint)
    assert r.session.quality >= Quality.OK


@pytest.mark.parametrize("program", ["lwr_identification", "stanford", "ros_control"])
def test_command_mode_is_entered_and_left_with_each_handshake(rig, program):
    r = rig(program=program)
    r.enter()
    assert r.session.state is State.CMD
    assert r.mode is Mode.HOLD
    r.post(Job.LEAVE, limit=500)
    assert r.until_done() is Result.DONE
    assert r.session.state is State.MON
    assert r.session.last_event.kind is EventKind.STOPPED
    r.enter()


@pytest.mark.parametrize("period_ms", [1, 2, 5, 10])
def test_motion_arrives_row_by_row(rig, period_ms):
    r = rig(period_ms)
    motion = in_motion(r, 1)
    assert r.until_done() is Result.DONE
    rows = np.array(r.arrived.rows)
    first = len(rows) - len(motion)
    assert np.array_equal(rows[first:], motion.q.astype(np.float32).astype(float))
    assert r.mode is Mode.HOLD
    r.cycles(5)
    assert r.session.state is State.CMD
    assert np.array_equal(r.arrived.rows[-1], rows[-1])
    check_sent(r)


def test_an_arm_in_command_mode_holds_until_a_motion_is_asked_for(rig):
    r = rig()
    r.enter()
    target = r.target.copy()
    for _ in range(30):
        r.cycles(1)
        assert r.mode is Mode.HOLD
        np.testing.assert_array_equal(r.target, target)


def test_stop_request_stops_within_limits_and_the_session_goes_on(rig):
    r = rig()
    in_motion(r, 400)
    r.stop()
    assert r.until_done() is Result.ABORTED
    assert r.reason.startswith("stop requested at row 399")
    r.cycles(5)
    assert r.session.state is State.CMD
    assert r.control.words[Word.ROW] == 399
    check_sent(r)
    # And from there on to another motion.
    r.start(move_to(arm(), r.target, START, r.period_s))
    assert r.until_done() is Result.DONE
    check_sent(r)


def test_halt_stops_a_motion_too(rig):
    r = rig()
    in_motion(r, 300)
    r.post(Job.HALT)
    assert r.until_done() is Result.DONE
    assert r.mode is Mode.HOLD
    check_sent(r)


def test_stop_request_made_before_the_motion_began_is_not_lost_by_the_loop(rig):
    r = rig()
    r.enter()
    motion = hop(r)
    r.start(motion)
    r.stop()
    assert r.until_done() is Result.ABORTED
    assert np.allclose(r.arrived.rows[-1], motion.q[0], atol=1e-6)


def test_motion_without_command_mode_is_refused(rig):
    r = rig()
    r.cycles(20)
    r.start(hop(r))
    assert r.until_done() is Result.REFUSED
    assert "not in command mode" in r.reason
    assert np.array_equal(r.target, START.astype(np.float32))


def test_motion_that_begins_elsewhere_is_refused(rig):
    r = rig()
    r.enter()
    r.start(move_to(arm(), START + 0.001, START, r.period_s))
    assert r.until_done() is Result.REFUSED
    assert r.mode is Mode.HOLD
    assert len({row.tobytes() for row in r.arrived.rows}) == 1


def leave_by(cause: str, r: Rig) -> None:
    if cause == "drives":
        r.session.set_drives(0)
    elif cause == "error":
        r.session.set_drives(ALL_DRIVES, error=0b100)
    elif cause == "quality":
        r.session.quality_ceiling = Quality.UNACCEPTABLE
    elif cause == "drop":
        r.session.drop(EventKind.EXTERNAL, "emergency stop")
    elif cause == "krl":
        r.session.fri_stop()


@pytest.mark.parametrize(
    ("cause", "result", "words"),
    [
        ("drives", Result.ROBOT, "drives are off"),
        ("error", Result.ROBOT, "error 0x04"),
        ("quality", Result.NETWORK, "quality UNACCEPTABLE"),
        ("drop", Result.ROBOT, "controller left command mode: state MON"),
        ("krl", Result.ROBOT, "controller left command mode: state MON"),
    ],
)
def test_leaving_command_mode_ends_the_motion_for_good(rig, cause, result, words):
    r = rig()
    in_motion(r, 400)
    leave_by(cause, r)
    assert r.until_done(200) is result
    assert words in r.reason
    assert "at row" in r.reason
    assert r.control.text(Text.LEFT) == r.reason
    # Everything is well again and command mode comes back: the arm holds.
    r.session.set_drives(ALL_DRIVES)
    r.session.quality_ceiling = Quality.PERFECT
    r.cycles(300)
    assert r.mode is Mode.MIRROR
    r.enter()
    held = r.target
    r.cycles(100)
    assert r.mode is Mode.HOLD
    assert np.array_equal(r.target, held)
    check_sent(r)


def test_program_is_not_left_with_a_request_to_start_after_a_fallback(rig):
    r = rig()
    in_motion(r, 300)
    r.session.drop(EventKind.EXTERNAL, "emergency stop")
    r.cycles(1000)
    assert r.session.state is State.MON
    assert r.session.counters()["starts"] == 1


def test_program_that_another_client_left_started_is_started_anew(rig):
    r = rig()
    r.enter()
    r.session.drop(EventKind.EXTERNAL, "the client crashed")
    for _ in range(20):
        r.cycle(lose_packet=True)
    r.replace_loop()
    r.enter()
    assert r.mode is Mode.HOLD


def test_drive_error_ends_the_motion_even_if_the_controller_stays_in_command_mode(rig):
    r = rig()
    in_motion(r, 200)
    r.session.error = 0b10
    assert r.until_done(20) is Result.ROBOT
    assert "drives report an error" in r.reason
    assert r.mode is Mode.MIRROR


def test_controller_that_leaves_position_control_ends_the_motion(rig):
    r = rig()
    in_motion(r, 200)
    r.session.control = Control.JNT_IMP
    assert r.until_done(20) is Result.ROBOT
    assert "control JNT_IMP" in r.reason


def test_single_losses_are_bridged_and_the_motion_is_where_it_would_have_been(rig):
    r = rig()
    motion = in_motion(r, 100)
    first = r.cycle_number - 100
    while not r.done:
        r.cycle(lose_packet=r.cycle_number % 17 == 0, lose_answer=r.cycle_number % 23 == 0)
    assert r.result is Result.DONE, r.reason
    rows, number = np.array(r.arrived.rows), np.array(r.arrived.cycles) - first
    plan = motion.q.astype(np.float32)[np.clip(number, 0, len(motion) - 1)]
    assert np.array_equal(rows, plan.astype(float))
    assert r.control.words[Word.LOST] > 20
    check_sent(r)


@pytest.mark.parametrize("what", ["lose_packet", "lose_answer"])
def test_burst_of_losses_ends_command_mode_and_names_the_link(rig, what):
    r = rig()
    in_motion(r, 400)
    for _ in range(6):
        r.cycle(**{what: True})
    assert r.until_done(100) is Result.NETWORK
    assert "answers missed" in r.reason
    assert r.session.state is State.MON
    check_sent(r)


def test_long_gap_ends_the_motion_even_if_the_controller_went_on(rig):
    r = rig(policy={"bridged_cycles": 100_000, "hold_quality": Quality.UNACCEPTABLE})
    in_motion(r, 400)
    lost_at = r.cycle_number
    for _ in range(150):
        r.cycle(lose_packet=True)
    r.cycles(2)
    assert r.result is Result.NETWORK
    assert "150 packets in a row were lost" in r.reason
    r.cycles(30)
    # It holds where the controller has it, not where the motion would be, and asks for the end of command
    # mode.
    after = np.array(r.arrived.rows)[np.array(r.arrived.cycles) > lost_at]
    assert len(after) >= 1
    assert np.ptp(after, axis=0).max() == 0.0
    assert r.mode is Mode.MIRROR
    assert r.session.last_event.kind is EventKind.STOPPED


def test_what_a_controller_does_after_missing_answers_is_left_to_it_for_a_while(rig):
    r = rig(policy={"bridged_cycles": 100_000, "hold_quality": Quality.UNACCEPTABLE})
    in_motion(r, 400)
    r.cycle(lose_answer=True)
    r.loop._lose("the link is in doubt")
    answers = len(r.arrived.rows)
    r.cycles(10)
    assert len(r.arrived.rows) == answers
    # This one would go on for ever.
    r.cycles(3)
    assert r.mode is Mode.STOP
    steps = np.abs(np.diff(r.arrived.rows[answers:], axis=0)).max(axis=1)
    assert len(steps) >= 1
    assert steps[0] > 1e-5
    assert np.all(np.diff(steps) < 0.0)


def test_repeated_packets_are_answered_once(rig):
    r = rig()
    in_motion(r, 50)
    answered = int(r.control.words[Word.ANSWERED])
    for _ in range(100):
        r.cycle(copies=2)
    assert r.control.words[Word.ANSWERED] == answered + 100
    assert r.control.words[Word.REPEATED] >= 99
    check_sent(r)


def test_arm_that_is_held_is_given_up_on(rig):
    r = rig(tracking_limit_rad=0.05)
    in_motion(r, 100)
    r.displacement = np.array([0.0, 0.06, 0.0, 0.0, 0.0, 0.0, 0.0])
    assert r.until_done() is Result.ROBOT
    assert "A2 measured position is 0.0" in r.reason
    assert r.mode is Mode.HOLD
    check_sent(r)


def test_controller_that_starts_anew_ends_the_motion(rig):
    r = rig()
    in_motion(r, 300)
    old = r.session
    fresh = Rig(1, q=np.array(old.setpoint))
    try:
        r.timeout_s = 0.01
        r.session, r.interpreter = fresh.session, fresh.interpreter
        r.cycles(60)
        assert r.result is Result.NETWORK
        assert "started again" in r.reason
        assert r.mode is Mode.MIRROR
        assert r.control.words[Word.RESTARTS] == 1
    finally:
        fresh.close()


def test_dropped_link_answers_no_more(rig):
    r = rig()
    in_motion(r, 300)
    r.control.words[Word.DROP] = 1
    r.loop.cycle(0.0)
    arrived = len(r.arrived.rows)
    r.end.send(r.session.packet(r.sample))
    assert r.loop.cycle(5.0)
    assert r.end.receive(0.0) is None
    assert r.result is Result.ABORTED
    assert "dropped on request" in r.reason
    assert len(r.arrived.rows) == arrived
    assert r.mode is Mode.SILENT


def test_silence_of_the_controller_is_noticed_in_real_time(rig, monkeypatch):
    r = rig(lock_step=False)
    in_motion(r, 300)
    heard = r.loop.remote.received_ns * 1e-9
    monkeypatch.setattr("lwr_driver.loop.time.monotonic", lambda: heard + 0.09)
    assert not r.loop.cycle(0.0)
    assert r.mode is Mode.MOTION
    monkeypatch.setattr("lwr_driver.loop.time.monotonic", lambda: heard + 0.2)
    assert not r.loop.cycle(0.0)
    assert r.result is Result.NETWORK
    assert r.reason.startswith("no packet for 0.200 s, at row 299")
    assert r.mode is Mode.MIRROR


def test_request_that_waits_gives_up_after_its_cycles_and_withdraws(rig):
    r = rig()
    r.session.quality_ceiling = Quality.BAD
    r.post(Job.START, limit=300)
    assert r.until_done() is Result.TIMEOUT
    r.session.quality_ceiling = Quality.PERFECT
    r.cycles(500)
    assert r.session.state is State.MON


def test_drives_that_come_on_later_are_waited_for(rig):
    r = rig(policy={"drop_on_drives_off": False})
    r.session.set_drives(0)
    r.post(Job.START, limit=5000)
    r.cycles(500)
    assert r.session.state is State.CMD
    assert r.mode is Mode.MIRROR
    r.session.set_drives(ALL_DRIVES)
    assert r.until_done(50) is Result.DONE
    assert r.mode is Mode.HOLD


def test_quality_is_waited_for_without_interruption(rig):
    r = rig()
    r.post(Job.QUALITY, 60, int(Quality.OK))
    r.cycles(50)
    r.session.quality_ceiling = Quality.BAD
    r.cycles(1)
    r.session.quality_ceiling = Quality.PERFECT
    r.cycles(50)
    assert not r.done
    assert r.until_done(30) is Result.DONE


def test_means_are_exact(rig):
    r = rig()
    random = np.random.default_rng(5)
    q = START + 1e-3 * random.standard_normal((40, 7))
    tau = 20.0 + random.standard_normal((40, 7))
    r.cycles(30)
    r.post(Job.CYCLES, 40)
    for row_q, row_tau in zip(q, tau, strict=True):
        r.sample.msr_jnt_pos[:], r.sample.msr_jnt_trq[:] = row_q, row_tau
        r.cycle()
    assert r.result is Result.DONE
    q, tau = q.astype(np.float32).astype(float), tau.astype(np.float32).astype(float)
    measured = r.control.measured
    assert np.allclose(measured[0], q.mean(axis=0), rtol=0, atol=1e-12)
    assert np.allclose(measured[1], q.std(axis=0), rtol=1e-6)
    assert np.allclose(measured[2], tau.mean(axis=0), rtol=0, atol=1e-10)
    assert np.allclose(measured[3], tau.std(axis=0), rtol=1e-6)


def test_controllers_smaller_velocity_limit_is_obeyed(rig):
    r = rig()
    start = r.session.fri_start
    r.session.fri_start = lambda limits=1.0: start(0.3)  # type: ignore[method-assign]
    in_motion(r, 5)
    assert r.until_done() is Result.GUARD
    assert "velocity" in r.reason
    check_sent(r)
    rows = np.array(r.arrived.rows)
    assert np.abs(np.diff(rows, axis=0)).max() / 1e-3 <= 0.31 * arm().v_max.max()


@pytest.mark.parametrize("seed", range(30))
def test_random_faults_in_every_phase_never_lead_outside_the_limits(rig, seed):
    random = np.random.default_rng(seed)
    r = rig(int(random.choice([1, 2, 5])))
    r.enter()
    for _ in range(3):
        if r.mode is Mode.HOLD:
            r.start(hop(r) if random.random() < 0.5 else move_to(arm(), r.target, START, r.period_s))
        for _ in range(int(random.integers(50, 400))):
            chance = random.random()
            if chance < 0.01:
                r.stop()
            elif chance < 0.013:
                r.session.drop(EventKind.EXTERNAL, "chance")
            elif chance < 0.016:
                r.session.set_drives(0 if r.session.power else ALL_DRIVES)
            r.cycle(
                lose_packet=random.random() < 0.05,
                lose_answer=random.random() < 0.05,
                copies=2 if random.random() < 0.05 else 1,
            )
        r.session.set_drives(ALL_DRIVES)
        r.post(Job.HALT)
        r.until_done()
        r.post(Job.START, limit=3000)
        r.until_done()
        check_sent(r)


def test_a_reason_counts_the_irregular_packets_of_command_mode(rig):
    r = rig()
    in_motion(r, 100)
    for _ in range(3):
        r.cycle(lose_packet=True)
        r.cycles(5)
    assert r.loop._meanwhile() == " (packets in command mode: 3 lost)"
    for _ in range(2):
        r.end.send(b"nonsense")
        r.cycle()
    r.cycles(3)
    assert r.loop._meanwhile() == (" (packets in command mode: 3 lost, 2 malformed, most for its length)")
    r.session.drop(EventKind.EXTERNAL, "test")
    r.until_done(50)
    assert "3 lost, 2 malformed, most for its length" in r.reason


def test_a_quality_is_waited_for_a_whole_run_of_packets_at_least_so_good(rig):
    r = rig()
    r.cycles(60)
    for quality, count in ((Quality.OK, 7), (Quality.PERFECT, 7)):
        r.session.quality_ceiling = Quality.OK
        r.cycles(3)
        r.post(Job.QUALITY, count, int(quality))
        r.cycles(count - 1)
        assert not r.done
        r.cycle()
        assert r.done == (quality is Quality.OK)
    r.session.quality_ceiling = Quality.PERFECT
    assert r.until_done(20) is Result.DONE


def test_a_job_without_an_end_times_out_after_its_limit_of_cycles(rig):
    r = rig()
    r.session.quality_ceiling = Quality.BAD
    r.cycles(50)
    r.post(Job.QUALITY, 5, int(Quality.OK), limit=20)
    r.cycles(20)
    assert not r.done
    r.cycle()
    assert (r.done, r.result, r.reason) == (True, Result.TIMEOUT, "")


def test_silence_ends_a_measurement_too(rig, monkeypatch):
    r = rig(lock_step=False)
    r.cycles(50)
    r.post(Job.CYCLES, 100)
    r.cycles(3)
    heard = r.loop.remote.received_ns * 1e-9
    monkeypatch.setattr("lwr_driver.loop.time.monotonic", lambda: heard + 0.09)
    assert not r.loop.cycle(0.0)
    assert not r.done
    monkeypatch.setattr("lwr_driver.loop.time.monotonic", lambda: heard + 0.11)
    assert not r.loop.cycle(0.0)
    assert r.result is Result.NETWORK
    assert r.reason.startswith("no packet for 0.110 s")


def test_a_start_is_asked_for_only_after_the_program_has_taken_the_stop(rig, monkeypatch):
    r = rig()
    r.cycles(60)
    taken = False
    monkeypatch.setattr(r.loop._handshake, "stopped", lambda msr: taken)
    monkeypatch.setattr(r.loop._handshake, "fallen", lambda msr: False)
    r.post(Job.START, limit=2000)
    r.cycles(5)
    # The words of Stanford's program: 20 stops, 10 starts.
    assert int(r.loop.remote.command["krl_int"][15]) == 20
    assert r.session.state is State.MON
    taken = True
    r.cycle()
    assert int(r.loop.remote.command["krl_int"][15]) == 10
    taken = False
    assert r.until_done(200) is Result.DONE


@pytest.mark.parametrize("step", ["turn", "_serve"])
def test_in_lock_step_the_last_answer_is_repeated_after_a_second_of_silence(rig, monkeypatch, step):
    r, late = rig(), [0.0]
    clock = SimpleNamespace(
        monotonic=lambda: time.monotonic() + late[0], monotonic_ns=time.monotonic_ns, sleep=lambda _: None
    )
    monkeypatch.setattr("lwr_driver.loop.time", clock)

    def heard() -> bool:
        getattr(r.loop, step)()
        return r.end.receive(0.0) is not None

    r.enter()
    # At rest in command mode, without a request.
    assert not heard()
    late[0] += 1.1
    assert [heard(), heard()] == [True, False]
    # During a measurement; a packet that comes is answered, and nothing is repeated beside.
    r.post(Job.CYCLES, 5)
    late[0] = 0.0
    r.end.send(r.session.packet(r.sample))
    assert [heard(), heard()] == [True, False]
    r.session.close_cycle()
    late[0] = 3.0
    assert [heard(), heard()] == [True, False]


def test_in_lock_step_a_turn_tells_whether_a_packet_was_handled(rig):
    r = rig()
    r.cycles(50)
    assert not r.loop.turn()
    r.post(Job.CYCLES, 3)
    assert not r.loop.turn()
    for _ in range(3):
        r.end.send(r.session.packet(r.sample))
        assert r.loop.turn()
        r.session.receive(r.end.receive(0.0))
        r.session.close_cycle()
        assert not r.loop.turn()
    assert r.result is Result.DONE


def test_in_lock_step_a_full_ring_is_waited_for(rig, monkeypatch):
    with Ring.create(8) as ring:
        r, rows = rig(ring=ring), []
        r.loop.begin()
        for _ in range(50):
            r.cycles(1)
            ring.release(len(ring.take()))

        def sleep(_: float) -> None:
            rows.append(len(ring.take()))
            ring.release(rows[-1])

        clock = SimpleNamespace(monotonic=time.monotonic, monotonic_ns=time.monotonic_ns, sleep=sleep)
        monkeypatch.setattr("lwr_driver.loop.time", clock)
        r.post(Job.CYCLES, 20)
        for _ in range(20):
            r.end.send(r.session.packet(r.sample))
            assert r.loop.turn()
            r.session.receive(r.end.receive(0.0))
            r.session.close_cycle()
        assert sum(rows) + len(ring.take()) == 20
        ring.release(len(ring.take()))


def test_packets_that_stay_ahead_of_their_time_end_the_motion(rig):
    r = rig()
    in_motion(r, 100)
    r.loop.pace = pace = SimpleNamespace(
        feed=lambda *_, **__: 0, too_fast=False, hasty=False, reset=lambda *_: None
    )
    row = r.target.copy()
    r.cycles(1)
    assert r.mode is Mode.MOTION
    np.testing.assert_array_equal(r.target, row)
    pace.too_fast = True
    r.cycles(1)
    assert r.mode is Mode.STOP
    pace.feed = lambda counted, *_, **__: counted
    assert r.until_done() is Result.NETWORK
    assert "run ahead of time" in r.reason


def test_the_loop_turns_the_torques_to_the_direction_of_their_joints(rig) -> None:
    one = rig()
    one.loop.remote.close()
    sign = (1.0, -1.0, 1.0, 1.0, 1.0, 1.0, -1.0)
    one.settings = dataclasses.replace(one.settings, port=one.loop.remote.address[1], torque_sign=sign)
    one.loop = Loop(one.settings, one.arm.limits, one.control, network=one.network)
    one.sample.msr_jnt_trq[:] = np.arange(1.0, 8.0)
    one.cycles(30)
    assert one.loop.remote.msr["msr_jnt_trq"].tolist() == [1.0, -2.0, 3.0, 4.0, 5.0, 6.0, -7.0]


def test_the_next_packet_is_looked_out_for_before_it_is_due(rig) -> None:
    one = rig(2)
    one.cycles(30)
    asked: list[tuple[int, int, int]] = []
    never = SimpleNamespace(
        next=lambda more: False, wait=lambda *window: asked.append(window) or False, arrived=False
    )
    one.loop._make_ready = lambda turnaround: None
    assert not one.loop._look_out(never, 0.25)
    ((early, late, timeout),) = asked
    # The packet before came at a time past, so the next is due within a period.
    assert early < late < round(1e9 * (0.002 + 0.002))
    # From 40 % of the period before, to 0.15 ms after the packet is due.
    assert late - early == pytest.approx(800_000 + 150_000, abs=2)
    assert timeout == 250_000_000


def test_without_a_request_the_answer_made_ready_begins_no_motion(rig) -> None:
    one = rig()
    one.enter()
    asked: list[tuple[int, int]] = []
    one.loop._commander.foresee = lambda sequence, rows, most: asked.append((rows, most))
    one.loop._make_ready(SimpleNamespace(disarm=lambda: one.control.words, most=4))
    assert asked == [(0, 1)]


def test_a_motion_stops_within_the_limits_when_the_driver_gives_no_sign_of_life(rig):
    r = rig(lock_step=False)
    r.control.words[Word.BEAT_NS] = 2**62
    in_motion(r, 300)
    r.control.words[Word.BEAT_NS] = r.loop.remote.received_ns - 1_100_000_000
    assert r.until_done() is Result.ABORTED
    assert "no sign of life of the driver's process for 1.1 s at row " in r.reason
    assert r.mode is Mode.HOLD
    check_sent(r)


def test_lock_step_knows_no_sign_of_life(rig):
    r = rig()
    r.control.words[Word.BEAT_NS] = 1
    in_motion(r, 300)
    assert r.until_done() is Result.DONE
