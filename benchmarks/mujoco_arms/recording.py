"""A motion as a session log."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.mujoco_arms.days import Setup
from benchmarks.mujoco_arms.sensors import lose, sense
from benchmarks.mujoco_arms.simulation import RECORD_S, Truth
from lwr_driver.session import SessionWriter, session_metadata

Floats = NDArray[np.float64]

_EPOCH_NS = 1_700_000_000_000_000_000


def logged(setup: Setup, truth: Truth) -> tuple[NDArray[np.bool_], Floats, Floats, Floats, Floats, Floats]:
    """Rows that reach the log, times, positions, joint torques, times of the motor torques, motor torques."""
    random = np.random.default_rng(setup.seed)
    times, q, joint, late, motor = sense(setup.arm, setup.sensing, truth, random)
    keep = np.ones(len(times), dtype=bool)
    if setup.sensing.loss.what != "none":
        keep, q, joint, motor = lose(setup.sensing.loss, times, late, q, joint, motor, setup.arm.rate, random)
    return keep, times, q, joint, late, motor


def write(path: Path, setup: Setup, truth: Truth) -> Path:
    """Write the session log of a motion; one that is there is replaced."""
    arm = setup.arm
    keep, times, q, joint, late, motor = logged(setup, truth)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.unlink(missing_ok=True)
    metadata = session_metadata(
        robot=arm.kind.name,
        payload=setup.label.payload,
        payload_mass=setup.label.mass,
        experiment="identification",
        uid=setup.uid,
        motor_torque_source="simulator",
        utc_start="2023-11-14T22:13:20+00:00",
    )
    grid = np.arange(len(truth)) * RECORD_S
    command = np.column_stack([np.interp(times, grid, column) for column in truth.command.T])
    with SessionWriter(path, arm.kind.joints, metadata, robot_description=arm.kind.urdf) as writer:
        stamps, numbers = _stamps(times), np.arange(len(times))
        sensed = joint[keep] if arm.has_sensors else None
        writer.write_joint_states(stamps[keep], q[keep], sensed, sequence=numbers[keep])
        writer.write_joint_command(stamps[keep], command[keep], sequence=numbers[keep])
        writer.write_motor_states(_stamps(late), motor)
    return path


def _stamps(times: Floats) -> NDArray[np.int64]:
    return np.asarray(_EPOCH_NS + np.round(times * 1e9).astype(np.int64))
