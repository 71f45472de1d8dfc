"""Two-mass joints with set-valued Coulomb friction, advanced by a midpoint scheme.

Per joint, with motor position `theta` referred to the joint and link position `q`::

    Ia theta'' = tau_m - tau_j - Fvm theta' - offm - Fcm Sgn(theta')
    M(q) q''   = tau_j - bias   - Fvl q'     - offl - Fcl Sgn(q')        (row-wise over the joints)
    tau_j      = K (theta - q) + D (theta' - q')

`Sgn` is the set-valued sign: any value in [-1, 1] at rest. A joint therefore sticks exactly, bit for bit, while
the other torques remain below breakaway. The smooth terms are taken at the midpoint (second order, conserves the
energy of the undamped system), the Coulomb terms at the end of the step (Moreau 1988; Acary and Brogliato 2008,
Moreau-Jean scheme). One step is a convex problem with a unique solution. The primal-dual active set method finds
it, almost always at the first try with the signs of the step before; coordinate descent replaces it if the active
sets cycle.
"""

from __future__ import annotations

import numpy as np
from numba import njit

_ACTIVE_SET_TRIES = 40
_DESCENT_SWEEPS = 20_000


@njit(cache=True)
def _solve(matrix: np.ndarray, right: np.ndarray, out: np.ndarray) -> None:
    """Solve the symmetric positive definite `matrix @ out = right`; `matrix` is overwritten by its factor."""
    n = right.shape[0]
    for j in range(n):
        pivot = matrix[j, j]
        for k in range(j):
            pivot -= matrix[j, k] * matrix[j, k]
        pivot = np.sqrt(pivot)
        matrix[j, j] = pivot
        for i in range(j + 1, n):
            value = matrix[i, j]
            for k in range(j):
                value -= matrix[i, k] * matrix[j, k]
            matrix[i, j] = value / pivot
    for i in range(n):
        value = right[i]
        for k in range(i):
            value -= matrix[i, k] * out[k]
        out[i] = value / matrix[i, i]
    for i in range(n - 1, -1, -1):
        value = out[i]
        for k in range(i + 1, n):
            value -= matrix[k, i] * out[k]
        out[i] = value / matrix[i, i]


@njit(cache=True)
def _try_modes(mass, terms, modes, matrix, right, speeds):  # type: ignore[no-untyped-def]
    """End speeds under the assumed modes (-1, 0, +1); corrects the modes and returns whether they held.

    terms : rows of `advance`: diagonals, coupling, right sides, friction bounds. modes, speeds : rows motor, link
    """
    n = mass.shape[0]
    motor_diagonal, link_diagonal, coupling = terms[0], terms[1], terms[2]
    motor_right, link_right, motor_grip, link_grip = terms[3], terms[4], terms[5], terms[6]
    motor_mode, link_mode = modes[0], modes[1]
    motor_speed, link_speed = speeds[0], speeds[1]
    for i in range(n):
        if link_mode[i] == 0:
            for j in range(i):
                matrix[i, j] = 0.0
            matrix[i, i] = 1.0
            right[i] = 0.0
            continue
        for j in range(i):
            matrix[i, j] = 0.0 if link_mode[j] == 0 else mass[i, j]
        diagonal = mass[i, i] + link_diagonal[i]
        value = link_right[i] - link_grip[i] * link_mode[i]
        if motor_mode[i] != 0:
            share = coupling[i] / motor_diagonal[i]
            diagonal -= coupling[i] * share
            value += share * (motor_right[i] - motor_grip[i] * motor_mode[i])
        matrix[i, i] = diagonal
        right[i] = value
    _solve(matrix, right, link_speed)

    settled = True
    for i in range(n):
        if link_mode[i] == 0:
            link_speed[i] = 0.0
        if motor_mode[i] == 0:
            motor_speed[i] = 0.0
            needed = motor_right[i] + coupling[i] * link_speed[i]
            if needed > motor_grip[i]:
                motor_mode[i] = 1
                settled = False
            elif needed < -motor_grip[i]:
                motor_mode[i] = -1
                settled = False
        else:
            motor_speed[i] = (
                motor_right[i] - motor_grip[i] * motor_mode[i] + coupling[i] * link_speed[i]
            ) / motor_diagonal[i]
            if motor_grip[i] > 0.0 and motor_speed[i] * motor_mode[i] < 0.0:
                motor_mode[i] = 0
                settled = False
    for i in range(n):
        if link_mode[i] == 0:
            needed = link_right[i] + coupling[i] * motor_speed[i]
            for j in range(n):
                needed -= mass[i, j] * link_speed[j]
            if needed > link_grip[i]:
                link_mode[i] = 1
                settled = False
            elif needed < -link_grip[i]:
                link_mode[i] = -1
                settled = False
        elif link_grip[i] > 0.0 and link_speed[i] * link_mode[i] < 0.0:
            link_mode[i] = 0
            settled = False
    return settled


@njit(cache=True)
def _descend(mass: np.ndarray, terms: np.ndarray, modes: np.ndarray, speeds: np.ndarray) -> None:
    """End speeds by exact coordinate descent on the convex problem; slow, but it cannot cycle."""
    n = mass.shape[0]
    motor_diagonal, link_diagonal, coupling = terms[0], terms[1], terms[2]
    motor_right, link_right, motor_grip, link_grip = terms[3], terms[4], terms[5], terms[6]
    motor_mode, link_mode = modes[0], modes[1]
    motor_speed, link_speed = speeds[0], speeds[1]
    for _ in range(_DESCENT_SWEEPS):
        change = 0.0
        for i in range(n):
            pull = motor_right[i] + coupling[i] * link_speed[i]
            speed = 0.0
            if pull > motor_grip[i]:
                speed = (pull - motor_grip[i]) / motor_diagonal[i]
            elif pull < -motor_grip[i]:
                speed = (pull + motor_grip[i]) / motor_diagonal[i]
            change = max(change, abs(speed - motor_speed[i]))
            motor_speed[i] = speed
            pull = link_right[i] + coupling[i] * motor_speed[i]
            for j in range(n):
                if j != i:
                    pull -= mass[i, j] * link_speed[j]
            speed = 0.0
            if pull > link_grip[i]:
                speed = (pull - link_grip[i]) / (mass[i, i] + link_diagonal[i])
            elif pull < -link_grip[i]:
                speed = (pull + link_grip[i]) / (mass[i, i] + link_diagonal[i])
            change = max(change, abs(speed - link_speed[i]))
            link_speed[i] = speed
        if change < 1e-15:
            break
    for i in range(n):
        motor_mode[i] = int(np.sign(motor_speed[i]))
        link_mode[i] = int(np.sign(link_speed[i]))


@njit(cache=True)
def advance(
    state: np.ndarray,
    modes: np.ndarray,
    mass: np.ndarray,
    bias: np.ndarray,
    motor_drive: np.ndarray,
    joint: np.ndarray,
    friction: np.ndarray,
    period: float,
    steps: int,
    joint_torque: np.ndarray,
    energy: np.ndarray,
) -> int:
    """Advance all joints by `period` in `steps` equal steps, in place; returns how often descent was needed.

    state : (4, n) motor position, motor velocity, link position, link velocity [rad, rad/s]
    modes : (2, n) int64, sign of the sliding on motor and link side, 0 = sticking; the guess for the next
    step
    mass : (n, n) link inertia [kg m^2], constant during the call; only the symmetric matrix
    bias : (n,) gravity and velocity torques less external torques on the links [Nm]
    motor_drive : (n,) motor torque referred to the joint [Nm], held
    joint : (3, n) motor inertia Ia [kg m^2], stiffness K [Nm/rad], damping D [Nm s/rad]
    friction : (6, n) Fvm, Fcm, offm, Fvl, Fcl, offl
    joint_torque : (n,) out, torque through the joint at the end [Nm]
    energy : (3,) accumulated: electrical input, dissipated, work against the offsets [J]
    """
    n = mass.shape[0]
    h = period / steps
    theta, theta_speed, q, q_speed = state[0], state[1], state[2], state[3]
    motor_mode, link_mode = modes[0], modes[1]
    inertia, stiffness, damping = joint[0], joint[1], joint[2]
    matrix = np.empty((n, n))
    right, momentum = np.empty(n), np.empty(n)
    terms = np.empty((7, n))
    motor_diagonal, link_diagonal, coupling = terms[0], terms[1], terms[2]
    motor_right, link_right, motor_grip, link_grip = terms[3], terms[4], terms[5], terms[6]
    speeds = np.zeros((2, n))
    motor_end, link_end = speeds[0], speeds[1]
    for i in range(n):
        series = 0.5 * h * stiffness[i] + damping[i]
        motor_diagonal[i] = inertia[i] + 0.5 * h * (series + friction[0, i])
        link_diagonal[i] = 0.5 * h * (series + friction[3, i])
        coupling[i] = 0.5 * h * series
        motor_grip[i] = h * friction[1, i]
        link_grip[i] = h * friction[4, i]
        # A joint without Coulomb friction never sticks: any mode but zero will do.
        if motor_grip[i] <= 0.0:
            motor_mode[i] = 1
        if link_grip[i] <= 0.0:
            link_mode[i] = 1

    descents = 0
    for _ in range(steps):
        for i in range(n):
            momentum[i] = 0.0
            for j in range(n):
                momentum[i] += mass[i, j] * q_speed[j]
        for i in range(n):
            slip = theta_speed[i] - q_speed[i]
            elastic = stiffness[i] * (theta[i] - q[i]) + (0.25 * h * stiffness[i] + 0.5 * damping[i]) * slip
            motor_right[i] = inertia[i] * theta_speed[i] + h * (
                motor_drive[i] - elastic - 0.5 * friction[0, i] * theta_speed[i] - friction[2, i]
            )
            link_right[i] = momentum[i] + h * (
                elastic - bias[i] - 0.5 * friction[3, i] * q_speed[i] - friction[5, i]
            )
        settled = False
        for _ in range(_ACTIVE_SET_TRIES):
            settled = _try_modes(mass, terms, modes, matrix, right, speeds)
            if settled:
                break
        if not settled:
            descents += 1
            _descend(mass, terms, modes, speeds)
        for i in range(n):
            motor_mean = 0.5 * (theta_speed[i] + motor_end[i])
            link_mean = 0.5 * (q_speed[i] + link_end[i])
            slip = motor_mean - link_mean
            motor_impulse = motor_right[i] + coupling[i] * link_end[i] - motor_diagonal[i] * motor_end[i]
            link_impulse = link_right[i] + coupling[i] * motor_end[i] - link_diagonal[i] * link_end[i]
            for j in range(n):
                link_impulse -= mass[i, j] * link_end[j]
            energy[0] += h * motor_drive[i] * motor_mean
            energy[1] += (
                h * damping[i] * slip * slip
                + h * friction[0, i] * motor_mean * motor_mean
                + h * friction[3, i] * link_mean * link_mean
                + motor_impulse * motor_mean
                + link_impulse * link_mean
            )
            energy[2] += h * (friction[2, i] * motor_mean + friction[5, i] * link_mean)
        for i in range(n):
            theta[i] += 0.5 * h * (theta_speed[i] + motor_end[i])
            q[i] += 0.5 * h * (q_speed[i] + link_end[i])
            theta_speed[i] = motor_end[i]
            q_speed[i] = link_end[i]
    for i in range(n):
        joint_torque[i] = stiffness[i] * (theta[i] - q[i]) + damping[i] * (theta_speed[i] - q_speed[i])
    return descents
