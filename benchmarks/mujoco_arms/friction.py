"""Joint torques that MuJoCo does not know, and the loop over its steps.

Friction in the drive is generalised Maxwell slip (Al-Bender, Lampaert and Swevers 2005): parallel elements
that stick with a stiffness, or slip towards their share of the velocity-weakening curve.
"""

from __future__ import annotations

import ctypes
from functools import cache
from typing import Any

import mujoco
import numpy as np
from numba import njit
from numpy.typing import NDArray

Floats = NDArray[np.float64]

DRIVE = np.dtype(
    [
        (name, np.float64)
        for name in (
            "inertia",
            "coulomb",
            "viscous",
            "speed",
            "stribeck",
            "stribeck_speed",
            "curve",
            "asymmetry",
            "load",
            "coulomb_kelvin",
            "viscous_kelvin",
            "heat",
            "cooling",
            "presliding",
            "gear",
            "ripple_1",
            "ripple_2",
            "phase_1",
            "phase_2",
            "place_amplitude",
            "place_phase",
            "place_cycles",
            "bearing",
            "stiffness",
            "hardening",
            "softening_kelvin",
            "damping",
            "gap",
            "neighbour",
            "window",
            "window_phase",
            "jump",
            "jump_angle",
            "quadratic",
            "dwell",
            "gravity_friction",
        )
    ],
    align=True,
)
"""Parameters of one drive; 0 switches an effect off (presliding, stribeck_speed, speed, cooling: never 0)."""

ELEMENTS = 4
_SHARE = np.array([0.4, 0.3, 0.2, 0.1])
_REACH = np.array([0.2, 0.5, 1.0, 1.6])
_ATTRACTION = 200.0
_BEARING_M = 2e-4
_WINDOW = 0.8


@cache
def stepper() -> Any:
    """MuJoCo's own `mj_step` as a C function of two addresses."""
    from pathlib import Path

    folder = Path(mujoco.__file__).parent
    found = sorted(folder.glob("libmujoco*.so*")) or sorted(folder.parent.glob("mujoco*/libmujoco*.so*"))
    step = ctypes.CDLL(str(found[0])).mj_step
    step.argtypes, step.restype = [ctypes.c_void_p, ctypes.c_void_p], None
    return step


@njit(cache=True)
def drive_torques(p, th, om, q, qd, tl, z, slips, zb, kelvin, rest, dt, f, g, s):
    """Friction f and spring s of the drives, link-side torque g; all (n,), states z, slips, zb, kelvin."""
    for j in range(len(p)):
        v = om[j]
        speed, sign = abs(v), np.sign(v)
        level = p[j].coulomb * (1.0 + p[j].coulomb_kelvin * kelvin[j]) + p[j].load * abs(tl[j])
        rest[j] = rest[j] + dt if speed < 2e-3 else rest[j] * max(0.0, 1.0 - 4.0 * dt)
        level *= 1.0 + p[j].dwell * (1.0 - np.exp(-rest[j]))
        limit = level * (1.0 + p[j].stribeck * np.exp(-((v / p[j].stribeck_speed) ** 2)))
        limit *= 1.0 + p[j].asymmetry * sign
        limit *= 1.0 + p[j].place_amplitude * np.cos(p[j].place_cycles * q[j] - p[j].place_phase)
        if p[j].neighbour != 0.0:
            limit += p[j].neighbour * abs(om[j - 1 if j > 0 else 1])
        if p[j].window != 0.0 and np.cos(0.1 * p[j].gear * th[j] - p[j].window_phase) > _WINDOW:
            limit += p[j].window
        if p[j].gravity_friction != 0.0:
            limit += p[j].gravity_friction * max(0.0, tl[j])
        total = 0.0
        for i in range(ELEMENTS):
            most = _SHARE[i] * limit
            stiffness = _SHARE[i] * p[j].coulomb / (_REACH[i] * p[j].presliding)
            if slips[j, i] * v <= 0.0:
                slips[j, i] = 0.0
            if slips[j, i] == 0.0:
                z[j, i] += stiffness * v * dt
                if abs(z[j, i]) >= most:
                    slips[j, i] = np.sign(z[j, i])
                    z[j, i] = slips[j, i] * most
            else:
                z[j, i] += (slips[j, i] * most - z[j, i]) * min(1.0, _ATTRACTION * dt)
            total += z[j, i]
        share = speed / p[j].speed
        viscous = p[j].viscous * (1.0 + p[j].viscous_kelvin * kelvin[j]) * (1.0 - p[j].curve * share)
        total += viscous * v + p[j].quadratic * speed * v
        kelvin[j] += dt * (p[j].heat * abs(total * v) - kelvin[j] / p[j].cooling)
        turn = p[j].gear * th[j]
        total += p[j].ripple_1 * np.sin(turn + p[j].phase_1) + p[j].ripple_2 * np.sin(
            2.0 * turn + p[j].phase_2
        )
        f[j] = total
        if p[j].bearing != 0.0:
            zb[j] += p[j].bearing * qd[j] * dt / _BEARING_M
            zb[j] = min(max(zb[j], -p[j].bearing), p[j].bearing)
        g[j] = -zb[j]
        if p[j].jump != 0.0 and q[j] > p[j].jump_angle:
            g[j] -= p[j].jump
        twist = th[j] - q[j]
        if p[j].stiffness > 0.0:
            half = 0.5 * p[j].gap
            twist = np.sign(twist) * max(0.0, abs(twist) - half)
            k = p[j].stiffness * (1.0 + p[j].softening_kelvin * kelvin[j])
            s[j] = k * twist + p[j].hardening * twist**3 + p[j].damping * (om[j] - qd[j])


def make_loop():
    """The loop over steps, compiled around MuJoCo's C function."""
    step = stepper()

    @njit
    def loop(
        model, data, p, state, qpos, qvel, qacc, applied, actuated, ctrl, places, external, push, ref, rec
    ):
        """Steps of one stretch; `ref` (steps, 2 n), `rec` (records, 5 n); see `simulation`."""
        z, slips, zb, kelvin, rest, tl = state
        motor, spring = places
        every, dt = rec[1], rec[2]
        out = rec[0]
        n = len(p)
        th, om, q, qd = np.empty(n), np.empty(n), np.empty(n), np.empty(n)
        f, g, s = np.zeros(n), np.zeros(n), np.zeros(n)
        for k in range(len(ref)):
            for j in range(n):
                th[j], om[j] = qpos[motor[j]], qvel[motor[j]]
                q[j], qd[j] = th[j], om[j]
                if spring[j] >= 0:
                    q[j] += qpos[spring[j]]
                    qd[j] += qvel[spring[j]]
            drive_torques(p, th, om, q, qd, tl, z, slips, zb, kelvin, rest, dt, f, g, s)
            for j in range(n):
                applied[motor[j]] = -f[j] + g[j]
                if spring[j] >= 0:
                    applied[spring[j]] = s[j] + g[j]
                ctrl[j] = ref[k, j]
                ctrl[n + j] = ref[k, n + j]
            for i in range(len(push)):
                external[i] = push[i] * ref[k, 2 * n]
            step(model, data)
            for j in range(n):
                if spring[j] >= 0:
                    tl[j] = s[j]
                else:
                    tl[j] = actuated[motor[j]] - f[j] - p[j].inertia * qacc[motor[j]]
            if k % every == 0:
                row = k // every
                for j in range(n):
                    out[row, j] = th[j]
                    out[row, n + j] = q[j]
                    out[row, 2 * n + j] = actuated[motor[j]]
                    out[row, 3 * n + j] = tl[j]
                    out[row, 4 * n + j] = kelvin[j]

    return loop
