"""Joints of the URDF between those of the model without a measurement."""

from __future__ import annotations

from collections.abc import Iterator

from ident.dynamics.kinematics import Chain
from ident.dynamics.urdf import read_urdf
from ident.screening.doubts import Doubt


def check_unmeasured(chain: Chain) -> Iterator[Doubt]:
    """A doubt about joints at zero in the chain for lack of a stated position."""
    names = unmeasured(chain)
    if not names:
        return
    one = len(names) == 1
    seen = (
        f"{', '.join(names)} {'lies' if one else 'lie'} between the joints of the model without a measurement and "
        f"{'is' if one else 'are'} taken to rest at 0"
    )
    mend = (
        "name every moving joint with its columns (`--joints`, `joints` in a mapping), and in `held` of a mapping "
        "where the others rest"
    )
    yield Doubt("kinematics", (), seen, "a joint left out" if one else "joints left out", mend)


def unmeasured(chain: Chain) -> tuple[str, ...]:
    """Movable joints of the URDF between the first and the last joint of the chain that are not in it.

    Joints coupled to another one (mimic) are left out.
    """
    if chain.urdf is None:
        return ()
    way = read_urdf(chain.urdf).chain(joints=chain.joint_names)
    places = [k for k, joint in enumerate(way) if joint.name in chain.joint_names]
    between = way[places[0] : places[-1]]
    return tuple(joint.name for joint in between if joint.driven and joint.name not in chain.joint_names)
