"""One motion seen by the optimiser: signals on two grids, Gram matrices, torques, and derivatives pulled back
to coefficients.

Everything kinematic is sampled on a fine grid; Gram matrices and torques, which vary slowly, on every
`refine`-th sample.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ident.excitation.estimate import ArmEstimate
from ident.excitation.information import Columns
from ident.excitation.mechanism import Mechanism
from ident.excitation.motion import Array, Basis
from ident.excitation.objectives import View
from ident.excitation.sweep import backward, forward

__all__ = ["Evaluator"]

_FVL, _FCL, _OFFL = 1, 2, 3


class Evaluator:
    """Scratch memory and grids for one mechanism, basis and set of columns; not to be shared between
    threads.
    """

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
        arm, columns = self.mechanism, self.columns
        speed = 1e-9 if exact_sign else self.sign_speed
        forward(arm.dynamics, self._coarse, columns.tables, self.loads, speed, self.z, self.tau)
        for joint in range(self.mechanism.joints):
            first = columns.first[joint]
            part = self.z[joint, :, first:]
            self._gram[joint, first:, first:] = part.T @ part
        drives = self.estimate.drives
        sign = self.z[:, :, -2].T
        torque = self.tau[-1] + qd * drives[:, _FVL] + sign * drives[:, _FCL] + drives[:, _OFFL]
        return View(self._gram / self.samples, torque)

    def gradient(self, view: View) -> Array:
        """Derivative with respect to the coefficients (n, free) of whatever filled the view's adjoints."""
        drives, columns = self.estimate.drives, self.columns
        sign = self.z[:, :, -2].T
        rate = view.torque_bar * (drives[:, _FVL] + (1.0 - sign**2) / self.sign_speed * drives[:, _FCL])
        for joint in range(self.mechanism.joints):
            first = columns.first[joint]
            bar = view.gram_bar[joint, first:, first:]
            np.matmul(
                self.z[joint, :, first:], (bar + bar.T) / self.samples, out=self._zbar[joint, :, first:]
            )
        taubar = np.zeros_like(self.tau)
        taubar[-1] = view.torque_bar
        return self._pull(self._zbar, taubar, rate, None)

    def torque_gradient(self, taubar: Array, rate: Array, acceleration: Array) -> Array:
        """Derivative of a function of the rigid torques (k, m, n), coarse velocities and accelerations (m,
        n).
        """
        return self._pull(np.zeros_like(self._zbar), taubar, rate, acceleration)

    def _pull(self, zbar: Array, taubar: Array, rate: Array, acceleration: Array | None) -> Array:
        columns, arm = self.columns, self.mechanism
        bars = (np.zeros_like(taubar[0]), np.ascontiguousarray(rate), np.zeros_like(taubar[0]))
        if acceleration is not None:
            bars[2][:] = acceleration
        backward(arm.dynamics, self._coarse, columns.tables, self.loads, self.sign_speed, zbar, taubar, bars)
        total = np.zeros((arm.joints, self.basis.free))
        for bar, matrix in zip(bars, self.matrices, strict=False):
            total += bar.T @ matrix[:: self.refine]
        return total
