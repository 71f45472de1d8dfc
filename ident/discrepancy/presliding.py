"""How far the drives of a healthy arm slide after a reversal before their Coulomb friction has turned."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar

from ident.discrepancy.nominal import Nominal
from ident.effects.operators import dahl

__all__ = ["presliding_reach"]

Floats = NDArray[np.float64]

_GRID = np.geomspace(2e-5, 1e-2, 10)
_SURE = 30.0


def presliding_reach(nominal: Nominal, values: Floats) -> Floats:
    """Reach (n,) [rad] of Dahl's friction that suits the motor rows best, 0 where a plain sign does as well.

    values : base parameters (p,). For each joint by itself what they leave is fitted with the drive's own
    acceleration, speed and offset, and Coulomb friction with each reach in turn.
    """
    n = nominal.arm.chain.n
    reach = np.zeros(n)
    if "motor" not in nominal.rows:
        return reach
    rows = nominal.rows["motor"]
    motions = nominal.motions
    signals = [[getattr(m, name) for m in motions] for name in ("motor_acceleration", "motor_speed")]
    thrust, speed = (nominal.reduce("motor", parts) for parts in signals)
    predicted = np.einsum("jmp,p->mj", rows.matrix, values)
    before = nominal.reduce("motor", [m.direction for m in motions])
    for joint in range(n):
        keep = rows.valid[:, joint] & ~rows.test
        coulomb = float(motions[0].motor_coulomb[joint])
        if keep.sum() < 200:
            continue
        target = (rows.target - predicted)[:, joint] + coulomb * before[:, joint]
        plain = np.column_stack([thrust[:, joint], speed[:, joint], np.ones(len(speed))])
        # Noise of neighbouring rows, so that the fit does not follow what it cannot know.
        difference = np.diff(target[keep])
        noise = float(np.quantile(np.abs(difference - np.median(difference)), 0.68) ** 2 / 2.0)

        def misfit(
            logarithm: float | None,
            joint: int = joint,
            keep: NDArray[np.bool_] = keep,
            plain: Floats = plain,
            target: Floats = target,
        ) -> float:
            state = []
            for m in motions:
                v = m.motor_speed[:, joint]
                if logarithm is None:
                    state.append(np.sign(v))
                else:
                    path = np.ascontiguousarray(np.cumsum(v) * m.dt)
                    state.append(dahl(path, float(np.exp(logarithm)), float(np.sign(v[0]))))
            table = np.column_stack([plain, nominal.reduce("motor", state)])[keep]
            rest = target[keep] - table @ np.linalg.lstsq(table, target[keep], rcond=None)[0]
            return float(rest @ rest)

        errors = [misfit(float(np.log(length))) for length in _GRID]
        best = int(np.argmin(errors))
        low, high = np.log(_GRID[max(best - 1, 0)]), np.log(_GRID[min(best + 1, len(_GRID) - 1)])
        found = minimize_scalar(misfit, bounds=(low, high), method="bounded", options={"maxiter": 8})
        if misfit(None) - float(found.fun) > _SURE * noise:
            reach[joint] = float(np.exp(found.x))
    return reach
