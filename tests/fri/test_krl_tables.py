"""The tables of the controller: structures, first values, bounds and arguments, as the manuals of KUKA give them."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from fri.errors import ConfigurationError, RobotError
from fri.krl import KrlProgram
from fri.krl_system import (
    AXES,
    FUNCTIONS,
    HERE,
    LOAD,
    NoMachinery,
    System,
    Table,
    axes,
    duplicate,
    first_value,
    get,
    positions,
    put,
)
from tests.fri.fri_rig import Rig

POSE = "X Y Z A B C"
EXTERNAL = "E1 E2 E3 E4 E5 E6"
SPRINGS = "A1 A2 A3 A4 A5 A6 E1"


def fields(value: Any, before: str = "") -> Iterator[tuple[str, Any]]:
    """Dotted names and values of a structure."""
    for name, inner in value.items():
        if isinstance(inner, dict):
            yield from fields(inner, f"{before}{name}.")
        else:
            yield f"{before}{name}", inner


def system() -> System:
    """The variables of a controller in monitor mode."""
    made = System(NoMachinery())
    made.session = Rig().open().session
    return made


@pytest.mark.parametrize(
    ("kind", "names"),
    [
        ("AXIS", "A1 A2 A3 A4 A5 A6"),
        ("E6AXIS", f"A1 A2 A3 A4 A5 A6 {EXTERNAL}"),
        ("FRAME", POSE),
        ("POS", f"{POSE} S T"),
        ("E6POS", f"{POSE} S T {EXTERNAL}"),
        ("LOAD", "M CM.X CM.Y CM.Z CM.A CM.B CM.C J.X J.Y J.Z"),
    ],
)
def test_a_structure_has_its_fields_and_begins_at_zero(kind: str, names: str) -> None:
    assert dict(fields(first_value(kind, 0))) == dict.fromkeys(names.split(), 0.0)


def test_the_springs_begin_with_kukas_values() -> None:
    found = dict(fields(system().read("$STIFFNESS", ())))
    assert (found.pop("STRATEGY"), found.pop("COMMIT"), found.pop("FRAMETYPE")) == (10, False, "#TOOL")
    stiff = {name: value for name, value in found.items() if value != 0.0}
    assert stiff == {f"AXISSTIFFNESS.{a}": 1000.0 for a in SPRINGS.split()} | {
        f"AXISDAMPING.{a}": 0.7 for a in SPRINGS.split()
    }
    zero = {name.split(".")[0]: name for name in found if name not in stiff}
    assert len(found) == 4 * 7 + 7 * 6
    assert set(zero) == {
        "BASE", "TOOL", "TASKFRAME", "AXISMAXDELTA", "AXISMAXDELTATRQ",
        "CPSTIFFNESS", "CPDAMPING", "CPMAXDELTA", "MAXFORCE",
    }  # fmt: skip


@pytest.mark.parametrize(
    ("kind", "value"),
    [("INT", 0), ("REAL", 0.0), ("BOOL", False), ("CHAR", ""), ("FRISTATE", "#OFF"), ("NOVELTY", {})],
)
def test_a_variable_without_a_value_is_empty(kind: str, value: object) -> None:
    found = first_value(kind, 0)
    assert (found, type(found)) == (value, type(value))
    many = first_value(kind, 4)
    if kind == "CHAR":
        assert many == ""
    else:
        assert (many[2], many.size) == (value, 4)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("$ADVANCE", 3), ("$OV_PRO", 100), ("$OV_ROB", 100), ("$OV_JOG", 10), ("$NUM_AX", 6), ("$EX_AX_NUM", 1),
        ("$ACT_TOOL", 1), ("$ACT_BASE", 0), ("$BWDSTART", False), ("$STOPMESS", False), ("$IPO_MODE", "#BASE"),
        ("$TRUE", True), ("$PRO_STATE", "#P_ACTIVE"), ("$IOSYS_IN_TRUE", True),
        *((name, 100) for name in ("$VEL_AXIS[2]", "$ACC_AXIS[2]", "$VEL_EXTAX[1]", "$ACC_EXTAX[1]")),
        *((name, False) for name in ("$OUT[9]", "$IN[9]", "$FLAG[9]", "$CYCFLAG[9]")),
        *((name, 0.0) for name in ("$ANOUT[3]", "$ANIN[3]", "$TORQUE_AXIS_EST[7]")),
        ("TOOL_NAME[4]", ""), ("BASE_NAME[4]", ""),
    ],
)  # fmt: skip
def test_a_kept_variable_has_its_first_value(name: str, value: object) -> None:
    title, _, index = name.rstrip("]").partition("[")
    path = (int(index),) if index else ()
    found = system().read(title, path)
    assert (found, type(found)) == (value, type(value))
    kept = system()
    kept.write(title, path, 7)
    assert kept.read(title, path) == 7
    assert system().read(title, path) == value


@pytest.mark.parametrize(
    ("title", "least", "most"),
    [
        *((f"$FRI_{way}_{kind}", 1, 16) for way in ("TO", "FRM") for kind in ("INT", "REA", "BOOL")),
        ("$CURR_ACT", 1, 7),
        ("$TORQUE_AXIS_ACT", 1, 7),
        ("$GRAVITATION", 1, 3),
        ("$TIMER", 1, 64),
        ("$TIMER_STOP", 1, 64),
        ("$TIMER_FLAG", 1, 64),
    ],
)
def test_an_array_of_the_controller_has_its_bounds(title: str, least: int, most: int) -> None:
    found = system()
    assert System.array(title) == most
    for index in (least, most):
        found.read(title, (index,))
    for index in (least - 1, most + 1):
        with pytest.raises(RobotError, match=rf"\[{index}\] is outside 1 to {most}"):
            found.read(title, (index,))
    with pytest.raises(RobotError, match="outside"):
        found.read(title, ())
    assert System.array("$OUT") == 0


def test_what_the_controller_measures_cannot_be_written() -> None:
    measured = [
        *HERE, "$FRISTATE", "$FRIQUALITY", "$ON_PATH", "$ROB_STOPPED", "$MODE_OP", "$DRIVES_ON", "$PERI_RDY",
        "$FRI_FRM_INT", "$FRI_FRM_REA", "$FRI_FRM_BOOL", "$CURR_ACT", "$TORQUE_AXIS_ACT", "$TIMER_FLAG",
    ]  # fmt: skip
    assert all(System.read_only(title) for title in measured)
    ours = ("$FRI_TO_INT", "$STIFFNESS", "$LOAD", "$TIMER", "$TIMER_STOP", "$GRAVITATION", "$OUT", "$MSG_T")
    assert not any(System.read_only(title) for title in ours)


# The least and the largest number of arguments.
ARGUMENTS = {
    "FRISETUP": (3, 3), "FRIOPEN": (1, 1), "FRISTART": (1, 1), "FRISTOP": (0, 0), "FRICLOSE": (0, 0),
    "FRISHOW": (0, 0), "BAS": (1, 2), "SWRITE": (4, 12), "SREAD": (4, 12), "CWRITE": (3, 12), "VARSTATE": (1, 1),
    "ABS": (1, 1), "SQRT": (1, 1), "SIN": (1, 1), "COS": (1, 1), "TAN": (1, 1), "ACOS": (1, 1), "ATAN2": (2, 2),
}  # fmt: skip


@pytest.mark.parametrize("name", sorted(FUNCTIONS))
def test_a_function_takes_no_fewer_and_no_more_arguments(name: str) -> None:
    def call(count: int) -> KrlProgram:
        return KrlProgram(f"DEF p( )\n{name}({','.join(['1'] * count)})\nEND\n")

    least, most = ARGUMENTS[name]
    for count in range(least, most + 1):
        assert not call(count).remarks
    for count in {most + 1, least - 1} - {-1}:
        with pytest.raises(ConfigurationError, match=f"{name} takes {most} arguments, not {count}"):
            call(count)


@pytest.mark.parametrize(
    ("value", "kept"),
    [
        (2.0**31, 2**31 - 1),
        (2**31 - 1, 2**31 - 1),
        (-(2.0**31), -(2**31)),
        (-3e9, -(2**31)),
        (4e9, 2**31 - 1),
    ],
)
def test_a_whole_number_for_the_client_ends_with_its_32_bits(value: float, kept: int) -> None:
    found = system()
    found.write("$FRI_TO_INT", (3,), value)
    assert found.read("$FRI_TO_INT", (3,)) == kept


def test_bits_for_the_client_are_set_and_cleared_one_by_one() -> None:
    found = system()
    for number in (1, 4, 16):
        found.write("$FRI_TO_BOOL", (number,), True)
    found.write("$FRI_TO_BOOL", (4,), False)
    assert [k for k in range(1, 17) if found.read("$FRI_TO_BOOL", (k,))] == [1, 16]
    assert found.session is not None
    assert found.session.to_bool == 0x8001


def test_axes_of_krl_are_the_joints_in_their_order_with_a2_from_the_vertical() -> None:
    q = np.radians([10.0, 20.0, 30.0, 40.0, 50.0, 60.0, 70.0])
    found = axes(q)
    assert AXES == (0, 1, 3, 4, 5, 6, 2)
    expected = {"A1": 10.0, "A2": 110.0, "A3": 40.0, "A4": 50.0, "A5": 60.0, "A6": 70.0, "E1": 30.0}
    assert {name: found.pop(name) for name in expected} == pytest.approx(expected)
    assert found == dict.fromkeys(("E2", "E3", "E4", "E5", "E6"), 0.0)
    np.testing.assert_allclose(
        positions({"A2": 80.0, "E1": 5.0}, q), np.radians([10, -10, 5, 40, 50, 60, 70])
    )
    np.testing.assert_allclose(
        positions({"A2": 1.0, "A6": -2.0}, q, relative=True), np.radians([10, 21, 30, 40, 50, 60, 68])
    )


def test_currents_torques_and_gravity_are_read_by_axis() -> None:
    found = system()
    found.machinery.currents, found.machinery.joint_torque = np.arange(7.0), 10.0 * np.arange(7)
    assert [found.read("$CURR_ACT", (k,)) for k in range(1, 8)] == [0.0, 1.0, 3.0, 4.0, 5.0, 6.0, 2.0]
    assert [found.read("$TORQUE_AXIS_ACT", (k,)) for k in range(1, 8)] == [0, 10, 30, 40, 50, 60, 20]
    found.machinery.currents = None
    with pytest.raises(RobotError, match=r"\$CURR_ACT\[2\] does not exist"):
        found.read("$CURR_ACT", (2,))
    found.write("$GRAVITATION", (2,), 4.0)
    assert found.machinery.gravity == (0.0, 4.0, 9.81)


def test_load_data_are_written_part_by_part() -> None:
    found = system()
    for number, name in enumerate(LOAD, start=1):
        found.write("$LOAD", tuple(name[1:].split(".")), float(number))
    assert found.machinery.load == tuple(map(float, range(1, 11)))
    assert dict(fields(found.read("$LOAD", ()))) == {
        name[1:]: float(number) for number, name in enumerate(LOAD, start=1)
    }
    found.machinery.load = (2.0,) * 10
    assert found.read("$LOAD", ("CM", "Y")) == 2.0


def test_a_message_is_taken_once_it_is_valid() -> None:
    found = system()
    found.write("$MSG_T", ("KEY",), "done")
    assert found.machinery.said == []
    found.write("$MSG_T", ("VALID",), True)
    assert (found.machinery.said, found.read("$MSG_T", ("VALID",))) == (["done"], False)
    found.write("$MSG_T", (), {"VALID": False, "KEY": "later"})
    assert found.machinery.said == ["done"]


def test_springs_are_in_force_with_their_commit() -> None:
    found, seen = system(), []
    found.machinery.set_impedance = lambda stiffness, damping: seen.append((stiffness, damping))
    found.write("$STIFFNESS", ("AXISSTIFFNESS",), {"A3": 300.0, "E1": 500.0})
    found.write("$STIFFNESS", ("AXISDAMPING", "A1"), 0.3)
    found.write("$STIFFNESS", ("COMMIT",), False)
    assert not seen
    found.write("$STIFFNESS", ("COMMIT",), True)
    ((stiffness, damping),) = seen
    assert stiffness.tolist() == [1000.0, 1000.0, 500.0, 300.0, 1000.0, 1000.0, 1000.0]
    assert damping.tolist() == [0.3, 0.7, 0.7, 0.7, 0.7, 0.7, 0.7]
    found.write("$STIFFNESS", (), {"COMMIT": False})
    assert len(seen) == 2


def test_a_letter_of_a_text_is_counted_from_one_and_others_have_no_parts() -> None:
    assert (get("ABC", (1,), "T"), get("ABC", (3,), "T")) == ("A", "C")
    for value, path in (("ABC", ("X",)), (5, (1,)), ({"X": 1.0}, ("Y",)), ({"X": 1.0}, ("X", "Y"))):
        with pytest.raises(RobotError, match=f"V has no part {path[-1]}"):
            get(value, path, "V")
    with pytest.raises(RobotError, match="V has no part X"):
        put(5, ("X",), 1.0, "V")
    table = Table(0.0, 3)
    assert put(table, (3,), 2.0, "V") is table
    assert (get(table, (3,), "V"), get(table, (1,), "V")) == (2.0, 0.0)
    for index in (0, 4):
        with pytest.raises(RobotError, match=rf"V\[{index}\] is outside 1 to 3"):
            put(table, (index,), 2.0, "V")


def test_copies_and_elements_share_nothing() -> None:
    table = Table({"X": 1.0})
    table[1]["X"] = 5.0
    copy = duplicate(table)
    copy[1]["X"], copy[2]["X"] = 7.0, 8.0
    assert (table[1]["X"], table[2]["X"], copy[3]["X"]) == (5.0, 1.0, 1.0)
    assert (duplicate(table).size, duplicate(Table(0, 4)).size) == (0, 4)


@pytest.mark.parametrize("index", ["NOVEL", "1+NOVEL", "ABS(NOVEL)"])
@pytest.mark.parametrize("statement", ["$FRI_TO_INT[{}]=1", "X=$FRI_TO_INT[{}]", "LOAD_DATA[{}].M=1.0"])
def test_an_unknown_name_within_an_index_is_found_before_the_program_runs(index: str, statement: str) -> None:
    with pytest.raises(ConfigurationError, match="line 3: there is no variable NOVEL"):
        KrlProgram(f"DEF p( )\nDECL INT X\n{statement.format(index)}\nEND\n")


@pytest.mark.parametrize(("passes", "ends"), [(2000, True), (2002, False)])
@pytest.mark.parametrize(("head", "foot"), [("WHILE N<{}", "ENDWHILE"), ("REPEAT", "UNTIL N>={}")])
def test_a_loop_passes_two_thousand_times_without_a_wait(
    passes: int, ends: bool, head: str, foot: str
) -> None:
    body = f"DECL INT N\nN=0\n{head.format(passes)}\nN=N+1\n{foot.format(passes)}\n$FRI_TO_INT[1]=N"
    rig, program = Rig().open(), KrlProgram(f"DEF p( )\n{body}\nEND\n")
    if ends:
        program.step(rig.session)
        assert int(rig.session.to_int[0]) == passes
    else:
        with pytest.raises(RobotError, match="line 4: the loop never waits"):
            program.step(rig.session)


@pytest.mark.parametrize(("deep", "ends"), [(99, True), (101, False)])
def test_a_subprogram_calls_itself_a_hundred_times_at_most(deep: int, ends: bool) -> None:
    text = f"DEF p( )\nDOWN({deep})\n$FRI_TO_INT[1]=1\nEND\nDEF DOWN(N:IN)\nINT N\nIF N>1 THEN\nDOWN(N-1)\nENDIF\nEND\n"
    rig, program = Rig().open(), KrlProgram(text)
    if ends:
        program.step(rig.session)
        assert program.finished
    else:
        with pytest.raises(RobotError, match="DOWN calls itself without end"):
            program.step(rig.session)
