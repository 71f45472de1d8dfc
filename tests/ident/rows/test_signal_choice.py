"""Cut-off, rows, reversals and friction law from the data."""

from __future__ import annotations

import dataclasses
import re

import numpy as np
import pytest

from fri.errors import DataError
from ident.dynamics.base_set import numeric_base
from ident.dynamics.structure import Coulomb, ModelStructure
from ident.rows.class_rows import ClassRows, blocks, error, fit
from ident.rows.content import Recall
from ident.rows.filters import SignalSettings
from ident.rows.prepare import prepare
from ident.rows.signal_choice import SignalChoice, _delay_s, choose_signals
from lwr_driver.session import Session
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
    settings = SignalSettings(
        cutoff_hz=7.0, decimate_hz=3.0, reversal_s=0.04, turning_rad=0.0, slow_rad_s=0.03
    )
    law = Coulomb("tanh", 0.01)
    found = chosen(arm.session(motor=False), settings, law)
    assert (found.settings, found.coulomb, found.row_coulomb, found.reasons) == (settings, law, law, ())


def test_a_recording_with_holes_in_every_interval_is_refused_with_advice():
    session = arm.session(motor=False, sensors=sensors())
    kept = np.ones(len(session.joint), dtype=bool)
    kept[3 : len(kept) - 3 : 5] = False
    fields = ("log_time", "publish_time", "sequence", "position", "velocity", "effort")
    joint = dataclasses.replace(
        session.joint, **{name: getattr(session.joint, name)[kept] for name in fields}
    )
    with pytest.raises(
        DataError, match=r"20 % of the \d+ samples of .* are lost by the counter; record without losses"
    ):
        chosen(dataclasses.replace(session, joint=joint))


def test_a_recording_polled_too_fast_is_refused_with_that_as_the_cause():
    session = arm.session(motor=False, sensors=sensors())
    seen = np.arange(len(session.joint)) // 5 * 5
    fields = ("position", "velocity", "effort")
    joint = dataclasses.replace(
        session.joint,
        **{name: getattr(session.joint, name)[seen] for name in fields if getattr(session.joint, name).size},
    )
    told = r"80 % of the \d+ samples of .* repeat the one before; the recorder polls faster than the arm measures"
    with pytest.raises(DataError, match=told):
        chosen(dataclasses.replace(session, joint=joint))


def test_a_recording_of_a_few_samples_is_said_to_be_too_short():
    session = arm.session(motor=False, sensors=sensors(), rate_hz=50.0, period_s=4.0, periods=1)
    joint = session.joint.rows(0, int(session.joint.log_time[25]))
    with pytest.raises(DataError, match=r"up to 25 samples.*too short.*record longer"):
        chosen(dataclasses.replace(session, joint=joint))


def test_a_fast_motion_has_a_wider_band_of_rows_and_positions():
    slow = chosen(arm.session(motor=False, sensors=sensors())).settings
    fast = chosen(arm.session(motor=False, sensors=sensors(), period_s=2.0, periods=8)).settings
    assert slow.decimate_hz == 2.0
    # Five harmonics of half a hertz.
    assert fast.decimate_hz == pytest.approx(2.5 * 2.5, rel=0.15)
    assert fast.cutoff_hz > slow.cutoff_hz


def test_a_short_recording_has_rows_enough():
    session = arm.session(phases=False, run_in_s=0.5, period_s=2.0, periods=1, motor=False, sensors=sensors())
    assert chosen(session).settings.decimate_hz > 4.0


def test_a_part_of_a_slow_motion_has_forty_rows():
    whole = arm.session(phases=False, period_s=20.0, periods=1, motor=False, sensors=sensors())
    first = int(whole.joint.log_time[0])
    session = dataclasses.replace(whole, joint=whole.joint.rows(first + 5 * 10**9, first + 10 * 10**9))
    found = chosen(session)
    assert found.settings.decimate_hz == pytest.approx(40.0 / (2.5 * session.duration_s), rel=5e-3)
    assert f"for a recording of {session.duration_s:.1f} s" in found.reasons[0]


@pytest.mark.parametrize(
    ("rate_hz", "stated", "band_hz", "why"),
    [
        (20.0, {}, 20.0 * 0.2 / 1.5, "the sampling rate of 20 Hz"),
        (250.0, {"cutoff_hz": 2.4}, 1.6, "cut-off of 2.4 Hz"),
    ],
)
def test_the_band_of_the_rows_ends_where_the_channels_do(rate_hz, stated, band_hz, why):
    session = arm.session(motor=False, sensors=sensors(), rate_hz=rate_hz, period_s=4.0, periods=4)
    found = chosen(session, SignalSettings(**stated))
    assert found.settings.decimate_hz == pytest.approx(band_hz, rel=5e-3)
    assert why in found.reasons[0]


def test_half_the_band_of_an_earlier_filter_is_the_limit():
    session = arm.session(motor=False, sensors=sensors(), period_s=2.0, periods=8)
    spectrum = np.fft.rfft(session.joint.effort, axis=0)
    spectrum[np.fft.rfftfreq(len(session.joint), 0.004) > 4.0] = 0.0
    smooth = np.fft.irfft(spectrum, len(session.joint), axis=0)
    found = chosen(dataclasses.replace(session, joint=dataclasses.replace(session.joint, effort=smooth)))
    assert 1.5 < found.settings.decimate_hz < 2.4
    assert "an earlier low-pass at" in found.reasons[0]
    assert found.settings.reversal_s == 0.0


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


@pytest.mark.parametrize(
    ("turned", "words"), [(0.02, r"\d+ % less than with all"), (1.0, r"\d[\d.]* times smaller than with all")]
)
def test_the_gain_beside_reversals_is_a_share_of_the_error_or_a_factor(turned: float, words: str):
    session = arm.session(sensors=sensors(joint=0.01, motor=0.01))
    time = session.motor.publish_time * 1e-9 - 3.0
    before, now = (np.sign(arm.fourier(at, 10.0, 5)[1]) for at in (time - 0.04, time))
    effort = session.motor.effort + turned * arm.drive("Fcm") * (before - now)
    late = dataclasses.replace(session, motor=dataclasses.replace(session.motor, effort=effort))
    said = next(reason for reason in chosen(late).reasons if reason.startswith("reversals"))
    assert re.search(words, said), said


@pytest.mark.parametrize(
    ("speed_rad_s", "share", "low", "high"),
    [(0.1, 0.5, 0.1, 0.3), (0.1, -0.5, 0.0, 0.0), (0.1, 0.0, 0.0, 0.0)],
)
def test_slow_motion_with_more_friction_is_left_out(
    speed_rad_s: float, share: float, low: float, high: float
):
    session = arm.session(motor=False, sensors=sensors(), period_s=50.0, periods=2)
    speed = arm.fourier(session.joint.publish_time * 1e-9 - 3.0, 50.0, 5)[1]
    more = share * arm.drive("Fcl") * np.sign(speed) * np.exp(-np.square(speed / speed_rad_s))
    stribeck = dataclasses.replace(
        session, joint=dataclasses.replace(session.joint, effort=session.joint.effort + more)
    )
    found = chosen(stribeck, coulomb=Coulomb())
    assert low <= found.settings.slow_rad_s <= high
    assert any(reason.startswith("slow motion: ") for reason in found.reasons)


def turning(session: Session, symbol: str, path_rad: float) -> np.ndarray:
    """What the friction `symbol` of the joints lacks while it turns over a path after a reversal."""
    time = session.joint.publish_time * 1e-9 - 3.0
    q, speed = arm.fourier(time, 20.0, 5)[:2]
    turned = np.vstack([np.ones((1, q.shape[1]), dtype=bool), np.diff(np.sign(speed), axis=0) != 0.0])
    gone = np.cumsum(np.abs(np.diff(q, axis=0, prepend=q[:1])), axis=0)
    since = gone - np.maximum.accumulate(np.where(turned, gone, 0.0), axis=0)
    return np.asarray(-2.0 * arm.drive(symbol) * np.sign(speed) * np.exp(-since / path_rad))


def test_a_path_of_presliding_is_left_out():
    session = arm.session(motor=False, sensors=sensors(), period_s=20.0, periods=4)
    less = turning(session, "Fcl", 2e-3)
    presliding = dataclasses.replace(
        session, joint=dataclasses.replace(session.joint, effort=session.joint.effort + less)
    )
    beside = SignalSettings(reversal_s=0.02)
    assert 5e-3 <= chosen(presliding, beside, Coulomb()).settings.turning_rad <= 1e-2
    assert chosen(session, beside, Coulomb()).settings.turning_rad == 1e-3


def test_friction_that_turns_over_milliradians_is_no_late_motor_channel():
    """Beside reversals it looks late by more than is searched, and sound sessions were refused."""
    session = arm.session(sensors=sensors(), period_s=20.0, periods=2)
    motor = session.motor
    assert motor is not None
    less = turning(session, "Fcm", 1e-2)[: len(motor)]
    presliding = dataclasses.replace(session, motor=dataclasses.replace(motor, effort=motor.effort + less))
    near = SignalSettings(decimate_hz=2.0, cutoff_hz=25.0)
    with pytest.raises(DataError, match="at the edge of the searched delays"):
        prepare(presliding, near, log=False)
    assert abs(_delay_s(presliding, near, True, Recall())) < 0.002
    # Where nothing is left so far from reversals, nearer rows tell it; without motor torques there is none.
    quick = arm.session(sensors=dataclasses.replace(sensors(), motor_delay_s=0.008), period_s=1.0, periods=4)
    assert _delay_s(quick, near, True, Recall()) == pytest.approx(0.008, abs=0.001)
    assert _delay_s(presliding, near, False, Recall()) == 0.0


def test_blocks_are_even_in_every_stretch():
    times = [np.array([0.0, 1.9, 2.0, 6.5]), np.array([5.0, 6.0]), np.array([0.5])]
    np.testing.assert_array_equal(blocks(times, 2.0), [0, 0, 1, 3, 6, 7, 8])


def test_samples_beside_the_reversals_of_an_ideal_drive_without_noise_stay():
    found = chosen(arm.session(), coulomb=Coulomb())
    assert found.settings.reversal_s == 0.0


def test_a_long_recording_is_judged_by_a_part_of_it():
    session = arm.session(motor=False, sensors=sensors(), period_s=10.0, periods=14)
    assert session.duration_s > 130.0
    assert chosen(session).settings.decimate_hz == 2.0


def made(torque, matrix, even) -> ClassRows:
    count = len(torque)
    whole = np.ones(count, dtype=bool)
    block = np.where(even, 0, 1)
    every = np.arange(matrix.shape[1])
    none = np.ones((count, 0))
    return ClassRows(
        matrix, torque, np.ones(count), none, whole, block, (), (slice(0, count),), every, len(every)
    )


def test_a_loud_class_has_little_weight_in_the_fit():
    random = np.random.default_rng(0)
    matrix = random.normal(size=(400, 1))
    even = np.arange(400) % 2 == 0
    clean = made(2.0 * matrix[:, 0] + 0.01 * random.normal(size=400), matrix, even)
    loud = made(3.0 * matrix[:, 0] + 5.0 * random.normal(size=400), matrix, even)
    masks = {key: np.ones(400, dtype=bool) for key in (("joint", 0), ("joint", 1))}
    values = fit({("joint", 0): clean, ("joint", 1): loud}, masks)
    assert values[0] == pytest.approx(2.0, abs=3e-3)


def test_even_blocks_are_fitted_and_odd_ones_predicted():
    matrix, even = np.ones((40, 1)), np.arange(40) < 20
    torque = np.where(even, 1.0, 4.0)
    rows = {("joint", 0): made(torque, matrix, even), ("motor", 0): made(2.0 * torque, 2.0 * matrix, even)}
    masks = {key: np.ones(40, dtype=bool) for key in rows}
    values = fit(rows, masks)
    assert values == pytest.approx([1.0])
    assert error(rows, values, masks) == pytest.approx(np.mean(np.log([3.0, 6.0])))


@pytest.mark.parametrize(("count", "expected"), [(7, 0.0), (8, np.log(3.0))])
def test_a_class_with_fewer_than_eight_rows_has_no_error(count: int, expected: float):
    even = np.zeros(40, dtype=bool)
    rows = {("joint", 0): made(np.full(40, 3.0), np.ones((40, 1)), even)}
    assert error(rows, np.zeros(1), {("joint", 0): np.arange(40) < count}) == pytest.approx(expected)


def test_rows_beside_a_reversal_are_unknown_in_their_stretch_alone():
    rows = made(np.ones(12), np.ones((12, 1)), np.ones(12, dtype=bool))
    speed = np.array([1, 1, 1, -1, -1, -1, 1, 1, 1, 1, 1, 1.0])
    turning = dataclasses.replace(rows, speed=speed, stretches=(slice(0, 6), slice(6, 12)))
    assert np.flatnonzero(~turning.known(1, 0.1, 1e-3)).tolist() == [2, 3]
    assert np.flatnonzero(~turning.known(0, 0.1, 0.0)).tolist() == []


def test_noisy_positions_have_a_lower_cut_off_than_clean_ones():
    clean, noisy = (
        chosen(arm.session(motor=False, sensors=sensors(position=some))).settings.cutoff_hz
        for some in (1e-7, 1e-3)
    )
    assert (clean, noisy) == (25.0, 5.0)


@pytest.mark.parametrize("stiffness", [None, arm.STIFFNESS], ids=["usual", "stated"])
def test_positions_of_the_motors_are_told_from_the_links(stiffness):
    session = arm.session(sensors=sensors(joint=0.02))
    assert chosen(session, SignalSettings(stiffness_nm_rad=stiffness)).settings.encoder == "link"
    found = chosen(arm.at_the_motors(session), SignalSettings(stiffness_nm_rad=stiffness))
    assert found.settings.encoder == "motor"
    assert any("of the motors" in reason for reason in found.reasons)
    np.testing.assert_allclose(np.median(found.settings.stiffness_nm_rad), 1e4, rtol=0.5)


def test_a_recording_that_states_positions_of_the_motors_needs_no_test():
    session = arm.session(motor=False, sensors=sensors())
    stated = dataclasses.replace(session, metadata={**session.metadata, "encoder": "motor"})
    found = chosen(stated, SignalSettings(stiffness_nm_rad=arm.STIFFNESS))
    assert found.settings.encoder == "motor"
    assert any("as stated" in reason for reason in found.reasons)


def test_links_stand_behind_their_motors_by_the_twist():
    session = arm.session(motor=False)
    settings = SignalSettings(stiffness_nm_rad=arm.STIFFNESS, encoder="motor", cutoff_hz=10.0)
    (link,) = prepare(session, dataclasses.replace(settings, encoder="link")).passages
    (motor,) = prepare(arm.at_the_motors(session), settings).passages
    np.testing.assert_allclose(motor.joint.q, link.joint.q, atol=1e-6)
    np.testing.assert_allclose(motor.joint.qdd, link.joint.qdd, atol=2e-3)
