from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from fri.errors import DataError
from lwr_driver.session.alignment import Track, align
from tests.lwr_driver.session.motions import excitation
from tests.lwr_driver.session.session_samples import JOINTS

END = 23.0


def tracks(
    log_period,
    trace_period,
    *,
    offset=0.0,
    rate=0.0,
    noise=1e-5,
    span=(-1.0, 25.0),
    seed=0,
    motion=excitation,
):
    """The same motion in a session and in a trace whose clock shows offset + (1 + rate) t."""
    rng = np.random.default_rng(seed)
    log_time = np.arange(0.0, END, log_period)
    trace_time = np.arange(*span, trace_period)
    log = motion(log_time) + rng.normal(scale=noise, size=(len(log_time), 7))
    trace = motion(trace_time) + rng.normal(scale=noise, size=(len(trace_time), 7))
    clock = np.round(offset + (1.0 + rate) * trace_time, 6)
    return (
        Track("log", JOINTS, log_time, log.astype(np.float32).astype(float)),
        Track("trace", JOINTS, clock, trace),
        trace_time,
    )


@pytest.mark.parametrize(
    ("log_period", "trace_period"),
    [(0.001, 0.001), (0.005, 0.001), (0.012, 0.001), (0.1, 0.001), (0.001, 0.004)],
)
@pytest.mark.parametrize(("offset", "rate"), [(812.4375, 1.5e-5), (-3.25, -8e-5), (0.0, 0.0)])
def test_clock_is_found_far_below_a_cycle(log_period, trace_period, offset, rate):
    log, trace, truth = tracks(log_period, trace_period, offset=offset, rate=rate)
    alignment = align(log, trace)
    inside = (truth > 0.0) & (truth < END)
    error = alignment.at(trace.time) - truth
    # 1 us is what the file's six decimals take away
    assert np.abs(error[inside]).max() < 5e-6
    assert alignment.delay_std_s < 5e-6
    assert alignment.rate_error == pytest.approx(-rate, abs=3e-7)
    assert alignment.residual_rad < 3e-5
    assert min(alignment.correlation) > 0.999


def test_stated_uncertainty_is_that_of_repeated_estimates():
    pulls = []
    for seed in range(40):
        log, trace, truth = tracks(0.005, 0.002, offset=3.0, noise=2e-3, seed=seed)
        alignment = align(log, trace)
        ends = np.searchsorted(truth, [0.0, END - 0.02])
        pulls.append((alignment.at(trace.time)[ends] - truth[ends]) / alignment.delay_std_s)
    # the deviation that is stated holds at the ends of the overlap, where that of the rate adds most
    assert 0.6 < np.std(pulls) < 1.3


def test_trace_of_a_part_of_the_motion():
    log, trace, truth = tracks(0.001, 0.001, offset=50.0, span=(2.0, 14.0))
    np.testing.assert_allclose(align(log, trace).at(trace.time), truth, atol=5e-6)


def test_constant_offsets_of_the_positions_do_not_matter():
    log, trace, truth = tracks(0.001, 0.001, offset=50.0)
    shifted = dataclasses.replace(trace, position=trace.position + np.linspace(-0.3, 0.3, 7))
    np.testing.assert_allclose(align(log, shifted).at(trace.time), truth, atol=5e-6)


def test_periodic_part_alone_is_ambiguous():
    log, trace, _ = tracks(0.001, 0.001, span=(8.0, 14.0))
    with pytest.raises(
        DataError, match=r"is ambiguous: .* a periodic motion must be recorded with its approach"
    ):
        align(log, trace)


def test_arm_that_stands_still():
    log, trace, _ = tracks(0.001, 0.001)
    still = dataclasses.replace(trace, position=np.full_like(trace.position, 0.5))
    with pytest.raises(DataError, match=r"trace: the arm stands still .* record a motion"):
        align(log, still)


def test_slow_motion_leaves_the_delay_vague():
    log, trace, _ = tracks(0.001, 0.001, noise=5e-3, motion=lambda time: 0.05 * excitation(time / 8.0))
    with pytest.raises(
        DataError, match=r"is known to .* ms only, 0\.500 ms are needed|agreement of positions"
    ):
        align(log, trace)
    log, trace, _ = tracks(0.01, 0.001, noise=3e-4, motion=lambda time: 0.05 * excitation(time / 2.0))
    with pytest.raises(DataError, match=r"is known to .* ms only, 0\.010 ms are needed"):
        align(log, trace, tolerance_s=1e-5)


@pytest.mark.parametrize("order", [[1, 0, 2, 3, 4, 5, 6], [0, 1, 6, 2, 3, 4, 5], [6, 5, 4, 3, 2, 1, 0]])
def test_wrong_joint_order_is_named(order):
    log, trace, _ = tracks(0.002, 0.001)
    mixed = dataclasses.replace(trace, position=trace.position[:, order])
    with pytest.raises(DataError, match="joints in another order") as caught:
        align(log, mixed)
    for place, joint in enumerate(order):
        named = f"{JOINTS[place]} of it follows {JOINTS[joint]} (correlation 1.000)" in str(caught.value)
        assert named == (place != joint)


def test_small_joints_in_the_wrong_order_are_not_overlooked():
    small = np.array([1.0, 1.0, 1.0, 1.0, 1.0, 0.02, 0.02])
    log, trace, _ = tracks(0.002, 0.001, motion=lambda time: excitation(time) * small)
    mixed = dataclasses.replace(trace, position=trace.position[:, [0, 1, 2, 3, 4, 6, 5]])
    with pytest.raises(DataError, match="A5 of it follows A6"):
        align(log, mixed)


def test_wrong_sign_is_named():
    log, trace, _ = tracks(0.002, 0.001)
    turned = dataclasses.replace(trace, position=trace.position * [1, 1, 1, -1, 1, 1, 1])
    with pytest.raises(DataError, match=r"A3 of it follows -A3 \(correlation -1\.000\)"):
        align(log, turned)


def test_another_motion():
    log, _, _ = tracks(0.002, 0.001)
    _, trace, _ = tracks(0.002, 0.001, motion=lambda time: excitation(time, period=3.1, seed=8))
    with pytest.raises(DataError, match="does not show the motion of log"):
        align(log, trace)


def test_degrees_are_no_radians():
    log, trace, _ = tracks(0.002, 0.001)
    with pytest.raises(DataError, match="are in radians"):
        align(log, dataclasses.replace(trace, position=np.rad2deg(trace.position)))


def test_clock_in_another_unit():
    log, trace, _ = tracks(0.002, 0.001)
    with pytest.raises(DataError):
        align(log, dataclasses.replace(trace, time=trace.time * 1.01))


def test_joint_at_rest_cannot_be_verified():
    moving = np.array([1.0, 1.0, 0.0, 1.0, 1.0, 1.0, 1.0])
    log, trace, _ = tracks(0.002, 0.001, motion=lambda time: excitation(time) * moving)
    assert np.isnan(align(log, trace).correlation).tolist() == [
        False,
        False,
        True,
        False,
        False,
        False,
        False,
    ]
