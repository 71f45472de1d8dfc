"""Arms of several tests."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from ident.dynamics.kinematics import Chain
from lwr_driver.configuration import find

RIGHT = np.pi / 2
DATA = Path(__file__).resolve().parents[4] / "shared" / "data"


def lwr() -> Chain:
    return Chain.from_urdf(find("lwr4plus.urdf"))


def puma560() -> Chain:
    """Craig's modified-DH table (Introduction to Robotics, section 3.7), lengths of Corke (1994)."""
    return Chain.from_table(
        [
            {},
            {"alpha": -RIGHT},
            {"d": 0.4318, "r": 0.15005},
            {"alpha": -RIGHT, "d": 0.0203, "r": 0.4318},
            {"alpha": RIGHT},
            {"alpha": -RIGHT},
        ]
    )


def tx40() -> Chain:
    """Staubli TX40 (DH constants of BIRDy: d3 0.035, a3 0.225, d4 0.225)."""
    return Chain.from_table(
        [
            {},
            {"alpha": -RIGHT},
            {"d": 0.225, "r": 0.035},
            {"alpha": RIGHT, "r": 0.225},
            {"alpha": -RIGHT},
            {"alpha": RIGHT},
        ]
    )


def ur10() -> Chain:
    return Chain.from_table(
        [
            {},
            {"alpha": RIGHT},
            {"d": -0.612},
            {"d": -0.5723, "r": 0.163941},
            {"alpha": RIGHT, "r": 0.1157},
            {"alpha": -RIGHT, "r": 0.0922},
        ]
    )


def panda() -> Chain:
    return Chain.from_table(
        [
            {"r": 0.333},
            {"alpha": -RIGHT},
            {"alpha": RIGHT, "r": 0.316},
            {"alpha": RIGHT, "d": 0.0825},
            {"alpha": -RIGHT, "d": -0.0825, "r": 0.384},
            {"alpha": RIGHT},
            {"alpha": RIGHT, "d": 0.088},
        ]
    )


def scara() -> Chain:
    return Chain.from_table([{}, {"d": 0.4}, {"d": 0.3}, {"kind": "prismatic", "theta": 0.3}])


def random_chain(rng: np.random.Generator, *, longest: int = 5) -> Chain:
    """Revolute and prismatic joints with many right, parallel and coincident axes, and a few odd ones."""
    n = int(rng.integers(1, longest + 1))
    prismatic = rng.random(n) < rng.choice([0.0, 0.3, 0.6])
    alpha = rng.choice([0.0, RIGHT, -RIGHT, np.pi, 0.7], n, p=[0.4, 0.2, 0.2, 0.05, 0.15])
    alpha[0] = rng.choice([0.0, 0.0, RIGHT, 0.4])
    gravity = np.array([[0.0, 0.0, -9.81], [0.0, -9.81, 0.0], [3.0, 2.0, -9.0]])
    return Chain(
        tuple(f"j{k}" for k in range(n)),
        prismatic,
        alpha,
        rng.choice([0.0, 0.3, -0.2], n),
        np.where(prismatic, rng.choice([0.0, RIGHT, 0.5], n), 0.0),
        rng.choice([0.0, 0.25, 0.4], n),
        gravity=gravity[rng.choice(3, p=[0.7, 0.2, 0.1])],
    )


def states(chain: Chain, samples: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    q, qd, qdd = np.random.default_rng(seed).uniform(-2.0, 2.0, (3, samples, chain.n))
    return q, qd, qdd


def bodies(n: int, seed: int = 0) -> np.ndarray:
    """(n, 10) inertial parameters of real bodies (random positive definite pseudo-inertia)."""
    from ident.dynamics.parameters import from_pseudo_inertia

    root = np.random.default_rng(seed).normal(size=(n, 4, 4))
    return from_pseudo_inertia(root @ np.swapaxes(root, 1, 2) + 0.1 * np.eye(4))


def shared(path: str) -> Path:
    """A file of the measured data beside the project."""
    file = DATA / path
    if not file.is_file():
        pytest.skip(f"{file} is absent: the recordings of other people's robots are not part of the project")
    return file
