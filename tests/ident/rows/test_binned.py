"""Rows at the full band: means over short bins, the same for torque and regressor."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ident.dynamics.structure import Coulomb, ModelStructure
from ident.rows.binned import binned_regressor, bins, observe_bins
from ident.rows.filters import SignalSettings
from ident.rows.prepare import prepare
from ident.rows.prepared import PreparedSession
from tests.ident import estimation_arm as arm

STRUCTURE = ModelStructure(arm.chain())
COLUMNS = np.flatnonzero(STRUCTURE.active)
CHI = np.array([arm.truth()[STRUCTURE.names[c]] for c in COLUMNS])
RIGID = SignalSettings(motor_delay_s=0.0, reversal_s=0.0)


@pytest.fixture(scope="module")
def prepared() -> PreparedSession:
    return prepare(arm.session(sensors=arm.Sensors(motor_step_s=0.006), period_s=6.0), RIGID)


def test_bins_of_all_sides_obey_the_equation_away_from_reversals(prepared: PreparedSession):
    structure = replace(STRUCTURE, sides=("joint", "motor", "difference"))
    found = observe_bins(prepared, None, structure, COLUMNS, 0.02)
    assert [rows.side for rows in found] == ["motor", "joint", "difference"]
    assert [rows.width for rows in found] == [3, 5, 3]
    for rows in found:
        assert rows.matrix.shape == (7, len(rows.time), len(COLUMNS))
        error = rows.torque - (rows.matrix @ CHI).T
        assert np.quantile(np.abs(error[rows.known]), 0.98) < 2e-2
        assert np.median(np.abs(error[rows.known])) < 1e-3
        assert 0.9 < rows.known.mean() < 1.0
        assert rows.measured.mean() > 0.99
        assert np.ptp(rows.time) == pytest.approx(12.0, abs=0.3)
        np.testing.assert_allclose(
            np.diff(rows.time), rows.width * (0.004 if rows.side == "joint" else 0.006)
        )
        np.testing.assert_allclose(bins(rows.samples, rows.width), rows.speed)
        np.testing.assert_allclose(rows.turned(Coulomb()), bins(np.sign(rows.samples), rows.width))


def test_the_bins_of_a_long_channel_are_those_of_its_parts(prepared: PreparedSession):
    joint = prepared.passages[0].joint
    some = joint.at(np.arange(2600))
    whole = binned_regressor(STRUCTURE, COLUMNS, some, None, "joint", 7)
    assert whole.shape == (7, 371, len(COLUMNS))
    for first in (0, 1995, 2002, 2590):
        part = binned_regressor(STRUCTURE, COLUMNS, joint.at(np.arange(first, first + 7)), None, "joint", 7)
        np.testing.assert_allclose(whole[:, first // 7], part[:, 0], atol=1e-12)
    assert binned_regressor(STRUCTURE, COLUMNS, joint.at(np.arange(6)), None, "joint", 7).shape == (
        7,
        0,
        len(COLUMNS),
    )


def test_a_flagged_sample_makes_its_bin_unmeasured(prepared: PreparedSession):
    (passage,) = prepared.passages
    flagged = passage.joint.flagged.copy()
    inside = int(np.searchsorted(passage.joint.times, passage.rows[0]))
    flagged[inside + 12, 3] = True
    joint = replace(passage.joint, flagged=flagged, known=passage.joint.known & ~flagged)
    bad = replace(prepared, passages=(replace(passage, joint=joint),))
    before, after = (observe_bins(one, None, STRUCTURE, COLUMNS, 0.02)[1] for one in (prepared, bad))
    assert [tuple(place) for place in np.argwhere(before.measured & ~after.measured)] == [(2, 3)]
    assert not after.known[2, 3]


def test_a_side_without_a_channel_has_no_bins():
    alone = prepare(arm.session(motor=False, period_s=6.0), RIGID)
    assert [rows.side for rows in observe_bins(alone, None, STRUCTURE, COLUMNS, 0.02)] == ["joint"]
    coarse = observe_bins(alone, None, replace(STRUCTURE, sides=("joint",)), COLUMNS, 1e-4)
    assert coarse[0].width == 1


def test_a_single_sample_between_the_rows_has_no_bin(prepared: PreparedSession):
    (passage,) = prepared.passages
    for count, bins_found in ((1, 0), (2, 1)):
        short = replace(passage, rows=passage.joint.times[100 : 100 + count], motor=None)
        found = observe_bins(replace(prepared, passages=(short,)), None, STRUCTURE, COLUMNS, 0.008)
        assert [len(rows.time) for rows in found] == [1] * bins_found
