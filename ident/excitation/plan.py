"""The result of planning: one exciting motion with its margins, predicted deviations and provenance."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Any, Literal

import numpy as np
import numpy.typing as npt
import yaml

from fri.errors import ConfigurationError, DataError
from fri.quantities import Name, Version, entries, within
from ident.excitation.check import Check, Margin
from ident.excitation.motions import (
    Array,
    FourierSeries,
    ParametricMotion,
    PointToPoint,
    Samples,
    SplineMotion,
)
from ident.model.model_file import write_checked
from lwr_driver.configuration import parse, read_mapping
from lwr_driver.extent import LONGEST_EXCITATION_S, Periods
from lwr_driver.listing import Listing, Piece
from lwr_driver.places import Place
from lwr_driver.yaml_text import yaml_content

_SCHEMA = 1
# Searches that end this close to the best one have found the same value.
_SAME = 0.01
_CYCLE_TOLERANCE = 1e-6

_Duration = Annotated[float, within(0.01, LONGEST_EXCITATION_S, "s")]
_Angle = Annotated[float, within(-20.0, 20.0, "rad")]
_Angles = Annotated[tuple[_Angle, ...], entries(1, 200)]
_Table = Annotated[tuple[_Angles, ...], entries(1, 100)]
# Motions of a diagnosis have a control point each 0.04 s.
_Controls = Annotated[tuple[_Angle, ...], entries(1, round(LONGEST_EXCITATION_S / 0.02))]
_Limit = Annotated[float, within(0.0, 1e6, above=True)]
_Limits = Annotated[tuple[_Limit, ...], entries(1, 100)]


@dataclass(frozen=True)
class FourierKeys:
    """A Fourier series in a plan file."""

    type: Literal["fourier"]
    period_s: _Duration
    bias: _Angles
    a: _Table
    b: _Table
    harmonics: Annotated[int, within(1, 200)] = 1


@dataclass(frozen=True)
class SplineKeys:
    """A B-spline in a plan file."""

    type: Literal["bspline"]
    duration_s: _Duration
    points: Annotated[tuple[_Controls, ...], entries(1, 100)]


@dataclass(frozen=True)
class PointKeys:
    """Postures in a plan file."""

    type: Literal["point to point"]
    postures: Annotated[tuple[_Angles, ...], entries(2, 10_000)]
    v_max: _Limits
    a_max: _Limits
    j_max: _Limits
    dwell_s: Annotated[float, within(0.0, 600.0, "s")]


MOTIONS = FourierKeys | SplineKeys | PointKeys
"""The forms of `motion` in a plan file, told apart by `type`."""


@dataclass(frozen=True)
class PlanFile:
    """The keys of a plan file that decide the motion; the rest is a record of its planning."""

    schema_version: Version
    kind: Literal["excitation plan"]
    joint_names: Annotated[tuple[Name, ...], entries(1, 100)]
    periods: Periods


@dataclass(frozen=True, eq=False)
class ExcitationPlan:
    """A checked exciting motion with its objective values and its origin.

    motion : the parametrised motion; periods : repetitions in one session
    joint_names : in the order of the motion's columns
    objectives : value of each criterion by name
    rsd_percent : predicted relative standard deviation by parameter [%]
    check : margins against every limit at planning time
    provenance : seeds, versions, limits, settings: plain values
    """

    motion: ParametricMotion
    joint_names: tuple[str, ...]
    periods: int = 1
    objectives: Mapping[str, float] = field(default_factory=dict)
    rsd_percent: Mapping[str, float] = field(default_factory=dict)
    check: Check = field(default_factory=lambda: Check(()))
    provenance: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if len(self.joint_names) != self.motion.joints:
            raise ConfigurationError(
                f"{len(self.joint_names)} joint_names for a motion of {self.motion.joints} joints"
            )
        if self.periods < 1:
            raise ConfigurationError(f"periods {self.periods} is below 1; at least one whole period is run")
        for name in ("objectives", "rsd_percent", "provenance"):
            object.__setattr__(self, name, MappingProxyType(dict(getattr(self, name))))

    def __repr__(self) -> str:
        values = [f"  {name} {value:.4g}" for name, value in list(self.objectives.items())[:5]]
        head = f"ExcitationPlan: {self.motion!r}, {self.periods} period(s), {self.duration_s:g} s"
        return "\n".join([head, *values, repr(self.check)])

    @property
    def period_s(self) -> float:
        """Duration of one period [s]."""
        return self.motion.duration

    @property
    def duration_s(self) -> float:
        """Duration of all periods [s]."""
        return self.periods * self.motion.duration

    @property
    def start(self) -> Array:
        """Posture at the start and the end of the motion [rad], (joints,)."""
        return self.motion.sample(0.0).q[0]

    def sample(self, t: npt.ArrayLike) -> Samples:
        """Positions, velocities, accelerations, jerks at t (n,) [s]; t may span several periods."""
        times = np.atleast_1d(np.asarray(t, dtype=np.float64))
        return self.motion.sample(np.mod(times, self.motion.duration))

    def rows(self, period_s: float, periods: int | None = None) -> Array:
        """Joint positions at every FRI cycle from the start to the end of the last period, (n, joints).

        Raises ConfigurationError unless a period of the motion is a whole number of cycles: averaging over periods
        needs samples at the same phase.
        """
        repeats = self.periods if periods is None else periods
        if repeats < 1:
            raise ConfigurationError(f"periods {repeats} is below 1; at least one whole period is run")
        cycles = self.motion.duration / period_s
        if abs(cycles - round(cycles)) > _CYCLE_TOLERANCE * cycles:
            raise ConfigurationError(
                f"motion period {self.motion.duration} s is {cycles:.4f} cycles of {period_s} s; choose a "
                "base period that is a whole number of FRI cycles"
            )
        count = round(cycles)
        one = self.motion.sample(np.arange(count) * period_s).q
        return np.vstack([np.tile(one, (repeats, 1)), one[:1]])

    def to_yaml(self) -> str:
        """Text of the plan file. Numbers keep every digit, so the motion survives reading bit for bit."""
        content = {
            "schema_version": _SCHEMA,
            "kind": "excitation plan",
            "joint_names": list(self.joint_names),
            "periods": self.periods,
            "motion": _motion_to_mapping(self.motion),
            "objectives": {key: float(value) for key, value in self.objectives.items()},
            "rsd_percent": {key: float(value) for key, value in self.rsd_percent.items()},
            "margins": [_margin_to_mapping(margin) for margin in self.check.margins],
            "provenance": dict(self.provenance),
        }
        return yaml.safe_dump(content, sort_keys=False, width=110, allow_unicode=True)

    def save(self, path: Path) -> None:
        """Write the plan file, read back first."""

        def check(text: str) -> None:
            if ExcitationPlan.from_mapping(yaml_content(text), "plan").to_yaml() != text:
                raise DataError("the plan read back differs from the one written")

        write_checked(path, self.to_yaml(), check)

    @classmethod
    def load(cls, path: Path) -> ExcitationPlan:
        """Read a plan file; ConfigurationError with path and fault otherwise."""
        return cls.from_mapping(read_mapping(path), path)

    @classmethod
    def from_mapping(cls, content: Any, path: str | Path) -> ExcitationPlan:
        """The plan of a file's content; ConfigurationError with path and fault otherwise."""
        place = Place.of(path)
        if not isinstance(content, Mapping) or content.get("kind") != "excitation plan":
            raise ConfigurationError(
                f"{path}: `kind` is not that of an excitation plan of schema_version {_SCHEMA}"
            )
        keys = ("schema_version", "kind", "joint_names", "periods")
        head = parse(PlanFile, {key: content[key] for key in keys if key in content}, place)
        try:
            plan = cls(
                motion=_motion_from_mapping(content.get("motion"), place.key("motion")),
                joint_names=head.joint_names,
                periods=head.periods,
                objectives=content.get("objectives", {}),
                rsd_percent=content.get("rsd_percent", {}),
                check=Check(tuple(_margin_from_mapping(entry) for entry in content.get("margins", []))),
                provenance=content.get("provenance", {}),
            )
        except (KeyError, TypeError, ValueError, OverflowError) as error:
            reason = str(error) if isinstance(error, ConfigurationError) else f"not readable: {error!r:.200}"
            raise ConfigurationError(
                reason if reason.startswith(str(path)) else f"{path}: {reason}"
            ) from error
        if not plan.duration_s <= LONGEST_EXCITATION_S:
            raise ConfigurationError(
                f"{place.line_of('periods')}: {plan.periods} periods of {plan.period_s:g} s last "
                f"{plan.duration_s:g} s, limit {LONGEST_EXCITATION_S:g} s; lower `periods`"
            )
        return plan


def _motion_to_mapping(motion: ParametricMotion) -> dict[str, Any]:
    def lists(*keys: str) -> dict[str, Any]:
        return {key: np.asarray(getattr(motion, key)).tolist() for key in keys}

    if isinstance(motion, FourierSeries):
        head = {"type": "fourier", "period_s": float(motion.period_s), "harmonics": motion.harmonics}
        return head | lists("bias", "a", "b")
    if isinstance(motion, SplineMotion):
        return {"type": "bspline", "duration_s": float(motion.duration_s)} | lists("points")
    if isinstance(motion, PointToPoint):
        limits = lists("postures", "v_max", "a_max", "j_max")
        return {"type": "point to point"} | limits | {"dwell_s": float(motion.dwell_s)}
    raise ConfigurationError(f"a {type(motion).__name__} cannot be stored in a plan file")


def _motion_from_mapping(content: Any, where: Place) -> ParametricMotion:
    forms = {"fourier": FourierKeys, "bspline": SplineKeys, "point to point": PointKeys}
    kind = content.get("type") if isinstance(content, Mapping) else None
    if not isinstance(kind, str) or kind not in forms:
        place = where.line_of("type") if kind is not None else where
        raise ConfigurationError(f"{place}: motion type {kind!r:.40} is unknown; known: {', '.join(forms)}")
    form: Any = parse(forms[kind], content, where)

    def arrays(*keys: str) -> list[Array]:
        rows = [getattr(form, key) for key in keys]
        if any(len({len(row) for row in table}) > 1 for table in rows if isinstance(table[0], tuple)):
            raise ConfigurationError(f"{where}: rows of different lengths; give one number per column")
        return [np.array(table, dtype=np.float64) for table in rows]

    if isinstance(form, FourierKeys):
        return FourierSeries(form.period_s, *arrays("bias", "a", "b"))
    if isinstance(form, SplineKeys):
        return SplineMotion(form.duration_s, *arrays("points"))
    postures, v_max, a_max, j_max = arrays("postures", "v_max", "a_max", "j_max")
    return PointToPoint(postures, v_max, a_max, j_max, form.dwell_s)


def _margin_to_mapping(margin: Margin) -> dict[str, Any]:
    numbers = {key: float(getattr(margin, key)) for key in ("value", "limit", "slack")}
    head = {"constraint": margin.constraint, "subject": margin.subject}
    return (
        head | numbers | {"unit": margin.unit, "time_s": float(margin.time_s), "proven": bool(margin.proven)}
    )


def _margin_from_mapping(entry: Any) -> Margin:
    value, limit, slack, time_s = (float(entry[key]) for key in ("value", "limit", "slack", "time_s"))
    names = str(entry["constraint"]), str(entry["subject"])
    return Margin(*names, value, limit, slack, str(entry["unit"]), time_s, bool(entry.get("proven", True)))


def spread_text(values: Sequence[float]) -> str:
    """How near several independent searches came to the best of them, as a measure of what more could find.

    values : best value of each search, in reported units.
    """
    best, middle, last = (f"{v:.4g}" for v in (min(values), float(np.median(values)), max(values)))
    near = sum(value <= (1.0 + _SAME) * min(values) for value in values)
    advice = "" if near > 1 else ": no other confirms the best one, more may find a better motion"
    return (
        f"{len(values)} independent searches: best {best}, median {middle}, worst {last}; {near} within "
        f"{100 * _SAME:.0f} % of the best{advice}"
    )


def plan_pieces(plan: ExcitationPlan) -> list[Piece]:
    """Tables of a plan: criteria, tightest margins, largest predicted deviations; the spread of several searches."""
    found: list[Piece] = [
        Listing(("criterion", "value"), [(name, f"{v:.4f}") for name, v in plan.objectives.items()]),
        "",
        Listing(
            ("tightest margins", "of", "value", "limit", "unit", "at s", ""),
            [
                (
                    margin.constraint,
                    margin.subject,
                    f"{margin.value:.4g}",
                    f"{margin.limit:.4g}",
                    margin.unit,
                    f"{margin.time_s:.3f}",
                    "ok" if margin.ok else "violated" if margin.proven else "not proven",
                )
                for margin in plan.check.tightest()
            ],
        ),
    ]
    worst = sorted(plan.rsd_percent.items(), key=lambda item: -item[1])[:8]
    if worst:
        rows = [(name, f"{value:.2f}") for name, value in worst]
        found += ["", Listing(("largest predicted deviations", "RSD %"), rows)]
    searches = plan.provenance.get("searches", ())
    return [*found, "", spread_text(searches)] if len(searches) > 1 else found
