"""The likelier of explanations with the same fit: of two sides of the gear, of two payload labels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ident.dynamics.parameters import INERTIAL
from ident.rows.sessions import payload_name, stated_mass
from ident.screening.explanations import Explanation, unit_of
from ident.screening.normal_equations import DEVIATIONS
from ident.screening.physics import friction_power, gravity_slopes, inertia_of
from ident.screening.redundancy import Redundancy
from lwr_driver.session import Session

# Largest deviation of a load from its stated mass.
_MASS = 0.3


def of_the_wrong_side(one: Explanation) -> Explanation:
    """A factor between motor and joint torque of all joints: inertia tells its sign, the URDF's bodies its unit."""
    data = one.mended
    if one.gain is None or len(data.sides) < 2 or (len(one.joints) < 2 and one.factor > 0.0):
        return one
    scale = np.diag([one.factor if joint in one.joints else 1.0 for joint in range(data.chain.n)])
    turned = data
    for side in data.sides:
        turned = turned.mapped(side, scale)
    fits = [each.fit(each.normal().by_data) for each in (data, turned)]
    if len(one.joints) == 1:
        # The other joints may not tell its sign; the difference of its torques is friction and inertia of the drive.
        power = friction_power(data, one.joints[0], ("motor",))
        first, second = (float(power @ fit.parameters) for fit in fits)
        other = first < 0.0 < second
    elif one.factor < 0.0:
        inertias = [inertia_of(d, fit) for d, fit in zip((data, turned), fits, strict=True)]
        other = bool(np.sum(inertias[1] > 0.0) > np.sum(inertias[0] > 0.0))
    else:
        slopes = [list(gravity_slopes(d, fit).values()) for d, fit in zip((data, turned), fits, strict=True)]
        if not slopes[0] or not slopes[1] or data.chain.placeholder_masses():
            return replace(one, channel="motor torque against joint torque")
        ratios = [abs(float(np.median(values))) for values in slopes]
        other = abs(np.log(ratios[1])) < abs(np.log(ratios[0]))
    if not other:
        return one
    channel = "joint torque" if one.channel == "motor torque" else "motor torque"
    factor = 1.0 / one.factor
    return replace(
        one, channel=channel, factor=factor, looks_like=unit_of(factor, torque=True), mended=turned
    )


def of_the_wrong_label(one: Explanation, sessions: Sequence[Session]) -> Explanation:
    """The session with the wrong label, of two with one label and the same fit.

    The difference of their loads decides: the heavier session is wrong where the label is the bare arm, the lighter
    one where it is a payload of the stated mass.
    """
    if one.channel != "payload" or len(one.alike) != 1:
        return one
    choices = {int(each.label): each for each in (one, *one.alike)}
    first, second = sorted(choices)
    labels = {payload_name(sessions[record]) for record in choices}
    more, std = _heavier_by(one.mended, first, second)
    if len(labels) != 1 or abs(more) < DEVIATIONS * std:
        return one
    heavy, light = (first, second) if more > 0.0 else (second, first)
    if labels == {None}:
        return replace(choices[heavy], alike=())
    stated = stated_mass(sessions[light])
    if stated and abs(abs(more) / stated - 1.0) < _MASS:
        return replace(choices[light], alike=())
    return one


def _heavier_by(data: Redundancy, first: int, second: int) -> tuple[float, float]:
    """By how much one session's payload is heavier than another's [kg], and its standard deviation."""
    row = np.zeros((1, data.width))
    for record, sign in ((first, 1.0), (second, -1.0)):
        payload = next(rows.payload for rows in data.rows if rows.record == record)
        if payload is not None:
            place = len(INERTIAL) * (data.chain.n + data.payloads.index(payload)) + INERTIAL.index("M")
            row[0, place] += sign
    normal = data.normal()
    fit = data.fit(normal)
    return float(row[0] @ fit.parameters), float(data.deviation(fit, normal, row)[0])
