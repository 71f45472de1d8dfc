"""Preflight: every condition that must hold before the arm moves, each with its value and its limit."""

from __future__ import annotations

import json
import math
import shutil
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pinocchio as pin

from fri.errors import RefusedError
from lwr_driver.arm import Arm
from lwr_driver.arm.collision import CollisionChecker
from lwr_driver.link import LinkState
from lwr_driver.motion import Motion, extremes
from lwr_driver.realtime import Rights
from runner.experiment_file import Payload
from runner.payload import Rest, gravity_torque

__all__ = [
    "Item",
    "Preflight",
    "check_disk",
    "check_gravity",
    "check_link",
    "check_motion_limits",
    "check_path",
    "check_rights",
    "check_start",
    "check_torque",
]

Vector = npt.NDArray[np.float64]

BYTES_PER_CYCLE = 600.0
TORQUE_SHARE = 0.8
GRAVITY_SHARE = 0.3
GRAVITY_FLOOR = 0.03


@dataclass(frozen=True)
class Item:
    """One condition: what was looked at, what was found, what is allowed, and what to do if it fails."""

    subject: str
    value: str
    limit: str
    ok: bool
    advice: str = ""

    def __str__(self) -> str:
        mark = "ok  " if self.ok else "FAIL"
        text = f"{mark} {self.subject:<28} {self.value:<34} limit {self.limit}"
        return text if self.ok or not self.advice else f"{text}\n     → {self.advice}"


@dataclass(frozen=True)
class Preflight:
    """The list of conditions, in the order in which they were checked."""

    items: tuple[Item, ...]

    @property
    def ok(self) -> bool:
        """True where every condition holds."""
        return all(item.ok for item in self.items)

    def __str__(self) -> str:
        return "\n".join(str(item) for item in self.items)

    def __add__(self, other: Iterable[Item]) -> Preflight:
        return Preflight((*self.items, *other))

    def enforce(self) -> None:
        """Raise RefusedError that names every failed condition; nothing may move then."""
        failed = [item for item in self.items if not item.ok]
        if failed:
            lines = "; ".join(
                f"{item.subject}: {item.value}, limit {item.limit}. {item.advice}" for item in failed
            )
            raise RefusedError(f"preflight refuses the motion. {lines}")

    def to_json(self) -> bytes:
        """The list as JSON, for the session log."""
        return json.dumps([asdict(item) for item in self.items], indent=1).encode()


def check_motion_limits(arm: Arm, motion: Motion) -> list[Item]:
    """Position, velocity, acceleration and jerk of every row as it is sent, against the arm's limits."""
    items = []
    for worst in extremes(arm, motion):
        items.append(
            Item(
                f"{worst.quantity}",
                f"{worst.joint} {worst.value:.4g} {worst.unit} at t = {worst.time_s:.3f} s",
                f"{worst.limit:.4g} {worst.unit}",
                worst.ok,
                "lower `speed_scale`, or lengthen `period_s` of the excitation in the experiment file",
            )
        )
    return items


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
    """Largest share of the joint torque limit that the nominal model predicts along the motion."""
    model = pin.buildModelFromXML(arm.urdf)
    if payload is not None:
        model.appendBodyToJoint(model.njoints - 1, payload.body(), pin.SE3.Identity())
    data = model.createData()
    step = max(1, math.ceil(0.01 / motion.period_s))
    time = motion.period_s * step
    q = motion.q[::step]
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
    """Distance of the arm from the first row of the excitation, which the approach must bridge."""
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
    """The controller's own rating of the link, drives and errors."""
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

    The sign of the sensors is not documented; a joint whose torque opposes gravity gives itself away here.
    """
    expected = gravity_torque(arm, rest.q, rest.payload)
    allowed = GRAVITY_SHARE * np.abs(expected) + GRAVITY_FLOOR * arm.tau_max
    excess = np.abs(rest.tau - expected) / allowed
    joint = int(np.argmax(excess))
    return Item(
        "torque at rest",
        f"{arm.joint_names[joint]} {rest.tau[joint]:+.2f} Nm",
        f"{expected[joint]:+.2f} ± {allowed[joint]:.2f} Nm",
        bool(excess[joint] <= 1.0),
        "check sign, order and zero of the torque sensors, and what is mounted",
    )


def check_disk(folder: Path, cycles: int) -> Item:
    """Free space where the logs go, against what the motion will write."""
    needed = 2.0 * BYTES_PER_CYCLE * cycles + 50e6
    place = folder
    while not place.exists():
        place = place.parent
    free = shutil.disk_usage(place).free
    return Item(
        "free disk space",
        "enough" if free >= needed else f"{free / 1e6:.0f} MB",
        f"{needed / 1e6:.0f} MB",
        free >= needed,
        "make room on the disk of the results, or choose another --out",
    )
