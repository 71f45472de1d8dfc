"""A body added to the last link, and a force on the arm: columns and simulation."""

from __future__ import annotations

from typing import Any

import numpy as np

from ident.dynamics import regressor
from ident.dynamics.kinematics import Chain
from ident.effects.effect import Column, Simulated
from ident.effects.motion import Floats, Motion

__all__ = [
    "Body",
    "Sliding",
    "body_columns",
    "force_torque",
    "inertia_columns",
    "leaning",
    "plant_jacobian",
    "slide",
]

# Places of M, MX, MY, MZ among the ten inertial parameters.
_PLACES = (9, 6, 7, 8)
# Coefficient of friction below which a loose part slides.
_FRICTION = 0.3


def body_columns(motion: Motion, count: int) -> tuple[Column, ...]:
    """Torque of a unit mass and of unit first moments (in this order) in the last link's frame, all rows."""
    columns = []
    for place in _PLACES[:count]:
        bodies = np.zeros_like(motion.bodies)
        bodies[-1, place] = 1.0
        torque = motion.rigid_torque(motion.q, motion.qd, motion.qdd, bodies)
        columns.append(Column(motor=torque, joint=torque))
    return tuple(columns)


def inertia_columns(motion: Motion) -> list[Floats]:
    """Torque (N, n) of each unit moment and product of inertia of the last link about its origin."""
    found = []
    for place in range(6):
        bodies = np.zeros_like(motion.bodies)
        bodies[-1, place] = 1.0
        found.append(motion.rigid_torque(motion.q, motion.qd, motion.qdd, bodies))
    return found


def force_torque(chain: Chain, q: Floats, axis: int, link: int) -> Floats:
    """Torque (N, n) [Nm] that a unit force along a base axis at the end of `link` (from 1) puts on
    the joints.

    The end of a link is the origin of the next frame, of the last link a point 0.1 m along its z axis. It is
    the gravity torque of a unit mass there, in a field of one unit along the axis, with its sign turned.
    """
    from dataclasses import replace

    field = np.zeros(3)
    field[axis] = 1.0
    bodies = np.zeros((chain.n, 10))
    bodies[link - 1, 9] = 1.0
    bodies[link - 1, 6:9] = _end(chain, link)
    return -regressor.gravity_torque(replace(chain, gravity=field), q, bodies)


def _end(chain: Chain, link: int) -> Floats:
    """The end of a link in its own frame, (3,) [m]."""
    if link >= chain.n:
        return np.array([0.0, 0.0, 0.1])
    alpha, d, r = chain.alpha[link], chain.d[link], chain.r[link]
    return np.array([d, -np.sin(alpha) * r, np.cos(alpha) * r])


def plant_jacobian(plant: Any, link: int) -> Floats:
    """Jacobian (3, n) of the end of a link of a simulated arm, in axes of the base."""
    import pinocchio as pin

    model, data = plant.model, plant.model.createData()
    pin.computeJointJacobians(model, data, plant.position)
    pin.updateGlobalPlacements(model, data)
    place = data.oMi[link]
    point = np.array([0.0, 0.0, 0.1]) if link >= model.nv else model.jointPlacements[link + 1].translation
    full = pin.getJointJacobian(model, data, link, pin.ReferenceFrame.LOCAL_WORLD_ALIGNED)
    lever = place.rotation @ point
    return np.asarray(full[:3] + np.cross(full[3:].T, lever).T)


class Body(Simulated):
    """Mass and first moments (4,) on the last link of a simulated arm from a time on: gravity and inertia."""

    def __init__(self, values: Floats, since_s: float) -> None:
        self.values, self.since_s = values, since_s
        self.speed: Any = None

    def load(self, time_s: float, plant: Any, loads: Any) -> None:
        """Gravity and inertia forces of the body at the present motion."""
        import pinocchio as pin

        before, self.speed = self.speed, plant.velocity.copy()
        if time_s < self.since_s or before is None:
            return
        model = plant.model.copy()
        for link in range(1, model.njoints):
            model.inertias[link] = pin.Inertia.Zero()
        mass, *moments = self.values * self.shares(plant)
        model.inertias[model.njoints - 1] = pin.Inertia.FromDynamicParameters(
            np.array([mass if abs(mass) > 1e-9 else 1e-9, *moments, 0, 0, 0, 0, 0, 0], dtype=float)
        )
        thrust = (self.speed - before) / plant.cycle_s
        loads.link_torque -= pin.rnea(model, model.createData(), plant.position, plant.velocity, thrust)

    def shares(self, plant: Any) -> Floats:
        """Factors (4,) of mass and first moments in the present pose."""
        return np.ones(4)


class Sliding(Body):
    """The same of a body that slides along the last link's axes to where gravity pulls it."""

    def shares(self, plant: Any) -> Floats:
        """See `slide`."""
        import pinocchio as pin

        data = plant.model.createData()
        pin.forwardKinematics(plant.model, data, plant.position)
        down = np.array(plant.model.gravity.linear)
        lean = data.oMi[plant.model.nv].rotation.T @ down / np.linalg.norm(down)
        return np.append(1.0, slide(lean))


def slide(lean: Floats) -> Floats:
    """Place of a loose body along an axis, -1 to 1, for the component of the direction of gravity along it.

    On a slope beyond that of friction it lies at the lower end; on a smaller one it may be anywhere between.
    """
    return np.tanh(lean / _FRICTION)


def leaning(motion: Motion) -> Floats:
    """Components (N, 3) of the direction of gravity along the axes of the last link."""
    chain = motion.chain
    turned = np.broadcast_to(
        chain.base_placement[:3, :3].T @ (chain.gravity / np.linalg.norm(chain.gravity)),
        (motion.q.shape[0], 3),
    )
    for joint in range(chain.n):
        # Into the joint's frame before it turns, then against its turn.
        fixed = turned @ chain.placement(joint)[:3, :3]
        angle = np.zeros(len(motion.q)) if chain.prismatic[joint] else motion.q[:, joint]
        c, s = np.cos(angle), np.sin(angle)
        turned = np.column_stack(
            [c * fixed[:, 0] + s * fixed[:, 1], c * fixed[:, 1] - s * fixed[:, 0], fixed[:, 2]]
        )
    return turned
