"""Preflight: every condition of a motion, with its value and its limit, and the check of a swapped payload.

At rest, equation (1) is gravity plus friction and offset. Between two measurements the offset cancels, the arm's
own gravity follows from the nominal model, and the rest is the payload's weight:

    Δτ = G(q₂; payload₂) − G(q₁; payload₁) + Δfriction.

After approaches from opposite sides the friction of a joint may differ by twice its Coulomb torque, so the
tolerance has a constant part per joint.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pinocchio as pin

from fri.errors import RefusedError, RobotError
from fri.handshake import IdentificationHandshake, find_handshake
from lwr_driver.arm import Arm
from lwr_driver.arm.collision import CollisionChecker
from lwr_driver.driver import Driver
from lwr_driver.link import LinkState
from lwr_driver.listing import Listing, Piece, text_of
from lwr_driver.motion import Motion, extremes
from lwr_driver.realtime import Rights
from runner.computer import free_disk
from runner.experiment_file import Payload

Vector = npt.NDArray[np.float64]
Triple = tuple[float, float, float]

_RELATIVE_TOLERANCE = 0.15
_FRICTION_SHARE = 0.02
_BYTES_PER_CYCLE = 600.0
TORQUE_SHARE = 0.8
_GRAVITY_SHARE = 0.3
_GRAVITY_FLOOR = 0.03
_LOAD_SETTLES_S = 0.2
_LOAD_SHARE, _LOAD_FLOOR = 0.15, 0.01


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
    mass : best fit of the change at the announced centre of mass [kg]; nan in an insensitive pose.
    """

    measured: Vector
    predicted: Vector
    tolerance: Vector
    mass: float
    announced: Payload | None

    @property
    def ok(self) -> bool:
        """Every joint agrees within its tolerance."""
        return bool(np.all(np.abs(self.measured - self.predicted) <= self.tolerance))

    def summary(self) -> str:
        """The result in one line."""
        error = float(np.max(np.abs(self.measured - self.predicted)))
        weighs = (
            f", like {self.mass:.2f} kg at the announced centre of mass" if np.isfinite(self.mass) else ""
        )
        return f"static check of the payload: torques changed as announced within {error:.2f} Nm{weighs}"

    def reason(self, joint_names: tuple[str, ...]) -> str:
        """The worst joint, in one sentence with value, limit and advice."""
        excess = np.abs(self.measured - self.predicted) / self.tolerance
        worst = int(np.argmax(excess))
        name = "no payload" if self.announced is None else f"payload {self.announced.name!r}"
        weighs = "" if not np.isfinite(self.mass) else f"; the change corresponds to {self.mass:.2f} kg"
        return (
            f"{name} announced, but the torque of {joint_names[worst]} changed by "
            f"{self.measured[worst]:+.2f} Nm, expected {self.predicted[worst]:+.2f} ± "
            f"{self.tolerance[worst]:.2f} Nm{weighs}. "
            "Check the mounted payload, and its mass and com in the experiment file."
        )


def gravity_torque(arm: Arm, q: Vector, payload: Payload | None) -> Vector:
    """Gravity torque G(q) of the nominal arm with a payload welded to the last link, (n,) [Nm]."""
    model = loaded_model(arm, payload)
    return np.asarray(pin.computeGeneralizedGravity(model, model.createData(), q))


def loaded_model(arm: Arm, payload: Payload | None) -> pin.Model:
    """The nominal arm with a payload welded to the last link."""
    model = pin.buildModelFromXML(arm.urdf)
    if payload is not None:
        model.appendBodyToJoint(model.njoints - 1, payload.body(), pin.SE3.Identity())
    return model


def check_payload(arm: Arm, before: Rest, after: Rest) -> PayloadCheck:
    """Compare the change of the joint torques at rest with the prediction for the announced payloads.

    before, after : measurements at rest. Two per cent of the torque limit are allowed for the sensor and for
    friction on the link side, of unknown sign at rest.
    """
    measured = after.tau - before.tau
    predicted = gravity_torque(arm, after.q, after.payload) - gravity_torque(arm, before.q, before.payload)
    arm_moved = np.abs(gravity_torque(arm, after.q, None) - gravity_torque(arm, before.q, None))
    tolerance = _FRICTION_SHARE * arm.tau_max + _RELATIVE_TOLERANCE * (np.abs(predicted) + arm_moved)
    return PayloadCheck(measured, predicted, tolerance, _mass(arm, before, after), after.payload)


def _mass(arm: Arm, before: Rest, after: Rest) -> float:
    """Least-squares mass at the announced centre of mass [kg]."""
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
    """Load data of the controller: mass [kg], centre of mass in the flange frame [m] and inertia about it along
    its axes [kg m2]; zeros for the empty flange.
    """
    if payload is None:
        return 0.0, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
    model = pin.buildModelFromXML(arm.urdf)
    flange = model.frames[model.getFrameId("flange")].placement
    x, y, z = flange.actInv(np.asarray(payload.com)).tolist()
    xx, yy, zz = np.diag(flange.rotation.T @ payload.body().inertia @ flange.rotation).tolist()
    return payload.mass, (x, y, z), (xx, yy, zz)


def set_load(driver: Driver, arm: Arm, payload: Payload | None) -> str:
    """Send the load data of a payload, and check them by the gravity torques of the controller; returns the result.

    Raises ConfigurationError before anything is sent for load data that no payload can have, and RobotError if the
    gravity torques in the packets do not change as they must.
    """
    mass, com, inertia = load_data(arm, payload)
    before = driver.last_rows(1)[-1]["msr"].copy()
    driver.set_load(mass, com, inertia)
    handshake = find_handshake(driver.link.handshake)
    if not isinstance(handshake, IdentificationHandshake) or not np.any(before["gravity"]):
        return "load data sent; the controller reports no gravity torques, so they are not checked further"
    driver.monitor(max(10, round(_LOAD_SETTLES_S / driver.state().period_s)))
    after = driver.last_rows(1)[-1]["msr"]
    old = handshake.load(before)
    return check_gravity_change(
        arm,
        np.asarray(after["msr_jnt_pos"], dtype=np.float64),
        (np.asarray(before["gravity"], dtype=np.float64), np.asarray(after["gravity"], dtype=np.float64)),
        ((float(old[0]), 1e-3 * old[1:4]), (mass, np.asarray(com))),
    )


def check_gravity_change(
    arm: Arm,
    q: Vector,
    gravity: tuple[Vector, Vector],
    loads: tuple[tuple[float, Vector], tuple[float, Vector]],
) -> str:
    """The change of the controller's gravity torques by new load data against the nominal one, in a sentence.

    q : (n,) [rad], at rest. gravity : (n,) [Nm] in the packets before and after. loads : mass [kg] and centre of mass
    in the flange frame [m] before and after. The sign of the torques in the packet is that of the arm's own gravity.
    Raises RobotError with joint, value and limit.
    """
    before, after = (gravity_of_load(arm, q, *load) for load in loads)
    sign = 1.0 if float(gravity[0] @ before) >= 0.0 else -1.0
    expected, found = after - before, sign * (gravity[1] - gravity[0])
    allowed = _LOAD_SHARE * np.abs(expected) + _LOAD_FLOOR * arm.tau_max
    excess = np.abs(found - expected) / allowed
    joint = int(np.argmax(excess))
    if excess[joint] > 1.0:
        raise RobotError(
            f"load data of {loads[1][0]:g} kg: gravity torque of {arm.joint_names[joint]} in the controller changed by "
            f"{found[joint]:+.2f} Nm, expected {expected[joint]:+.2f} ± {allowed[joint]:.2f} Nm. They are not "
            "in force as sent; check the KRL program and the tool at the pendant, nothing moved"
        )
    largest = int(np.argmax(np.abs(expected)))
    return (
        f"load data in force: the controller's gravity torque of {arm.joint_names[largest]} changed by "
        f"{found[largest]:+.2f} Nm, expected {expected[largest]:+.2f} Nm"
    )


def gravity_of_load(arm: Arm, q: Vector, mass: float, com: Vector) -> Vector:
    """Gravity torque of the nominal arm with a mass [kg] at com in the flange frame, (3,) [m]; (n,) [Nm]."""
    model = pin.buildModelFromXML(arm.urdf)
    place = model.frames[model.getFrameId("flange")].placement
    model.appendBodyToJoint(model.njoints - 1, pin.Inertia(mass, np.asarray(com), np.zeros((3, 3))), place)
    return np.asarray(pin.computeGeneralizedGravity(model, model.createData(), q))


@dataclass(frozen=True)
class Item:
    """One condition: subject, value, limit, and advice for a failure."""

    subject: str
    value: str
    limit: str
    ok: bool
    advice: str = ""


@dataclass(frozen=True)
class Preflight:
    """The conditions in the order of their checks."""

    items: tuple[Item, ...]

    @property
    def ok(self) -> bool:
        """Every condition holds."""
        return all(item.ok for item in self.items)

    def pieces(self) -> list[Piece]:
        """The conditions as a table, and the advice for those that fail."""
        rows = [(one.subject, "ok" if one.ok else "FAIL", one.value, one.limit) for one in self.items]
        advice = [f"  → {one.subject}: {one.advice}" for one in self.items if not one.ok and one.advice]
        return [Listing(("condition", "", "value", "limit"), rows, 0), *advice]

    def __str__(self) -> str:
        return text_of(self.pieces())

    def __add__(self, other: Iterable[Item]) -> Preflight:
        return Preflight((*self.items, *other))

    def enforce(self) -> None:
        """Raise RefusedError with every failed condition; nothing may move then."""
        failed = [item for item in self.items if not item.ok]
        if failed:
            lines = [f"{item.subject}: {item.value}, limit {item.limit}. {item.advice}" for item in failed]
            raise RefusedError(f"preflight refuses the motion. {'; '.join(lines)}")

    def to_json(self) -> bytes:
        """The list as JSON, for the session log."""
        return json.dumps([asdict(item) for item in self.items], indent=1).encode()


def check_motion_limits(arm: Arm, motion: Motion) -> list[Item]:
    """Position, velocity, acceleration and jerk of every row as sent, against the arm's limits."""
    return [
        Item(
            f"{worst.quantity}",
            f"{worst.joint} {worst.value:.4g} {worst.unit} at t = {worst.time_s:.3f} s",
            f"{worst.limit:.4g} {worst.unit}",
            worst.ok,
            "lower `speed_scale`, or lengthen `period_s` of the excitation in the experiment file",
        )
        for worst in extremes(arm, motion)
    ]


def check_path(checker: CollisionChecker, motion: Motion, margin: float) -> Item:
    """The tightest moment of the motion against itself, the ground and the cell."""
    tightest = checker.check_path(motion.q, period_s=motion.period_s)
    return Item(
        "clearance",
        f"{1000 * tightest.distance:.0f} mm, {' to '.join(tightest.pair)}, t = {tightest.time_s:.2f} s",
        f"{1000 * margin:.0f} mm",
        tightest.distance >= margin,
        "choose another seed or home position, or correct the cell file",
    )


def check_torque(arm: Arm, motion: Motion, payload: Payload | None) -> Item:
    """Largest predicted share of a joint torque limit along the motion, by the nominal model."""
    model = loaded_model(arm, payload)
    data = model.createData()
    step = max(1, math.ceil(0.01 / motion.period_s))
    time, q = motion.period_s * step, motion.q[::step]
    if len(q) < 3:
        q = np.repeat(motion.q[:1], 3, axis=0)
    qd = np.gradient(q, time, axis=0)
    qdd = np.gradient(qd, time, axis=0)
    tau = np.array([pin.rnea(model, data, *row) for row in zip(q, qd, qdd, strict=True)])
    share = np.abs(tau) / arm.tau_max
    row, joint = np.unravel_index(int(np.argmax(share)), share.shape)
    return Item(
        "joint torque estimate",
        f"{arm.joint_names[joint]} {abs(tau[row, joint]):.1f} Nm at t = {row * time:.2f} s",
        f"{TORQUE_SHARE * arm.tau_max[joint]:.1f} Nm",
        bool(share[row, joint] <= TORQUE_SHARE),
        "slow the motion down or take a lighter payload",
    )


def check_start(arm: Arm, q: Vector, first: Vector, limit: float) -> Item:
    """Distance of the arm from the first row of the excitation, the length of the approach."""
    distance = np.abs(first - q)
    joint = int(np.argmax(distance))
    return Item(
        "distance to the start",
        f"{arm.joint_names[joint]} {distance[joint]:.2f} rad",
        f"{limit:.2f} rad",
        bool(distance[joint] <= limit),
        "move the arm nearer to its home position by hand guidance or with the pendant",
    )


def check_rights(rights: Rights, *, needed: bool) -> Item:
    """Real-time rights of the loop process; in lock step they do not matter."""
    lacking = "; ".join(shortage.what for shortage in rights.missing)
    return Item(
        "real-time rights",
        ("had" if needed else "not needed") if not lacking else f"missing: {lacking}",
        "had, or waived" if needed else "none",
        True,
    )


def check_link(state: LinkState) -> Item:
    """The controller's rating of the link, drives and errors."""
    good = state.quality in ("OK", "PERFECT") and not state.error
    return Item(
        "link",
        f"{state.quality}, answer rate {state.answer_rate:.3f}, drive errors 0x{state.error:02x}",
        "OK, 0x00",
        good,
        "close other programs, check the cable, acknowledge messages at the pendant",
    )


def check_gravity(arm: Arm, rest: Rest) -> Item:
    """Joint torques at rest against gravity of the nominal arm with its payload: signs, order, gross load.

    The sign of the sensors is not documented; a wrong sign fails here.
    """
    expected = gravity_torque(arm, rest.q, rest.payload)
    allowed = _GRAVITY_SHARE * np.abs(expected) + _GRAVITY_FLOOR * arm.tau_max
    excess = np.abs(rest.tau - expected) / allowed
    joint = int(np.argmax(excess))
    return Item(
        "torque at rest",
        f"{arm.joint_names[joint]} {rest.tau[joint]:+.2f} Nm",
        f"{expected[joint]:+.2f} ± {allowed[joint]:.2f} Nm",
        bool(excess[joint] <= 1.0),
        "check sign, order and zero of the torque sensors, and the mounted payload",
    )


def check_disk(folder: Path, cycles: int) -> Item:
    """Free disk space against the size of the log."""
    needed = 2.0 * _BYTES_PER_CYCLE * cycles + 50e6
    _, free = free_disk(folder)
    return Item(
        "free disk space",
        "enough" if free >= needed else f"{free / 1e6:.0f} MB",
        f"{needed / 1e6:.0f} MB",
        free >= needed,
        "make room on the disk of the results, or choose another --out",
    )
