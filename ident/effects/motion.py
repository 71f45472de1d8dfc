"""The motion of an arm for effects, and operators with memory along it: Dahl's hysteresis, low-pass."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numba import njit
from numpy.typing import NDArray

from ident.dynamics import regressor
from ident.dynamics.kinematics import Chain
from ident.dynamics.structure import TorqueSide
from ident.effects.springs import Springs
from lwr_driver.session.spool import spans

Floats = NDArray[np.float64]
Picked = slice | NDArray[np.int64]
"""Samples of a motion."""

_BY_SAMPLE = (
    "time", "q", "qd", "qdd", "motor_speed", "motor_acceleration", "joint_torque", "motor_torque",
)  # fmt: skip
# Values along a whole motion remembered for its parts.
_KEPT = 4
# A drive that begins with a tenth of this speed is at rest.
_REST_RAD_S = 0.01
STILL_RAD_S = 2e-3
"""A slower drive rests, and its friction stays what it is."""


@dataclass(frozen=True, eq=False)
class ArmMotion:
    """Motion of n joints at N samples and its torques as predicted by the present model.

    chain : the arm. bodies : (n, 10) inertial parameters of the links, the payload in the last one.
    session : number of the session (from 0), in the order of the recordings.
    time : (N,) [s] from the start of the session, evenly spaced. duration_s : length of the session [s].
    q, qd, qdd : (N, n), positions as published [rad], and their derivatives.
    motor_speed, motor_acceleration : (N, n) of the motors referred to the joints; equal to qd and qdd for
        stiff joints.
    joint_torque, motor_torque : (N, n) predicted torque through the joint and at the motor [Nm], free of any
        sensor's noise.
    gear_ratio : (n,) motor turns for a turn of the joint. inertia : (n,) of the drives.
    link_coulomb, motor_coulomb : (n,) Coulomb friction of link and drive [Nm].
    friction : the model's drive friction (N, n) [Nm] as a function of the motors' speed (N, n).
    motor_q : (N, n) positions of the motors referred to the joints [rad], where they are the published ones and q those
        of the links behind springs; None: q.
    slip : (N, n) Coulomb friction of the drives over its level: from one sign to the other within the presliding
        length after a reversal; None: at once.
    springs : between published motors and the links; None if the links' positions are published, or the stiffness
        is unknown.
    loaded : whether the payload is attached.
    begun_s : beginning of the session [s] by a clock of all sessions. earlier : the motion before it by that clock, of
        this session or of another one; None for the first.
    whole, picked : of a part, the motion it is from and its samples there; None for a whole motion.
    """

    chain: Chain
    bodies: Floats
    session: int
    time: Floats
    duration_s: float
    q: Floats
    qd: Floats
    qdd: Floats
    motor_speed: Floats
    motor_acceleration: Floats
    joint_torque: Floats
    motor_torque: Floats
    gear_ratio: Floats
    inertia: Floats
    link_coulomb: Floats
    motor_coulomb: Floats
    friction: Callable[[Floats], Floats] = field(default=np.zeros_like)
    motor_q: Floats | None = None
    slip: Floats | None = None
    springs: Springs | None = None
    loaded: bool = True
    begun_s: float = 0.0
    earlier: ArmMotion | None = None
    whole: ArmMotion | None = None
    picked: Picked | None = None

    @property
    def n(self) -> int:
        """Number of joints."""
        return self.chain.n

    @property
    def dt(self) -> float:
        """Time between samples [s], of the whole motion."""
        time = self.time if self.whole is None else self.whole.time
        return float(time[1] - time[0]) if len(time) > 1 else 1e-3

    def motor_angle(self, joint: int, compliance: float) -> Floats:
        """Position (N,) of a motor referred to its joint: the published one, or that of the link and the twist of the
        joint of a compliance [rad/Nm]."""
        published = (self.q if self.motor_q is None else self.motor_q)[:, joint]
        return published + compliance * self.joint_torque[:, joint] if compliance else published

    def part(self, picked: Picked) -> ArmMotion:
        """Some samples of this motion. Operators with memory go along the whole one: see `along`."""
        found = {name: getattr(self, name)[picked] for name in _BY_SAMPLE}
        for name in ("motor_q", "slip"):
            values = getattr(self, name)
            found[name] = None if values is None else values[picked]
        return replace(self, **found, whole=self, picked=picked)

    def along(self, made: Callable[[ArmMotion], Floats], *key: Hashable) -> Floats:
        """Values (N, ...) of an operator with memory: made on the whole motion, picked for a part.

        key : name and parameters; the whole motion remembers the last few values for its next part.
        """
        if self.whole is None or self.picked is None:
            return made(self)
        return self.whole._remembered(made, key)[self.picked]

    def _remembered(self, made: Callable[[ArmMotion], Floats], key: tuple[Hashable, ...]) -> Floats:
        found = self._kept.get(key)
        if found is None:
            found = made(self)
            # Threads may forget what another one has just made: it is made again, nothing else.
            for old in list(self._kept)[: len(self._kept) + 1 - _KEPT]:
                self._kept.pop(old, None)
            self._kept[key] = found
        return found

    def around(self, seconds: float) -> ArmMotion:
        """The uninterrupted motion from the first to the last sample of a part, and `seconds` to either side."""
        if self.whole is None:
            return self
        more = int(np.ceil(abs(seconds) / self.dt)) + 2
        first, last = np.searchsorted(self.whole.time, self.time[[0, -1]])
        return self.whole.part(slice(max(int(first) - more, 0), int(last) + more + 1))

    def beside(self, seconds: float, made: Callable[[ArmMotion], Floats]) -> Floats:
        """Values (N, ...) of an operator that reaches `seconds` to either side, for a part made from its
        surroundings."""
        around = self.around(seconds)
        values = made(around)
        if around is self or not isinstance(around.picked, slice):
            return values
        first, own = around.picked.start, self.picked
        return values[slice(own.start - first, own.stop - first) if isinstance(own, slice) else own - first]

    @cached_property
    def _kept(self) -> dict[tuple[Hashable, ...], Floats]:
        return {}

    @property
    def direction(self) -> Floats:
        """(N, n) `slip`, or the sign of the motors' speed."""
        return np.sign(self.motor_speed) if self.slip is None else self.slip

    @cached_property
    def viscous(self) -> Floats:
        """Viscous friction (n,) of the drives [Nm s/rad]."""
        one = np.ones((1, self.n))
        return np.asarray((self.friction(2.0 * one) - self.friction(one))[0])

    @cached_property
    def drive_friction(self) -> Floats:
        """Friction (N, n) of the drives [Nm]."""
        return self.friction(self.motor_speed) + self.motor_coulomb * (
            self.direction - np.sign(self.motor_speed)
        )

    def friction_power(self, joint: int) -> Floats:
        """Power (N,) [W] of the friction of a drive."""

        def power(whole: ArmMotion) -> Floats:
            parts = (whole.part(some) for some in spans(len(whole.time), 2**14))
            return np.concatenate([one.drive_friction[:, joint] * one.motor_speed[:, joint] for one in parts])

        return self._remembered(power, ("power", joint))

    def rigid_torque(self, q: Floats, qd: Floats, qdd: Floats, bodies: Floats | None = None) -> Floats:
        """Rigid inverse dynamics (N, n) [Nm] of the links with the payload, or of other `bodies` (n, 10)."""
        return regressor.torque(self.chain, q, qd, qdd, self.bodies if bodies is None else bodies)

    @cached_property
    def frames(self) -> regressor.Frames:
        """The joints' frames along the motion, computed once."""
        return regressor.frames(self.chain, self.q)

    @cached_property
    def still_rigid(self) -> Floats:
        """`rigid_torque` (N, n) of the motion itself [Nm], computed once."""
        return self.torque_of(self.bodies)

    def torque_of(self, bodies: Floats) -> Floats:
        """`rigid_torque` (N, n) [Nm] of the motion itself with other `bodies` (n, 10)."""
        return regressor.torque_in(self.chain, self.frames, self.qd, self.qdd, bodies)

    def smooth_torque(self, side: TorqueSide) -> Floats:
        """Predicted torque (N, n) of a side without the Coulomb friction and its jumps at reversals."""
        link = self.link_coulomb * np.sign(self.qd)
        if side == "joint":
            return self.joint_torque - link
        return self.motor_torque - link - self.motor_coulomb * self.direction

    def gravity_along(self, direction: Floats) -> Floats:
        """Gravity torque (N, n) [Nm] in a field of 9.81 m/s^2 along `direction` (3,), in frame 0."""
        tilted = replace(self.chain, gravity=9.81 * np.asarray(direction, dtype=np.float64))
        return regressor.gravity_torque(tilted, self.q, self.bodies)

    def displaced(self, joint: int, shift: Floats, rate: Floats, acceleration: Floats) -> Floats:
        """Change (N, n) of the predicted joint torque [Nm] when a link is at q + shift.

        shift, rate, acceleration : (N,) of the joint [rad, rad/s, rad/s^2].
        """
        at = regressor.moved_frames(self.chain, self.frames, self.q[:, joint] + shift, joint)
        qd, qdd = self.qd.copy(), self.qdd.copy()
        qd[:, joint] += rate
        qdd[:, joint] += acceleration
        moved = regressor.torque_in(self.chain, at, qd, qdd, self.bodies)
        return np.subtract(moved, self.still_rigid, out=moved)


def in_order(motions: Sequence[ArmMotion]) -> list[ArmMotion]:
    """The same motions, each with the one before it by the clock of all sessions."""
    found, before = list(motions), None
    for k in sorted(range(len(found)), key=lambda k: found[k].begun_s + float(found[k].time[0])):
        found[k] = before = replace(found[k], earlier=before)
    return found


def dahl_after(z, step, length):  # type: ignore[no-untyped-def]
    """State z in [-1, 1] of Dahl's friction after a step dx along its path: dz = (1 - z sign(dx)) dx / length.

    Integrated exactly over the step, so any step is stable. Dahl, Solid friction damping of mechanical vibrations,
    AIAA Journal 14 (1976).
    """
    if step > 0.0:
        return 1.0 - (1.0 - z) * np.exp(-step / length)
    if step < 0.0:
        return -1.0 + (1.0 + z) * np.exp(step / length)
    return z


_after = njit(cache=True, nogil=True)(dahl_after)


@njit(cache=True, nogil=True)
def dahl(path, length, start):  # type: ignore[no-untyped-def]
    """States (N,) of Dahl's friction along `path` (N,), see `dahl_after`."""
    out = np.empty(path.shape[0])
    z = start
    out[0] = z
    for k in range(1, path.shape[0]):
        z = _after(z, path[k] - path[k - 1], length)
        out[k] = z
    return out


def turned_friction(path: Floats, speed: Floats, length: float) -> Floats:
    """`dahl` along a path (N,) with its speed (N,) [rad/s]; one that begins at rest, without friction to either side.

    A drive slower than `STILL_RAD_S` rests and keeps its friction: what a low-pass leaves of a stop, and the steps of
    an encoder, turn none.
    """
    steps = np.diff(path, prepend=path[:1])
    steps[np.abs(speed) < STILL_RAD_S] = 0.0
    return np.asarray(dahl(np.cumsum(steps), length, float(np.tanh(speed[0] / _REST_RAD_S))))


@njit(cache=True, nogil=True)
def first_order(signal, keep, start):  # type: ignore[no-untyped-def]
    """First-order low-pass (N,) of `signal` (N,): value = keep value + (1 - keep) signal."""
    out = np.empty(signal.shape[0])
    value = start
    for k in range(signal.shape[0]):
        value = keep * value + (1.0 - keep) * signal[k]
        out[k] = value
    return out
