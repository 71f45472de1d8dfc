"""The nominal arm of the first healthy sets: the side of its positions, delays, stiffness, presliding."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from ident.diagnosis.causes.selection import select
from ident.diagnosis.gain.products import Floats
from ident.diagnosis.healthy.bench import UNSURE, mean_delay, prepare_bench
from ident.diagnosis.healthy.channel_delays import CHANNELS, channel_delays, common_delays
from ident.diagnosis.healthy.day_spread import compliance_std
from ident.diagnosis.healthy.presliding import presliding_length
from ident.diagnosis.healthy.reference import unsure
from ident.diagnosis.rows.nominal_arm import STATED_WITHIN, NominalArm
from ident.diagnosis.rows.recording import SessionRecord
from ident.diagnosis.settings import DiagnosisSettings
from ident.dynamics.base_set import BaseSet
from ident.dynamics.structure import EncoderSide
from ident.rows.delay import Delay
from lwr_driver.session import Session

log = logging.getLogger(__name__)

TUNING_SETS = 3
"""Number of the first sets that the arm is tuned to."""

# Rounds of a fit of stiffness and presliding.
_ROUNDS = 3
_LATEST_S = 0.02
# Share of the factor of a stated stiffness within which a fit is at its end.
_END = 1.05
# Least compliance of a joint of unknown stiffness, in its standard errors.
_TOLD = 2.0
# Least fall of the logarithm of the chi-square by encoders at the motors of such an arm.
_CLEARLY = 0.1


@dataclass(frozen=True, eq=False)
class SettledArm:
    """An arm settled on healthy sets. base : the base set of its rows. delays : of the channels, of each set, from rows
    away from reversals. late : the delays [s] by side that these agree on."""

    arm: NominalArm
    base: BaseSet
    delays: Sequence[Mapping[str, Sequence[Delay]]]
    late: Mapping[str, float]


def settled_arm(
    sets: Sequence[Sequence[Session]],
    recorded: Sequence[Sequence[SessionRecord]],
    arm: NominalArm,
    settings: DiagnosisSettings,
) -> SettledArm:
    """The arm with the side of its positions by the first set, and stiffness, presliding and delays by the first few.

    recorded : records of the sets. arm : by its description.
    """
    arm = replace(arm, encoder_known=True)
    if all(one.has_effort and one.has_motor for records in recorded for one in records):
        # One torque alone does not tell a twist from friction and inertia.
        arm = arm.of_unknown_stiffness()
    told, started = _of_side(sets[0], recorded[0], arm, settings)
    delays = [told, *(channel_delays(part, started, settings) for part in sets[1:TUNING_SETS])]
    late = common_delays(delays)
    first = _tuned(started, recorded[0], settings, _ROUNDS, late)
    several = [
        first,
        *(_tuned(first.arm, records, settings, 1, late) for records in recorded[1:TUNING_SETS]),
    ]
    known = with_compliance_std(
        _middle([tuned.arm for tuned in several]),
        [tuned.arm.compliance for tuned in several],
        [tuned.compliance_std for tuned in several if tuned.compliance_std is not None],
    )
    return SettledArm(known, first.base, delays, late)


def _of_side(
    sessions: Sequence[Session],
    records: Sequence[SessionRecord],
    arm: NominalArm,
    settings: DiagnosisSettings,
) -> tuple[Mapping[str, Sequence[Delay]], NominalArm]:
    """Delays of the channels in a set, and the arm with encoders at the side of less misfit, tuned to it."""
    sides: tuple[EncoderSide, ...] = ("link", "motor") if np.any(arm.anchor > 0.0) else ("link",)
    # Both sides in bins long enough to average the links' ringing, for a fair comparison.
    slow = replace(settings, bin_s=max(settings.bin_s, settings.ringing_s))
    # Of rigid joints the delays do not depend on the side.
    rigid = None if arm.compliance.any() else channel_delays(sessions, arm, settings)
    told, tuned = {}, {}
    for side in sides:
        arm_of_side = replace(arm, encoder=side)
        told[side] = channel_delays(sessions, arm_of_side, settings) if rigid is None else rigid
        tuned[side] = _tuned(arm_of_side, records, slow, 2, common_delays([told[side]]))
    side = _encoder(arm, {one: tuned[one].misfit for one in sides})
    log.info("positions of the %s", side)
    return told[side], tuned[side].arm


class _Tuned(NamedTuple):
    """Chi-square of a row, the arm, the standard deviation of its compliance by the set's rows, and the base set of its
    bench."""

    misfit: float
    arm: NominalArm
    compliance_std: Floats | None
    base: BaseSet


def _tuned(
    arm: NominalArm,
    recordings: Sequence[SessionRecord],
    settings: DiagnosisSettings,
    rounds: int,
    late: Mapping[str, float],
) -> _Tuned:
    """The arm with stiffness and presliding fitted to a set in turns, and the delays that `late` does not have.

    They are similar near a reversal, so they need a few rounds.
    """
    arm = replace(
        arm,
        motor_delay_s=late.get("motor", arm.motor_delay_s),
        joint_delay_s=late.get("joint", arm.joint_delay_s),
    )
    misfit = np.inf
    for _ in range(rounds):
        bench = prepare_bench(arm, recordings, settings, None, (), fit_compliance=True)
        evidence, base = bench.evidence, bench.nominal.base
        # An unknown delay of the channels belongs to the healthy arm, whatever it is.
        wide = (
            settings
            if bench.nominal.rows.keys() <= late.keys()
            else replace(settings, delay_tolerance_s=_LATEST_S)
        )
        deviations = select(bench.dictionary, wide, None).deviations
        count = max(sum(float(m.sum()) for m in evidence.mask.values()), 1.0)
        rms = [float(np.log(v).mean()) for v in evidence.sigma.values()]
        misfit = float(np.log(evidence.chi_square / count) + 2.0 * np.mean(rms))
        arm = replace(
            bench.nominal.arm,
            presliding=presliding_length(bench.nominal, evidence.full.values[: len(base)]),
        )
        arm = later(arm, {side: mean_delay(deviations, side)[0] for side in CHANNELS if side not in late})
    return _Tuned(misfit, arm, bench.compliance_std, base)


def _encoder(arm: NominalArm, misfits: Mapping[EncoderSide, float]) -> EncoderSide:
    """The side of the joints that the positions come from: that of the least misfit. Of an arm whose description states
    no stiffness, that of the motors has to be clearly less: a twist of any size takes something off."""
    motor = misfits.get("motor", np.inf) + (_CLEARLY if arm.within > STATED_WITHIN else 0.0)
    return "motor" if motor < misfits["link"] else "link"


def later(arm: NominalArm, by: Mapping[str, float]) -> NominalArm:
    """The arm with channels later by so much [s]."""
    return replace(
        arm,
        motor_delay_s=arm.motor_delay_s + by.get("motor", 0.0),
        joint_delay_s=arm.joint_delay_s + by.get("joint", 0.0),
    )


def _middle(arms: Sequence[NominalArm]) -> NominalArm:
    """The mean of tuned arms; of the presliding lengths the geometric one, 0 if most of them have none."""
    found = np.array([arm.presliding for arm in arms])
    seen = found > 0.0
    lengths = np.exp(np.sum(np.log(np.where(seen, found, 1.0)), axis=0) / np.maximum(seen.sum(axis=0), 1))
    return replace(
        arms[0],
        compliance=np.mean([arm.compliance for arm in arms], axis=0),
        motor_delay_s=float(np.mean([arm.motor_delay_s for arm in arms])),
        joint_delay_s=float(np.mean([arm.joint_delay_s for arm in arms])),
        presliding=np.where(2 * seen.sum(axis=0) > len(arms), lengths, 0.0),
    )


def with_compliance_std(arm: NominalArm, sets: Sequence[Floats], own: Sequence[Floats] = ()) -> NominalArm:
    """The arm with the standard error of its compliance from those of the sets (n,) [rad/Nm] and by each one's rows,
    and with the stated one, known to a factor, where encoders at the motors do not tell it: the sets do not agree on
    one, or end at that factor. Behind encoders at the links a stated one that no set shows is unknown, and so are one
    that no set was fitted to, and one softer than that factor allows. Without a stated one a joint is rigid where the
    sets do not clearly tell that it twists.
    """
    std = compliance_std(sets, own)
    if arm.stated is None:
        return replace(arm, compliance_std=std)
    if arm.stated.any() and not own and all(np.array_equal(one, arm.stated) for one in sets):
        return replace(arm, compliance_std=UNSURE * arm.stated)
    low, high = _END / arm.within * arm.stated, arm.largest_compliance / _END
    ends = np.any([(one < low) | (one > high) for one in sets], axis=0)
    if arm.within > STATED_WITHIN:
        told = ~ends & (arm.compliance > (0.0 if std is None else _TOLD * std))
        return replace(
            arm,
            compliance=np.where(told, arm.compliance, 0.0),
            compliance_std=None if std is None else np.where(told, std, 0.0),
        )
    if std is not None:
        # A joint that hardly moves tells nothing of its own.
        std = np.where(np.isfinite(std), std, UNSURE * arm.stated)
    if arm.encoder == "link":
        # A fit that ends at a rigid joint, or at the softest one, in every set does not differ from set to set.
        ended = (arm.compliance <= 0.0) | (arm.compliance >= high)
        ended &= arm.stated > 0.0
        # A joint softer than its description allows has taken up something else: a lag, or friction of another form.
        softer = (arm.compliance > arm.within * arm.stated) & (arm.stated > 0.0)
        return replace(
            arm,
            compliance=np.where(softer, arm.stated, arm.compliance),
            compliance_std=None if std is None else np.where(ended | softer, UNSURE * arm.stated, std),
        )
    # The fit of each set is held to the stated one as far as its rows do not tell.
    unknown = (arm.stated > 0.0) & (ends | unsure(arm.compliance, compliance_std(sets)))
    known = np.zeros(len(arm.stated)) if std is None else std
    if std is None and not unknown.any():
        return arm
    return replace(
        arm,
        compliance=np.where(unknown, arm.stated, arm.compliance),
        compliance_std=np.where(unknown, UNSURE * arm.stated, known),
    )
