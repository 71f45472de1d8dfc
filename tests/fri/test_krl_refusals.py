"""What the emulated controller refuses: texts that are no program, places that are no positions, starts too early."""

from __future__ import annotations

import numpy as np
import pytest

from fri.errors import ConfigurationError, RobotError
from fri.in_process import Network
from fri.krc import EventKind, KrcPolicy, KrcSession
from fri.krl import KrlProgram
from fri.krl_source import parse_source
from fri.krl_tree import Constant, Ignored, Name, Unary
from fri.states import ALL_DRIVES, Control, State
from tests.fri.fri_rig import LIMITS, Q_START, QUICK, Rig


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("DEF p( )\nEND\nDEF p( )\nEND", "holds P twice"),
        ("", "holds no DEF"),
        ("DEF p( )\nX=1", "ends within a block"),
        ("DEF p( )\nLOOP\nX=1", "ends within a block"),
        ("DEF p( )\nSPLINE\nSPL XP1", "ends within a block"),
        ("DEF p( )\nGOTO 3\nEND", "line 2: .* is no statement"),
        ("DEF p( )\n5=3\nEND", "line 2: .* is no statement"),
        ("DEF p( )\nSWITCH 1\nX=1\nENDSWITCH\nEND", "line 3: X within SWITCH"),
        ("DEF p( )\nX=A:B\nEND", "line 2: the geometric operator"),
        ("DEF p( )\nX=THEN\nEND", "line 2: 'THEN' is no value"),
        ("DEF p( )\nX=)\nEND", r"line 2: '\)' is no value"),
        ("DEF p( )\nDECL 5\nEND", "line 2: .* is no declaration"),
        ("DEF p( )\nDECL INT A, 5\nEND", "line 2: '5' is no declaration"),
        ("DEF p( )\nDECL INT A[N]\nEND", "line 2: the size of A is no whole number"),
        ("DEF p( )\nDECL INT A[2.5]\nEND", "line 2: the size of A is no whole number"),
        ("DEF p( )\nDECL INT A=B\nEND", "line 2: .* the value of A is no constant"),
        ("DEF p( )\nEXT\nEND", "line 2: .* names no subprogram"),
        ("DEF p( ) 5\nEND", "line 1: '5' is too much"),
        ("p( )\nEND", "line 1: found 'P' where 'DEF' is expected"),
        ("DEF p( )\nLOOP 5\nENDLOOP\nEND", "line 2: '5' is too much"),
        ("DEF p( )\nWHILE 1==1 5\nENDWHILE\nEND", "line 2: '5' is too much"),
        ("DEF p( )\nIF 1==1 THEN 5\nENDIF\nEND", "line 2: '5' is too much"),
        ("DEF p( )\nREPEAT 5\nUNTIL 1==1\nEND", "line 2: '5' is too much"),
        ("DEF p( )\nREPEAT\nUNTIL 1==1 5\nEND", "line 3: '5' is too much"),
        ("DEF p( )\nFOR K=1 TO 2 5\nENDFOR\nEND", "line 2: '5' is too much"),
        ("DEF p( )\nHALT 5\nEND", "line 2: '5' is too much"),
        ("DEF p( )\nEXIT 5\nEND", "line 2: '5' is too much"),
        ("DEF p( )\nPTP XP1 5\nEND", "line 2: '5' is too much"),
        ("DEF p( )\nFRISTOP() 5\nEND", "line 2: '5' is too much"),
        ("DEF p( )\nSWITCH 1\nCASE 1 5\nENDSWITCH\nEND", "line 3: '5' is too much"),
    ],
)
def test_a_text_that_is_no_program_is_refused_with_its_line(text: str, message: str) -> None:
    with pytest.raises(ConfigurationError, match=message):
        parse_source(text)


@pytest.mark.parametrize("data", ["A=1", "=1", "EXT B"])
def test_a_line_of_a_data_list_declares_something(data: str) -> None:
    with pytest.raises(ConfigurationError, match=r"line 1: .* (declares nothing|names no subprogram)"):
        parse_source("DEF p( )\nEND", data)


def test_signs_splines_fields_and_arrays_of_functions_are_read() -> None:
    source = parse_source(
        "DEF p( )\nEXT OTHER(INT:IN)\nX=+3\nY=-(+2)\nSPLINE\nSPL XP1\nENDSPLINE\nZ={A[2] 5}\nN=$POS_ACT.X\nEND\n"
        "GLOBAL DEFFCT REAL[] F(a[]:OUT,b:IN,c)\nRETURN\nENDFCT\n"
    )
    body = source.subprograms["P"].body
    assert source.external == {"OTHER"}
    assert body[0].value == Constant(3)  # type: ignore[union-attr]
    assert body[1].value == Unary("-", Constant(2))  # type: ignore[union-attr]
    assert isinstance(body[2], Ignored)
    assert body[3].value.items == (("A[2]", Constant(5)),)  # type: ignore[union-attr]
    assert body[4].value == Name("$POS_ACT.X")  # type: ignore[union-attr]
    assert source.subprograms["F"].parameters == (("A", False), ("B", True), ("C", False))
    assert source.subprograms["F"].function
    assert not source.subprograms["P"].function


def test_a_function_within_an_expression_does_not_wait() -> None:
    text = "DEF p( )\n$FRI_TO_INT[1]=1+LATE()\nEND\nDEFFCT INT LATE( )\nWAIT SEC 0.1\nRETURN 2\nENDFCT\n"
    with pytest.raises(RobotError, match="a function that waits is called within an expression"):
        KrlProgram(text).step(Rig().open().session)


def test_subprograms_of_other_modules_are_called_with_their_own_data() -> None:
    other = ("GLOBAL DEF SET(K:IN)\nINT K\n$FRI_TO_INT[K]=OWN\nEND\n", "DEFDAT o\nDECL INT OWN=42\nENDDAT")
    rig = Rig().open()
    KrlProgram("DEF p( )\nSET(2)\nSET(3)\nEND\n", modules={"other": other}).step(rig.session)
    assert rig.session.to_int[:4].tolist() == [0, 42, 42, 0]


def test_a_strategy_is_not_committed_in_command_mode() -> None:
    rig = Rig().command_mode()
    program = KrlProgram("DEF p( )\n$STIFFNESS.STRATEGY=30\n$STIFFNESS.COMMIT=TRUE\nEND\n")
    with pytest.raises(RobotError, match="line 3: strategy 30 cannot be committed in command mode"):
        program.step(rig.session)


def test_the_mode_of_operation_is_read_as_a_state() -> None:
    rig = Rig().open()
    KrlProgram(
        "DEF p( )\nIF $MODE_OP==#EXT THEN\n$FRI_TO_INT[1]=1\nENDIF\n"
        "IF $ROB_STOPPED THEN\n$FRI_TO_INT[2]=1\nENDIF\nEND\n"
    ).step(rig.session)
    assert rig.session.to_int[:2].tolist() == [1, 1]


@pytest.mark.parametrize("q", [np.zeros(6), np.full(7, np.nan), np.zeros((1, 7))])
def test_a_setpoint_is_seven_finite_numbers(q: np.ndarray) -> None:
    with pytest.raises(ValueError, match="must be 7 finite numbers"):
        KrcSession(LIMITS, q)


def test_a_mode_without_command_mode_here_is_refused_with_its_reason() -> None:
    session = Rig().open().session
    seen: list[EventKind] = []
    session.on_event = lambda event: seen.append(event.kind)
    session.refused = {Control.POSITION: "no brakes"}
    assert session.fri_start() is State.MON
    assert session.last_event is not None
    assert session.last_event.text == "start refused: no brakes"
    assert seen == [EventKind.REFUSED]
    # A request from before is not granted either.
    rig = Rig().open()
    rig.cycles(20)
    rig.session.fri_start()
    rig.session.refused = {Control.POSITION: "no brakes"}
    rig.cycles(5)
    assert rig.session.state is State.MON


def test_outside_monitor_mode_a_start_changes_nothing() -> None:
    session = KrcSession(LIMITS, Q_START, KrcPolicy(**QUICK))
    assert session.fri_start() is State.OFF
    assert session.last_event is None
    assert not session.t1
    session.t1 = True
    assert session.t1


def test_drives_switched_off_in_command_mode_may_leave_it_on() -> None:
    rig = Rig(drop_on_drives_off=False).command_mode()
    step = 0.2 * LIMITS.v_max * 0.001
    for _ in range(5):
        rig.cycle(rig.session.setpoint + step)
    rig.session.set_drives(0)
    held = rig.session.setpoint
    # The velocity is forgotten: a missing answer does not go on with it.
    rig.cycle(reply=False)
    np.testing.assert_allclose(rig.session.setpoint, held, atol=1e-9)
    assert rig.session.state is State.CMD


def test_a_port_in_a_process_has_no_descriptor_and_waits_for_nothing() -> None:
    port = Network().bind("127.0.0.1")
    assert port.fileno() == -1
    for receive in (lambda: port.recvfrom(10), lambda: port.recv_into(bytearray(4))):
        with pytest.raises(BlockingIOError):
            receive()
    port.sendto(b"abcdef", port.getsockname())
    buffer = bytearray(4)
    assert port.recv_into(buffer) == 4
    assert buffer == b"abcd"
    assert port.sendto(b"abc", port.getsockname()) == 3


def test_drives_that_stay_on_or_off_do_not_end_command_mode() -> None:
    rig = Rig().command_mode()
    rig.session.set_drives(ALL_DRIVES)
    rig.session.set_drives(0x3F)
    assert rig.session.state is State.CMD
    rig.session.set_drives(0)
    assert rig.session.state is State.MON
    without = Rig().open()
    without.session.set_drives(0)
    without.cycles(20)
    without.session.fri_start()
    without.cycle()
    without.session.set_drives(0)
    assert without.session.state is State.CMD
