"""Regressor and torque of a serial arm over a batch of samples, and their exact derivative in reverse mode.

Body b's frame rotates about its z axis by q_b relative to a fixed placement in frame b-1. With w, wd, vd the
angular velocity, angular acceleration and linear acceleration (gravity included) of frame b and with (l, a)
the linear and angular velocity of its origin per unit velocity of joint j, all in frame b, the torque of
joint j per parameter of body b is

    M:            l.vd
    (MX,MY,MZ):   l x wd + (l.w) w - (w.w) l + vd x a
    inertia:      sym(a wd^T) + sym(e w^T),   e = a x w

so the regressor is polynomial in the propagated vectors and the reverse sweep is the same recursion run
backwards. Rotations are differentiated through d(R^T u)/dq = -z x (R^T u). Between the sweeps only the samples
are stored.
"""

from __future__ import annotations

import numpy as np
from numba import njit


@njit(cache=True, error_model="numpy")
def _into(r, c, s, x, y, z):  # type: ignore[no-untyped-def]
    """A vector of the frame before, in the frame placed by r and turned about z (cosine c, sine s)."""
    u = r[0, 0] * x + r[1, 0] * y + r[2, 0] * z
    v = r[0, 1] * x + r[1, 1] * y + r[2, 1] * z
    return c * u + s * v, c * v - s * u, r[0, 2] * x + r[1, 2] * y + r[2, 2] * z


@njit(cache=True, error_model="numpy")
def _out(r, c, s, x, y, z):  # type: ignore[no-untyped-def]
    u, v = c * x - s * y, s * x + c * y
    return (
        r[0, 0] * u + r[0, 1] * v + r[0, 2] * z,
        r[1, 0] * u + r[1, 1] * v + r[1, 2] * z,
        r[2, 0] * u + r[2, 1] * v + r[2, 2] * z,
    )


@njit(cache=True, error_model="numpy")
def _kinematics(rot0, trans, gravity, q, qd, qdd, cs, w, wd, vd, lin, ang):  # type: ignore[no-untyped-def]
    """Fill cos/sin (n, 2), w, wd, vd (n, 3) and lin, ang (b, j, 3) of one sample."""
    n = q.shape[0]
    for b in range(n):
        c, s = np.cos(q[b]), np.sin(q[b])
        cs[b, 0], cs[b, 1] = c, s
        px, py, pz = trans[b, 0], trans[b, 1], trans[b, 2]
        r = rot0[b]
        if b == 0:
            wx = wy = wz = 0.0
            dx = dy = dz = 0.0
            ax, ay, az = -gravity[0], -gravity[1], -gravity[2]
        else:
            wx, wy, wz = w[b - 1, 0], w[b - 1, 1], w[b - 1, 2]
            dx, dy, dz = wd[b - 1, 0], wd[b - 1, 1], wd[b - 1, 2]
            wp = wx * px + wy * py + wz * pz
            ww = wx * wx + wy * wy + wz * wz
            ax = vd[b - 1, 0] + dy * pz - dz * py + wx * wp - ww * px
            ay = vd[b - 1, 1] + dz * px - dx * pz + wy * wp - ww * py
            az = vd[b - 1, 2] + dx * py - dy * px + wz * wp - ww * pz
        tx, ty, tz = _into(r, c, s, wx, wy, wz)
        w[b, 0], w[b, 1], w[b, 2] = tx, ty, tz + qd[b]
        vx, vy, vz = _into(r, c, s, dx, dy, dz)
        wd[b, 0], wd[b, 1], wd[b, 2] = vx + ty * qd[b], vy - tx * qd[b], vz + qdd[b]
        vd[b, 0], vd[b, 1], vd[b, 2] = _into(r, c, s, ax, ay, az)
        for j in range(b):
            ax, ay, az = ang[b - 1, j, 0], ang[b - 1, j, 1], ang[b - 1, j, 2]
            lx = lin[b - 1, j, 0] + ay * pz - az * py
            ly = lin[b - 1, j, 1] + az * px - ax * pz
            lz = lin[b - 1, j, 2] + ax * py - ay * px
            ang[b, j, 0], ang[b, j, 1], ang[b, j, 2] = _into(r, c, s, ax, ay, az)
            lin[b, j, 0], lin[b, j, 1], lin[b, j, 2] = _into(r, c, s, lx, ly, lz)
        ang[b, b, 0], ang[b, b, 1], ang[b, b, 2] = 0.0, 0.0, 1.0
        lin[b, b, :] = 0.0


@njit(cache=True, error_model="numpy")
def forward(arm, motion, columns, chi, eps, z, tau):  # type: ignore[no-untyped-def]
    """Regressor columns and rigid-body torques of all samples.

    rot0 (n, 3, 3), trans (n, 3), gravity (3,): the chain. q, qd, qdd (m, n). `parameter` (c,) holds the
    index 0 to 9 of each selected column, sorted by body; the columns of body b are first[b] to first[b + 1].
    chi (k, n, 10): k sets of body parameters. Filled: z (n, m, c + 4), joint j's selected columns from
    first[j] on, then qdd_j, qd_j, smoothed sign(qd_j) = tanh(qd_j / eps), 1; tau (k, m, n) rigid-body torque
    for each set.
    """
    rot0, trans, gravity = arm
    q, qd, qdd = motion
    first, parameter = columns
    m, n = q.shape
    sets = chi.shape[0]
    c = parameter.shape[0]
    cs = np.empty((n, 2))
    w, wd, vd = np.empty((n, 3)), np.empty((n, 3)), np.empty((n, 3))
    lin, ang = np.empty((n, n, 3)), np.empty((n, n, 3))
    y = np.empty(10)
    tau[:] = 0.0
    for i in range(m):
        _kinematics(rot0, trans, gravity, q[i], qd[i], qdd[i], cs, w, wd, vd, lin, ang)
        for j in range(n):
            z[j, i, c] = qdd[i, j]
            z[j, i, c + 1] = qd[i, j]
            z[j, i, c + 2] = np.tanh(qd[i, j] / eps)
            z[j, i, c + 3] = 1.0
        for b in range(n):
            wx, wy, wz = w[b, 0], w[b, 1], w[b, 2]
            dx, dy, dz = wd[b, 0], wd[b, 1], wd[b, 2]
            vx, vy, vz = vd[b, 0], vd[b, 1], vd[b, 2]
            ww = wx * wx + wy * wy + wz * wz
            for j in range(b + 1):
                ax, ay, az = ang[b, j, 0], ang[b, j, 1], ang[b, j, 2]
                lx, ly, lz = lin[b, j, 0], lin[b, j, 1], lin[b, j, 2]
                ex = ay * wz - az * wy
                ey = az * wx - ax * wz
                ez = ax * wy - ay * wx
                lw = lx * wx + ly * wy + lz * wz
                y[0] = ax * dx + ex * wx
                y[1] = ax * dy + ay * dx + ex * wy + ey * wx
                y[2] = ax * dz + az * dx + ex * wz + ez * wx
                y[3] = ay * dy + ey * wy
                y[4] = ay * dz + az * dy + ey * wz + ez * wy
                y[5] = az * dz + ez * wz
                y[6] = ly * dz - lz * dy + lw * wx - ww * lx + vy * az - vz * ay
                y[7] = lz * dx - lx * dz + lw * wy - ww * ly + vz * ax - vx * az
                y[8] = lx * dy - ly * dx + lw * wz - ww * lz + vx * ay - vy * ax
                y[9] = lx * vx + ly * vy + lz * vz
                for k in range(first[b], first[b + 1]):
                    z[j, i, k] = y[parameter[k]]
                for s in range(sets):
                    torque = 0.0
                    for p in range(10):
                        torque += y[p] * chi[s, b, p]
                    tau[s, i, j] += torque


@njit(cache=True, error_model="numpy")
def _adjoint_of_columns(i, columns, chi, zbar, taubar, vectors, y, adjoints):  # type: ignore[no-untyped-def]
    """Fill the derivatives wb, db, vb (n, 3), lb, ab (b, j, 3) with respect to the vectors of sample `i`."""
    first, parameter = columns
    w, wd, vd, lin, ang = vectors
    wb, db, vb, lb, ab = adjoints
    sets, n = chi.shape[0], chi.shape[1]
    for b in range(n):
        wx, wy, wz = w[b, 0], w[b, 1], w[b, 2]
        dx, dy, dz = wd[b, 0], wd[b, 1], wd[b, 2]
        vx, vy, vz = vd[b, 0], vd[b, 1], vd[b, 2]
        ww = wx * wx + wy * wy + wz * wz
        wbx = wby = wbz = 0.0
        dbx = dby = dbz = 0.0
        vbx = vby = vbz = 0.0
        for j in range(b + 1):
            for p in range(10):
                value = 0.0
                for s in range(sets):
                    value += taubar[s, i, j] * chi[s, b, p]
                y[p] = value
            for k in range(first[b], first[b + 1]):
                y[parameter[k]] += zbar[j, i, k]
            ax, ay, az = ang[b, j, 0], ang[b, j, 1], ang[b, j, 2]
            lx, ly, lz = lin[b, j, 0], lin[b, j, 1], lin[b, j, 2]
            ex = ay * wz - az * wy
            ey = az * wx - ax * wz
            ez = ax * wy - ay * wx
            # the adjoint of the inertia columns is a symmetric matrix S: S wd, S w, S a + ..., S e
            ebx = y[0] * wx + y[1] * wy + y[2] * wz
            eby = y[1] * wx + y[3] * wy + y[4] * wz
            ebz = y[2] * wx + y[4] * wy + y[5] * wz
            abx = y[0] * dx + y[1] * dy + y[2] * dz + wy * ebz - wz * eby
            aby = y[1] * dx + y[3] * dy + y[4] * dz + wz * ebx - wx * ebz
            abz = y[2] * dx + y[4] * dy + y[5] * dz + wx * eby - wy * ebx
            mx, my, mz, mass = y[6], y[7], y[8], y[9]
            wm = wx * mx + wy * my + wz * mz
            lm = lx * mx + ly * my + lz * mz
            lw = lx * wx + ly * wy + lz * wz
            wbx += y[0] * ex + y[1] * ey + y[2] * ez + eby * az - ebz * ay
            wby += y[1] * ex + y[3] * ey + y[4] * ez + ebz * ax - ebx * az
            wbz += y[2] * ex + y[4] * ey + y[5] * ez + ebx * ay - eby * ax
            wbx += wm * lx + lw * mx - 2.0 * lm * wx
            wby += wm * ly + lw * my - 2.0 * lm * wy
            wbz += wm * lz + lw * mz - 2.0 * lm * wz
            dbx += y[0] * ax + y[1] * ay + y[2] * az + my * lz - mz * ly
            dby += y[1] * ax + y[3] * ay + y[4] * az + mz * lx - mx * lz
            dbz += y[2] * ax + y[4] * ay + y[5] * az + mx * ly - my * lx
            vbx += ay * mz - az * my + mass * lx
            vby += az * mx - ax * mz + mass * ly
            vbz += ax * my - ay * mx + mass * lz
            lb[b, j, 0] = dy * mz - dz * my + wm * wx - ww * mx + mass * vx
            lb[b, j, 1] = dz * mx - dx * mz + wm * wy - ww * my + mass * vy
            lb[b, j, 2] = dx * my - dy * mx + wm * wz - ww * mz + mass * vz
            ab[b, j, 0] = abx + my * vz - mz * vy
            ab[b, j, 1] = aby + mz * vx - mx * vz
            ab[b, j, 2] = abz + mx * vy - my * vx
        wb[b, 0], wb[b, 1], wb[b, 2] = wbx, wby, wbz
        db[b, 0], db[b, 1], db[b, 2] = dbx, dby, dbz
        vb[b, 0], vb[b, 1], vb[b, 2] = vbx, vby, vbz


@njit(cache=True, error_model="numpy")
def _adjoint_of_kinematics(rot0, trans, qd, cs, vectors, adjoints, qbar, qdbar, qddbar):  # type: ignore[no-untyped-def]
    """Run `_kinematics` backwards: from the derivatives of its vectors to those of q, qd, qdd (n,), added."""
    w, wd, vd, lin, ang = vectors
    wb, db, vb, lb, ab = adjoints
    n = qd.shape[0]
    for b in range(n - 1, -1, -1):
        cb, sb = cs[b, 0], cs[b, 1]
        r = rot0[b]
        px, py, pz = trans[b, 0], trans[b, 1], trans[b, 2]
        rate = qd[b]
        tx, ty = w[b, 0], w[b, 1]
        dbx, dby, dbz = db[b, 0], db[b, 1], db[b, 2]
        wbx = wb[b, 0] - dby * rate
        wby = wb[b, 1] + dbx * rate
        wbz = wb[b, 2]
        vbx, vby, vbz = vb[b, 0], vb[b, 1], vb[b, 2]
        qddbar[b] += dbz
        qdbar[b] += wbz + dbx * ty - dby * tx
        angle = wbx * ty - wby * tx
        angle += dbx * (wd[b, 1] + tx * rate) - dby * (wd[b, 0] - ty * rate)
        angle += vbx * vd[b, 1] - vby * vd[b, 0]
        if b > 0:
            gx, gy, gz = _out(r, cb, sb, vbx, vby, vbz)
            vb[b - 1, 0] += gx
            vb[b - 1, 1] += gy
            vb[b - 1, 2] += gz
            ux, uy, uz = _out(r, cb, sb, dbx, dby, dbz)
            db[b - 1, 0] += ux + py * gz - pz * gy
            db[b - 1, 1] += uy + pz * gx - px * gz
            db[b - 1, 2] += uz + px * gy - py * gx
            wx, wy, wz = w[b - 1, 0], w[b - 1, 1], w[b - 1, 2]
            gw = gx * wx + gy * wy + gz * wz
            wp = wx * px + wy * py + wz * pz
            gp = gx * px + gy * py + gz * pz
            ux, uy, uz = _out(r, cb, sb, wbx, wby, wbz)
            wb[b - 1, 0] += ux + gw * px + wp * gx - 2.0 * gp * wx
            wb[b - 1, 1] += uy + gw * py + wp * gy - 2.0 * gp * wy
            wb[b - 1, 2] += uz + gw * pz + wp * gz - 2.0 * gp * wz
            for j in range(b):
                ax, ay, az = ab[b, j, 0], ab[b, j, 1], ab[b, j, 2]
                lx, ly, lz = lb[b, j, 0], lb[b, j, 1], lb[b, j, 2]
                angle += ax * ang[b, j, 1] - ay * ang[b, j, 0] + lx * lin[b, j, 1] - ly * lin[b, j, 0]
                gx, gy, gz = _out(r, cb, sb, lx, ly, lz)
                lb[b - 1, j, 0] += gx
                lb[b - 1, j, 1] += gy
                lb[b - 1, j, 2] += gz
                ux, uy, uz = _out(r, cb, sb, ax, ay, az)
                ab[b - 1, j, 0] += ux + py * gz - pz * gy
                ab[b - 1, j, 1] += uy + pz * gx - px * gz
                ab[b - 1, j, 2] += uz + px * gy - py * gx
        qbar[b] += angle


@njit(cache=True, error_model="numpy")
def backward(arm, motion, columns, chi, eps, zbar, taubar, bars):  # type: ignore[no-untyped-def]
    """Add the derivative of a function of `forward`'s results with respect to q, qd, qdd to `bars`, (m, n) each.

    zbar (n, m, c + 4) and taubar (k, m, n) are the function's derivatives with respect to z and tau.
    """
    rot0, trans, gravity = arm
    q, qd, qdd = motion
    qbar, qdbar, qddbar = bars
    m, n = q.shape
    c = columns[1].shape[0]
    cs = np.empty((n, 2))
    w, wd, vd = np.empty((n, 3)), np.empty((n, 3)), np.empty((n, 3))
    lin, ang = np.empty((n, n, 3)), np.empty((n, n, 3))
    wb, db, vb = np.empty((n, 3)), np.empty((n, 3)), np.empty((n, 3))
    lb, ab = np.empty((n, n, 3)), np.empty((n, n, 3))
    vectors, adjoints = (w, wd, vd, lin, ang), (wb, db, vb, lb, ab)
    y = np.empty(10)
    for i in range(m):
        _kinematics(rot0, trans, gravity, q[i], qd[i], qdd[i], cs, w, wd, vd, lin, ang)
        for j in range(n):
            sign = np.tanh(qd[i, j] / eps)
            qddbar[i, j] += zbar[j, i, c]
            qdbar[i, j] += zbar[j, i, c + 1] + zbar[j, i, c + 2] * (1.0 - sign * sign) / eps
        _adjoint_of_columns(i, columns, chi, zbar, taubar, vectors, y, adjoints)
        _adjoint_of_kinematics(rot0, trans, qd[i], cs, vectors, adjoints, qbar[i], qdbar[i], qddbar[i])
