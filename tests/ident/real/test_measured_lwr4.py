"""Three recordings of a real LWR4+ (github kjyv/FloBaRoID, LGPL-3): honest intervals and unseen motions.

Runs 1 and 2 repeat one trajectory, run 3 is another. Figures of other software on the same files: held-out
relative error 6.03 % ({1, 2} -> 3) and 3.48 % (3 -> 1) at best, textbook standard deviations 8.8 times too
small.
"""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest

from ident.estimation.channel_errors import EXACT_CHANNELS
from ident.estimation.identification import Identification, IdentificationSettings
from ident.estimation.identify import identify
from ident.rows.filters import differentiate, low_pass
from ident.rows.timebase import stretches
from lwr_driver.session import JointColumns, Session
from tests.ident import estimation_arm as arm

DATA = Path(__file__).resolve().parents[4] / "shared" / "data" / "lwr4_flobaroid"
pytestmark = pytest.mark.skipif(not DATA.is_dir(), reason=f"recordings of the real arm are not at {DATA}")


@lru_cache
def recording(run: int) -> Session:
    content = np.load(DATA / f"measurements_{run}.npz")
    times = np.rint((content["times"] - content["times"][0]) * 1e9).astype(np.int64)
    names = arm.chain().joint_names
    empty = np.zeros((len(times), 0))
    joint = JointColumns(
        "/joint_states",
        names,
        times + 10**18,
        times,
        np.zeros(len(times), dtype=np.int64),
        content["positions"],
        empty,
        content["torques"],
    )
    return Session(Path(f"run{run}.mcap"), {"payload": "none"}, None, names, joint)


@lru_cache
def identified(runs: tuple[int, ...], estimator: str) -> Identification:
    settings = IdentificationSettings(model=1, estimator=estimator, essential=None)
    return identify([recording(run) for run in runs], arm.chain(), settings)


def relative_error(found: Identification, run: int) -> float:
    """||e|| / ||tau|| [%] over the whole recording, every ninth sample."""
    joint = recording(run).joint
    parts, _ = stretches(
        joint.publish_time * 1e-9,
        np.hstack([joint.position, joint.effort]),
        np.zeros(len(joint), dtype=bool),
        0.005,
        0.05,
    )
    q = low_pass(parts[0].values[:, :7], parts[0].dt, 10.0)
    qd, qdd = differentiate(q, parts[0].dt)
    torque = parts[0].values[:, 7:]
    error = torque - found.model.torque(q, qd, qdd, side="joint")
    return float(100 * np.linalg.norm(error[::9]) / np.linalg.norm(torque[::9]))


def test_two_recordings_of_one_trajectory_agree_within_the_deviations_of_equal_channels():
    first, second = (identified((run,), "wls").estimate for run in (1, 2))
    exact = [e.covariances[EXACT_CHANNELS].std for e in (first, second)]
    z = (first.values - second.values) / np.hypot(*exact)
    assert 0.8 < np.sqrt(np.mean(z**2)) < 1.5
    assert np.mean(np.abs(z) < 2) >= 0.85


@pytest.mark.parametrize(("train", "test", "bound"), [((1, 2), 3, 6.0), ((3,), 1, 3.4)])
def test_a_motion_that_was_not_seen_is_predicted_better_than_by_others(train, test, bound):
    assert relative_error(identified(train, "physical"), test) < bound
    assert relative_error(identified(train, "wls"), test) > bound
