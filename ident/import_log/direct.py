"""Sessions from logs of any origin: session logs, and ROS 2 bags read as they are."""

from __future__ import annotations

import logging
import os
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from fri.errors import DataError
from ident.dynamics.session_chain import AS_RECORDED
from ident.import_log.bag import Bag, bag_files, read_bag
from ident.import_log.conversion import import_log
from ident.import_log.mapping import LogMapping, Signal, TimeBase, Unit
from lwr_driver.session import Session, read_session
from lwr_driver.session.writer import LIBRARY

logger = logging.getLogger(__name__)

_HEAD_BYTES = 256


def read_recording(path: str | os.PathLike[str], *, status: bool = True, motor: bool = False) -> Session:
    """The session in a session log, or in a ROS 2 bag: an MCAP file, or the folder of a split bag.

    From a bag, the topic of `sensor_msgs/JointState` with most arrays and joints is taken, `effort` as joint torque,
    header stamps as times if they rise with every message, else the recorder's times, equal ones spread. Joints with
    values missing are left out.
    motor : whether `effort` of a bag is the motors' torque, already at the joint, instead of the sensors'.
    status : as in `read_session`. Raises DataError for an unreadable file or a bag without torques.
    """
    source = Path(path)
    files = bag_files(source)
    if not files or (source.is_file() and _ours(source)):
        return read_session(source, status=status)
    bag = read_bag(source)
    if bag.is_session:
        return read_session(source, status=status)
    mapping = bag_mapping(bag, motor=motor)
    with tempfile.TemporaryDirectory() as folder:
        target = Path(folder) / f"{source.stem}.mcap"
        report = import_log(mapping, source, target, urdf=None)
        session = read_session(target, status=status)
    for turned in report.unwrapped:
        logger.warning("%s: %s", source.name, turned)
    metadata = {**session.metadata, "joints": AS_RECORDED}
    return replace(session, path=source, metadata=metadata, robot_description=bag.robot_description)


def bag_mapping(bag: Bag, *, motor: bool = False) -> LogMapping:
    """The mapping of a bag. motor : whether `effort` is the motors' torque, already at the joint."""
    states = bag.states[0]
    if not {"position", "effort"} <= set(states.values):
        found = "; ".join(f"{group.topic}: {', '.join(group.values) or 'names only'}" for group in bag.states)
        raise DataError(
            f"{bag.path}: no topic has `position` and `effort` ({found}); torques must be recorded"
        )
    whole = np.all([np.isfinite(values).all(axis=0) for values in states.values.values()], axis=0)
    joints = tuple(name for name, good in zip(states.names, whole, strict=True) if good)
    if not joints:
        raise DataError(f"{bag.path}: {states.topic} has missing values (nan) in every joint")
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
    with path.open("rb") as file:
        return LIBRARY.split()[0].encode() in file.read(_HEAD_BYTES)
