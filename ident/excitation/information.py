"""Information matrices of a motion, assembled from one small Gram matrix per joint.

The observation matrix itself is never built. Joint j has the same signals z_j (regressor entries of the bodies it
carries, then qdd_j, qd_j, sign(qd_j), 1) in its joint row and in its motor row, without and with payload. Every entry
of Omega^T W Omega is therefore a weighted sum of entries of the Gram matrices z_j^T z_j, and so is its derivative.

`Evaluator` samples a motion for the optimiser: kinematics on a fine grid, Gram matrices and torques, which vary
slowly, on every `refine`-th sample. It carries derivatives back to the coefficients.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt
from numba import njit

from fri.errors import ConfigurationError
from ident.excitation.arm_model import (
    BODY,
    DRIVE_SIGNAL,
    FCL,
    FVL,
    JOINT_SIDE,
    OFFL,
    ArmEstimate,
    Mechanism,
    split_name,
)
from ident.excitation.motions import Array, Basis, ParametricMotion, Samples
from ident.excitation.sweep import backward, forward


@dataclass(frozen=True, eq=False)
class Columns:
    """Distinct regressor columns needed by a set of parameters, sorted by body.

    parameter (c,): 0 to 9 within the body; first (n + 1,): the columns of body b are first[b] to first[b + 1].
    A payload shares the frame, and so the columns, of the last body.
    """

    joints: int
    parameter: np.ndarray
    first: np.ndarray
    place: dict[tuple[int, int], int]

    @classmethod
    def of(cls, joints: int, names: Iterable[str]) -> Columns:
        """Columns of the named parameters; links are 1 .. n, the payload is n + 1."""
        keys = set()
        for name in names:
            kind, link = split_name(name)
            if link > joints + 1 or (link == joints + 1 and kind not in BODY):
                raise ConfigurationError(
                    f"parameter {name} does not exist in an arm of {joints} joints and a payload"
                )
            if kind in BODY:
                keys.add((min(link, joints) - 1, BODY.index(kind)))
        ordered = sorted(keys)
        first = np.array([sum(body < b for body, _ in ordered) for b in range(joints + 1)], dtype=np.int64)
        parameter = np.array([index for _, index in ordered], dtype=np.int64)
        return cls(joints, parameter, first, {key: position for position, key in enumerate(ordered)})

    @property
    def tables(self) -> tuple[np.ndarray, np.ndarray]:
        """First column of each body and parameter of each column, in the form of the sweeps."""
        return self.first, self.parameter

    @property
    def width(self) -> int:
        """Columns of z: the rigid ones and four drive signals."""
        return int(self.parameter.size) + 4


@dataclass(frozen=True, eq=False)
class Rows:
    """Rows of the stacked observation matrix, and their weights.

    model : 1 joint rows, 2 motor and joint rows, 3 their difference
    sessions : for each session of the planned motion, whether the payload is mounted
    joint, motor (n,): weight of each row, 1/sigma² or 1; the difference rows of model 3 use `motor`
    """

    model: int
    sessions: tuple[bool, ...]
    joint: Array
    motor: Array

    def __post_init__(self) -> None:
        if self.model not in (1, 2, 3):
            raise ConfigurationError(f"model {self.model} is unknown; models 1, 2 and 3 exist")
        if not self.sessions:
            raise ConfigurationError("no session is planned; at least one is needed")

    @classmethod
    def unweighted(cls, joints: int, model: int = 2, sessions: Sequence[bool] = (False, True)) -> Rows:
        """All weights one, the paper's stacked matrix."""
        return cls(model, tuple(sessions), np.ones(joints), np.ones(joints))


class Assembly:
    """Omega^T W Omega of the named parameters as a linear function of the Gram matrices."""

    def __init__(self, columns: Columns, names: Sequence[str], rows: Rows) -> None:
        self.names = tuple(names)
        self.rows = rows
        split = [split_name(name) for name in names]
        joints = columns.joints
        rigid = columns.width - 4
        parameter: list[int] = []
        signal: list[int] = []
        weight: list[Array] = []
        offset, block = [0], [0]
        for joint in range(joints):
            active, place = [], []
            for index, (kind, link) in enumerate(split):
                if kind in BODY:
                    if min(link, joints) > joint and rows.model != 3:
                        active.append(index)
                        place.append(columns.place[min(link, joints) - 1, BODY.index(kind)])
                elif link == joint + 1:
                    active.append(index)
                    place.append(rigid + DRIVE_SIGNAL[kind])
            table = np.zeros((len(active), len(active)))
            for loaded in rows.sessions:
                for side, value in self._sides(joint):
                    seen = np.array(
                        [self._seen(*split[index], joints, side, loaded) for index in active], dtype=float
                    )
                    table += value * np.outer(seen, seen)
            parameter += active
            signal += place
            weight.append(table.ravel())
            offset.append(offset[-1] + len(active))
            block.append(block[-1] + table.size)
        lists = (parameter, signal, offset, block)
        parameters, signals, offsets, blocks = (np.array(part, dtype=np.int64) for part in lists)
        self._tables = (parameters, signals, np.concatenate(weight), offsets, blocks)

    def _sides(self, joint: int) -> list[tuple[str, float]]:
        row, motor = ("joint", float(self.rows.joint[joint])), float(self.rows.motor[joint])
        return {1: [row], 2: [row, ("motor", motor)], 3: [("difference", motor)]}[self.rows.model]

    @staticmethod
    def _seen(kind: str, link: int, joints: int, side: str, loaded: bool) -> bool:
        if kind in BODY:
            return side != "difference" and (link <= joints or loaded)
        if kind in JOINT_SIDE:
            return side != "difference"
        return side != "joint"

    def information(self, gram: Array) -> Array:
        """The matrix (p, p) from the Gram matrices (n, c, c)."""
        out = np.zeros((len(self.names), len(self.names)))
        _gather(gram, *self._tables, out)
        return out

    def adjoint(self, bar: Array, gram_bar: Array) -> None:
        """Add the derivative with respect to the Gram matrices of a function with derivative `bar` (p, p)."""
        _scatter(bar, *self._tables, gram_bar)


@njit(cache=True, error_model="numpy")
def _gather(gram, parameter, signal, weight, offset, block, out):  # type: ignore[no-untyped-def]
    for joint in range(offset.shape[0] - 1):
        start, stop = offset[joint], offset[joint + 1]
        k = block[joint]
        for a in range(start, stop):
            for b in range(start, stop):
                out[parameter[a], parameter[b]] += weight[k] * gram[joint, signal[a], signal[b]]
                k += 1


@njit(cache=True, error_model="numpy")
def _scatter(bar, parameter, signal, weight, offset, block, gram_bar):  # type: ignore[no-untyped-def]
    for joint in range(offset.shape[0] - 1):
        start, stop = offset[joint], offset[joint + 1]
        k = block[joint]
        for a in range(start, stop):
            for b in range(start, stop):
                gram_bar[joint, signal[a], signal[b]] += weight[k] * bar[parameter[a], parameter[b]]
                k += 1


@dataclass(eq=False)
class View:
    """One motion in the form read by the criteria, and the adjoints filled by them.

    gram (n, c, c): mean over the samples of z_j z_j^T
    torque (m, n): joint torque under the last load case [Nm]
    """

    gram: Array
    torque: Array
    gram_bar: Array = field(init=False)
    torque_bar: Array = field(init=False)

    def __post_init__(self) -> None:
        self.gram_bar = np.zeros_like(self.gram)
        self.torque_bar = np.zeros_like(self.torque)

    def clear(self) -> None:
        """Set the adjoints to zero."""
        self.gram_bar[:] = 0.0
        self.torque_bar[:] = 0.0


class Evaluator:
    """Grids and scratch memory for one mechanism, basis and set of columns; not to be shared between threads."""

    def __init__(
        self,
        mechanism: Mechanism,
        basis: Basis,
        estimate: ArmEstimate,
        columns: Columns,
        *,
        samples: int = 64,
        refine: int = 5,
        sign_speed: float = 0.02,
    ) -> None:
        self.mechanism, self.basis, self.estimate, self.columns = mechanism, basis, estimate, columns
        self.samples, self.refine, self.sign_speed = samples, refine, sign_speed
        self.fine = samples * refine
        self.times = np.arange(self.fine) * (basis.duration / self.fine)
        self.matrices = [np.ascontiguousarray(basis.matrix(self.times, order)) for order in range(4)]
        self.loads = np.ascontiguousarray(estimate.loads)
        n = mechanism.joints
        self.z = np.zeros((n, samples, columns.width))
        self.tau = np.zeros((self.loads.shape[0], samples, n))
        self._zbar = np.zeros_like(self.z)
        self._gram = np.zeros((n, columns.width, columns.width))
        self._coarse: tuple[Array, Array, Array]

    def signals(self, x: Array) -> list[Array]:
        """q, qd, qdd, qddd on the fine grid for the coefficients x (n, free); each (fine, n)."""
        return [matrix @ x.T for matrix in self.matrices]

    def view(self, signals: Sequence[Array], *, exact_sign: bool = False) -> View:
        """Gram matrices and loaded joint torque; `z`, `tau` keep the coarse signals for the pullback."""
        q, qd, qdd = (np.ascontiguousarray(signal[:: self.refine]) for signal in signals[:3])
        self._coarse = (q, qd, qdd)
        columns, speed = self.columns, 1e-9 if exact_sign else self.sign_speed
        forward(self.mechanism.dynamics, self._coarse, columns.tables, self.loads, speed, self.z, self.tau)
        for joint in range(self.mechanism.joints):
            first = columns.first[joint]
            part = self.z[joint, :, first:]
            self._gram[joint, first:, first:] = part.T @ part
        drives = self.estimate.drives
        sign = self.z[:, :, -2].T
        torque = self.tau[-1] + qd * drives[:, FVL] + sign * drives[:, FCL] + drives[:, OFFL]
        return View(self._gram / self.samples, torque)

    def gradient(self, view: View) -> Array:
        """Derivative with respect to the coefficients (n, free), from the adjoints of the view."""
        drives, columns = self.estimate.drives, self.columns
        sign = self.z[:, :, -2].T
        rate = view.torque_bar * (drives[:, FVL] + (1.0 - sign**2) / self.sign_speed * drives[:, FCL])
        for joint in range(self.mechanism.joints):
            first = columns.first[joint]
            bar = view.gram_bar[joint, first:, first:]
            np.matmul(
                self.z[joint, :, first:], (bar + bar.T) / self.samples, out=self._zbar[joint, :, first:]
            )
        taubar = np.zeros_like(self.tau)
        taubar[-1] = view.torque_bar
        return self._pull(self._zbar, taubar, rate, np.zeros_like(rate))

    def torque_gradient(self, taubar: Array, rate: Array, acceleration: Array) -> Array:
        """Derivative of a function of rigid torques (k, m, n), coarse velocities and accelerations (m, n)."""
        return self._pull(np.zeros_like(self._zbar), taubar, rate, acceleration)

    def _pull(self, zbar: Array, taubar: Array, rate: Array, acceleration: Array) -> Array:
        columns, arm = self.columns, self.mechanism
        bars = (np.zeros_like(taubar[0]), np.array(rate, order="C"), np.array(acceleration, order="C"))
        backward(arm.dynamics, self._coarse, columns.tables, self.loads, self.sign_speed, zbar, taubar, bars)
        total = np.zeros((arm.joints, self.basis.free))
        for bar, matrix in zip(bars, self.matrices, strict=False):
            total += bar.T @ matrix[:: self.refine]
        return total


def motion_view(
    motion: ParametricMotion,
    mechanism: Mechanism,
    estimate: ArmEstimate,
    columns: Columns,
    step_s: float = 0.01,
) -> View:
    """A parametric motion sampled every `step_s`, with the true sign of the velocities."""
    count = max(200, round(motion.duration / step_s))
    times = np.arange(count) * (motion.duration / count)
    return samples_view(motion.sample(times), mechanism, estimate, columns)


def samples_view(samples: Samples, mechanism: Mechanism, estimate: ArmEstimate, columns: Columns) -> View:
    """Samples of any motion, measured ones included; jerks are not used."""
    evaluator = Evaluator(
        mechanism, ConstantBasis(1.0, free=0), estimate, columns, samples=len(samples.q), refine=1
    )
    return evaluator.view(list(samples[:3]), exact_sign=True)


@dataclass(frozen=True)
class ConstantBasis:
    """Postures held still: the basis of one constant; without it (free = 0) for samples given directly."""

    duration: float
    free: int = 1

    def matrix(self, t: npt.ArrayLike, derivative: int = 0) -> Array:
        """One, and zero for every derivative."""
        return np.full((np.size(t), self.free), 1.0 if derivative == 0 else 0.0)

    def motion(self, x: Array) -> ParametricMotion:
        """ConfigurationError: a posture is not a motion."""
        raise ConfigurationError("a posture is no motion")

    def grid_factor(self, n: int, derivative: int) -> float:
        """One: the extremum of a constant is everywhere."""
        return 1.0
