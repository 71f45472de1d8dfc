"""Positions at rest of recorded joints outside the model."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fri.errors import DataError
from ident.dynamics.urdf import Urdf
from ident.import_log.tables import Floats

RESTING_RAD = 1e-2
"""Largest range of a joint at rest; `identify` counts a joint as moving beyond it."""


@dataclass(frozen=True)
class Rests:
    """Positions of joints held for the model [rad or m]. moving : those that move, held at their mean."""

    held: dict[str, float]
    moving: tuple[str, ...]


def rests(
    source: Path,
    names: Sequence[str],
    position: Floats,
    joints: Sequence[str],
    robot: Urdf,
    root: str | None = None,
    tip: str | None = None,
) -> Rests:
    """Mean positions, to four digits, of the recorded joints that act on the chain of `joints` and are not of it.

    names : of the columns of position (n, k) [rad or m]. Joints elsewhere, such as a second arm's, are of no concern.
    Raises DataError for one on the way of the chain that moves: it belongs to `joints`.
    """
    on_way, carried = robot.beside(joints, root, tip)
    held, moving = {}, []
    for k, name in enumerate(names):
        if name not in on_way | carried:
            continue
        size = float(np.ptp(position[:, k]))
        if size > RESTING_RAD and name in on_way:
            raise DataError(
                f"{source}: {name} moves by {size:.3g} rad; name it in --joints, which leaves out joints at rest only"
            )
        if size > RESTING_RAD:
            moving.append(name)
        held[name] = round(float(np.mean(position[:, k])), 4)
    return Rests(held, tuple(moving))


def without_gripper(
    joints: tuple[str, ...], position: Floats, robot: Urdf, root: str | None = None
) -> tuple[str, ...]:
    """The joints of an arm without those of a gripper at its end that rest. position : theirs (n, k) [rad]."""
    left = list(joints)
    for joint in reversed(robot.chain(root, None, joints)):
        if joint.name not in joints:
            continue
        if not joint.grips or np.ptp(position[:, joints.index(joint.name)]) > RESTING_RAD:
            break
        left.remove(joint.name)
    return tuple(left) or joints
