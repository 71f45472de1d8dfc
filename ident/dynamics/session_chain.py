"""The kinematic chain of a session: the joints it has measured, in the URDF it carries or one given."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from fri.errors import ConfigurationError
from ident.dynamics.kinematics import Chain
from ident.dynamics.urdf import Urdf, held, read_urdf
from lwr_driver.session import Session

AS_RECORDED = "as recorded"
"""Metadata `joints` of a session with the joints of a bag, which nobody has chosen."""


def session_chain(
    session: Session, urdf: str | Path | None = None, *, base: str | None = None, tip: str | None = None
) -> Chain:
    """Chain of the session's joints; others of the URDF are held, at zero or where they rested.

    urdf : a path, or the text; default: the description in the session.
    base, tip : first and last link; default: those in the session's metadata, then root and last joint.

    A session may have further joints, such as those of a gripper, if it has all of one arm of the URDF, or of the
    chain to `tip`; with the joints of a bag, that arm is meant anyhow.

    Raises ConfigurationError for unknown names, with the nearest.
    """
    source = session.robot_description if urdf is None else urdf
    if source is None:
        raise ConfigurationError(f"{session.path}: holds no robot description; name the URDF with --urdf")
    root = base or session.metadata.get("base") or None
    end = tip or session.metadata.get("tip") or None
    read = read_urdf(source)
    rests = recorded_rests(session.metadata)
    if rests:
        read = read_urdf(held(read.text, rests))
    whole = _whole_arm(read, session.joint_names, root, end)
    recorded = session.metadata.get("joints") == AS_RECORDED
    if whole is not None and recorded:
        return Chain.from_urdf(read.text, root=root, tip=end, joints=whole)
    try:
        return Chain.from_urdf(read.text, root=root, tip=end, joints=session.joint_names)
    except ConfigurationError:
        if whole is None:
            if recorded and end is None:
                # Its error has the arms to choose from.
                read.arm(names=session.joint_names, root=root)
            raise
        return Chain.from_urdf(read.text, root=root, tip=end, joints=whole)


def recorded_rests(metadata: Mapping[str, str]) -> dict[str, float]:
    """Positions of joints that rested during an imported session and are no coordinates of it [rad or m]."""
    pairs = (entry.partition("=") for entry in metadata.get("held", "").split())
    return {name: float(value) for name, _, value in pairs}


def _whole_arm(
    read: Urdf, measured: tuple[str, ...], root: str | None, tip: str | None
) -> tuple[str, ...] | None:
    """The one arm with all its joints among the measured ones, or None."""
    try:
        if tip is None:
            return read.arm(names=measured, root=root)
        joints = tuple(joint.name for joint in read.chain(root, tip) if joint.driven)
        return joints if set(joints) <= set(measured) else None
    except ConfigurationError:
        return None
