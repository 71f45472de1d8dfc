"""What earlier sessions already tell: their information, which the new motion only has to complete.

A prior is a motion that has been run, known as a plan file or as the session logs that were recorded.
Sequential design: the criteria act on the sum of both, so the new motion is strong where the earlier ones
were weak.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from fri.errors import ConfigurationError
from ident.excitation.estimate import ArmEstimate, Noise
from ident.excitation.information import Assembly, Columns, Rows
from ident.excitation.mechanism import Mechanism
from ident.excitation.motion import Array, Samples
from ident.excitation.objectives import View
from ident.excitation.plan import ExcitationPlan
from ident.excitation.problem import PlanProblem, Prior
from ident.excitation.views import motion_view, samples_view
from ident.rows.prepare import prepare
from lwr_driver.configuration import find
from lwr_driver.session import read_session

__all__ = ["prior_information"]


def prior_information(
    problem: PlanProblem,
    mechanism: Mechanism,
    estimate: ArmEstimate,
    columns: Columns,
    names: tuple[str, ...],
    noise: Noise | None,
) -> Array | None:
    """Information (p, p) of all priors, None without any.

    With `noise` it is weighted and counts independent samples at the rate of the planned sessions; without,
    it is unweighted and counts in multiples of one planned session, as the condition number needs it.
    """
    if not problem.prior:
        return None
    n = mechanism.joints
    planned = problem.motion.periods * problem.motion.period_s
    total = np.zeros((len(names), len(names)))
    for entry in problem.prior:
        for loaded, view, duration in _motions(problem, entry, mechanism, estimate, columns):
            if noise is None:
                rows, share = Rows.unweighted(n, problem.model, (loaded,)), duration / planned
            else:
                rows = Rows(problem.model, (loaded,), noise.joint**-2.0, noise.motor**-2.0)
                share = noise.samples * duration / planned
            total += share * Assembly(columns, names, rows).information(view.gram)
    return total


def _motions(
    problem: PlanProblem, entry: Prior, mechanism: Mechanism, estimate: ArmEstimate, columns: Columns
) -> list[tuple[bool, View, float]]:
    """Loaded or not, the view, and the duration [s] of each session of one prior."""
    beside = problem.source.parent if problem.source is not None else None
    if entry.plan is not None:
        done = ExcitationPlan.load(find(entry.plan, beside=beside))
        if done.joint_names != mechanism.joint_names:
            raise ConfigurationError(f"prior plan {entry.plan} is for joints {' '.join(done.joint_names)}")
        view = motion_view(done.motion, mechanism, estimate, columns)
        return [(session == "loaded", view, done.duration_s) for session in entry.sessions]
    assert entry.session is not None
    return [_recorded(find(entry.session, beside=beside), mechanism, estimate, columns)]


def _recorded(
    path: Path, mechanism: Mechanism, estimate: ArmEstimate, columns: Columns
) -> tuple[bool, View, float]:
    session = read_session(path).select(mechanism.joint_names)
    prepared = prepare(session, motor=False)
    parts = [[getattr(passage.joint, key) for passage in prepared.passages] for key in ("q", "qd", "qdd")]
    q, qd, qdd = (np.ascontiguousarray(np.vstack(part)) for part in parts)
    duration = sum(len(passage.rows) for passage in prepared.passages) * prepared.row_time_s
    loaded = session.metadata.get("payload", "none").strip() not in ("", "none")
    return (
        loaded,
        samples_view(Samples(q, qd, qdd, np.zeros_like(q)), mechanism, estimate, columns),
        float(duration),
    )
