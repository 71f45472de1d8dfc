"""Planning of exciting motions: parametrisations, criteria, constraints, search, and the resulting plan.

`plan("plans/default.yaml")` does everything; `lower_bound` tells how far from the best its motion may be.
`feasible_fourier` gives a safe motion without optimisation, `random_points` a random motion to compare with,
`trade_off` a front between two criteria, `check_motion` the verdict on any motion.

The search runs through `joblib`; its configured backend spreads it over processes or computers. On a Dask cluster, with
`search.jobs: -1` in the problem file::

    import joblib, distributed
    from ident.excitation import plan

    client = distributed.Client("tcp://scheduler:8786")
    with joblib.parallel_config(backend="dask"):
        result = plan("plans/default.yaml")

The result depends on the seed and the counts of the problem file, not on the backend or the number of processes.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from fri.on_first_use import on_first_use

if TYPE_CHECKING:
    from ident.excitation.arm_model import ArmEstimate, Mechanism, Noise
    from ident.excitation.assembly import Assembled, arm_limits, assemble
    from ident.excitation.check import Check, Limits, Margin, Workspace, check_motion
    from ident.excitation.comparison import (
        TableRow,
        hypervolume,
        not_dominated,
        random_points,
        table,
        table_row,
        trade_off,
    )
    from ident.excitation.lower_bound import LowerBound, can_bound, lower_bound
    from ident.excitation.motions import FourierBasis, FourierSeries, PointToPoint, SplineBasis, SplineMotion
    from ident.excitation.plan import ExcitationPlan, plan_pieces
    from ident.excitation.planner import Progress, feasible_fourier, plan
    from ident.excitation.problem import Knowledge, MotionForm, Objective, PlanProblem, Prior, Search

__all__ = [
    "ArmEstimate",
    "Assembled",
    "Check",
    "ExcitationPlan",
    "FourierBasis",
    "FourierSeries",
    "Knowledge",
    "Limits",
    "LowerBound",
    "Margin",
    "Mechanism",
    "MotionForm",
    "Noise",
    "Objective",
    "PlanProblem",
    "PointToPoint",
    "Prior",
    "Progress",
    "Search",
    "SplineBasis",
    "SplineMotion",
    "TableRow",
    "Workspace",
    "arm_limits",
    "assemble",
    "can_bound",
    "check_motion",
    "feasible_fourier",
    "hypervolume",
    "lower_bound",
    "not_dominated",
    "plan",
    "plan_pieces",
    "random_points",
    "table",
    "table_row",
    "trade_off",
]

_HOMES = {
    ".arm_model": (
        "ArmEstimate",
        "Mechanism",
        "Noise",
    ),
    ".assembly": (
        "Assembled",
        "arm_limits",
        "assemble",
    ),
    ".check": (
        "Check",
        "Limits",
        "Margin",
        "Workspace",
        "check_motion",
    ),
    ".comparison": (
        "TableRow",
        "hypervolume",
        "not_dominated",
        "random_points",
        "table",
        "table_row",
        "trade_off",
    ),
    ".lower_bound": (
        "LowerBound",
        "can_bound",
        "lower_bound",
    ),
    ".motions": (
        "FourierBasis",
        "FourierSeries",
        "PointToPoint",
        "SplineBasis",
        "SplineMotion",
    ),
    ".plan": (
        "ExcitationPlan",
        "plan_pieces",
    ),
    ".planner": (
        "Progress",
        "feasible_fourier",
        "plan",
    ),
    ".problem": (
        "Knowledge",
        "MotionForm",
        "Objective",
        "PlanProblem",
        "Prior",
        "Search",
    ),
}

__getattr__, __dir__ = on_first_use(globals(), _HOMES)
