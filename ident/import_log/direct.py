"""Sessions from logs of any origin: session logs, and ROS 2 bags read as they are."""

from __future__ import annotations

import logging
import os
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from fri.errors import ConfigurationError, DataError
from ident.dynamics.session_chain import AS_RECORDED
from ident.dynamics.urdf import Urdf, read_urdf
from ident.import_log.bag import Bag, bag_files, read_bag
from ident.import_log.channels import MOST_MISSING
from ident.import_log.conversion import import_log
from ident.import_log.mapping import LogMapping, Signal, TimeBase, Unit
from ident.import_log.rests import rests, without_gripper
from lwr_driver.session import Session, read_session
from lwr_driver.session.container import MAGIC
from lwr_driver.session.writer import LIBRARY

logger = logging.getLogger(__name__)

_HEAD_BYTES = 256


def read_recording(
    path: str | os.PathLike[str],
    *,
    status: bool = True,
    motor: bool = False,
    joints: tuple[str, ...] = (),
    urdf: str | Path | None = None,
    base: str | None = None,
    tip: str | None = None,
) -> Session:
    """The session in a session log, or in a ROS 2 bag: an MCAP file, or the folder of a split bag.

    From a bag, the topic of `sensor_msgs/JointState` with most arrays and joints is taken, `effort` as joint torque,
    header stamps as times if they rise with every message, else the recorder's times, equal ones spread. Joints with
    most values missing are left out.
    motor : whether `effort` of a bag is the motors' torque, already at the joint, instead of the sensors'.
    joints : those of a bag that are the model's; others that act on them are held where they rest. Without, all, but a
        gripper at rest at the end of the arm.
    urdf : of a bag without its own, or instead of it. base, tip : first and last link of the arm in it.
    status : as in `read_session`. Raises DataError for an unreadable file or a bag without torques, and
    ConfigurationError for `joints` of a session log.
    """
    source = Path(path)
    files = bag_files(source)
    bag = None if not files or (source.is_file() and _ours(source)) else read_bag(source)
    if bag is None or bag.is_session:
        if joints:
            raise ConfigurationError(
                f"{source}: the joints of a session log were chosen at its import; leave --joints out, or give the "
                "recording itself"
            )
        if source.is_file() and source.suffix != ".mcap" and MAGIC not in _head(source):
            raise DataError(
                f"{source}: is no session log; `lwr-run import MAPPING {source} {source.stem}.mcap` makes one of it, "
                "and `lwr-run identify` guesses the mapping and imports it"
            )
        return read_session(source, status=status)
    mapping = bag_mapping(bag, motor=motor)
    described = urdf if urdf is not None else bag.robot_description
    robot = None if described is None else read_urdf(described)
    if robot is not None:
        mapping = _of_arm(mapping, bag, robot, joints, base, tip)
    elif joints:
        mapping = _with(mapping, bag, joints, {})
    chosen = bool(joints or mapping.held)
    with tempfile.TemporaryDirectory() as folder:
        target = Path(folder) / f"{source.stem}.mcap"
        report = import_log(mapping, source, target, urdf=None)
        session = read_session(target, status=status)
    for said in (*report.unwrapped, *report.left_out):
        logger.warning("%s: %s", source.name, said)
    more = {"robot": "" if robot is None else robot.name, **({} if chosen else {"joints": AS_RECORDED})}
    metadata = {**session.metadata, **more}
    return replace(session, path=source, metadata=metadata, robot_description=bag.robot_description)


def _of_arm(
    mapping: LogMapping, bag: Bag, robot: Urdf, joints: tuple[str, ...], base: str | None, tip: str | None
) -> LogMapping:
    """The mapping for the joints of an arm, others held where they rest."""
    names, position = bag.states[0].names, bag.states[0].values["position"]
    position = position[np.isfinite(position[:, [names.index(name) for name in mapping.joints]]).all(axis=1)]
    if not joints:
        known = {joint.name for joint in robot.joints if joint.movable}
        try:
            whole = robot.arm(names=[name for name in mapping.joints if name in known], root=base)
        except ConfigurationError:
            return mapping
        joints = without_gripper(whole, position[:, [names.index(name) for name in whole]], robot, base)
        if tip is not None or len(joints) == len(whole):
            return mapping
    robot.chain(base, tip, joints)
    found = rests(bag.path, names, position, joints, robot, base, tip)
    if found.moving:
        logger.warning(
            "%s: %s moves and is no joint of the model; held at its mean",
            bag.path.name,
            ", ".join(found.moving),
        )
    return _with(mapping, bag, joints, found.held)


def _with(mapping: LogMapping, bag: Bag, joints: tuple[str, ...], held: dict[str, float]) -> LogMapping:
    missing = [name for name in joints if name not in mapping.joints]
    if missing:
        raise ConfigurationError(
            f"{bag.path}: {bag.states[0].topic} has no joint {missing[0]!r} with its values; it has "
            f"{', '.join(mapping.joints)}"
        )
    signals = {name: replace(signal, columns=joints) for name, signal in mapping.signals.items()}
    return replace(mapping, joints=joints, held=held or None, **signals)  # type: ignore[arg-type]


def bag_mapping(bag: Bag, *, motor: bool = False) -> LogMapping:
    """The mapping of a bag. motor : whether `effort` is the motors' torque, already at the joint."""
    states = bag.states[0]
    if not {"position", "effort"} <= set(states.values):
        found = "; ".join(f"{group.topic}: {', '.join(group.values) or 'names only'}" for group in bag.states)
        raise DataError(
            f"{bag.path}: no topic has `position` and `effort` ({found}); torques must be recorded"
        )
    there = [np.isfinite(values).mean(axis=0) >= 1.0 - MOST_MISSING for values in states.values.values()]
    whole = np.all(there, axis=0)
    joints = tuple(name for name, good in zip(states.names, whole, strict=True) if good)
    if not joints:
        raise DataError(f"{bag.path}: {states.topic} has most values missing (nan) in every joint")
    units: dict[str, Unit] = {"position": "rad", "velocity": "rad/s", "effort": "Nm"}
    signals: dict[str, Any] = {
        name: Signal(unit, array=f"{states.topic}/{name}", columns=joints)
        for name, unit in units.items()
        if name in states.values
    }
    signals["motor_torque" if motor else "joint_torque"] = signals.pop("effort")
    return LogMapping(
        robot=bag.path.stem,
        joints=joints,
        time=TimeBase(column=f"{states.topic}/{states.clock}", zero="unix", equal="spread"),
        **signals,
    )


def _ours(path: Path) -> bool:
    return LIBRARY.split()[0].encode() in _head(path)


def _head(path: Path) -> bytes:
    with path.open("rb") as file:
        return file.read(_HEAD_BYTES)
