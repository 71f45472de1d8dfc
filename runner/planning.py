"""The motions of an experiment: the exciting ones, from a plan file or planned now, and whole checked sessions."""

from __future__ import annotations

import io
import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import reduce
from pathlib import Path

import numpy as np
import numpy.typing as npt

from fri.errors import ConfigurationError
from ident.excitation import ExcitationPlan, feasible_fourier
from lwr_driver.arm import Arm
from lwr_driver.arm.cell import Cell
from lwr_driver.arm.collision import CollisionChecker
from lwr_driver.configuration import find
from lwr_driver.motion import Motion, move_to
from lwr_driver.references import Frozen
from runner.experiment_file import Experiment, Payload, SessionPlan
from runner.preflight import (
    Item,
    Preflight,
    check_disk,
    check_motion_limits,
    check_path,
    check_start,
    check_torque,
)
from runner.stopping import check_stops

PLAN = "plan.yaml"
VALIDATION_PLAN = "validation.plan.yaml"
_PLAN_PERIOD_S = 0.01  # between the rows of a plan attached to a log
Vector = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Excitations:
    """The motions of an experiment's sessions.

    exciting : motion of the estimate, `periods` times. unseen : held-out motion, once; None without a session
    for validation.
    """

    exciting: ExcitationPlan
    periods: int
    unseen: ExcitationPlan | None = None

    @classmethod
    def of(cls, experiment: Experiment, arm: Arm, cell: Cell, folder: Path | None = None) -> Excitations:
        """The motions stored in `folder`, the results of the experiment; missing ones are planned now."""

        def motion(name: str, make: Callable[[Experiment, Arm, Cell], ExcitationPlan]) -> ExcitationPlan:
            stored = None if folder is None else stored_plan(folder, name, arm)
            return make(experiment, arm, cell) if stored is None else stored

        validated = any(session.validation for session in experiment.sessions)
        unseen = motion(VALIDATION_PLAN, _plan_unseen) if validated else None
        return cls(motion(PLAN, plan_excitation), experiment.excitation.periods, unseen)

    def save(self, folder: Path) -> None:
        """Write missing plan files into the folder of the results."""
        for name, plan in ((PLAN, self.exciting), (VALIDATION_PLAN, self.unseen)):
            if plan is not None:
                store_plan(folder, name, plan)

    def rows(self, session: SessionPlan, period_s: float) -> Motion:
        """The motion of a session for a controller's period [s], with one phase per period of the motion."""
        if session.validation and self.unseen is not None:
            return excitation_rows(self.unseen, 1)(period_s)
        return excitation_rows(self.exciting, self.periods)(period_s)


def read_plan(path: Path, arm: Arm) -> ExcitationPlan:
    """A plan file for the joints of the arm; ConfigurationError otherwise."""
    plan = ExcitationPlan.load(path)
    if plan.joint_names != arm.joint_names:
        raise ConfigurationError(
            f"{path}: joint_names {', '.join(plan.joint_names)} are not those of {arm.name}, "
            f"{', '.join(arm.joint_names)}; plan the motion for this arm"
        )
    return plan


def stored_plan(folder: Path, name: str, arm: Arm) -> ExcitationPlan | None:
    """The plan made by an earlier run into the folder of the results; None without one.

    Raises ConfigurationError if it changed since, or is of another arm.
    """
    frozen = Frozen(folder)
    there = frozen.kept(name) if frozen.there else (folder / name).is_file()
    return read_plan(folder / name, arm) if there else None


def store_plan(folder: Path, name: str, plan: ExcitationPlan) -> None:
    """Write a plan into the folder of the results, unless it is there, and note its hash."""
    frozen = Frozen(folder)
    if frozen.kept(name) if frozen.there else (folder / name).is_file():
        return
    plan.save(folder / name)
    if frozen.there:
        frozen.keep(name)


def checker(arm: Arm, cell: Cell, payload: Payload | None) -> CollisionChecker:
    """Collision check of the arm in its cell, with the shape of the payload if it is known."""
    return CollisionChecker(arm, cell, None if payload is None else payload.shape)


def plan_excitation(experiment: Experiment, arm: Arm, cell: Cell) -> ExcitationPlan:
    """The experiment's exciting motion, the same period for all sessions.

    With `excitation.plan` the file is read; its motion is checked again before each session. Without it a
    feasible random Fourier motion is planned with the heaviest payload.
    """
    settings = experiment.excitation
    if settings.plan is not None:
        return read_plan(find(settings.plan, beside=experiment.folder), arm)
    return _simple(experiment, arm, cell, settings.seed, settings.periods)


def _plan_unseen(experiment: Experiment, arm: Arm, cell: Cell) -> ExcitationPlan:
    """Another motion than the exciting one: that of `excitation.validation_plan`, or one from the next seed."""
    stored = experiment.excitation.validation_plan
    if stored is not None:
        return read_plan(find(stored, beside=experiment.folder), arm)
    return _simple(experiment, arm, cell, experiment.excitation.seed + 1, 1)


def _simple(experiment: Experiment, arm: Arm, cell: Cell, seed: int, periods: int) -> ExcitationPlan:
    settings = experiment.excitation
    return feasible_fourier(
        arm,
        checker(arm, cell, experiment.heaviest),
        period_s=settings.period_s,
        harmonics=settings.harmonics,
        periods=periods,
        seed=seed,
        speed_scale=settings.speed_scale,
        clearance_m=max(experiment.moves.clearance_m, cell.margin_m),
    )


def excitation_rows(plan: ExcitationPlan, periods: int) -> Callable[[float], Motion]:
    """The plan as rows for a controller's period, with one phase per period of the motion."""

    def rows(period_s: float) -> Motion:
        q = plan.rows(period_s, periods)
        length = (len(q) - 1) // periods
        phases = tuple((index * length, f"period {index + 1}") for index in range(periods))
        return Motion(q, period_s, phases)

    return rows


def attached_plan(motion: Motion) -> bytes:
    """The planned motion for its log: arrays time [s], q [rad], qd, qdd of `plan.npz`, at 100 Hz at most.

    The log has every row anyway: `/joint_command` is the plan as it was sent.
    """
    qd = np.gradient(motion.q, motion.period_s, axis=0)
    qdd = np.gradient(qd, motion.period_s, axis=0)
    last = len(motion) - 1
    rows = np.append(np.arange(0, last, max(1, round(_PLAN_PERIOD_S / motion.period_s))), last)
    buffer = io.BytesIO()
    np.savez_compressed(buffer, time=rows * motion.period_s, q=motion.q[rows], qd=qd[rows], qdd=qdd[rows])
    return buffer.getvalue()


def dwell(q: Vector, duration_s: float, period_s: float, phase: str) -> Motion:
    """Rest at q, (n,) [rad], for `duration_s` [s]."""
    rows = max(2, round(duration_s / period_s) + 1)
    return Motion(np.tile(q, (rows, 1)), period_s, ((0, phase),))


def way(arm: Arm, points: Sequence[Vector], period_s: float, speed_scale: float, phase: str) -> Motion:
    """Straight jerk-limited moves in joint space from point to point, at rest in each, (n,) [rad]."""
    motion = dwell(points[0], 0.0, period_s, phase)
    for start, goal in itertools.pairwise(points):
        motion = motion.join(move_to(arm, start, goal, period_s, speed_scale=speed_scale, phase=phase))
    return motion


def route(
    arm: Arm,
    approach: Sequence[Vector],
    excitation: Motion,
    retreat: Sequence[Vector],
    *,
    speed_scale: float,
    settle_s: float,
    brake_s: float,
) -> Motion:
    """One session as one motion: approach, settle, excite, brake and return.

    approach : points from the present posture to the first row of the excitation. retreat : points from its last
    row to the resting posture. speed_scale : of the velocity limits, for both. settle_s, brake_s : rest before
    and after the excitation [s].
    """
    period, first, last = excitation.period_s, excitation.q[0], excitation.q[-1]
    parts = (
        way(arm, [*approach, first], period, speed_scale, "move_to_start"),
        dwell(first, settle_s, period, "settle"),
        excitation,
        dwell(last, brake_s, period, "brake"),
        way(arm, [last, *retreat], period, speed_scale, "return"),
    )
    return reduce(Motion.join, parts)


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

    The straight way to the first row of the excitation is tried first, then the way over the home position. The
    arm returns home, or stays at the last row if the way home is not free. If every way fails a check, the first
    one is returned with its failures. folder : of the log.
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
            *check_stops(arm, collision, motion, plan.payload, margin),
        ]
        if folder is not None:
            items.append(check_disk(folder, len(motion)))
        preflight = Preflight(tuple(items))
        if preflight.ok:
            return motion, preflight
        first = first or (motion, preflight)
    assert first is not None
    return first
