"""Cut-off, rows, reversals and friction law from the data."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from ident.dynamics.base_set import numeric_base
from ident.dynamics.structure import Coulomb, ModelStructure
from ident.rows.filters import SignalSettings
from ident.rows.signal_choice import SignalChoice, choose_signals
from tests.ident import estimation_arm as arm


def chosen(session, settings: SignalSettings | None = None, coulomb: Coulomb | None = None) -> SignalChoice:
    structure = ModelStructure(arm.chain(), 2 if session.motor is not None else 1)
    base = numeric_base(structure)
    return choose_signals(
        [session], [None], structure, base.columns, settings or SignalSettings(), (coulomb, None)
    )


def sensors(**changes) -> arm.Sensors:
    return dataclasses.replace(arm.Sensors(position=1e-6, joint=0.05, motor=0.1), **changes)


def test_every_open_figure_is_set_and_explained():
    found = chosen(arm.session(sensors=sensors()))
    assert None not in (found.settings.cutoff_hz, found.settings.decimate_hz, found.settings.reversal_s)
    words = " ".join(found.reasons)
    for word in ("rows: low-pass", "positions: cut-off", "reversals:", "friction:"):
        assert word in words


def test_stated_figures_stay():
    settings = SignalSettings(cutoff_hz=7.0, decimate_hz=3.0, reversal_s=0.04)
    law = Coulomb("tanh", 0.01)
    found = chosen(arm.session(motor=False), settings, law)
    assert (found.settings, found.coulomb, found.row_coulomb, found.reasons) == (settings, law, law, ())


def test_a_fast_motion_has_a_wider_band_of_rows_and_positions():
    slow = chosen(arm.session(motor=False, sensors=sensors())).settings
    fast = chosen(arm.session(motor=False, sensors=sensors(), period_s=2.0, periods=8)).settings
    assert slow.decimate_hz == 2.0
    assert fast.decimate_hz > 4.0
    assert fast.cutoff_hz > slow.cutoff_hz


def test_a_short_recording_has_rows_enough():
    session = arm.session(phases=False, run_in_s=0.5, period_s=2.0, periods=1, motor=False, sensors=sensors())
    assert chosen(session).settings.decimate_hz > 4.0


def test_an_ideal_drive_keeps_the_sign():
    found = chosen(arm.session(sensors=sensors()))
    assert found.coulomb.kind == "sign"


@pytest.mark.parametrize("width", [0.02, 0.05])
def test_a_smooth_drive_is_recognised(width):
    session = arm.session(sensors=sensors())
    time = session.motor.publish_time * 1e-9 - 3.0
    speed = arm.fourier(time, 10.0, 5)[1]
    change = (arm.drive("Fcm") + arm.drive("Fcl")) * (np.tanh(speed / width) - np.sign(speed))
    joint_speed = arm.fourier(session.joint.publish_time * 1e-9 - 3.0, 10.0, 5)[1]
    on_joint = arm.drive("Fcl") * (np.tanh(joint_speed / width) - np.sign(joint_speed))
    smooth = dataclasses.replace(
        session,
        motor=dataclasses.replace(session.motor, effort=session.motor.effort + change),
        joint=dataclasses.replace(session.joint, effort=session.joint.effort + on_joint),
    )
    assert chosen(smooth).coulomb == Coulomb("tanh", width)


def test_a_drive_that_turns_slowly_has_its_reversals_left_out():
    session = arm.session(sensors=sensors())
    time = session.motor.publish_time * 1e-9 - 3.0
    late = 0.04
    before, now = (np.sign(arm.fourier(at, 10.0, 5)[1]) for at in (time - late, time))
    effort = session.motor.effort + arm.drive("Fcm") * (before - now)
    turned = dataclasses.replace(session, motor=dataclasses.replace(session.motor, effort=effort))
    assert late <= chosen(turned).settings.reversal_s <= 0.1
    assert chosen(session).settings.reversal_s < late


def test_samples_beside_the_reversals_of_an_ideal_drive_without_noise_stay():
    found = chosen(arm.session(), coulomb=Coulomb())
    assert found.settings.reversal_s == 0.0


def test_a_long_recording_is_judged_by_a_part_of_it():
    session = arm.session(motor=False, sensors=sensors(), period_s=10.0, periods=14)
    assert session.duration_s > 130.0
    assert chosen(session).settings.decimate_hz == 2.0
