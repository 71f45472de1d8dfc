"""The delay of a channel: its search, its interval, and what it says without enough data."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import ident.rows.delay as module
from fri.errors import DataError
from ident.rows.content import Kept
from ident.rows.delay import Delay, DelayData, _misfit, _Rows, estimate_delay
from ident.rows.filters import SignalSettings, differentiate, interpolate_uniform
from ident.rows.prepare import prepare
from tests.ident import estimation_arm as arm

DT, MOTOR_DT, NAMES = 0.004, 0.01, ("a", "b")


def data(delay_s: float, seconds: float = 24.0, seed: int = 0, scale: float = 1.0) -> DelayData:
    """Two joints with drives of 0.4 and 0.3 kg m^2, 5 and 3 Nm s/rad, 4 and 3 Nm, offsets of 1 and -1 Nm."""
    random = np.random.default_rng(seed)
    time = np.arange(0.0, seconds, DT)

    def q(at: np.ndarray) -> np.ndarray:
        return scale * np.column_stack(
            [np.sin(1.1 * at) + 0.3 * np.sin(3.7 * at), np.cos(0.9 * at) + 0.3 * np.sin(4.3 * at)]
        )

    def motor(at: np.ndarray) -> np.ndarray:
        grid = np.arange(at[0] - 0.1, at[-1] + 0.1, DT)
        qd, qdd = differentiate(q(grid), DT)
        total = 20.0 * q(grid) + qdd * [0.4, 0.3] + qd * [5.0, 3.0] + np.sign(qd) * [4.0, 3.0] + [1.0, -1.0]
        return np.column_stack([np.interp(at, grid, column) for column in total.T])

    position = q(time)
    qd, qdd = differentiate(position, DT)
    joint = 20.0 * position + 0.002 * random.normal(size=position.shape)
    when = np.arange(0.2, seconds - 0.2, MOTOR_DT)
    torque = motor(when - delay_s) + 0.005 * random.normal(size=(len(when), 2))
    known = np.abs(qd) > 0.1 * scale
    return DelayData(time, qd, qdd, joint, known, when, torque, (0.1, seconds - 0.1))


@pytest.mark.parametrize("delay_s", [0.0, 0.003, 0.02, 0.09])
def test_the_delay_is_found_over_the_whole_search(delay_s: float):
    found = estimate_delay([data(delay_s)], NAMES)
    assert found.estimate == pytest.approx(delay_s, abs=2e-4)
    assert found.std < 2e-4
    assert list(found.by_joint) == ["a", "b"]
    for own, std in found.by_joint.values():
        assert own == pytest.approx(delay_s, abs=4e-4)
        assert 0.0 < std < 4e-4
    assert 1.0 <= found.disagreement < 3.0


def test_a_joint_of_doubtful_stiffness_does_not_decide_the_delay():
    """The motors of joint a are said to turn ahead by its torque over 1250 Nm/rad, and do not.

    Its torque follows the weight of other links too; what is its own position's alone looks like viscous friction.
    """
    right, twist = data(0.004), np.array([1.0 / 1250.0, 0.0])
    weight = np.array([30.0, 0.0])
    right = replace(
        right,
        joint_torque=right.joint_torque + weight * np.sin(2.3 * right.times)[:, None],
        motor_torque=right.motor_torque + weight * np.sin(2.3 * (right.motor_times - 0.004))[:, None],
    )
    assert estimate_delay([right], NAMES).estimate == pytest.approx(0.004, abs=2e-4)
    rate, change = differentiate(right.joint_torque * twist, DT)
    wrong = replace(right, qd=right.qd + rate, qdd=right.qdd + change)
    doubtful = estimate_delay([wrong], NAMES)
    assert doubtful.disagreement > 10.0
    assert abs(doubtful.estimate - 0.004) > 2e-4
    found = estimate_delay([wrong], NAMES, compliance=twist)
    low, high = found.interval
    assert low < 0.004 < high
    assert found.disagreement < 3.0
    assert found.estimate == pytest.approx(0.004, abs=1e-4)
    assert found.by_joint["a"][1] == pytest.approx(0.3 * 5.0 * twist[0], rel=0.1)


def test_two_stretches_know_more_than_one():
    one, two = data(0.005, 12.0), data(0.005, 24.0, seed=1)
    alone, both = estimate_delay([one], NAMES), estimate_delay([one, two], NAMES)
    assert both.estimate == pytest.approx(0.005, abs=2e-4)
    assert both.by_joint["a"][1] < 0.8 * alone.by_joint["a"][1]


@pytest.mark.parametrize("delay_s", [0.05, -0.05])
def test_a_delay_at_the_edge_of_the_search_is_refused(delay_s: float):
    with pytest.raises(DataError, match=f"searched delays, {np.sign(delay_s) * 30:.0f} ms"):
        estimate_delay([data(delay_s)], NAMES, search_s=0.03)


def test_a_short_or_still_motion_tells_nothing():
    still = data(0.0, scale=0.0)
    for some in (data(0.0, 0.9), replace(still, known=np.zeros_like(still.known))):
        found = estimate_delay([some], NAMES)
        assert (found.seconds, found.std, found.how) == (
            0.0,
            pytest.approx(MOTOR_DT),
            "the motion is too short or too slow to tell",
        )


def test_a_joint_in_one_direction_keeps_its_offset_out_of_the_friction():
    whole = data(0.004)
    forward = whole.qd[:, 0] > 0.1
    found = estimate_delay([replace(whole, known=np.column_stack([forward, whole.known[:, 1]]))], NAMES)
    assert found.estimate == pytest.approx(0.004, abs=3e-4)
    assert set(found.by_joint) == {"a", "b"}


def test_a_delay_within_its_interval_is_zero_with_the_whole_uncertainty():
    late = Delay.of(0.0041, 0.002, "how", {}, 1.0)
    assert (late.seconds, late.std, late.interval) == (
        0.0041,
        0.002,
        (pytest.approx(0.0041 - 1.96 * 0.002), pytest.approx(0.0041 + 1.96 * 0.002)),
    )
    same = Delay.of(0.0039, 0.002, "how", {}, 1.0)
    assert (same.seconds, same.estimate) == (0.0, 0.0039)
    assert same.std == pytest.approx(np.hypot(0.002, 0.0039))
    assert same.interval == (0.0, pytest.approx(1.96 * same.std))
    early = Delay.of(-0.0039, 0.002, "how", {}, 1.0)
    assert (early.seconds, early.std, early.early) == (0.0, 0.002, False)
    assert Delay.of(-0.0081, 0.002, "how", {}, 1.0).early
    assert not Delay.of(-0.0079, 0.002, "how", {}, 1.0).early
    stated = Delay(0.007, 0.0, "stated")
    assert stated.interval == (0.007, 0.007)
    assert str(stated) == "late by 7.00 ms (stated)"
    assert str(same).startswith("not late (0.00 to 8.")


def test_a_stated_delay_is_taken_and_motor_torques_alone_have_none():
    session = arm.session(sensors=arm.Sensors(motor_delay_s=0.004))
    stated = prepare(session, SignalSettings(motor_delay_s=0.003)).delay
    assert (stated.seconds, stated.std, stated.how) == (0.003, 0.0, "stated")
    joint = replace(session.joint, effort=session.joint.effort[:, :0])
    alone = prepare(replace(session, joint=joint)).delay
    assert (alone.seconds, alone.std) == (0.0, 0.0)


def test_equal_data_are_estimated_once_and_each_other_argument_anew(monkeypatch: pytest.MonkeyPatch):
    calls: list[tuple[object, ...]] = []

    def estimated(*arguments: object) -> Delay:
        calls.append(arguments)
        return Delay(1e-3 * len(calls), 1e-4, "counted")

    monkeypatch.setattr(module, "_estimates", Kept(8))
    monkeypatch.setattr(module, "_estimated", estimated)
    first, joints = data(0.01, seconds=8.0), ("A1", "A2")
    assert estimate_delay([first], joints) == estimate_delay([data(0.01, seconds=8.0)], joints)
    assert len(calls) == 1
    torque = first.motor_torque.copy()
    torque[-1, -1] += 1e-9
    others = [replace(first, motor_torque=torque), replace(first, span=(first.span[0], first.span[1] - 1e-3))]
    for number, other in enumerate(others, start=2):
        assert estimate_delay([other], joints).seconds == pytest.approx(1e-3 * number)
    estimate_delay([first], joints, cutoff_hz=4.0)
    estimate_delay([first], joints, search_s=0.05)
    estimate_delay([first], ("A1", "E1"))
    assert len(calls) == 6


@pytest.mark.parametrize("delay", [0.0, 0.004, 0.0137, -0.3])
def test_samples_of_a_delay_are_those_of_the_moved_channel(delay: float) -> None:
    found = data(0.02)
    found = replace(found, known=np.random.default_rng(1).random(found.known.shape) < 0.8)
    rows = _Rows.of([found], 5.0, 0.1)
    assert rows is not None
    (block,) = rows.blocks
    times = found.motor_times[block.inside] - delay
    place = np.clip(np.rint((times - found.times[0]) / DT).astype(int), 0, len(found.times) - 1)
    known = block.known(delay)
    np.testing.assert_array_equal(known, found.known[place])
    moved = interpolate_uniform(block.state, float(found.times[0]), DT, times)
    qdd, qd, torque = np.split(moved, 3, axis=1)
    signals = np.stack([qdd, qd, np.sign(qd), found.motor_torque[block.inside] - torque], axis=2)
    expected = block.parallel.apply(signals * known[:, :, None])
    np.testing.assert_allclose(block.at(delay, known), expected, rtol=1e-12, atol=1e-12)


def test_rows_take_every_sample_and_the_coarse_search_forty_a_period():
    rows = _Rows.of([data(0.0)], 1.0, 0.1)
    assert rows is not None
    assert (rows.step_s, rows.row_s) == (pytest.approx(MOTOR_DT), pytest.approx(0.4))
    (block,) = rows.blocks
    assert block.inside.step == 1
    # 40 Hz of the 100 Hz, and of 100 Hz nothing to leave out beyond 1.25 Hz.
    assert rows.thinned(1.0).blocks[0].inside.step == 2
    assert rows.thinned(1.3) is rows


def test_joints_without_a_known_row_have_no_part_in_the_search():
    whole = data(0.0)
    rows = [_Rows.of([replace(whole, known=whole.known * some)], 5.0, 0.1) for some in (True, [True, False])]
    both, one = (_misfit([part], [0, 1], 0.0) for part in rows)
    assert one == pytest.approx(_misfit(rows[:1], [0], 0.0))
    assert both == pytest.approx(one + _misfit(rows[:1], [1], 0.0))
