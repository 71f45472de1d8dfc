"""How visible a fault is, and the strength that makes it as visible as wanted.

rho is the held-out error of the base model over that of the healthy twin, the largest of the joints' ratios
on either side. The base model has rigid bodies, a payload, drive inertia, viscous and Coulomb friction and an
offset on either side of the gear, by weighted least squares; what is slow or near a reversal is left out. What
these columns take up leaves no such error. There the model of the reference days, the announced payload known, is
held against the sessions and against those of the twin, so that the days' own differences count as the twin's.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
import pinocchio
from numpy.typing import NDArray
from scipy.signal import butter, sosfiltfilt

Floats = NDArray[np.float64]

_CUTOFF_HZ = 8.0
_BIN_S = 0.024
_EDGE_S = 0.4
_REVERSAL_S = 0.08
_SLOW_RAD_S = 0.02
_PASSES = 3
_RANK = 1e-9


@dataclass(frozen=True)
class Record:
    """Sampled channels of a session: times (m,), q and joint torque (m, n), motor torque at its times."""

    times: Floats
    q: Floats
    joint: Floats
    motor_times: Floats
    motor: Floats
    loaded: bool


@dataclass(frozen=True)
class Rows:
    """Equations of a session: (r, n, columns) of motor and joint rows, torques and use (r, n) each."""

    motor: Floats
    joint: Floats
    motor_torque: Floats
    joint_torque: Floats
    used: NDArray[np.bool_]


@dataclass(frozen=True)
class Yardstick:
    """The base model of an arm: kinematics, the healthy delay of its motor channel [s], joint torque sensors or not."""

    urdf: str
    motor_delay: float
    sensors: bool = True

    def rows(self, record: Record) -> Rows:
        """Equations of a session, every 24 ms."""
        rate = 1.0 / float(np.median(np.diff(record.times)))
        low_pass = butter(2, _CUTOFF_HZ, fs=rate, output="sos")
        q = sosfiltfilt(low_pass, record.q, axis=0)
        qd = np.gradient(q, 1.0 / rate, axis=0)
        qdd = np.gradient(qd, 1.0 / rate, axis=0)
        motor = np.column_stack(
            [np.interp(record.times, record.motor_times - self.motor_delay, x) for x in record.motor.T]
        )
        motor, joint = (sosfiltfilt(low_pass, x, axis=0) for x in (motor, record.joint))
        near = np.column_stack([_near_reversal(record.times, x) for x in qd.T])
        used = ~near & (np.abs(qd) > _SLOW_RAD_S)
        places = np.arange(
            round(_EDGE_S * rate), len(q) - round(_EDGE_S * rate), max(1, round(_BIN_S * rate))
        )
        model, data = _pinocchio(self.urdf)
        n = model.nv
        bodies = np.stack(
            [pinocchio.computeJointTorqueRegressor(model, data, q[k], qd[k], qdd[k]) for k in places]
        )
        payload = bodies[:, :, -10:] * float(record.loaded)
        unit = np.eye(n)
        columns = [
            qd[places, :, None] * unit,
            np.sign(qd[places, :, None]) * unit,
            np.broadcast_to(unit, (len(places), n, n)),
        ]
        zero = [np.zeros_like(column) for column in columns]
        inertia = qdd[places, :, None] * unit
        rigid = np.concatenate([bodies, payload], axis=2)
        return Rows(
            motor=np.concatenate([rigid, inertia, *columns, *columns], axis=2),
            joint=np.concatenate([rigid, 0.0 * inertia, *columns, *zero], axis=2),
            motor_torque=motor[places],
            joint_torque=joint[places],
            used=used[places],
        )

    def known(self, rows: Rows, payload: Floats) -> Rows:
        """The equations with the payload's ten parameters known, about the flange."""
        place = slice(self._bodies, self._bodies + 10)

        def without(matrix: Floats) -> Floats:
            matrix = matrix.copy()
            matrix[:, :, place] = 0.0
            return matrix

        return Rows(
            motor=without(rows.motor),
            joint=without(rows.joint),
            motor_torque=rows.motor_torque - rows.motor[:, :, place] @ payload,
            joint_torque=rows.joint_torque - rows.joint[:, :, place] @ payload,
            used=rows.used,
        )

    @property
    def _bodies(self) -> int:
        """Number of the arm's own inertial columns."""
        return 10 * int(_pinocchio(self.urdf)[0].nv)

    def model(self, train: Sequence[Rows]) -> Floats:
        """Parameters of the base model, by least squares weighted with each row's own error."""
        n = train[0].used.shape[1]
        weights = np.ones(2 * n)
        for _ in range(_PASSES):
            normal, right = 0.0, 0.0
            for rows in train:
                for side, (matrix, torque) in enumerate(self._sides(rows)):
                    for j in range(n):
                        use = rows.used[:, j]
                        y, t = matrix[use, j], torque[use, j]
                        w = weights[side * n + j] ** 2
                        normal, right = normal + w * (y.T @ y), right + w * (y.T @ t)
            scale = np.sqrt(np.diag(normal))
            scale[scale == 0.0] = 1.0
            inverse = np.linalg.pinv(normal / np.outer(scale, scale), rcond=_RANK, hermitian=True)
            found = inverse @ (right / scale) / scale
            weights = 1.0 / np.maximum(self.errors(found, train), 1e-6)
        return np.asarray(found)

    def errors(self, model: Floats, test: Sequence[Rows]) -> Floats:
        """RMS error of the computed torque (2 n,) [Nm], motor rows and joint rows."""
        n = test[0].used.shape[1]
        squares, counts = np.zeros(2 * n), np.zeros(2 * n)
        for rows in test:
            for side, (matrix, torque) in enumerate(self._sides(rows)):
                error = (torque - matrix @ model) * rows.used
                squares[side * n : side * n + n] += np.sum(error**2, axis=0)
                counts[side * n : side * n + n] += rows.used.sum(axis=0)
        return np.sqrt(squares / np.maximum(counts, 1))

    def _sides(self, rows: Rows) -> tuple[tuple[Floats, Floats], ...]:
        sides = ((rows.motor, rows.motor_torque), (rows.joint, rows.joint_torque))
        return sides if self.sensors else sides[:1]


@cache
def _pinocchio(urdf: str) -> tuple[Any, Any]:
    model = pinocchio.buildModelFromXML(urdf)
    return model, model.createData()


def _near_reversal(times: Floats, speed: Floats) -> NDArray[np.bool_]:
    turns = times[1:][np.diff(np.sign(speed)) != 0.0]
    if not len(turns):
        return np.zeros(len(times), dtype=bool)
    after = np.searchsorted(turns, times)
    later, before = turns[np.minimum(after, len(turns) - 1)], turns[np.maximum(after - 1, 0)]
    return np.asarray(np.minimum(np.abs(times - later), np.abs(times - before)) < _REVERSAL_S)


def ten(mass: float, centre: Sequence[float], gyration: Sequence[float]) -> Floats:
    """Ten parameters of a payload in the frame that its centre is given in, in pinocchio's order."""
    turned = mass * np.diag(np.square(gyration))
    return np.asarray(pinocchio.Inertia(mass, np.array(centre), turned).toDynamicParameters())


def inflation(error: Floats, twin: Floats) -> float:
    """rho of errors (2 n,)."""
    good = twin > 0.0
    return float(np.max(error[good] / twin[good]))


def found_strength(
    rho: Callable[[float], float], target: float, low: float, high: float, tries: int = 8
) -> tuple[float, float]:
    """Strength within [low, high] whose rho is the target, and its rho; the nearest found.

    The squared error grows about as the square of the strength, which gives the first guesses; then the interval
    around the target is halved on the logarithm. Within 4 % of the target, or of what is beyond 1, is near enough.
    """
    seen: list[tuple[float, float]] = []
    p = float(np.sqrt(low * high))
    below, above = np.log(low), np.log(high)
    for _ in range(tries):
        value = rho(p)
        seen.append((p, value))
        if _near(value, target):
            break
        if value < target:
            below = np.log(p)
        else:
            above = np.log(p)
        guess = np.log(p) + 0.5 * np.log((target**2 - 1.0) / max(value**2 - 1.0, 1e-3))
        if not below < guess < above:
            guess = 0.5 * (below + above)
        p = float(np.exp(guess))
    return min(seen, key=lambda pair: abs(np.log(pair[1] / target)))


def _near(value: float, target: float) -> bool:
    return abs(value - target) < max(0.12 * (target - 1.0), 0.004)
