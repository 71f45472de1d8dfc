"""What the command line says of an arm's drives."""

from __future__ import annotations

import pytest

from fri.errors import ConfigurationError
from ident.dynamics.kinematics import Chain
from lwr_driver.arm import Arm
from runner.diagnosis import arm_data


@pytest.fixture(scope="module")
def chain() -> Chain:
    return Chain.from_urdf(Arm.load().urdf)


def test_one_number_holds_for_all_joints_and_a_list_for_each(chain: Chain) -> None:
    data = arm_data(None, chain, gear_ratio="100,100,160,100,100,100,50", stiffness="10000")
    assert data.gear_ratio is not None
    assert data.stiffness is not None
    assert data.gear_ratio.tolist() == [100.0, 100.0, 160.0, 100.0, 100.0, 100.0, 50.0]
    assert data.stiffness.tolist() == [1e4] * 7
    assert arm_data(None, chain).stiffness is None


@pytest.mark.parametrize("text", ["soft", "1e4,2e4", "-5", "nan", "0"])
def test_a_wrong_stiffness_is_refused_with_its_option(chain: Chain, text: str) -> None:
    with pytest.raises(ConfigurationError, match="--stiffness"):
        arm_data(None, chain, stiffness=text)
