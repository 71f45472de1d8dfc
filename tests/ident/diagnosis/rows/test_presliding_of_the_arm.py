from __future__ import annotations

import numpy as np
import pytest

from ident.diagnosis.rows.nominal_arm import NominalArm
from ident.dynamics.kinematics import Chain
from ident.effects import EFFECTS, Setting

DT = 1e-3


def speed() -> np.ndarray:
    """Forwards for a second, then backwards, all joints, at 0.1 rad/s."""
    return np.repeat(np.where(np.arange(2000) < 1000, 0.1, -0.1)[:, None], 3, axis=1)


def test_friction_turns_within_the_reach_and_at_once_without_one(chain: Chain) -> None:
    arm = NominalArm(chain, np.zeros(3), np.ones(3), presliding=np.array([0.0, 1e-3, 1e-2]))
    slip = arm.slip(speed(), DT)
    np.testing.assert_array_equal(slip[:, 0], np.sign(speed()[:, 0]))
    # One reach after the reversal, 63 % of the way from 1 to -1 are done.
    for joint, reach in ((1, 1e-3), (2, 1e-2)):
        after = 999 + round(reach / (0.1 * DT))
        assert slip[after, joint] == pytest.approx(-1.0 + 2.0 * np.exp(-1.0), abs=0.02)


def test_presliding_near_the_reach_of_the_healthy_drive_is_no_cause() -> None:
    spread = np.array([[-0.6, 0.6]] * 3)
    known = Setting(
        1,
        (4.0,),
        np.ones(3),
        np.ones(3),
        np.ones(3, dtype=bool),
        np.ones(3),
        spread,
        presliding=np.full(3, 2e-4),
    )
    lengths = [s["length"] for s in EFFECTS["presliding_hysteresis"].shapes(known, 0) if "length" in s]
    assert lengths
    assert min(lengths) >= 2e-3
