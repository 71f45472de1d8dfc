"""The exciting motions of an experiment: from a plan file, or simple feasible ones planned now."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from fri.errors import ConfigurationError
from ident.excitation import ExcitationPlan, feasible_fourier
from lwr_driver.arm import Arm
from lwr_driver.arm.cell import Cell
from lwr_driver.arm.collision import CollisionChecker
from lwr_driver.configuration import find
from lwr_driver.motion import Motion
from runner.experiment_file import Experiment, Payload, SessionPlan

__all__ = ["PLAN", "VALIDATION_PLAN", "Excitations", "checker", "excitation_rows", "plan_excitation"]

PLAN = "plan.yaml"
VALIDATION_PLAN = "validation.plan.yaml"


@dataclass(frozen=True)
class Excitations:
    """The motions of an experiment's sessions.

    exciting : what the estimate is made from, `periods` times. unseen : what it is held against, once; None
    where no session is for validation.
    """

    exciting: ExcitationPlan
    periods: int
    unseen: ExcitationPlan | None = None

    @classmethod
    def of(cls, experiment: Experiment, arm: Arm, cell: Cell, folder: Path | None = None) -> Excitations:
        """The motions stored in `folder`, the results of the experiment; what is not there is planned now."""

        def stored(name: str, make: Callable[[Experiment, Arm, Cell], ExcitationPlan]) -> ExcitationPlan:
            path = None if folder is None else folder / name
            if path is not None and path.is_file():
                return ExcitationPlan.load(path)
            return make(experiment, arm, cell)

        validated = any(session.validation for session in experiment.sessions)
        return cls(
            stored(PLAN, plan_excitation),
            experiment.excitation.periods,
            stored(VALIDATION_PLAN, _plan_unseen) if validated else None,
        )

    def save(self, folder: Path) -> None:
        """Write the plans that are not there yet into the folder of the results."""
        for name, plan in ((PLAN, self.exciting), (VALIDATION_PLAN, self.unseen)):
            if plan is not None and not (folder / name).is_file():
                plan.save(folder / name)

    def rows(self, session: SessionPlan, period_s: float) -> Motion:
        """The motion of a session for a controller's period [s], each period of it a phase of its own."""
        if session.validation and self.unseen is not None:
            return excitation_rows(self.unseen, 1)(period_s)
        return excitation_rows(self.exciting, self.periods)(period_s)


def checker(arm: Arm, cell: Cell, payload: Payload | None) -> CollisionChecker:
    """Collision check of the arm in its cell with the shape of a payload, where it has one."""
    return CollisionChecker(arm, cell, None if payload is None else payload.shape)


def plan_excitation(experiment: Experiment, arm: Arm, cell: Cell) -> ExcitationPlan:
    """The experiment's exciting motion, one period of which serves all of its sessions.

    With `excitation.plan` the file is read; what it holds is checked again before each motion. Without it a
    feasible random Fourier motion is planned with the payload that is largest in mass.
    """
    settings = experiment.excitation
    if settings.plan is not None:
        plan = ExcitationPlan.load(find(settings.plan, beside=experiment.folder))
        if plan.joint_names != arm.joint_names:
            raise ConfigurationError(
                f"{settings.plan}: joints {', '.join(plan.joint_names)} are not those of {arm.name}, "
                f"{', '.join(arm.joint_names)}; plan the motion for this arm"
            )
        return plan
    return _simple(experiment, arm, cell, settings.seed, settings.periods)


def _plan_unseen(experiment: Experiment, arm: Arm, cell: Cell) -> ExcitationPlan:
    """Another motion than the exciting one: a simple feasible one from the next seed."""
    return _simple(experiment, arm, cell, experiment.excitation.seed + 1, 1)


def _simple(experiment: Experiment, arm: Arm, cell: Cell, seed: int, periods: int) -> ExcitationPlan:
    settings = experiment.excitation
    payloads = sorted(experiment.payloads().values(), key=lambda payload: payload.mass)
    return feasible_fourier(
        arm,
        checker(arm, cell, payloads[-1] if payloads else None),
        period_s=settings.period_s,
        harmonics=settings.harmonics,
        periods=periods,
        seed=seed,
        speed_scale=settings.speed_scale,
        clearance_m=max(experiment.moves.clearance_m, cell.margin_m),
    )


def excitation_rows(plan: ExcitationPlan, periods: int) -> Callable[[float], Motion]:
    """The plan as rows for a controller's period, each period of the motion marked as a phase of its own."""

    def rows(period_s: float) -> Motion:
        q = plan.rows(period_s, periods)
        length = (len(q) - 1) // periods
        phases = tuple((index * length, f"period {index + 1}") for index in range(periods))
        return Motion(q, period_s, phases)

    return rows
