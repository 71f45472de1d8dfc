"""What Table 1 says of a motion: condition number, mean torque, for the motion that was really driven."""

from __future__ import annotations

from typing import Any

from ident.estimation.identify import Identification
from runner.published import TABLE_2

__all__ = ["characteristics"]


def characteristics(found: Identification) -> dict[str, Any]:
    """Condition numbers and mean torques of the sessions that an identification was made from.

    condition : of the unscaled, unweighted observation matrix, over all base parameters (`base`), the
        essential parameters of this run (`essential`) and the 49 of the paper's Table 2 (`paper`, the
        definition that its Table 1 agrees with); null where the run does not have them.
    mean_torque_nm : by session file and joint, mean |joint torque sensor| over the excitation [Nm].
    """
    names = list(found.problem.names)
    wanted = [entry.name for entry in TABLE_2]
    condition: dict[str, float | None] = {"base": found.condition, "essential": None, "paper": None}
    if found.essential is not None and len(found.essential.names):
        condition["essential"] = found.problem.select(found.essential.columns).condition
    if set(wanted) <= set(names):
        condition["paper"] = found.problem.select([names.index(name) for name in wanted]).condition
    return {"condition": condition, "mean_torque_nm": _mean_torque(found)}


def _mean_torque(found: Identification) -> dict[str, dict[str, float]]:
    return {
        session.name: dict(zip(session.joint_names, session.mean_torque, strict=True))
        for session in found.prepared
        if session.mean_torque
    }
