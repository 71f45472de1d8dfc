"""The hidden arm: against the emulator's own where both say the same, against its laws where they differ."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from sim_backend.configuration import load_configuration
from sim_backend.plant import ElasticArm
from sim_backend.robot import robot_file, true_arm
from tests.hidden_physics.arm import Contact, HiddenArm
from tests.hidden_physics.bristles import FILM_ROW, _spring

HOME = np.array([0.0, 0.5, 0.0, -1.3, 0.0, 0.8, 0.0])


def plants(frictionless: bool = False, **options):
    """The emulator's arm and the hidden one with the same parameters."""
    config = load_configuration()
    model, drive = true_arm(config, robot_file(config))
    if frictionless:
        none = dict.fromkeys(("Fvl", "Fcl", "offl", "Fvm", "Fcm", "offm"), np.zeros(7))
        drive = dataclasses.replace(drive, **none)
    own = ElasticArm(model, drive)
    hidden = HiddenArm(model, drive, np.random.default_rng(0), **options)
    for plant in (own, hidden):
        plant.reset(HOME)
    return own, hidden


def push_through(plant, milliseconds: int, speed: float, joint: int) -> np.ndarray:
    """Motor torque that a stiff speed controller needs at the end, one joint turning, the others held."""
    wanted = np.array(plant.motor_position)
    rate = np.zeros(7)
    torque = np.zeros(7)
    integral = np.zeros(7)
    for step in range(milliseconds):
        rate[joint] = speed * min(1.0, step / 100.0)
        wanted = wanted + 1e-3 * rate
        error = wanted - plant.motor_position
        integral += error * 1e-3
        torque = 6e3 * error + 3e4 * integral + 150.0 * (rate - plant.motor_velocity)
        plant.step(torque)
    return torque


def test_without_friction_both_arms_move_alike() -> None:
    own, hidden = plants(frictionless=True)
    gravity = np.array(own.joint_torque)
    for step in range(400):
        torque = gravity + 5.0 * np.sin(2.0 * np.pi * np.arange(1, 8) * step * 1e-3)
        own.step(torque)
        hidden.step(torque)
    travelled = np.ptp([HOME, own.position], axis=0)
    assert travelled.max() > 0.05
    np.testing.assert_allclose(hidden.position, own.position, atol=2e-5)
    np.testing.assert_allclose(hidden.motor_position, own.motor_position, atol=2e-5)
    np.testing.assert_allclose(hidden.joint_torque, own.joint_torque, atol=0.05)


def test_at_steady_speed_both_arms_need_the_same_torque() -> None:
    own, hidden = plants()
    expected = push_through(own, 900, 0.3, 4)
    found = push_through(hidden, 900, 0.3, 4)
    assert found[4] == pytest.approx(expected[4], abs=0.05)


def test_bristles_give_way_before_they_slide() -> None:
    _, hidden = plants()
    rest = np.array(hidden.motor_position)
    gravity = np.array(hidden.joint_torque)
    torque = gravity.copy()
    torque[4] += 2.5
    for _ in range(300):
        hidden.step(torque)
    # Fcm5 is 5.58 Nm: it holds, but the bristles have bent, and they spring back in part.
    bent = hidden.motor_position[4] - rest[4]
    assert 1e-5 < bent < 2e-4
    for _ in range(300):
        hidden.step(gravity)
    remains = hidden.motor_position[4] - rest[4]
    assert 0.3 * bent < remains < 0.8 * bent


@pytest.mark.parametrize(
    ("traits", "excess"),
    [
        ({"stribeck": {5: 0.3}, "stribeck_speed": {5: 10.0}, "stribeck_shape": {5: 2.0}}, 0.3 * 5.58),
        ({"load_share": {2: 0.0, 5: 0.5}}, None),
        ({"forward_coulomb": {5: 0.2}}, 0.2 * 5.58),
        ({"coulomb": {5: 1.1}}, 0.1 * 5.58),
        ({"memory": {5: 2.0}, "memory_time": {5: 0.05}}, 2.0 * 0.3),
        ({"viscous_power": {5: 0.5}, "viscous_corner": {5: 0.3}}, 5.39 * 0.3 * (2.0**-0.5 - 1.0)),
    ],
)
def test_a_trait_changes_the_torque_by_what_its_law_says(traits, excess) -> None:
    _, healthy = plants()
    _, changed = plants(traits=traits)
    before = push_through(healthy, 900, 0.3, 4)
    after = push_through(changed, 900, 0.3, 4)
    if excess is None:
        excess = 0.5 * abs(healthy.joint_torque[4])
        assert excess > 0.05
    assert after[4] - before[4] == pytest.approx(excess, abs=0.03)
    others = np.delete(after - before, 4)
    assert np.abs(others).max() < 0.05


def test_torque_constant_is_seen_in_the_reported_torque_only() -> None:
    _, healthy = plants()
    _, changed = plants(traits={"motor_gain": {2: 1.25}})
    before = push_through(healthy, 900, 0.2, 1)
    after = push_through(changed, 900, 0.2, 1)
    assert after[1] * 1.25 == pytest.approx(before[1], rel=0.01)
    assert changed.joint_torque[1] == pytest.approx(healthy.joint_torque[1], rel=0.01)


def test_friction_warms_the_film_and_then_the_joint() -> None:
    _, hidden = plants(traits={"film_capacity": {5: 1.0}, "film_conductance": {5: 2.0}})
    push_through(hidden, 4000, 0.3, 4)
    power = (5.58 + 5.39 * 0.3) * 0.3
    # Film in balance with what flows to the housing, which is still nearly cold.
    assert hidden.inner[FILM_ROW, 4] == pytest.approx(power / 2.0, rel=0.05)
    assert hidden.inner[FILM_ROW, 1] < 0.05


def test_within_the_lost_motion_the_joint_is_soft() -> None:
    # Stiffness of joint 5 is 8 kNm/rad; it is held still on both sides of the spring.
    torque, slope = _spring(0.8e-3, 8e3, 1e-3, 0.01, 0.0)
    assert torque == pytest.approx(8e3 * 0.8e-3 * 0.01)
    assert slope == pytest.approx(80.0)
    torque, slope = _spring(-2e-3, 8e3, 1e-3, 0.01, 0.0)
    assert torque == pytest.approx(-8.0, rel=0.02)
    assert slope == pytest.approx(8e3)
    assert _spring(2e-3, 8e3, 0.0, 0.01, 1e5)[0] == pytest.approx(16.0 + 8e3 * 1e5 * 8e-9)


def test_encoders_show_their_zero_and_the_arm_stands_where_they_say() -> None:
    _, hidden = plants(traits={"zero": {2: 0.02}})
    np.testing.assert_allclose(hidden.position, HOME)
    assert hidden.body[2, 1] == pytest.approx(HOME[1] - 0.02)


def test_an_encoder_off_its_axis_errs_with_the_angle() -> None:
    off, angle = 0.01, 0.7
    _, hidden = plants(traits={"eccentric": {2: off}, "eccentric_angle": {2: angle}})
    np.testing.assert_allclose(hidden.position, HOME, atol=1e-12)
    true = hidden.body[2, 1]
    assert HOME[1] - true == pytest.approx(off * np.sin(true + angle), abs=1e-6)


def test_tilt_brings_gravity_to_the_first_joint() -> None:
    _, level = plants()
    _, tilted = plants(tilt=(0.02, 0.0))
    assert abs(tilted.joint_torque[0] - level.joint_torque[0]) > 0.2


def test_contact_is_felt_in_the_joints_while_it_lasts() -> None:
    contact = Contact(0.1, 0.2, 7, (0.0, 0.0, -10.0))
    assert contact.at(0.05) == contact.at(0.31) == 0.0
    assert contact.at(0.2) == pytest.approx(1.0)
    _, free = plants()
    _, touched = plants(contacts=[dataclasses.asdict(contact)])
    gravity = np.array(free.joint_torque)
    most = 0.0
    for step in range(350):
        free.step(gravity)
        touched.step(gravity)
        difference = np.abs(touched.joint_torque - free.joint_torque).max()
        if step < 100:
            assert difference == 0.0
        most = max(most, float(difference))
    assert most > 2.0
