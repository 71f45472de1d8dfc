"""The payload swap: did the joint torques at rest change as the announced payload says they must?

At rest, equation (1) is gravity plus friction and offset. Between two measurements the offset cancels, what
the arm's own gravity contributes follows from the nominal model, and what remains is the payload's weight:

    Δτ = G(q₂; payload₂) − G(q₁; payload₁) + Δfriction.

The friction of a joint that came to rest from the other side may differ by up to twice its Coulomb torque,
therefore the tolerance has a constant part per joint.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import pinocchio as pin

from lwr_driver.arm import Arm
from runner.experiment_file import Payload

__all__ = ["PayloadCheck", "Rest", "check_payload", "gravity_torque", "load_data"]

Vector = npt.NDArray[np.float64]
Triple = tuple[float, float, float]

RELATIVE_TOLERANCE = 0.15
FRICTION_SHARE = 0.02


@dataclass(frozen=True)
class Rest:
    """The arm at rest: mean joint position q [rad] and joint torque tau [Nm], (n,) each, and its payload."""

    q: Vector
    tau: Vector
    payload: Payload | None


@dataclass(frozen=True)
class PayloadCheck:
    """Result of the static check.

    measured, predicted, tolerance : (n,) torque change per joint [Nm].
    mass : kg that explain the change best at the announced centre of mass; nan where the pose hides it.
    """

    measured: Vector
    predicted: Vector
    tolerance: Vector
    mass: float
    announced: Payload | None

    @property
    def ok(self) -> bool:
        """True where every joint agrees within its tolerance."""
        return bool(np.all(np.abs(self.measured - self.predicted) <= self.tolerance))

    def summary(self) -> str:
        """The result in one line."""
        error = float(np.max(np.abs(self.measured - self.predicted)))
        weighs = (
            "" if not np.isfinite(self.mass) else f", like {self.mass:.2f} kg at the announced centre of mass"
        )
        return f"static check of the payload: torques changed as announced within {error:.2f} Nm{weighs}"

    def reason(self, joint_names: tuple[str, ...]) -> str:
        """What disagrees, in one sentence with value, limit and advice."""
        excess = np.abs(self.measured - self.predicted) / self.tolerance
        worst = int(np.argmax(excess))
        name = "no payload" if self.announced is None else f"payload {self.announced.name!r}"
        weighs = "" if not np.isfinite(self.mass) else f"; the change is that of about {self.mass:.2f} kg"
        return (
            f"{name} announced, but the torque of {joint_names[worst]} changed by "
            f"{self.measured[worst]:+.2f} Nm where {self.predicted[worst]:+.2f} ± "
            f"{self.tolerance[worst]:.2f} Nm is expected{weighs}. "
            "Check what is mounted and the payload's mass and com in the experiment file."
        )


def gravity_torque(arm: Arm, q: Vector, payload: Payload | None) -> Vector:
    """Gravity torque G(q) of the nominal arm with a payload welded to the last link, (n,) [Nm]."""
    model = pin.buildModelFromXML(arm.urdf)
    if payload is not None:
        model.appendBodyToJoint(model.njoints - 1, payload.body(), pin.SE3.Identity())
    return np.asarray(pin.computeGeneralizedGravity(model, model.createData(), q))


def check_payload(arm: Arm, before: Rest, after: Rest) -> PayloadCheck:
    """Compare the change of the joint torques at rest with the one that the announced payloads predict.

    before, after : measurements at rest. Two per cent of the torque limit are allowed for the friction on
    the link side, whose sign at rest is not known, and for the sensor.
    """
    bare_before = gravity_torque(arm, before.q, None)
    bare_after = gravity_torque(arm, after.q, None)
    measured = after.tau - before.tau
    predicted = gravity_torque(arm, after.q, after.payload) - gravity_torque(arm, before.q, before.payload)
    arm_moved = np.abs(bare_after - bare_before)
    tolerance = FRICTION_SHARE * arm.tau_max + RELATIVE_TOLERANCE * (np.abs(predicted) + arm_moved)
    return PayloadCheck(measured, predicted, tolerance, _mass(arm, before, after), after.payload)


def _mass(arm: Arm, before: Rest, after: Rest) -> float:
    """Mass at the announced centre of mass that explains the torque change best (least squares) [kg]."""
    payload = after.payload if after.payload is not None else before.payload
    if payload is None:
        return float("nan")
    unit = Payload("unit", 1.0, payload.com)
    per_kg = gravity_torque(arm, after.q, unit) - gravity_torque(arm, after.q, None)
    if float(np.linalg.norm(per_kg)) < 0.5:
        return float("nan")
    carried = gravity_torque(arm, before.q, before.payload)
    change = after.tau - before.tau - gravity_torque(arm, after.q, None) + carried
    return float(per_kg @ change / (per_kg @ per_kg))


def load_data(arm: Arm, payload: Payload | None) -> tuple[float, Triple, Triple]:
    """Mass [kg], centre of mass in the flange frame [m] and inertia about it along its axes [kg m2], as the
    controller wants them; zeros for the empty flange.
    """
    if payload is None:
        return 0.0, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
    model = pin.buildModelFromXML(arm.urdf)
    flange = model.frames[model.getFrameId("flange")].placement
    com = flange.actInv(np.asarray(payload.com))
    tensor = flange.rotation.T @ payload.body().inertia @ flange.rotation
    return payload.mass, _triple(com), _triple(np.diag(tensor))


def _triple(values: Vector) -> Triple:
    x, y, z = (float(value) for value in values)
    return x, y, z
