"""Presliding of the drives of a healthy arm: the length of Dahl's friction, and a share that turns over longer ones."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from ident.diagnosis.gain.evidence import Evidence
from ident.diagnosis.gain.products import Floats
from ident.diagnosis.rows.nominal import Nominal
from ident.diagnosis.rows.nominal_arm import NominalArm
from ident.effects.motion import dahl

# Initial presliding lengths [rad], and least fall of the misfit over the noise.
_GRID = np.geomspace(2e-5, 1e-2, 10)
_SURE = 30.0
# Longer distances to try, over the presliding length; least slow friction over its own standard error.
_LONGER = (4.0, 12.0, 36.0)
_CLEAR = 3.0

SlowTurns = NDArray[np.float64]
"""(2, longer distances, n): slowly reversing Coulomb friction [Nm], and its standard deviation."""


def presliding_length(nominal: Nominal, values: Floats) -> Floats:
    """Presliding length (n,) [rad] of Dahl's friction with the best fit to the motor rows, 0 if a sign fits as well.

    values : base parameters (p,). For each joint by itself, their residual is fitted with the drive's own
    acceleration, speed and offset, and Coulomb friction with each length in turn.
    """
    from scipy.optimize import minimize_scalar  # on use: its import is slow

    n = nominal.arm.chain.n
    lengths = np.zeros(n)
    if "motor" not in nominal.rows:
        return lengths
    rows, motions = nominal.rows["motor"], nominal.motions
    acceleration = nominal.grid.reduce("motor", [m.motor_acceleration for m in motions])
    speed = nominal.grid.reduce("motor", [m.motor_speed for m in motions])
    predicted = np.einsum("jmp,p->mj", rows.matrix, values)
    before = nominal.grid.reduce("motor", [m.direction for m in motions])
    for joint in range(n):
        keep = rows.valid[:, joint] & ~rows.test
        coulomb = float(motions[0].motor_coulomb[joint])
        if keep.sum() < 200:
            continue
        target = (rows.target - predicted)[:, joint] + coulomb * before[:, joint]
        plain = np.column_stack([acceleration[:, joint], speed[:, joint], np.ones(len(speed))])
        # Noise from neighbouring rows, against an overfit.
        difference = np.diff(target[keep])
        noise = float(np.quantile(np.abs(difference - np.median(difference)), 0.68) ** 2 / 2.0)
        misfit = partial(_misfit, nominal, joint, keep, plain, target)
        errors = [misfit(float(np.log(length))) for length in _GRID]
        best = int(np.argmin(errors))
        low, high = np.log(_GRID[max(best - 1, 0)]), np.log(_GRID[min(best + 1, len(_GRID) - 1)])
        found = minimize_scalar(misfit, bounds=(low, high), method="bounded", options={"maxiter": 8})
        if misfit(None) - float(found.fun) > _SURE * noise:
            lengths[joint] = float(np.exp(found.x))
    return lengths


def _misfit(
    nominal: Nominal,
    joint: int,
    keep: NDArray[np.bool_],
    plain: Floats,
    target: Floats,
    logarithm: float | None,
) -> float:
    """Sum of squares [Nm^2] with the logarithm of a presliding length, None for a sign."""
    state = []
    for m in nominal.motions:
        v = m.motor_speed[:, joint]
        if logarithm is None:
            state.append(np.sign(v))
        else:
            path = np.ascontiguousarray(np.cumsum(v) * m.dt)
            state.append(dahl(path, float(np.exp(logarithm)), float(np.sign(v[0]))))
    table = np.column_stack([plain, nominal.grid.reduce("motor", state)])[keep]
    rest = target[keep] - table @ np.linalg.lstsq(table, target[keep], rcond=None)[0]
    return float(rest @ rest)


def slow_turns(nominal: Nominal, evidence: Evidence) -> SlowTurns:
    """Coulomb friction (2, distances, n) with reversal within each of the longer distances, and its standard
    deviation, beside the present columns of the evidence; zero and infinite if unknown.
    """
    n = nominal.arm.chain.n
    found = np.zeros((2, len(_LONGER), n))
    found[1] = np.inf
    lengths = nominal.arm.presliding
    if lengths is None or "motor" not in nominal.rows:
        return found
    for joint in np.flatnonzero((lengths > 0.0) & nominal.moving):
        for k, longer in enumerate(_LONGER):
            signals = []
            for m in nominal.motions:
                path = np.ascontiguousarray(np.cumsum(m.motor_speed[:, joint]) * m.dt)
                state = dahl(path, longer * float(lengths[joint]), float(np.sign(m.motor_speed[0, joint])))
                signals.append(state - m.direction[:, joint])
            rows = {("motor", int(joint)): nominal.grid.reduce("motor", signals)[:, None]}
            score = evidence.score(rows)
            if np.isfinite(score.gain):
                found[:, k, joint] = score.coefficients[0], np.sqrt(score.covariance[0, 0])
    return found


def with_far_presliding(arm: NominalArm, days: Sequence[SlowTurns], coulomb: Sequence[Floats]) -> NominalArm:
    """The arm with a share of friction with reversal within a longer distance, if several healthy sets agree on one:
    the mean of the sets is large against its standard error from their scatter.

    coulomb : (n,) of each set [Nm].
    """
    if arm.presliding is None or len(days) < 3:
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
    return replace(arm, far=np.array(_LONGER)[best] * arm.presliding, far_share=np.minimum(share, 0.5))
