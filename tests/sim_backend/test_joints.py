"""One elastic joint against theory: resonance, sticking, sliding, swinging."""

import numpy as np
import pytest

from sim_backend.plant import ElasticArm
from sim_backend.stiction import advance
from tests.sim_backend import arms


def _free_mode_hz(arm, cycles):
    """Frequency of the twist between motor and link, from its sign changes."""
    twist = []
    for _ in range(cycles):
        arm.step(np.zeros(1))
        twist.append(arm.motor_position[0] - arm.position[0])
    twist = np.array(twist)
    up = np.flatnonzero((twist[:-1] < 0.0) & (twist[1:] >= 0.0))
    exact = up + twist[up] / (twist[up] - twist[up + 1])
    return (len(exact) - 1) / ((exact[-1] - exact[0]) * arm.cycle_s)


@pytest.mark.parametrize(
    ("motor", "link", "stiffness", "tolerance"),
    [(3.14, 2.0, 15e3, 1e-3), (2.58, 5.0, 15e3, 1e-3), (0.42, 0.003, 6e3, 0.012)],
)
def test_free_two_mass_mode_is_where_theory_puts_it(motor, link, stiffness, tolerance):
    # omega^2 = K (1/Ia + 1/J). The wrist's 226 Hz is sampled by 4 steps of 0.25 ms: 1 % low, as (omega h)^2 /
    # 12 says.
    arm = ElasticArm(arms.pendulum(link, gravity=0.0), arms.drive(Ia=motor, stiffness=stiffness))
    arm.motor_position[0] = 0.01
    expected = np.sqrt(stiffness * (1 / motor + 1 / link)) / (2 * np.pi)
    assert _free_mode_hz(arm, 2000) == pytest.approx(expected, rel=tolerance)


def test_wrist_mode_converges_with_the_step():
    expected = np.sqrt(6e3 * (1 / 0.42 + 1 / 0.003)) / (2 * np.pi)
    errors = []
    for substeps in (4, 8, 16):
        drive = arms.drive(Ia=0.42, stiffness=6e3)
        arm = ElasticArm(arms.pendulum(0.003, gravity=0.0), drive, substeps=substeps)
        arm.motor_position[0] = 0.01
        errors.append(abs(_free_mode_hz(arm, 2000) - expected) / expected)
    assert errors[0] / errors[1] == pytest.approx(4.0, rel=0.1)
    assert errors[1] / errors[2] == pytest.approx(4.0, rel=0.1)


def test_damping_of_the_free_mode_is_where_theory_puts_it():
    motor, link, stiffness, damping = 2.0, 1.0, 1e4, 5.0
    arm = ElasticArm(
        arms.pendulum(link, gravity=0.0), arms.drive(Ia=motor, stiffness=stiffness, damping=damping)
    )
    arm.motor_position[0] = 0.01
    reduced = 1 / (1 / motor + 1 / link)
    start = arms.stored_energy(arm)
    for _ in range(1000):
        arm.step(np.zeros(1))
    # Energy decays by exp(-D/J_reduced t), half of it in the spring at any time on average.
    rest = (
        0.5 * (motor + link) * ((motor * arm.motor_velocity + link * arm.velocity) / (motor + link))[0] ** 2
    )
    assert arms.stored_energy(arm) - rest == pytest.approx(start * np.exp(-damping / reduced * 1.0), rel=0.05)


def test_rest_stays_at_rest_bit_for_bit():
    model = arms.pendulum(0.5, 2.0, 0.3)
    arm = ElasticArm(model, arms.drive(Fcm=10.0, Fcl=0.3, Fvm=5.0))
    arm.reset(np.array([0.7]))
    arm.step(arm.joint_torque.copy())
    state = arm.state.copy()
    random = np.random.default_rng(3)
    hold = arm.joint_torque.copy()
    for _ in range(2000):
        arm.step(hold + random.uniform(-9.9, 9.9, 1))
    assert np.array_equal(arm.state, state)
    assert not arm.velocity.any()
    assert not arm.motor_velocity.any()


@pytest.mark.parametrize(("share", "moves"), [(0.999, False), (1.001, True)])
def test_motor_breaks_away_at_the_coulomb_torque(share, moves):
    arm = ElasticArm(arms.pendulum(0.5, gravity=0.0), arms.drive(Fcm=15.0))
    arm.reset(np.zeros(1))
    for _ in range(100):
        arm.step(np.array([15.0 * share]))
    assert bool(arm.motor_velocity[0]) is moves


def test_link_sticks_on_a_slowly_turning_motor_until_the_spring_pulls_harder():
    stiffness, grip = 1e4, 0.5
    arm = ElasticArm(arms.pendulum(0.5, gravity=0.0), arms.drive(Ia=1e6, Fcl=grip, stiffness=stiffness))
    arm.reset(np.zeros(1))
    arm.motor_velocity[0] = 1e-4
    broke = None
    for _ in range(2000):
        arm.step(np.zeros(1))
        if arm.velocity[0] != 0.0:
            broke = arm.motor_position[0]
            break
        assert arm.position[0] == 0.0
    assert broke == pytest.approx(grip / stiffness, rel=0.01)


def test_sliding_friction_is_coulomb_plus_viscous_plus_offset():
    arm = ElasticArm(
        arms.pendulum(0.5, gravity=0.0), arms.drive(Fcm=4.0, Fvm=2.0, offm=0.5, Fcl=0.3, Fvl=0.7, offl=-0.2)
    )
    for sign in (1.0, -1.0):
        arm.reset(np.zeros(1))
        for _ in range(20000):
            arm.step(np.array([sign * 9.0]))
        speed = sign * (9.0 - sign * (0.5 - 0.2) - 4.0 - 0.3) / (2.0 + 0.7)
        assert arm.velocity[0] == pytest.approx(speed, rel=1e-6)
        assert arm.motor_velocity[0] == pytest.approx(speed, rel=1e-6)
        assert arm.joint_torque[0] == pytest.approx(0.7 * speed + 0.3 * sign - 0.2, rel=1e-6)


def test_coulomb_friction_stops_a_sliding_mass_after_the_right_distance():
    # v^2 / (2 a) with a = Fc / (Ia + J); the joint is stiff enough to move as one.
    arm = ElasticArm(arms.pendulum(0.5, gravity=0.0), arms.drive(Fcm=3.0, stiffness=1e6, damping=300.0))
    arm.reset(np.zeros(1))
    arm.velocity[:] = arm.motor_velocity[:] = 1.0
    for _ in range(2000):
        arm.step(np.zeros(1))
    assert arm.motor_velocity[0] == 0.0
    assert arm.motor_position[0] == pytest.approx(1.0**2 / 2 / (3.0 / 1.5), rel=2e-3)


def test_free_swing_has_the_period_of_the_physical_pendulum():
    # Brakes off, no friction, the motor's inertia swings along through the stiff joint: T = 2 pi sqrt((J +
    # Ia) / m g l).
    arm = ElasticArm(arms.pendulum(0.6, 2.0, 0.4), arms.drive(Ia=0.2, stiffness=1e5))
    arm.reset(np.array([0.02]))
    arm.motor_position[:] = arm.position
    angle = []
    for _ in range(10_000):
        arm.step(np.zeros(1))
        angle.append(arm.position[0])
    angle = np.array(angle)
    up = np.flatnonzero((angle[:-1] < 0.0) & (angle[1:] >= 0.0))
    exact = up + angle[up] / (angle[up] - angle[up + 1])
    period = np.diff(exact).mean() * 1e-3
    assert period == pytest.approx(2 * np.pi * np.sqrt(0.8 / (2.0 * 9.81 * 0.4)), rel=2e-4)


def test_brakes_hold_the_arm_without_drift():
    arm = ElasticArm(arms.pendulum(0.5, 2.0, 0.3), arms.drive(Fcl=0.1, damping=20.0))
    arm.reset(np.array([1.2]))
    arm.brake(True)
    for _ in range(3000):
        arm.step(np.zeros(1))
    settled = arm.state.copy()
    for _ in range(500):
        arm.step(np.zeros(1))
    assert np.array_equal(arm.state, settled)
    assert arm.position[0] == pytest.approx(1.2, abs=1e-6)


def test_descent_finds_the_same_motion_as_the_active_sets():
    """Seven strongly coupled sticking links; the solution satisfies the friction law to rounding."""
    random = np.random.default_rng(11)
    n, h = 7, 2.5e-4
    for _ in range(300):
        factor = random.normal(size=(n, n))
        mass = factor @ factor.T + 1e-3 * np.eye(n)
        state = random.normal(size=(4, n)) * np.array([[1e-4], [1e-3], [1e-4], [1e-3]])
        before = state.copy()
        drive = 20.0 * random.normal(size=n)
        bias = 5.0 * random.normal(size=n)
        joint = np.array([np.ones(n), np.full(n, 1e4), np.full(n, 2.0)])
        friction = np.array(
            [np.ones(n), np.full(n, 15.0), np.zeros(n), np.zeros(n), np.full(n, 5.0), np.zeros(n)]
        )
        torque, energy, modes = np.zeros(n), np.zeros(3), random.integers(-1, 2, (2, n))
        advance(state, modes, mass, bias, drive, joint, friction, h, 1, torque, energy)
        mean = 0.5 * (before + state)
        through = joint[1] * (mean[0] - mean[2]) + joint[2] * (mean[1] - mean[3])
        grip = drive - through - friction[0] * mean[1] - joint[0] * (state[1] - before[1]) / h
        _check_law(grip, state[1], friction[1])
        grip = through - bias - mass @ (state[3] - before[3]) / h
        _check_law(grip, state[3], friction[4])


def _check_law(force, speed, limit):
    moving = speed != 0.0
    assert np.allclose(force[moving], (limit * np.sign(speed))[moving], atol=1e-7)
    assert (np.abs(force[~moving]) <= limit[~moving] + 1e-7).all()
