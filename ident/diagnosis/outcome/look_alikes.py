"""Look-alikes: two causes side by side, and the overlap of their signatures in the sessions at hand.

The signature of a cause is the part of its torque beyond a refitted base model (`ident.diagnosis.outcome.signatures`).
Two causes with the same signature cannot be separated by any method; only another motion decides between them.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from fri.errors import DataError
from ident.diagnosis.causes.candidates import Candidate
from ident.diagnosis.gain.products import Floats, Rows
from ident.diagnosis.gain.rivals import margin
from ident.diagnosis.healthy.bench import ArmData, DiagnosisBench
from ident.diagnosis.healthy.reference import Reference
from ident.diagnosis.outcome.result import Diagnosis, Finding
from ident.diagnosis.outcome.signatures import Signature, overlap, signature_bench, signatures
from ident.diagnosis.settings import DiagnosisSettings
from ident.dynamics.kinematics import Chain
from ident.effects import WEAR, find_effect
from lwr_driver.session import Session

Place = tuple[str, tuple[int, ...]]
"""A cause and its joints, from 1; none for the whole arm."""

_RIVALS = 2
_TRACES = 2
_LEAST_SHARE = 0.15


@dataclass(frozen=True, eq=False)
class Trace:
    """The rows of one joint (from 1) and side, (m,) each.

    time [s] in the session, session number from 0; position [rad], velocity [rad/s], load [Nm] and motor_angle (part
    of a turn) of the causes' own joint; first, second : torque left by each cause [Nm]; measured : residual of the
    model without either [Nm].
    """

    side: str
    joint: int
    time: Floats
    session: Floats
    position: Floats
    velocity: Floats
    load: Floats
    motor_angle: Floats
    first: Floats
    second: Floats
    measured: Floats


@dataclass(frozen=True)
class Foreseen:
    """Expected overlap and strength of `first` once a further motion is recorded. file : of its plan."""

    file: str
    alike: float
    strength: float

    @property
    def apart(self) -> float:
        """Expected rest of `first` beside `second`, in units of the noise."""
        return _rest(self.strength, self.alike)

    def to_dict(self) -> dict[str, Any]:
        """Plain content."""
        return {"file": self.file, "overlap": self.alike, "strength": self.strength, "apart": self.apart}


@dataclass(frozen=True, eq=False)
class LookAlikes:
    """Two causes in the same sessions.

    finding : number of the open finding, from 1; 0 for a pair asked for. alike : cosine (0 to 1) of the angle between
    the signature of `first` and the nearest one of `second`; 1: inseparable. strength : length of each signature in
    units of the noise. variables : the variable of each cause. decides : the discriminating motion for each.
    sessions : names in their order. shape_alone : a sensor error against a torque of the arm, in the joint torque
    alone. parameters, forms : of each cause as compared. foreseen : expected effect of a planned discriminating
    experiment.
    """

    finding: int
    first: Place
    second: Place
    alike: float
    strength: tuple[float, float]
    variables: tuple[str, str]
    decides: tuple[str, str]
    sessions: tuple[str, ...] = ()
    shape_alone: bool = False
    parameters: tuple[Mapping[str, float], Mapping[str, float]] = ({}, {})
    forms: tuple[str | None, ...] = (None, None)
    foreseen: Foreseen | None = None
    traces: tuple[Trace, ...] = field(default=(), repr=False)

    @property
    def apart(self) -> float:
        """Rest of `first` beside `second`, in units of the noise."""
        return _rest(self.strength[0], self.alike)

    @property
    def needed(self) -> float:
        """Smallest rest that separates causes of this strength, in units of the noise."""
        return math.sqrt(margin(self.strength[0] ** 2))

    @property
    def told_apart(self) -> bool:
        """Whether these sessions separate the two causes."""
        return self.apart > self.needed

    def about(self, places: Sequence[Place]) -> bool:
        """Whether both causes are among `places`."""
        return self.first in places and self.second in places

    def to_dict(self) -> dict[str, Any]:
        """Plain content, without the traces."""
        return {
            "finding": self.finding or None,
            "causes": [
                {"cause": cause, "joints": list(joints)} for cause, joints in (self.first, self.second)
            ],
            "overlap": self.alike,
            "strength": list(self.strength),
            "apart": self.apart,
            "needed": self.needed,
            "told_apart": self.told_apart,
            "variables": list(self.variables),
            "decides": list(self.decides),
            "sessions": list(self.sessions),
            "shape_alone": self.shape_alone,
            "parameters": [dict(values) for values in self.parameters],
            "forms": list(self.forms),
            "foreseen": None if self.foreseen is None else self.foreseen.to_dict(),
        }

    @classmethod
    def from_dict(cls, entry: Mapping[str, Any], traces: Sequence[Trace] = ()) -> LookAlikes:
        """From plain content; KeyError, IndexError or TypeError for an incomplete one."""
        first, second = ((one["cause"], tuple(one["joints"])) for one in entry["causes"])
        seen = entry["foreseen"]
        return cls(
            entry["finding"] or 0,
            first,
            second,
            alike=entry["overlap"],
            strength=(entry["strength"][0], entry["strength"][1]),
            variables=(entry["variables"][0], entry["variables"][1]),
            decides=(entry["decides"][0], entry["decides"][1]),
            sessions=tuple(entry["sessions"]),
            shape_alone=bool(entry["shape_alone"]),
            parameters=(entry["parameters"][0], entry["parameters"][1]),
            forms=tuple(entry["forms"]),
            foreseen=None if seen is None else Foreseen(seen["file"], seen["overlap"], seen["strength"]),
            traces=tuple(traces),
        )


def look_alikes(
    diagnosis: Diagnosis,
    sessions: Sequence[Session],
    chain: Chain,
    pairs: Sequence[tuple[Place, Place]] = (),
    *,
    arm: ArmData | None = None,
    reference: Reference | None = None,
    settings: DiagnosisSettings | None = None,
) -> tuple[tuple[LookAlikes, ...], tuple[str, ...]]:
    """Each open finding beside its first alternatives, then the `pairs` asked for; and notes on pairs left out.

    The other findings stay in the model. Raises DataError for unusable sessions, and for a pair asked for with a
    cause without torque in them.
    """
    settings = settings or DiagnosisSettings()
    wanted: list[tuple[int, Place, Place]] = []
    for number, finding in enumerate(diagnosis.claims, start=1):
        first = (finding.cause, finding.joints)
        if finding.cause != WEAR:
            wanted += [(number, first, (c, tuple(j))) for c, j, _ in finding.alternatives[:_RIVALS]]
    asked_for = [pair for pair in pairs if pair not in [(a, b) for _, a, b in wanted]]
    wanted += [(0, *pair) for pair in asked_for]
    if not wanted:
        return (), ()
    bench = signature_bench(
        sessions, chain, arm=arm, reference=reference, settings=settings, broken=diagnosis.data
    )
    nuisance = list(bench.evidence.extra)
    columns = {(f.cause, f.joints): _columns(bench, f) for f in diagnosis.claims}
    found, notes = [], []
    for number, first, second in wanted:
        others = [rows for place, rows in columns.items() if place not in (first, second) and rows]
        bench.evidence.replace([*others, *nuisance])
        mine = diagnosis.claims[number - 1] if number else None
        try:
            found.append(_side_by_side(bench, number, first, second, mine))
        except DataError as error:
            if not number:
                raise
            names = " and ".join(f"{cause}{list(joints) or ''}" for cause, joints in (first, second))
            notes.append(f"{names} cannot be shown side by side: {error}")
    return tuple(found), tuple(notes)


def _rest(strength: float, alike: float) -> float:
    return strength * math.sqrt(max(0.0, 1.0 - alike**2))


def _columns(bench: DiagnosisBench, finding: Finding) -> Rows:
    """Columns of a finding on the bench; none for a cause without torque."""
    if finding.cause == WEAR:
        return {}
    effect = find_effect(finding.cause)
    candidate = Candidate(effect, finding.joints[0] - 1 if finding.joints else -1)
    if effect.counted:
        return {}
    return bench.dictionary.rows(candidate, effect.shape_of(_values(finding), finding.form))


def _values(finding: Finding) -> dict[str, float]:
    return {name: value.value for name, value in finding.parameters.items()}


def _side_by_side(
    bench: DiagnosisBench, number: int, first: Place, second: Place, finding: Finding | None
) -> LookAlikes:
    given = [None if finding is None else _values(finding), None]
    a, b = signatures(
        bench, [first, second], parameters=given, forms=[None if finding is None else finding.form, None]
    )
    effects = find_effect(a.cause), find_effect(b.cause)
    decides = [
        effect.tell_apart.format(joint=joints[0] if joints else 1)
        for effect, (_, joints) in zip(effects, (first, second), strict=True)
    ]
    return LookAlikes(
        number,
        (a.cause, a.joints),
        (b.cause, b.joints),
        alike=overlap(a, b),
        strength=(a.strength, b.strength),
        variables=(effects[0].variable(a.parameters), effects[1].variable(b.parameters)),
        decides=(decides[0], decides[1]),
        sessions=tuple(recording.name for recording in bench.nominal.recordings),
        shape_alone="motor" not in bench.nominal.rows and "sensor" in {effect.side for effect in effects},
        parameters=(a.parameters, b.parameters),
        forms=tuple(None if one.form is None else str(one.form.value) for one in (a, b)),
        traces=_traces(bench, a, b),
    )


def _traces(bench: DiagnosisBench, first: Signature, second: Signature) -> tuple[Trace, ...]:
    """The rows of the causes' own joints, else the rows of their largest torques."""
    nominal, evidence = bench.nominal, bench.evidence
    power: dict[tuple[str, int], float] = {}
    for signature in (first, second):
        mine = {
            (side, joint): float(np.nansum(left[:, joint] ** 2)) / float(evidence.sigma[side][joint]) ** 2
            for side, left in signature.left.items()
            for joint in range(left.shape[1])
            if np.isfinite(left[:, joint]).any()
        }
        near = {key: value for key, value in mine.items() if key[1] + 1 in signature.joints}
        whole = sum(mine.values())
        for key, value in (near or mine).items():
            power[key] = max(power.get(key, 0.0), value / whole if whole > 0.0 else 0.0)
    keys = [key for key in sorted(power, key=lambda key: -power[key]) if power[key] > _LEAST_SHARE]
    residual = evidence.residuals()
    found = []
    for side, joint in sorted(keys[:_TRACES] or list(power)[:1]):
        # The variables are those of the causes' own joint, whichever joint shows them.
        own = next((j for place in (first, second) for j in place.joints), joint + 1) - 1
        states = [
            nominal.grid.reduce(side, [getattr(m, name)[:, own] for m in nominal.motions])
            for name in ("q", "motor_speed", "joint_torque")
        ]
        used = np.isfinite(first.left[side][:, joint])
        ahead = bench.dictionary.setting.motor_ahead(own)
        motors = nominal.grid.reduce(side, [m.motor_angle(own, ahead) for m in nominal.motions])
        turns = motors * nominal.arm.gear_ratio[own] / (2.0 * np.pi)
        columns = (
            first.time[side],
            first.session[side],
            *states,
            turns - np.floor(turns),
            first.left[side][:, joint],
            second.left[side][:, joint],
            residual[side][:, joint],
        )
        found.append(Trace(side, joint + 1, *(np.asarray(column)[used] for column in columns)))
    return tuple(found)
