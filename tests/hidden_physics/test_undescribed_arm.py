"""A healthy arm whose description states no stiffness: its sessions tell where the encoders are, and how it twists."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from ident.diagnosis import ArmData, commission
from ident.dynamics.kinematics import Chain
from lwr_driver.arm import Arm
from lwr_driver.session import read_session
from sim_backend.configuration import RobotConfig
from tests.hidden_physics.cases import Store
from tests.hidden_physics.engine import healthy_sets
from tests.hidden_physics.robots import Encoder

# From day to day, beside the 20 % of a known one.
_DAY = 0.03


@pytest.mark.slow
@pytest.mark.parametrize(("encoder", "days"), [("motor", 2), ("link", 1)])
def test_the_side_of_the_encoders_and_the_stiffness_are_found(
    encoder: Encoder, days: int, tmp_path: Path
) -> None:
    arm, store = Arm.load(), Store(tmp_path)
    chain = Chain.from_urdf(arm.urdf)
    sets = [[read_session(path) for path in store.train(case)] for case in healthy_sets(encoder, days)]
    found = commission(sets, chain, arm=ArmData(gear_ratio=arm.gear_ratio))
    assert found.encoder == encoder
    truth, told = 1.0 / np.array(RobotConfig().stiffness), found.compliance > 0.0
    # The first joints carry the arm; the wrist hardly twists.
    assert told[:4].all()
    known = told & ~np.isin(chain.joint_names, found.unknown_stiffness)
    assert known.any()
    np.testing.assert_allclose(found.compliance[known], truth[known], rtol=0.2 + _DAY)
    assert np.all(found.noise["motor"] < 0.6)
