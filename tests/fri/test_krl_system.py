"""Variables and functions of the controller as KRL sees them."""

from __future__ import annotations

import math

import pytest

from fri.errors import ConfigurationError, RobotError
from fri.krl import KrlProgram
from tests.fri.fri_rig import Rig


def reals(body: str, ticks: int = 5, data: str = "") -> list[float]:
    """The values of $FRI_TO_REA after some ticks."""
    rig = Rig()
    program = KrlProgram(f"DEF p( )\n{body}\nEND\n", data)
    for _ in range(ticks):
        if not program.finished:
            program.step(rig.session)
    return [float(value) for value in rig.session.to_real]


def test_inputs_outputs_and_flags_are_off_at_first() -> None:
    body = "\n".join(
        f"$FRI_TO_REA[{k}]=1.0\nIF {name}[{k}] THEN\n$FRI_TO_REA[{k}]=2.0\nENDIF\n{name}[{k}]=TRUE\n"
        f"IF {name}[{k}] THEN\n$FRI_TO_REA[{k}]=$FRI_TO_REA[{k}]+4.0\nENDIF"
        for k, name in enumerate(("$IN", "$OUT", "$FLAG", "$CYCFLAG"), start=1)
    )
    assert reals(body)[:4] == [5.0] * 4


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("$ANIN[2]", 0.0),
        ("$ANOUT[1]", 0.0),
        ("$TORQUE_AXIS_EST[3]", 0.0),
        ("$TORQUE_TCP_EST.FT.Z", 0.0),
        ("$GRAVITATION[1]", 0.0),
        ("$GRAVITATION[2]", 0.0),
        ("$GRAVITATION[3]", 9.81),
        ("$OV_PRO", 100.0),
        ("$VEL_AXIS[3]", 100.0),
        ("$BASE.X", 0.0),
        ("LOAD_DATA[3].CM.Y", 0.0),
        ("$LOAD.M", 0.0),
    ],
)
def test_first_values_of_the_controller(name: str, value: float) -> None:
    assert reals(f"$FRI_TO_REA[1]={name}")[0] == pytest.approx(value)


@pytest.mark.parametrize("index", [0, 4])
@pytest.mark.parametrize("statement", ["$FRI_TO_REA[1]=A[I]", "A[I]=1.0"])
def test_an_array_ends_with_its_last_element(statement: str, index: int) -> None:
    with pytest.raises(RobotError, match=rf"A\[{index}\] is outside 1 to 3"):
        reals(f"DECL REAL A[3]\nDECL INT I\nI={index}\n{statement}")


def test_structures_in_arrays_are_read_as_they_were_set() -> None:
    body = "TOOL_DATA[2]={X 1.5,Y 2.5,Z -3.0,A 0.0,B 0.0,C 0.0}\nTOOL_DATA[3].Y=7.0\n"
    body += "$FRI_TO_REA[1]=TOOL_DATA[2].Y\n$FRI_TO_REA[2]=TOOL_DATA[3].Y\n$FRI_TO_REA[3]=TOOL_DATA[3].X\n"
    body += "LOAD_DATA[1].CM={X 4.0,Y 5.0,Z 6.0,A 0.0,B 0.0,C 0.0}\n$FRI_TO_REA[4]=LOAD_DATA[1].CM.Z"
    assert reals(body)[:4] == [2.5, 7.0, 0.0, 6.0]


def test_a_timer_runs_from_its_value_until_it_is_stopped() -> None:
    body = "$TIMER[1]=-20\n$FRI_TO_REA[1]=$TIMER[1]\n$TIMER_STOP[1]=FALSE\nWAIT SEC 0.012\n$FRI_TO_REA[2]=$TIMER[1]\n"
    body += "IF $TIMER_FLAG[1] THEN\n$FRI_TO_REA[6]=1.0\nENDIF\nWAIT SEC 0.012\n$TIMER_STOP[1]=TRUE\n"
    body += "$FRI_TO_REA[3]=$TIMER[1]\nWAIT SEC 0.012\n$FRI_TO_REA[4]=$TIMER[1]\n"
    body += "IF $TIMER_FLAG[1] THEN\n$FRI_TO_REA[7]=1.0\nENDIF\n"
    body += "$TIMER_STOP[1]=FALSE\n$TIMER[1]=100\nWAIT SEC 0.012\n$FRI_TO_REA[5]=$TIMER[1]"
    assert reals(body, ticks=20)[:7] == [-20.0, -8.0, 4.0, 4.0, 112.0, 0.0, 1.0]


@pytest.mark.parametrize(
    ("call", "value"),
    [
        ("ABS(-2.5)", 2.5),
        ("SQRT(9.0)", 3.0),
        ("SIN(30.0)", 0.5),
        ("COS(60.0)", 0.5),
        ("TAN(45.0)", 1.0),
        ("ACOS(0.5)", 60.0),
        ("ATAN2(1.0,-1.0)", 135.0),
        ("2.0*SIN(ACOS(0.0))", 2.0),
    ],
)
def test_functions_take_and_give_degrees(call: str, value: float) -> None:
    found = reals(f"$FRI_TO_REA[1]={call}")[0]
    assert math.isclose(found, value, rel_tol=1e-6)


@pytest.mark.parametrize("name", ["ABS", "SQRT", "SIN", "COS", "TAN", "ACOS", "ATAN2"])
@pytest.mark.parametrize("arguments", ["", "0.1,0.2,0.3"])
def test_a_function_has_its_number_of_arguments(name: str, arguments: str) -> None:
    with pytest.raises((ConfigurationError, RobotError), match=name):
        reals(f"$FRI_TO_REA[1]={name}({arguments})")


def test_an_unknown_variable_is_made_as_it_is_used_and_a_known_one_must_be_set() -> None:
    body = "$NOVELTY.A=2.0\n$FRI_TO_REA[1]=$NOVELTY.A\n$FRI_TO_REA[2]=$NOVELTY.B\n"
    body += "$OTHER[3]=5.0\n$FRI_TO_REA[3]=$OTHER[3]\n$FRI_TO_REA[4]=$OTHER[2]\n$FRI_TO_REA[5]=$THIRD"
    assert reals(body)[:5] == [2.0, 0.0, 5.0, 0.0, 0.0]
    with pytest.raises(RobotError, match="CDIS"):
        reals("$FRI_TO_REA[1]=$APO.CDIS")


@pytest.mark.parametrize(
    ("header", "passes", "after"),
    [
        ("FOR K=1 TO 3", [1, 2, 3], 4),
        ("FOR K=3 TO 1 STEP -1", [3, 2, 1], 0),
        ("FOR K=1 TO 6 STEP 2", [1, 3, 5], 7),
        ("FOR K=1 TO 0", [], 1),
        ("FOR K=0 TO 1 STEP -1", [], 0),
        ("FOR K=2 TO 2 STEP -1", [2], 1),
        ("FOR K=2 TO 1 STEP 0", [], 2),
    ],
)
def test_a_count_goes_from_the_first_to_the_last(header: str, passes: list[int], after: int) -> None:
    body = f"DECL INT K,N\nN=0\n{header}\nN=N+1\n$FRI_TO_REA[N]=K\nENDFOR\n$FRI_TO_REA[8]=K"
    found = reals(body)
    assert found[: len(passes) + 1] == [*map(float, passes), 0.0]
    assert found[7] == after


@pytest.mark.parametrize("statement_ms", [0.0, 0.5])
def test_a_function_gives_its_value_and_a_plain_return_none(statement_ms: float) -> None:
    rig = Rig()
    program = KrlProgram(
        "DEF p( )\n$FRI_TO_REA[1]=HALF(7.0)\n$FRI_TO_REA[2]=HALF(HALF(8.0))\nEARLY()\n"
        "$FRI_TO_REA[4]=1.0\nEND\n"
        "DEFFCT REAL HALF(X:IN)\nREAL X\nRETURN X/2.0\nENDFCT\n"
        "DEF EARLY( )\nRETURN\n$FRI_TO_REA[3]=1.0\nEND\n",
        statement_ms=statement_ms,
    )
    for _ in range(50):
        if not program.finished:
            program.step(rig.session)
    assert [float(value) for value in rig.session.to_real[:4]] == [3.5, 2.0, 0.0, 1.0]
