"""The exciting motion of an experiment: taken from its plan file, or a simple feasible one planned now."""

from __future__ import annotations

from collections.abc import Callable

from fri.errors import ConfigurationError
from ident.excitation import ExcitationPlan, feasible_fourier
from lwr_driver.arm import Arm
from lwr_driver.cell import Cell
from lwr_driver.collision import CollisionChecker
from lwr_driver.configuration import find
from lwr_driver.motion import Motion
from runner.experiment_file import Experiment, Payload

__all__ = ["checker", "excitation_rows", "plan_excitation"]


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
    payloads = sorted(experiment.payloads().values(), key=lambda payload: payload.mass)
    return feasible_fourier(
        arm,
        checker(arm, cell, payloads[-1] if payloads else None),
        period_s=settings.period_s,
        harmonics=settings.harmonics,
        periods=settings.periods,
        seed=settings.seed,
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
