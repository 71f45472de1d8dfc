"""Doubts about sessions before anything is estimated from them: `screen`.

First the channels by themselves (`channels`), then the arm's own redundancy (`redundancy`, `explanations`): the joints
share their inertial parameters, motor and joint torque differ by a drive, gravity and acceleration act on the same
masses. Of explanations with the same fit the likelier is taken (`ambiguity`). The laws of motion come last (`physics`):
positive inertia, dissipative friction. The inertia of the URDF decides only in orders of magnitude, and between gains
with the same fit.

The thresholds lie between the scores of true faults and of wrong explanations of healthy data;
`python -m benchmarks.wrong_channels` holds them against both.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from fri.errors import LwrError
from ident.dynamics.kinematics import Chain
from ident.dynamics.structure import Coupling
from ident.estimators.problem import Problem
from ident.rows.content import Kept, Recall
from ident.rows.filters import SignalSettings
from ident.screening.ambiguity import of_the_wrong_label, of_the_wrong_side
from ident.screening.channels import check_channels
from ident.screening.doubts import MEND_POSITION, MEND_TIME, Doubt, settle
from ident.screening.explanations import AGREES, DOUBT, Explanation, explain
from ident.screening.limits import check_limits
from ident.screening.normal_equations import Class, Fit, Normal
from ident.screening.physics import bodies_of, drives_in_sensors, physics, poses
from ident.screening.positions import KINDS, leaning, position_errors
from ident.screening.redundancy import Redundancy
from ident.screening.statements import better, doubt_of, opposite
from ident.screening.stuck import dead
from ident.screening.zeros import zero_by_gravity
from lwr_driver.session import Session, Sessions, as_sessions

logger = logging.getLogger(__name__)

# A gain, or an error in a part of the data: the product of the residuals falls to two thirds. Torques of 0.3 Nm at a
# real LWR4+'s wrist reach 0.33 with gains that are none.
_GAIN = float(np.log(1.5))
# A payload acts on all joints: the geometric mean of the residuals falls to a half.
_LABEL = float(np.log(2.0))
# Least rows for each parameter: with fewer a fit explains anything.
_ROWS = 3.0
# Pass bands tried, over that of the settings: rows see the motion low-passed, and fast motion contradicts itself in a
# narrow band. Fall of the score for which a wider one is taken.
_BANDS, _CLEARER = (1.0, 2.5), 0.1
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
    doubts, beyond = check_channels(chosen, chain, recall=recall), check_limits(chosen, chain)
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
    """Doubts, the remaining score with the explanations undone, and whether all joints agree as recorded."""
    normal = data.normal()
    fit = data.fit(normal)
    agree = max(fit.rho.values()) <= AGREES
    explanations = explain(data, fit, normal, _supported)
    explanations = [of_the_wrong_label(of_the_wrong_side(one), sessions) for one in explanations]
    found = [doubt_of(one, sessions) for one in explanations]
    if explanations:
        data = explanations[-1].mended
        normal = data.normal()
        fit = data.fit(normal)
    found += physics(data, normal.by_data)
    found = (
        found
        or _positions(data, fit, normal, sessions)
        or [*_zeros(data, fit, normal), *drives_in_sensors(data)]
    )
    return found, fit.score, agree


def _positions(data: Redundancy, fit: Fit, normal: Normal, sessions: Sequence[Session]) -> list[Doubt]:
    """Small errors of positions; no certain ones, for drawing and arm may differ as well."""
    names = data.chain.joint_names
    return [
        Doubt(
            "position",
            (names[one.joint],),
            f"contradicts the torques of the other joints; {better(one.drop)}",
            one.looks_like + opposite(one.parts, sessions),
            MEND_TIME if one.kind == "delay" else MEND_POSITION,
            False,
            sessions[one.parts[0][0]].path.name if one.parts else "",
        )
        for one in position_errors(data, fit, normal)
    ]


def _zeros(data: Redundancy, fit: Fit, normal: Normal) -> list[Doubt]:
    """A wrong zero by the URDF's gravity alone; a leaning base looks like one."""
    try:
        nominal = data.chain.urdf_inertials()
    except LwrError:
        return []
    if data.chain.placeholder_masses():
        return []
    found = zero_by_gravity(data.chain, poses(data), bodies_of(data, fit), nominal)
    if found is None or leaning(data, fit, normal) > KINDS["offset"].drop:
        return []
    seen = (
        f"gravity differs from that of the URDF's bodies by {100.0 * found.before:.2g} %, by "
        f"{100.0 * found.after:.2g} % with it undone"
    )
    looks = f"a zero offset of {np.degrees(found.size):.0f} deg, or a centre of mass elsewhere"
    return [Doubt("position", (data.chain.joint_names[found.joint],), seen, looks, MEND_POSITION)]


def _supported(one: Explanation, classes: int) -> bool:
    """Whether an explanation gains enough to be believed."""
    if one.gain is not None or one.error is not None:
        return one.drop > _GAIN
    return one.drop > (_LABEL * classes if one.channel == "payload" else DOUBT)
