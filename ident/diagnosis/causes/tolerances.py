"""Deviations of the nominal arm that are no finding: columns of the base beside every cause.

Delays of a millisecond, joint stiffness, and, against a reference, what differs from day to day: the gains of the
torque sensors, the presliding lengths of the drives, and the sizes of the healthy arm's own effects.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum
from typing import Any

import numpy as np

from ident.diagnosis.causes.candidates import Candidate, Dictionary
from ident.diagnosis.gain.evidence import Evidence
from ident.diagnosis.gain.products import Rows
from ident.diagnosis.gain.size import USUAL_CHANGES
from ident.diagnosis.rows.nominal_arm import GAIN_STD, NominalArm
from ident.diagnosis.settings import DiagnosisSettings
from ident.effects import (
    DELAYS,
    ELASTICITY,
    PRESLIDING,
    SENSOR_GAIN,
    Column,
    Effect,
    Shape,
    find_effect,
    parameter_values,
)
from ident.effects.motion import ArmMotion

# Factor on the tolerance for a whole channel's delay with a known healthy delay.
_KNOWN_DELAY = 0.4
# The same for a stiffness behind published motors.
_KNOWN_COMPLIANCE = 0.4
# Largest error of a healthy arm's compliance, in standard errors: to a factor of two of a stated one.
_ERRORS = 2.0
# Largest factor on a presliding length from day to day, and that of the two lengths of its column.
_LONGEST, _APART = 5.0, 1.5
# Largest share of friction that turns, with some room.
_WHOLE = 1.3
# Least gain and size in the models, in standard deviations and in those of a gain from day to day.
_CLEAR, _MATTERS = 2.0, 0.5
# Standard deviation of a further day from the mean of two, over that of a day.
_FURTHER = 1.5**0.5

_LATE = tuple(effect.cause for effect in DELAYS.values())

HABITUAL = 3.0
"""Largest change from day to day, in standard deviations."""


class Kind(Enum):
    """What a tolerated deviation is of."""

    DELAY = "delay"
    COMPLIANCE = "compliance"
    GAIN = "gain"
    """Of a torque sensor."""
    LENGTH = "presliding"
    """The logarithm of the factor on the presliding length of a drive."""
    TURNING = "turning"
    """The share of a drive's friction that turns over the usual length, where its own is unknown."""
    SIZE = "size"
    """Of one of the healthy arm's own effects, as a share of it."""
    HABIT = "habit"
    """A candidate of a gain as on healthy days."""


@dataclass(frozen=True, eq=False)
class Tolerance:
    """A tolerated deviation. number : of its joint, of the healthy effect or of the habit, from 0; -1 for a whole
    channel. unit : of the coefficient. size : the largest. of : the candidate with these rows.
    """

    kind: Kind
    number: int
    rows: Rows
    size: float
    of: tuple[str, int] | None = None
    unit: float = 1.0

    @property
    def name(self) -> str:
        """In short, once in an arm."""
        if self.kind is Kind.HABIT and self.of is not None:
            cause, joint = self.of
            return f"{self.kind.value} {self.number + 1}: {cause} {joint + 1}"
        if self.kind is not Kind.DELAY:
            return f"{self.kind.value} {self.number + 1}"
        return f"{self.channel} delay" if self.channel else f"delay of joint {self.number + 1} apart"

    @property
    def cause(self) -> str | None:
        """Of the candidate with these rows."""
        return None if self.of is None else self.of[0]

    @property
    def channel(self) -> str | None:
        """The channel that is late as a whole; None for other deviations."""
        if self.kind is not Kind.DELAY or self.cause is None:
            return None
        return find_effect(self.cause).channel

    @property
    def delays(self) -> bool:
        """Whether it delays torques: no torque of its own."""
        return self.kind is Kind.DELAY or self.cause in _LATE


@dataclass(frozen=True, eq=False)
class Deviation:
    """A tolerated deviation in a fit: value and standard deviation."""

    tolerance: Tolerance
    value: float
    std: float

    @property
    def stays(self) -> bool:
        """Whether it stays beside the columns of a model: delays and stiffness, which are no torques, and the gains of
        the torque sensors and the sizes of the healthy effects where they are clear of zero, which the models predict
        as on these days."""
        if self.tolerance.delays or self.tolerance.kind is Kind.COMPLIANCE:
            return True
        clear = abs(self.value) > max(_CLEAR * self.std, _MATTERS * GAIN_STD)
        return clear and self.tolerance.kind in (Kind.GAIN, Kind.SIZE)


def tolerances(dictionary: Dictionary, settings: DiagnosisSettings) -> list[Tolerance]:
    """The tolerated deviations of an arm in the rows of a dictionary."""
    nominal, evidence, found = dictionary.nominal, dictionary.evidence, list[Tolerance]()
    limit = settings.delay_tolerance_s
    for side in nominal.rows:
        rows = dictionary.rows(Candidate(DELAYS[side], -1), Shape(delay=1e-3))
        if side == "motor":
            found.append(Tolerance(Kind.DELAY, -1, rows, limit, (DELAYS[side].cause, -1), 1e-3))
        else:
            found += _joint_delays(dictionary, evidence, rows, limit)
    if "motor" in nominal.rows and np.any(nominal.arm.compliance > 0.0):
        # Behind published motors the links' ringing shows the stiffness, known from the healthy arm.
        known = nominal.arm.encoder == "motor" and nominal.arm.encoder_known
        share = settings.compliance_tolerance * (_KNOWN_COMPLIANCE if known else 1.0)
        shape = ELASTICITY.at_encoder(nominal.arm.encoder)
        error = nominal.arm.compliance_std
        unknown = np.zeros(nominal.arm.chain.n) if error is None else _ERRORS * error
        for joint in range(nominal.arm.chain.n):
            rows = dictionary.rows(Candidate(ELASTICITY, joint), shape)
            if rows:
                size = max(share * float(nominal.arm.compliance[joint]), float(unknown[joint]))
                found.append(Tolerance(Kind.COMPLIANCE, joint, rows, size, (ELASTICITY.cause, joint)))
    if evidence.compared:
        # Without a reference the gains of the sensors are hardly distinguishable from a scale of all masses.
        size = HABITUAL * _FURTHER * nominal.arm.gain_std
        found += [
            Tolerance(Kind.GAIN, j, rows, size, (SENSOR_GAIN.cause, j))
            for j, rows in gain_rows(dictionary).items()
        ]
        found += _lengths(dictionary)
        found += _sizes(dictionary, evidence, settings.least_gain)
    return found


def _joint_delays(dictionary: Dictionary, evidence: Evidence, rows: Rows, limit: float) -> list[Tolerance]:
    """Tolerated delays of the torque sensors: a common one, and the difference of each from it.

    Each sensor has electronics of its own and a delay of its own. The delay of the whole channel is their mean,
    weighted by the information in the rows. Seven sensors determine it much better than one, so with a known
    healthy delay a smaller one is a finding.
    """
    keys, known = sorted(rows), dictionary.nominal.arm.encoder_known
    weight = {
        key: float(np.sum((part * evidence.mask[key][:, None]) ** 2))
        / float(evidence.sigma[key[0]][key[1]] ** 2)
        for key, part in evidence.products.ordered(rows).items()
    }
    best = max(keys, key=lambda key: weight[key])
    common = (_KNOWN_DELAY if known else 2.0) * limit
    found = [Tolerance(Kind.DELAY, -1, rows, common, (DELAYS["joint"].cause, -1), 1e-3)]
    for key in keys:
        if key != best and weight[best] > 0.0:
            apart = {key: rows[key], best: -weight[key] / weight[best] * rows[best]}
            found.append(Tolerance(Kind.DELAY, key[1], apart, 2.0 * limit, unit=1e-3))
    return found


def _sizes(dictionary: Dictionary, evidence: Evidence, least_gain: float) -> list[Tolerance]:
    """Other sizes of the healthy arm's own effects, where a usual change of one would show."""
    found = []
    for number, entry in enumerate(dictionary.nominal.arm.healthy):
        effect, values = find_effect(str(entry["cause"])), parameter_values(entry)
        candidate = Candidate(effect, int(entry["joints"][0]) - 1 if entry["joints"] else -1)
        coefficients = effect.coefficients_of(values)
        columns = dictionary.rows(candidate, effect.shape_of(values, entry.get("form")))
        # Plain forms have fewer columns than the effect has coefficients.
        rows = {key: own @ coefficients[: own.shape[1], None] for key, own in columns.items()}
        if not rows:
            continue
        size = HABITUAL * _FURTHER * _usual_share(entry, effect)
        if evidence.information(evidence.products.alone(rows)) * size**2 > least_gain:
            found.append(Tolerance(Kind.SIZE, number, rows, size, candidate.key))
    return found


def _usual_share(entry: Mapping[str, Any], effect: Effect) -> float:
    """Standard deviation of the size of a healthy arm's effect from day to day, as a share of it: from its scatter over
    the healthy sets, with the usual one as some further changes."""
    linear = [entry["parameters"][p.name] for p in effect.linear if p.name in entry["parameters"]]
    size, scatter = (float(np.linalg.norm([one[name] for one in linear])) for name in ("value", "std"))
    own = scatter / max(size, 1e-300)
    return float(np.sqrt((USUAL_CHANGES * effect.usual_share**2 + own**2) / (USUAL_CHANGES + 1.0)))


def usual_change(effect: Effect, arm: NominalArm) -> float:
    """Standard deviation of a cause that is a scale on a further day from its healthy mean, 0 for others."""
    return _FURTHER * max(effect.usual_change, arm.gain_std) if effect.usual_change else 0.0


def gain_rows(dictionary: Dictionary) -> dict[int, Rows]:
    """Rows of an error of the torque sensor's gain, by joint from 0, where the sensor shows anything."""
    mask = dictionary.evidence.mask
    joints = [j for side, j in mask if side == "joint" and mask[side, j].any()]
    found = {j: dictionary.rows(Candidate(SENSOR_GAIN, j), Shape()) for j in joints}
    return {j: rows for j, rows in found.items() if rows}


def _lengths(dictionary: Dictionary) -> list[Tolerance]:
    """Other presliding lengths of the drives; for a drive of unknown length, friction that turns over that of the
    others."""
    nominal, found = dictionary.nominal, list[Tolerance]()
    lengths, usual = nominal.arm.presliding, nominal.arm.usual_length
    if lengths is None or not usual or "motor" not in nominal.rows:
        return found
    for joint in np.flatnonzero(nominal.moving).tolist():
        own = float(lengths[joint])
        slope = 0.5 / np.log(_APART)
        # Of the column: friction over each length, in units of the Coulomb friction.
        parts = {own * _APART: slope, own / _APART: -slope} if own > 0.0 else {usual: 1.0}

        def made(motion: ArmMotion, joint: int = joint, parts: Mapping[float, float] = parts) -> list[Column]:
            turned = (PRESLIDING.columns(motion, joint, Shape(length=length))[0].motor for length in parts)
            total = sum(share * np.asarray(one) for share, one in zip(parts.values(), turned, strict=True))
            return [Column(motor=float(motion.motor_coulomb[joint]) * np.asarray(total))]

        rows = {("motor", joint): nominal.columns(made, ["motor"])["motor"][0][:, None]}
        kind, size = (Kind.LENGTH, np.log(_LONGEST)) if own > 0.0 else (Kind.TURNING, _WHOLE)
        found.append(Tolerance(kind, joint, rows, size, (PRESLIDING.cause, joint)))
    return found
