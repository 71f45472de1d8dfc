"""Joint and motor torques along a motion, equations (1) to (4), and the bounds that they must keep.

Coulomb friction enters the bounds with its full magnitude at every instant, not as sign(qd): a bound then
holds on both sides of a standstill and is a smooth function of the motion. Parameter uncertainty adds
`coverage` standard deviations, coverage * sqrt(y C y^T), with y the regressor row and C the covariance.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ident.excitation.estimate import BODY, ArmEstimate, split_name
from ident.excitation.mechanism import Mechanism
from ident.excitation.motion import Array, Samples
from ident.excitation.sweep import forward

__all__ = ["TorqueBounds", "joint_torque", "torque_bounds", "torque_deviation"]

_NO_COLUMNS = np.zeros(0, dtype=np.int64)
_SIGNAL = {"Ia": 0, "Fvl": 1, "Fvm": 1, "Fcl": 2, "Fcm": 2, "offl": 3, "offm": 3}
_IA, _FVL, _FCL, _OFFL, _FVM, _FCM, _OFFM = range(7)


class TorqueBounds(NamedTuple):
    """Largest magnitude that each torque can have, over load cases and uncertainty; (n, joints) [Nm]."""

    joint: Array
    motor: Array


def rigid_torque(mechanism: Mechanism, samples: Samples, bodies: Array) -> Array:
    """M(q) qdd + C qd + G for k sets of body parameters (k, joints, 10); (k, n, joints) [Nm]."""
    q, qd, qdd = (np.ascontiguousarray(part, dtype=np.float64) for part in samples[:3])
    n, joints = q.shape
    tau = np.empty((bodies.shape[0], n, joints))
    first = np.zeros(joints + 1, dtype=np.int64)
    scratch = np.empty((joints, n, 4))
    forward(mechanism.dynamics, (q, qd, qdd), (first, _NO_COLUMNS), bodies, 1.0, scratch, tau)
    return tau


def joint_torque(mechanism: Mechanism, samples: Samples, estimate: ArmEstimate) -> Array:
    """Joint torque tau_l of equation (1) for each load case, (k, n, joints) [Nm]."""
    drives = estimate.drives
    friction = samples.qd * drives[:, _FVL] + np.sign(samples.qd) * drives[:, _FCL] + drives[:, _OFFL]
    return rigid_torque(mechanism, samples, estimate.loads) + friction


def torque_bounds(
    mechanism: Mechanism, samples: Samples, estimate: ArmEstimate, coverage: float = 3.0
) -> TorqueBounds:
    """Worst magnitude of joint and motor torque at each sample over load cases and uncertainty."""
    drives = estimate.drives
    rigid = rigid_torque(mechanism, samples, estimate.loads)
    joint = rigid + samples.qd * drives[:, _FVL] + drives[:, _OFFL]
    motor = joint + samples.qdd * drives[:, _IA] + samples.qd * drives[:, _FVM] + drives[:, _OFFM]
    joint_bound = np.abs(joint) + np.abs(drives[:, _FCL])
    motor_bound = np.abs(motor) + np.abs(drives[:, _FCL]) + np.abs(drives[:, _FCM])
    if estimate.covariance is not None and coverage > 0.0:
        for load in range(rigid.shape[0]):
            deviation = torque_deviation(mechanism, samples, estimate, loaded=load == 1)
            joint_bound[load] += coverage * deviation.joint
            motor_bound[load] += coverage * deviation.motor
    return TorqueBounds(joint_bound.max(axis=0), motor_bound.max(axis=0))


def torque_deviation(
    mechanism: Mechanism, samples: Samples, estimate: ArmEstimate, *, loaded: bool
) -> TorqueBounds:
    """Standard deviation of joint and motor torque from the estimate's covariance, (n, joints) [Nm]."""
    q, qd, qdd = (np.ascontiguousarray(part, dtype=np.float64) for part in samples[:3])
    n, joints = q.shape
    sigma = np.zeros((2, n, joints))
    if estimate.covariance is None:
        return TorqueBounds(sigma[0], sigma[1])
    columns = np.tile(np.arange(10), joints).astype(np.int64)
    first = np.arange(0, 10 * joints + 1, 10).astype(np.int64)
    z = np.zeros((joints, n, 10 * joints + 4))
    tau = np.empty((1, n, joints))
    forward(mechanism.dynamics, (q, qd, qdd), (first, columns), np.zeros((1, joints, 10)), 1e-3, z, tau)
    for joint in range(joints):
        signals: list[Array] = []
        used: list[int] = []
        joint_side: list[bool] = []
        for index, name in enumerate(estimate.covariance_names):
            kind, link = split_name(name)
            if kind in BODY and joint < link <= joints + loaded:
                signals.append(z[joint, :, 10 * (min(link, joints) - 1) + BODY.index(kind)])
                joint_side.append(True)
            elif kind not in BODY and link == joint + 1:
                column = _SIGNAL[kind]
                # Coulomb friction and offset count with a magnitude of one at every instant
                signals.append(np.ones(n) if column >= 2 else z[joint, :, 10 * joints + column])
                joint_side.append(kind in ("Fvl", "Fcl", "offl"))
            else:
                continue
            used.append(index)
        if used:
            rows, covariance = np.column_stack(signals), estimate.covariance[np.ix_(used, used)]
            own = np.array(joint_side)
            sigma[0, :, joint] = _deviation(rows[:, own], covariance[np.ix_(own, own)])
            sigma[1, :, joint] = _deviation(rows, covariance)
    return TorqueBounds(sigma[0], sigma[1])


def _deviation(rows: Array, covariance: Array) -> Array:
    """sqrt(y C y^T) of each row y."""
    variance = np.einsum("ij,ij->i", rows @ covariance, rows)
    return np.sqrt(np.maximum(variance, 0.0))
