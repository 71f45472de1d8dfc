from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from ident.excitation.arm_model import ArmEstimate, Mechanism, Noise
from ident.excitation.check import Limits
from lwr_driver.arm import Arm
from lwr_driver.configuration import CONFIGS


@pytest.fixture(scope="session")
def arm() -> Arm:
    return Arm.load("lwr4plus.yaml")


@pytest.fixture(scope="session")
def mechanism(arm: Arm) -> Mechanism:
    return Mechanism.from_urdf(arm.urdf)


@pytest.fixture(scope="session")
def limits(arm: Arm) -> Limits:
    return Limits(arm.q_low, arm.q_high, arm.v_max, arm.a_max, arm.j_max, arm.tau_max)


@pytest.fixture(scope="session")
def estimate(mechanism: Mechanism) -> ArmEstimate:
    path: Path = CONFIGS / "emulator/table2.yaml"
    known = ArmEstimate.from_file(path, mechanism.joints, "paper_load")
    return ArmEstimate(known.bodies, known.drives, known.payload, noise=Noise.published())


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(7)
