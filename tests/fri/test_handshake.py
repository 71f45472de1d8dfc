"""The words of every KRL program: what a request writes, and which words of the program mean what."""

from __future__ import annotations

import numpy as np
import pytest

from fri.errors import ConfigurationError
from fri.handshake import HANDSHAKES, IdentificationHandshake, find_handshake
from fri.packets import new_cmd, new_msr
from fri.states import Control, State

# Index in krl_int (from 0) and its values when opened, started, stopped and fallen.
STATUS = {
    "lwr_identification": (15, {1, 2, 3, 4}, {4}, {1}, {4, 6}),
    "stanford": (15, {10, 20}, {20}, {10}, {20}),
    "ros_control": (1, {0, 1, 10}, {1}, {0, 10}, {1}),
}
# Written words, (index in krl_int, value), for a start in joint impedance, a stop and the end.
WORDS = {
    "lwr_identification": ([(15, 22)], [(15, 11)], [(15, 33)]),
    "stanford": ([(14, 30), (15, 10)], [(15, 20)], [(15, 77)]),
    "ros_control": ([(0, 30), (1, 1)], [(1, 0)], [(1, 0)]),
}


@pytest.mark.parametrize("name", WORDS)
@pytest.mark.parametrize("request_", [0, 1, 2])
def test_a_request_writes_its_words_and_no_others(name: str, request_: int) -> None:
    handshake, cmd, msr = find_handshake(name), new_cmd(), new_msr()
    cmd["krl_int"] = -5
    msr["krl_int"][14] = 77
    expected = cmd.copy()
    if request_ == 0:
        handshake.request_start(cmd, msr, Control.JNT_IMP)
    elif request_ == 1:
        handshake.request_stop(cmd, msr)
    else:
        handshake.request_close(cmd, msr)
    for index, value in WORDS[name][request_]:
        expected["krl_int"][index] = value
    assert cmd.tobytes() == expected.tobytes()


@pytest.mark.parametrize("name", STATUS)
@pytest.mark.parametrize("state", list(State))
def test_the_status_means_what_the_program_says(name: str, state: State) -> None:
    handshake, (index, opened, started, stopped, fallen) = find_handshake(name), STATUS[name]
    for value in range(32):
        msr = new_msr()
        msr["state"] = state
        msr["krl_int"][index] = value
        # The status of ros_control is 0 without a program.
        assert handshake.opened(msr) == (value in opened and (name != "ros_control" or state != State.OFF))
        assert handshake.started(msr) == (value in started and state == State.CMD)
        assert handshake.stopped(msr) == (value in stopped and state == State.MON)
        assert handshake.fallen(msr) == (value in fallen and state == State.MON)


@pytest.mark.parametrize("state", list(State))
@pytest.mark.parametrize("bits", [0, 1, 2, 3])
def test_rcprg_is_through_when_its_bit_is_off(state: State, bits: int) -> None:
    handshake, msr = find_handshake("rcprg"), new_msr()
    msr["state"], msr["krl_bool"] = state, bits
    assert handshake.opened(msr) == (state != State.OFF)
    assert handshake.started(msr) == (state == State.CMD and not bits & 1)
    assert handshake.stopped(msr) == (state == State.MON and not bits & 1)
    assert not handshake.fallen(msr)


@pytest.mark.parametrize(("asks", "word", "wanted"), [("start", 1, State.CMD), ("stop", 2, State.MON)])
def test_rcprg_sets_its_bit_until_it_is_acknowledged(asks: str, word: int, wanted: State) -> None:
    handshake, cmd, msr = find_handshake("rcprg"), new_cmd(), new_msr()
    other = State.MON if wanted is State.CMD else State.CMD

    def ask() -> None:
        if asks == "start":
            handshake.request_start(cmd, msr, Control.POSITION)
        else:
            handshake.request_stop(cmd, msr)

    cmd["krl_bool"], msr["state"] = 0x8002, other
    ask()
    assert (int(cmd["krl_int"][0]), int(cmd["krl_bool"])) == (word, 0x8003)
    msr["krl_bool"] = 1
    ask()
    assert int(cmd["krl_bool"]) == 0x8002
    msr["krl_bool"], msr["state"], cmd["krl_int"][0] = 0, wanted, 9
    ask()
    assert (int(cmd["krl_int"][0]), int(cmd["krl_bool"])) == (9, 0x8002)


def test_what_a_program_can_end() -> None:
    found = {name: handshake.can_close for name, handshake in HANDSHAKES.items()}
    assert found == {"lwr_identification": True, "stanford": True, "ros_control": False, "rcprg": False}


def test_load_data_are_numbered_and_summed() -> None:
    handshake, cmd, msr = IdentificationHandshake(), new_cmd(), new_msr()
    load = np.array([3.5, 10.0, -66.0, 144.0, 0.01, 0.02, 0.03])
    cmd["krl_real"][8:] = 9.0
    assert not handshake.load_taken(cmd, msr)
    msr["krl_int"][13] = 4
    handshake.request_load(cmd, msr, load)
    assert cmd["krl_real"][:7].tolist() == np.float32(load).tolist()
    assert cmd["krl_real"][7] == pytest.approx(91.56, abs=1e-4)
    assert (cmd["krl_real"][8:] == 9.0).all()
    assert cmd["krl_int"][12:14].tolist() == [-5, 5]
    assert not cmd["krl_int"][:12].any()
    # The same request again is the same; other data get the next number.
    handshake.request_load(cmd, msr, load)
    assert cmd["krl_int"][12:14].tolist() == [-5, 5]
    assert not handshake.load_taken(cmd, msr)
    msr["krl_int"][13] = 5
    assert handshake.load_taken(cmd, msr)
    handshake.request_load(cmd, msr, 2.0 * load)
    assert cmd["krl_int"][12:14].tolist() == [-6, 6]
    assert cmd["krl_real"][7] == pytest.approx(183.12, abs=1e-4)
    assert not handshake.load_taken(cmd, msr)


def test_the_first_request_is_made_even_for_zeros() -> None:
    handshake, cmd, msr = IdentificationHandshake(), new_cmd(), new_msr()
    cmd["krl_int"][12] = 3
    handshake.request_load(cmd, msr, np.zeros(7))
    assert cmd["krl_int"][12:14].tolist() == [-1, 1]


def test_load_data_in_force_are_read() -> None:
    msr = new_msr()
    msr["krl_real"] = np.arange(16)
    assert IdentificationHandshake().load(msr).tolist() == [7.0, 8.0, 9.0, 10.0]


def test_an_unknown_program_is_refused_with_the_known_ones() -> None:
    with pytest.raises(
        ConfigurationError, match="known are lwr_identification, rcprg, ros_control, stanford"
    ):
        find_handshake("fri")


def test_a_request_that_was_never_taken_keeps_its_number_from_the_next() -> None:
    handshake, cmd, msr = IdentificationHandshake(), new_cmd(), new_msr()
    for number in (1, 2, 3):
        handshake.request_load(cmd, msr, np.full(7, float(number)))
        assert cmd["krl_int"][12:14].tolist() == [-number, number]
        assert not handshake.load_taken(cmd, msr)
