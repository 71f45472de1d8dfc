"""Compiled rigid bodies against pinocchio."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest

from fri.errors import ConfigurationError
from lwr_driver.arm import Arm
from sim_backend import bodies
from sim_backend.robot import Payload, with_payload


def _random_chain(seed: int) -> pin.Model:
    """Seven revolute joints about any axes, bodies of any shape, gravity in any direction."""
    random = np.random.default_rng(seed)
    model = pin.Model()
    for number in range(7):
        axis = random.normal(size=3)
        joint = pin.JointModelRevoluteUnaligned(axis / np.linalg.norm(axis))
        model.addJoint(number, joint, pin.SE3.Random(), f"joint{number}")
        model.appendBodyToJoint(number + 1, pin.Inertia.Random(), pin.SE3.Random())
    model.gravity.linear = random.normal(size=3) * 9.81
    return model


def _arm() -> pin.Model:
    return with_payload(
        pin.buildModelFromXML(Arm.load().urdf), Payload(3.0, MY=-0.2, MZ=0.4, XX=0.1, YY=0.1, ZZ=0.02)
    )


@pytest.mark.parametrize("seed", [None, 0, 1, 2])
def test_all_functions_give_the_numbers_of_pinocchio(seed: int | None) -> None:
    model = _arm() if seed is None else _random_chain(seed)
    data, random, tip = model.createData(), np.random.default_rng(7), pin.SE3.Random()
    chain = bodies.chain_of(model, tip)
    for _ in range(20):
        q, qd = random.uniform(-3.0, 3.0, 7), random.uniform(-2.0, 2.0, 7)
        torque, mass, place = np.empty(7), np.empty((7, 7)), np.empty(12)
        bodies.torques(chain, q, qd, torque)
        bodies.mass_matrix(chain, q, mass)
        bodies.pose(chain, q, place)
        assert torque == pytest.approx(pin.nonLinearEffects(model, data, q, qd), rel=1e-11, abs=1e-10)
        assert np.allclose(mass, pin.crba(model, data, q), rtol=1e-11, atol=1e-11)
        assert (mass == mass.T).all()
        pin.forwardKinematics(model, data, q)
        assert np.allclose(place.reshape(3, 4), (data.oMi[7] * tip).homogeneous[:3], rtol=0.0, atol=1e-12)


def test_other_joints_are_refused() -> None:
    model = pin.Model()
    model.addJoint(0, pin.JointModelPX(), pin.SE3.Identity(), "slide")
    model.appendBodyToJoint(1, pin.Inertia.Random(), pin.SE3.Identity())
    with pytest.raises(ConfigurationError, match="joint 1 of the model is JointModelPX; only serial chains"):
        bodies.chain_of(model)
