"""Forms of causes: what each of them adds to the plain one."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest

from ident.dynamics.kinematics import Chain
from ident.effects import EFFECTS, ArmMotion, Shape, check_entry
from ident.effects.course import Course
from ident.effects.motion import in_order

FLAT = [{"alpha": 0.0, "r": 0.1, "d": 0.2 * k} for k in range(3)]
TIME = np.arange(0.0, 20.0, 0.002)


def motion(begun_s: float = 0.0, slow: float = 1.0) -> ArmMotion:
    """Three joints that swing at one amplitude, with drives of viscous and Coulomb friction."""
    w = slow * np.array([1.0, 1.5, 2.0])
    q, qd, qdd = (
        0.8 * np.sin(w * TIME[:, None]),
        0.8 * w * np.cos(w * TIME[:, None]),
        -0.8 * w**2 * np.sin(w * TIME[:, None]),
    )
    return ArmMotion(
        chain=Chain.from_table(FLAT),
        bodies=np.zeros((3, 10)),
        session=0,
        time=TIME,
        duration_s=20.0,
        q=q,
        qd=qd,
        qdd=qdd,
        motor_speed=qd,
        motor_acceleration=qdd,
        joint_torque=4.0 * np.sin(q),
        motor_torque=4.0 * np.sin(q) + 2.0 * qd,
        gear_ratio=np.full(3, 100.0),
        inertia=np.zeros(3),
        link_coulomb=np.zeros(3),
        motor_coulomb=np.full(3, 1.0),
        friction=lambda v: 2.0 * v + np.sign(v),
        begun_s=begun_s,
    )


def test_a_plain_ripple_is_one_by_direction_with_equal_waves_and_no_delay() -> None:
    ripple, here = EFFECTS["gear_ripple"], motion()
    plain = {"cosine": 0.3, "sine": -0.2, "cycles_per_turn": 2.0, "gear_ratio": 100.0}
    both = {**plain, "cosine_backward": 0.3, "sine_backward": -0.2, "delay": 0.0}
    np.testing.assert_allclose(
        ripple.torque(here, 1, plain)[0], ripple.torque(here, 1, both, "by direction")[0], atol=1e-12
    )
    # The pull and its reverse at one angle are one torque with the plain form, two with the other.
    other = {**both, "cosine_backward": -0.3, "sine_backward": 0.2}
    difference = ripple.torque(here, 1, other, "by direction")[0] - ripple.torque(here, 1, plain)[0]
    forward = here.motor_speed[:, 1] > 0.0
    assert np.all(difference[forward] == 0.0)
    assert np.sqrt(np.mean(difference[~forward, 1] ** 2)) == pytest.approx(0.51, abs=0.05)


def test_a_late_ripple_is_that_of_the_angle_before() -> None:
    ripple, here = EFFECTS["gear_ripple"], motion()
    values = {"cosine": 0.3, "sine": -0.2, "cosine_backward": 0.3, "sine_backward": -0.2}
    values |= {"cycles_per_turn": 1.0, "gear_ratio": 100.0}
    late, now = (
        ripple.torque(here, 0, {**values, "delay": delay}, "by direction")[0][:, 0] for delay in (0.02, 0.0)
    )
    # The angle is taken on a line; a swing bends it by 0.1 mrad in this time.
    np.testing.assert_allclose(late[10:], now[:-10], atol=0.02)
    assert np.max(np.abs(late - now)) > 0.3


def test_a_ripple_turns_with_the_motor_ahead_of_its_link() -> None:
    ripple, links = EFFECTS["gear_ripple"], motion()
    values = {"cosine": 0.3, "sine": -0.2, "cycles_per_turn": 2.0, "gear_ratio": 100.0}
    motors = replace(links, motor_q=links.q + 1e-3 * links.joint_torque)
    of_motors = ripple.torque(motors, 1, values)[0]
    np.testing.assert_allclose(ripple.torque(links, 1, {**values, "compliance": 1e-3})[0], of_motors)
    assert np.max(np.abs(of_motors - ripple.torque(links, 1, values)[0])) > 0.1
    some = motors.part(slice(100, 200))
    np.testing.assert_array_equal(ripple.torque(some, 1, values)[0], of_motors[100:200])


def test_a_hose_over_two_joints_has_a_potential() -> None:
    """Its pulls are the slopes of half the stiffness times the squared length."""
    hose, here = EFFECTS["cable_spring"], motion()
    values = {"stiffness": 3.0, "source": 3.0, "ratio": -0.5}
    motor, joint = hose.torque(here, 1, values, "over two joints")
    np.testing.assert_array_equal(motor, joint)
    power = np.sum(joint * here.qd, axis=1)
    energy = 1.5 * (here.q[:, 1] - 0.5 * here.q[:, 2]) ** 2
    np.testing.assert_allclose(power[1:-1], np.gradient(energy, 0.002)[1:-1], atol=1e-3)
    assert not np.any(joint[:, 0])


def test_other_friction_each_way_is_the_offset_of_a_simulated_drive_at_reversals_too() -> None:
    asymmetry, here = EFFECTS["friction_asymmetry"], motion()
    torque, _ = asymmetry.torque(here, 1, {"viscous": 0.5, "coulomb": 0.2}, "viscous and Coulomb")
    np.testing.assert_allclose(torque[:, 1], 0.5 * np.abs(here.motor_speed[:, 1]) + 0.2, atol=1e-12)


def test_a_saturating_constant_reads_the_more_too_much_the_larger_the_torque() -> None:
    gain, here = EFFECTS["motor_torque_gain"], motion()
    values = {"error": 0.02, "cubic": 1e-3}
    torque = gain.torque(here, 1, values, "saturating")[0][:, 1]
    np.testing.assert_allclose(
        torque, here.motor_torque[:, 1] * (0.02 + 1e-3 * here.motor_torque[:, 1] ** 2), atol=1e-12
    )
    saturating = gain.shapes(None, 0)[1]  # type: ignore[arg-type]
    assert gain.plausible(np.array([0.1, 1e-3]), saturating)
    assert not gain.plausible(np.array([0.1, -1e-3]), saturating)


def test_friction_that_turns_over_twenty_degrees_is_no_presliding_of_a_drive() -> None:
    effect, one = EFFECTS["presliding_hysteresis"], np.ones(1)
    assert effect.familiar(Shape(length=0.02), one, None, 0)  # type: ignore[arg-type]
    assert not effect.familiar(Shape(length=0.37), one, None, 0)  # type: ignore[arg-type]


def test_a_hose_pulls_the_more_the_further_the_joint_turns() -> None:
    spring = EFFECTS["cable_spring"]
    hardening = spring.shape_of({"stiffness": 1.0, "quadratic": 0.0, "cubic": 1.0}, "hardening")
    travel = SimpleNamespace(position_range=np.array([[-2.0, 2.0]]))
    for coefficients, known in (
        ([1.1, 0.05, -0.02], True),
        ([1.0, 0.0, 0.3], True),
        ([3.7, -1.0, -1.2], False),
        ([-1.0, 0.0, 0.3], False),
    ):
        assert spring.familiar(hardening, np.array(coefficients), travel, 0) == known  # type: ignore[arg-type]


def test_smooth_friction_is_none_at_standstill_and_whole_at_speed() -> None:
    film, here = EFFECTS["presliding_hysteresis"], motion()
    values = {"amplitude": 1.0, "velocity": 0.02}
    torque = film.torque(here, 0, values, "smooth in speed")[0][:, 0]
    speed = here.motor_speed[:, 0]
    whole = torque + here.direction[:, 0]
    assert np.all(np.abs(whole[np.abs(speed) < 1e-3]) < 0.06)
    np.testing.assert_allclose(whole[np.abs(speed) > 0.1], np.sign(speed[np.abs(speed) > 0.1]), atol=1e-3)


def warmth(motions: list[ArmMotion], time_constant: float) -> list[np.ndarray]:
    drift, shape = EFFECTS["friction_temperature"], Shape(Course.CARRIED, time_constant=time_constant)
    found = []
    for one in in_order(motions):
        (column,) = drift.columns(one, 0, shape)
        assert column.motor is not None
        friction = one.drive_friction[:, 0]
        used = np.abs(friction) > 0.5
        found.append(column.motor[used] / friction[used])
    return found


def test_a_drive_stays_warm_from_session_to_session() -> None:
    # In any order of the list; a minute and an hour between them.
    first, soon, later = (motion(begun_s=start) for start in (0.0, 80.0, 3700.0))
    beginning = [values[0] for values in warmth([soon, later, first], 300.0)]
    assert beginning[2] == pytest.approx(0.0, abs=1e-3)
    assert beginning[0] > 0.02
    assert beginning[1] == pytest.approx(0.0, abs=1e-3)
    for before, after in pairwise(warmth([first, soon], 300.0)):
        # Sixty seconds of pause cool by a fifth.
        assert after[0] == pytest.approx(before[-1] * np.exp(-60.0 / 300.0), rel=0.02)


def test_the_first_session_is_that_of_a_cold_start() -> None:
    drift, here = EFFECTS["friction_temperature"], motion()
    values = {"change": -0.2, "time_constant": 30.0}
    for one in (here, replace(here, begun_s=1e9)):
        np.testing.assert_allclose(
            drift.torque(one, 0, values, Course.CARRIED)[0],
            drift.torque(here, 0, values, Course.HEATED)[0],
        )


def test_entries_without_a_form_stay_what_they_were() -> None:
    for cause, values in {
        "gear_ripple": {"cosine": 0.1, "sine": 0.1, "cycles_per_turn": 1.0, "gear_ratio": 100.0},
        "motor_torque_gain": {"error": 0.1},
        "presliding_hysteresis": {"amplitude": 1.0, "length": 1e-3},
    }.items():
        parameters = {name: {"value": value, "std": 0.0, "unit": "1"} for name, value in values.items()}
        check_entry({"cause": cause, "joints": [1], "parameters": parameters}, 3)
        assert EFFECTS[cause].shape_of(values).form is None
        EFFECTS[cause].check(values, None, whole=True)
