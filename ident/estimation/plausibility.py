"""Whether an estimate can be an arm: friction dissipates, drives have inertia, payloads the stated mass.

A bound is broken when it is missed by five standard deviations and the torque of it is a visible share of the joint's:
the hysteresis of a sensor looks like a little negative friction. Friction counts by its power, because its viscous and
its Coulomb part replace each other in a narrow range of speed.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from fri.errors import DataError
from ident.dynamics.base_set import BaseSet
from ident.dynamics.parameters import split_name
from ident.dynamics.structure import ModelStructure
from ident.estimators.estimate import Estimate
from ident.estimators.problem import Problem
from ident.rows.sessions import stated_mass
from ident.screening.doubts import Doubt, settle
from lwr_driver.session import Session

_DEVIATIONS = 5.0
# Least share of the torque of the joint.
_SHARE = 0.1
_FRICTION = {"joint": ("Fvl", "Fcl"), "motor": ("Fvm", "Fcm"), "difference": ("Fvm", "Fcm")}


def check_estimate(problem: Problem, estimate: Estimate, joints: Sequence[str]) -> list[Doubt]:
    """Doubts by the power of friction and the sign of drive inertias of the chain's `joints`, one by one."""
    found = []
    for side in dict.fromkeys(group.side for group in problem.groups):
        wrong = {
            j: text for j in joints if (text := _impossible(problem, estimate, side, j, joints.index(j)))
        }
        for joint, text in wrong.items():
            found.append(
                Doubt(
                    "motor torque" if side == "difference" else f"{side} torque",
                    (joint,),
                    text,
                    "a reversed sign of torque or position, or a late channel",
                    "check the signs of both channels and the delay",
                    len(wrong) > 0.5 * len(joints),
                )
            )
    return found


def require_plausible(problem: Problem, estimate: Estimate, joints: Sequence[str]) -> list[str]:
    """Sentences of `check_estimate` for the report. Raises DataError when most joints of a side are impossible."""
    return settle(check_estimate(problem, estimate, joints))


def payload_warnings(
    sessions: Sequence[Session],
    payloads: Sequence[str | None],
    base: BaseSet,
    estimate: Estimate,
    structure: ModelStructure,
) -> list[str]:
    """Estimated against stated mass of each payload. DataError for a payload not mounted as stated."""
    found = []
    if structure.payloads and None not in payloads:
        found.append(
            "no session of the bare arm is stacked, so the payload's parameters are partly regrouped into "
            "the arm's; add an unloaded session of the same arm"
        )
    for payload in structure.payloads:
        link = structure.payload_link(payload)
        assert link is not None
        name = f"M{link + 1}"
        if name not in base.names:
            continue
        place = base.names.index(name)
        mass, std = float(estimate.values[place]), float(estimate.std[place])
        carriers = [s for s, p in zip(sessions, payloads, strict=True) if p == payload]
        stated = next((m for m in map(stated_mass, carriers) if m is not None), None)
        estimated = f"payload {payload!r}: estimated mass {mass:.3f} ± {std:.3f} kg"
        absent = mass < 3.0 * std if stated is None else mass + 3.0 * std < 0.5 * stated
        if absent:
            names = ", ".join(s.path.name for s in carriers)
            bare = ", ".join(s.path.name for s, p in zip(sessions, payloads, strict=True) if p is None)
            doubt = (
                f"the payloads of {names} and {bare} are interchanged"
                if bare and mass < -3.0 * std
                else f"it was not mounted in {names}, or it was mounted in {bare or 'all sessions'} as well"
            )
            raise DataError(
                f"{estimated}{'' if stated is None else f' against {stated:.3f} kg stated'}: {doubt}; name "
                "the mounted payload (`--payload FILE=NAME`, `none`: the bare arm) or record the session again"
            )
        if stated is not None and abs(mass - stated) > max(0.1 * stated, 3.0 * std):
            found.append(
                f"{estimated} against {stated:.3f} kg stated; check the mounted payload and the torque "
                "sensors' gain"
            )
        elif mass < 3.0 * std:
            found.append(f"{estimated} is not above zero; the motion excites so light a payload too little")
    return found


def _impossible(problem: Problem, estimate: Estimate, side: str, joint: str, number: int) -> str:
    """What is impossible in the rows of a joint and side; empty if nothing."""
    groups = [group for group in problem.groups if (group.side, group.joint) == (side, joint)]
    places = {}
    for name in estimate.names:
        symbol, link, _ = _split(name)
        if link == number + 1:
            places[symbol] = estimate.names.index(name)
    texts = []
    matrix = estimate.covariance.matrix
    torque = float(np.sqrt(sum(float(group.target @ group.target) for group in groups)))
    if not groups or torque <= 0.0:
        return ""
    rubbing = [places[symbol] for symbol in _FRICTION[side] if symbol in places]
    if side == "motor" and "Fvm" not in places:
        # Motor torques alone: friction of both sides in one.
        rubbing = [places[symbol] for symbol in _FRICTION["joint"] if symbol in places]
    if rubbing:
        # Power of the friction over the speed, the column of the viscous part.
        speed = [group.matrix[:, rubbing[0]] for group in groups]
        direction = np.zeros(len(estimate.names))
        for k in rubbing:
            direction[k] = sum(float(v @ group.matrix[:, k]) for v, group in zip(speed, groups, strict=True))
        power, std = float(direction @ estimate.values), float(np.sqrt(direction @ matrix @ direction))
        rub = [group.matrix[:, rubbing] @ estimate.values[rubbing] for group in groups]
        share = float(np.sqrt(sum(float(part @ part) for part in rub))) / torque
        if power + _DEVIATIONS * std < 0.0 and share > _SHARE:
            values = " and ".join(
                f"{estimate.names[k]} {estimate.values[k]:.3g} ± {estimate.std[k]:.2g}" for k in rubbing
            )
            texts.append(f"friction drives the joint ({values}, {100 * share:.0f} % of the torque)")
    if side != "joint" and "Ia" in places:
        k = places["Ia"]
        value, std = float(estimate.values[k]), float(estimate.std[k])
        size = float(np.sqrt(sum(float(np.sum(group.matrix[:, k] ** 2)) for group in groups)))
        share = abs(value) * size / torque
        if value + _DEVIATIONS * std < 0.0 and share > _SHARE:
            texts.append(
                f"drive inertia Ia {value:.3g} ± {std:.2g} kg m^2, {100 * share:.0f} % of the torque"
            )
    return " and ".join(texts)


def _split(name: str) -> tuple[str, int, bool]:
    # Parameters of coupled drives have names of their own.
    return split_name(name) if not name.startswith(("Iam", "fvm", "fcm")) else (name, 0, False)
