"""Preflight of stops: wherever a motion is stopped, the arm keeps its clearance and the limits of its torques."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from lwr_driver.arm import Arm
from lwr_driver.arm.collision import CollisionChecker
from lwr_driver.motion import Motion
from lwr_driver.stopping import AT_ONCE, FINE_S, around, begins, nearest_stop, sampled_stops
from runner.experiment_file import Payload
from runner.preflight import TORQUE_SHARE, Item, loaded_model

_TORQUE_STEP_S = 0.08
_NEAR_WORST = 0.95  # of the largest torque: stops around those are looked at


def check_stops(
    arm: Arm, checker: CollisionChecker, motion: Motion, payload: Payload | None, margin: float
) -> list[Item]:
    """Clearance and torque of the stops of a motion. margin : least clearance [m]."""
    return [stop_torque(arm, motion, payload), stop_clearance(checker, motion, margin)]


def stop_clearance(checker: CollisionChecker, motion: Motion, margin: float) -> Item:
    """The tightest moment of all stops, and of the ways back after a contact."""
    found = nearest_stop(checker, motion, margin)
    near = found.clearance
    when = "on the way back after a contact" if np.isnan(found.after_s) else f"{found.after_s:.2f} s later"
    return Item(
        "clearance of a stop",
        f"{1000 * near.distance:.0f} mm, {' to '.join(near.pair)}, stop at t = {near.time_s:.2f} s, {when}",
        f"{1000 * margin:.0f} mm",
        near.distance >= margin,
        "a stop brakes each joint by itself and leaves the planned path; choose a motion that keeps further away or "
        "is slower there, or correct the cell file",
    )


def stop_torque(arm: Arm, motion: Motion, payload: Payload | None) -> Item:
    """Largest predicted share of a joint torque limit in all stops, by the nominal model."""
    model = loaded_model(arm, payload)
    coarse = begins(motion, _TORQUE_STEP_S)
    shares = _torques(arm, model, motion, coarse)
    worst = shares.max(axis=1)
    fine = around(motion, coarse[worst >= _NEAR_WORST * worst.max()], _TORQUE_STEP_S, FINE_S)
    shares, rows = np.concatenate([shares, _torques(arm, model, motion, fine)]), np.append(coarse, fine)
    stop, joint = np.unravel_index(int(np.argmax(shares)), shares.shape)
    share, limit = shares[stop, joint], arm.tau_max[joint]
    return Item(
        "torque of a stop",
        f"{arm.joint_names[joint]} {share * limit:.1f} Nm, stop at t = {rows[stop] * motion.period_s:.2f} s",
        f"{TORQUE_SHARE * limit:.1f} Nm",
        bool(share <= TORQUE_SHARE),
        "take a lighter payload or a slower motion, or lower `acceleration_rad_s2` in the arm file",
    )


def _torques(arm: Arm, model: pin.Model, motion: Motion, rows: NDArray[np.intp]) -> NDArray[np.float64]:
    """Largest shares of the torque limits in the stops begun at `rows` (m,), (m, 7)."""
    largest = np.zeros((len(rows), len(arm.tau_max)))
    data = model.createData()
    for first in range(0, len(rows), AT_ONCE):
        part = rows[first : first + AT_ONCE]
        paths, sample_s = sampled_stops(arm.limits, motion, part)
        before = motion.q[np.maximum(part - round(sample_s / motion.period_s), 0)]
        q = np.concatenate([before[:, np.newaxis], paths, paths[:, -1:]], axis=1)
        qd = (q[:, 2:] - q[:, :-2]) / (2.0 * sample_s)
        qdd = (q[:, 2:] - 2.0 * q[:, 1:-1] + q[:, :-2]) / sample_s**2
        # Later entries of a stop, at rest, have the torque of the last one here.
        moving = 1 + np.count_nonzero(np.any(paths != paths[:, -1:], axis=2), axis=1)
        for stop, entries in enumerate(moving):
            each = zip(paths[stop, :entries], qd[stop, :entries], qdd[stop, :entries], strict=True)
            tau = np.array([pin.rnea(model, data, *state) for state in each])
            largest[first + stop] = np.max(np.abs(tau), axis=0) / arm.tau_max
    return largest
