"""KRL as laboratories write it: declarations, folds, structures, functions, nudges, waits, interrupts."""

from __future__ import annotations

import numpy as np
import pytest

from fri.errors import ConfigurationError, RobotError
from fri.krl import Interpreter, KrlProgram
from fri.krl_system import NoMachinery
from fri.states import State
from tests.fri.fri_rig import DEG, Q_START, Rig

DATA = """&ACCESS RVP
&PARAM EDITMASK = *
DEFDAT  LABOR PUBLIC
;FOLD EXTERNAL DECLARATIONS;%{PE}%MKUKATPBASIS
EXT  BAS (BAS_COMMAND  :IN,REAL  :IN )
EXTFCT INT SOMEWHERE (INT :IN)
DECL INT SUCCESS
int n, k
DECL FRISTATE answer
;ENDFOLD
DECL STATE_T status
DECL BASIS_SUGG_T last={POINT1[] "P2      ; no comment",CONT[] "  ",VEL[] "2.0"}
DECL E6POS XP1={X -525.5,Y -3.4E-05,Z 659.2,A 0.0,B -45.2,C 0.0,S 5,T 28,E1 0.0}
DECL FDAT FP1={TOOL_NO 1,BASE_NO 0,IPO_FRAME #BASE,POINT2[] " ",TQ_STATE FALSE}
DECL E6AXIS READY={A1 10.0,A2 60.0,A3 70.0,A4 0.0,A5 40.0,A6 5.0,E1 0.0}
DECL REAL speeds[3]
speeds[1]=1.5
speeds[3]=-2.5
ENDDAT
"""

PROGRAM = """&ACCESS RVP
&REL 4
DEF  labor ( )
;FOLD INI
  DECL STIFFNESS SOFT
  DECL INT IP[4]
  GLOBAL INTERRUPT DECL 3 WHEN $STOPMESS==TRUE DO IR_STOPM ( )
  INTERRUPT ON 3
  BAS (#INITMOV,0 )
;ENDFOLD (INI)
answer = friStop()
answer=FRICLOSE()
FOR k = 1 TO 16 STEP 1
  $fri_to_int[k] = 0
  $FRI_TO_REA[K]=0.0
ENDFOR
$FRI_TO_INT[2] = 10
SOFT=$STIFFNESS
SOFT.STRATEGY=30
SOFT.FRAMETYPE=#TOOL
SOFT.TOOL=TOOL_DATA[2]
SOFT.AXISSTIFFNESS={A1 200, A2 300.0,A3 300, A4 100, A5 50., A6 50, E1 250}
SOFT.CPDAMPING = { x 0.7, y 0.7, z 0.7, a 0.7, b 0.7, c 0.7}
$STIFFNESS=SOFT
$stiffness.strategy=10;
$stiffness.commit = true
$VEL_AXIS[1]=50
$BASE=$NULLFRAME
$TIMER[2]=-50
$TIMER_STOP[2]=FALSE
IP[1]=192
ptp {a1 10,a2 60.5,a4 -1}
PTP TOUCHED($AXIS_ACT) C_PTP
PTP_REL {A6 1.0}
LIN XP1
PTP XP1
$MSG_T.KEY[]="ready; really"
$MSG_T.VALID=TRUE
WAIT FOR ($MSG_T.VALID == FALSE)
answer=friSetup("no",49948,49948)
answer=friOpen(2)
wait for ($FriState==#MON)
SWRITE($MSG_T.KEY[], status, n, "%d", answer)
REPEAT
  n=n+DOUBLE(2)
  $FRI_TO_INT[3]=n
  WAIT SEC 0.012
UNTIL (n>=12) OR FALSE
WHILE NOT $TIMER_FLAG[2]
  $FRI_TO_INT[4]=$FRI_TO_INT[4]+1
  WAIT SEC 0.012
ENDWHILE
IF ($FRI_TO_INT[3]==12) AND (speeds[1]>1.0) THEN
  $FRI_TO_REA[5]=speeds[3]
ENDIF
HALT
SWAP(n, k)
$FRI_TO_INT[5]=n
$FRI_TO_INT[6]=SOMEWHERE(1)
$FRI_TO_INT[7]='H1F' B_AND 'B0110'
END

DEFFCT E6AXIS TOUCHED (ax)
  E6AXIS ax
  DECL E6AXIS an
  an=ax
  IF an.A6<0 THEN
    an.A6=an.A6+0.01
  ELSE
    an.A6 = an.A6 - 0.01
  ENDIF
  RETURN an
ENDFCT

DEFFCT INT DOUBLE(value:IN)
  INT value
  DECL INT an
  an=2*value
  value=0
  RETURN an
ENDFCT

DEF SWAP(first:OUT, second)
  INT first, second, kept
  kept=first
  first=second
  second=kept
END
"""


class Arm(NoMachinery):
    """An arm at the setpoint of its session."""

    def __init__(self, rig: Rig) -> None:
        super().__init__()
        self.rig = rig

    @property
    def position(self) -> np.ndarray:
        return self.rig.session.setpoint

    @position.setter
    def position(self, value: np.ndarray) -> None:
        pass


class Bench:
    def __init__(self, text: str, data: str = "", **options: float) -> None:
        self.rig = Rig(sample_time_ms=2)
        self.machinery = Arm(self.rig)
        self.program = KrlProgram(text, data, machinery=self.machinery, name="labor", **options)
        self.interpreter = Interpreter(self.rig.session, self.program)
        self.ms = 0

    def cycles(self, count: int) -> np.ndarray:
        seen = []
        for _ in range(count):
            session = self.rig.session
            if session.state is State.OFF:
                session.close_cycle()
            else:
                self.rig.cycle()
            self.interpreter.advance(session.sample_time_ms)
            self.ms += session.sample_time_ms
            seen.append(session.setpoint)
            if self.program.finished:
                break
        return np.array(seen)


def test_a_program_with_the_constructs_of_published_ones_runs_to_its_end() -> None:
    bench = Bench(PROGRAM, DATA, halt_s=0.1)
    path = bench.cycles(20_000)
    assert bench.program.finished
    session = bench.rig.session
    assert session.state is State.MON
    assert session.sample_time_ms == 2
    assert session.to_int[:7].tolist()[1:3] == [10, 12]
    # FOR leaves its variable one step behind the end.
    assert session.to_int[4] == 17
    assert session.to_int[6] == 0b00110
    assert session.to_real[4] == -2.5
    # Goals of PTP in degrees; A2 of KRL is 90 degrees more; what is left out stays.
    goal = Q_START.copy()
    goal[[0, 1, 4]] = np.array([10.0, 60.5 - 90.0, -1.0]) * DEG
    goal[6] += (1.0 - 0.01) * DEG
    assert path[-1] == pytest.approx(goal, abs=1e-6)
    assert np.abs(np.diff(path, axis=0)).max() < 0.002 * 2.0944 * 0.26
    assert "ready; really" in bench.machinery.said
    assert any("HALT" in text for text in bench.machinery.said)
    assert any("Cartesian" in text for text in bench.machinery.said)


def test_what_has_no_effect_is_told_with_its_line() -> None:
    remarks = "\n".join(KrlProgram(PROGRAM, DATA, name="labor").remarks)
    assert "labor, line 7: GLOBAL INTERRUPT has no effect" in remarks
    assert "LIN has no effect" in remarks
    assert "SOMEWHERE of another module is passed over" in remarks
    assert "BAS" not in remarks


def test_an_unknown_system_variable_is_told_and_a_misspelt_one_of_the_interface_refused() -> None:
    program = KrlProgram("DEF p( )\n$SOMETHING[3]=2\n$FRI_TO_INT[1]=$SOMETHING_ELSE\nEND\n")
    assert [remark.split(";")[0].split()[-1] for remark in program.remarks] == [
        "$SOMETHING",
        "$SOMETHING_ELSE",
    ]
    rig = Rig()
    program.step(rig.session)
    assert program.finished
    with pytest.raises(ConfigurationError, match=r"line 2: there is no variable \$FRI_TOINT"):
        KrlProgram("DEF p( )\n$FRI_TOINT[1]=2\nEND\n")


def test_statements_take_time() -> None:
    text = "DEF p( )\nLOOP\n$FRI_TO_INT[1]=$FRI_TO_INT[1]+1\nENDLOOP\nEND\n"
    bench = Bench(text, statement_ms=0.5)
    bench.cycles(100)
    # The assignment and the end of each pass: one millisecond.
    assert bench.rig.session.to_int[0] == pytest.approx(bench.ms, abs=4)
    free = Bench(text.replace("ENDLOOP", "WAIT SEC 0.005\nENDLOOP"), statement_ms=0.5)
    free.cycles(120)
    assert free.rig.session.to_int[0] == pytest.approx(free.ms / 12, abs=2)


def test_a_goal_out_of_reach_and_an_early_strategy_stop_the_program_with_the_line() -> None:
    with pytest.raises(RobotError, match="line 2: software limit"):
        Bench("DEF p( )\nPTP {A1 200}\nEND\n").cycles(10)
    with pytest.raises(RobotError, match=r"line 2: .* sample time 200 ms"):
        Bench("DEF p( )\nfriOpen(200)\nEND\n").cycles(10)


def test_motion_waits_for_the_drives_and_begins_anew_after_an_emergency_stop() -> None:
    bench = Bench("DEF p( )\nPTP {A1 60}\nEND\n")
    bench.machinery.powered = False
    bench.cycles(100)
    assert np.array_equal(bench.rig.session.setpoint.astype(np.float32), Q_START.astype(np.float32))
    bench.machinery.powered = True
    moving = bench.cycles(200)[-1, 0]
    bench.machinery.powered = False
    stopped = bench.cycles(50)[-1, 0]
    assert Q_START[0] < stopped < 60 * DEG
    assert abs(stopped - moving) < 0.01
    bench.machinery.powered = True
    bench.cycles(4000)
    assert bench.program.finished
    assert bench.rig.session.setpoint[0] == pytest.approx(60 * DEG, abs=1e-6)


def test_a_motion_of_krl_in_command_mode_is_superposed_by_the_client() -> None:
    text = (
        "DEF p( )\nDECL FRISTATE r\nr=friOpen(2)\nWAIT FOR $FRIQUALITY==#PERFECT\nr=friStart(1.0)\n"
        "WAIT FOR $FRISTATE==#CMD\nPTP {A1 40}\nr=friStop()\n$FRI_TO_INT[1]=-1\nEND\n"
    )
    bench = Bench(text)
    session = bench.rig.session
    for _ in range(3000):
        if session.state is State.OFF:
            session.close_cycle()
        else:
            msr = bench.rig.begin()
            # A client of the kind "KRL's setpoint plus my own".
            session.receive(bench.rig.answer(msr["cmd_jnt_pos"] if msr["state"] == State.CMD else None))
            session.close_cycle()
        bench.interpreter.advance(2)
        if bench.program.finished:
            break
    assert session.to_int[0] == -1
    assert session.counters()["drops"] == 0
    assert session.setpoint[0] == pytest.approx(40 * DEG, abs=1e-4)


def test_a_nudge_of_the_third_joint_alone_moves_it() -> None:
    bench = Bench("DEF labor()\nPTP_REL {E1 0.5}\nPTP_REL {X 5.0, E1 0.5}\nEND")
    moved = np.degrees(np.ptp(bench.cycles(2000), axis=0))
    assert moved == pytest.approx([0.0, 0.0, 0.5, 0.0, 0.0, 0.0, 0.0], abs=1e-3)
    assert [remark for remark in bench.machinery.said if "line 2" in remark] == []


def test_signals_and_global_kinds_of_a_data_list_are_plain_variables() -> None:
    data = "DEFDAT labor PUBLIC\nGLOBAL ENUM KIND FIRST,SECOND\nGLOBAL SIGNAL LAMP $OUT[1]\nENDDAT"
    body = "SIGNAL SPEED $OUT[1] TO $OUT[4]\nLAMP=TRUE\nSPEED=3\nr=friShow()\nIF LAMP THEN\n$FRI_TO_INT[3]=SPEED\nENDIF"
    bench = Bench(f"DEF labor()\nDECL FRISTATE r\n{body}\nEND", data)
    bench.cycles(20)
    assert bench.rig.session.to_int[2] == 3
