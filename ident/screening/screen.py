"""Doubts about sessions before anything is estimated from them: `screen`.

First the channels by themselves (`channels`), then the arm's own redundancy (`redundancy`, `explanations`): the joints
share their inertial parameters, motor and joint torque differ by a drive, gravity and acceleration act on the same
masses. The laws of motion come last: positive inertia, dissipative friction. The inertia of the URDF decides only in
orders of magnitude, and which of two gains is likelier that fit alike.

The thresholds lie between the scores of true faults and of wrong explanations of healthy data;
`python -m benchmarks.wrong_channels` holds them against both.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from fri.errors import LwrError
from ident.dynamics.kinematics import Chain
from ident.dynamics.parameters import INERTIAL, Floats
from ident.dynamics.regressor import rigid_regressor, torque
from ident.dynamics.structure import Coupling
from ident.estimators.problem import Problem
from ident.rows.content import Kept, Recall
from ident.rows.filters import SignalSettings
from ident.rows.sessions import payload_name, stated_mass
from ident.screening.channels import check_channels
from ident.screening.doubts import MEND_TIME, Doubt, settle
from ident.screening.explanations import AGREES, Explanation, explain, unit_of
from ident.screening.limits import check_limits
from ident.screening.normal_equations import FLOOR, Class, Fit, Normal, Part
from ident.screening.positions import KINDS, leaning, position_errors
from ident.screening.redundancy import Redundancy
from ident.screening.stuck import dead
from ident.screening.zeros import zero_by_gravity
from lwr_driver.session import Session, Sessions, as_sessions

logger = logging.getLogger(__name__)

# Fall of the score for a doubt: the product of all residuals falls to a tenth; for certainty, to a hundredth. Wrong
# explanations of healthy recordings reach 1.6 (two joints of a real LWR4+ with torques of 0.3 Nm), true faults 5.
_DOUBT, _CERTAIN = float(np.log(10.0)), float(np.log(100.0))
# Gains beyond a factor of two, and reversed signs, are no calibration; undone, they leave this share of the residual.
_FACTOR, _LEFT = 2.0, 0.6
# A gain, or an error in a part of the data: the product of the residuals falls to two thirds. Torques of 0.3 Nm at a
# real LWR4+'s wrist reach 0.33 with gains that are none.
_GAIN = float(np.log(1.5))
# A payload acts on all joints: the geometric mean of the residuals falls to a half.
_LABEL = float(np.log(2.0))
# Largest deviation of a load from its stated mass.
_MASS = 0.3
# Rows for each parameter, below which a fit explains anything.
_ROWS = 3.0
# Pass bands tried, over that of the settings: rows see the motion low-passed, and fast motion contradicts itself in a
# narrow band. Fall of the score for which a wider one is taken.
_BANDS, _CLEARER = (1.0, 2.5), 0.1
_POSES = 64
# Factor between an arm's gravity and its URDF's: 0.9 to 1.4 in six real arms. Correlation of gravity of the two, and
# number of joints, to speak of a factor.
_NOMINAL, _ALIKE, _SEVERAL = 4.0, 0.9, 3
# Standard deviations of a negative inertia, and least share of its torque in that of the joint.
_DEVIATIONS, _SHARE = 5.0, 0.1
# Drive inertias over their standard deviations, together (Stouffer) and of one joint at most: joint torque sensors of
# four real arms reach 0.7 together, motor torques of five simulated ones 6 to 20.
_DRIVES, _MOST_BY_ONE = 5.0, 10.0
_MEND_POSITION = (
    "check zero and gain of this channel (`offset_rad` and `scale` in the mapping of the import) and the joint's frame "
    "in the URDF"
)
# Latest screenings: the same recordings are estimated several times.
_MOST_SCREENED = 64


def screen(
    sessions: Sessions,
    chain: Chain,
    signals: SignalSettings | None = None,
    couplings: Sequence[Coupling] = (),
    *,
    motor: bool = True,
    recall: Recall | None = None,
) -> tuple[Doubt, ...]:
    """Doubts about the channels of the sessions of one arm.

    signals : as for `prepare`. couplings : coupled joints of the motor side. motor : False asks for no doubt about the
        motor torques; sound ones still tell of the other channels. recall : as for `prepare`.

    Raises ConfigurationError for sessions of other joints than the chain's.
    """
    chosen = [session.select(chain.joint_names) for session in as_sessions(sessions)]
    signals, recall = signals or SignalSettings(), recall or Recall()
    look = partial(_doubts, recall=recall)
    found = _screened.of(look, chosen, chain, signals, tuple(couplings))
    if motor or not any("motor" in doubt.channel + doubt.seen for doubt in found):
        return found
    return _screened.of(look, [replace(session, motor=None) for session in chosen], chain, signals, ())


_screened = Kept[tuple[Doubt, ...]](_MOST_SCREENED)


def _doubts(
    chosen: Sequence[Session],
    chain: Chain,
    signals: SignalSettings,
    couplings: Sequence[Coupling],
    *,
    recall: Recall,
) -> tuple[Doubt, ...]:
    doubts, beyond = check_channels(chosen, chain), check_limits(chosen, chain)
    if any(doubt.certain for doubt in (*doubts, *beyond)):
        # A certain fault bends everything computed from it.
        return (*doubts, *beyond)
    contradictions, least = list[Doubt](), np.inf
    for data in _in_bands(chosen, chain, signals, couplings, recall):
        told, left, agree = _contradictions(data, chosen)
        # The channels and their mending agree better in this band.
        if left < least - _CLEARER:
            contradictions, least = told, left
        if agree and not told:
            break
    found = [doubt for doubt in contradictions if not _shared(doubt, doubts)]
    return (*doubts, *found, *(doubt for doubt in beyond if not _shared(doubt, found)))


def _in_bands(
    sessions: Sequence[Session],
    chain: Chain,
    signals: SignalSettings,
    couplings: Sequence[Coupling],
    recall: Recall,
) -> Iterator[Redundancy]:
    """Rows of the sessions in each band with enough of them for a contradiction, the narrowest first."""
    for factor in _BANDS:
        wider = replace(
            signals,
            cutoff_hz=factor * signals.cutoff,
            decimate_hz=factor * signals.decimate,
            edge_s=signals.edge,
        )
        try:
            data = Redundancy.of(sessions, chain, wider, couplings, _silent(sessions), recall)
        except LwrError as error:
            # The fit itself says what is too short or does not move.
            logger.info("no screening by redundancy at %g Hz: %s", wider.decimate_hz, error)
            continue
        if data.rows and data.enough(_ROWS):
            yield data


def without_dead(problem: Problem, session: Session) -> Problem:
    """The rows of one session without those of its dead torque sensors."""
    names = session.joint_names
    silent = {(side, names[joint]) for side, joint in _silent([session])}
    kept = {k: group for k, group in enumerate(problem.groups) if (group.side, group.joint) not in silent}
    places = {old: new for new, old in enumerate(kept)}
    nuisances = tuple(
        replace(one, columns={places[k]: column for k, column in one.columns.items() if k in places})
        for one in problem.nuisances
    )
    return replace(problem, groups=tuple(kept.values()), nuisances=nuisances)


def _shared(doubt: Doubt, others: Sequence[Doubt]) -> bool:
    """Whether another doubt names the channel and one of the joints."""
    return any(one.channel == doubt.channel and set(one.joints) & set(doubt.joints) for one in others)


def require_sound(
    sessions: Sessions,
    chain: Chain,
    signals: SignalSettings | None = None,
    couplings: Sequence[Coupling] = (),
    *,
    motor: bool = True,
    recall: Recall | None = None,
) -> tuple[Doubt, ...]:
    """Doubts of `screen`. Raises DataError when one is certain."""
    doubts = screen(sessions, chain, signals, couplings, motor=motor, recall=recall)
    settle(doubts)
    return doubts


def _silent(sessions: Sequence[Session]) -> frozenset[Class]:
    return frozenset(
        (side, joint)
        for session in sessions
        for side, columns in (("joint", session.joint), ("motor", session.motor))
        for joint in dead(columns)
    )


def _contradictions(data: Redundancy, sessions: Sequence[Session]) -> tuple[list[Doubt], float, bool]:
    """Doubts, the score that is left with the explanations undone, and whether all joints agree as recorded."""
    normal = data.normal()
    fit = data.fit(normal)
    agree = max(fit.rho.values()) <= AGREES
    explanations = explain(data, fit, normal, _supported)
    explanations = [_of_the_wrong_label(_of_the_wrong_side(one), sessions) for one in explanations]
    found = [_doubt(one, sessions) for one in explanations]
    if explanations:
        data = explanations[-1].mended
        normal = data.normal()
        fit = data.fit(normal)
    found += _physics(data, normal.by_data)
    found = (
        found or _positions(data, fit, normal, sessions) or [*_zeros(data, fit, normal), *_of_motors(data)]
    )
    return found, fit.score, agree


def _positions(data: Redundancy, fit: Fit, normal: Normal, sessions: Sequence[Session]) -> list[Doubt]:
    """Small errors of positions; no certain ones, for drawing and arm may differ as well."""
    names = data.chain.joint_names
    return [
        Doubt(
            "position",
            (names[one.joint],),
            f"contradicts the torques of the other joints; {_better(one.drop)}",
            one.looks_like + _opposite(one.parts, sessions),
            MEND_TIME if one.kind == "delay" else _MEND_POSITION,
            False,
            sessions[one.parts[0][0]].path.name if one.parts else "",
        )
        for one in position_errors(data, fit, normal)
    ]


def _zeros(data: Redundancy, fit: Fit, normal: Normal) -> list[Doubt]:
    """A zero that the URDF's gravity tells alone; a base that leans looks like one."""
    try:
        nominal = data.chain.urdf_inertials()
    except LwrError:
        return []
    if data.chain.placeholder_masses():
        return []
    found = zero_by_gravity(data.chain, _poses(data), _bodies(data, fit), nominal)
    if found is None or leaning(data, fit, normal) > KINDS["offset"].drop:
        return []
    seen = (
        f"gravity differs from that of the URDF's bodies by {100.0 * found.before:.2g} %, by "
        f"{100.0 * found.after:.2g} % with it undone"
    )
    looks = f"a zero offset of {np.degrees(found.size):.0f} deg, or a centre of mass elsewhere"
    return [Doubt("position", (data.chain.joint_names[found.joint],), seen, looks, _MEND_POSITION)]


def _better(drop: float) -> str:
    return f"the residuals of all torques together fall by a factor of {np.exp(drop):.3g} with it undone"


def _of_the_wrong_side(one: Explanation) -> Explanation:
    """A factor between motor and joint torque of all joints: inertia tells its sign, the URDF's bodies its unit."""
    data = one.mended
    if one.gain is None or len(data.sides) < 2 or (len(one.joints) < 2 and one.factor > 0.0):
        return one
    scale = np.diag([one.factor if joint in one.joints else 1.0 for joint in range(data.chain.n)])
    turned = data
    for side in data.sides:
        turned = turned.mapped(side, scale)
    fits = [each.fit(each.normal().by_data) for each in (data, turned)]
    if len(one.joints) == 1:
        # The other joints may not tell its sign; the difference of its torques is friction and inertia of the drive.
        power = _friction(data, one.joints[0], ("motor",))
        first, second = (float(power @ fit.parameters) for fit in fits)
        other = first < 0.0 < second
    elif one.factor < 0.0:
        inertias = [
            _inertia(d.chain, _poses(d), _bodies(d, fit)) for d, fit in zip((data, turned), fits, strict=True)
        ]
        other = bool(np.sum(inertias[1] > 0.0) > np.sum(inertias[0] > 0.0))
    else:
        slopes = [list(_gravity_slopes(d, fit).values()) for d, fit in zip((data, turned), fits, strict=True)]
        if not slopes[0] or not slopes[1] or data.chain.placeholder_masses():
            return replace(one, channel="motor torque against joint torque")
        ratios = [abs(float(np.median(values))) for values in slopes]
        other = abs(np.log(ratios[1])) < abs(np.log(ratios[0]))
    if not other:
        return one
    channel = "joint torque" if one.channel == "motor torque" else "motor torque"
    factor = 1.0 / one.factor
    return replace(
        one, channel=channel, factor=factor, looks_like=unit_of(factor, torque=True), mended=turned
    )


def _of_the_wrong_label(one: Explanation, sessions: Sequence[Session]) -> Explanation:
    """Of two sessions with one label that explain the data alike the wrong one, by what more the other carries.

    The heavier one is no bare arm; without the load of the stated mass the lighter one is.
    """
    if one.channel != "payload" or len(one.alike) != 1:
        return one
    choices = {int(each.label): each for each in (one, *one.alike)}
    first, second = sorted(choices)
    labels = {payload_name(sessions[record]) for record in choices}
    more, std = _heavier_by(one.mended, first, second)
    if len(labels) != 1 or abs(more) < _DEVIATIONS * std:
        return one
    heavy, light = (first, second) if more > 0.0 else (second, first)
    if labels == {None}:
        return replace(choices[heavy], alike=())
    stated = stated_mass(sessions[light])
    if stated and abs(abs(more) / stated - 1.0) < _MASS:
        return replace(choices[light], alike=())
    return one


def _heavier_by(data: Redundancy, first: int, second: int) -> tuple[float, float]:
    """By how much one session's payload is heavier than another's [kg], and its standard deviation."""
    row = np.zeros((1, data.width))
    for record, sign in ((first, 1.0), (second, -1.0)):
        payload = next(rows.payload for rows in data.rows if rows.record == record)
        if payload is not None:
            place = len(INERTIAL) * (data.chain.n + data.payloads.index(payload)) + INERTIAL.index("M")
            row[0, place] += sign
    normal = data.normal()
    fit = data.fit(normal)
    return float(row[0] @ fit.parameters), float(data.deviation(fit, normal, row)[0])


def _supported(one: Explanation, classes: int) -> bool:
    """Whether an explanation gains enough to be believed."""
    if one.gain is not None or one.error is not None:
        return one.drop > _GAIN
    return one.drop > (_LABEL * classes if one.channel == "payload" else _DOUBT)


def _doubt(one: Explanation, sessions: Sequence[Session]) -> Doubt:
    names = sessions[0].joint_names
    joints = tuple(names[joint] for joint in one.joints)
    channel, session, looks_like = one.channel, "", one.looks_like
    certain = one.drop > _CERTAIN
    better = _better(one.drop)
    if one.gain is not None:
        seen = f"is {one.factor:.4g} times the torque computed from all other channels"
        if len(joints) == 1:
            seen = f"is {one.gain.value:.4g} ± {one.gain.std:.2g} times the torque computed from all other channels"
        if one.alike:
            either = {names[each.joints[0]]: each.factor for each in (one, *one.alike)}
            listed = " or ".join(f"{joint} is {factor:.4g} times" for joint, factor in either.items())
            joints, looks_like = tuple(either), "a gain of one of them"
            seen = (
                f"{listed} the torque computed from all other channels; both fit alike, the first is likelier"
            )
        strange = one.factor < 0.0 or abs(np.log(one.factor)) > np.log(_FACTOR)
        certain = strange and one.gain.left < _LEFT
        check = (
            "the sign of this channel and of the joint's position"
            if one.factor < 0.0 and len(one.mended.sides) == 1
            else "sign, unit and gain of this channel"
        )
        mend = f"check {check}; `scale` in the mapping of the import mends a known factor"
    elif one.parts and channel == "position":
        session = sessions[one.parts[0][0]].path.name
        seen = f"contradicts the torques and the other sessions; {better}"
        looks_like += _opposite(one.parts, sessions)
        mend = _MEND_POSITION
    elif one.parts:
        session, seen, certain = _of_part(one, sessions)
        mend = "check this channel there; the mapping of its import mends a known factor (`scale`) or order of columns"
        if one.error is not None and one.error.kind == "drift":
            mend = "leave the session out, or record it with warm electronics"
    elif channel == "payload" and one.alike:
        files = [sessions[int(each.label)].path.name for each in (one, *one.alike)]
        stated = payload_name(sessions[int(one.label)]) or "none"
        seen = f"one of {', '.join(sorted(files))} carries another payload than its label {stated!r} says; {better}"
        options = " or ".join(f"`--payload {file}=NAME`" for file in sorted(files))
        mend = f"name what is mounted in the one with the wrong label ({options}; `none`: the bare arm)"
        return Doubt(channel, joints, seen, "", mend, certain)
    elif channel == "payload":
        session = sessions[int(one.label)].path.name
        stated = payload_name(sessions[int(one.label)]) or "none"
        seen = f"the torques contradict the label {stated!r}; {better}"
        mend = f"name the mounted payload (`--payload {session}=NAME`, `none`: the bare arm)"
    elif channel == "mounting":
        seen = f"the torques contradict gravity down the URDF's z axis; {better}"
        mend = "add a root link with its z axis up to the URDF, and a fixed joint from it to the base"
    elif channel == "time":
        seen = f"accelerations and gravity contradict each other; {better}"
        mend = "check the sampling rate and the unit of time of the log"
    elif one.factor == 1.0:
        seen = f"contradicts the other channels; {better}"
        mend = "check the order of the columns of this channel, and its zero positions"
    else:
        seen = f"contradicts the other channels; {better}"
        mend = "check sign, unit and gain of this channel; `scale` in the mapping of the import mends a known factor"
    return Doubt(channel, joints, seen, looks_like, mend, certain, session)


def _of_part(one: Explanation, sessions: Sequence[Session]) -> tuple[str, str, bool]:
    """Session with its half, what was seen, and whether the data are worthless with it, for an error of some parts."""
    record, half = one.parts[0]
    session = sessions[record].path.name
    if len(one.parts) == 1:
        session += f", {('first', 'second')[half]} half"
    elif {other for other, _ in one.parts} != {record}:
        session = "all sessions"
    rest = "the torque computed from all other channels and the rest of the data"
    if one.error is None:
        seen = f"contradicts {rest}" if len(one.joints) > 1 else f"is about {one.factor:g} times {rest}"
        return session, seen, len(one.joints) == 1 or one.drop > _CERTAIN
    value, std = one.error.value, one.error.std
    if one.error.kind == "drift":
        way = "rises" if value > 0.0 else "falls"
        return session, f"{way} by {abs(value):.3g} ± {std:.2g} Nm from start to end against {rest}", False
    if one.error.kind == "zero":
        more = "higher" if value > 0.0 else "lower"
        either = ", or the other session's" if _is_either(one.parts, sessions) else ""
        return (
            session,
            f"is {abs(value):.3g} ± {std:.2g} Nm {more} than {rest} (its zero is wrong{either})",
            False,
        )
    gross = one.factor < 0.0 or abs(np.log(one.factor)) > np.log(_FACTOR)
    return session, f"is {value:.4g} ± {std:.2g} times {rest}", gross and one.error.left < _LEFT


def _is_either(parts: Sequence[Part], sessions: Sequence[Session]) -> bool:
    """Whether the parts are one whole session of two: with different zeros either may have the wrong one."""
    return len({half for _, half in parts}) == len(parts) == len(sessions) == 2


def _opposite(parts: Sequence[Part], sessions: Sequence[Session]) -> str:
    return ", or the opposite one in the other session" if _is_either(parts, sessions) else ""


def _poses(data: Redundancy) -> Floats:
    return np.concatenate([part.q[:: max(1, len(part.q) // _POSES)] for part in data.rows])


def _bodies(data: Redundancy, fit: Fit) -> Floats:
    return fit.parameters[: len(INERTIAL) * data.chain.n]


def _inertia_rows(chain: Chain, q: Floats) -> Floats:
    """Rows (n, 10 n) of the diagonal of the mass matrix, mean over the poses (N, n)."""
    still = np.zeros_like(q)
    rest = rigid_regressor(chain, q, still, still)
    rows = []
    for joint in range(chain.n):
        unit = still.copy()
        unit[:, joint] = 1.0
        rows.append(np.mean(rigid_regressor(chain, q, still, unit)[joint] - rest[joint], axis=0))
    return np.array(rows)


def _inertia(chain: Chain, q: Floats, bodies: Floats) -> Floats:
    return _inertia_rows(chain, q) @ bodies


def _physics(data: Redundancy, normal: Normal) -> list[Doubt]:
    """Inertia clearly negative, and gravity of another order than the URDF's."""
    fit = data.fit(normal)
    n, names = data.chain.n, data.chain.joint_names
    bodies = len(INERTIAL) * n
    rows = np.zeros((n, len(fit.parameters)))
    rows[:, :bodies] = _inertia_rows(data.chain, _poses(data))
    if data.sides == ("motor",):
        rows[np.arange(n), [data.place("Ia", joint) for joint in range(n)]] = 1.0
    inertia, std = rows @ fit.parameters, data.deviation(fit, normal, rows)
    shares = _acting(data, fit, dict(enumerate(inertia.tolist())))
    acting = np.array([shares.get(joint, 0.0) for joint in range(n)])
    sure = (np.abs(inertia) > _DEVIATIONS * std) & (acting > _SHARE)
    negative, positive = np.flatnonzero(sure & (inertia < 0.0)), np.flatnonzero(sure & (inertia > 0.0))
    if len(negative) > len(positive) and _without_inertia(data).score - fit.score > _DOUBT:
        listed = ", ".join(f"{names[j]} {inertia[j]:.3g} ± {std[j]:.2g} kg m^2" for j in negative)
        channel = " and ".join(f"{side} torque" for side in data.sides)
        looks, mend = (
            "a reversed sign of all torques, or of all positions",
            "`scale: -1` in the mapping of the import mends it",
        )
        return [Doubt(channel, names, f"the arm's inertia is negative ({listed})", looks, mend, True)]
    return [*_reversed(data, fit, normal, negative, inertia, std), *_nominal(data, fit)]


def _reversed(
    data: Redundancy, fit: Fit, normal: Normal, negative: NDArray[np.int64], inertia: Floats, std: Floats
) -> Iterator[Doubt]:
    """Single joints with a negative inertia: their torques and those of the others have nothing in common that would
    tell their sign. Certain where friction drives them, too. A torque that bodies and friction hardly explain, such as
    that of a light wrist with a cable, says nothing."""
    for joint in negative.tolist():
        if max(rho for (_, own), rho in fit.rho.items() if own == joint) > AGREES:
            continue
        power = _friction(data, joint, data.sides)
        driven = float(power @ fit.parameters) < -_DEVIATIONS * float(
            data.deviation(fit, normal, power[None])[0]
        )
        unit = "kg" if data.chain.prismatic[joint] else "kg m^2"
        yield Doubt(
            " and ".join(f"{side} torque" for side in data.sides),
            (data.chain.joint_names[joint],),
            f"its inertia is negative ({inertia[joint]:.3g} ± {std[joint]:.2g} {unit})"
            + (", and its friction drives it" if driven else ""),
            "a reversed sign of the torque or the position",
            "`scale: -1` in the mapping of the import mends it",
            driven,
        )


def _friction(data: Redundancy, joint: int, sides: Sequence[str]) -> Floats:
    """Row (p,) of the mean power [W] of a joint's friction, that of the links and of the drives for their sides."""
    row = np.zeros(data.width)
    for side, viscous, coulomb in (("joint", "Fvl", "Fcl"), ("motor", "Fvm", "Fcm")):
        parts = [part for part in data.rows if part.side == side] if side in sides else []
        if parts:
            speed = np.concatenate([part.qd[:, joint] for part in parts])
            sign = np.concatenate([part.sign[:, joint] for part in parts])
            row[data.place(viscous, joint)] = np.mean(speed**2)
            row[data.place(coulomb, joint)] = np.mean(speed * sign)
    return row


def _acting(data: Redundancy, fit: Fit, inertia: Mapping[int, float]) -> dict[int, float]:
    """Largest share of the inertia's torque in a joint's (rms), over its sides."""
    found = dict.fromkeys(inertia, 0.0)
    for side, joint in fit.rho:
        if joint in found:
            parts = [part for part in data.rows if part.side == side]
            torque_rms = np.sqrt(np.mean([np.var(part.torque[:, joint]) for part in parts]))
            speeding = np.sqrt(np.mean([np.mean(part.qdd[:, joint] ** 2) for part in parts]))
            found[joint] = max(found[joint], float(abs(inertia[joint]) * speeding / max(torque_rms, 1e-300)))
    return found


def _of_motors(data: Redundancy) -> list[Doubt]:
    """Drive inertia in joint torques that have no motor torques beside them.

    Sensors behind the gears have none. The inertia of the first two drives is not told from that of the links.
    """
    silent = frozenset(("motor", joint) for _, joint in data.silent)
    joints = [joint for joint in range(2, data.chain.n) if ("motor", joint) not in silent]
    if data.sides != ("joint",) or not joints:
        return []
    motor = replace(data, rows=tuple(replace(rows, side="motor") for rows in data.rows), silent=silent)
    normal = motor.normal()
    fit = motor.fit(normal)
    places = [motor.place("Ia", joint) for joint in joints]
    inertia, std = fit.parameters[places], motor.deviation(fit, normal, np.eye(motor.width)[places])
    acting = _acting(motor, fit, dict(zip(joints, inertia.tolist(), strict=True)))
    # What no sensor would feel is no drive, however sure.
    felt = np.array([acting[joint] for joint in joints]) > FLOOR
    seen = std > 0.0
    shares = np.clip(inertia[seen] / std[seen], -_MOST_BY_ONE, _MOST_BY_ONE)
    if not felt.any() or np.sum(shares) <= _DRIVES * np.sqrt(max(len(shares), 1)):
        return []
    names = data.chain.joint_names
    listed = ", ".join(
        f"{names[joint]} {value:.3g} ± {deviation:.2g} kg m^2"
        for joint, value, deviation, is_felt in zip(joints, inertia, std, felt, strict=True)
        if is_felt and value > 2.0 * deviation > 0.0
    )
    mend = (
        "import them as motor torques (`--torque motor`, or `motor_torque` in the mapping), so that the drives are in "
        "the model"
    )
    return [
        Doubt(
            "joint torque",
            names,
            f"has the inertia of the drives in it ({listed})",
            "motor torques",
            mend,
            False,
        )
    ]


def _nominal(data: Redundancy, fit: Fit) -> list[Doubt]:
    """Gravity against the URDF's, in joints with agreement but for a factor.

    Bodies of a URDF are often rough or missing; then they do not correlate, and nothing is said. Placeholders may
    correlate, and say nothing of the torques: they make no error.
    """
    slopes = _gravity_slopes(data, fit)
    if not slopes:
        return []
    middle = float(np.median(list(slopes.values())))
    if middle > 0.0 and abs(np.log(middle)) < np.log(_NOMINAL):
        return []
    channel = " and ".join(f"{side} torque" for side in data.sides)
    names = tuple(data.chain.joint_names[joint] for joint in slopes)
    looks = (
        unit_of(middle, torque=True)
        if middle > 0.0
        else "a reversed sign of all torques, or of all positions"
    )
    seen = f"gravity is {middle:.3g} times that of the URDF's bodies"
    mend = "state unit and sign of the torques when importing, or correct the URDF's masses"
    certain = len(slopes) >= _SEVERAL and (middle < 0.0 or abs(np.log(middle)) > 2.0 * np.log(_NOMINAL))
    if middle > 0.0 and (placeholder := data.chain.placeholder_masses()):
        looks, certain = f"placeholders: {placeholder}", False
        mend = "give a URDF with the manufacturer's masses, and look whether the torques are in Nm"
    return [Doubt(channel, names, seen, looks, mend, certain)]


def _gravity_slopes(data: Redundancy, fit: Fit) -> dict[int, float]:
    """Identified over nominal gravity torque of joints with correlated torques."""
    try:
        nominal = data.chain.urdf_inertials()
    except LwrError:
        return {}
    q = _poses(data)
    still = np.zeros_like(q)
    expected = torque(data.chain, q, still, still, nominal)
    computed = (rigid_regressor(data.chain, q, still, still) @ _bodies(data, fit)).T
    expected, computed = expected - expected.mean(axis=0), computed - computed.mean(axis=0)
    power, both = np.sum(expected**2, axis=0), np.sum(expected * computed, axis=0)
    size = np.sqrt(power * np.sum(computed**2, axis=0))
    # Only joints bearing a visible part of the arm.
    bearing = np.flatnonzero((power > 1e-4 * power.max()) & (power > 1e-12))
    return {int(j): float(both[j] / power[j]) for j in bearing if abs(both[j]) > _ALIKE * size[j]}


def _without_inertia(data: Redundancy) -> Fit:
    """The fit without accelerations: a slow motion says nothing about inertia."""
    still = replace(data, rows=tuple(replace(part, qdd=np.zeros_like(part.qdd)) for part in data.rows))
    return still.fit(still.normal().by_data)
