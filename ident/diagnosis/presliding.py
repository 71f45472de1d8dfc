"""How far the drives of a healthy arm slide after a reversal before their Coulomb friction has turned.

Asperities have many lengths (Al-Bender, Lampaert and Swevers, IEEE Trans. Autom. Control 50 (2005)): one reach
describes most of the friction, and a small share that turns within a longer distance the rest. That share is
small beside the noise of one set, so it is a mean over all healthy sets.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar

from ident.diagnosis.evidence import Evidence
from ident.diagnosis.nominal import Arm, Nominal
from ident.effects.motion import dahl

__all__ = ["SlowTurns", "presliding_reach", "slow_turns", "with_far_presliding"]

Floats = NDArray[np.float64]

_GRID = np.geomspace(2e-5, 1e-2, 10)
_SURE = 30.0
# Longer distances to try, over the reach; the friction that turns within them, over its own standard error.
_LONGER = (4.0, 12.0, 36.0)
_CLEAR = 3.0

SlowTurns = NDArray[np.float64]
"""(2, longer distances, n): Coulomb friction that turns slowly [Nm], and its standard deviation."""


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


def slow_turns(nominal: Nominal, evidence: Evidence) -> SlowTurns:
    """Coulomb friction (2, distances, n) that turns within each of the longer distances, and its standard
    deviation, beside all columns that the evidence holds; zero and infinite where nothing is known."""
    n = nominal.arm.chain.n
    found = np.zeros((2, len(_LONGER), n))
    found[1] = np.inf
    reach = nominal.arm.reach
    if reach is None or "motor" not in nominal.rows:
        return found
    for joint in np.flatnonzero((reach > 0.0) & nominal.moving):
        for k, longer in enumerate(_LONGER):
            signals = []
            for m in nominal.motions:
                path = np.ascontiguousarray(np.cumsum(m.motor_speed[:, joint]) * m.dt)
                state = dahl(path, longer * float(reach[joint]), float(np.sign(m.motor_speed[0, joint])))
                signals.append(state - m.direction[:, joint])
            rows = {("motor", int(joint)): nominal.reduce("motor", signals)[:, None]}
            score = evidence.score(evidence.padded(rows))
            if np.isfinite(score.gain):
                found[:, k, joint] = score.coefficients[0], np.sqrt(score.covariance[0, 0])
    return found


def with_far_presliding(arm: Arm, days: Sequence[SlowTurns], coulomb: Sequence[Floats]) -> Arm:
    """The arm with the share of friction that turns within a longer distance, where several healthy sets agree
    on one: the mean of the sets over its standard error, from their scatter, is clear.

    coulomb : (n,) of each set [Nm].
    """
    if arm.reach is None or len(days) < 3:
        return arm
    table = np.array(days)
    weight = 1.0 / table[:, 1] ** 2
    total = np.maximum(weight.sum(axis=0), 1e-300)
    mean = np.sum(weight * table[:, 0], axis=0) / total
    error = np.maximum(np.std(table[:, 0], axis=0, ddof=1) / np.sqrt(len(days)), total**-0.5)
    clear = np.where(np.isfinite(weight).all(axis=0) & (mean > _CLEAR * error), mean**2 * total, 0.0)
    best = np.argmax(clear, axis=0)
    joints = np.arange(len(best))
    level = np.maximum(np.mean(coulomb, axis=0), 1e-9)
    share = np.where(clear[best, joints] > 0.0, mean[best, joints] / level, 0.0)
    return replace(arm, far=np.array(_LONGER)[best] * arm.reach, far_share=np.minimum(share, 0.5))
