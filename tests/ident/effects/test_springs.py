from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

from ident.dynamics.kinematics import Chain
from ident.dynamics.parameters import from_com
from ident.dynamics.regressor import torque
from ident.effects import EFFECTS, ELASTICITY, ArmMotion
from ident.effects.springs import Springs

MASS, STIFFNESS, DAMPING, GAP = 2.0, 8000.0, 8.0, 2e-3


def motor(time: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A motor that swings and stops at once, as friction stops it."""
    going = time < 1.1
    angle = np.where(going, 0.1 * np.sin(4.0 * time), 0.1 * np.sin(4.4))
    return angle, np.where(going, 0.4 * np.cos(4.0 * time), 0.0)


def springs(dt: float = 2e-3, weight: float = 3.0) -> tuple[np.ndarray, Springs]:
    time = np.arange(0.0, 2.0, dt)
    angle, speed = (x[:, None] for x in motor(time))
    other = weight * np.cos(2.0 * np.pi * time)[:, None]
    mass = np.full((len(time), 1, 1), MASS)
    return time, Springs(mass, other, angle, speed, np.array([STIFFNESS]), np.array([DAMPING]), dt)


def solved(time: np.ndarray, gap: float, weight: float) -> np.ndarray:
    """Torque through the joint from an integrator of another kind."""

    def torque(t: float, q: float, v: float) -> float:
        angle, speed = motor(np.array([t]))
        twist = float(angle[0]) - q
        inside = np.clip(twist, -0.5 * gap, 0.5 * gap)
        return STIFFNESS * (twist - 0.98 * float(inside)) + DAMPING * (float(speed[0]) - v)

    def rate(t: float, x: np.ndarray) -> list[float]:
        return [x[1], (torque(t, x[0], x[1]) - weight * np.cos(2.0 * np.pi * t)) / MASS]

    start = [-weight / STIFFNESS, 0.4]
    found = solve_ivp(rate, (0.0, time[-1]), start, t_eval=time, rtol=1e-8, atol=1e-10, max_step=2e-3)
    return np.array([torque(t, q, v) for t, q, v in zip(time, *found.y, strict=True)])


@pytest.mark.parametrize("gap", [0.0, GAP])
def test_links_ring_on_their_springs_as_an_integrator_says(gap: float) -> None:
    time, plain = springs()
    joint = plain.with_play(0, gap) if gap else plain
    expected = solved(time, gap, 3.0)
    assert expected.std() > 3.0
    assert np.sqrt(np.mean((joint.torque[:, 0] - expected) ** 2)) < 0.04 * expected.std()


def test_acceleration_belongs_to_the_torque() -> None:
    _, plain = springs()
    for one in (plain, plain.with_play(0, GAP), plain.softer(0, 1e-4)):
        _, _, thrust = one.links
        np.testing.assert_allclose(MASS * thrust + one.other, one.torque, atol=1e-6)


def test_stiff_joint_follows_its_motor() -> None:
    _, plain = springs()
    stiff = Springs(
        plain.mass * 1e-4, plain.other, plain.angle, plain.speed, np.array([1e6]), np.array([1e3]), 2e-3
    )
    q, _, _ = stiff.links
    assert np.abs(q[:, 0] - plain.angle[:, 0]).max() < 2e-4


def test_softer_spring_bends_more() -> None:
    _, plain = springs(weight=30.0)
    still = slice(-50, None)
    twist = (plain.angle - plain.links[0])[still, 0]
    more = (plain.angle - plain.softer(0, 1e-4).links[0])[still, 0]
    bend = (more - twist) / plain.torque[still, 0]
    assert np.mean(bend) == pytest.approx(1e-4, rel=0.1)


def on_springs(time: np.ndarray, plain: Springs, chain: Chain, bodies: np.ndarray) -> ArmMotion:
    """The motion of an arm of one joint on its spring."""
    return ArmMotion(
        chain=chain,
        bodies=bodies,
        session=0,
        time=time,
        duration_s=2.0,
        q=plain.links[0],
        qd=plain.links[1],
        qdd=plain.links[2],
        motor_speed=plain.speed,
        motor_acceleration=np.zeros_like(plain.angle),
        joint_torque=plain.torque,
        motor_torque=plain.torque,
        gear_ratio=np.ones(1),
        inertia=np.zeros(1),
        link_coulomb=np.zeros(1),
        motor_coulomb=np.zeros(1),
        springs=plain,
    )


def test_a_softer_spring_lets_the_link_sag_to_another_gravity_torque() -> None:
    chain = Chain.from_table([{"name": "one", "alpha": 0.5 * np.pi}])
    body = from_com(10.0, np.array([0.7, 0.0, 0.0]), 0.1 * np.eye(3))[None]
    time, angle, size = np.arange(0.0, 0.5, 2e-3), 0.6, 1e-4

    def gravity(q: float) -> float:
        return float(torque(chain, np.array([[q]]), np.zeros((1, 1)), np.zeros((1, 1)), body)[0, 0])

    def rest(compliance: float) -> float:
        return float(brentq(lambda q: angle - q - compliance * gravity(q), angle - 0.5, angle + 0.5))

    before, after = (gravity(rest(1.0 / STIFFNESS + more)) for more in (0.0, size))
    assert abs(after - before) > 0.1
    one = np.ones((len(time), 1))
    plain = Springs(
        one[:, :, None] * 5.0,
        one * before,
        one * angle,
        0.0 * one,
        np.array([STIFFNESS]),
        np.array([500.0]),
        2e-3,
    )
    motion = on_springs(time, plain, chain, body)
    (soft,) = ELASTICITY.columns(motion, 0, ELASTICITY.at_encoder("motor").at(size=size))
    assert soft.joint is not None
    np.testing.assert_allclose(size * soft.joint, after - before, rtol=0.02)


def test_columns_of_lost_motion_and_twist_come_from_the_springs() -> None:
    time, plain = springs()
    motion = on_springs(time, plain, Chain.from_table([{"name": "one"}]), np.zeros((1, 10)))
    shape = EFFECTS["backlash"].shape_of({"width": 0.1, "size": GAP}, "encoder at the motor")
    (column,) = EFFECTS["backlash"].columns(motion, 0, shape)
    assert column.joint is not None
    change = plain.with_play(0, GAP).torque - plain.torque
    np.testing.assert_allclose(GAP * column.joint, change)
    assert np.abs(change).max() > 3.0
    (soft,) = ELASTICITY.columns(motion, 0, ELASTICITY.at_encoder("motor").at(size=2e-5))
    assert soft.joint is not None
    np.testing.assert_allclose(2e-5 * soft.joint, plain.softer(0, 2e-5).torque - plain.torque)
    unknown = replace(motion, springs=None)
    (slow,) = EFFECTS["backlash"].columns(unknown, 0, shape)
    assert slow.joint is not None
    assert EFFECTS["backlash"].plausible(np.array([1.1 * GAP]), shape)
    assert not EFFECTS["backlash"].plausible(np.array([5.0 * GAP]), shape)
