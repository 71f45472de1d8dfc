"""A session of the controller: opening, quality, command mode, and what follows it."""

from __future__ import annotations

import struct

import numpy as np
import pytest

from fri.krc import EventKind, KrcPolicy, KrcSession, Sample
from fri.packets import MSR, new_msr
from fri.states import ALL_DRIVES, Control, Quality, State
from tests.fri.fri_rig import LIMITS, Q_START, QUICK, STEP, V_MAX, Rig, accelerate


def kinds(rig: Rig) -> list[EventKind]:
    return [event.kind for event in rig.session.events]


# --- opening, counters, quality --------------------------------------------------------------------------


def test_first_packet_is_in_monitor_mode_with_the_period_and_no_offset():
    rig = Rig(sample_time_ms=5).open()
    msr = rig.begin()
    assert (int(msr["state"]), int(msr["quality"]), int(msr["control"])) == (1, 0, 1)
    assert msr["msr_sample_time"] == msr["cmd_sample_time"] == np.float32(0.005)
    assert (int(msr["packet_size"]), int(msr["datagram_id"]), int(msr["power"])) == (916, 0x2006, ALL_DRIVES)
    assert msr["cmd_jnt_pos"].tolist() == np.float32(Q_START).tolist()
    assert not msr["cmd_jnt_pos_fri_offset"].any()
    assert msr["cmd_cart_pos_fri_offset"].tolist() == [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0]


def test_packets_count_up_and_wrap():
    session = KrcSession(LIMITS, Q_START, first_sequence=65_534)
    session.fri_open(1)
    found = []
    for _ in range(4):
        found.append(int(np.frombuffer(session.packet(Sample()), MSR)[0]["send_seq"]))
        session.close_cycle()
    assert found == [65_534, 65_535, 0, 1]


@pytest.mark.parametrize("first", [0, 1, 2, 65_535, 31_337])
def test_any_first_count_of_the_client_is_accepted_and_reflected(first):
    rig = Rig().open()
    rig.cmd["send_seq"] = (first - 1) & 0xFFFF
    rig.cycle()
    assert int(rig.begin()["refl_seq"]) == first


@pytest.mark.parametrize("sample_time_ms", [0, 101, -5])
def test_periods_outside_1_to_100_ms_are_refused(sample_time_ms):
    with pytest.raises(ValueError, match=r"1\.\.100"):
        Rig(sample_time_ms=sample_time_ms).open()


def test_quality_needs_a_full_window_and_sinks_with_missing_answers():
    rig = Rig(window=100, minimum_packets=100).open()
    rig.cycles(99)
    assert rig.session.quality is Quality.UNACCEPTABLE
    rig.cycle()
    assert rig.session.quality is Quality.PERFECT
    found = []
    for _ in range(21):
        rig.cycle(reply=False)
        found.append(rig.session.quality)
    assert found == [Quality.PERFECT] + [Quality.OK] * 4 + [Quality.BAD] * 15 + [Quality.UNACCEPTABLE]
    msr = rig.begin()
    assert msr["answer_rate"] == pytest.approx(0.79)
    assert msr["miss_rate"] == pytest.approx(0.21)
    assert int(msr["miss_counter"]) == 21


def test_latency_of_half_a_period_is_not_perfect():
    rig = Rig(sample_time_ms=2).open()
    for _ in range(20):
        rig.begin()
        rig.session.receive(rig.answer(), delay_s=0.0011)
        rig.session.close_cycle()
    assert rig.session.quality is Quality.OK
    assert rig.begin()["latency"] == pytest.approx(0.0011)


def test_late_answer_is_a_miss_and_shows_in_the_latency():
    rig = Rig().open()
    rig.begin()
    held_back = rig.answer()
    rig.session.close_cycle()
    rig.begin()
    assert rig.session.receive(held_back, delay_s=0.0002) is False
    assert rig.session.receive(rig.answer()) is True
    rig.session.close_cycle()
    assert rig.session.counters()["late"] == 1
    assert rig.session.miss_counter == 1
    assert rig.begin()["latency"] == pytest.approx((0.0012 + 0.0) / 2)


def test_first_valid_answer_of_a_cycle_counts():
    rig = Rig().command_mode()
    rig.begin()
    first, second = rig.answer(Q_START + 1e-4), rig.answer(Q_START + 5e-4)
    assert rig.session.receive(first) is True
    assert rig.session.receive(second) is False
    assert np.allclose(rig.session.close_cycle().position, Q_START + 1e-4, atol=1e-6)
    assert rig.session.counters()["duplicated"] == 1


def test_malformed_datagrams_in_monitor_mode_are_counted_only():
    rig = Rig().open()
    rig.begin()
    assert rig.session.receive(b"") is False
    assert rig.session.malformed_now
    assert rig.session.receive(rig.answer()) is True
    rig.session.close_cycle()
    assert rig.session.counters()["malformed"] == 1
    assert rig.session.state is State.MON


def test_cycle_order_is_enforced():
    rig = Rig()
    with pytest.raises(RuntimeError, match="not open"):
        rig.begin()
    rig.open()
    with pytest.raises(RuntimeError, match="packet"):
        rig.session.close_cycle()
    rig.begin()
    with pytest.raises(RuntimeError, match="not closed"):
        rig.begin()


# --- command mode ----------------------------------------------------------------------------------------


def test_start_waits_for_quality_and_dwell():
    rig = Rig(window=10, minimum_packets=10, start_dwell=5).open()
    rig.session.fri_start()
    states = [rig.cycle().state for _ in range(20)]
    assert states == [State.MON] * 14 + [State.CMD] * 6


def test_stop_withdraws_a_pending_start():
    rig = Rig().open()
    rig.session.fri_start()
    rig.session.fri_stop()
    assert rig.cycles(40).state is State.MON


def test_new_control_mode_starts_the_dwell_anew():
    rig = Rig(start_dwell=5).open()
    rig.cycles(30)
    rig.session.set_strategy(30)
    rig.session.fri_start()
    assert [rig.cycle().state for _ in range(8)] == [State.MON] * 5 + [State.CMD] * 3
    assert int(rig.cmd["cmd_flags"]) == 0x35


def test_krl_setpoint_stays_and_the_offset_is_what_fri_adds():
    rig = Rig().command_mode()
    accelerate(rig, 50, 0.5 * STEP)
    msr = rig.begin()
    assert msr["cmd_jnt_pos"].tolist() == np.float32(Q_START).tolist()
    assert np.allclose(msr["cmd_jnt_pos_fri_offset"], 25 * STEP, atol=1e-6)
    # The mirror is exactly what was commanded.
    assert rig.mirror().tolist() == rig.cmd["jnt_pos"].tolist()


def test_superposing_client_does_not_integrate():
    rig = Rig().command_mode()
    for k in range(1, 500):
        delta = 0.02 * (1.0 - np.cos(2 * np.pi * k / 200.0)) * np.ones(7)
        rig.begin()
        rig.session.receive(rig.answer(rig.msr["cmd_jnt_pos"] + delta))
        setpoint = rig.session.close_cycle()
        assert np.allclose(setpoint.position, Q_START + delta, atol=1e-6)
    assert rig.session.state is State.CMD


def test_superposing_client_adds_to_a_moving_krl_setpoint():
    rig = Rig().command_mode()
    for k in range(1, 300):
        rig.session.move_krl(Q_START + k * 0.2 * STEP)
        rig.begin()
        rig.session.receive(rig.answer(rig.msr["cmd_jnt_pos"] + 0.001 * np.sin(k / 20.0)))
        position = rig.session.close_cycle().position
        assert np.allclose(position, Q_START + k * 0.2 * STEP + 0.001 * np.sin(k / 20.0), atol=1e-6)
    assert rig.session.state is State.CMD


def test_absolute_client_is_followed_whatever_krl_does():
    rig = Rig().command_mode()
    for k in range(1, 100):
        rig.session.move_krl(Q_START - k * 0.2 * STEP)
        target = Q_START + k * 0.3 * STEP
        assert np.allclose(rig.cycle(target).position, target, atol=1e-6)


@pytest.mark.parametrize("sample_time_ms", [1, 2, 5, 12, 100])
def test_commands_are_interpolated_to_a_millisecond_and_reached_one_period_later(sample_time_ms):
    rig = Rig(sample_time_ms=sample_time_ms).command_mode()
    q = rig.session.setpoint
    last = q
    for k in range(1, 8):
        target = np.float32(Q_START + 0.4 * STEP * sample_time_ms * k).astype(float)
        positions = rig.cycle(target).positions
        assert positions.shape == (sample_time_ms, 7)
        expected = last + np.arange(1, sample_time_ms + 1)[:, None] / sample_time_ms * (target - last)
        assert np.allclose(positions, expected, atol=1e-12)
        last = target


def test_single_dropouts_are_bridged_along_the_line():
    rig = Rig(bridged_cycles=3).command_mode()
    q = accelerate(rig, 30, 0.5 * STEP)
    bridged = [rig.cycle(reply=False) for _ in range(3)]
    for k, setpoint in enumerate(bridged, 1):
        assert setpoint.state is State.CMD
        assert np.allclose(setpoint.position, q + k * 0.5 * STEP, atol=1e-6)
    back = rig.cycle(q + 4 * 0.5 * STEP)
    assert back.state is State.CMD
    assert [rig.cycle(reply=False).state for _ in range(3)] == [State.CMD] * 3


def test_offset_is_exact_after_a_bridge():
    rig = Rig().command_mode()
    accelerate(rig, 10, 0.5 * STEP)
    rig.cycle(reply=False)
    rig.begin()
    assert np.allclose(rig.mirror(), rig.session.setpoint, atol=1e-6)


def test_command_mode_with_the_drives_off_mirrors_and_does_not_move():
    rig = Rig().open()
    rig.session.set_drives(0)
    rig.cycles(20)
    rig.session.fri_start()
    assert rig.cycles(10).state is State.CMD
    rig.session.set_drives(ALL_DRIVES)
    assert np.allclose(rig.cycle().position, Q_START, atol=1e-6)
    assert accelerate(rig, 5, 0.1 * STEP) is not None
    assert rig.session.state is State.CMD


def test_additional_fields_are_ignored_without_their_flags():
    rig = Rig().command_mode()
    nonsense = {"add_jnt_trq": np.nan, "cart_pos": np.inf, "jnt_stiffness": np.nan}
    assert rig.cycle(None, **nonsense).state is State.CMD


def test_krl_variables_travel_both_ways():
    rig = Rig().open()
    rig.session.to_real[6] = 2.5
    rig.session.to_int[15] = -7
    rig.session.to_bool = 0x8001
    msr = rig.begin()
    assert (float(msr["krl_real"][6]), int(msr["krl_int"][15]), int(msr["krl_bool"])) == (2.5, -7, 0x8001)
    rig.cmd["krl_real"][0], rig.cmd["krl_int"][1], rig.cmd["krl_bool"] = -1.5, 123456, 0x0102
    rig.session.receive(rig.answer())
    session = rig.session
    assert (float(session.from_real[0]), int(session.from_int[1]), session.from_bool) == (
        -1.5,
        123456,
        0x0102,
    )


def test_statistics_and_requests_begin_anew_when_opened_again():
    rig = Rig().command_mode()
    rig.cmd["krl_int"][15] = 10
    rig.cycle()
    rig.session.fri_close()
    assert rig.session.state is State.OFF
    rig.session.fri_open(2)
    assert rig.session.from_int[15] == 0
    assert rig.session.quality is Quality.UNACCEPTABLE
    assert int(rig.begin()["miss_counter"]) == 0


# --- after command mode ----------------------------------------------------------------------------------


@pytest.mark.parametrize("sample_time_ms", [1, 5])
@pytest.mark.parametrize("how", ["stop", "misses", "velocity"])
def test_arm_is_braked_without_a_jump(sample_time_ms, how):
    rig = Rig(sample_time_ms=sample_time_ms, q=np.zeros(7)).command_mode()
    # Half speed, approached within the acceleration limits.
    speed = np.zeros(7)
    q = np.zeros(7)
    positions = []
    for _ in range(200 // sample_time_ms):
        speed = np.minimum(speed + LIMITS.a_max * sample_time_ms * 1e-3, 0.5 * V_MAX)
        q = q + speed * sample_time_ms * 1e-3
        positions.append(rig.cycle(q).positions)
    if how == "stop":
        rig.session.fri_stop()
    elif how == "misses":
        positions += [rig.cycle(reply=False).positions for _ in range(4)]
    else:
        positions.append(rig.cycle(q + 1.0).positions)
    assert rig.session.state is State.MON
    while rig.session.ramping:
        positions.append(rig.cycle().positions)
    track = np.vstack(positions)
    velocity = np.diff(track, axis=0) / 1e-3
    acceleration = np.diff(velocity, axis=0) / 1e-3
    start = 200 // sample_time_ms * sample_time_ms
    assert (np.abs(velocity) <= 0.5 * V_MAX + 1e-3).all()
    assert (np.abs(acceleration[start - 1 :]) <= LIMITS.a_max * 1.02 + 0.5).all()
    assert np.allclose(rig.cycle().positions, track[-1])
    assert np.allclose(rig.cycle().positions, track[-1])


def test_after_a_fallback_a_start_is_refused_until_krl_is_in_step_again():
    rig = Rig().command_mode()
    accelerate(rig, 20, 0.3 * STEP)
    rig.session.drop(EventKind.EXTERNAL, "test")
    rig.session.fri_start()
    assert rig.session.last_event.kind is EventKind.REFUSED
    with pytest.raises(RuntimeError, match="stop it first"):
        rig.session.resync()
    rig.cycles(400)
    assert not rig.session.ramping
    assert rig.begin()["cmd_jnt_pos_fri_offset"].any()
    rig.session.close_cycle()
    held = rig.session.setpoint
    rig.session.resync()
    assert np.allclose(rig.session.setpoint, held, atol=1e-6)
    assert not rig.begin()["cmd_jnt_pos_fri_offset"].any()
    rig.session.close_cycle()
    rig.session.fri_start()
    assert rig.cycles(20).state is State.CMD


def test_command_mode_is_never_entered_again_without_a_new_start():
    rig = Rig().command_mode()
    rig.session.drop(EventKind.EXTERNAL, "test")
    rig.cycles(400)
    rig.session.resync()
    assert rig.cycles(400).state is State.MON


def test_after_a_stop_the_offset_remains_and_a_start_goes_on_from_there():
    rig = Rig().command_mode()
    q = accelerate(rig, 20, 0.3 * STEP)
    rig.session.fri_stop()
    rig.cycles(100)
    assert not rig.session.needs_resync
    rig.session.fri_start()
    setpoint = rig.cycles(20)
    assert setpoint.state is State.CMD
    assert np.all(setpoint.position >= q - 1e-9)


def test_resync_to_a_measured_position():
    rig = Rig().open()
    rig.session.resync(Q_START + 0.1)
    assert np.allclose(rig.cycle().position, Q_START + 0.1, atol=1e-6)
    assert np.allclose(rig.msr["cmd_jnt_pos"], Q_START + 0.1, atol=1e-6)


def test_krl_moves_the_arm_in_monitor_mode():
    rig = Rig(sample_time_ms=4).open()
    rig.session.move_krl(Q_START + 0.004)
    positions = rig.cycle().positions
    assert np.allclose(positions, Q_START + 0.001 * np.arange(1, 5)[:, None], atol=1e-6)
    assert not rig.begin()["cmd_jnt_pos_fri_offset"].any()


def test_closing_a_moving_session_brakes_the_arm_while_off():
    rig = Rig().command_mode()
    accelerate(rig, 20, 0.3 * STEP)
    rig.session.fri_close()
    assert rig.session.ramping
    positions = np.vstack([rig.session.close_cycle().positions for _ in range(400)])
    assert not rig.session.ramping
    assert np.allclose(positions[-1], positions[-50])
    assert kinds(rig)[-2:] == [EventKind.STOPPED, EventKind.CLOSED]


def test_strategy_cannot_be_committed_in_command_mode():
    rig = Rig().command_mode()
    with pytest.raises(RuntimeError, match="strategy 30"):
        rig.session.set_strategy(30)
    assert rig.session.control is Control.POSITION


def test_same_calls_give_the_same_bytes():
    def run() -> bytes:
        rig = Rig(sample_time_ms=2)
        rng = np.random.default_rng(3)
        packets = []
        rig.open().session.fri_start()
        for _ in range(150):
            rig.sample.msr_jnt_pos[:] = rng.normal(size=7)
            rig.begin()
            packets.append(rig.msr.tobytes())
            if rng.random() < 0.9:
                rig.session.receive(rig.answer(rig.mirror() + np.float32(1e-4)), delay_s=rng.random() * 1e-3)
            packets.append(rig.session.close_cycle().positions.tobytes())
        return b"".join(packets)

    assert run() == run()


def test_sample_is_sent_as_it_is():
    rig = Rig().open()
    rng = np.random.default_rng(5)
    names = list(rig.sample.__dataclass_fields__)
    for name in names:
        values = getattr(rig.sample, name)
        values[...] = rng.normal(size=values.shape)
    msr = rig.begin()
    for name in names:
        assert msr[name].tolist() == np.asarray(getattr(rig.sample, name), MSR[name].base).tolist(), name


@pytest.mark.parametrize(("first", "style"), [(1, "absolute"), (2, "superposed"), (54_323, "superposed")])
@pytest.mark.parametrize("sample_time_ms", [1, 10, 100])
def test_clients_that_know_only_the_bytes(first, style, sample_time_ms):
    """A client written with `struct` alone: absolute from its own start, or on top of the KRL setpoint."""
    session = KrcSession(LIMITS, Q_START, KrcPolicy(**QUICK))
    session.fri_open(sample_time_ms)
    session.fri_start()
    start, moved = None, -1
    for k in range(80):
        packet = session.packet(Sample())
        sequence, _, size, identifier = struct.unpack_from("<4H", packet)
        assert (size, identifier, len(packet)) == (916, 0x2006, 916)
        state, quality = struct.unpack_from("<2H", packet, 144)
        (power,) = struct.unpack_from("<H", packet, 180)
        krl = struct.unpack_from("<7f", packet, 292)
        fri_offset = struct.unpack_from("<7f", packet, 320)
        q = [a + b for a, b in zip(krl, fri_offset, strict=True)]
        if state == 2 and power:
            start = start or q
            moved += 1
            base = krl if style == "superposed" else start
            q = [value + 1e-4 * sample_time_ms * moved for value in base]
        zeros = [0.0] * 51
        head = ((first + k) & 0xFFFF, sequence, 376, 0x1005)
        session.receive(struct.pack("<4H16f16i2HI58f", *head, *[0.0] * 16, *[0] * 16, 0, 0, 1, *q, *zeros))
        setpoint = session.close_cycle()
    assert quality == Quality.PERFECT
    assert moved > 50
    assert setpoint.state is State.CMD
    assert np.allclose(setpoint.position, Q_START + 1e-4 * sample_time_ms * moved, atol=1e-6)


def test_every_field_of_the_first_packet():
    rig = Rig(sample_time_ms=5)
    session = KrcSession(LIMITS, Q_START, KrcPolicy(**QUICK), uptime_s=12.5, first_sequence=40, power=0x3F)
    session.fri_open(5)
    expected = new_msr()
    values = {
        "send_seq": 40,
        "timestamp": np.float32(12.505),
        "state": 1,
        "msr_sample_time": np.float32(0.005),
        "cmd_sample_time": np.float32(0.005),
        "safety_limits": 1.0,
        "power": 0x3F,
        "control": 1,
        "cmd_jnt_pos": np.float32(Q_START),
        "cmd_cart_pos_fri_offset": [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0],
    }
    for name, value in values.items():
        expected[name] = value
    for name in Sample.__dataclass_fields__:
        expected[name] = getattr(rig.sample, name)
    found = np.frombuffer(session.packet(rig.sample), MSR)[0]
    for name in MSR.names:
        np.testing.assert_array_equal(found[name], expected[name], err_msg=name)
    assert session.timestamp_s == pytest.approx(12.505)
    assert {name for name, count in session.counters().items() if count} == {"packets"}
    assert session.counters()["packets"] == 1


def test_the_last_answer_can_be_read():
    rig = Rig().open()
    assert not rig.session.command.tobytes().strip(bytes(1))
    rig.begin()
    answer = rig.answer(np.linspace(-0.3, 0.3, 7))
    rig.session.receive(answer)
    assert rig.session.command.tobytes() == answer


@pytest.mark.parametrize("sample_time_ms", [1, 2, 10])
def test_a_late_answer_is_as_late_as_its_packets_are_old(sample_time_ms):
    rig = Rig(sample_time_ms).open()
    rig.begin()
    held_back = rig.answer()
    rig.session.close_cycle()
    for _ in range(2):
        rig.cycle(reply=False)
    rig.begin()
    assert rig.session.receive(held_back, delay_s=0.0002) is False
    rig.session.close_cycle()
    assert rig.begin()["latency"] == pytest.approx(3 * sample_time_ms * 1e-3 + 0.0002)


def test_an_answer_between_two_cycles_is_nobodys():
    rig = Rig().open()
    rig.begin()
    answer = rig.answer()
    rig.session.close_cycle()
    before = rig.session.counters()
    assert rig.session.receive(answer) is False
    assert rig.session.counters() == before


def test_the_clock_goes_on_while_the_session_is_closed():
    rig = Rig(sample_time_ms=4).open()
    rig.cycles(3)
    rig.session.fri_close()
    for _ in range(5):
        rig.session.close_cycle()
    assert rig.session.timestamp_s == pytest.approx(0.004 * 8)


@pytest.mark.parametrize("joint", [0, 3, 6])
@pytest.mark.parametrize("value", [0.0, 0.01, 10.0, np.nan, np.inf])
def test_commands_ahead_are_judged_as_single_ones(joint, value):
    rig = Rig().command_mode()
    accelerate(rig, 5, np.full(7, 1e-4))
    rows = rig.session.setpoint + np.arange(1, 9)[:, np.newaxis] * 1e-4
    rows = rows.astype(np.float32)
    rows[4, joint] += value
    judge = rig.session._judge
    passed = judge.pass_rows(rows.astype(float), rig.session.setpoint)
    assert passed == (4 if not value < 0.0001 else 8)
    held = rig.session.setpoint
    for number, row in enumerate(rows[: passed + 1]):
        rig.session._command.jnt_pos[:] = row
        objection = judge.position(row.tolist(), "commanded") or judge.velocity(rig.session._command, held)
        assert (objection is None) == (number < passed)
        held = row.astype(float)
