"""Equations of the hidden arm's joints, advanced through a millisecond in equal steps.

Per joint, with motor angle `theta` and link angle `q`, both at the joint::

    Ia theta'' = gain u - tau - f(theta') - h - off_m + ripple(theta) + more
    M(q) q''   = tau - bias - f_l(q') - off_l + hose(q) + outside
    tau        = spring(theta - q) + D (theta' - q')

Friction is a family of bristles (Canudas de Wit, Olsson, Astrom and Lischinsky 1995, one bristle; Al-Bender,
Lampaert and Swevers 2005, many): deflection `z_i` of reach `x_i` with::

    z_i' = v - |v| z_i / (x_i r),   h = Fc sum_i w_i z_i / x_i + sigma_1 sum_i w_i z_i' Fc / x_i

where `r(v, q, T, tau, ...)` is the level of sliding friction over Fc. Velocities are solved for implicitly in
spring, damping and inertia, bristles are advanced before (symplectic).
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from tests.hidden_physics.traits import TRAITS

__all__ = ["SHORT", "STATES", "advance"]

_AT = {name: place for place, name in enumerate(TRAITS)}
STIFFNESS, DAMPING, PLAY, SOFTNESS, HARDENING = (
    _AT[name] for name in ("stiffness", "damping", "play", "play_softness", "hardening")
)
PRESLIDING, SPREAD, LONG_REACH, LONG_SHARE = (
    _AT[name] for name in ("presliding", "spread", "long_reach", "long_share")
)
COULOMB, VISCOUS, STRIBECK, STRIBECK_SPEED, STRIBECK_SHAPE, POWER, CORNER = (
    _AT[name]
    for name in (
        "coulomb",
        "viscous",
        "stribeck",
        "stribeck_speed",
        "stribeck_shape",
        "viscous_power",
        "viscous_corner",
    )
)
FORWARD_COULOMB, FORWARD_VISCOUS, LOAD = (
    _AT[name] for name in ("forward_coulomb", "forward_viscous", "load_share")
)
WAVE, WAVE_COUNT, WAVE_PHASE, BUMP, BUMP_CENTRE, BUMP_WIDTH = (
    _AT[name] for name in ("wave", "wave_count", "wave_phase", "bump", "bump_centre", "bump_width")
)
WARMTH, FILM_C, FILM_G, HOUSING_C, HOUSING_G = (
    _AT[name]
    for name in ("warmth", "film_capacity", "film_conductance", "housing_capacity", "housing_conductance")
)
GAIN, ONCE, TWICE, ONCE_PHASE, TWICE_PHASE, GEAR = (
    _AT[name]
    for name in (
        "motor_gain",
        "ripple_once",
        "ripple_twice",
        "ripple_once_phase",
        "ripple_twice_phase",
        "gear",
    )
)
CABLE, CABLE_CUBIC, CABLE_CENTRE, CABLE_SLACK, CABLE_RUB, CABLE_REACH = (
    _AT[name] for name in ("cable", "cable_cubic", "cable_centre", "cable_slack", "cable_rub", "cable_reach")
)
BACK, LATE, FALLS, CREEP, CREEP_SPEED = (
    _AT[name] for name in ("ripple_back", "ripple_late", "gain_falls", "creep", "creep_speed")
)
HOSE, HOSE_OTHER, HOSE_RATIO = (_AT[name] for name in ("hose", "hose_other", "hose_ratio"))
OTHER, OTHER_FRICTION, OTHER_PHASE, OTHER_DRAG = (
    _AT[name] for name in ("other", "other_friction", "other_phase", "other_drag")
)
MEMORY, MEMORY_TIME, INERTIAL, SHAKE, SHAKE_HZ = (
    _AT[name] for name in ("memory", "memory_time", "inertial_friction", "shake", "shake_hz")
)

SHORT = 3
"""Short bristles of a motor; one long one follows."""

_LONG, _LINK, _RUB, _FILM, _HOUSING, _PAST, _SPEED, _RATE = SHORT, *range(SHORT + 1, SHORT + 8)
STATES = SHORT + 8
"""Rows of the internal state: bristles of motor (short, long), link and hose [share of their reach], film and
housing temperature [K], past speed, filtered speed and its rate."""

FILM_ROW, HOUSING_ROW = _FILM, _HOUSING

# Damping of a bristle over its stiffness [s].
_BRISTLE_S = 5e-4
_RATE_S = 0.02


@njit(cache=True)
def _slip(z: float, speed: float, h: float, reach: float, level: float) -> float:
    """Deflection over reach after `h` [s]; backward Euler, so it never passes `level`."""
    return (z + h * speed / reach) / (1.0 + h * abs(speed) / (reach * level))


@njit(cache=True)
def _spring(twist: float, stiffness: float, play: float, softness: float, hardening: float) -> tuple:
    """Torque and its slope: soft within the lost motion, then stiff, stiffening with the twist."""
    if play > 0.0:
        inside = min(play, max(-play, twist))
        beyond = twist - inside
        torque = stiffness * (softness * inside + beyond)
        slope = stiffness * (1.0 if beyond != 0.0 else softness)
    else:
        torque = stiffness * twist
        slope = stiffness
    return (
        torque + stiffness * hardening * twist**3,
        slope + 3.0 * stiffness * hardening * twist * twist,
    )


@njit(cache=True)
def _hose(q: float, p: np.ndarray, i: int) -> float:
    """Torque of a hose on the link: none within the slack, then hardening."""
    centre, slack = p[CABLE_CENTRE, i], p[CABLE_SLACK, i]
    away = q - centre
    if slack > 0.0:
        away -= min(slack, max(-slack, away))
    return -(p[CABLE, i] * away + p[CABLE_CUBIC, i] * away**3)


@njit(cache=True)
def _level(
    i: int,
    p: np.ndarray,
    speed: float,
    q: np.ndarray,
    theta: float,
    load: float,
    rate: float,
    loss: float,
    coulomb: float,
) -> float:
    """Sliding friction of motor i over its Coulomb torque."""
    level = p[COULOMB, i]
    if p[STRIBECK, i] != 0.0:
        level *= 1.0 + p[STRIBECK, i] * math.exp(
            -((abs(speed) / p[STRIBECK_SPEED, i]) ** p[STRIBECK_SHAPE, i])
        )
    if p[WAVE, i] != 0.0:
        level *= 1.0 + p[WAVE, i] * math.sin(p[WAVE_COUNT, i] * theta + p[WAVE_PHASE, i])
    if p[BUMP, i] != 0.0:
        away = (theta - p[BUMP_CENTRE, i]) / p[BUMP_WIDTH, i]
        level *= 1.0 + p[BUMP, i] / (1.0 + away**4)
    if p[FORWARD_COULOMB, i] != 0.0:
        level *= 1.0 + p[FORWARD_COULOMB, i] * (1.0 if speed > 0.0 else -1.0)
    if p[OTHER_FRICTION, i] != 0.0:
        level *= 1.0 + p[OTHER_FRICTION, i] * math.sin(q[int(p[OTHER, i]) - 1] + p[OTHER_PHASE, i])
    if p[INERTIAL, i] != 0.0:
        level *= 1.0 + p[INERTIAL, i] * abs(rate)
    level *= loss
    if p[LOAD, i] != 0.0:
        level += p[LOAD, i] * abs(load) / coulomb
    return max(level, 0.05)


@njit(cache=True)
def _cholesky_solve(matrix: np.ndarray, x: np.ndarray) -> None:
    """Solve the symmetric positive definite `matrix @ y = x` in place."""
    n = x.shape[0]
    for j in range(n):
        for k in range(j):
            matrix[j, j] -= matrix[j, k] * matrix[j, k]
        matrix[j, j] = math.sqrt(matrix[j, j])
        for i in range(j + 1, n):
            for k in range(j):
                matrix[i, j] -= matrix[i, k] * matrix[j, k]
            matrix[i, j] /= matrix[j, j]
    for i in range(n):
        for k in range(i):
            x[i] -= matrix[i, k] * x[k]
        x[i] /= matrix[i, i]
    for i in range(n - 1, -1, -1):
        for k in range(i + 1, n):
            x[i] -= matrix[k, i] * x[k]
        x[i] /= matrix[i, i]


@njit(cache=True)
def advance(
    body: np.ndarray,
    inner: np.ndarray,
    mass: np.ndarray,
    bias: np.ndarray,
    reported: np.ndarray,
    drive: np.ndarray,
    p: np.ndarray,
    time_s: float,
    period: float,
    steps: int,
    braked: bool,
    joint_torque: np.ndarray,
) -> None:
    """Advance everything by `period` [s] in place.

    body : (4, n) motor angle and speed, link angle and speed. inner : (STATES, n), see there
    mass : (n, n) upper triangle; bias : (n,) what the links need besides [Nm]; reported : (n,) motor torque
    as the cabinet has it; drive : (9, n) Ia, K, D, Fvm, Fcm, offm, Fvl, Fcl, offl
    p : (traits, n). joint_torque : (n,) out
    """
    n = mass.shape[0]
    h = period / steps
    theta, motor_speed, q, link_speed = body[0], body[1], body[2], body[3]
    matrix = np.empty((n, n))
    right = np.empty(n)
    motor_right, motor_diagonal, grip = np.empty(n), np.empty(n), np.empty(n)
    for step in range(steps):
        now = time_s + step * h
        for i in range(n):
            stiffness = drive[1, i] * p[STIFFNESS, i]
            damping = drive[2, i] * p[DAMPING, i]
            speed = motor_speed[i]
            twist, slip = theta[i] - q[i], speed - link_speed[i]
            torque, slope = _spring(twist, stiffness, p[PLAY, i], p[SOFTNESS, i], p[HARDENING, i])
            transmitted = torque + damping * slip

            # Filtered speed, its rate, and what the joint remembers of it.
            inner[_RATE, i] = (speed - inner[_SPEED, i]) / _RATE_S
            inner[_SPEED, i] += h * inner[_RATE, i]
            inner[_PAST, i] += h * (speed - inner[_PAST, i]) / p[MEMORY_TIME, i]

            loss = 1.0
            if p[WARMTH, i] != 0.0:
                loss = math.exp(-p[WARMTH, i] * inner[_FILM, i])
            coulomb = drive[4, i]
            friction, bristle_power = 0.0, 0.0
            if coulomb > 0.0:
                level = _level(i, p, speed, q, theta[i], transmitted, inner[_RATE, i], loss, coulomb)
                share = (1.0 - p[LONG_SHARE, i] - p[CREEP, i]) / SHORT
                reach = p[PRESLIDING, i] / p[SPREAD, i]
                for k in range(SHORT):
                    before = inner[k, i]
                    after = _slip(before, speed, h, reach, level)
                    inner[k, i] = after
                    friction += coulomb * share * (after + _BRISTLE_S * (after - before) / h)
                    reach *= p[SPREAD, i]
                if p[LONG_SHARE, i] > 0.0:
                    after = _slip(inner[_LONG, i], speed, h, p[LONG_REACH, i], level)
                    inner[_LONG, i] = after
                    friction += coulomb * p[LONG_SHARE, i] * after
                bristle_power = friction * speed

            viscous = drive[3, i] * p[VISCOUS, i] * loss
            if p[FORWARD_VISCOUS, i] != 0.0:
                viscous *= 1.0 + p[FORWARD_VISCOUS, i] * (1.0 if speed > 0.0 else -1.0)
            if p[CREEP, i] != 0.0:
                # As a viscous friction, for the midpoint to be stable.
                slow = p[CREEP_SPEED, i]
                steep = math.tanh(speed / slow) / speed if abs(speed) > 1e-6 * slow else 1.0 / slow
                viscous += coulomb * p[CREEP, i] * steep
            if p[POWER, i] != 1.0:
                viscous *= (1.0 + abs(speed) / p[CORNER, i]) ** (p[POWER, i] - 1.0)

            power = max(0.0, bristle_power + viscous * speed * speed)
            flow = p[FILM_G, i] * (inner[_FILM, i] - inner[_HOUSING, i])
            inner[_FILM, i] += h * (power - flow) / p[FILM_C, i]
            inner[_HOUSING, i] += h * (flow - p[HOUSING_G, i] * inner[_HOUSING, i]) / p[HOUSING_C, i]

            more = -drive[5, i]
            past = theta[i] - p[LATE, i] * inner[_SPEED, i]
            turned = p[BACK, i] if speed < 0.0 else 0.0
            if p[ONCE, i] != 0.0:
                more += p[ONCE, i] * math.sin(p[GEAR, i] * past + p[ONCE_PHASE, i] + turned)
            if p[TWICE, i] != 0.0:
                more += p[TWICE, i] * math.sin(2.0 * p[GEAR, i] * past + p[TWICE_PHASE, i] + turned)
            if p[OTHER_DRAG, i] != 0.0:
                more -= p[OTHER_DRAG, i] * link_speed[int(p[OTHER, i]) - 1]
            if p[MEMORY, i] != 0.0:
                more -= p[MEMORY, i] * inner[_PAST, i]
            if p[SHAKE, i] != 0.0:
                more += p[SHAKE, i] * math.sin(2.0 * math.pi * p[SHAKE_HZ, i] * now)

            # Midpoint in spring, damping and viscous friction.
            grip[i] = 0.5 * h * (0.5 * h * slope + damping)
            inertia = drive[0, i]
            motor_diagonal[i] = inertia + grip[i] + 0.5 * h * viscous
            mid = torque + (0.25 * h * slope + 0.5 * damping) * slip
            motor_right[i] = inertia * speed + h * (
                p[GAIN, i] * (1.0 - p[FALLS, i] * reported[i] ** 2) * reported[i]
                - mid
                - 0.5 * viscous * speed
                - friction
                + more
            )

            outside = -drive[8, i] - 0.5 * drive[6, i] * link_speed[i]
            if drive[7, i] > 0.0:
                after = _slip(inner[_LINK, i], link_speed[i], h, p[PRESLIDING, i], 1.0)
                outside -= drive[7, i] * (after + _BRISTLE_S * (after - inner[_LINK, i]) / h)
                inner[_LINK, i] = after
            if p[CABLE, i] != 0.0 or p[CABLE_CUBIC, i] != 0.0:
                outside += _hose(q[i], p, i)
            if p[CABLE_RUB, i] != 0.0:
                inner[_RUB, i] = _slip(inner[_RUB, i], link_speed[i], h, p[CABLE_REACH, i], 1.0)
                outside -= p[CABLE_RUB, i] * inner[_RUB, i]
            right[i] = h * (mid - bias[i] + outside)

        for i in range(n):
            if p[HOSE, i] != 0.0:
                far, ratio = int(p[HOSE_OTHER, i]) - 1, p[HOSE_RATIO, i]
                pull = p[HOSE, i] * (q[i] + ratio * q[far])
                right[i] -= h * pull
                right[far] -= h * ratio * pull
        for i in range(n):
            for j in range(n):
                entry = mass[i, j] if j >= i else mass[j, i]
                matrix[i, j] = entry
                right[i] += entry * link_speed[j]
        for i in range(n):
            matrix[i, i] += grip[i] + 0.5 * h * drive[6, i]
            if not braked:
                share = grip[i] / motor_diagonal[i]
                matrix[i, i] -= grip[i] * share
                right[i] += share * motor_right[i]
        _cholesky_solve(matrix, right)
        for i in range(n):
            end = 0.0 if braked else (motor_right[i] + grip[i] * right[i]) / motor_diagonal[i]
            theta[i] += 0.5 * h * (motor_speed[i] + end)
            q[i] += 0.5 * h * (link_speed[i] + right[i])
            motor_speed[i] = end
            link_speed[i] = right[i]
    for i in range(n):
        torque, _ = _spring(
            theta[i] - q[i],
            drive[1, i] * p[STIFFNESS, i],
            p[PLAY, i],
            p[SOFTNESS, i],
            p[HARDENING, i],
        )
        joint_torque[i] = torque + drive[2, i] * p[DAMPING, i] * (motor_speed[i] - link_speed[i])
