from __future__ import annotations

import socket
from collections.abc import Iterator

import numpy as np
import pytest

import fri.remote
from fri.errors import ConfigurationError, NetworkError
from fri.packets import CMD, CMD_SIZE, MSR_SIZE, Fault, new_msr
from fri.remote import LinkEventKind, RemoteEnd
from fri.states import Control, State

# Long enough for loopback on a loaded machine, and never waited for in full by a passing test.
PATIENCE_S = 5.0
# For what is not handed on: a loaded machine delivers on loopback a little late.
BRIEF_S = 0.1


class Controller:
    """A bare socket that sends measurements and reads answers."""

    def __init__(self, end: RemoteEnd, host: str = "127.0.0.1") -> None:
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.bind((host, 0))
        self.socket.settimeout(PATIENCE_S)
        self.to = end.address
        self.msr = new_msr()
        self.msr["state"], self.msr["control"], self.msr["power"] = State.MON, Control.POSITION, 0x7F
        self.msr["msr_sample_time"] = self.msr["cmd_sample_time"] = 0.001
        self.msr["cmd_jnt_pos"] = np.arange(7) * 0.1
        self.number = 99

    def send(self, step: int = 1, **fields: object) -> None:
        self.number += step
        self.msr["send_seq"] = self.number & 0xFFFF
        self.msr["timestamp"] = self.number * 0.001
        for name, value in fields.items():
            self.msr[name] = value
        self.socket.sendto(self.msr.tobytes(), self.to)

    def again(self) -> None:
        self.socket.sendto(self.msr.tobytes(), self.to)

    def raw(self, datagram: bytes) -> None:
        self.socket.sendto(datagram, self.to)

    def answer(self) -> np.ndarray:
        datagram = self.socket.recv(2048)
        assert len(datagram) == CMD_SIZE
        return np.frombuffer(datagram, CMD)[0]

    def silent(self) -> bool:
        """Whether nothing has come back. Loopback delivers before `sendto` returns, so nothing is awaited."""
        self.socket.setblocking(False)
        try:
            self.socket.recv(2048)
        except BlockingIOError:
            return True
        finally:
            self.socket.settimeout(PATIENCE_S)
        return False

    def close(self) -> None:
        self.socket.close()


@pytest.fixture
def end() -> Iterator[RemoteEnd]:
    with RemoteEnd("127.0.0.1", 0) as remote:
        yield remote


@pytest.fixture
def controller(end: RemoteEnd) -> Iterator[Controller]:
    one = Controller(end)
    yield one
    one.close()


def exchange(end: RemoteEnd, controller: Controller, q: object = None, **fields: object) -> np.ndarray:
    controller.send(**fields)
    assert end.receive(PATIENCE_S) is not None
    end.answer(q)
    return controller.answer()


# --- answering -------------------------------------------------------------------------------------------


def test_answer_carries_size_id_counters_and_the_mirror(end, controller):
    offset = np.float32(np.linspace(-0.3, 0.3, 7))
    answer = exchange(end, controller, cmd_jnt_pos_fri_offset=offset)
    assert (int(answer["packet_size"]), int(answer["datagram_id"])) == (376, 0x1005)
    assert (int(answer["send_seq"]), int(answer["refl_seq"])) == (1, 100)
    assert answer["jnt_pos"].tolist() == (np.float32(np.arange(7) * 0.1) + offset).tolist()
    assert int(answer["cmd_flags"]) == 0x0001
    assert not answer["add_jnt_trq"].any()
    assert end.command.tobytes() == answer.tobytes()


def test_answer_that_was_foreseen_is_the_one_that_would_be_sent(end, controller):
    q = np.linspace(-1.0, 1.0, 7, dtype=np.float32)
    ahead = bytearray(CMD_SIZE)
    assert end.foreseen is None
    exchange(end, controller)
    end.krl_int[15] = 11
    assert end.foreseen == 101
    second = bytearray(CMD_SIZE)
    end.foresee(q, memoryview(ahead))
    end.foresee(-q, memoryview(second), 1)
    assert exchange(end, controller, q, state=State.CMD).tobytes() == bytes(ahead)
    assert exchange(end, controller, -q, state=State.CMD).tobytes() == bytes(second)


def test_answer_that_has_left_is_taken_into_account_and_not_sent_again(end, controller):
    exchange(end, controller)
    q, ahead = np.linspace(-1.0, 1.0, 7, dtype=np.float32), bytearray(CMD_SIZE)
    end.foresee(q, memoryview(ahead))
    controller.send(state=State.CMD)
    with socket.socket(fileno=socket.dup(end.descriptor)) as other_hand:
        datagram, source = other_hand.recvfrom(2048)
    end.buffer[: len(datagram)] = datagram
    assert end.receive(0.0, (len(datagram), source, 123)) is not None
    assert end.received_ns == 123
    assert end.answer(q, sent=True)
    assert controller.silent()
    assert end.answered == 2
    assert end.command.tobytes() == bytes(ahead)
    assert int(exchange(end, controller)["send_seq"]) == 3


@pytest.mark.parametrize("beforehand", ["torque", "control", "doubt"])
def test_answer_that_depends_on_more_than_the_packet_is_not_foreseen(end, controller, beforehand):
    q, ahead = np.zeros(7, dtype=np.float32), memoryview(bytearray(CMD_SIZE))
    exchange(end, controller)
    if beforehand == "torque":
        controller.send(state=State.CMD)
        assert end.receive(PATIENCE_S) is not None
        end.answer(q, np.ones(7))
    elif beforehand == "control":
        exchange(end, controller, control=Control.JNT_IMP)
    else:
        controller.send(20_000, timestamp=5.0)
        assert end.receive(0.0) is None
    assert end.foreseen is None
    with pytest.raises(RuntimeError, match="no answer can be prepared"):
        end.foresee(q, ahead)


def test_each_packet_is_answered_once(end, controller):
    exchange(end, controller)
    with pytest.raises(RuntimeError, match="no packet to answer"):
        end.answer()
    assert end.receive(0.0) is None
    with pytest.raises(RuntimeError, match="no packet to answer"):
        end.answer()
    assert controller.silent()
    assert end.answered == 1


def test_nothing_is_sent_before_a_packet_came(end):
    with pytest.raises(RuntimeError, match="no packet"):
        end.answer()


@pytest.mark.parametrize(
    ("state", "power", "used"),
    [(State.CMD, 0x7F, True), (State.CMD, 0, False), (State.MON, 0x7F, False), (State.MON, 0, False)],
)
def test_setpoint_is_used_in_command_mode_with_drives_on_only(end, controller, state, power, used):
    q = np.linspace(0.2, 0.8, 7)
    controller.send(state=state, power=power)
    end.receive(PATIENCE_S)
    assert end.commanding is used
    assert end.answer(q, np.full(7, 3.0)) is used
    answer = controller.answer()
    expected = q if used else controller.msr["cmd_jnt_pos"]
    assert answer["jnt_pos"].tolist() == np.float32(expected).tolist()
    assert answer["add_jnt_trq"].tolist() == [3.0 if used else 0.0] * 7


def test_torque_does_not_stay_in_the_next_answer(end, controller):
    controller.send(state=State.CMD)
    end.receive(PATIENCE_S)
    end.answer(np.zeros(7), np.full(7, 3.0))
    controller.answer()
    assert not exchange(end, controller)["add_jnt_trq"].any()


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_setpoint_that_is_no_number_is_not_sent(end, controller, value):
    controller.send(state=State.CMD)
    end.receive(PATIENCE_S)
    q = np.zeros(7)
    q[5] = value
    with pytest.raises(ValueError, match="A5 setpoint"):
        end.answer(q)
    assert controller.silent()
    end.answer(np.zeros(7))
    assert int(controller.answer()["send_seq"]) == 1


def test_flags_follow_the_control_mode_in_monitor_mode_only(end, controller):
    steps = [
        (Control.POSITION, State.MON, 0x0001),
        (Control.JNT_IMP, State.MON, 0x0035),
        (Control.JNT_IMP, State.CMD, 0x0035),
        (Control.POSITION, State.CMD, 0x0035),
        (Control.CART_IMP, State.MON, 0x3500),
        (Control.OTHER, State.MON, 0x0000),
    ]
    for control, state, flags in steps:
        assert int(exchange(end, controller, control=control, state=state)["cmd_flags"]) == flags


def test_cartesian_mode_mirrors_the_commanded_pose(end, controller):
    pose = np.arange(12) * 0.5
    answer = exchange(end, controller, control=Control.CART_IMP, cmd_cart_pos=pose)
    assert answer["cart_pos"].tolist() == pose.tolist()


def test_joint_impedance_is_stiff_unless_told_otherwise(end, controller):
    answer = exchange(end, controller, control=Control.JNT_IMP)
    assert answer["jnt_stiffness"].tolist() == [1000.0] * 7
    end.set_impedance(np.arange(7), np.full(7, 0.5))
    answer = exchange(end, controller)
    assert answer["jnt_stiffness"].tolist() == list(range(7))
    assert answer["jnt_damping"].tolist() == [0.5] * 7


def test_own_counter_wraps(controller):
    with RemoteEnd("127.0.0.1", 0, first_sequence=65_535) as end:
        controller.to = end.address
        assert [int(exchange(end, controller)["send_seq"]) for _ in range(3)] == [65_535, 0, 1]


def test_krl_variables_are_sent_until_changed(end, controller):
    end.krl_int[15] = 10
    end.krl_real[0] = 1.5
    end.set_krl_bool(0, True)
    end.set_krl_bool(15, True)
    for _ in range(2):
        answer = exchange(end, controller)
        assert (int(answer["krl_int"][15]), float(answer["krl_real"][0])) == (10, 1.5)
        assert int(answer["krl_bool"]) == 0x8001
    end.set_krl_bool(15, False)
    assert int(exchange(end, controller)["krl_bool"]) == 0x0001
    with pytest.raises(ValueError, match=r"0\.\.15"):
        end.set_krl_bool(16, True)


def test_answers_that_the_controller_did_not_see_are_counted(end, controller):
    exchange(end, controller)
    exchange(end, controller, refl_seq=1)
    exchange(end, controller, refl_seq=1)
    assert end.unreflected == 1


# --- what is passed over ---------------------------------------------------------------------------------


def test_timeout_ends_the_wait(end):
    assert end.receive(0.0) is None
    assert end.receive(0.001) is None


def test_repeated_and_late_packets_are_counted_and_not_answered(end, controller):
    exchange(end, controller)
    controller.again()
    assert end.receive(BRIEF_S) is None
    exchange(end, controller, step=3)
    controller.send(step=-1)
    assert end.receive(BRIEF_S) is None
    with pytest.raises(RuntimeError, match="no packet"):
        end.answer()
    counters = end.counters()
    assert (counters["repeated"], counters["reordered"], counters["lost"]) == (1, 1, 2)
    assert (counters["received"], counters["answered"]) == (2, 2)
    assert controller.silent()


def test_a_good_packet_behind_bad_ones_is_found_in_the_same_call(end, controller):
    exchange(end, controller)
    controller.again()
    controller.raw(b"nonsense")
    controller.send()
    assert end.receive(PATIENCE_S) is not None
    assert end.sequence == 101


@pytest.mark.parametrize(
    ("damage", "fault"),
    [
        (lambda data: data[:-1], Fault.LENGTH),
        (lambda data: data + b"\0", Fault.LENGTH),
        (lambda data: data * 3, Fault.LENGTH),
        (lambda data: b"", Fault.LENGTH),
        (lambda data: data[:6] + b"\x01\x20" + data[8:], Fault.ID),
        (lambda data: data[:4] + b"\x00\x00" + data[6:], Fault.SIZE),
        (lambda data: data[:144] + b"\x09\x00" + data[146:], Fault.FIELD),
        (lambda data: data[:292] + b"\x00\x00\xc0\x7f" + data[296:], Fault.VALUE),
    ],
)
def test_malformed_datagrams_are_counted_by_reason(end, controller, damage, fault):
    controller.raw(damage(controller.msr.tobytes()))
    assert end.receive(BRIEF_S) is None
    assert end.controller is None
    assert (end.malformed, end.malformed_by[fault]) == (1, 1)
    exchange(end, controller)


def test_only_the_controller_is_answered_once_it_is_known(end, controller):
    stranger = Controller(end, "127.0.0.2")
    exchange(end, controller)
    for _ in range(3):
        stranger.send()
    assert end.receive(BRIEF_S) is None
    assert stranger.silent()
    assert end.foreign == 3
    events = [event for event in end.events if event.kind is LinkEventKind.FOREIGN]
    assert len(events) == 1
    assert events[0].text.startswith("datagrams from 127.0.0.2:")
    exchange(end, controller)
    stranger.close()


def test_configured_controller_is_the_only_one_from_the_beginning():
    with RemoteEnd("127.0.0.1", 0, controller="127.0.0.3") as end:
        stranger, controller = Controller(end), Controller(end, "127.0.0.3")
        stranger.send()
        assert end.receive(BRIEF_S) is None
        assert end.foreign == 1
        exchange(end, controller)
        assert end.controller == controller.socket.getsockname()
        stranger.close()
        controller.close()


def test_second_program_on_the_controllers_host_does_not_take_over(end, controller, monkeypatch):
    monkeypatch.setattr(fri.remote, "_PORT_GRACE_S", 1e9)
    exchange(end, controller)
    second = Controller(end)
    second.send()
    assert end.receive(BRIEF_S) is None
    assert (end.foreign, end.port_changes) == (1, 0)
    assert second.silent()
    exchange(end, controller)
    second.close()


def test_controller_that_was_opened_again_from_another_port_is_accepted(end, controller, monkeypatch):
    monkeypatch.setattr(fri.remote, "_PORT_GRACE_S", 0.0)
    exchange(end, controller)
    again = Controller(end)
    again.number = controller.number
    exchange(end, again)
    assert (end.port_changes, end.restarts) == (1, 0)
    assert end.events[-1].kind is LinkEventKind.PORT_CHANGED
    again.close()


def test_command_mode_does_not_move_to_another_port(end, controller, monkeypatch):
    monkeypatch.setattr(fri.remote, "_PORT_GRACE_S", 0.0)
    exchange(end, controller, state=State.CMD)
    second = Controller(end)
    second.number = controller.number
    second.send(state=State.CMD)
    assert end.receive(BRIEF_S) is None
    assert (end.foreign, end.port_changes) == (1, 0)
    assert second.silent()
    exchange(end, controller)
    second.close()


def test_restart_clears_requests_and_goes_on_counting(end, controller, monkeypatch):
    end.krl_int[15] = 10
    end.set_krl_bool(3, True)
    controller.number = 5000
    for _ in range(3):
        exchange(end, controller, state=State.CMD, control=Control.JNT_IMP)
    monkeypatch.setattr("fri.remote.monotonic_ns", lambda: end.received_ns)
    controller.number = 6
    answer = exchange(end, controller, state=State.MON, control=Control.POSITION)
    assert (end.restarts, end.lost, end.sequence) == (1, 0, 5005)
    assert int(answer["krl_int"][15]) == int(answer["krl_bool"]) == 0
    assert int(answer["cmd_flags"]) == 0x0001
    assert end.events[-1].kind is LinkEventKind.RESTARTED


@pytest.mark.parametrize(("host_clock", "numbers"), [(True, 3000), (False, 2)])
def test_the_time_of_a_restart_is_a_gap_in_the_numbers(end, controller, monkeypatch, host_clock, numbers):
    end.host_clock = host_clock
    controller.number = 5000
    for _ in range(3):
        exchange(end, controller)
    before, heard = end.sequence, end.received_ns
    cycles = 1e9 * end.sample_time_s
    monkeypatch.setattr("fri.remote.monotonic_ns", lambda: heard + round(3000 * cycles))
    controller.number = 6
    exchange(end, controller)
    assert (end.restarts, end.lost, end.sequence) == (1, 0, before + numbers)


def test_pending_tells_that_the_packet_in_hand_is_stale(end, controller):
    controller.send()
    controller.send()
    end.receive(PATIENCE_S)
    assert end.pending()
    end.receive(PATIENCE_S)
    assert not end.pending()


# --- opening ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("address", ["", "localhost", "192.168.0", "::1", "300.1.1.1"])
def test_address_must_be_four_numbers(address):
    with pytest.raises(ConfigurationError, match="IPv4"):
        RemoteEnd(address)


def test_port_must_be_one():
    with pytest.raises(ConfigurationError, match="49938"):
        RemoteEnd("127.0.0.1", 70_000)


def test_port_in_use_says_so(end):
    with pytest.raises(NetworkError, match="no other FRI client"):
        RemoteEnd("127.0.0.1", end.address[1])


def test_address_of_another_machine_says_so():
    with pytest.raises(NetworkError, match="this PC"):
        RemoteEnd("192.0.2.1", 0)


def test_other_interfaces_are_not_listened_on(end, controller):
    controller.to = ("127.0.0.9", end.address[1])
    controller.send()
    assert not end.pending()


def test_measurement_is_what_was_sent(end, controller):
    rng = np.random.default_rng(1)
    controller.msr["krl_real"] = rng.normal(size=16)
    controller.msr["gravity"] = rng.normal(size=7)
    controller.msr["mass_matrix"] = rng.normal(size=(7, 7))
    controller.send()
    assert end.receive(PATIENCE_S).tobytes() == controller.msr.tobytes()
    assert len(end.msr.tobytes()) == MSR_SIZE


def test_a_refusing_network_is_counted_and_the_packet_counts_as_unanswered(end, controller):
    exchange(end, controller)
    controller.send(state=State.CMD)
    assert end.receive(PATIENCE_S) is not None
    end.controller = ("255.255.255.255", 9)
    assert end.answer(np.zeros(7)) is False
    assert (end.send_errors, end.answered) == (1, 1)
    end.remind()
    assert (end.send_errors, end.answered) == (2, 1)


@pytest.mark.parametrize("index", [-1, 16])
def test_krl_bits_outside_the_word_are_refused(end, index):
    with pytest.raises(ValueError, match=r"outside 0\.\.15"):
        end.set_krl_bool(index, True)
    end.set_krl_bool(0, True)
    end.set_krl_bool(15, True)
    assert int(end.command["krl_bool"]) == 0x8001
    end.set_krl_bool(0, False)
    assert int(end.command["krl_bool"]) == 0x8000


def test_a_new_end_has_seen_nothing(end):
    assert set(end.counters().values()) == {0}
    assert (end.sequence, end.state, end.quality, end.power, end.control, end.error) == (-1, 0, 0, 0, 0, 0)
    assert (end.timestamp_s, end.sample_time_s, end.received_ns, end.commanding) == (0.0, 0.0, 0, False)
    assert end.controller is None
    assert set(end.malformed_by.values()) == {0}
    assert end.msr.tobytes() == bytes(916)


def test_the_default_answer_is_stiff_and_damped(end, controller):
    answer = exchange(end, controller)
    expected = {
        "jnt_stiffness": [1000.0] * 7,
        "jnt_damping": [0.7] * 7,
        "cart_stiffness": [1000.0] * 3 + [100.0] * 3,
        "cart_damping": [0.7] * 6,
    }
    for name, values in expected.items():
        np.testing.assert_allclose(answer[name], values, rtol=1e-6)
    assert not answer["krl_real"].any()
    assert not answer["krl_int"].any()
    assert int(answer["krl_bool"]) == 0


def test_a_reminder_is_the_last_answer_again(end, controller):
    end.remind()
    first = exchange(end, controller)
    end.remind()
    assert controller.answer().tobytes() == first.tobytes()
    end.krl_int[3] = 5
    end.remind()
    assert int(controller.answer()["krl_int"][3]) == 5
    assert end.counters()["answered"] == 1


def test_torques_are_turned_by_the_sign_of_their_sensors(end, controller):
    sign = np.array([1.0, -1.0, 1.0, 1.0, 1.0, 1.0, -1.0])
    end.set_torque_sign(sign)
    for _ in range(2):
        controller.send(
            msr_jnt_trq=np.arange(1.0, 8.0), est_ext_jnt_trq=np.full(7, 0.5), gravity=np.full(7, 2.0)
        )
        msr = end.receive(PATIENCE_S)
        assert msr["msr_jnt_trq"].tolist() == (np.arange(1.0, 8.0) * sign).tolist()
        assert msr["est_ext_jnt_trq"].tolist() == (0.5 * sign).tolist()
        assert msr["gravity"].tolist() == [2.0] * 7
        end.answer()
    with pytest.raises(ConfigurationError, match="must be"):
        end.set_torque_sign(np.zeros(7))
