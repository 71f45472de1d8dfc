"""Links on the springs of their joints, for a known motion of the motors.

With the encoders at the motors a joint's torque bends it, and the links ring on the springs whenever a motor stops
or turns. The joint torques show it, the positions do not. Given the motors' angles theta the links follow

    M(q) q'' + b(q, q') = tau,  tau = K s(theta - q) + D (theta' - q'),

with mass matrix M, all other torques b, stiffness K and damping D (Spong, J. Dyn. Syst. Meas. Control 109 (1987),
with the motors' side given); s is the twist, less the part within the play of a joint (Nordin and Gutman,
Automatica 38 (2002)): with play the link crosses the gap almost free, arrives, and rings. M and b vary little over
the twist of a joint, so they are taken along a first guess of the links' motion. The remaining linear equation has
time-varying coefficients. It is integrated by the trapezoidal rule for a link ringing slower than the samples, and by
the backward rule for a faster one: a light wrist follows its motor and does not chatter.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numba import njit
from numpy.typing import NDArray

Floats = NDArray[np.float64]

# Weight of the end of a step for a slow mode: half is the trapezoidal rule, one is the backward one.
_LATE = 0.505
# Stiffness within the play (seals, lubricant) over the stiffness beyond it.
_SOFT = 0.02


@dataclass(frozen=True, eq=False)
class Springs:
    """Springs of n joints along a motion of N samples.

    mass : (N, n, n) of the links [kg m^2]; other : (N, n) torques of the links besides their inertia [Nm].
    angle, speed : (N, n) of the motors. stiffness : (n,) [Nm/rad]; damping : (n,) [Nm s/rad]; dt : [s].
    loose, play : a joint (from 0) with lost motion and half of it [rad]; -1 for none.
    """

    mass: Floats
    other: Floats
    angle: Floats
    speed: Floats
    stiffness: Floats
    damping: Floats
    dt: float
    loose: int = -1
    play: float = 0.0

    @cached_property
    def links(self) -> tuple[Floats, Floats, Floats]:
        """Position, speed and acceleration (N, n) of the links, initially at rest on their springs."""
        start = np.stack([self.angle[0] - self.other[0] / self.stiffness, self.speed[0]])
        return self._solve(self._drive - self.other, self.angle, start)

    @cached_property
    def torque(self) -> Floats:
        """Torque (N, n) [Nm] through the joints."""
        q, v, _ = self.links
        found: Floats = self._drive - self.stiffness * q - self.damping * v
        if self.loose >= 0:
            inside = np.clip((self.angle - q)[:, self.loose], -self.play, self.play)
            found[:, self.loose] -= (1.0 - _SOFT) * self.stiffness[self.loose] * inside
        return found

    def with_play(self, joint: int, gap: float) -> Springs:
        """The same with a lost motion of `gap` [rad] in a joint."""
        return replace(self, loose=joint, play=0.5 * gap)

    def softer(self, joint: int, compliance: float) -> Springs:
        """The same with `compliance` [rad/Nm] more in a joint, and the damping unchanged."""
        stiffness = self.stiffness.copy()
        stiffness[joint] = 1.0 / (1.0 / stiffness[joint] + compliance)
        return replace(self, stiffness=stiffness)

    @property
    def _drive(self) -> Floats:
        return np.asarray(self.stiffness * self.angle + self.damping * self.speed)

    def _solve(self, force: Floats, angle: Floats, start: Floats) -> tuple[Floats, Floats, Floats]:
        inertia = np.maximum(np.einsum("kii->i", self.mass) / len(self.mass), 1e-9)
        # Square of the ringing phase within a step.
        fast = self.stiffness * self.dt**2 / inertia
        late = _LATE + (1.0 - _LATE) * np.minimum(1.0, 0.25 * fast)
        lost = np.zeros(len(self.stiffness))
        if self.loose >= 0:
            lost[self.loose] = (1.0 - _SOFT) * self.stiffness[self.loose]
        q, v, a = _integrate(
            self.mass, force, angle, self.stiffness, self.damping, lost, self.play, self.dt, start, late
        )
        return q, v, a


@njit(cache=True)
def _solve_in_place(matrix, right):  # type: ignore[no-untyped-def]
    """x (n,) with `matrix` (n, n) x = `right`, symmetric, by L D L'; both are overwritten.

    No root is taken: identified parameters may make a small inertia of the wrist a little negative.
    """
    n = right.shape[0]
    for j in range(n):
        for k in range(j):
            matrix[j, j] -= matrix[j, k] * matrix[j, k] * matrix[k, k]
        for i in range(j + 1, n):
            for k in range(j):
                matrix[i, j] -= matrix[i, k] * matrix[j, k] * matrix[k, k]
            matrix[i, j] /= matrix[j, j]
    for i in range(n):
        for k in range(i):
            right[i] -= matrix[i, k] * right[k]
    for i in range(n - 1, -1, -1):
        right[i] /= matrix[i, i]
        for k in range(i + 1, n):
            right[i] -= matrix[k, i] * right[k]


@njit(cache=True)
def _integrate(mass, force, angle, stiffness, damping, lost, play, dt, start, late):  # type: ignore[no-untyped-def]
    """Position, speed, acceleration (N, n) of M q'' + D q' + K q = force - lost clip(angle - q) from `start`."""
    count, n = force.shape
    q, v, a = np.empty((count, n)), np.empty((count, n)), np.empty((count, n))
    q[0], v[0] = start[0], start[1]
    matrix, right, fixed = np.empty((n, n)), np.empty(n), np.empty(n)
    early = 1.0 - late
    loose = -1
    for i in range(n):
        if lost[i] > 0.0:
            loose = i
    side = 0.0
    for step in range(count):
        if step:
            for i in range(n):
                push = early[i] * force[step - 1, i] + late[i] * force[step, i]
                here = q[step - 1, i] + late[i] * early[i] * dt * v[step - 1, i]
                fixed[i] = push - stiffness[i] * here - early[i] * damping[i] * v[step - 1, i]
                for j in range(n):
                    fixed[i] += 0.5 * (mass[step - 1, i, j] + mass[step, i, j]) / dt * v[step - 1, j]
            if loose >= 0:
                twist = angle[step - 1, loose] - q[step - 1, loose]
                fixed[loose] -= lost[loose] * early[loose] * min(play, max(-play, twist))
            # The link's side of the gap at the end of the step, 0 within the gap.
            for _attempt in range(3):
                for i in range(n):
                    right[i] = fixed[i]
                    for j in range(n):
                        matrix[i, j] = 0.5 * (mass[step - 1, i, j] + mass[step, i, j]) / dt
                for i in range(n):
                    matrix[i, i] += late[i] * (late[i] * dt * stiffness[i] + damping[i])
                if loose >= 0:
                    weight = lost[loose] * late[loose]
                    if side == 0.0:
                        ahead = q[step - 1, loose] + dt * early[loose] * v[step - 1, loose]
                        right[loose] -= weight * (angle[step, loose] - ahead)
                        matrix[loose, loose] -= weight * dt * late[loose]
                    else:
                        right[loose] -= weight * side * play
                _solve_in_place(matrix, right)
                if loose < 0:
                    break
                moved = dt * (early[loose] * v[step - 1, loose] + late[loose] * right[loose])
                twist = angle[step, loose] - q[step - 1, loose] - moved
                now = 1.0 if twist > play else (-1.0 if twist < -play else 0.0)
                if now == side:
                    break
                side = now
            for i in range(n):
                v[step, i] = right[i]
                q[step, i] = q[step - 1, i] + dt * (early[i] * v[step - 1, i] + late[i] * right[i])
        for i in range(n):
            for j in range(n):
                matrix[i, j] = mass[step, i, j]
            right[i] = force[step, i] - stiffness[i] * q[step, i] - damping[i] * v[step, i]
        if loose >= 0:
            twist = angle[step, loose] - q[step, loose]
            right[loose] -= lost[loose] * min(play, max(-play, twist))
        _solve_in_place(matrix, right)
        for i in range(n):
            a[step, i] = right[i]
    return q, v, a
