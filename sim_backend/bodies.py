"""Rigid bodies of a serial chain of revolute joints, compiled: mass matrix, torques and pose by recursion.

With the frame of each body in its joint, R and p the pose of a frame in the one before it, a the axis of the joint:
velocity and acceleration run from the base to the tip, forces back (recursive Newton-Euler, Luh, Walker and Paul 1980);
the mass matrix follows from composite bodies (Walker and Orin 1982). The chain comes from a pinocchio model, whose
algorithms give the same numbers to rounding. The functions are for compiled loops, where no other library can be
called.
"""

from __future__ import annotations

import numpy as np
import pinocchio as pin
from numba import njit

from fri.errors import ConfigurationError

# Columns of a chain (n + 1, 46), a row for each joint: its frame at zero with the axis turned in (three 3x3 matrices,
# see `_turn`), p, a, mass, centre of mass, inertia about it (3x3). The last row: frame of the tip, and gravity.
_P, _A, _M, _C, _I = 27, 30, 33, 34, 37
_WIDTH = 46


def chain_of(model: pin.Model, tip: pin.SE3 | None = None) -> np.ndarray:
    """The chain of a model, for the functions below; ConfigurationError for joints other than revolute in a row.

    tip : pose of the tip in the frame of the last body; None takes that frame
    """
    chain = np.zeros((model.nv + 1, _WIDTH))
    for number in range(1, model.njoints):
        joint, row = model.joints[number], chain[number - 1]
        data = joint.createData()
        joint.calc(data, np.zeros(model.nq))
        subspace = np.asarray(data.S).reshape(6)
        if model.nq != model.nv or model.parents[number] != number - 1 or np.any(subspace[:3]):
            raise ConfigurationError(
                f"joint {number} of the model is {joint.shortname()}; only serial chains of revolute joints are "
                "simulated"
            )
        place, body, axis = model.jointPlacements[number], model.inertias[number], subspace[3:]
        cross = pin.skew(axis)
        turned = place.rotation, place.rotation @ cross, place.rotation @ cross @ cross
        row[:27] = np.array(turned).reshape(27)
        row[_P : _P + 3], row[_A : _A + 3] = place.translation, axis
        row[_M], row[_C : _C + 3], row[_I : _I + 9] = body.mass, body.lever, body.inertia.reshape(9)
    tip = pin.SE3.Identity() if tip is None else tip
    chain[-1, :9], chain[-1, 9:12], chain[-1, 12:15] = (
        tip.rotation.reshape(9),
        tip.translation,
        model.gravity.linear,
    )
    return chain


@njit(cache=True)
def _turn(row, angle, out):  # type: ignore[no-untyped-def]
    """R of a joint at an angle (9,): R0 (1 + sin [a] + (1 - cos) [a]^2), Rodrigues."""
    sine, rest = np.sin(angle), 1.0 - np.cos(angle)
    for k in range(9):
        out[k] = row[k] + sine * row[9 + k] + rest * row[18 + k]


@njit(cache=True)
def torques(chain, q, qd, out):  # type: ignore[no-untyped-def]
    """Gravity, centrifugal and Coriolis torques at q, qd into `out`, (n,) each."""
    n = q.shape[0]
    turns, forces = np.empty((n, 9)), np.empty((n, 6))
    w0 = w1 = w2 = e0 = e1 = e2 = 0.0
    a0, a1, a2 = -chain[n, 12], -chain[n, 13], -chain[n, 14]
    for i in range(n):
        row, turn = chain[i], turns[i]
        _turn(row, q[i], turn)
        p0, p1, p2 = row[27], row[28], row[29]
        # a + alpha x p + omega x (omega x p), then all into the frame of the body.
        u0, u1, u2 = w1 * p2 - w2 * p1, w2 * p0 - w0 * p2, w0 * p1 - w1 * p0
        b0 = a0 + e1 * p2 - e2 * p1 + w1 * u2 - w2 * u1
        b1 = a1 + e2 * p0 - e0 * p2 + w2 * u0 - w0 * u2
        b2 = a2 + e0 * p1 - e1 * p0 + w0 * u1 - w1 * u0
        a0 = turn[0] * b0 + turn[3] * b1 + turn[6] * b2
        a1 = turn[1] * b0 + turn[4] * b1 + turn[7] * b2
        a2 = turn[2] * b0 + turn[5] * b1 + turn[8] * b2
        u0 = turn[0] * w0 + turn[3] * w1 + turn[6] * w2
        u1 = turn[1] * w0 + turn[4] * w1 + turn[7] * w2
        u2 = turn[2] * w0 + turn[5] * w1 + turn[8] * w2
        b0 = turn[0] * e0 + turn[3] * e1 + turn[6] * e2
        b1 = turn[1] * e0 + turn[4] * e1 + turn[7] * e2
        b2 = turn[2] * e0 + turn[5] * e1 + turn[8] * e2
        s0, s1, s2 = row[30] * qd[i], row[31] * qd[i], row[32] * qd[i]
        e0, e1, e2 = b0 + u1 * s2 - u2 * s1, b1 + u2 * s0 - u0 * s2, b2 + u0 * s1 - u1 * s0
        w0, w1, w2 = u0 + s0, u1 + s1, u2 + s2
        mass, c0, c1, c2 = row[33], row[34], row[35], row[36]
        u0, u1, u2 = w1 * c2 - w2 * c1, w2 * c0 - w0 * c2, w0 * c1 - w1 * c0
        f0 = mass * (a0 + e1 * c2 - e2 * c1 + w1 * u2 - w2 * u1)
        f1 = mass * (a1 + e2 * c0 - e0 * c2 + w2 * u0 - w0 * u2)
        f2 = mass * (a2 + e0 * c1 - e1 * c0 + w0 * u1 - w1 * u0)
        l0 = row[37] * w0 + row[38] * w1 + row[39] * w2
        l1 = row[40] * w0 + row[41] * w1 + row[42] * w2
        l2 = row[43] * w0 + row[44] * w1 + row[45] * w2
        force = forces[i]
        force[0], force[1], force[2] = f0, f1, f2
        force[3] = row[37] * e0 + row[38] * e1 + row[39] * e2 + w1 * l2 - w2 * l1 + c1 * f2 - c2 * f1
        force[4] = row[40] * e0 + row[41] * e1 + row[42] * e2 + w2 * l0 - w0 * l2 + c2 * f0 - c0 * f2
        force[5] = row[43] * e0 + row[44] * e1 + row[45] * e2 + w0 * l1 - w1 * l0 + c0 * f1 - c1 * f0
    for i in range(n - 1, -1, -1):
        row, force = chain[i], forces[i]
        out[i] = row[30] * force[3] + row[31] * force[4] + row[32] * force[5]
        if i > 0:
            below = forces[i - 1]
            _lower(row, turns[i], force)
            for k in range(6):
                below[k] += force[k]


@njit(cache=True)
def _lower(row, turn, force):  # type: ignore[no-untyped-def]
    """A force with its moment (6,), from the frame of a joint into the one before, in place."""
    f0 = turn[0] * force[0] + turn[1] * force[1] + turn[2] * force[2]
    f1 = turn[3] * force[0] + turn[4] * force[1] + turn[5] * force[2]
    f2 = turn[6] * force[0] + turn[7] * force[1] + turn[8] * force[2]
    m0 = turn[0] * force[3] + turn[1] * force[4] + turn[2] * force[5]
    m1 = turn[3] * force[3] + turn[4] * force[4] + turn[5] * force[5]
    m2 = turn[6] * force[3] + turn[7] * force[4] + turn[8] * force[5]
    p0, p1, p2 = row[27], row[28], row[29]
    force[0], force[1], force[2] = f0, f1, f2
    force[3], force[4], force[5] = m0 + p1 * f2 - p2 * f1, m1 + p2 * f0 - p0 * f2, m2 + p0 * f1 - p1 * f0


@njit(cache=True)
def mass_matrix(chain, q, out):  # type: ignore[no-untyped-def]
    """Mass matrix at q (n,) into `out` (n, n)."""
    n = q.shape[0]
    turns, force = np.empty((n, 9)), np.empty(6)
    # Of the body with all bodies beyond it, about the origin of its frame: mass, first moment, inertia.
    masses, moments, inertias = np.empty(n), np.empty((n, 3)), np.empty((n, 9))
    shift, half = np.empty(3), np.empty(9)
    for i in range(n):
        row, moment, inertia = chain[i], moments[i], inertias[i]
        _turn(row, q[i], turns[i])
        mass = masses[i] = row[33]
        square = 0.0
        for k in range(3):
            moment[k] = mass * row[34 + k]
            square += moment[k] * row[34 + k]
        for k in range(3):
            for m in range(3):
                inertia[3 * k + m] = row[37 + 3 * k + m] - moment[k] * row[34 + m]
            inertia[4 * k] += square
    for i in range(n - 1, -1, -1):
        row, moment, inertia, turn = chain[i], moments[i], inertias[i], turns[i]
        a0, a1, a2 = row[30], row[31], row[32]
        force[0], force[1] = a1 * moment[2] - a2 * moment[1], a2 * moment[0] - a0 * moment[2]
        force[2] = a0 * moment[1] - a1 * moment[0]
        for k in range(3):
            force[3 + k] = inertia[3 * k] * a0 + inertia[3 * k + 1] * a1 + inertia[3 * k + 2] * a2
        out[i, i] = a0 * force[3] + a1 * force[4] + a2 * force[5]
        for j in range(i, 0, -1):
            _lower(chain[j], turns[j], force)
            before = chain[j - 1]
            out[i, j - 1] = before[30] * force[3] + before[31] * force[4] + before[32] * force[5]
            out[j - 1, i] = out[i, j - 1]
        if i > 0:
            mass = masses[i]
            along = place = 0.0
            for k in range(3):
                shift[k] = turn[3 * k] * moment[0] + turn[3 * k + 1] * moment[1] + turn[3 * k + 2] * moment[2]
                along += shift[k] * row[27 + k]
                place += row[27 + k] * row[27 + k]
                for m in range(3):
                    half[3 * k + m] = 0.0
                    for s in range(3):
                        half[3 * k + m] += turn[3 * k + s] * inertia[3 * s + m]
            below, first = inertias[i - 1], moments[i - 1]
            masses[i - 1] += mass
            for k in range(3):
                first[k] += shift[k] + mass * row[27 + k]
                for m in range(3):
                    value = (
                        -row[27 + k] * shift[m] - shift[k] * row[27 + m] - mass * row[27 + k] * row[27 + m]
                    )
                    for s in range(3):
                        value += half[3 * k + s] * turn[3 * m + s]
                    below[3 * k + m] += value
                below[4 * k] += 2.0 * along + mass * place


@njit(cache=True)
def pose(chain, q, out):  # type: ignore[no-untyped-def]
    """Pose of the tip in the base at q (n,) into `out` (12,), 3x4 row-major [R | p]."""
    n, turn = q.shape[0], np.empty(9)
    for k in range(12):
        out[k] = 1.0 if k % 5 == 0 else 0.0
    for i in range(n):
        _turn(chain[i], q[i], turn)
        _onwards(turn, chain[i], 27, out)
    _onwards(chain[n], chain[n], 9, out)


@njit(cache=True)
def _onwards(turn, row, at, out):  # type: ignore[no-untyped-def]
    """Append a frame to the pose `out` (12,): its rotation `turn` (9,), its place from column `at` of `row` on."""
    p0, p1, p2 = row[at], row[at + 1], row[at + 2]
    for k in range(3):
        r0, r1, r2 = out[4 * k], out[4 * k + 1], out[4 * k + 2]
        out[4 * k + 3] += r0 * p0 + r1 * p1 + r2 * p2
        out[4 * k] = r0 * turn[0] + r1 * turn[3] + r2 * turn[6]
        out[4 * k + 1] = r0 * turn[1] + r1 * turn[4] + r2 * turn[7]
        out[4 * k + 2] = r0 * turn[2] + r1 * turn[5] + r2 * turn[8]
