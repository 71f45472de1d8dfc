"""A three-joint arm that obeys the equations exactly, and sessions of it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from ident.dynamics.kinematics import Chain
from ident.dynamics.regressor import torque
from lwr_driver.session import JointColumns, Phase, Session
from tests.ident.known_arm import bench, estimated, truth_model  # noqa: F401  fixtures

PERIOD_S = 10.0
MOTOR_NOISE, JOINT_NOISE = 0.05, 0.03
Change = Callable[[dict[str, np.ndarray]], None]


@pytest.fixture(scope="session")
def chain() -> Chain:
    return Chain.from_table(
        [
            {"name": "one"},
            {"name": "two", "alpha": np.pi / 2},
            {"name": "three", "d": 0.4},
        ]
    )


@pytest.fixture(scope="session")
def bodies() -> np.ndarray:
    table = np.zeros((3, 10))
    for k, (mass, reach) in enumerate([(4.0, 0.1), (3.0, 0.2), (2.0, 0.15)]):
        table[k, 9] = mass
        table[k, 6] = mass * reach
        table[k, 7] = 0.1 * mass * reach
        inertia = mass * reach**2 + 0.02
        table[k, 0], table[k, 3], table[k, 5] = 0.02, inertia, inertia
    return table


def path(time: np.ndarray, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    random = np.random.default_rng(seed)
    q, qd, qdd = np.zeros((3, len(time), 3))
    for k in range(1, 6):
        w = 2 * np.pi * k / PERIOD_S
        a, b = random.normal(size=(2, 3)) * 0.45
        s, c = np.sin(w * time)[:, None], np.cos(w * time)[:, None]
        q += a * s + b * c
        qd += w * (a * c - b * s)
        qdd -= w * w * (a * s + b * c)
    return q, qd, qdd


def maker(chain: Chain, bodies: np.ndarray, rate: float) -> Callable[..., Session]:
    """Makes sessions of two periods; `change` alters torques and positions in place before they are measured."""

    def session(name: str, seed: int, change: Change | None = None, number: int = 0) -> Session:
        time = np.arange(0.0, 2 * PERIOD_S + 3.0, 1.0 / rate)
        q, qd, qdd = path(time, seed)
        sign = np.sign(qd)
        joint = torque(chain, q, qd, qdd, bodies) + 0.1 * sign + np.array([0.1, -0.2, 0.05])
        motor = joint + np.array([0.5, 0.4, 0.2]) * qdd + np.array([2.0, 2.5, 1.0]) * qd + 1.5 * sign
        signals = {"time": time, "q": q, "qd": qd, "joint": joint, "motor": motor}
        if change is not None:
            change(signals)
        random = np.random.default_rng(1000 + seed + 17 * number)
        stamps = (time * 1e9).astype(np.int64) + 10**15 + number * 10**12
        empty = np.zeros((len(time), 0))

        def columns(topic: str, position: np.ndarray, effort: np.ndarray) -> JointColumns:
            sequence = np.arange(1, len(time) + 1)
            return JointColumns(
                topic, chain.joint_names, stamps, stamps, sequence, position, empty, effort, name
            )

        phases = [Phase(int(stamps[round((1.5 + k * PERIOD_S) * rate)]), f"period {k + 1}") for k in range(2)]
        phases.append(Phase(int(stamps[round((1.5 + 2 * PERIOD_S) * rate)]), "return"))
        return Session(
            Path(name),
            {"robot": "three", "payload": "none"},
            {},
            chain.joint_names,
            columns("/joint_states", q, signals["joint"] + JOINT_NOISE * random.normal(size=q.shape)),
            columns("/motor_states", empty, signals["motor"] + MOTOR_NOISE * random.normal(size=q.shape)),
            None,
            tuple(phases),
        )

    return session


@pytest.fixture(scope="session")
def make(chain: Chain, bodies: np.ndarray) -> Callable[..., Session]:
    """Makes sessions at 125 Hz."""
    return maker(chain, bodies, 125.0)


@pytest.fixture(scope="session")
def make_250_hz(chain: Chain, bodies: np.ndarray) -> Callable[..., Session]:
    """The same with twice as many samples, for what is small."""
    return maker(chain, bodies, 250.0)
