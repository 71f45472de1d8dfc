"""The words of a doubt: an explanation of contradictory channels, and the check that it asks for."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ident.rows.sessions import payload_name
from ident.screening.doubts import MEND_POSITION, Doubt, DoubtKind
from ident.screening.explanations import CERTAIN, Explanation
from ident.screening.normal_equations import Part
from lwr_driver.session import Session

# Gains beyond a factor of two, and reversed signs, are no calibration; undone, they leave this share of the residual.
_FACTOR, _LEFT = 2.0, 0.6


def doubt_of(one: Explanation, sessions: Sequence[Session]) -> Doubt:
    """The doubt of an explanation: channel, observation, likely cause, remedy."""
    if one.gain is not None:
        return _of_gain(one, sessions)
    if one.channel == "payload" and one.alike:
        return _of_labels(one, sessions)
    joints = tuple(sessions[0].joint_names[joint] for joint in one.joints)
    channel, session, looks_like = one.channel, "", one.looks_like
    certain, fall = one.drop > CERTAIN, better(one.drop)
    if one.parts and channel == "position":
        session = sessions[one.parts[0][0]].path.name
        seen = f"contradicts the torques and the other sessions; {fall}"
        looks_like += opposite(one.parts, sessions)
        mend = MEND_POSITION
    elif one.parts:
        session, seen, certain = _of_part(one, sessions)
        mend = "check this channel there; the mapping of its import mends a known factor (`scale`) or order of columns"
        if one.error is not None and one.error.kind == "drift":
            mend = "leave the session out, or record it with warm electronics"
    elif channel == "payload":
        session = sessions[int(one.label)].path.name
        stated = payload_name(sessions[int(one.label)]) or "none"
        seen = f"the torques contradict the label {stated!r}; {fall}"
        mend = f"name the mounted payload (`--payload {session}=NAME`, `none`: the bare arm)"
    elif channel == "mounting":
        seen = f"the torques contradict gravity down the URDF's z axis; {fall}"
        mend = "add a root link with its z axis up to the URDF, and a fixed joint from it to the base"
    elif channel == "time":
        seen = f"accelerations and gravity contradict each other; {fall}"
        mend = "check the sampling rate and the unit of time of the log"
    elif one.factor == 1.0:
        seen = f"contradicts the other channels; {fall}"
        mend = "check the order of the columns of this channel, and its zero positions"
    else:
        seen = f"contradicts the other channels; {fall}"
        mend = "check sign, unit and gain of this channel; `scale` in the mapping of the import mends a known factor"
    return Doubt(channel, joints, seen, looks_like, mend, certain, session, kind=_kind(one))


def _of_gain(one: Explanation, sessions: Sequence[Session]) -> Doubt:
    """The doubt about a torque with another gain, or about the torques of several joints that explain it alike."""
    assert one.gain is not None
    names = sessions[0].joint_names
    joints, looks_like = tuple(names[joint] for joint in one.joints), one.looks_like
    rest = "the torque computed from all other channels"
    seen = f"is {one.factor:.4g} times {rest}"
    if len(joints) == 1:
        seen = f"is {one.gain.value:.4g} ± {one.gain.std:.2g} times {rest}"
    if one.alike:
        either = {names[each.joints[0]]: each.factor for each in (one, *one.alike)}
        listed = " or ".join(f"{joint} is {factor:.4g} times" for joint, factor in either.items())
        joints, looks_like = tuple(either), "a gain of one of them"
        seen = f"{listed} {rest}; both fit alike, the first is likelier"
    strange = one.factor < 0.0 or abs(np.log(one.factor)) > np.log(_FACTOR)
    check = (
        "the sign of this channel and of the joint's position"
        if one.factor < 0.0 and len(one.mended.sides) == 1
        else "sign, unit and gain of this channel"
    )
    mend = f"check {check}; `scale` in the mapping of the import mends a known factor"
    certain = strange and one.gain.left < _LEFT
    return Doubt(one.channel, joints, seen, looks_like, mend, certain, kind=_kind(one))


def _of_labels(one: Explanation, sessions: Sequence[Session]) -> Doubt:
    """The doubt about one of several sessions with the same label of their payload."""
    files = sorted(sessions[int(each.label)].path.name for each in (one, *one.alike))
    stated = payload_name(sessions[int(one.label)]) or "none"
    seen = f"one of {', '.join(files)} carries another payload than its label {stated!r} says; {better(one.drop)}"
    options = " or ".join(f"`--payload {file}=NAME`" for file in files)
    mend = f"name what is mounted in the one with the wrong label ({options}; `none`: the bare arm)"
    joints = tuple(sessions[0].joint_names[joint] for joint in one.joints)
    return Doubt(one.channel, joints, seen, "", mend, one.drop > CERTAIN)


def _kind(one: Explanation) -> DoubtKind:
    """Kind of a doubt about a torque."""
    if one.error is not None:
        return one.error.kind
    return "gain" if one.gain is not None else ""


def _of_part(one: Explanation, sessions: Sequence[Session]) -> tuple[str, str, bool]:
    """For an error of some parts: session with its half, observation, and whether the data are worthless with it."""
    record, half = one.parts[0]
    session = sessions[record].path.name
    if len(one.parts) == 1:
        session += f", {('first', 'second')[half]} half"
    elif {other for other, _ in one.parts} != {record}:
        session = "all sessions"
    rest = "the torque computed from all other channels and the rest of the data"
    if one.error is None:
        seen = f"contradicts {rest}" if len(one.joints) > 1 else f"is about {one.factor:g} times {rest}"
        return session, seen, len(one.joints) == 1 or one.drop > CERTAIN
    value, std, unit = one.error.value, one.error.std, one.mended.chain.torque_units[one.joints[0]]
    if one.error.kind == "drift":
        way = "rises" if value > 0.0 else "falls"
        return (
            session,
            f"{way} by {abs(value):.3g} ± {std:.2g} {unit} from start to end against {rest}",
            False,
        )
    if one.error.kind == "zero":
        more = "higher" if value > 0.0 else "lower"
        either = ", or the other session's" if _is_either(one.parts, sessions) else ""
        return (
            session,
            f"is {abs(value):.3g} ± {std:.2g} {unit} {more} than {rest} (its zero is wrong{either})",
            False,
        )
    gross = one.factor < 0.0 or abs(np.log(one.factor)) > np.log(_FACTOR)
    return session, f"is {value:.4g} ± {std:.2g} times {rest}", gross and one.error.left < _LEFT


def better(drop: float) -> str:
    """How much better all channels agree by a fall of the score."""
    return f"the residuals of all torques together fall by a factor of {np.exp(drop):.3g} with it undone"


def _is_either(parts: Sequence[Part], sessions: Sequence[Session]) -> bool:
    """Whether the parts are one whole session of two: with different zeros either may have the wrong one."""
    return len({half for _, half in parts}) == len(parts) == len(sessions) == 2


def opposite(parts: Sequence[Part], sessions: Sequence[Session]) -> str:
    """The other reading of an error in one of two sessions; "" for other parts."""
    return ", or the opposite one in the other session" if _is_either(parts, sessions) else ""
