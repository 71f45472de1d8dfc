"""The diagnosis as a value: findings, unexplained remainders, gain; as text and as plain content."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import KW_ONLY, dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ident.diagnosis.gain.products import Floats
from ident.diagnosis.outcome.claims_in_words import SURE, finding_statement
from ident.diagnosis.outcome.details import moved_parameters, row_gains, session_errors
from ident.diagnosis.outcome.statements import Statements, statements
from ident.diagnosis.outcome.torque_errors import TorqueErrors
from ident.diagnosis.rows.broken_data import BrokenChannel
from ident.dynamics.tables import Tabular
from ident.effects.words import quantity_text
from ident.model import DynamicModel
from lwr_driver.notebook import subplots

SCHEMA_VERSION = 2

# Probability under chance that is written for what chance does not do, such as a count.
_BEYOND_CHANCE = 1e-12


@dataclass(frozen=True)
class Value:
    """A parameter: value, standard deviation, SI unit."""

    value: float
    std: float
    unit: str


@dataclass(frozen=True)
class FindingEvidence:
    """Evidence of a finding. test_rms [Nm] over `rows`, sides and joints from 1, the most affected; interval of their
    difference."""

    delta_bic: float
    p_value: float
    test_rms_before: float
    test_rms_after: float
    gain_interval_95: tuple[float, float]
    rows: tuple[tuple[str, int], ...] = ()

    @classmethod
    def counted(cls, delta_bic: float) -> FindingEvidence:
        """Beyond chance without any error in rows: counted in the samples, or in the parameters."""
        return cls(delta_bic, _BEYOND_CHANCE, 0.0, 0.0, (0.0, 0.0))


@dataclass(frozen=True)
class Finding:
    """A claim. joints : from 1, empty for the whole arm. mode : `within` or `between` sessions, or None.

    alternatives : (cause, joints, delta_bic). gain : fall of the cross-validated chi-square. grounds : of the
    confidence, see `confidence.Grounds`. detail : in words, what was counted in the samples. sessions : names of those
    with it, empty where it is not of some alone; payload : of a payload's error, its name, None for the bare flange.
    """

    cause: str
    side: str
    joints: tuple[int, ...]
    _: KW_ONLY
    parameters: Mapping[str, Value]
    evidence: FindingEvidence
    confidence: float
    alternatives: tuple[tuple[str, tuple[int, ...], float], ...] = ()
    tell_apart: str
    gain: float
    mode: str | None = None
    form: str | None = None
    grounds: Mapping[str, float] = field(default_factory=dict)
    detail: str | None = None
    sessions: tuple[str, ...] = ()
    payload: str | None = None

    @property
    def values(self) -> dict[str, tuple[float, float, str]]:
        """Value, standard deviation and unit by parameter."""
        return {name: (v.value, v.std, v.unit) for name, v in self.parameters.items()}

    def to_dict(self) -> dict[str, Any]:
        """Plain content."""
        content: dict[str, Any] = {
            "cause": self.cause,
            "side": self.side,
            "joints": list(self.joints),
            "parameters": {
                name: {"value": v.value, "std": v.std, "unit": v.unit} for name, v in self.parameters.items()
            },
            "evidence": {
                "delta_bic": self.evidence.delta_bic,
                "p_value": self.evidence.p_value,
                "test_rms_before": self.evidence.test_rms_before,
                "test_rms_after": self.evidence.test_rms_after,
                "gain_interval_95": list(self.evidence.gain_interval_95),
                "rows": [list(row) for row in self.evidence.rows],
            },
            "confidence": self.confidence,
            "alternatives": [
                {"cause": cause, "joints": list(joints), "delta_bic": bic}
                for cause, joints, bic in self.alternatives
            ],
            "tell_apart": self.tell_apart,
        }
        if self.mode is not None:
            content["mode"] = self.mode
        if self.form is not None:
            content["form"] = self.form
        if self.grounds:
            content["grounds"] = dict(self.grounds)
        if self.detail is not None:
            content["detail"] = self.detail
        if self.sessions:
            content |= {"sessions": list(self.sessions), "payload": self.payload}
        return content

    def __str__(self) -> str:
        return "\n".join(finding_statement(1, self.to_dict(), ()).lines())


@dataclass(frozen=True)
class Unexplained:
    """An unnamed remainder in the rows of a joint (from 1) and side.

    test_rms : error on held-out rows [Nm]. noise_floor : of these rows, or what the healthy arm may leave there [Nm].
    """

    side: str
    joint: int
    depends_on: tuple[str, ...]
    test_rms: float
    noise_floor: float

    @property
    def beyond_noise(self) -> bool:
        """Whether the error is beyond the noise; a remainder of the fit within it is none that a user meets."""
        return not self.test_rms <= self.noise_floor


@dataclass(frozen=True, eq=False)
class Nameless:
    """A term of the extended model without a name, in the torque of a joint (from 1) and side.

    depends_on : its variables. entries : of the model's effects. interval : 95 % of the fall of the error [Nm].
    """

    side: str
    joint: int
    depends_on: tuple[str, ...]
    entries: tuple[Mapping[str, Any], ...]
    test_rms_before: float
    test_rms_after: float
    interval: tuple[float, float]

    def to_dict(self) -> dict[str, Any]:
        """Plain content."""
        return {
            "side": self.side,
            "joint": self.joint,
            "depends_on": list(self.depends_on),
            "test_rms_before": self.test_rms_before,
            "test_rms_after": self.test_rms_after,
            "gain_interval_95": list(self.interval),
        }


@dataclass(frozen=True, eq=False)
class SimulationError:
    """RMS error (n,) of the simulated session: position [rad], motor and joint torque [Nm].

    method : the simulation behind each of them, in words.
    """

    position: Floats | None
    motor: Floats | None
    joint: Floats | None
    method: Mapping[str, str] = field(default_factory=dict)

    def to_dict(self) -> dict[str, Any]:
        """Plain content."""
        return {"motor": _plain(self.motor), "joint": _plain(self.joint), "position": _plain(self.position)}


@dataclass(frozen=True, eq=False)
class RowStates:
    """State of the arm in the m rows of a side, for plots of residuals.

    time : (m,) [s] in the session. session : (m,) number in the order of the sessions, from 0. block : (m,) of
    mutually dependent rows. position, speed, load : (m, n) [rad, rad/s, Nm] of each joint, with the predicted load.
    """

    time: Floats
    session: NDArray[np.int64]
    block: NDArray[np.int64]
    position: Floats
    speed: Floats
    load: Floats


@dataclass(frozen=True, eq=False)
class Diagnosis(Tabular):
    """Everything that was found; prints itself.

    findings : changes against the reference, or what no healthy arm of the kind has. character : what every such drive
    has and the base model lacks. doubted : names more likely wrong than right, with confidence 0 those that held-out
    rows refute. nameless : fitted terms without a name. unexplained : remainders that could not be fitted.
    extension : `cause(joints)` of all in the extended model, `cause(joint: variable)` of a term without a name.
    base_model, extended_model : fitted to the training sessions, without and with the findings' effects.
    changes : change of the base parameters by the extension, in their standard deviations.
    rms_base, rms_extended : rms error (n,) [Nm] by side in the held-out rows, beside the noise_floor of these rows.
    healthy_left : the same of the base model on the healthy arm of the reference, empty if unknown.
    torque_base, torque_extended : errors of the models in the test sessions with all samples, None without any.
    torque_present : the same of the present model, None without one.
    referenced : against a healthy arm. numbered : names of all sessions, in the order of their numbers.
    notes : sentences on limits of the data. data : broken channels, left out. in_doubt : channels that may
    be broken, with rows that stay; no cause beside them is sure.
    residuals : held-out residual (m, n) [Nm] by model (`base`, `extended`) and side, NaN in unused rows.
    states : of the arm in these rows, by side.
    """

    train: tuple[str, ...]
    test: tuple[str, ...]
    model_number: int
    findings: tuple[Finding, ...]
    unexplained: tuple[Unexplained, ...]
    noise_floor: Mapping[str, Floats]
    rms_base: Mapping[str, Floats]
    rms_extended: Mapping[str, Floats]
    base_model: DynamicModel
    extended_model: DynamicModel
    changes: Mapping[str, float]
    scores: Mapping[tuple[str, int], float]
    nuisance: Mapping[str, tuple[float, float]]
    simulation_base: SimulationError | None = None
    simulation_extended: SimulationError | None = None
    notes: tuple[str, ...] = ()
    character: tuple[Finding, ...] = ()
    doubted: tuple[Finding, ...] = ()
    nameless: tuple[Nameless, ...] = ()
    extension: tuple[str, ...] = ()
    residuals: Mapping[str, Mapping[str, Floats]] = field(default_factory=dict, repr=False)
    states: Mapping[str, RowStates] = field(default_factory=dict, repr=False)
    referenced: bool = False
    numbered: tuple[str, ...] = ()
    data: tuple[BrokenChannel, ...] = ()
    in_doubt: tuple[BrokenChannel, ...] = ()
    healthy: tuple[Mapping[str, Any], ...] = ()
    healthy_left: Mapping[str, Floats] = field(default_factory=dict)
    torque_base: TorqueErrors | None = None
    torque_extended: TorqueErrors | None = None
    torque_present: TorqueErrors | None = None

    @property
    def torque_rms_base(self) -> dict[str, Floats]:
        """Rms error (n,) [Nm] of the base model by side, all samples of the test sessions pooled, as `validate`
        measures it; empty without test sessions, without a side that has no score. `rms_base` is that of the rows."""
        return {} if self.torque_base is None else self.torque_base.rms()

    @property
    def torque_rms_extended(self) -> dict[str, Floats]:
        """The same of the extended model; `rms_extended` is that of the rows."""
        return {} if self.torque_extended is None else self.torque_extended.rms()

    @property
    def claims(self) -> tuple[Finding, ...]:
        """Findings and character."""
        return (*self.findings, *self.character)

    def records(self) -> list[dict[str, Any]]:
        """One row for each finding and each character of the arm."""
        return [
            {
                "cause": f.cause,
                "kind": "finding" if f in self.findings else "character",
                "side": f.side,
                "joint": _place(f),
                "parameters": _values(f),
                "confidence": f.confidence,
                "rms_before": f.evidence.test_rms_before,
                "rms_after": f.evidence.test_rms_after,
                "gain": f.gain,
            }
            for f in self.claims
        ]

    def plot(self) -> Any:
        """RMS error on held-out rows by joint, before and after; the matplotlib Axes, one for each side."""
        sides = list(self.rms_base)
        size = (4.0 * len(sides), 3.0)
        axes = subplots(1, len(sides), figsize=size)
        for axis, side in zip(axes, sides, strict=True):
            rows = (
                ("noise floor", self.noise_floor.get(side)),
                ("base model", self.rms_base[side]),
                ("extended model", self.rms_extended.get(side)),
            )
            for k, (label, values) in enumerate(rows):
                if values is not None:
                    axis.bar(np.arange(len(values)) + 1 + 0.27 * (k - 1), values, 0.27, label=label)
            axis.set(title=f"{side} torque", xlabel="joint", ylabel="rms error, held out [Nm]")
        axes[0].legend(fontsize="small")
        return axes

    def to_dict(self) -> dict[str, Any]:
        """Content of `diagnosis.json`, with null for missing errors."""
        none = {"motor": None, "joint": None, "position": None}
        base = self.simulation_base.to_dict() if self.simulation_base else none
        extended = self.simulation_extended.to_dict() if self.simulation_extended else none
        return {
            "schema_version": SCHEMA_VERSION,
            "sessions": {"train": list(self.train), "test": list(self.test)},
            "baseline": {
                "model": self.model_number,
                "test_rms": _sides(self.rms_base),
                "noise_floor": _sides(self.noise_floor),
                "simulation_error": base,
            },
            "data": [broken.to_dict() for broken in self.data],
            "findings": [finding.to_dict() for finding in self.findings],
            "character": [finding.to_dict() for finding in self.character],
            "healthy": [
                {
                    "cause": entry["cause"],
                    "joints": list(entry["joints"]),
                    "parameters": {name: dict(value) for name, value in entry["parameters"].items()},
                }
                for entry in self.healthy
            ],
            "nameless": [term.to_dict() for term in self.nameless],
            "unexplained": [
                {
                    "side": u.side,
                    "joint": u.joint,
                    "depends_on": list(u.depends_on),
                    "test_rms": u.test_rms,
                    "noise_floor": u.noise_floor,
                }
                for u in self.unexplained
            ],
            "gain": {
                "test_rms_base": _sides(self.rms_base if self.torque_base is None else self.torque_rms_base),
                "test_rms_extended": _sides(
                    self.rms_extended if self.torque_extended is None else self.torque_rms_extended
                ),
                "rows_base": _sides(self.rms_base),
                "rows_extended": _sides(self.rms_extended),
                "simulation_error_base": base,
                "simulation_error_extended": extended,
                "simulation": dict(self.simulation_base.method) if self.simulation_base else {},
            },
            "extension": list(self.extension),
            "model": "model_extended.yaml",
        }

    @cached_property
    def details(self) -> dict[str, Any]:
        """Content of `details.json` about the verdict: errors of each joint, parameters moved, limits of the data,
        channels in doubt."""
        return {
            "sessions": list(self.numbered),
            "joints": list(self.base_model.structure.chain.joint_names),
            "reference": self.referenced,
            "sure": SURE,
            "rows": row_gains(self),
            "base_parameters": moved_parameters(self),
            "notes": list(self.notes),
            "in_doubt": [one.to_dict() for one in self.in_doubt],
            "doubted": [finding.to_dict() for finding in self.doubted],
            "torque_errors": session_errors(self),
        }

    def statements(self) -> Statements:
        """The diagnosis in words."""
        return statements(self.to_dict(), self.details, self.details["joints"])

    def __str__(self) -> str:
        return self.statements().text()

    def __repr__(self) -> str:
        return self.statements().brief()


def _place(finding: Finding) -> str:
    return f"joint {' and '.join(map(str, finding.joints))}" if finding.joints else "whole arm"


def _values(finding: Finding) -> str:
    return ", ".join(
        f"{name} {quantity_text(v.value, v.std, v.unit)}" for name, v in finding.parameters.items()
    )


def _sides(table: Mapping[str, Floats]) -> dict[str, Any]:
    return {side: _plain(table.get(side)) for side in ("motor", "joint")}


def _plain(values: Floats | None) -> list[float | None] | None:
    if values is None:
        return None
    return [float(v) if math.isfinite(v) else None for v in np.asarray(values, dtype=float)]
