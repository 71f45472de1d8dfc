"""Sessions with positions and joint torques alone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from lwr_driver.session import Session
from tests.ident.estimation_arm import session

TIMES = np.arange(0.0, 20.0, 0.004)


def of_joints(q: np.ndarray, effort: np.ndarray) -> Session:
    """A session of the joints J1, J2, ... at `TIMES` with their joint torques alone."""
    whole, random, stamps = session(rate_hz=250.0), np.random.default_rng(0), np.rint(1e9 * TIMES)
    names = tuple(f"J{number + 1}" for number in range(q.shape[1]))
    columns = replace(
        whole.joint,
        names=names,
        log_time=stamps.astype(np.int64),
        publish_time=stamps.astype(np.int64),
        sequence=np.arange(1, len(TIMES) + 1),
        position=q + 1e-5 * random.normal(size=q.shape),
        velocity=np.zeros((len(TIMES), 0)),
        effort=effort + 0.05 * random.normal(size=q.shape),
    )
    return replace(whole, joint_names=names, joint=columns, motor=None, phases=())
