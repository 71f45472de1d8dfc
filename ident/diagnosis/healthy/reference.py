"""The healthy-arm baseline from commissioning, stored in the provenance of its model.

A reference ties the base parameters to their healthy values, within their uncertainty and a tolerance for changes
from day to day. Causes otherwise absorbed by the parameters become visible. It also holds the noise, the delays and
the stiffness of the healthy arm, and the mean gain of each candidate in healthy sessions: the basis of the least gain
of a claim.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fri.errors import ConfigurationError
from ident.diagnosis.causes.usual_sizes import (
    LEAST_SETS,
    Healthy,
    OfDays,
    UsualSize,
    scatter_limits,
)
from ident.diagnosis.gain.products import Floats
from ident.diagnosis.rows.nominal_arm import GAIN_STD
from ident.dynamics.base_set import BaseSet
from ident.dynamics.parameters import LINK_FRICTION, PER_LINK, split_name
from ident.dynamics.structure import EncoderSide
from ident.effects import EFFECTS, Effect, find_effect
from ident.estimators.estimate import fisher_limit
from ident.model import DynamicModel, write_model

DELAY_STD_S = 2e-4
"""Usual standard deviation [s] of a healthy channel's delay from day to day."""
WEIGHED = 0.02
"""Relative standard deviation of an announced mass."""
INERTIA_BY_PHASE = 0.05
"""Largest effect of the phase of slow motor samples on a drive's inertia, as a share of it."""
USUAL_DAYS = 4
"""Weight of the usual deviation of a delay, in days."""
USUAL = {"Fvl": 0.087, "Fcl": 0.058, "Fvm": 0.087, "Fcm": 0.058}
"""Usual relative standard deviation of a healthy arm's parameters from day to day, by symbol: Coulomb friction within
10 % and viscous friction within 15 %, evenly."""
ELSE = 0.01
"""The same of all others: gains of the sensors by a per cent."""
LAST_BODY = ("M", "MX", "MY", "MZ", "XX", "XY", "XZ", "YY", "YZ", "ZZ")
"""Inertial parameters of a body on the last link: those that are told first."""

_KEY = "commissioning"
# The name of the presliding lengths in files, that of the first versions.
_LENGTHS = "reach"
_WIDER = 1.5
# Relative error within which a stiffness counts as known.
_STIFFNESS_WITHIN = 0.2
_ONE_IN = 0.01
_AS_SETS = 4


@dataclass(frozen=True, eq=False)
class Reference:
    """A healthy arm.

    model : its identified model. compliance : (n,) [rad/Nm]. motor_delay_s, joint_delay_s : of its channels.
    noise : of a row [Nm] by side, (n,). correlated : number of rows that count as one for it, by side, (n,).
    null : mean gain of each candidate by (cause, joint from 0). sets : number of healthy sets of sessions behind the
    null. encoder : `link` or `motor`, see `nominal_arm.NominalArm`.
    presliding : (n,) presliding length [rad], None if unknown. far, far_share : (n,) see `nominal_arm.NominalArm`.
    delay_std_s : of the channels' delays from day to day, by side. habits : whether the covariance of the model holds
    the changes from day to day. masses : announced, of its payloads [kg].
    gain_std : of the torque sensors' gains from day to day. compliance_std : (n,) [rad/Nm] standard error of the
    compliance by the sets' rows and its scatter over them, None where none was fitted; 0 of a joint taken as rigid, and
    half of a stated compliance that the sets do not tell. shown : mean information of the sets on each
    candidate, by shape of its grid: the fall of the chi-square for a unit of its coefficients. usual : size of each
    candidate on the healthy arm. left : largest rms (n,) [Nm] by side of a held-out session of a healthy set, beside
    what differs from day to day; empty if unknown. lost : largest share of lost, repeated and stale samples of a
    healthy session, by channel. gear_ratio : (n,) of the drives, None if unknown.
    """

    model: DynamicModel
    _: KW_ONLY
    compliance: Floats
    motor_delay_s: float
    joint_delay_s: float
    noise: Mapping[str, Floats]
    null: Mapping[tuple[str, int], float]
    sets: int
    encoder: EncoderSide = "link"
    presliding: Floats | None = None
    far: Floats | None = None
    far_share: Floats | None = None
    delay_std_s: Mapping[str, float] = field(default_factory=dict)
    habits: bool = False
    masses: Mapping[str, float | None] = field(default_factory=dict)
    gain_std: float = GAIN_STD
    compliance_std: Floats | None = None
    correlated: Mapping[str, Floats] = field(default_factory=dict)
    shown: Mapping[tuple[str, int], Mapping[str, float]] = field(default_factory=dict)
    usual: Mapping[tuple[str, int], UsualSize] = field(default_factory=dict)
    left: Mapping[str, Floats] = field(default_factory=dict)
    lost: Mapping[str, float] = field(default_factory=dict)
    gear_ratio: Floats | None = None

    @property
    def unknown_stiffness(self) -> tuple[str, ...]:
        """Joints with a stiffness that the sets do not tell within 20 % (95 %); none where none was fitted."""
        names = self.model.structure.chain.joint_names
        found = unsure(self.compliance, self.compliance_std)
        return tuple(name for name, one in zip(names, found, strict=False) if one)

    def __repr__(self) -> str:
        joints = self.model.structure.chain.joint_names
        stiff = ", ".join(
            f"{name} {1.0 / c:.4g}" if c > 0.0 else f"{name} rigid"
            for name, c in zip(joints, self.compliance, strict=False)
        )
        unknown = ", ".join(self.unknown_stiffness)
        return "\n".join(
            [
                f"Reference of {self.model.robot}: {len(self.model.names)} parameters, healthy sets: {self.sets}",
                f"  positions of the {self.encoder} side; delays: motor {1e3 * self.motor_delay_s:.2f} ms, "
                f"joint {1e3 * self.joint_delay_s:.2f} ms",
                f"  stiffness [Nm/rad]: {stiff or 'unknown'}{f'; not known within 20 %: {unknown}' if unknown else ''}",
            ]
        )

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the model file with the reference in its provenance, for `diagnose(reference=path)`."""
        write_model(replace(self.model, provenance={**self.model.provenance, **self.stored()}), Path(path))

    @classmethod
    def of(cls, model: DynamicModel) -> Reference:
        """From a model file of `lwr-run commission`; other models give their parameters alone."""
        n = model.structure.chain.n
        stored = model.provenance.get(_KEY)
        if not isinstance(stored, Mapping):
            return cls(
                model,
                compliance=np.zeros(0),
                motor_delay_s=0.0,
                joint_delay_s=0.0,
                noise={},
                null={},
                sets=0,
            )
        try:
            null = {_split(key): float(value) for key, value in stored["null"].items()}
            shown = {
                _split(key): {shape: float(v) for shape, v in some.items()}
                for key, some in stored.get("shown", {}).items()
            }
            usual = {_split(key): UsualSize.read(one) for key, one in stored.get("usual", {}).items()}
            compliance = np.array(stored["compliance"], dtype=np.float64)
            noise, correlated, left = (
                _by_side(stored.get(key, {})) for key in ("noise", "correlated", "left")
            )
            motor_delay_s, joint_delay_s = float(stored["motor_delay_s"]), float(stored["joint_delay_s"])
            delay_std = {side: float(v) for side, v in stored.get("delay_std_s", {}).items()}
            lost = {channel: float(v) for channel, v in stored.get("lost", {}).items()}
            sets, encoder = int(stored["sets"]), str(stored["encoder"])
            presliding, far, far_share, compliance_std, gear_ratio = (
                np.array(stored[name], dtype=np.float64) if stored.get(name) else None
                for name in (_LENGTHS, "far", "far_share", "compliance_std", "gear_ratio")
            )
        except (AttributeError, KeyError, TypeError, ValueError) as error:
            raise ConfigurationError(
                f"the reference's `provenance.{_KEY}` cannot be read ({error}); commission the arm again"
            ) from error
        if set(noise) == {"motor"} and any(symbol_of(name) == "Fcl" for name in model.names):
            raise ConfigurationError(
                "the reference is of motor torques alone and has its friction at the links, as earlier versions made "
                "it: there it neither turns over a path nor wears; commission the arm again"
            )
        if compliance.shape != (n,):
            raise ConfigurationError(
                f"the reference's compliance has {compliance.size} entries for {n} joints; commission again"
            )
        return cls(
            model,
            compliance=compliance,
            motor_delay_s=motor_delay_s,
            joint_delay_s=joint_delay_s,
            noise=noise,
            null=null,
            sets=sets,
            encoder="motor" if encoder == "motor" else "link",
            presliding=presliding,
            far=far,
            far_share=far_share,
            delay_std_s=delay_std,
            habits=bool(stored.get("habits", False)),
            masses=dict(stored.get("masses", {})),
            gain_std=float(stored.get("gain_std", GAIN_STD)),
            compliance_std=compliance_std,
            correlated=correlated,
            shown=shown,
            usual=usual,
            left=left,
            lost=lost,
            gear_ratio=gear_ratio,
        )

    def stored(self) -> dict[str, Any]:
        """Content for the provenance of the model."""
        return {
            _KEY: {
                "compliance": [float(v) for v in self.compliance],
                "compliance_std": _listed(self.compliance_std),
                "motor_delay_s": self.motor_delay_s,
                "joint_delay_s": self.joint_delay_s,
                "delay_std_s": dict(self.delay_std_s),
                "noise": {side: _listed(values) for side, values in self.noise.items()},
                "correlated": {side: _listed(values) for side, values in self.correlated.items()},
                "left": {side: _listed(values) for side, values in self.left.items()},
                "lost": dict(self.lost),
                "null": {
                    f"{cause} {joint + 1}": round(float(v), 2) for (cause, joint), v in self.null.items()
                },
                "shown": {
                    f"{cause} {joint + 1}": {shape: float(f"{v:.4g}") for shape, v in some.items()}
                    for (cause, joint), some in self.shown.items()
                },
                "usual": {f"{cause} {joint + 1}": one.stored() for (cause, joint), one in self.usual.items()},
                "sets": self.sets,
                "habits": self.habits,
                "masses": dict(self.masses),
                "gain_std": self.gain_std,
                "encoder": self.encoder,
                _LENGTHS: _listed(self.presliding),
                "far": _listed(self.far),
                "far_share": _listed(self.far_share),
                "gear_ratio": _listed(self.gear_ratio),
            }
        }

    def healthy(self) -> Healthy:
        """Upper 1 % limits of the gain of each candidate in a healthy set, and of its difference from the usual
        size."""
        changes = scatter_limits(self.usual, self.sets, _ONE_IN, _AS_SETS)
        sizes = {key: (size, changes[key]) for key, size in self.usual.items()}
        return Healthy(self.limits(), self.shown, sizes, self.days())

    def limits(self) -> dict[tuple[str, int], float]:
        """Upper 1 % limit of each candidate's gain in a healthy set, by (cause, joint from 0).

        The gain of a candidate differs between healthy sets, for the arm is never quite the nominal one. It is
        modelled as the square of a normally distributed deviation. Then the gain of a further set over the mean of
        `sets` of them has Fisher's distribution F(1, sets). The mean of a few sets is uncertain, so the mean of the
        same cause over all joints counts as further sets, unless all joints have it from one state of a day. Each of
        the n sets was held against the others; a further one is held against all, and deviates from their mean by
        1 - 1/n^2 of that in square. A function of many knots is one deviation, too: what a healthy arm leaves has a
        form.
        """
        found = {
            key: one.by_days if _effect(key[0]).together else one.by_joints
            for key, one in self.days().items()
        }
        # On a healthy arm a cause reaches at least the gain of its special cases, and is not counted beside them.
        for effect in EFFECTS.values():
            for case in effect.contains:
                for (cause, joint), limit in list(found.items()):
                    if cause == case:
                        found[effect.cause, joint] = max(limit, found.get((effect.cause, joint), 0.0))
        return found

    def days(self) -> dict[tuple[str, int], OfDays]:
        """The same from the sets and all joints, and from the sets alone, see `limits`."""
        if not self.sets:
            return {}
        further = 1.0 - self.sets**-2.0 if self.sets > 1 else 1.0
        by_cause: dict[str, list[float]] = {}
        for (cause, _), gain in self.null.items():
            by_cause.setdefault(cause, []).append(gain)
        # The gain from noise alone has no such tail; the least gain of a claim accounts for it.
        each = [gain for (cause, _), gain in self.null.items() if " " not in cause]
        noise = float(np.median(each)) if each else 0.0
        sets = self.sets + _AS_SETS
        by_joints, by_days = (
            further * fisher_limit(_ONE_IN, 1, count) for count in (sets, max(self.sets, LEAST_SETS))
        )
        found = {}
        for key, gain in self.null.items():
            mean = (self.sets * gain + _AS_SETS * float(np.mean(by_cause[key[0]]))) / sets
            beyond = max(mean - noise, 0.0)
            found[key] = OfDays(beyond, noise + by_joints * beyond, noise + by_days * beyond)
        return found

    def carrying(self, values: Floats, covariance: Floats) -> Reference:
        """The same with a further body on the last link: its parameters (10,) of `LAST_BODY`, covariance (10, 10)."""
        model = self.model
        if model.covariance is None or model.base is None:
            return self
        body = last_body(model.base)[model.positions]
        more = body @ covariance @ body.T
        return replace(
            self,
            model=replace(model, values=model.values + body @ values, covariance=model.covariance + more),
        )

    def loosened(self, symbol: str, share: float) -> Reference:
        """The same with parameters of a symbol, such as `Ia`, uncertain by at least that share of their value."""
        model = self.model
        if model.covariance is None:
            return self
        mine = np.array([symbol_of(name) == symbol for name in model.names])
        more = np.diag(np.where(mine, share * model.values, 0.0) ** 2)
        return replace(self, model=replace(model, covariance=model.covariance + more))

    def common(self, base: BaseSet, masses: Mapping[str, float | None]) -> list[tuple[int, int]]:
        """Places in the model's values and in a base set of the parameters that both have, see `shared`."""
        own = self.model
        if own.base is None:
            return []
        mine = {int(p): k for k, p in enumerate(own.positions)}
        return [(mine[a], b) for a, b in shared(own.base, base, self.masses, masses) if a in mine]

    def prior(
        self, base: BaseSet, masses: Mapping[str, float | None] | None = None, *, wider: float = _WIDER
    ) -> tuple[Floats, Floats] | None:
        """Precision (p, p) and values (p,) of the base parameters shared with the reference.

        masses : announced, of the payloads [kg]. Another payload than the reference's shares no parameter; its mass is
        the announced one. wider : factor on their standard deviations. None for a reference without covariance or
        shared parameters.
        """
        masses = masses or {}
        own = self.model
        if own.covariance is None or own.base is None:
            return None
        pairs = self.common(base, masses)
        if not pairs:
            return None
        here, there = np.array([b for _, b in pairs]), np.array([a for a, _ in pairs])
        covariance = own.covariance[np.ix_(there, there)] * wider**2
        values = own.values[there]
        usual = np.array([USUAL.get(symbol_of(base.names[b]), ELSE) for b in here])
        tolerance = np.zeros(len(here)) if self.habits else usual * np.abs(values)
        std = np.sqrt(np.diag(covariance))
        covariance = covariance + np.diag(tolerance**2 + (0.05 * std) ** 2)
        precision = np.zeros((len(base), len(base)))
        precision[np.ix_(here, here)] = np.linalg.inv(covariance)
        mean = np.zeros(len(base))
        mean[here] = values
        for k, (_, mass) in announced_masses(base, masses).items():
            if k not in here:
                precision[k, k], mean[k] = 1.0 / (WEIGHED * mass) ** 2, mass
        return precision, mean


def unsure(compliance: Floats, std: Floats | None) -> NDArray[np.bool_]:
    """Compliances (n,) with a standard error (n,) of more than 20 % (95 %), none without."""
    if std is None:
        return np.zeros(len(compliance), dtype=bool)
    return np.asarray(2.0 * std > _STIFFNESS_WITHIN * compliance)


def last_body(base: BaseSet) -> Floats:
    """Base parameters (p, 10) of a unit of each of `LAST_BODY` on the last link."""
    structure = base.structure
    return base.matrix[:, [structure.names.index(f"{symbol}{structure.chain.n}") for symbol in LAST_BODY]]


def joint_of(name: str) -> int:
    """Number from 0 of the joint of a drive's base parameter."""
    return int("".join(c for c in name if c.isdigit())) - 1


def _by_side(stored: Mapping[str, Sequence[float]]) -> dict[str, Floats]:
    return {side: np.array(values, dtype=np.float64) for side, values in stored.items()}


def _listed(values: Floats | None) -> list[float] | None:
    return None if values is None else [float(v) for v in values]


def symbol_of(name: str) -> str:
    """Symbol of a base parameter: without joint and mark of regrouping."""
    return name.rstrip("R").rstrip("0123456789")


def _effect(cause: str) -> Effect:
    """The effect of a cause, of a kind of nameless function that of its side."""
    return find_effect(cause.partition(" ")[0])


def _split(key: str) -> tuple[str, int]:
    cause, _, joint = key.rpartition(" ")
    return cause, int(joint) - 1


def shared(
    a: BaseSet, b: BaseSet, masses_a: Mapping[str, float | None], masses_b: Mapping[str, float | None]
) -> list[tuple[int, int]]:
    """Pairs of base parameters of two sets with the same sum of standard parameters; those of a payload only if it
    has the same name and no other announced mass [kg].
    """
    other = set()
    for name, mass in masses_a.items():
        now = masses_b.get(name)
        if mass is not None and now is not None and not np.isclose(mass, now, rtol=1e-3):
            other.add(name)
    rows_a = [_combination(a, k, other) for k in range(len(a))]
    rows_b = {_combination(b, k, set()): k for k in range(len(b))}
    return [(k, rows_b[row]) for k, row in enumerate(rows_a) if row in rows_b]


def _combination(base: BaseSet, k: int, other: set[str]) -> tuple[tuple[str, float], ...]:
    """Names and factors of a base parameter's sum, the payloads' by their names; `other` ones by no name in use.

    Friction of a drive has that of its link in it, where that is left out for want of joint torques.
    """
    row, structure = base.matrix[k], base.structure
    found = []
    for column in np.flatnonzero(np.abs(row) > 1e-9).tolist():
        factor = round(float(row[column]), 6)
        found.append((_with_payload(base, column, other), factor))
        symbol, link, *_ = split_name(structure.names[column])
        beside = column - len(LINK_FRICTION) if symbol in ("Fvm", "Fcm", "offm") else column
        if link <= structure.chain.n and not structure.active[beside]:
            found.append((structure.names[beside], factor))
    return tuple(sorted(found))


def _with_payload(base: BaseSet, column: int, other: set[str]) -> str:
    """Name of a column, of a payload's with that payload."""
    structure, name = base.structure, base.structure.names[column]
    payload = column // len(PER_LINK) - structure.chain.n
    if not 0 <= payload < len(structure.payloads):
        return name
    title = structure.payloads[payload]
    return f"{name.rstrip('0123456789')} of {title}{' before' if title in other else ''}"


def announced_masses(base: BaseSet, masses: Mapping[str, float | None]) -> dict[int, tuple[str, float]]:
    """Payload and announced mass [kg] by place of the base parameters that are the mass of a payload."""
    found = {}
    for k in range(len(base)):
        terms = _combination(base, k, set())
        for payload, mass in masses.items():
            if mass and terms == ((f"M of {payload}", 1.0),):
                found[k] = payload, float(mass)
    return found
