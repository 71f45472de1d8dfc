"""The kinematic chain of a session: the joints it has measured, in the URDF it carries or one given."""

from __future__ import annotations

from pathlib import Path

from fri.errors import ConfigurationError
from ident.dynamics.kinematics import Chain
from ident.dynamics.urdf import read_urdf
from lwr_driver.session import Session


def session_chain(
    session: Session, urdf: str | Path | None = None, *, base: str | None = None, tip: str | None = None
) -> Chain:
    """Chain of the session's joints; joints of the URDF without measurements are held at zero.

    urdf : a path, or the text; default: the description in the session.
    base, tip : first and last link; default: those in the session's metadata, then root and last joint.

    A session with further joints, of a gripper not in the URDF say, does with the only chain of the URDF or the
    chain to `tip`, if it has measured all of it. Raises ConfigurationError for unknown names, with the nearest.
    """
    source = session.robot_description if urdf is None else urdf
    if source is None:
        raise ConfigurationError(f"{session.path}: holds no robot description; name the URDF with --urdf")
    root = base or session.metadata.get("base") or None
    end = tip or session.metadata.get("tip") or None
    read = read_urdf(source)
    measured = set(session.joint_names)
    try:
        only = [joint.name for joint in read.chain(root, end) if joint.driven]
        joints = only if measured.issuperset(only) else session.joint_names
    except ConfigurationError:
        joints = session.joint_names
    return Chain.from_urdf(source, root=root, tip=end, joints=joints)
