"""What both ends of the link and the policy of the controller begin with, and the ranges of their settings."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import fri.remote
from fri.errors import ConfigurationError
from fri.in_process import Network
from fri.judge import CommandJudge
from fri.krc import IDENTITY_POSE, KrcPolicy, KrcSession, Sample
from fri.packets import CMD_OFFSETS, CmdBuffer, MsrBuffer, new_cmd, new_msr
from fri.remote import DEFAULT_PORT, LinkEventKind, RemoteEnd
from fri.sequence import Arrival, SequenceTracker
from fri.states import CommandFlag, Control, EventKind, Quality, State
from tests.fri.fri_rig import LIMITS, Q_START, QUICK


def test_buffers_begin_without_a_packet() -> None:
    measured = MsrBuffer()
    names = (
        "send_seq",
        "refl_seq",
        "timestamp",
        "state",
        "quality",
        "sample_time",
        "power",
        "control",
        "error",
    )
    assert [getattr(measured, name) for name in names] == [0] * 9
    assert not any(measured.buffer)
    command = CmdBuffer()
    assert [getattr(command, name) for name in ("send_seq", "refl_seq", "krl_bool", "cmd_flags")] == [0] * 4
    assert not any(command.buffer)


def test_a_counter_begins_with_nothing_counted() -> None:
    tracker = SequenceTracker()
    assert (tracker.sequence, tracker.expected) == (-1, None)
    counts = ("lost", "repeated", "reordered", "suspect", "restarts")
    assert [getattr(tracker, name) for name in counts] == [0] * 5
    assert tracker.feed(7, 0.5, 0.001) is Arrival.NEW
    assert (tracker.sequence, tracker.expected) == (7, 8)
    assert [getattr(tracker, name) for name in counts] == [0] * 5


def remote(network: Network, **settings: Any) -> RemoteEnd:
    return RemoteEnd("127.0.0.1", 0, network=network, **settings)


def test_the_client_begins_without_a_controller_and_with_the_usual_springs() -> None:
    end = remote(Network())
    assert DEFAULT_PORT == 49938
    assert (end.controller, end.sequence, end.state, end.control) == (None, -1, State.OFF, Control.OTHER)
    assert (end.quality, end.power, end.error, end.timestamp_s, end.sample_time_s) == (0, 0, 0, 0.0, 0.0)
    assert (end.received_ns, end.commanding, end.foreseen, end.send_seq) == (0, False, None, 0)
    assert set(end.counters().values()) == {0}
    assert set(end.malformed_by.values()) == {0}
    assert (len(end.events), end.events.maxlen) == (0, 64)
    command = end.command
    assert command["jnt_stiffness"].tolist() == [1000.0] * 7
    assert command["jnt_damping"].tolist() == [np.float32(0.7)] * 7
    assert command["cart_stiffness"].tolist() == [1000.0] * 3 + [100.0] * 3
    assert command["cart_damping"].tolist() == [np.float32(0.7)] * 6
    assert not any(end.command[name].any() for name in ("jnt_pos", "add_jnt_trq", "krl_real", "krl_int"))


@pytest.mark.parametrize(("first", "sent"), [(1, 1), (65535, 65535), (65536, 0), (0, 0)])
def test_the_first_answer_has_the_counter_asked_for(first: int, sent: int) -> None:
    network = Network()
    end, port = remote(network, first_sequence=first), network.bind("127.0.0.1")
    measurement(port, end)
    end.answer()
    assert end.send_seq == sent
    assert int(np.frombuffer(port.recvfrom(2000)[0], "<u2")[0]) == sent


def measurement(port: Any, end: RemoteEnd, number: int = 1, **fields: Any) -> np.ndarray | None:
    """A measurement of the controller, received by the client."""
    record = new_msr()
    record["send_seq"], record["timestamp"] = number, number * 0.001
    record["state"], record["control"] = State.MON, Control.POSITION
    record["msr_sample_time"] = record["cmd_sample_time"] = 0.001
    for name, value in fields.items():
        record[name] = value
    port.sendto(record.tobytes(), end.address)
    return end.receive(0.0)


@pytest.mark.parametrize(("port", "taken"), [(-1, False), (0, True), (65535, True), (65536, False)])
def test_a_port_has_sixteen_bits(port: int, taken: bool) -> None:
    network = Network()
    if taken:
        assert RemoteEnd("127.0.0.1", port, network=network).address[1] == (port or 49152)
    else:
        with pytest.raises(ConfigurationError, match=rf"port {port} is outside 0\.\.65535"):
            RemoteEnd("127.0.0.1", port, network=network)


def test_bits_for_krl_are_set_and_cleared_one_by_one() -> None:
    end = remote(Network())
    for index in (0, 3, 15):
        end.set_krl_bool(index, True)
    end.set_krl_bool(3, False)
    assert int(end.command["krl_bool"]) == 0x8001
    for index in (-1, 16):
        with pytest.raises(ValueError, match=r"outside 0\.\.15"):
            end.set_krl_bool(index, True)


def test_sixteen_strangers_are_named_and_the_others_counted() -> None:
    network = Network()
    end = remote(network, controller="127.0.0.2")
    for host in range(3, 23):
        port = network.bind(f"127.0.0.{host}")
        for _ in range(2):
            measurement(port, end)
    assert end.foreign == 40
    assert [event.kind for event in end.events] == [LinkEventKind.FOREIGN] * 16
    assert "the controller is 127.0.0.2" in end.events[0].text


def test_waiting_datagrams_are_dropped_and_counted() -> None:
    network = Network()
    end, port = remote(network), network.bind("127.0.0.1")
    assert (end.drain(), end.pending()) == (0, False)
    for _ in range(3):
        port.sendto(b"stale", end.address)
    assert end.pending()
    assert (end.drain(), end.pending()) == (3, False)


def test_a_datagram_taken_elsewhere_is_judged_like_a_received_one() -> None:
    network = Network()
    end, port = remote(network), network.bind("127.0.0.1")
    measurement(port, end)
    record = new_msr()
    record["send_seq"], record["timestamp"], record["state"], record["control"] = 2, 0.002, 1, 1
    record["msr_sample_time"] = record["cmd_sample_time"] = 0.001
    end.buffer[: record.nbytes] = record.tobytes()
    source = port.getsockname()
    assert end.receive(0.0, (record.nbytes, source, 123_456)) is not None
    assert (end.sequence, end.received_ns, end.received) == (2, 123_456, 2)


def test_an_answer_without_torque_takes_the_torque_back() -> None:
    network = Network()
    end, port = remote(network), network.bind("127.0.0.1")
    measurement(port, end, control=Control.JNT_IMP)
    end.answer()
    for number, torque in ((2, np.full(7, 3.0)), (3, None)):
        measurement(port, end, number, state=State.CMD, power=0x7F, control=Control.JNT_IMP)
        assert end.answer(np.zeros(7), torque)
        assert end.command["add_jnt_trq"].tolist() == ([3.0] * 7 if torque is not None else [0.0] * 7)


def test_an_answer_with_torque_is_not_foreseen_and_one_without_is_again() -> None:
    network = Network()
    end, port = remote(network), network.bind("127.0.0.1")
    measurement(port, end)
    end.answer()
    assert end.foreseen == 2
    for number, torque, foreseen in ((2, np.zeros(7), None), (3, None, 4)):
        measurement(port, end, number, state=State.CMD, power=0x7F)
        end.answer(np.zeros(7), torque)
        assert end.foreseen == foreseen
    out = bytearray(376)
    q = np.arange(7, dtype=np.float32)
    end.foresee(q, memoryview(out), ahead=5)
    place = CMD_OFFSETS["jnt_pos"]
    assert out[place : place + 28] == q.tobytes()
    assert np.frombuffer(out, "<u2", 2).tolist() == [end.send_seq + 6, 9]


@pytest.mark.parametrize("restart", [False, True])
def test_a_restart_clears_the_requests_to_the_last_run(restart: bool) -> None:
    network = Network()
    end, port = remote(network), network.bind("127.0.0.1")
    for number in range(100, 110):
        measurement(port, end, number)
        end.answer()
    end.krl_real[3], end.krl_int[15] = 1.0, 7
    end.set_krl_bool(2, True)
    number = 1 if restart else 110
    measurement(port, end, number, timestamp=0.001 if restart else 0.11)
    if restart:
        # Told by the clock that began anew, confirmed by the next packet.
        for number in range(2, 60):
            measurement(port, end, number, timestamp=number * 0.001)
    kept = (float(end.krl_real[3]), int(end.krl_int[15]), int(end.command["krl_bool"]))
    assert kept == ((0.0, 0, 0) if restart else (1.0, 7, 4))
    assert end.restarts == int(restart)


@pytest.mark.parametrize("sign", [[1, 1, 1, 1, 1, 1, -2], [1] * 6, [0] * 7])
def test_a_torque_sign_is_plus_or_minus_one_for_each_joint(sign: list[int]) -> None:
    with pytest.raises(ConfigurationError, match="must be"):
        remote(Network()).set_torque_sign(sign)


@pytest.mark.parametrize("turned", [None, 1, 7])
def test_torques_have_the_sign_of_their_sensors(turned: int | None) -> None:
    network = Network()
    end, port = remote(network), network.bind("127.0.0.1")
    sign = np.where(np.arange(1, 8) == turned, -1.0, 1.0)
    end.set_torque_sign(sign)
    torque = np.arange(1.0, 8.0)
    measurement(port, end, msr_jnt_trq=torque, est_ext_jnt_trq=2.0 * torque)
    assert end.msr["msr_jnt_trq"].tolist() == (sign * torque).tolist()
    assert end.msr["est_ext_jnt_trq"].tolist() == (2.0 * sign * torque).tolist()


# -- the controller ------------------------------------------------------------------------------------------

# Default, low end, high end; a low or high end in brackets is not included.
SETTINGS: dict[str, tuple[Any, Any, Any]] = {
    "window": (100, 2, 100_000),
    "minimum_packets": (100, 1, 100),
    "perfect_rate": (0.99, 0.95, 1.0),
    "ok_rate": (0.95, 0.80, 0.99),
    "bad_rate": (0.80, 0.0, 0.95),
    "perfect_latency": (0.5, [0.0], 1000.0),
    "start_dwell": (100, 0, 100_000),
    "bridged_cycles": (3, 0, 100_000),
    "mirror_tolerance": (1e-3, [0.0], 1.0),
    "mirror_speed": (0.1, [0.0], 10.0),
    "soft_mirror_tolerance": (0.1, [0.0], 3.0),
    "largest_stiffness": (5000.0, [0.0], 1e6),
    "largest_damping": (1.0, [0.0], 10.0),
    "limit_tolerance": (1e-6, 0.0, [1e-3]),
    "t1_velocity_factor": (0.25, [0.0], 1000.0),
    "acceleration_factor": (None, [0.0], 1000.0),
    "stop_acceleration_factor": (1.0, [0.0], 1000.0),
    "stop_jerk_time_s": (0.02, [0.0], 10.0),
}


def test_the_policy_begins_with_its_documented_thresholds() -> None:
    policy = KrcPolicy()
    assert {name: getattr(policy, name) for name in SETTINGS} == {
        name: default for name, (default, *_) in SETTINGS.items()
    }
    assert (policy.start_quality, policy.hold_quality) == (Quality.OK, Quality.BAD)
    assert policy.drop_on_malformed
    assert policy.drop_on_drives_off


@pytest.mark.parametrize("name", sorted(SETTINGS))
def test_a_threshold_has_its_range(name: str) -> None:
    default, *ends = SETTINGS[name]
    whole = isinstance(default, int)
    for end, out in zip(ends, (-1.0, 1.0), strict=True):
        value = end[0] if isinstance(end, list) else end
        beyond = value + int(out) if whole else value + 1e-9 * out * max(abs(value), 1.0)
        changes = {"minimum_packets": 1} if name == "window" else {}
        policy = replace(KrcPolicy(), **changes)
        if isinstance(end, list):
            with pytest.raises(ConfigurationError, match=name):
                replace(policy, **{name: value})
        else:
            assert getattr(replace(policy, **{name: value}), name) == value
            with pytest.raises(ConfigurationError, match=name):
                replace(policy, **{name: beyond})


@pytest.mark.parametrize("name", ["q_min", "q_max", "v_max", "a_max"])
@pytest.mark.parametrize("bad", [np.zeros(6), np.full(7, np.nan), np.full((1, 7), 1.0)])
def test_limits_are_seven_finite_numbers(name: str, bad: np.ndarray) -> None:
    with pytest.raises(ConfigurationError, match=f"{name} is"):
        replace(LIMITS, **{name: bad})


@pytest.mark.parametrize("joint", [0, 6])
def test_limits_leave_a_range_and_a_speed_to_each_joint(joint: int) -> None:
    def changed(values: np.ndarray, value: float) -> np.ndarray:
        made = np.array(values)
        made[joint] = value
        return made

    with pytest.raises(ConfigurationError, match="is not below q_max"):
        replace(LIMITS, q_min=changed(LIMITS.q_min, LIMITS.q_max[joint]))
    for name in ("v_max", "a_max"):
        for value in (0.0, -1.0):
            with pytest.raises(ConfigurationError, match="must be positive"):
                replace(LIMITS, **{name: changed(getattr(LIMITS, name), value)})
    with pytest.raises(ValueError, match="read-only"):
        LIMITS.q_min[0] = 0.0


def test_the_controller_begins_off_at_rest_with_the_identity_for_poses() -> None:
    assert np.array(IDENTITY_POSE).reshape(3, 4).tolist() == np.eye(3, 4).tolist()
    session = KrcSession(LIMITS, Q_START, KrcPolicy(**QUICK))
    assert (session.state, session.quality) == (State.OFF, Quality.UNACCEPTABLE)
    np.testing.assert_allclose(session.setpoint, Q_START, atol=1e-7)
    assert not session.ramping
    assert set(session.counters().values()) == {0}
    session.fri_open(2)
    packet = session.packet(Sample())
    assert len(packet) == 916


@pytest.mark.parametrize(("factor", "taken"), [(0.0, False), (1e-3, True), (1.0, True), (1.0001, False)])
def test_the_limit_factor_of_a_start_is_a_share(factor: float, taken: bool) -> None:
    session = KrcSession(LIMITS, Q_START, KrcPolicy(**QUICK))
    session.fri_open(1)
    if taken:
        session.fri_start(factor)
    else:
        with pytest.raises(ValueError, match="1"):
            session.fri_start(factor)


# -- the judge -----------------------------------------------------------------------------------------------


def command(**fields: Any) -> CmdBuffer:
    record = new_cmd()
    for name, value in fields.items():
        record[name] = value
    buffer = CmdBuffer()
    assert buffer.load(record.tobytes()) is None
    return buffer


def judge(**policy: Any) -> CommandJudge:
    made = CommandJudge(LIMITS, KrcPolicy(**policy))
    made.tighten(0.002, 1.0, False)
    return made


@pytest.mark.parametrize(
    ("field", "flag", "largest"),
    [("jnt_stiffness", CommandFlag.JNTSTIFF, 5000.0), ("jnt_damping", CommandFlag.JNTDAMP, 1.0)],
)
def test_springs_beyond_their_bounds_are_named_with_the_worst_joint(
    field: str, flag: CommandFlag, largest: float
) -> None:
    usual = np.full(7, 0.5 * largest)
    for joint, value in ((0, 1.01 * largest), (2, -0.01 * largest), (6, -2.0 * largest)):
        values = usual.copy()
        values[joint] = value
        found = judge().springs(command(cmd_flags=int(flag), **{field: values}))
        assert found is not None
        assert found[0] is EventKind.IMPEDANCE
        assert found[1].startswith(("A1", "A2", "E1", "A3", "A4", "A5", "A6")[joint])
        assert judge().springs(command(cmd_flags=0, **{field: values})) is None
    for value in (0.0, largest):
        assert judge().springs(command(cmd_flags=int(flag), **{field: np.full(7, value)})) is None


def test_a_step_may_be_as_long_as_the_speed_allows() -> None:
    start = np.zeros(7)
    for joint in range(7):
        for sign in (-1.0, 1.0):
            for share, kept in ((0.999, True), (1.001, False)):
                q = np.zeros(7)
                q[joint] = sign * share * LIMITS.v_max[joint] * 0.002
                found = judge(limit_tolerance=0.0).velocity(command(jnt_pos=q), start)
                assert (found is None) == kept
                if found is not None:
                    speed = share * LIMITS.v_max[joint]
                    assert f"{speed:.4f} rad/s exceeds {LIMITS.v_max[joint]:.4f} rad/s" in found[1]


@pytest.mark.parametrize(
    ("limits", "t1", "factor"), [(0.5, False, 0.5), (1.0, True, 0.25), (0.5, True, 0.125)]
)
def test_a_start_with_smaller_limits_and_t1_shorten_the_steps(limits: float, t1: bool, factor: float) -> None:
    made = judge(limit_tolerance=0.0)
    made.tighten(0.002, limits, t1)
    for share, kept in ((0.999, True), (1.001, False)):
        q = share * factor * LIMITS.v_max * 0.002
        assert (made.velocity(command(jnt_pos=q), np.zeros(7)) is None) == kept
    found = made.velocity(command(jnt_pos=np.ones(7)), np.zeros(7))
    assert found is not None
    assert f"limit factor {limits:.2f}{' in T1' if t1 else ''}" in found[1]


@pytest.mark.parametrize("cycles", [1.0, 2.0])
def test_a_change_of_the_step_may_be_as_large_as_the_acceleration_allows(cycles: float) -> None:
    assert judge().acceleration(np.full(7, 1.0), cycles) is None
    made = judge(acceleration_factor=0.5, limit_tolerance=0.0)
    allowed = 0.5 * LIMITS.a_max * 0.002**2 * cycles
    assert made.acceleration(0.999 * allowed, cycles) is None
    worst = 0.9 * allowed
    worst[4] = -1.5 * allowed[4]
    found = made.acceleration(worst, cycles)
    assert found is not None
    assert found[0] is EventKind.ACCELERATION
    most = 0.5 * LIMITS.a_max[4]
    assert found[1].startswith(f"A4 commanded acceleration {1.5 * most:.2f} rad/s^2 exceeds {most:.2f}")


@pytest.mark.parametrize(
    ("settings", "soft", "most"),
    [
        ({"mirror_tolerance": 1e-3, "mirror_speed": 0.1}, False, 1e-3),
        ({"mirror_tolerance": 1e-4, "mirror_speed": 0.1}, False, 2e-4),
        ({"soft_mirror_tolerance": 0.05}, True, 0.05),
    ],
)
def test_the_first_command_is_within_reach_of_the_mirror(settings: dict, soft: bool, most: float) -> None:
    target = np.zeros(7)
    for share, kept in ((0.99, True), (1.01, False)):
        for sign in (1.0, -1.0):
            q = np.zeros(7)
            q[5] = sign * share * most
            found = judge(**settings).mirror(command(jnt_pos=q), target, "first command", soft=soft)
            assert (found is None) == kept
    assert found is not None
    assert f"A5 of first command is {1.01 * most:.5f} rad from the mirror, at most {most:g} rad" in found[1]


def test_positions_end_at_the_limits() -> None:
    made = judge(limit_tolerance=1e-4)
    for limit, out in ((LIMITS.q_min, -1.0), (LIMITS.q_max, 1.0)):
        for joint in (0, 6):
            q = np.zeros(7)
            q[joint] = limit[joint] + out * 0.9e-4
            assert made.position(q.tolist(), "commanded") is None
            q[joint] = limit[joint] + out * 1.1e-4
            found = made.position(q.tolist(), "commanded")
            assert found is not None
            assert found[0] is EventKind.POSITION
    q[joint] = np.inf
    found = made.position(q.tolist(), "commanded")
    assert found is not None
    assert found[0] is EventKind.NOT_FINITE


def test_a_silence_of_the_network_takes_no_time_from_the_caller() -> None:
    assert 0.0 < fri.remote._SHORTEST_FLOOD_S < fri.remote._LONGEST_DRAIN_S < fri.remote._PORT_GRACE_S
