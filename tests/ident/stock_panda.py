"""The Franka Panda as its maker ships it: seven joints, a hand, two prismatic fingers of which one mimics the other."""

from __future__ import annotations

JOINTS = tuple(f"panda_joint{k}" for k in range(1, 8))
_ORIGINS = (
    ("0 0 0.333", "0 0 0"),
    ("0 0 0", "-1.5707963 0 0"),
    ("0 -0.316 0", "1.5707963 0 0"),
    ("0.0825 0 0", "1.5707963 0 0"),
    ("-0.0825 0.384 0", "-1.5707963 0 0"),
    ("0 0 0", "1.5707963 0 0"),
    ("0.088 0 0", "1.5707963 0 0"),
)
_FINGERS = ("0 1 0", "0 -1 0")


def link(name: str, mass: float) -> str:
    """A link with a body off its axes."""
    return (
        f'<link name="{name}"><inertial><mass value="{mass}"/><origin xyz="0.01 0.02 {0.03 * mass}" rpy="0.1 0.2 0"/>'
        '<inertia ixx="0.05" ixy="0.001" ixz="0.002" iyy="0.06" iyz="-0.001" izz="0.04"/></inertial></link>'
    )


def joint(name: str, kind: str, parent: str, child: str, origin: tuple[str, str], extra: str = "") -> str:
    """A joint, about z unless `extra` has an axis."""
    axis = "" if "<axis" in extra else '<axis xyz="0 0 1"/>'
    limit = '<limit lower="-2.9" upper="2.9" velocity="2.2" effort="87"/>'
    return (
        f'<joint name="{name}" type="{kind}"><origin xyz="{origin[0]}" rpy="{origin[1]}"/><parent link="{parent}"/>'
        f'<child link="{child}"/>{axis}{limit}{extra}</joint>'
    )


def stock_panda(*, floating: bool = False, head: bool = False) -> str:
    """The URDF. floating : on a floating root. head : with a camera's pan and tilt joints on its base."""
    parts = [link("panda_link0", 2.8)]
    if floating:
        parts += [
            '<link name="world"/>',
            joint("free", "floating", "world", "panda_link0", ("0 0 0", "0 0 0")),
        ]
    for k, origin in enumerate(_ORIGINS, start=1):
        parts += [
            link(f"panda_link{k}", 4.0 - 0.4 * k),
            joint(f"panda_joint{k}", "revolute", f"panda_link{k - 1}", f"panda_link{k}", origin),
        ]
    parts += [
        '<link name="panda_link8"/>',
        joint("panda_joint8", "fixed", "panda_link7", "panda_link8", ("0 0 0.107", "0 0 0")),
        link("panda_hand", 0.73),
        joint("panda_hand_joint", "fixed", "panda_link8", "panda_hand", ("0 0 0", "0 0 -0.7853981")),
    ]
    for k, axis in enumerate(_FINGERS, start=1):
        follows = '<mimic joint="panda_finger_joint1"/>' if k == 2 else ""
        parts += [
            link(f"panda_finger{k}", 0.1),
            joint(
                f"panda_finger_joint{k}", "prismatic", "panda_hand", f"panda_finger{k}", ("0 0 0.0584", "0 0 0"),
                f'<axis xyz="{axis}"/>{follows}',
            ),
        ]  # fmt: skip
    if head:
        parts += [
            link("pan", 0.5), joint("head_pan", "revolute", "panda_link0", "pan", ("0 0.3 1", "0 0 0")),
            link("tilt", 0.4), joint("head_tilt", "revolute", "pan", "tilt", ("0 0 0.1", "1.5707963 0 0")),
        ]  # fmt: skip
    return f'<robot name="panda">{"".join(parts)}</robot>'
