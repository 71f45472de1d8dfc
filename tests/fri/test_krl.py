from __future__ import annotations

import numpy as np
import pytest

from fri.errors import ConfigurationError
from fri.handshake import HANDSHAKES, find_handshake
from fri.krc import EventKind
from fri.krl import Interpreter, KrlProgram
from fri.packets import new_cmd, new_msr
from fri.states import ALL_DRIVES, Control, State
from sim_backend.program import krl_program
from tests.fri.fri_rig import V_MAX, Rig

NAMES = ["lwr_identification", "rcprg", "ros_control", "stanford"]
COUNTING = "DEF p( )\nLOOP\n$FRI_TO_INT[1]=$FRI_TO_INT[1]+1\nWAIT SEC 0.012\nENDLOOP\nEND"
# Cycles of 2 ms within which every granted request must be visible.
BOUND = 400


class Cell:
    """A controller with a KRL program and a client that only speaks the handshake."""

    def __init__(self, name: str, sample_time_ms: int = 2) -> None:
        self.rig = Rig()
        self.session = self.rig.session
        self.program = krl_program(name, sample_time_ms)
        self.interpreter = Interpreter(self.session, self.program)
        self.handshake = find_handshake(name)
        self.krl = self.rig.cmd
        self.request = lambda: None

    def cycle(self, q: np.ndarray | None = None, reply: bool = True) -> State:
        if self.session.state is State.OFF:
            self.session.close_cycle()
        else:
            self.rig.cycle(q, reply)
            self.request()
        self.interpreter.advance(self.session.sample_time_ms)
        return self.session.state

    def until(self, seen: object) -> None:
        """Cycles until the client sees what it waits for; bounded."""
        for _ in range(BOUND):
            self.cycle()
            if self.session.state is not State.OFF and seen(self.rig.msr):
                return
        raise AssertionError(f"not within {BOUND} cycles: {seen}; {list(self.session.events)}")

    def ask_start(self, control: Control = Control.POSITION) -> None:
        """Ask for a start from now on, in every cycle."""
        self.request = lambda: self.handshake.request_start(self.krl, self.rig.msr, control)
        self.request()

    def ask_stop(self) -> None:
        self.request = lambda: self.handshake.request_stop(self.krl, self.rig.msr)
        self.request()

    def start(self, control: Control = Control.POSITION) -> None:
        self.until(self.handshake.opened)
        self.ask_start(control)
        self.until(self.handshake.started)
        self.request = lambda: None

    def stop(self) -> None:
        self.ask_stop()
        self.until(self.handshake.stopped)
        self.request = lambda: None


@pytest.mark.parametrize("name", NAMES)
def test_start_stop_start(name):
    cell = Cell(name)
    cell.start()
    assert cell.session.state is State.CMD
    cell.stop()
    assert cell.session.state is State.MON
    cell.start(Control.POSITION)
    assert cell.session.counters()["starts"] == 2


@pytest.mark.parametrize("name", NAMES)
def test_nothing_starts_without_a_request(name):
    cell = Cell(name)
    for _ in range(2 * BOUND):
        cell.cycle()
    assert cell.session.counters()["starts"] == 0
    assert cell.session.state is State.MON


@pytest.mark.parametrize("name", NAMES)
def test_after_a_fallback_nothing_starts_until_asked_anew(name):
    cell = Cell(name)
    cell.start()
    q = cell.session.setpoint
    for _ in range(10):
        q = q + 0.2 * V_MAX * 0.002
        cell.cycle(q)
    cell.session.drop(EventKind.EXTERNAL, "test")
    for _ in range(2 * BOUND):
        cell.cycle()
    assert cell.session.state is State.MON
    assert cell.session.counters()["starts"] == 1
    cell.stop()
    cell.start(Control.POSITION)
    assert not cell.rig.msr["cmd_jnt_pos_fri_offset"].any()


@pytest.mark.parametrize("name", NAMES)
def test_program_that_is_started_again_does_not_obey_an_old_request(name):
    cell = Cell(name)
    cell.start()
    cell.session.fri_close()
    cell.interpreter = Interpreter(cell.session, krl_program(name, 5))
    cell.krl["krl_int"] = 0
    cell.krl["krl_bool"] = 0
    for _ in range(BOUND):
        cell.cycle()
    assert (cell.session.state, cell.session.sample_time_ms) == (State.MON, 5)
    assert cell.session.counters()["starts"] == 1


def test_stanford_values_on_the_wire():
    cell = Cell("stanford")
    cell.until(cell.handshake.opened)
    assert (int(cell.rig.msr["krl_int"][14]), int(cell.rig.msr["krl_int"][15])) == (30, 10)
    cell.ask_start(Control.JNT_IMP)
    assert cell.krl["krl_int"][14:].tolist() == [30, 10]
    cell.until(cell.handshake.started)
    assert int(cell.rig.msr["krl_int"][15]) == 20
    assert (int(cell.rig.msr["control"]), int(cell.krl["cmd_flags"])) == (Control.JNT_IMP, 0x35)
    cell.ask_stop()
    assert int(cell.krl["krl_int"][15]) == 20
    cell.until(cell.handshake.stopped)
    assert int(cell.rig.msr["krl_int"][15]) == 10


@pytest.mark.parametrize("abort_code", [30, 40])
def test_stanford_close_needs_the_code_of_this_run(abort_code):
    cell = Cell("stanford")
    cell.program = krl_program("stanford", 2, LWR_ABORT=abort_code)
    cell.interpreter = Interpreter(cell.session, cell.program)
    cell.start()
    cell.krl["krl_int"][15] = 70 - abort_code
    for _ in range(50):
        cell.cycle()
    assert cell.session.state is State.CMD
    cell.handshake.request_close(cell.krl, cell.rig.msr)
    seen_closed = False
    for _ in range(BOUND):
        cell.cycle()
        seen_closed = seen_closed or int(cell.rig.msr["krl_int"][15]) == 30
    assert seen_closed
    assert cell.program.finished
    assert cell.session.state is State.OFF


def test_ros_values_on_the_wire():
    cell = Cell("ros_control")
    cell.until(cell.handshake.opened)
    assert int(cell.rig.msr["krl_int"][1]) == 10
    cell.ask_start(Control.JNT_IMP)
    assert cell.krl["krl_int"][:2].tolist() == [30, 1]
    cell.until(cell.handshake.started)
    # The first start stays in position control, as the published program has it.
    assert (int(cell.rig.msr["krl_int"][1]), int(cell.rig.msr["control"])) == (1, Control.POSITION)
    cell.stop()
    assert int(cell.rig.msr["krl_int"][1]) == 0
    cell.start(Control.JNT_IMP)
    assert int(cell.rig.msr["control"]) == Control.JNT_IMP


def test_rcprg_values_on_the_wire():
    cell = Cell("rcprg")
    cell.until(cell.handshake.opened)
    cell.ask_start(Control.JNT_IMP)
    assert (int(cell.krl["krl_int"][0]), int(cell.krl["krl_bool"])) == (1, 1)
    acknowledged = False
    for _ in range(BOUND):
        cell.cycle()
        acknowledged = acknowledged or bool(cell.rig.msr["krl_bool"] & 1)
    assert acknowledged
    assert int(cell.krl["krl_bool"]) == 0
    assert cell.handshake.started(cell.rig.msr)


def test_rcprg_request_is_taken_back_when_acknowledged():
    handshake, cmd, msr = find_handshake("rcprg"), new_cmd(), new_msr()
    msr["state"] = State.MON
    handshake.request_start(cmd, msr, Control.JNT_IMP)
    assert (int(cmd["krl_bool"]), int(cmd["krl_int"][0])) == (1, 1)
    msr["krl_bool"] = 1
    handshake.request_start(cmd, msr, Control.JNT_IMP)
    assert int(cmd["krl_bool"]) == 0
    msr["krl_bool"] = 0
    handshake.request_start(cmd, msr, Control.JNT_IMP)
    assert int(cmd["krl_bool"]) == 1


def test_rcprg_opens_again_with_another_period():
    cell = Cell("rcprg")
    cell.until(cell.handshake.opened)
    cell.krl["krl_int"][:2] = (3, 10)
    cell.krl["krl_bool"] = 1
    cell.until(lambda msr: msr["cmd_sample_time"] == np.float32(0.01))


@pytest.mark.parametrize("name", ["lwr_identification", "stanford", "ros_control"])
def test_waiting_for_quality_ends_when_the_request_is_withdrawn(name):
    cell = Cell(name)
    cell.until(cell.handshake.opened)
    cell.session.quality_ceiling = cell.session.quality.OK
    cell.ask_start(Control.POSITION)
    for _ in range(BOUND):
        cell.cycle()
    assert cell.session.state is State.MON
    cell.stop()
    cell.session.quality_ceiling = cell.session.quality.PERFECT
    for _ in range(BOUND):
        cell.cycle()
    assert cell.session.state is State.MON
    cell.start(Control.POSITION)


@pytest.mark.parametrize("name", NAMES)
def test_command_mode_with_drives_off_is_granted(name):
    cell = Cell(name)
    cell.session.set_drives(0)
    cell.start()
    assert cell.session.power == 0
    cell.session.set_drives(ALL_DRIVES)
    for _ in range(20):
        assert cell.cycle() is State.CMD


@pytest.mark.parametrize(
    ("period_ms", "calls", "ticks"), [(1, 120, 10), (5, 24, 10), (12, 10, 10), (50, 12, 50), (100, 6, 50)]
)
def test_interpreter_ticks_every_12_ms(period_ms, calls, ticks):
    # A tick falls due at 0, 12, 24, ... ms; a call runs those due in its milliseconds.
    session = Rig().session
    interpreter = Interpreter(session, KrlProgram(COUNTING))
    for _ in range(calls):
        interpreter.advance(period_ms)
    assert session.to_int[0] == (calls * period_ms - 1) // 12 + 1 == ticks


def test_a_variable_holds_between_two_ticks():
    rig = Rig(sample_time_ms=1).open()
    interpreter = Interpreter(rig.session, KrlProgram(COUNTING))
    seen = []
    for _ in range(60):
        interpreter.advance(1)
        rig.cycle()
        seen.append(int(rig.msr["krl_int"][0]))
    assert seen == [k // 12 + 1 for k in range(60)]


def test_unknown_program_is_named_with_the_known_ones():
    assert sorted(HANDSHAKES) == NAMES
    with pytest.raises(ConfigurationError, match=r"known are lwr_id.*, rcprg, ros_control, stanford"):
        find_handshake("kuka")


@pytest.mark.parametrize("statement_ms", [0.0, 0.1, 0.7, 5.0])
@pytest.mark.parametrize("period_ms", [1, 5, 12])
def test_idle_cycles_are_those_without_a_statement(statement_ms, period_ms):
    made = [KrlProgram(COUNTING, name="p", statement_ms=statement_ms) for _ in range(2)]
    stepped, skipped = (Interpreter(Rig().session, program) for program in made)
    now = 0
    while now < 200:
        idle = skipped.idle_cycles(period_ms)
        skipped.skip(idle * period_ms)
        skipped.advance(period_ms)
        for cycle in range(idle + 1):
            before, due_ms = stepped.session.to_int.copy(), stepped.program.due_ms
            stepped.advance(period_ms)
            if cycle < idle:
                assert np.array_equal(stepped.session.to_int, before)
                assert stepped.program.due_ms == due_ms
        now += idle + 1
        assert skipped.program.due_ms == stepped.program.due_ms
        assert np.array_equal(skipped.session.to_int, stepped.session.to_int)
