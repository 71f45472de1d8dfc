"""The whole arm: energy, statics, step size, effects."""

import numpy as np
import pinocchio as pin
import pytest

from fri.errors import ConfigurationError
from sim_backend.configuration import load_configuration
from sim_backend.plant import Plant, PlantEffect
from sim_backend.robot import Payload, chain, robot_file, truth, with_inertias
from tests.sim_backend import arms

POSE = np.array([0.3, 0.8, -0.4, -1.1, 0.5, 0.9, 0.2])
PUSH = np.array([60.0, 60.0, 36.0, 36.0, 18.0, 18.0, 12.0])


def _energy_error(cycle_s, frictionless):
    arm = arms.lwr("paper_load", frictionless=frictionless, cycle_s=cycle_s)
    arm.reset(POSE)
    arm.energy[:] = 0.0
    start, worst = arms.stored_energy(arm), 0.0
    for k in range(round(1.0 / cycle_s)):
        drive = np.zeros(7) if frictionless else PUSH * np.sin(4 * np.pi * (k + 0.5) * cycle_s)
        arm.step(drive)
        put_in, dissipated, offset = arm.energy
        worst = max(worst, abs(arms.stored_energy(arm) - start - (put_in - dissipated - offset)))
    return worst


@pytest.mark.parametrize(("frictionless", "bound"), [(True, 2e-3), (False, 3e-4)])
def test_energy_in_is_stored_or_dissipated_and_the_error_shrinks_with_the_step(frictionless, bound):
    # Free fall of the loaded arm for 1 s turns 16 J into motion; driven with friction 72 J go in and 147 J to
    # heat.
    coarse, fine = _energy_error(1e-3, frictionless), _energy_error(5e-4, frictionless)
    assert coarse < bound
    assert coarse / fine == pytest.approx(4.0, rel=0.25)


def test_static_joint_torque_is_gravity_and_offset():
    arm = arms.lwr("paper_load")
    for pose in (POSE, -POSE, np.array([0.0, 0.5, 0.0, -1.3, 0.0, 0.8, 0.0])):
        arm.reset(pose)
        hold = arm.joint_torque + arm.drive.offm
        for _ in range(500):
            arm.step(hold)
        gravity = pin.computeGeneralizedGravity(arm.model, arm.model.createData(), arm.position)
        held = gravity + arm.drive.offl
        assert np.abs(arm.joint_torque - held)[[5]] == pytest.approx(0.0, abs=1e-6)
        assert (np.abs(arm.joint_torque - held) <= arm.drive.Fcl + 1e-6).all()
        assert np.allclose(arm.position, pose, atol=1e-6)


def test_payload_changes_the_static_torque_by_its_weight():
    arm = arms.lwr()
    arm.reset(POSE)
    empty = arm.joint_torque.copy()
    load = robot_file(load_configuration()).payload("paper_load")
    arm.mount(load)
    data = arm.model.createData()
    pin.forwardKinematics(arm.model, data, arm.position)
    jacobian = pin.computeJointJacobian(arm.model, data, arm.position, 7)
    weight = data.oMi[7].rotation.T @ np.array([0.0, 0.0, -9.81 * load.M])
    centre = np.array([load.MX, load.MY, load.MZ]) / load.M
    expected = -jacobian.T @ np.concatenate([weight, np.cross(centre, weight)])
    # The links sag a little under the load, so the torques of the arm itself change too.
    assert np.allclose(arm.joint_torque - empty, expected, atol=0.15)
    assert np.abs(expected).max() > 10.0


def _motion(substeps, cycle_s):
    arm = arms.lwr(substeps=substeps, cycle_s=cycle_s)
    arm.reset(POSE)
    hold = arm.joint_torque.copy()
    torques, positions = [], []
    each = round(1e-3 / cycle_s)
    for k in range(1000 * each):
        arm.step(hold + PUSH * np.sin(4 * np.pi * (k // each) * 1e-3))
        if k % each == each - 1:
            torques.append(arm.joint_torque.copy())
            positions.append(arm.position.copy())
    return np.array(torques), np.array(positions)


def test_halving_the_step_changes_nothing_that_matters():
    torque, position = _motion(4, 1e-3)
    for finer in (_motion(8, 1e-3), _motion(4, 5e-4)):
        # The noise floor of the joint torque sensors after an 8 Hz filter is 0.05 to 0.011 Nm.
        assert np.sqrt(np.mean((torque - finer[0]) ** 2, axis=0)).max() < 0.01
        assert np.abs(position - finer[1]).max() < 2e-4


def test_the_same_start_gives_the_same_bits():
    assert np.array_equal(_motion(4, 1e-3)[0], _motion(4, 1e-3)[0])


def test_default_arm_meets_the_plant_protocol():
    assert isinstance(arms.lwr(), Plant)


class Spring(PlantEffect):
    """Cable on the link side, gravity-like pull on the motor side, doubled friction, a gain on the joint
    torque.
    """

    def load(self, time_s, plant, loads):
        loads.link_torque -= 0.3 * plant.position
        loads.motor_torque += 1.0
        loads.Fcm *= 2.0

    def sense(self, time_s, plant, reading):
        reading.joint_torque *= 1.01


def test_effects_act_on_both_sides_and_on_friction():
    arm = arms.lwr(effects=[Spring()])
    arm.reset(POSE)
    friction = arm.drive.Fcm + 0.0
    arm.step(arm.joint_torque.copy())
    assert np.allclose(arm.loads.Fcm, 2.0 * friction)
    assert np.allclose(arm.loads.link_torque, -0.3 * POSE, atol=1e-4)
    arm.step(arm.joint_torque.copy())
    assert np.allclose(arm.loads.Fcm, 2.0 * friction), (
        "effects must start from the nominal values every cycle"
    )


def test_motor_side_effect_is_equivalent_to_motor_torque():
    class Push(PlantEffect):
        def load(self, time_s, plant, loads):
            loads.motor_torque += 20.0

    pushed, driven = arms.lwr(effects=[Push()]), arms.lwr()
    for arm in (pushed, driven):
        arm.reset(POSE)
    for _ in range(200):
        pushed.step(np.zeros(7))
        driven.step(np.full(7, 20.0))
    assert np.array_equal(pushed.state, driven.state)


def test_push_moves_the_links_and_ends():
    arm = arms.lwr()
    arm.reset(POSE)
    hold = arm.joint_torque + arm.drive.offm
    arm.brake(True)
    arm.push(np.array([0.0, 30.0, 0.0, 0.0, 0.0, 0.0, 0.0]))
    for _ in range(1500):
        arm.step(hold)
    assert arm.position[1] - POSE[1] == pytest.approx(30.0 / 15e3, rel=0.05)
    arm.push(np.zeros(7))
    for _ in range(1500):
        arm.step(hold)
    assert abs(arm.position[1] - POSE[1]) < 1e-4


@pytest.mark.parametrize("joint", range(7))
def test_a_brake_holds_up_to_its_torque_and_lets_go_when_it_opens(joint):
    arm = arms.lwr()
    arm.reset(POSE)
    hold = arm.joint_torque + arm.drive.offm
    arm.brake(True)
    push = np.zeros(7)
    push[joint] = 0.9 * (arm.drive.brake_torque + arm.drive.Fcm)[joint]
    start = arm.motor_position.copy()
    for _ in range(50):
        arm.step(hold + push)
    assert np.abs(arm.motor_position - start).max() < 1e-6
    arm.brake(False)
    for _ in range(50):
        arm.step(hold + push)
    assert arm.motor_position[joint] - start[joint] > 1e-3


def test_truth_lists_all_standard_parameters_with_the_payload_as_link_8():
    values = truth("emulator/default.yaml", payload="paper_load")
    assert len(values) == 136
    assert values["M8"] == 3.34
    assert values["Ia8"] == 0.0
    assert values["Fcm2"] == 16.48
    assert truth("emulator/default.yaml")["M8"] == 0.0


def test_standard_parameters_round_trip_through_the_rigid_body_model():
    config = load_configuration()
    content = robot_file(config)
    model = with_inertias(chain(config.beside("lwr4plus.urdf")), content.parameters)
    for link in range(1, 8):
        inertia = model.inertias[link].toDynamicParameters()
        names = ("M", "MX", "MY", "MZ", "XX", "XY", "YY", "XZ", "YZ", "ZZ")
        expected = [content.parameters[f"{name}{link}"] for name in names]
        assert np.allclose(inertia, expected, atol=1e-12)


def test_payload_from_its_centre_of_mass_has_the_inertia_of_the_parallel_axes():
    load = Payload.from_centre_of_mass(2.0, (0.1, 0.0, 0.2), (0.01, 0.0, 0.0, 0.02, 0.0, 0.03))
    found = (load.MX, load.XX, load.YY, load.ZZ, load.XZ)
    assert found == pytest.approx((0.2, 0.01 + 2.0 * 0.04, 0.02 + 2.0 * 0.05, 0.03 + 2.0 * 0.01, -2.0 * 0.02))


def test_unphysical_inertias_are_refused():
    config = load_configuration()
    parameters = dict(robot_file(config).parameters)
    parameters["ZZ7"] = -0.01
    with pytest.raises(ConfigurationError, match="not physical"):
        with_inertias(chain(config.beside("lwr4plus.urdf")), parameters)
