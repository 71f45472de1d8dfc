"""Batched rigid-body regressor and inverse dynamics of a serial chain, without a Python loop over samples.

The torque of joint j is linear in the inertial parameters of the links j..n (Newton-Euler about the link
origins, in the link frames; Khalil and Dombre 2002, section 9.3; Atkeson, An and Hollerbach 1986)::

    tau_j = sum_{k >= j} [ w_jk . (I_k alpha_k + omega_k x I_k omega_k + h_k x a_k)
                         + v_jk . (m_k a_k + alpha_k x h_k + omega_k x (omega_k x h_k)) ]

with omega_k, alpha_k, a_k the angular velocity, angular acceleration and linear acceleration minus gravity of
frame k, and (v_jk, w_jk) the velocity of frame k for a unit speed of joint j alone. The kernel carries these
six numbers up the chain, at a tenth of the cost of carrying 60 wrench columns down.

Samples run in the inner loop, in blocks of the size of the first-level cache, and every column of the result is
contiguous over samples: the loops vectorise, and columns not asked for cost nothing.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from fri.errors import ConfigurationError, DataError
from ident.dynamics.kinematics import Chain
from ident.dynamics.parameters import Floats

_BLOCK = 128


def check_states(chain: Chain, q: ArrayLike, qd: ArrayLike, qdd: ArrayLike) -> tuple[Floats, Floats, Floats]:
    """The three (N, n) float64 arrays. Raises DataError with array, joint and row of a bad value."""
    checked = []
    for name, values in (("q", q), ("qd", qd), ("qdd", qdd)):
        array = np.ascontiguousarray(values, dtype=np.float64)
        if array.ndim == 1 and array.shape == (chain.n,):
            array = array[None, :]
        if array.ndim != 2 or array.shape[1] != chain.n:
            raise DataError(f"`{name}` has shape {array.shape}; expected (samples, {chain.n}) for this chain")
        if not np.isfinite(array.sum()) and not np.all(np.isfinite(array)):
            row, joint = np.argwhere(~np.isfinite(array))[0]
            raise DataError(
                f"`{name}` of joint {chain.joint_names[joint]} is {array[row, joint]} at sample {row}; "
                "remove or interpolate such samples first"
            )
        checked.append(array)
    if not checked[0].shape == checked[1].shape == checked[2].shape:
        shapes = ", ".join(str(array.shape) for array in checked)
        raise DataError(f"`q`, `qd`, `qdd` have shapes {shapes}; they must be equal")
    return checked[0], checked[1], checked[2]


def _is_plain(array: Any, shape: tuple[int, ...]) -> bool:
    return (
        type(array) is np.ndarray
        and array.dtype == np.float64
        and array.shape == shape
        and array.flags.carray  # contiguous and writeable: numba compiles for one kind of argument
    )


def _is_instant(n: int, q: Any, qd: Any, qdd: Any) -> bool:
    """Whether all are plain arrays (n,), as a controller has them: what is left to check is checked in the kernel."""
    shape = (n,)
    return _is_plain(q, shape) and _is_plain(qd, shape) and _is_plain(qdd, shape)


def all_columns(chain: Chain) -> NDArray[np.int64]:
    """(n, 10) column map of all inertial parameters, link after link: 0, 1, ..., 10 n - 1."""
    return np.arange(10 * chain.n, dtype=np.int64).reshape(chain.n, 10)


def rigid_regressor(
    chain: Chain,
    q: ArrayLike,
    qd: ArrayLike,
    qdd: ArrayLike,
    *,
    columns: NDArray[np.int64] | None = None,
    out: Floats | None = None,
) -> Floats:
    """Rigid-body regressor of every joint: (n, N, C), `tau[:, j] = result[j] @ parameters`.

    q, qd, qdd : (N, n) [rad, rad/s, rad/s^2; m for prismatic joints].
    columns : (n, 10) int, column of parameter i of link k, -1 to leave it out; by default all 10 n in their
        order. C = largest entry + 1.
    out : (C, n, N) float64 C-contiguous to write into. Structural zeros (links before the joint) are not
        rewritten: pass zeros, or an earlier result for the same `columns`.

    The result is a view of memory ordered (column, joint, sample): `result.reshape(n * N, C)` makes no copy
    and is Fortran-ordered, as LAPACK expects.
    """
    if columns is None and out is None and _is_instant(chain.n, q, qd, qdd):
        instant = np.zeros((10 * chain.n, chain.n, 1))
        if _fill_at(q, qd, qdd, chain.table, chain.gravity, instant):
            return instant.transpose(1, 2, 0)
    states = check_states(chain, q, qd, qdd)
    wanted = all_columns(chain) if columns is None else np.ascontiguousarray(columns, dtype=np.int64)
    if wanted.shape != (chain.n, 10):
        raise ConfigurationError(f"column map has shape {wanted.shape}; expected ({chain.n}, 10)")
    count, samples = int(wanted.max(initial=-1)) + 1, len(states[0])
    if out is None:
        out = np.zeros((count, chain.n, samples))
    elif out.shape != (count, chain.n, samples) or not out.flags.c_contiguous or out.dtype != np.float64:
        raise ConfigurationError(
            f"`out` must be C-contiguous float64 of shape ({count}, {chain.n}, {samples})"
        )
    fill_rigid(chain, *states, wanted, out[:, None])
    return out.transpose(1, 2, 0)


def fill_rigid(
    chain: Chain, q: Floats, qd: Floats, qdd: Floats, columns: NDArray[np.int64], out: Floats
) -> None:
    """`rigid_regressor` without checks and without an array of its own.

    out : (>= C, >= 1, n, >= N) float64 C-contiguous; writes [column, 0, joint, sample] except structural zeros.
    """
    constants = (*chain.cos_sin_alpha, chain.d, chain.theta, chain.r, chain.prismatic.astype(np.float64))
    _fill(_fixed(q), _fixed(qd), _fixed(qdd), *constants, chain.gravity, _fixed(columns), out)


def _fixed(array: Any) -> Any:
    """The array as contiguous and read-only: numba then compiles for one kind of argument."""
    view = np.ascontiguousarray(array).view()
    view.flags.writeable = False
    return view


@njit(cache=True, error_model="numpy", inline="always")
def _cos_sin(angle, cosine, sine, size):  # type: ignore[no-untyped-def]
    # The polynomials and the three-part pi/2 of FreeBSD's msun (k_sin.c, k_cos.c, e_rem_pio2.c), without
    # branches so that the loop vectorises; error below 1 ulp for |angle| < 1e5.
    for s in range(size):
        x = angle[s]
        turns = np.rint(x * 0.6366197723675814)
        y = x - turns * 1.5707963267341256
        y = y - turns * 6.077100506303966e-11
        y = y - turns * 2.0222662487959506e-21
        z = y * y
        p = z * (-2.50507602534068634195e-08 + z * 1.58969099521155010221e-10)
        p = z * (-1.98412698298579493134e-04 + z * (2.75573137070700676789e-06 + p))
        p = -1.66666666666666324348e-01 + z * (8.33333333332248946124e-03 + p)
        sin_y = y + y * z * p
        p = z * (2.08757232129817482790e-09 + z * -1.13596475577881948265e-11)
        p = z * (2.48015872894767294178e-05 + z * (-2.75573143513906633035e-07 + p))
        p = 4.16666666666666019037e-02 + z * (-1.38888888888741095749e-03 + p)
        cos_y = 1.0 - (0.5 * z - z * z * p)
        quarter = turns - 4.0 * np.floor(0.25 * turns)
        odd = (quarter == 1.0) | (quarter == 3.0)
        c, t = (sin_y, cos_y) if odd else (cos_y, sin_y)
        cosine[s] = -c if (quarter == 1.0) | (quarter == 2.0) else c
        sine[s] = -t if quarter >= 2.0 else t


@njit(cache=True, error_model="numpy", nogil=True)
def _rest(body, gravity, size):  # type: ignore[no-untyped-def]
    """A base at rest, accelerated against gravity: rows 0-8 of the scratch."""
    for s in range(size):
        for i in range(6):
            body[i, s] = 0.0
        body[6, s] = -gravity[0]
        body[7, s] = -gravity[1]
        body[8, s] = -gravity[2]


@njit(cache=True, error_model="numpy", nogil=True)
def _fill(q, qd, qdd, ca, sa, d, theta, r, prismatic, gravity, columns, out):  # type: ignore[no-untyped-def]
    samples, n = q.shape
    block = min(_BLOCK, samples)
    # Rows of the scratch: 0-2 omega, 3-5 alpha, 6-8 acceleration, 9-14 the products of omega.
    body = np.zeros((15, block))
    # Six numbers (v, w) for each joint below or at the link.
    twist = np.zeros((n, 6, block))
    # cos and sin of theta, r, qd, qdd, theta of the link at hand.
    joint = np.zeros((6, block))
    for start in range(0, samples, _BLOCK):
        size = min(_BLOCK, samples - start)
        _rest(body, gravity, size)
        for k in range(n):
            turning = 1.0 - prismatic[k]
            for s in range(size):
                position = q[start + s, k]
                joint[5, s] = theta[k] + turning * position
                joint[2, s] = r[k] + prismatic[k] * position
                joint[3, s] = qd[start + s, k]
                joint[4, s] = qdd[start + s, k]
            _cos_sin(joint[5], joint[0], joint[1], size)
            _advance(body, joint, ca[k], sa[k], d[k], prismatic[k], size)
            _products(body, size)
            for j in range(k):
                _carry(twist[j], joint, ca[k], sa[k], d[k], size)
            for s in range(size):
                for i in range(6):
                    twist[k, i, s] = 0.0
                twist[k, 2, s] = prismatic[k]
                twist[k, 5, s] = turning
            for j in range(k + 1):
                _columns_of_link(body, twist[j], columns[k], out, j, start, size)


@njit(cache=True, error_model="numpy")
def _fill_at(q, qd, qdd, table, gravity, out):  # type: ignore[no-untyped-def]
    """`_fill` for one sample (n,), all columns, `out` (10 n, n, 1); False for a value that is not finite."""
    n = q.shape[0]
    if not np.isfinite(q.sum() + qd.sum() + qdd.sum()):
        return False
    columns = np.arange(10 * n).reshape(n, 10)
    states = q.reshape(1, n), qd.reshape(1, n), qdd.reshape(1, n)
    ca, sa, d, theta, r, prismatic = table[0], table[1], table[2], table[3], table[4], table[5]
    whole = out.reshape(10 * n, 1, n, 1)
    _fill(states[0], states[1], states[2], ca, sa, d, theta, r, prismatic, gravity, columns, whole)
    return True


@njit(cache=True, inline="always")
def _advance(body, joint, ca, sa, d, prismatic, size):  # type: ignore[no-untyped-def]
    # Three loops of few outputs: the compiler vectorises no loop of many.
    c, sn, r, speed, acceleration = joint[0], joint[1], joint[2], joint[3], joint[4]
    wx, wy, wz = body[0], body[1], body[2]
    ex, ey, ez = body[3], body[4], body[5]
    ax, ay, az = body[6], body[7], body[8]
    revolute = 1.0 - prismatic
    for s in range(size):
        px, py, pz = d, -sa * r[s], ca * r[s]
        w0, w1, w2 = wx[s], wy[s], wz[s]
        e0, e1, e2 = ex[s], ey[s], ez[s]
        # omega x p, then a + alpha x p + omega x (omega x p)
        u0, u1, u2 = w1 * pz - w2 * py, w2 * px - w0 * pz, w0 * py - w1 * px
        a0 = ax[s] + e1 * pz - e2 * py + w1 * u2 - w2 * u1
        a1 = ay[s] + e2 * px - e0 * pz + w2 * u0 - w0 * u2
        a2 = az[s] + e0 * py - e1 * px + w0 * u1 - w1 * u0
        cs, ss = c[s], sn[s]
        # into frame k: Rx(-alpha) then Rz(-theta)
        t1, t2 = ca * a1 + sa * a2, ca * a2 - sa * a1
        ax[s], ay[s], az[s] = cs * a0 + ss * t1, cs * t1 - ss * a0, t2
    for s in range(size):
        cs, ss = c[s], sn[s]
        w0, w1, w2 = wx[s], wy[s], wz[s]
        t1, t2 = ca * w1 + sa * w2, ca * w2 - sa * w1
        wx[s], wy[s], wz[s] = cs * w0 + ss * t1, cs * t1 - ss * w0, t2
    for s in range(size):
        cs, ss, qd, qdd = c[s], sn[s], speed[s], acceleration[s]
        b0, b1, rate, rate2 = wx[s], wy[s], revolute * qd, 2.0 * prismatic * qd
        e0, e1, e2 = ex[s], ey[s], ez[s]
        t1, t2 = ca * e1 + sa * e2, ca * e2 - sa * e1
        ex[s] = cs * e0 + ss * t1 + b1 * rate
        ey[s] = cs * t1 - ss * e0 - b0 * rate
        ez[s] = t2 + revolute * qdd
        ax[s] += b1 * rate2
        ay[s] -= b0 * rate2
        az[s] += prismatic * qdd
        wz[s] += rate


@njit(cache=True, inline="always")
def _products(body, size):  # type: ignore[no-untyped-def]
    wx, wy, wz = body[0], body[1], body[2]
    xx, yy, zz, xy, xz, yz = body[9], body[10], body[11], body[12], body[13], body[14]
    for s in range(size):
        b0, b1, b2 = wx[s], wy[s], wz[s]
        xx[s], yy[s], zz[s] = b0 * b0, b1 * b1, b2 * b2
        xy[s], xz[s], yz[s] = b0 * b1, b0 * b2, b1 * b2


@njit(cache=True, inline="always")
def _carry(twist, joint, ca, sa, d, size):  # type: ignore[no-untyped-def]
    c, sn, r = joint[0], joint[1], joint[2]
    for s in range(size):
        px, py, pz = d, -sa * r[s], ca * r[s]
        w0, w1, w2 = twist[3, s], twist[4, s], twist[5, s]
        v0 = twist[0, s] + w1 * pz - w2 * py
        v1 = twist[1, s] + w2 * px - w0 * pz
        v2 = twist[2, s] + w0 * py - w1 * px
        cs, ss = c[s], sn[s]
        t1, t2 = ca * v1 + sa * v2, ca * v2 - sa * v1
        twist[0, s], twist[1, s], twist[2, s] = cs * v0 + ss * t1, cs * t1 - ss * v0, t2
        t1, t2 = ca * w1 + sa * w2, ca * w2 - sa * w1
        twist[3, s], twist[4, s], twist[5, s] = cs * w0 + ss * t1, cs * t1 - ss * w0, t2


@njit(cache=True, inline="always")
def _columns_of_link(body, twist, column, out, joint, start, size):  # type: ignore[no-untyped-def]
    ex, ey, ez = body[3], body[4], body[5]
    ax, ay, az = body[6], body[7], body[8]
    xx, yy, zz, xy, xz, yz = body[9], body[10], body[11], body[12], body[13], body[14]
    vx, vy, vz, wx, wy, wz = twist[0], twist[1], twist[2], twist[3], twist[4], twist[5]
    if column[0] >= 0:
        o = out[column[0], 0, joint, start : start + size]
        for s in range(size):
            o[s] = wx[s] * ex[s] + wy[s] * xz[s] - wz[s] * xy[s]
    if column[1] >= 0:
        o = out[column[1], 0, joint, start : start + size]
        for s in range(size):
            o[s] = wx[s] * (ey[s] - xz[s]) + wy[s] * (ex[s] + yz[s]) + wz[s] * (xx[s] - yy[s])
    if column[2] >= 0:
        o = out[column[2], 0, joint, start : start + size]
        for s in range(size):
            o[s] = wx[s] * (ez[s] + xy[s]) + wy[s] * (zz[s] - xx[s]) + wz[s] * (ex[s] - yz[s])
    if column[3] >= 0:
        o = out[column[3], 0, joint, start : start + size]
        for s in range(size):
            o[s] = -wx[s] * yz[s] + wy[s] * ey[s] + wz[s] * xy[s]
    if column[4] >= 0:
        o = out[column[4], 0, joint, start : start + size]
        for s in range(size):
            o[s] = wx[s] * (yy[s] - zz[s]) + wy[s] * (ez[s] - xy[s]) + wz[s] * (ey[s] + xz[s])
    if column[5] >= 0:
        o = out[column[5], 0, joint, start : start + size]
        for s in range(size):
            o[s] = wx[s] * yz[s] - wy[s] * xz[s] + wz[s] * ez[s]
    if column[6] >= 0:
        o = out[column[6], 0, joint, start : start + size]
        for s in range(size):
            o[s] = (
                ay[s] * wz[s]
                - az[s] * wy[s]
                - vx[s] * (yy[s] + zz[s])
                + vy[s] * (xy[s] + ez[s])
                + vz[s] * (xz[s] - ey[s])
            )
    if column[7] >= 0:
        o = out[column[7], 0, joint, start : start + size]
        for s in range(size):
            o[s] = (
                az[s] * wx[s]
                - ax[s] * wz[s]
                + vx[s] * (xy[s] - ez[s])
                - vy[s] * (xx[s] + zz[s])
                + vz[s] * (yz[s] + ex[s])
            )
    if column[8] >= 0:
        o = out[column[8], 0, joint, start : start + size]
        for s in range(size):
            o[s] = (
                ax[s] * wy[s]
                - ay[s] * wx[s]
                + vx[s] * (xz[s] + ey[s])
                + vy[s] * (yz[s] - ex[s])
                - vz[s] * (xx[s] + yy[s])
            )
    if column[9] >= 0:
        o = out[column[9], 0, joint, start : start + size]
        for s in range(size):
            o[s] = vx[s] * ax[s] + vy[s] * ay[s] + vz[s] * az[s]


def torque(chain: Chain, q: ArrayLike, qd: ArrayLike, qdd: ArrayLike, inertial: ArrayLike) -> Floats:
    """Rigid inverse dynamics (N, n) [Nm, N] from the inertial parameters (n, 10), by recursive Newton-Euler.

    Batches cost least by far; a single sample is quickest as three plain arrays (n,), see `benchmarks.regressor`.
    """
    if _is_instant(chain.n, q, qd, qdd) and _is_plain(inertial, (chain.n, 10)):
        instant = np.empty((1, chain.n))
        if _torque_at(q, qd, qdd, chain.table, chain.gravity, inertial, instant):
            return instant
    position, speed, acceleration = check_states(chain, q, qd, qdd)
    bodies = np.ascontiguousarray(inertial, dtype=np.float64)
    if bodies.shape != (chain.n, 10):
        raise ConfigurationError(f"inertial parameters have shape {bodies.shape}; expected ({chain.n}, 10)")
    return _rnea(position, speed, acceleration, bodies, chain, chain.gravity)


def gravity_torque(chain: Chain, q: ArrayLike, inertial: ArrayLike) -> Floats:
    """Gravity torque G(q) (N, n)."""
    position = np.atleast_2d(np.asarray(q, dtype=np.float64))
    zero = np.zeros_like(position)
    return torque(chain, position, zero, zero, inertial)


def mass_matrix(chain: Chain, q: ArrayLike, inertial: ArrayLike) -> Floats:
    """Mass matrix M(q) (N, n, n) of the rigid links, drive inertia not included."""
    position = np.atleast_2d(np.asarray(q, dtype=np.float64))
    zero = np.zeros_like(position)
    bodies = np.ascontiguousarray(inertial, dtype=np.float64)
    check_states(chain, position, zero, zero)
    matrix, at = np.empty((len(position), chain.n, chain.n)), frames(chain, position)
    for j in range(chain.n):
        unit = zero.copy()
        unit[:, j] = 1.0
        matrix[:, :, j] = _in_frames(at, zero, unit, bodies, chain, np.zeros(3))
    return matrix


def _rnea(q: Floats, qd: Floats, qdd: Floats, bodies: Floats, chain: Chain, gravity: Floats) -> Floats:
    return _in_frames(frames(chain, q), qd, qdd, bodies, chain, gravity)


Frames = tuple[Floats, Floats, Floats]
"""Cosine and sine of the joint angles, and offsets along the joint axes, (N, n) each."""


def frames(chain: Chain, q: Floats) -> Frames:
    """The joints' frames at positions q (N, n), to reuse in several torques."""
    found = np.empty((3, *q.shape))
    _frames(_fixed(q), chain.theta, chain.r, chain.prismatic, found)
    return found[0], found[1], found[2]


@njit(cache=True, error_model="numpy", nogil=True)
def _frames(q, theta, r, prismatic, out):  # type: ignore[no-untyped-def]
    samples, n = q.shape
    block = min(_BLOCK, samples)
    angle, cosine, sine = np.empty(block), np.empty(block), np.empty(block)
    for start in range(0, samples, _BLOCK):
        size = min(_BLOCK, samples - start)
        for k in range(n):
            for s in range(size):
                position = q[start + s, k]
                angle[s] = theta[k] + (0.0 if prismatic[k] else position)
                out[2, start + s, k] = r[k] + (position if prismatic[k] else 0.0)
            _cos_sin(angle, cosine, sine, size)
            for s in range(size):
                out[0, start + s, k] = cosine[s]
                out[1, start + s, k] = sine[s]


def moved_frames(chain: Chain, at: Frames, q: Floats, joint: int) -> Frames:
    """The same frames with one joint at q (N,)."""
    cosine, sine, offset = at
    if chain.prismatic[joint]:
        offset = offset.copy()
        offset[:, joint] = q + chain.r[joint]
        return cosine, sine, offset
    cosine, sine, angle = cosine.copy(), sine.copy(), q + chain.theta[joint]
    cosine[:, joint], sine[:, joint] = np.cos(angle), np.sin(angle)
    return cosine, sine, offset


def torque_in(chain: Chain, at: Frames, qd: Floats, qdd: Floats, inertial: Floats) -> Floats:
    """`torque` (N, n) in known frames, without checks."""
    return _in_frames(at, qd, qdd, inertial, chain, chain.gravity)


def _in_frames(at: Frames, qd: Floats, qdd: Floats, bodies: Floats, chain: Chain, gravity: Floats) -> Floats:
    (cosine, sine), (ct, st, rr) = chain.cos_sin_alpha, at
    out = np.empty(ct.shape)
    _newton_euler(
        ct,
        st,
        rr,
        _fixed(qd),
        _fixed(qdd),
        cosine,
        sine,
        chain.d,
        chain.prismatic,
        _fixed(gravity),
        _fixed(bodies),
        out,
    )
    return out


@njit(cache=True, error_model="numpy", nogil=True)
def _newton_euler(ct, st, rr, qd, qdd, ca, sa, d, prismatic, gravity, bodies, out):  # type: ignore[no-untyped-def]
    samples, n = ct.shape
    block = min(_BLOCK, samples)
    # As in `_fill`; cos and sin of theta, r, qd, qdd of each joint; force and moment of each link.
    body, joint, force = np.zeros((9, block)), np.zeros((n, 5, block)), np.zeros((n, 6, block))
    for start in range(0, samples, _BLOCK):
        size = min(_BLOCK, samples - start)
        _rest(body, gravity, size)
        for k in range(n):
            for s in range(size):
                joint[k, 0, s] = ct[start + s, k]
                joint[k, 1, s] = st[start + s, k]
                joint[k, 2, s] = rr[start + s, k]
                joint[k, 3, s] = qd[start + s, k]
                joint[k, 4, s] = qdd[start + s, k]
            _advance(body, joint[k], ca[k], sa[k], d[k], 1.0 if prismatic[k] else 0.0, size)
            _load_of_link(body, bodies[k], force[k], size)
        for k in range(n - 1, -1, -1):
            own = force[k, 2] if prismatic[k] else force[k, 5]
            for s in range(size):
                out[start + s, k] = own[s]
            if k > 0:
                _carry_down(force[k], joint[k], ca[k], sa[k], d[k], force[k - 1], size)


@njit(cache=True, error_model="numpy", inline="always")
def _load_of_link(body, of_link, force, size):  # type: ignore[no-untyped-def]
    """Force and moment (6, s) that move a link with the inertial parameters (10,)."""
    wx, wy, wz = body[0], body[1], body[2]
    ex, ey, ez = body[3], body[4], body[5]
    ax, ay, az = body[6], body[7], body[8]
    ixx, ixy, ixz, iyy, iyz, izz = of_link[0], of_link[1], of_link[2], of_link[3], of_link[4], of_link[5]
    h0, h1, h2, m = of_link[6], of_link[7], of_link[8], of_link[9]
    f0, f1, f2, m0, m1, m2 = force[0], force[1], force[2], force[3], force[4], force[5]
    for s in range(size):
        w0, w1, w2 = wx[s], wy[s], wz[s]
        e0, e1, e2 = ex[s], ey[s], ez[s]
        a0, a1, a2 = ax[s], ay[s], az[s]
        # omega x h, then f = m a + alpha x h + omega x (omega x h)
        g0, g1, g2 = w1 * h2 - w2 * h1, w2 * h0 - w0 * h2, w0 * h1 - w1 * h0
        f0[s] = m * a0 + e1 * h2 - e2 * h1 + w1 * g2 - w2 * g1
        f1[s] = m * a1 + e2 * h0 - e0 * h2 + w2 * g0 - w0 * g2
        f2[s] = m * a2 + e0 * h1 - e1 * h0 + w0 * g1 - w1 * g0
        l0 = ixx * w0 + ixy * w1 + ixz * w2
        l1 = ixy * w0 + iyy * w1 + iyz * w2
        l2 = ixz * w0 + iyz * w1 + izz * w2
        m0[s] = ixx * e0 + ixy * e1 + ixz * e2 + w1 * l2 - w2 * l1 + h1 * a2 - h2 * a1
        m1[s] = ixy * e0 + iyy * e1 + iyz * e2 + w2 * l0 - w0 * l2 + h2 * a0 - h0 * a2
        m2[s] = ixz * e0 + iyz * e1 + izz * e2 + w0 * l1 - w1 * l0 + h0 * a1 - h1 * a0


@njit(cache=True, error_model="numpy", inline="always")
def _carry_down(force, joint, ca, sa, d, below, size):  # type: ignore[no-untyped-def]
    """Add force and moment (6, s) of a link to those of the link before it."""
    c, sn, r = joint[0], joint[1], joint[2]
    f0, f1, f2, m0, m1, m2 = force[0], force[1], force[2], force[3], force[4], force[5]
    b0, b1, b2, b3, b4, b5 = below[0], below[1], below[2], below[3], below[4], below[5]
    for s in range(size):
        # from frame k to frame k-1: Rz(theta) then Rx(alpha), moment about the origin of k-1
        cs, ss = c[s], sn[s]
        g0, t1, t2 = cs * f0[s] - ss * f1[s], ss * f0[s] + cs * f1[s], f2[s]
        g1, g2 = ca * t1 - sa * t2, sa * t1 + ca * t2
        n0, t1, t2 = cs * m0[s] - ss * m1[s], ss * m0[s] + cs * m1[s], m2[s]
        n1, n2 = ca * t1 - sa * t2, sa * t1 + ca * t2
        px, py, pz = d, -sa * r[s], ca * r[s]
        b0[s] += g0
        b1[s] += g1
        b2[s] += g2
        b3[s] += n0 + py * g2 - pz * g1
        b4[s] += n1 + pz * g0 - px * g2
        b5[s] += n2 + px * g1 - py * g0


@njit(cache=True, error_model="numpy")
def _torque_at(q, qd, qdd, table, gravity, bodies, out):  # type: ignore[no-untyped-def]
    """`_newton_euler` for one sample (n,), `out` (1, n); False for a value that is not finite."""
    n = q.shape[0]
    if not np.isfinite(q.sum() + qd.sum() + qdd.sum()):
        return False
    turned = table[5] > 0.0
    motion = np.empty((3, 1, n))
    _frames(q.reshape(1, n), table[3], table[4], turned, motion)
    ca, sa, d = table[0], table[1], table[2]
    states = qd.reshape(1, n), qdd.reshape(1, n)
    _newton_euler(
        motion[0], motion[1], motion[2], states[0], states[1], ca, sa, d, turned, gravity, bodies, out
    )
    return True
