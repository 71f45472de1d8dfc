"""Delays of the channels from rows away from reversals, where friction that turns later, like a delay, has no part."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence

import numpy as np

from fri.errors import DataError
from ident.diagnosis.healthy.reference import DELAY_STD_S, USUAL_DAYS, Reference
from ident.diagnosis.rows.nominal_arm import NominalArm
from ident.diagnosis.settings import DiagnosisSettings
from ident.estimation.identification import IdentificationSettings, Known
from ident.estimation.identify import observed
from ident.estimators.estimate import chi_square_tail, fisher_tail
from ident.rows.delay import Delay, weighted_mean
from lwr_driver.session import Session

log = logging.getLogger(__name__)

CHANNELS = ("motor", "joint")
ONE_IN = 0.0027
"""Largest probability of a late channel's delay on a healthy arm: three normal standard deviations."""
# Chance below which sessions scatter by more than their deviations.
_SCATTERED = 0.01


def channel_delays(
    sessions: Sequence[Session], arm: NominalArm, settings: DiagnosisSettings
) -> dict[str, list[Delay]]:
    """Delays of the channels as `identify` finds them: from rows away from reversals, where presliding, which looks
    like a delay, has no part. Without those that the rows do not tell.
    """
    wanted = IdentificationSettings(
        model=2 if any(session.motor is not None for session in sessions) else 1,
        estimator="wls",
        signals=arm.elastic(settings.signals),
        coulomb=settings.law,
        row_coulomb=settings.row_law,
        couplings=arm.couplings,
        essential=None,
    )
    known = Known(signal_reasons=("signal settings of the diagnosis",))
    try:
        prepared = observed(sessions, arm.chain, wanted, known=known).prepared
    except DataError as error:
        log.info("no delays from rows away from reversals: %s", error)
        return {}
    delays = {"motor": [one.delay for one in prepared], "joint": [one.joint_delay for one in prepared]}
    return {
        side: [one for one in own if one is not None and one.by_joint and one.std > 0.0]
        for side, own in delays.items()
    }


def common_delays(sets: Sequence[Mapping[str, Sequence[Delay]]]) -> dict[str, float]:
    """The delay of each channel [s] that the sets tell together, zero where it is none; without the sides that none of
    them tells."""
    found = {}
    for side in CHANNELS:
        told = [one for own in sets for one in own.get(side, ())]
        if told:
            mean, std, _ = mean_of(told)
            earliest = min(one.earliest for one in told)
            found[side] = Delay.of(mean, std, "", {}, 1.0, earliest).seconds
    return found


def sides_apart(
    sessions: Sequence[Session], arm: NominalArm, settings: DiagnosisSettings, reference: Reference
) -> dict[str, tuple[float, float]]:
    """Channels whose delay is not that of the healthy arm, with the difference and its standard deviation [s].

    In all rows friction that turns over another length looks late as well, so a gain there has to be more than on
    healthy days; these rows tell the two apart. The scatter of the sessions widens the deviation of their mean where it
    is more than theirs by chance: one that hardly tells a delay says nothing against one that does. The probability is
    that of Student's distribution, with the freedom of both deviations together (Welch and Satterthwaite), since that
    of the healthy delays comes from few days.
    """
    found = {}
    for side, told in channel_delays(sessions, arm, settings).items():
        if not told:
            continue
        mean, std, chi = mean_of(told)
        if chi_square_tail(chi**2 * (len(told) - 1), max(len(told) - 1, 1)) < _SCATTERED:
            std *= chi
        apart = mean - (arm.motor_delay_s if side == "motor" else arm.joint_delay_s)
        days = reference.delay_std_s.get(side, DELAY_STD_S) ** 2
        variance = std**2 + days
        freedom = (USUAL_DAYS + max(reference.sets, 1) - 1) * (variance / days) ** 2
        if fisher_tail(apart**2 / variance, 1, freedom) < ONE_IN:
            found[side] = apart, std
    return found


def mean_of(delays: Sequence[Delay]) -> tuple[float, float, float]:
    """Weighted mean of estimates, its standard deviation [s], and their scatter over their deviations, one at least."""
    return weighted_mean(np.array([one.estimate for one in delays]), np.array([one.std for one in delays]))
