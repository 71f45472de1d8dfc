"""Channels of two joints that swing, with noisy torques."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from lwr_driver.session import JointColumns, Session

RATE = 250.0
COUNT = 2000


def columns(
    effort: np.ndarray, position: np.ndarray | None = None, sequence: np.ndarray | None = None
) -> JointColumns:
    """A channel of two joints that swing, with the efforts (n, 2)."""
    time = np.arange(len(effort)) / RATE
    if position is None:
        position = np.column_stack([np.sin(time), np.cos(1.3 * time)])
    stamps = np.rint(time * 1e9).astype(np.int64)
    sequence = np.arange(1, len(effort) + 1) if sequence is None else sequence
    empty = np.zeros((len(effort), 0))
    return JointColumns(
        "/joint_states", ("a", "b"), stamps + 10**15, stamps, sequence, position, empty, effort
    )


def noisy(seed: int = 0, count: int = COUNT) -> np.ndarray:
    random = np.random.default_rng(seed)
    time = np.arange(count) / RATE
    return np.column_stack([10.0 * np.sin(time), 5.0 * np.cos(2.0 * time)]) + 0.05 * random.normal(
        size=(count, 2)
    )


def session(joint: JointColumns, motor: JointColumns | None = None) -> Session:
    return Session(Path("run.mcap"), {}, {}, joint.names, joint, motor, None, ())
