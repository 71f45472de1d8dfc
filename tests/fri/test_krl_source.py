"""KRL text: what it means, and what is refused with its line."""

from __future__ import annotations

import numpy as np
import pytest

from fri.errors import ConfigurationError, RobotError
from fri.handshake import IdentificationHandshake
from fri.krc import EventKind
from fri.krl import Interpreter, KrlProgram
from fri.krl_source import parse_source
from fri.krl_system import AXES, NoMachinery
from fri.krl_tree import (
    Aggregate,
    Assign,
    Binary,
    Branch,
    Call,
    Constant,
    Declaration,
    For,
    Halt,
    Ignored,
    Leave,
    Loop,
    Move,
    Name,
    Unary,
    WaitFor,
    WaitSeconds,
)
from fri.packets import JOINT_NAMES, new_cmd, new_msr
from fri.states import Control, State
from lwr_driver.session.motor_torque import KrlMotorTorque, KrlTorqueDecoder
from sim_backend.program import krl_program
from tests.fri.fri_rig import Rig


def run(body: str, ticks: int = 5, data: str = "", **settings: int) -> tuple[KrlProgram, Rig]:
    rig = Rig()
    program = KrlProgram(f"DEF p( )\n{body}\nEND\n", data, settings)
    for _ in range(ticks):
        if not program.finished:
            program.step(rig.session)
    return program, rig


def ints(body: str, **options: object) -> list[int]:
    _, rig = run(body, **options)
    return rig.session.to_int.tolist()


@pytest.mark.parametrize(
    ("expression", "value"),
    [
        ("2+3*4", 14),
        ("(2+3)*4", 20),
        ("-7/2", -3),
        ("10-3-2", 5),
        ("7/2*2", 6),
    ],
)
def test_arithmetic_is_that_of_krl(expression: str, value: int) -> None:
    assert ints(f"$FRI_TO_INT[1]={expression}")[0] == value


@pytest.mark.parametrize(
    ("condition", "holds"),
    [
        ("1==1 AND 2<>2 OR 3<4", True),
        ("NOT 1==1", False),
        ("NOT (1==2) AND (2<=2)", True),
        ("$FRISTATE==#MON", False),
        ("$FRISTATE==#OFF", True),
    ],
)
def test_conditions(condition: str, holds: bool) -> None:
    found = ints(f"IF {condition} THEN\n$FRI_TO_INT[2]=1\nELSE\n$FRI_TO_INT[2]=2\nENDIF")
    assert found[1] == (1 if holds else 2)


def test_loops_and_switch() -> None:
    body = """
    INT I, N=0
    FOR I=1 TO 10
      SWITCH I
      CASE 1, 2
        N=N+100
      CASE 3
        N=N+10
      DEFAULT
        N=N+1
      ENDSWITCH
      IF I==5 THEN
        EXIT
      ENDIF
    ENDFOR
    WHILE N<300
      N=N+50
    ENDWHILE
    $FRI_TO_INT[I]=N   ; I stands where EXIT left it
    """
    assert ints(body)[4] == 312


def test_a_wait_lasts_whole_ticks() -> None:
    program, _ = run("WAIT SEC 0.036", ticks=3)
    assert not program.finished
    program, _ = run("WAIT SEC 0.036", ticks=4)
    assert program.finished
    # 2000 ticks of 12 ms.
    assert not run("WAIT SEC 24.0", ticks=2000)[0].finished
    assert run("WAIT SEC 24.0", ticks=2001)[0].finished


def test_settings_take_the_place_of_the_data_list() -> None:
    data = 'DEFDAT p\nDECL INT N=3 ; three\nDECL CHAR HOST[4]\nHOST[]="abcd"\nENDDAT'
    assert ints("$FRI_TO_INT[1]=N", data=data)[0] == 3
    assert ints("$FRI_TO_INT[1]=N", data=data, n=4)[0] == 4
    with pytest.raises(ConfigurationError, match="no variable Q; it has HOST, N"):
        run("", data=data, Q=1)


@pytest.mark.parametrize(
    ("body", "message"),
    [
        ("X=1", "line 2: there is no variable X"),
        ("$FRISTATE=1", "line 2: .FRISTATE cannot be written"),
        ("$FRI_TO_INT=1", "line 2: .FRI_TO_INT needs an index"),
        ("friOpen()", "line 2: FRIOPEN takes 1 arguments, not 0"),
        ("kick()", "line 2: there is no function KICK"),
        ("IF 1==1 THEN\nENDLOOP", "line 3: ENDLOOP closes nothing; ELSE or ENDIF is expected"),
        ("LOOP", "line 3: END closes nothing; ENDLOOP is expected"),
        ("WAIT 3", "line 2: WAIT takes FOR or SEC"),
        ("$FRI_TO_INT[1]=", "line 2: the line ends"),
        ("$FRI_TO_INT[1]=1 2", "line 2: '2' is too much"),
        ("$FRI_TO_INT[1]=?", "line 2: .* is not understood"),
        ("$LOAD.CM.Q=1", "line 2: there is no variable"),
        ("E6AXIS L\nL={A1 1 A2 2}", "line 3: .*A2"),
        ("E6AXIS L\nL={1, 2}", "line 3: '1' is no field"),
    ],
)
def test_what_is_not_krl_is_refused_with_its_line(body: str, message: str) -> None:
    with pytest.raises(ConfigurationError, match=message):
        run(body)


def test_a_loop_that_never_waits_and_a_wrong_index_are_found_when_they_run() -> None:
    with pytest.raises(RobotError, match="line 2: the loop never waits"):
        run("LOOP\nENDLOOP")
    with pytest.raises(RobotError, match=r"line 3: \$FRI_TO_INT\[17\] is outside 1 to 16"):
        run("INT I=17\n$FRI_TO_INT[I]=1")


def as_krl(load: np.ndarray) -> tuple[float, ...]:
    """Load data of the link as the controller has them: the axes of the inertia are not turned."""
    return (*load[:4].tolist(), 0.0, 0.0, 0.0, *load[4:].tolist())


class Bench:
    """Our own program beside a client that speaks its handshake."""

    def __init__(self) -> None:
        self.machinery = NoMachinery()
        self.rig = Rig(sample_time_ms=2)
        self.program = krl_program("lwr_identification", 2, self.machinery)
        self.interpreter = Interpreter(self.rig.session, self.program)
        self.handshake = IdentificationHandshake()

    def cycles(self, count: int) -> list[np.ndarray]:
        seen = []
        for _ in range(count):
            if self.rig.session.state is State.OFF:
                self.rig.session.close_cycle()
            else:
                self.rig.cycle()
                seen.append(self.rig.msr.copy())
            self.interpreter.advance(2)
        return seen


def test_currents_arrive_in_kinematic_order_each_with_a_new_count() -> None:
    bench = Bench()
    bench.cycles(20)
    krl_order = ("A1", "A2", "A3", "A4", "A5", "A6", "E1")
    assert tuple(JOINT_NAMES[place] for place in AXES) == krl_order
    seen = []
    for step in range(60):
        bench.machinery.currents[:] = step + 0.1 * np.arange(7)
        seen += bench.cycles(1)
    rows = np.array(seen)
    decoder = KrlTorqueDecoder(KrlMotorTorque())
    times = np.arange(len(rows)) * 2_000_000
    fresh = decoder.decode(times, times, rows["krl_real"], rows["krl_int"])
    assert decoder.torn == decoder.lost == decoder.restarts == 0
    assert np.allclose(np.diff(fresh.log_time), 12_000_000)
    assert np.allclose(fresh.effort - fresh.effort[:, :1], 0.1 * np.arange(7), atol=1e-5)


def test_load_data_are_taken_in_monitor_mode_only_and_reported() -> None:
    bench = Bench()
    bench.cycles(40)
    load = np.array([3.34, 0.0, -66.0, 66.0, 0.01, 0.02, 0.03])
    bench.handshake.request_load(bench.rig.cmd, bench.rig.msr, load)
    bench.cycles(20)
    assert bench.handshake.load_taken(bench.rig.cmd, bench.rig.msr)
    assert bench.machinery.load == pytest.approx(as_krl(load))
    assert bench.handshake.load(bench.rig.msr) == pytest.approx([3.34, 0.0, -66.0, 66.0])
    # The same load is not asked for again, another one is; in command mode it has to wait.
    bench.handshake.request_load(bench.rig.cmd, bench.rig.msr, load)
    assert bench.rig.cmd["krl_int"][13] == 1
    bench.handshake.request_start(bench.rig.cmd, bench.rig.msr, Control.POSITION)
    bench.cycles(200)
    assert bench.handshake.started(bench.rig.msr)
    bench.handshake.request_load(bench.rig.cmd, bench.rig.msr, np.zeros(7))
    bench.cycles(60)
    assert not bench.handshake.load_taken(bench.rig.cmd, bench.rig.msr)
    bench.handshake.request_stop(bench.rig.cmd, bench.rig.msr)
    bench.cycles(60)
    assert bench.handshake.load_taken(bench.rig.cmd, bench.rig.msr)
    assert bench.machinery.load == (0.0,) * 10


@pytest.mark.parametrize("mass", [-1.0, 15.0])
def test_a_load_that_cannot_be_is_not_taken(mass: float) -> None:
    bench = Bench()
    bench.cycles(40)
    bench.handshake.request_load(bench.rig.cmd, bench.rig.msr, np.array([mass, 0, 0, 0, 0, 0, 0]))
    bench.cycles(40)
    assert not bench.handshake.load_taken(bench.rig.cmd, bench.rig.msr)
    assert bench.machinery.load == (0.0,) * 10


def test_the_program_ends_when_it_is_asked_to() -> None:
    bench = Bench()
    bench.cycles(40)
    bench.handshake.request_close(bench.rig.cmd, bench.rig.msr)
    seen = bench.cycles(300)
    assert bench.program.finished
    assert bench.rig.session.state is State.OFF
    assert seen[-1]["krl_int"][15] == 5
    assert not bench.handshake.opened(seen[-1])


def test_phases_on_the_wire() -> None:
    handshake, cmd, msr = IdentificationHandshake(), new_cmd(), new_msr()
    msr["krl_int"][15], msr["state"] = 6, State.MON
    assert not handshake.opened(msr)
    assert not handshake.stopped(msr)
    handshake.request_start(cmd, msr, Control.POSITION)
    assert cmd["krl_int"][15] == 22
    msr["krl_int"][15], msr["state"] = 4, State.MON
    assert not handshake.started(msr)


def test_a_damaged_bit_is_no_request_and_no_load() -> None:
    bench = Bench()
    bench.cycles(40)
    bench.handshake.request_start(bench.rig.cmd, bench.rig.msr, Control.POSITION)
    bench.cycles(200)
    assert bench.handshake.started(bench.rig.msr)
    for bit in range(31):
        bench.rig.cmd["krl_int"][15] = 22 ^ 1 << bit
        bench.cycles(10)
        assert bench.rig.session.state is State.CMD, f"bit {bit} of the request"
    bench.handshake.request_stop(bench.rig.cmd, bench.rig.msr)
    bench.cycles(60)
    load = np.array([3.34, 0.0, -66.0, 66.0, 0.01, 0.02, 0.03])
    bench.handshake.request_load(bench.rig.cmd, bench.rig.msr, load)
    bench.cycles(40)
    good = bench.rig.cmd.copy()
    for bit in range(31):
        bench.rig.cmd["krl_int"][13] = good["krl_int"][13] ^ 1 << bit
        bench.rig.cmd["krl_real"][0] = 0.0
        bench.cycles(10)
    bench.rig.cmd[...] = good
    bench.rig.cmd["krl_int"][12:14] = (-7, 7)
    bench.rig.cmd["krl_real"][3] = 600.0
    bench.cycles(20)
    assert bench.machinery.load == pytest.approx(as_krl(load))


def test_after_a_fallback_a_damaged_request_does_not_start_anything() -> None:
    bench = Bench()
    bench.cycles(40)
    bench.handshake.request_start(bench.rig.cmd, bench.rig.msr, Control.POSITION)
    bench.cycles(200)
    bench.rig.session.drop(EventKind.EXTERNAL, "test")
    bench.cycles(100)
    for bit in range(31):
        bench.rig.cmd["krl_int"][15] = 22 ^ 1 << bit
        bench.cycles(10)
        bench.rig.cmd["krl_int"][15] = 22
        bench.cycles(10)
    bench.cycles(200)
    assert bench.rig.session.state is State.MON
    assert bench.rig.msr["krl_int"][15] == 6


def only_statement(line: str) -> object:
    """The tree of a line, with some declarations around it."""
    data = "DECL INT N=3\nDECL REAL R=-1.5\nDECL BOOL B=TRUE\nDECL CHAR HOST[8]"
    source = parse_source(f"DEF p( )\n{line}\nEND\n", data)
    (statement,) = source.subprograms["P"].body
    return statement


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ('friSetup("10.0.0.1", 7)', Call("FRISETUP", (Constant("10.0.0.1"), Constant(7)), 2)),
        ("N=1.5", Assign(Name("N"), Constant(1.5), 2)),
        ("N=2", Assign(Name("N"), Constant(2), 2)),
        ("B=FALSE", Assign(Name("B"), Constant(False), 2)),
        ("B=true", Assign(Name("B"), Constant(True), 2)),
        ("N=#MON", Assign(Name("N"), Constant("#MON"), 2)),
        ("N=-N*2", Assign(Name("N"), Binary("*", Unary("-", Name("N")), Constant(2)), 2)),
        (
            "$FRI_TO_INT[N+1]=R",
            Assign(Name("$FRI_TO_INT", Binary("+", Name("N"), Constant(1))), Name("R"), 2),
        ),
        ("WAIT SEC 0.012", WaitSeconds(Constant(0.012), 2)),
        ("WAIT FOR B", WaitFor(Name("B"), 2)),
        ("PTP XHOME", Move(Name("XHOME"), 2)),
        ("PTP_REL {A1 0.5}", Move(Aggregate((("A1", Constant(0.5)),)), 2, relative=True)),
        ("L={LOAD: M 3.5}", Assign(Name("L"), Aggregate((("M", Constant(3.5)),)), 2)),
        ("L={A1 1, A2 2}", Assign(Name("L"), Aggregate((("A1", Constant(1)), ("A2", Constant(2)))), 2)),
        ("L={}", Assign(Name("L"), Aggregate(()), 2)),
        ("HALT", Halt(2)),
        ("INTERRUPT ON 3", Ignored("INTERRUPT ON 3", 2)),
        ("EXIT", Leave("EXIT", 2)),
        ("RETURN", Leave("RETURN", 2)),
        ("RETURN N", Leave("RETURN", 2, Name("N"))),
        ("T[2].X=1.", Assign(Name("T", Constant(2), (".X",)), Constant(1.0), 2)),
        ("N='HFF'", Assign(Name("N"), Constant(255), 2)),
    ],
)
def test_a_line_becomes_its_tree(line: str, expected: object) -> None:
    assert only_statement(line) == expected


def test_blocks_keep_their_statements_and_lines() -> None:
    body = "IF B THEN\nN=1\nELSE\nN=2\nN=3\nENDIF"
    one, two, three = (Assign(Name("N"), Constant(k), line) for k, line in ((1, 3), (2, 5), (3, 6)))
    assert only_statement(body) == Branch(Name("B"), (one,), (two, three), 2)
    assert only_statement("IF B THEN\nN=1\nENDIF") == Branch(Name("B"), (one,), (), 2)
    assert only_statement("LOOP\nN=1\nENDLOOP") == Loop((one,), None, 2)
    assert only_statement("WHILE B\nN=1\nENDWHILE") == Loop((one,), Name("B"), 2)
    assert only_statement("FOR N=1 TO 4\nN=1\nENDFOR") == For(Name("N"), Constant(1), Constant(4), (one,), 2)


def test_declarations_have_kind_size_value_and_line() -> None:
    data = 'DEFDAT p\n; nothing\nDECL INT A, B=-2\nREAL C[7]\nDECL CHAR HOST[8]\nHOST[]="abc"\nENDDAT'
    source = parse_source("DEF p( )\nBOOL D=TRUE\nEND\n", data)
    found = source.declarations | source.subprograms["P"].declarations
    assert found == {
        "A": Declaration("A", "INT", 0, None, 3),
        "B": Declaration("B", "INT", 0, Constant(-2.0), 3),
        "C": Declaration("C", "REAL", 7, None, 4),
        "HOST": Declaration("HOST", "CHAR", 8, Constant("abc"), 5),
        "D": Declaration("D", "BOOL", 0, Constant(True), 2),
    }


def test_a_text_fills_its_variable_at_most() -> None:
    data = 'DECL CHAR HOST[4]\nHOST[]="{}"'
    assert parse_source("DEF p( )\nEND", data.format("abcd")).declarations["HOST"].value == Constant("abcd")
    with pytest.raises(ConfigurationError, match="line 2: the text does not fit into HOST"):
        parse_source("DEF p( )\nEND", data.format("abcde"))
    with pytest.raises(ConfigurationError, match="does not fit"):
        parse_source("DEF p( )\nEND", 'DECL INT HOST[4]\nHOST[]="a"')


def test_the_first_subprogram_is_the_main_one() -> None:
    source = parse_source("DEF one( )\nEND\n\nDEF two( )\nN=1\nEND\n", "DECL INT N")
    assert source.main == "ONE"
    assert list(source.subprograms) == ["ONE", "TWO"]
    with pytest.raises(ConfigurationError, match="holds no DEF"):
        parse_source("; nothing\n")


def test_load_data_begin_with_zeros_and_are_set_field_by_field() -> None:
    machinery = NoMachinery()
    body = "$LOAD=L\nL.CM.Y=2.5\nL.M=3\n$FRI_TO_REA[1]=L.CM.Y\n$LOAD.J.Z=0.5\n$FRI_TO_REA[2]=$LOAD.J.Z"
    rig = Rig()
    machinery.set_load((9.0,) * 10)
    program = KrlProgram(f"DEF p( )\nLOAD L\n{body}\nEND\n", machinery=machinery)
    program.step(rig.session)
    assert machinery.load == (0.0,) * 9 + (0.5,)
    assert rig.session.to_real[:3].tolist() == [2.5, 0.5, 0.0]


def test_bits_of_the_words_are_read_and_written_one_by_one() -> None:
    rig = Rig().open()
    rig.begin()
    rig.session.receive(rig.answer(krl_bool=0b0100))
    body = "$FRI_TO_BOOL[16]=$FRI_FRM_BOOL[3]\n$FRI_TO_BOOL[1]=TRUE\n$FRI_TO_BOOL[2]=$FRI_FRM_BOOL[2]"
    body += "\nWAIT SEC 0.012\n$FRI_TO_BOOL[1]=FALSE"
    program = KrlProgram(f"DEF p( )\n{body}\nEND\n")
    rig.session.to_bool = 0b0010
    program.step(rig.session)
    assert rig.session.to_bool == 0x8001
    program.step(rig.session)
    assert rig.session.to_bool == 0x8000


def test_the_strategy_is_position_control_until_another_is_committed() -> None:
    assert ints("$FRI_TO_INT[1]=$STIFFNESS.STRATEGY")[0] == 10
    body = "$STIFFNESS.STRATEGY=30\n$FRI_TO_INT[1]=$STIFFNESS.STRATEGY"
    _, rig = run(body)
    assert rig.session.to_int[0] == 30
    assert rig.session.control is Control.POSITION
    _, rig = run(body + "\n$STIFFNESS.COMMIT=TRUE")
    assert rig.session.control is Control.JNT_IMP
