"""Writes the tables of docs/import_mapping.md anew: python docs/mapping_table.py."""

from __future__ import annotations

import dataclasses
import types
import typing
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from ident.import_log import LogMapping

PAGE = Path(__file__).with_name("import_mapping.md")
MARK = "<!-- written by docs/mapping_table.py -->\n"

# key: (meaning, unit, example)
KEYS = {
    "schema_version": ("version of this format", "", "1"),
    "robot": ("model of the arm, for the metadata", "", "Staubli TX40"),
    "serial": ("serial number of the arm", "", "F07_2611"),
    "joints": ("joint names as in the URDF; they choose the chain", "", "[joint_1, joint_2]"),
    "urdf": ("URDF of the arm, beside the mapping file; null: joint names are not checked", "", "arm.urdf"),
    "held": (
        "where other joints between them rest; those not named are at 0",
        "rad or m",
        "{joint_3: -1.57}",
    ),
    "base": (
        "first link of the arm, gravity points down in its axes; null: the root of the URDF",
        "",
        "base_link",
    ),
    "tip": ("last link of the arm; null: the link behind the last joint", "", "tool0"),
    "payload": ("name of the payload; `none`: the empty flange", "", "none"),
    "payload_mass": ("its weighed mass", "kg", "3.34"),
    "start_utc": ("UTC of time 0 of the clock", "", '"2016-04-07T13:01:04+00:00"'),
    "source": ("origin of the recording, for the metadata", "", "laboratory of ..."),
    "delimiter": ("of text files; null: semicolon, comma, tab or blanks, as found", "", '";"'),
    "header": ("whether text files name their columns in the first row; null: by its content", "", "false"),
    "time": ("times of the samples: either a column or a rate", "", "{column: t, unit: ms}"),
    "time.column": ("name or number (from 1) of the time column, or name of an array", "", "t"),
    "time.file": ("file of the column; null: that of the signal", "", "time.txt"),
    "time.unit": ("unit of the column", "", "ms"),
    "time.rate_hz": ("rate of a recording without a time column", "Hz", "5000"),
    "time.zero": (
        "`start`: the clock counts from a moment of its own; `unix`: from 1970-01-01 UTC",
        "",
        "unix",
    ),
    "time.equal": (
        "samples with the same time: an error, or spread evenly up to the next time",
        "",
        "spread",
    ),
    "position": ("measured joint positions", "", "{columns: [q1, q2], unit: rad}"),
    "velocity": ("measured joint velocities", "", "{columns: [dq1, dq2], unit: deg/s}"),
    "joint_torque": ("joint torque sensors, behind the gear", "", "{columns: [tau1, tau2], unit: Nm}"),
    "motor_torque": ("motor torques or currents", "", "{columns: [i1, i2], unit: mA, torque_constant: 0.09}"),
    "motor_position": (
        "motor positions, at the times of `motor_torque`",
        "",
        "{columns: [m1, m2], unit: rev, side: motor}",
    ),
    "command": ("commanded joint positions", "", "{columns: [qd1, qd2], unit: rad}"),
    "position.unit": (
        "unit of the numbers; `counts` need `scale`, currents `torque_constant` or `scale`",
        "",
        "deg",
    ),
    "position.file": (
        "file of the signal, or a list of one for each joint; null: the source itself",
        "",
        "q.csv",
    ),
    "position.columns": (
        "names or numbers (from 1), one a joint; null: those called like the joints, or all",
        "",
        "[2, 3]",
    ),
    "position.array": (
        "array of an NPZ or MATLAB file (`struct.field`) or a bag (`/joint_states/position`)",
        "",
        "log.q",
    ),
    "position.side": (
        "`motor`: before the gear; null: `motor` with a `torque_constant`, else `joint`",
        "",
        "motor",
    ),
    "position.sign": ("1 or -1, for all joints or for each", "", "[1, -1]"),
    "position.scale": ("factor, for all joints or for each", "rad a count, Nm/A", "0.5"),
    "position.torque_constant": ("of the motor, for all joints or for each", "Nm/A", "[0.11, 0.09]"),
    "position.time": (
        "a clock of its own, for `motor_torque` and `command`; null: the common `time`",
        "",
        "{column: t2}",
    ),
    "transmission": ("gears, required for signals on the motor side", "", "{reduction: [100, -101]}"),
    "transmission.reduction": (
        "turns of the motor for one of the joint, negative for opposite directions",
        "",
        "[100, -101]",
    ),
    "transmission.coupling": (
        "drives that also turn with another joint",
        "",
        "[{motor: j6, joint: j5, ratio: 32}]",
    ),
    "transmission.coupling.motor": ("the motor", "", "j6"),
    "transmission.coupling.joint": ("the other joint", "", "j5"),
    "transmission.coupling.ratio": ("turns of the motor for one turn of that joint", "", "32"),
    "periods": (
        "of the excitation; null: as the positions show them",
        "",
        "{period_s: 20.0, start_s: 1.5, count: 2}",
    ),
    "periods.period_s": ("length; null: the recording from `start_s` on in `count` parts", "s", "20.0"),
    "periods.start_s": ("beginning of the first one, after the first sample taken", "s", "1.5"),
    "periods.count": ("number; null: all that fit; 0: none, and none are looked for", "", "2"),
    "offset_rad": ("added to the joint positions, to meet the zero of the URDF", "rad", "[0, -1.5708]"),
}
ALIKE = ("velocity.", "joint_torque.", "motor_torque.", "motor_position.", "command.", "position.time.")


def declared(kind: type = LogMapping, prefix: str = "") -> Iterator[tuple[str, str, str]]:
    """Key, default and allowed values of every field; the keys of all signals are alike and appear once."""
    hints = typing.get_type_hints(kind)
    for field in dataclasses.fields(kind):
        hint, key = hints[field.name], prefix + field.name
        if key.startswith(ALIKE):
            continue
        default = "required" if field.default is dataclasses.MISSING else _yaml(field.default)
        yield key, default, ", ".join(f"`{word}`" for word in _words(hint))
        for part in (hint, *typing.get_args(hint)):
            if dataclasses.is_dataclass(part):
                yield from declared(typing.cast(type, part), f"{key}.")


def _words(hint: Any) -> Iterator[str]:
    if typing.get_origin(hint) is typing.Literal:
        yield from map(str, typing.get_args(hint))
    elif typing.get_origin(hint) in (typing.Union, types.UnionType):
        for part in typing.get_args(hint):
            yield from _words(part)


def _yaml(value: Any) -> str:
    if value is None:
        return "null"
    return "[]" if value == () else '""' if value == "" else str(value)


def table() -> str:
    """All keys as a table."""
    head = "| key | default | unit or values | example | meaning |\n| --- | --- | --- | --- | --- |\n"
    rows = []
    fields = {key: rest for key, *rest in declared()}
    for key, (meaning, unit, example) in KEYS.items():
        default, words = fields[key]
        rows.append(
            f"| `{key}` | {default} | {unit or (words if words.count('`') > 2 else '')} | `{example}` | {meaning} |\n"
        )
    return head + "".join(rows)


if __name__ == "__main__":
    text = PAGE.read_text(encoding="utf-8")
    PAGE.write_text(text[: text.index(MARK) + len(MARK)] + "\n" + table(), encoding="utf-8")
