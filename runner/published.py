"""The published results, and the same characteristics of a run.

Kolyubin, Shiriaev and Jubien, "Refining Dynamics Identification for Co-Bots: Case Study on KUKA LWR4+",
IFAC-PapersOnLine 50-1 (2017): Table 1 (excitation trajectories) and Table 2 (essential base parameters).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from fri.errors import LwrError
from ident.dynamics.kinematics import Chain
from lwr_driver.configuration import CONFIGS, find

if TYPE_CHECKING:
    from ident.estimation.identification import Identification
    from ident.excitation import Assembled, ExcitationPlan

SOURCE = (
    "Kolyubin, Shiriaev, Jubien: Refining Dynamics Identification for Co-Bots: Case Study on KUKA LWR4+. "
    "IFAC-PapersOnLine 50-1 (2017)"
)


# Difference of lengths [m] and angles [rad] within one kind of arm.
_SAME = 0.01


@dataclass(frozen=True)
class PublishedMotion:
    """A row of Table 1. mean_torque : mean |joint torque| of joints 1 to 7 with the payload [Nm]."""

    name: str
    constraints: str
    condition: float
    mean_torque: tuple[float, ...]


@dataclass(frozen=True)
class PublishedParameter:
    """An entry of Table 2: estimate in SI units and its relative standard deviation [%]."""

    name: str
    estimate: float
    rsd_percent: float


TABLE_1 = (
    PublishedMotion("Random points", "yes", 84.21, (3.05, 45.09, 6.78, 18.58, 2.17, 2.28, 1.04)),
    PublishedMotion("Optimised, algorithm 1", "yes", 34.01, (3.12, 41.71, 9.30, 13.24, 2.12, 1.56, 0.92)),
    PublishedMotion("Optimised, algorithm 2", "yes", 37.23, (4.63, 42.26, 10.23, 14.05, 1.56, 1.64, 1.64)),
)

REBUILT = {
    "Random points": "plans/published/random_points.plan.yaml",
    "Optimised, algorithm 1": "plans/published/algorithm_1.plan.yaml",
    "Optimised, algorithm 2": "plans/published/algorithm_2.plan.yaml",
}
"""Motions by the rules of Table 1, whose own coefficients were not published; made by `benchmarks.excitation`."""


def is_published_arm(chain: Chain) -> bool:
    """Whether the arm has the joints of the LWR4+, so that its parameters compare with the published ones.

    Base, flange, zero positions and directions of the joints may differ.
    """
    known = Chain.from_urdf((CONFIGS / "lwr4plus.urdf").read_text(encoding="utf-8"))
    if chain.n != known.n:
        return False
    pairs = [(getattr(chain, name), getattr(known, name)) for name in ("alpha", "d", "r")]
    inner = slice(1, -1)
    return all(np.allclose(np.abs(a[inner]), np.abs(b[inner]), atol=_SAME) for a, b in pairs)


@dataclass(frozen=True)
class PredictedMotion:
    """What a motion promises before it is driven, for Model 2 with the 49 parameters of Table 2.

    The noise of the torques is the published one, and each session has equally many independent samples, so motions
    can be compared. mean_rsd, worst_rsd : of the relative standard deviations, equation (15) [%]. mean_torque : with
    the payload [Nm].
    """

    complies: bool
    condition: float
    mean_rsd: float
    worst_rsd: float
    mean_torque: tuple[float, ...]


@cache
def _assembled() -> Assembled:
    from ident.excitation import PlanProblem, assemble  # on use: the planner is slow to import

    return assemble(PlanProblem.load("plans/default.yaml"))


def predicted(plan: ExcitationPlan) -> PredictedMotion | None:
    """The prediction for a plan of the arm of Table 1; None for another arm."""
    if plan.joint_names != _assembled().setup.mechanism.joint_names:
        return None
    from ident.excitation import table_row

    row = table_row("", _assembled(), plan.motion, plan.check)
    return PredictedMotion(
        row.complies, row.condition, row.rsd_mean, row.rsd_worst, tuple(row.torque.tolist())
    )


@cache
def rebuilt(name: str) -> PredictedMotion:
    """The prediction for a motion of Table 1 rebuilt by its rule. name : of `REBUILT`."""
    from ident.excitation import ExcitationPlan

    found = predicted(ExcitationPlan.load(find(REBUILT[name])))
    assert found is not None
    return found


def planned(folder: Path) -> tuple[PredictedMotion, str] | None:
    """The prediction for the plan of a run and the objective of its search; None without such a plan."""
    from ident.excitation import ExcitationPlan

    file = folder / "plan.yaml"
    try:
        plan = ExcitationPlan.load(file) if file.is_file() else None
    except LwrError:
        return None
    found = None if plan is None else predicted(plan)
    if plan is None or found is None:
        return None
    problem = plan.provenance.get("problem")
    objective = problem.get("objective") if isinstance(problem, dict) else None
    return found, str(objective["criterion"]) if isinstance(objective, dict) else ""


_TABLE_2 = """
Ia1 3.14 1.68    Fvm1 16.68 0.84   Fcm1 15.04 1.02   Ia2 2.58 5.42     Fvm2 19.09 1.29   Fcm2 16.48 1.43
offm2 2.09 6.91  Ia3 2.14 1.85     Fvm3 7.87 1.14    Fcm3 8.77 1.12    Ia4 1.97 4.20     Fvm4 11.63 1.61
Fcm4 9.96 2.11   Ia5 0.67 8.37     Fvm5 5.39 1.87    Fcm5 5.58 1.47    Ia6 0.38 6.51     Fvm6 3.64 1.63
Fcm6 4.41 1.41   Ia7 0.42 3.18     Fvm7 2.03 1.78    Fcm7 4.16 1.62    offm7 -0.54 7.31  Fcl1 0.79 2.70
offl1 0.28 7.33  Fcl2 0.41 2.24    offl2 -0.87 1.37  Fcl3 0.22 2.85    Fcl4 0.17 4.63    offl4 0.26 2.97
Fcl5 0.35 2.47   offl5 0.10 8.12   Fcl7 0.34 6.05    offl7 0.29 6.96   XX2R 1.36 0.93    ZZ2R 1.40 1.01
MY2R 3.46 0.06   XX4R 0.44 0.58    ZZ4R 0.45 0.73    MY4R -1.37 0.08   MY5R 0.04 1.89    MY6R 0.03 3.23
XX8 0.09 2.65    YY8 0.07 3.85     YZ8 0.03 5.03     ZZ8 0.02 12.70    MY8 -0.22 0.55    MZ8 0.48 0.34
M8 3.34 0.09
"""


_words = iter(_TABLE_2.split())
TABLE_2 = tuple(
    PublishedParameter(name, float(value), float(rsd)) for name, value, rsd in zip(*[_words] * 3, strict=True)
)
"""The 49 essential base parameters of Model 2, in the order of the paper."""


def characteristics(found: Identification) -> dict[str, Any]:
    """Condition numbers and mean torques of the sessions of an identification, as in Table 1.

    condition : of the unscaled, unweighted observation matrix, over all base parameters (`base`), the essential
        parameters of this run (`essential`) and the 49 of Table 2 (`paper`). The last one is the definition in
        agreement with Table 1. None if the run lacks any of the parameters.
    mean_torque_nm : by session file and joint, mean |joint torque sensor| over the excitation [Nm].
    """
    names = list(found.problem.names)
    wanted = [entry.name for entry in TABLE_2]
    condition: dict[str, float | None] = {"base": found.condition, "essential": None, "paper": None}
    if found.essential is not None and len(found.essential.names):
        condition["essential"] = found.problem.select(found.essential.columns).condition
    if set(wanted) <= set(names):
        condition["paper"] = found.problem.select([names.index(name) for name in wanted]).condition
    torque = {
        session.name: dict(zip(session.joint_names, session.mean_torque, strict=True))
        for session in found.prepared
        if session.mean_torque
    }
    return {"condition": condition, "mean_torque_nm": torque}
