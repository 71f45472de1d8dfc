"""Single wrong samples and joints that nobody measured are named."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from ident.dynamics.kinematics import Chain
from ident.dynamics.urdf import held
from ident.screening.channels import check_channels
from ident.screening.unmeasured import check_unmeasured, unmeasured
from lwr_driver.configuration import CONFIGS
from lwr_driver.session import JointColumns, Session

TIMES = np.arange(2000) * 5e-3
URDF = CONFIGS / "lwr4plus.urdf"


@pytest.fixture(scope="module")
def arm() -> Chain:
    return Chain.from_urdf(URDF)


def found(arm: Chain, place: int, *, position: float = 0.0, torque: float = 0.0) -> list[str]:
    """What is said of a smooth motion with velocities, and one wrong sample of the fourth joint."""
    phase = 2.0 * np.pi * 0.3 * TIMES[:, None] + np.arange(7)
    q, qd = np.sin(phase), 2.0 * np.pi * 0.3 * np.cos(phase)
    tau = 10.0 * np.sin(2.0 * phase) + 0.2 * np.random.default_rng(1).normal(size=q.shape)
    q[place, 3] += position
    tau[place, 3] += torque
    stamps = np.round(TIMES * 1e9).astype(np.int64)
    count = np.arange(len(stamps))
    joint = JointColumns("/joint_states", arm.joint_names, stamps, stamps, count, q, qd, tau)
    return [
        str(doubt) for doubt in check_channels([Session(Path("made"), {}, {}, arm.joint_names, joint)], arm)
    ]


@pytest.mark.parametrize("size", [1000.0, 0.1])
def test_one_wrong_position_is_named_and_the_velocity_is_not_blamed(arm: Chain, size: float) -> None:
    (said,) = found(arm, 400, position=size)
    assert said == (
        f"made: {arm.joint_names[3]} spike: position off by {size:.3g} rad in 1 of 2000 samples, at 2 s (sample 400), "
        "looks like a misread value; it is left out of the rows; correct the recording"
    )


def test_a_torque_beyond_all_others_is_named_and_a_shock_among_them_is_not(arm: Chain) -> None:
    (said,) = found(arm, 400, torque=1e4)
    assert "joint torque off by 1e+04 Nm in 1 of 2000 samples" in said
    assert found(arm, 400, torque=8.0) == []


def test_a_joint_between_those_of_the_model_without_measurement_is_named(arm: Chain) -> None:
    measured = [name for name in arm.joint_names if name != arm.joint_names[3]]
    chain = Chain.from_urdf(URDF, joints=measured)
    (doubt,) = check_unmeasured(chain)
    assert f"{arm.joint_names[3]} lies between the joints of the model without a measurement" in str(doubt)
    assert not doubt.certain


def test_a_joint_that_rests_where_somebody_said_is_not_named(arm: Chain) -> None:
    rest = arm.joint_names[3]
    measured = [name for name in arm.joint_names if name != rest]
    chain = Chain.from_urdf(held(URDF.read_text(), {rest: 0.4}), joints=measured)
    assert unmeasured(chain) == ()
    assert unmeasured(arm) == ()
    assert (
        unmeasured(Chain.from_urdf(URDF, joints=arm.joint_names[:5])) == ()
    )  # a gripper would be further joints
