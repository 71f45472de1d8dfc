"""Columns without names, told apart by their number and by their derivatives."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from fri.errors import DataError
from ident.dynamics.urdf import Urdf
from ident.import_log.fields import Field
from ident.import_log.rates import ALIKE, compare


def unnamed_columns(
    table: Field, robot: Urdf, joints: Sequence[str], source: Path
) -> tuple[list[Field], dict[str, str]]:
    """A table without names, split by the joints of the longest arm: times, positions, their derivatives, torques.

    joints : of the columns, if the user knows. The reasons are by quantity. Raises DataError for columns that may be
    several things.
    """
    names = joints or robot.arm(names=[joint.name for joint in robot.joints if joint.driven])
    why = {"position": "the first columns", "torque": "the columns left"}
    width, count = table.values.shape[1], len(names)
    grips = {joint.name for joint in robot.joints if joint.grips}
    while not joints and count > 1 and names[count - 1] in grips and width % count > 1:
        count -= 1
    start = width % count
    if start > 1 or width < 2 * count:
        raise DataError(
            f"{source}: {width} columns without names are no positions and torques of {count} joints; name "
            "the joints with --joints, or write a mapping file for `lwr-run import`, or name columns in a first row"
        )
    parts = [
        replace(
            table,
            values=table.values[:, at : at + count],
            columns=tuple(range(at + 1, at + count + 1)),
            labels=tuple(str(k + 1) for k in range(count)),
        )
        for at in range(start, width, count)
    ]
    parts = [part for part in parts if np.ptp(part.values, axis=0).max() > 0.0]
    found = [replace(parts.pop(0), name="position")]
    for quantity in ("velocity", "acceleration"):
        if not parts:
            break
        count_up = np.arange(len(table.values), dtype=np.float64)
        scores = [compare(found[-1].values, part.values, count_up).alike for part in parts]
        if max(scores) > ALIKE:
            found.append(replace(parts.pop(int(np.argmax(scores))), name=quantity))
            why[quantity] = f"correlates {max(scores):.3f} with the change of {found[-2].shown}"
        else:
            break
    if len(parts) != 1:
        listed = "; ".join(part.shown for part in parts) or "none"
        raise DataError(
            f"{source}: of the columns without names these may be torques: {listed}. Write a mapping file for "
            "`lwr-run import`, or name the columns in a first row"
        )
    times = (
        [replace(table, name="time", values=table.values[:, :1], columns=(1,), labels=("",))] if start else []
    )
    return [*times, *found, replace(parts[0], name="torque")], why
