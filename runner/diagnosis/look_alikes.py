"""Two causes that look alike, side by side: what each would leave in these sessions, and how far that goes together.

What a cause leaves is its torque less what the base model makes of it when it is fitted anew
(`ident.diagnosis.signatures`). Where two causes leave the same, no method can tell them apart from these
sessions, and another motion has to.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fri.errors import ConfigurationError, DataError
from ident.diagnosis import ArmData, Diagnosis, DiagnosisSettings, Finding, Reference
from ident.diagnosis.bench import Bench
from ident.diagnosis.candidates import Candidate
from ident.diagnosis.evidence import Rows
from ident.diagnosis.selection import margin
from ident.diagnosis.signatures import Signature, overlap, signature_bench, signatures
from ident.dynamics.kinematics import Chain
from ident.effects import find_effect
from ident.effects.words import joints_text, named
from lwr_driver.session import Session

__all__ = [
    "FILE",
    "Foreseen",
    "LookAlikes",
    "Place",
    "Trace",
    "asked",
    "look_alikes",
    "read_look_alikes",
    "write_look_alikes",
]

Floats = NDArray[np.float64]
Place = tuple[str, tuple[int, ...]]
"""A cause and its joints, from 1; none for the whole arm."""

FILE = "look_alikes.npz"

_RIVALS = 2
_TRACES = 2
_LEAST_SHARE = 0.15
_COLUMNS = ("time", "session", "position", "velocity", "load", "motor_angle", "first", "second", "measured")


@dataclass(frozen=True, eq=False)
class Trace:
    """The rows of one joint (from 1) and side, (m,) each.

    time [s] in the session, session number from 0; position [rad], velocity [rad/s], load [Nm] and motor_angle (part
    of a turn) of the joint that the causes speak of; first, second : what each cause would leave there [Nm];
    measured : what the model without either leaves [Nm].
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
    """Overlap and strength of `first` that are to be expected with a motion besides. file : of its plan."""

    file: str
    alike: float
    strength: float

    @property
    def apart(self) -> float:
        """What will be left of `first` beside `second`, in units of the noise."""
        return self.strength * math.sqrt(max(0.0, 1.0 - self.alike**2))

    @property
    def needed(self) -> float:
        """From how much on the two are told apart then."""
        return math.sqrt(margin(self.strength**2))

    def sentence(self) -> str:
        """What to expect of the motion."""
        verdict = "that decides" if self.apart > self.needed else "that may not decide either"
        return (
            f"with {self.file} recorded as well the overlap should be {self.alike:.3f} and {self.apart:.2g} times the "
            f"noise between them, of {self.needed:.2g} needed: {verdict}"
        )

    def to_dict(self) -> dict[str, Any]:
        """Plain content."""
        return {"file": self.file, "overlap": self.alike, "strength": self.strength, "apart": self.apart}


@dataclass(frozen=True, eq=False)
class LookAlikes:
    """Two causes in the same sessions.

    finding : number of the finding that is in doubt, from 1; 0 where somebody asked. alike : share (0 to 1) of what
    `first` leaves that `second` can imitate, the cosine of the angle between the two; 1: not to be told apart.
    strength : of what each leaves, in units of the noise. variables : what each depends on. decides : the motion
    that tells them apart, for each. sessions : names in their order. shape_alone : whether a sensor's error and a
    torque of the arm are compared in the joint torque alone. parameters, forms : of each, as they were compared.
    foreseen : what the motion that decides is to bring, where there is a plan of it.
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
        """What is left of `first` beside `second`, in units of the noise."""
        return self.strength[0] * math.sqrt(max(0.0, 1.0 - self.alike**2))

    @property
    def needed(self) -> float:
        """From how much on two causes of this strength are told apart, in units of the noise."""
        return math.sqrt(margin(self.strength[0] ** 2))

    @property
    def told_apart(self) -> bool:
        """Whether these sessions can tell them apart."""
        return self.apart > self.needed

    @property
    def open(self) -> bool:
        """Whether another motion has to decide."""
        return not self.told_apart or self.shape_alone

    def about(self, places: Sequence[Place]) -> bool:
        """Whether these are two of `places`."""
        return self.first in places and self.second in places

    def title(self, names: Sequence[str]) -> str:
        """Both causes in words."""
        return " or ".join(_said(place, names) for place in (self.first, self.second))

    def sentences(self, names: Sequence[str]) -> tuple[str, str]:
        """What the overlap says, and which motion decides."""
        first, second = (_said(place, names) for place in (self.first, self.second))
        if not self.told_apart:
            verdict = "not with these sessions"
        elif self.shape_alone:
            verdict = (
                "their shapes differ enough, yet without a motor torque no sensor's error is told from a torque of the "
                "arm of that very shape"
            )
        else:
            verdict = "these sessions do"
        said = (
            f"overlap {self.alike:.3f}: beside a base model fitted anew, {first} would leave {self.strength[0]:.2g} "
            f"times the noise, and {second} could imitate all of it but {self.apart:.2g}. Telling them apart takes "
            f"{self.needed:.2g}: {verdict}"
        )
        motions = list(dict.fromkeys(named(text, names) for text in self.decides))
        return said, " or ".join(motions)

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


def asked(text: str, names: Sequence[str]) -> Place:
    """`cause(joint)` or `cause:joint` with the joint's name or number from 1; a cause of the whole arm alone.

    Raises ConfigurationError for unknown causes and joints.
    """
    match = re.fullmatch(r"\s*(\w+)\s*(?:\(([^()]*)\)|:(.*))?\s*", text)
    if match is None:
        raise ConfigurationError(f"--compare {text!r}: write a cause and its joint, such as cable_spring:5")
    effect = find_effect(match.group(1))
    word = (match.group(2) or match.group(3) or "").strip()
    if effect.whole_arm:
        return effect.cause, ()
    if word in names:
        return effect.cause, (list(names).index(word) + 1,)
    if not word.isdigit() or not 1 <= int(word) <= len(names):
        raise ConfigurationError(
            f"--compare {text!r}: {effect.cause} belongs to a joint, 1 to {len(names)} or one of {', '.join(names)}; "
            f"write {effect.cause}:{names[0]}"
        )
    return effect.cause, (int(word),)


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
    """Each finding in doubt beside its first alternatives, then the `pairs` asked for; and what could not be shown.

    Other findings stay in the model meanwhile. Raises DataError for sessions that cannot be used, and where a
    pair asked for has a cause that leaves no torque in them.
    """
    settings = settings or DiagnosisSettings()
    wanted: list[tuple[int, Place, Place]] = []
    for number, finding in enumerate(diagnosis.findings, start=1):
        first = (finding.cause, finding.joints)
        wanted += [(number, first, (c, tuple(j))) for c, j, _ in finding.alternatives[:_RIVALS]]
    asked_for = [pair for pair in pairs if pair not in [(a, b) for _, a, b in wanted]]
    wanted += [(0, *pair) for pair in asked_for]
    if not wanted:
        return (), ()
    bench = signature_bench(sessions, chain, arm=arm, reference=reference, settings=settings)
    nuisance = list(bench.evidence.extra)
    columns = {(f.cause, f.joints): _columns(bench, f) for f in diagnosis.findings}
    found, notes = [], []
    for number, first, second in wanted:
        others = [rows for place, rows in columns.items() if place not in (first, second) and rows]
        bench.evidence.replace([*others, *nuisance])
        mine = diagnosis.findings[number - 1] if number else None
        try:
            found.append(_side_by_side(bench, number, first, second, mine))
        except DataError as error:
            if not number:
                raise
            notes.append(f"{_plain(first)} and {_plain(second)} cannot be shown side by side: {error}")
    return tuple(found), tuple(notes)


def _columns(bench: Bench, finding: Finding) -> Rows:
    """Columns of a finding on the bench; none for what leaves no torque."""
    effect = find_effect(finding.cause)
    candidate = Candidate(effect, finding.joints[0] - 1 if finding.joints else -1)
    if effect.counted:
        return {}
    return bench.dictionary.rows(candidate, effect.shape_of(_values(finding), finding.form))


def _values(finding: Finding) -> dict[str, float]:
    return {name: value.value for name, value in finding.parameters.items()}


def _side_by_side(
    bench: Bench, number: int, first: Place, second: Place, finding: Finding | None
) -> LookAlikes:
    given = [None if finding is None else _values(finding), None]
    a, b = signatures(
        bench, [first, second], parameters=given, forms=[None if finding is None else finding.form, None]
    )
    decides = [
        find_effect(cause).tell_apart.format(joint=joints[0] if joints else 1)
        for cause, joints in (first, second)
    ]
    return LookAlikes(
        number,
        (a.cause, a.joints),
        (b.cause, b.joints),
        overlap(a, b),
        (a.strength, b.strength),
        (
            find_effect(a.cause).variable(a.parameters),
            find_effect(b.cause).variable(b.parameters),
        ),
        (decides[0], decides[1]),
        tuple(recording.name for recording in bench.nominal.recordings),
        "motor" not in bench.nominal.rows
        and "sensor" in {find_effect(cause).side for cause, _ in (first, second)},
        (a.parameters, b.parameters),
        tuple(None if one.form is None else str(one.form.value) for one in (a, b)),
        None,
        _traces(bench, a, b),
    )


def _traces(bench: Bench, first: Signature, second: Signature) -> tuple[Trace, ...]:
    """The rows of the causes' own joints, else those in which they are strongest."""
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
        # What the causes depend on is their own joint's, wherever they are seen.
        own = next((j for place in (first, second) for j in place.joints), joint + 1) - 1
        states = [
            nominal.reduce(side, [getattr(m, name)[:, own] for m in nominal.motions])
            for name in ("q", "motor_speed", "joint_torque")
        ]
        used = np.isfinite(first.left[side][:, joint])
        turns = states[0] * nominal.arm.gear_ratio[own] / (2.0 * np.pi)
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


def write_look_alikes(found: Sequence[LookAlikes], path: Path) -> None:
    """Keep the traces, in single precision; the rest is in `to_dict`."""
    columns: dict[str, Any] = {}
    for number, pair in enumerate(found):
        columns[f"{number}.rows"] = np.array([f"{trace.side}.{trace.joint}" for trace in pair.traces])
        for k, trace in enumerate(pair.traces):
            columns |= {f"{number}.{k}.{name}": getattr(trace, name).astype(np.float32) for name in _COLUMNS}
    np.savez_compressed(path, **columns)


def read_look_alikes(path: Path, entries: Sequence[Mapping[str, Any]]) -> tuple[LookAlikes, ...]:
    """Traces from the file with the plain content beside them. Raises DataError where it is broken."""
    found = []
    try:
        with np.load(path, allow_pickle=False) as content:
            for number, entry in enumerate(entries):
                traces = []
                for k, label in enumerate(content[f"{number}.rows"]):
                    side, joint = str(label).split(".")
                    columns = (content[f"{number}.{k}.{name}"].astype(float) for name in _COLUMNS)
                    traces.append(Trace(side, int(joint), *columns))
                places = [(one["cause"], tuple(one["joints"])) for one in entry["causes"]]
                found.append(
                    LookAlikes(
                        entry["finding"] or 0,
                        places[0],
                        places[1],
                        entry["overlap"],
                        (entry["strength"][0], entry["strength"][1]),
                        (entry["variables"][0], entry["variables"][1]),
                        (entry["decides"][0], entry["decides"][1]),
                        tuple(entry["sessions"]),
                        bool(entry["shape_alone"]),
                        (entry["parameters"][0], entry["parameters"][1]),
                        tuple(entry["forms"]),
                        _foreseen(entry["foreseen"]),
                        tuple(traces),
                    )
                )
    except (OSError, ValueError, KeyError, TypeError, IndexError) as error:
        raise DataError(f"{path}: cannot be read: {error}; run the diagnosis again") from error
    return tuple(found)


def _foreseen(entry: Mapping[str, Any] | None) -> Foreseen | None:
    return None if entry is None else Foreseen(entry["file"], entry["overlap"], entry["strength"])


def _said(place: Place, names: Sequence[str]) -> str:
    return f"{place[0]} ({joints_text(place[1], names)})"


def _plain(place: Place) -> str:
    return f"{place[0]}{list(place[1]) or ''}"
