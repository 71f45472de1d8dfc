"""Memory and CPU time of a diagnosis of two long sessions of seven joints.

Run `python -m benchmarks.long_sessions [--seconds 600]`. The sessions are made here: a healthy LWR4+, positions and
joint torques every 4 ms, motor torques every 12 ms, a motion that does not repeat.
"""

from __future__ import annotations

import argparse
import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import resource
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ident.diagnosis import diagnose
from ident.dynamics.kinematics import Chain
from ident.dynamics.regressor import torque
from lwr_driver.configuration import find
from lwr_driver.session import JointColumns, Session

STEP_S, MOTOR_EVERY = 0.004, 3
FREQUENCIES_HZ = (0.11, 0.23, 0.37, 0.51)


def session(chain: Chain, seconds: float, seed: int) -> Session:
    random = np.random.default_rng(seed)
    t = np.arange(0.0, seconds, STEP_S)
    q, qd, qdd = np.zeros((3, len(t), chain.n))
    for w in 2.0 * np.pi * np.array(FREQUENCIES_HZ):
        size, phase = random.uniform(0.1, 0.35, chain.n), random.uniform(0.0, 6.3, chain.n)
        angle = w * t[:, None] + phase
        q += size * np.sin(angle)
        qd += size * w * np.cos(angle)
        qdd -= size * w**2 * np.sin(angle)
    link = torque(chain, q, qd, qdd, chain.urdf_inertials()) + 0.3 * np.sign(qd) + 0.1
    drive = link + qdd + 8.0 * qd + 5.0 * np.sign(qd) + 0.3 * random.normal(size=q.shape)
    link += 0.1 * random.normal(size=q.shape)
    stamps = (t * 1e9).astype(np.int64) + 10**15 + seed * 10**13
    empty, count = np.zeros((len(t), 0)), np.arange(1, len(t) + 1)

    def columns(topic: str, every: int, position: np.ndarray, effort: np.ndarray) -> JointColumns:
        some = slice(None, None, every)
        times, number = stamps[some], count[: len(stamps[some])]
        name = f"{seed}.mcap"
        return JointColumns(
            topic, chain.joint_names, times, times, number, position[some], empty[some], effort[some], name
        )

    return Session(
        Path(f"{seed}.mcap"),
        {"robot": "LWR4+", "payload": "none"},
        {},
        chain.joint_names,
        columns("/joint_states", 1, q, link),
        columns("/motor_states", MOTOR_EVERY, empty, drive),
    )


def main(arguments: Sequence[str]) -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--seconds", type=float, default=600.0, help="length of each of the two sessions")
    seconds = parser.parse_args(arguments).seconds
    chain = Chain.from_urdf(find("lwr4plus.urdf"))
    sessions = [session(chain, seconds, seed) for seed in (1, 2)]
    start = time.process_time()
    found = diagnose(sessions, chain)
    used = time.process_time() - start
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(
        f"2 sessions of {seconds:.0f} s: CPU {used:.0f} s, peak memory {peak:.0f} MB, {len(found.findings)} findings"
    )
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
