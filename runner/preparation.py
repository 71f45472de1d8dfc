"""The motion of a session, from wherever the arm is, together with every check of it."""

from __future__ import annotations

import itertools
from pathlib import Path

import numpy as np
import numpy.typing as npt

from lwr_driver.arm import Arm
from lwr_driver.arm.cell import Cell
from lwr_driver.motion import Motion
from runner.experiment_file import Experiment, SessionPlan
from runner.planning import checker
from runner.preflight import (
    Item,
    Preflight,
    check_disk,
    check_motion_limits,
    check_path,
    check_start,
    check_torque,
)
from runner.route import route

__all__ = ["session_motion"]


def session_motion(
    experiment: Experiment,
    arm: Arm,
    cell: Cell,
    plan: SessionPlan,
    excitation: Motion,
    start: npt.NDArray[np.float64],
    folder: Path | None = None,
) -> tuple[Motion, Preflight]:
    """One session as one motion from `start`, (n,) [rad], with its preflight.

    The straight way to the first row of the excitation is tried first, then the way over the home position;
    the arm returns home, or stays at the last row where the way home is not free. If no way passes every
    check, the first one is returned with the checks that it fails. `folder` is where the log will go.
    """
    moves = experiment.moves
    home = experiment.home(len(start))
    collision = checker(arm, cell, plan.payload)
    margin = max(moves.clearance_m, cell.margin_m)
    first: tuple[Motion, Preflight] | None = None
    for approach, retreat in itertools.product(([start], [start, home]), ([home], [])):
        motion = route(
            arm,
            approach,
            excitation,
            retreat,
            speed_scale=moves.speed_scale,
            settle_s=moves.settle_s,
            brake_s=moves.brake_s,
        )
        items: list[Item] = [
            check_start(arm, start, excitation.q[0], moves.max_start_distance_rad),
            *check_motion_limits(arm, motion),
            check_torque(arm, motion, plan.payload),
            check_path(collision, motion, margin),
        ]
        if folder is not None:
            items.append(check_disk(folder, len(motion)))
        preflight = Preflight(tuple(items))
        if preflight.ok:
            return motion, preflight
        first = first or (motion, preflight)
    assert first is not None
    return first
