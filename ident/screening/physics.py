"""The laws of motion as a check of sessions.

Inertia is positive, friction dissipates, joint torque sensors feel no drive, and gravity has the order of magnitude of
the URDF's.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from fri.errors import LwrError
from ident.dynamics.kinematics import Chain
from ident.dynamics.parameters import INERTIAL, Floats
from ident.dynamics.regressor import rigid_regressor, torque
from ident.screening.doubts import Doubt
from ident.screening.explanations import AGREES, DOUBT, unit_of
from ident.screening.normal_equations import DEVIATIONS, FLOOR, Fit, Normal
from ident.screening.redundancy import Redundancy

# Poses of a session, in place of all samples.
_POSES = 64
# Factor between an arm's gravity and its URDF's: 0.9 to 1.4 in six real arms. Correlation of gravity of the two, and
# number of joints, to speak of a factor.
_NOMINAL, _ALIKE, _SEVERAL = 4.0, 0.9, 3
# Least share of a negative inertia's torque in that of the joint.
_SHARE = 0.1
# Drive inertias over their standard deviations, together (Stouffer) and of one joint at most: joint torque sensors of
# four real arms reach 0.7 together, motor torques of five simulated ones 6 to 20.
_DRIVES, _MOST_BY_ONE = 5.0, 10.0


def physics(data: Redundancy, normal: Normal) -> list[Doubt]:
    """Inertia clearly negative, and gravity of another order than the URDF's."""
    fit = data.fit(normal)
    n, names = data.chain.n, data.chain.joint_names
    bodies = len(INERTIAL) * n
    rows = np.zeros((n, len(fit.parameters)))
    rows[:, :bodies] = _inertia_rows(data.chain, poses(data))
    if data.sides == ("motor",):
        rows[np.arange(n), [data.place("Ia", joint) for joint in range(n)]] = 1.0
    inertia, std = rows @ fit.parameters, data.deviation(fit, normal, rows)
    shares = _acting(data, fit, dict(enumerate(inertia.tolist())))
    acting = np.array([shares.get(joint, 0.0) for joint in range(n)])
    sure = (np.abs(inertia) > DEVIATIONS * std) & (acting > _SHARE)
    negative, positive = np.flatnonzero(sure & (inertia < 0.0)), np.flatnonzero(sure & (inertia > 0.0))
    if len(negative) > len(positive) and _without_inertia(data).score - fit.score > DOUBT:
        listed = ", ".join(f"{names[j]} {inertia[j]:.3g} ± {std[j]:.2g} kg m^2" for j in negative)
        channel = " and ".join(f"{side} torque" for side in data.sides)
        looks, mend = (
            "a reversed sign of all torques, or of all positions",
            "`scale: -1` in the mapping of the import mends it",
        )
        return [Doubt(channel, names, f"the arm's inertia is negative ({listed})", looks, mend, True)]
    return [*_reversed(data, fit, normal, negative, inertia, std), *_nominal(data, fit)]


def _reversed(
    data: Redundancy, fit: Fit, normal: Normal, negative: NDArray[np.int64], inertia: Floats, std: Floats
) -> Iterator[Doubt]:
    """Single joints with a negative inertia and nothing in common with the other joints, so with an unknown sign.

    Certain where friction drives the joint, too. No doubt about a torque hardly explained by bodies and friction, such
    as that of a light wrist with a cable.
    """
    for joint in negative.tolist():
        if max(rho for (_, own), rho in fit.rho.items() if own == joint) > AGREES:
            continue
        power = friction_power(data, joint, data.sides)
        driven = float(power @ fit.parameters) < -DEVIATIONS * float(
            data.deviation(fit, normal, power[None])[0]
        )
        unit = "kg" if data.chain.prismatic[joint] else "kg m^2"
        yield Doubt(
            " and ".join(f"{side} torque" for side in data.sides),
            (data.chain.joint_names[joint],),
            f"its inertia is negative ({inertia[joint]:.3g} ± {std[joint]:.2g} {unit})"
            + (", and its friction drives it" if driven else ""),
            "a reversed sign of the torque or the position",
            "`scale: -1` in the mapping of the import mends it",
            driven,
        )


def drives_in_sensors(data: Redundancy) -> list[Doubt]:
    """Drive inertia in joint torques without motor torques beside them.

    Sensors behind the gears feel none. At the first two joints drive and links have one common inertia.
    """
    silent = frozenset(("motor", joint) for _, joint in data.silent)
    joints = [joint for joint in range(2, data.chain.n) if ("motor", joint) not in silent]
    if data.sides != ("joint",) or not joints:
        return []
    motor = replace(data, rows=tuple(replace(rows, side="motor") for rows in data.rows), silent=silent)
    normal = motor.normal()
    fit = motor.fit(normal)
    places = [motor.place("Ia", joint) for joint in joints]
    inertia, std = fit.parameters[places], motor.deviation(fit, normal, np.eye(motor.width)[places])
    acting = _acting(motor, fit, dict(zip(joints, inertia.tolist(), strict=True)))
    # What no sensor would feel is no drive, however sure.
    felt = np.array([acting[joint] for joint in joints]) > FLOOR
    seen = std > 0.0
    shares = np.clip(inertia[seen] / std[seen], -_MOST_BY_ONE, _MOST_BY_ONE)
    if not felt.any() or np.sum(shares) <= _DRIVES * np.sqrt(max(len(shares), 1)):
        return []
    names = data.chain.joint_names
    listed = ", ".join(
        f"{names[joint]} {value:.3g} ± {deviation:.2g} kg m^2"
        for joint, value, deviation, is_felt in zip(joints, inertia, std, felt, strict=True)
        if is_felt and value > 2.0 * deviation > 0.0
    )
    mend = (
        "import them as motor torques (`--torque motor`, or `motor_torque` in the mapping), so that the drives are in "
        "the model"
    )
    return [
        Doubt(
            "joint torque",
            names,
            f"has the inertia of the drives in it ({listed})",
            "motor torques",
            mend,
            False,
        )
    ]


def _nominal(data: Redundancy, fit: Fit) -> list[Doubt]:
    """Gravity against the URDF's, in joints with agreement but for a factor.

    Bodies of a URDF are often rough or missing; then they do not correlate, and nothing is said. Placeholders may
    correlate, and say nothing of the torques: they make no error.
    """
    slopes = gravity_slopes(data, fit)
    if not slopes:
        return []
    middle = float(np.median(list(slopes.values())))
    if middle > 0.0 and abs(np.log(middle)) < np.log(_NOMINAL):
        return []
    channel = " and ".join(f"{side} torque" for side in data.sides)
    names = tuple(data.chain.joint_names[joint] for joint in slopes)
    looks = (
        unit_of(middle, torque=True)
        if middle > 0.0
        else "a reversed sign of all torques, or of all positions"
    )
    seen = f"gravity is {middle:.3g} times that of the URDF's bodies"
    mend = "state unit and sign of the torques when importing, or correct the URDF's masses"
    certain = len(slopes) >= _SEVERAL and (middle < 0.0 or abs(np.log(middle)) > 2.0 * np.log(_NOMINAL))
    if middle > 0.0 and (placeholder := data.chain.placeholder_masses()):
        looks, certain = f"placeholders: {placeholder}", False
        mend = "give a URDF with the manufacturer's masses, and look whether the torques are in Nm"
    return [Doubt(channel, names, seen, looks, mend, certain)]


def _without_inertia(data: Redundancy) -> Fit:
    """The fit without accelerations: a slow motion says nothing about inertia."""
    still = replace(data, rows=tuple(replace(part, qdd=np.zeros_like(part.qdd)) for part in data.rows))
    return still.fit(still.normal().by_data)


def friction_power(data: Redundancy, joint: int, sides: Sequence[str]) -> Floats:
    """Row (p,) of the mean power [W] of a joint's friction, on the link side and the motor side."""
    row = np.zeros(data.width)
    for side, viscous, coulomb in (("joint", "Fvl", "Fcl"), ("motor", "Fvm", "Fcm")):
        parts = [part for part in data.rows if part.side == side] if side in sides else []
        if parts:
            speed = np.concatenate([part.qd[:, joint] for part in parts])
            sign = np.concatenate([part.sign[:, joint] for part in parts])
            row[data.place(viscous, joint)] = np.mean(speed**2)
            row[data.place(coulomb, joint)] = np.mean(speed * sign)
    return row


def _acting(data: Redundancy, fit: Fit, inertia: Mapping[int, float]) -> dict[int, float]:
    """Largest share of the inertia's torque in a joint's (rms), over its sides."""
    found = dict.fromkeys(inertia, 0.0)
    for side, joint in fit.rho:
        if joint in found:
            parts = [part for part in data.rows if part.side == side]
            torque_rms = np.sqrt(np.mean([np.var(part.torque[:, joint]) for part in parts]))
            speeding = np.sqrt(np.mean([np.mean(part.qdd[:, joint] ** 2) for part in parts]))
            found[joint] = max(found[joint], float(abs(inertia[joint]) * speeding / max(torque_rms, 1e-300)))
    return found


def gravity_slopes(data: Redundancy, fit: Fit) -> dict[int, float]:
    """Identified over nominal gravity torque of joints with correlated torques."""
    try:
        nominal = data.chain.urdf_inertials()
    except LwrError:
        return {}
    q = poses(data)
    still = np.zeros_like(q)
    expected = torque(data.chain, q, still, still, nominal)
    computed = (rigid_regressor(data.chain, q, still, still) @ bodies_of(data, fit)).T
    expected, computed = expected - expected.mean(axis=0), computed - computed.mean(axis=0)
    power, both = np.sum(expected**2, axis=0), np.sum(expected * computed, axis=0)
    size = np.sqrt(power * np.sum(computed**2, axis=0))
    # Only joints bearing a visible part of the arm.
    bearing = np.flatnonzero((power > 1e-4 * power.max()) & (power > 1e-12))
    return {int(j): float(both[j] / power[j]) for j in bearing if abs(both[j]) > _ALIKE * size[j]}


def inertia_of(data: Redundancy, fit: Fit) -> Floats:
    """Inertia (n,) of the fit's bodies about each joint, mean over the poses [kg m^2 or kg]."""
    return _inertia_rows(data.chain, poses(data)) @ bodies_of(data, fit)


def _inertia_rows(chain: Chain, q: Floats) -> Floats:
    """Rows (n, 10 n) of the diagonal of the mass matrix, mean over the poses (N, n)."""
    still = np.zeros_like(q)
    rest = rigid_regressor(chain, q, still, still)
    rows = []
    for joint in range(chain.n):
        unit = still.copy()
        unit[:, joint] = 1.0
        rows.append(np.mean(rigid_regressor(chain, q, still, unit)[joint] - rest[joint], axis=0))
    return np.array(rows)


def poses(data: Redundancy) -> Floats:
    """Some positions (N, n) of the data [rad or m]."""
    return np.concatenate([part.q[:: max(1, len(part.q) // _POSES)] for part in data.rows])


def bodies_of(data: Redundancy, fit: Fit) -> Floats:
    """Inertial parameters (10 n,) of the links in a fit."""
    return fit.parameters[: len(INERTIAL) * data.chain.n]
