"""Long sessions in overlapping blocks give the rows of the whole session; long arrays live in files."""

from __future__ import annotations

import importlib
from dataclasses import replace

import numpy as np
import pytest

from ident.dynamics.structure import ModelStructure
from ident.estimation.identification import IdentificationSettings
from ident.estimation.identify import identify
from ident.estimation.scores import score_session
from ident.estimation.validate import predictor
from ident.rows import SignalSettings, commanded, observe, prepare
from lwr_driver.session import spool
from tests.ident import estimation_arm as arm

motion_module = importlib.import_module("ident.rows.filtered_motion")


@pytest.fixture
def long(monkeypatch):
    """A session with lost samples and an outlier, cut into several blocks kept in files."""
    monkeypatch.setattr(motion_module, "_BLOCK_S", 6.0)
    monkeypatch.setattr(spool, "LEAST_BYTES", 1)
    session = arm.session(seed=4, periods=5, period_s=10.0, command=True)
    keep = np.ones(len(session.joint), dtype=bool)
    keep[[2000, 2001, 5000]] = False
    joint = session.joint
    fields = ("log_time", "publish_time", "sequence", "position", "velocity", "effort")
    kept = {name: getattr(joint, name)[keep] for name in fields}
    kept["effort"] = kept["effort"].copy()
    kept["effort"][3000, 2] += 500.0
    return replace(session, joint=replace(joint, **kept))


@pytest.mark.parametrize(
    ("stiffness", "late_s"), [(None, 0.0), ((9000.0,) * 7, 0.0), ((9000.0,) * 7, 0.0043), (None, -0.0037)]
)
def test_blocks_give_the_rows_of_the_whole_session(long, stiffness, late_s):
    structure = ModelStructure(arm.chain(), 2)
    settings = SignalSettings(stiffness_nm_rad=stiffness, joint_delay_s=late_s)
    whole, blocks = (prepare(long, settings, log=False, blocks=cut) for cut in (False, True))
    assert len(blocks.passages) > 3 * len(whole.passages)
    assert blocks.counts == whole.counts
    assert blocks.excitation_hz == pytest.approx(whole.excitation_hz, rel=1e-12)
    np.testing.assert_allclose(blocks.mean_torque, whole.mean_torque, rtol=1e-12)
    assert blocks.delay.seconds == pytest.approx(whole.delay.seconds, abs=1e-9)
    a, b = (observe([one], [None], structure) for one in (whole, blocks))
    for mine, other in zip(a.groups, b.groups, strict=True):
        np.testing.assert_array_equal(mine.time_index, other.time_index)
        size = np.abs(mine.matrix).max(axis=0) + 1e-6
        np.testing.assert_allclose(other.matrix / size, mine.matrix / size, atol=1e-9)
        np.testing.assert_allclose(other.target, mine.target, atol=1e-9 * np.abs(mine.target).max())


def test_a_block_has_the_samples_in_reach_of_its_filters_and_no_more(monkeypatch):
    monkeypatch.setattr(motion_module, "_BLOCK_S", 10.0)
    count = {}
    for periods in (8, 12):
        session = arm.session(seed=4, periods=periods, period_s=10.0, motor=False)
        whole, blocks = (
            prepare(session, SignalSettings(decimate_hz=8.0), log=False, blocks=cut) for cut in (False, True)
        )
        sizes = [len(passage.joint.times) for passage in blocks.passages]
        assert len(sizes) > 3
        assert max(sizes[1:-1]) < 0.5 * len(whole.passages[0].joint.times)
        assert sum(sizes) >= len(whole.passages[0].joint.times)
        count[periods] = max(sizes[1:-1])
    # The memory of a block does not grow with the session.
    assert count[8] == count[12]


def test_commanded_motion_in_blocks_is_that_of_the_whole_session(long):
    structure = ModelStructure(arm.chain(), 1)
    # Both channels have a hole, so that the later blocks are those of a second stretch.
    fields = ("log_time", "publish_time", "sequence", "position", "velocity", "effort")
    parts = {
        name: replace(part, **{f: np.delete(getattr(part, f), np.s_[6000:6400], axis=0) for f in fields})
        for name, part in (("joint", long.joint), ("command", long.command))
    }
    long = replace(long, **parts)
    rows = []
    for cut in (False, True):
        prepared = prepare(long, motor=False, log=False, blocks=cut)
        motion = commanded(long, prepared)
        assert motion is not None
        rows.append(observe([motion], [None], structure))
    for mine, other in zip(rows[0].groups, rows[1].groups, strict=True):
        size = np.abs(mine.matrix).max(axis=0) + 1e-6
        np.testing.assert_allclose(other.matrix / size, mine.matrix / size, atol=1e-9)


def test_blocks_give_the_scores_of_the_whole_session(long):
    model = identify(long, arm.chain(), IdentificationSettings(model=1, essential=None)).model
    a, b = (
        score_session(
            prepare(long, motor=False, log=False, blocks=cut),
            predictor(model, None),
            ("joint",),
            long,
            "model",
        )
        for cut in (False, True)
    )
    for mine, other in zip(a.scores, b.scores, strict=True):
        for name, value in mine.to_dict().items():
            if isinstance(value, float):
                assert other.to_dict()[name] == pytest.approx(value, rel=1e-9, abs=1e-12), name
            else:
                assert other.to_dict()[name] == value, name
    assert a.relative == pytest.approx(b.relative, rel=1e-9)


def test_long_arrays_are_in_files_and_hold_what_was_written(monkeypatch):
    monkeypatch.setattr(spool, "LEAST_BYTES", 1000)
    parts = [np.random.default_rng(k).normal(size=(50 + k, 3)) for k in range(5)]
    found = spool.stored(parts)
    assert spool.mapping(found) is not None
    spool.release(found)
    np.testing.assert_array_equal(found, np.concatenate(parts))
    np.testing.assert_array_equal(spool.column(found, 1), np.concatenate(parts)[:, 1])
    assert spool.mapping(spool.stored([np.zeros(3)])) is None
    arena = spool.Arena()
    large = np.random.default_rng(9).normal(size=(200, 100))
    kept = [arena.keep(large * k) for k in range(3)]
    spool.release(kept[0])
    assert all(spool.mapping(one) is not None for one in kept)
    np.testing.assert_array_equal(kept[2], large * 2)
