"""What an identification is asked for, and what it finds."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from fri.errors import ConfigurationError
from ident.dynamics.base_set import BaseSet
from ident.dynamics.structure import Coulomb, Coupling, ModelStructure
from ident.dynamics.tables import Tabular
from ident.estimation.assumptions import Assumptions
from ident.estimation.essential import Essential, EssentialSettings
from ident.estimation.feasibility import Feasibility
from ident.estimators import ESTIMATORS
from ident.estimators.covariance import CovarianceSettings
from ident.estimators.estimate import Estimate, Estimator, two_digits
from ident.estimators.names import AUTO
from ident.estimators.problem import Problem, condition_text
from ident.model.dynamic_model import DynamicModel
from ident.model.signals import signals_entry
from ident.rows.filters import SignalSettings
from ident.rows.prepared import PreparedSession
from ident.screening.doubts import Doubt
from lwr_driver.listing import Piece, text_of

if TYPE_CHECKING:
    from ident.estimation.choice import Choice

EstimatorFactory = Callable[[BaseSet, Problem, CovarianceSettings], Estimator]


@dataclass(frozen=True)
class IdentificationSettings:
    """Model, estimator and signal processing of an identification.

    model : 1 (joint torque), 2 (motor and joint torque), 3 (their difference).
    estimator : one of `ESTIMATORS`, "auto" (the best on held-back parts of the motion), or a factory from base set,
        problem and covariance settings to an estimator. "iv" takes the commanded motion as instruments. "wls"
        (default) uses the data alone.
        "physical" (consistent bodies within 20 % of the URDF's) predicts new motions best, above all after a
        short or weakly exciting recording: on three runs of a real LWR4+ its error is 3 to 4 %, that of least
        squares 9 to 14 % (`benchmarks/real_data.py`).
    without : parameters left out of the model, by symbol or name. couplings : see `ModelStructure`.
    coulomb : the function for sign(qd) of the model; None takes the one that predicts best. row_coulomb : that of the
        rows, if another; see `ident.rows.signal_choice`.
    resonance_hz : lowest structural resonance of the arm, for advice on the cut-offs.
    essential : settings of the search for essential parameters; None skips it.
    robot : name of the arm in the model; default from the sessions' metadata.
    """

    model: int = 2
    signals: SignalSettings = field(default_factory=SignalSettings)
    estimator: str | EstimatorFactory = "wls"
    covariance: CovarianceSettings = field(default_factory=CovarianceSettings)
    without: tuple[str, ...] = ()
    couplings: tuple[Coupling, ...] = ()
    coulomb: Coulomb | None = None
    row_coulomb: Coulomb | None = None
    resonance_hz: float | None = None
    essential: EssentialSettings | None = field(default_factory=EssentialSettings)
    robot: str = ""

    def __post_init__(self) -> None:
        if isinstance(self.estimator, str) and self.estimator not in (AUTO, *ESTIMATORS):
            known = ", ".join((AUTO, *ESTIMATORS))
            raise ConfigurationError(f"estimator {self.estimator!r} is unknown; choose one of {known}")


@dataclass(frozen=True)
class Known:
    """What an earlier step of the same command knows of its sessions.

    doubts : of their screening. signal_reasons : why the signal settings are as they are, where the data
    chose them.
    """

    doubts: tuple[Doubt, ...] = ()
    signal_reasons: tuple[str, ...] = ()


@dataclass(frozen=True)
class Identification(Tabular):
    """Result of `identify`.

    base : the base parameters and their regrouping. estimate : values, covariance and residuals.
    prepared : the filtered sessions, without their samples. problem : the stacked regression.
    warnings : sentences for the report. choice : of the estimator, with "auto". known : of the sessions, for a further
    identification of them. effects : of the model beside its parameters (sensor gains, turning friction). marks : of
    the rows of each session, by which a copy is known (`ident.rows.shared_rows`). feasibility : whether real bodies and
    drives have the parameters.
    """

    settings: IdentificationSettings
    structure: ModelStructure
    base: BaseSet
    problem: Problem
    estimate: Estimate
    prepared: tuple[PreparedSession, ...]
    payloads: tuple[str | None, ...]
    condition: float
    condition_normalised: float
    assumptions: Assumptions
    essential: Essential | None
    robot: str
    warnings: tuple[str, ...]
    known: Known = field(default_factory=Known)
    choice: Choice | None = None
    effects: tuple[Mapping[str, Any], ...] = ()
    marks: tuple[str, ...] = ()
    feasibility: Feasibility | None = None

    @cached_property
    def model(self) -> DynamicModel:
        """The identified model with all base parameters."""
        return self._model(self.base.names, self.estimate)

    @cached_property
    def essential_model(self) -> DynamicModel:
        """The identified model with the essential parameters only.

        Raises ConfigurationError when the settings skip the search for them.
        """
        if self.essential is None:
            raise ConfigurationError("essential parameters were not sought; set `essential` in the settings")
        return self._model(self.essential.names, self.essential.estimate)

    def _model(self, names: tuple[str, ...], found: Estimate) -> DynamicModel:
        provenance: dict[str, Any] = {
            "estimator": self.estimate.method,
            "covariance": self.estimate.covariance.kind,
            "sessions": [
                {"file": session.name, "uid": session.uid, "payload": payload or "none"}
                | ({"rows": rows} if rows else {})
                for session, payload, rows in zip(
                    self.prepared, self.payloads, self.marks or ("",) * len(self.prepared), strict=True
                )
            ],
            "signals": signals_entry(self.settings.signals, self.prepared),
        }
        freedom = found.covariance.degrees_of_freedom
        if np.isfinite(freedom):
            provenance["degrees_of_freedom"] = float(freedom)
        if self.choice is not None:
            provenance["choice"] = self.choice.to_dict()
        matrix = found.covariance.matrix
        base = self.base
        return DynamicModel(
            self.robot, self.structure, names, found.values, matrix, base, provenance, self.effects
        )

    @property
    def counts(self) -> dict[str, int]:
        """Numbers of standard, not identifiable, regrouped and base parameters."""
        return {
            "standard": int(self.structure.active.sum()),
            "not_identifiable": len(self.base.not_identifiable),
            "regrouped": len(self.base.dependent),
            "base": len(self.base),
        }

    @property
    def parameters(self) -> list[dict[str, Any]]:
        """One row for each base parameter: name, unit, estimate, std, rsd_percent."""
        return self.estimate.records()

    @property
    def median_rsd_percent(self) -> float:
        """Median relative standard deviation [%] of the essential parameters, in their own estimate; of all base
        parameters where these were not sought, infinite where no parameter is left."""
        chosen = self.estimate if self.essential is None else self.essential.estimate
        return float(np.median(chosen.rsd_percent)) if len(chosen.names) else float("inf")

    @property
    def _condition(self) -> str:
        plain, normalised = condition_text(self.condition), condition_text(self.condition_normalised)
        return f"condition number {plain}, columns normalised {normalised}"

    @property
    def torque_rms(self) -> dict[str, dict[str, float]]:
        """Root mean square of the residual torque [Nm] by side and joint."""
        result: dict[str, dict[str, float]] = {}
        for fit in self.estimate.classes:
            result.setdefault(fit.side, {})[fit.joint] = fit.rms
        return result

    def to_dict(self) -> dict[str, Any]:
        """Plain content for files and reports."""
        return {
            "model": self.settings.model,
            "estimator": self.estimate.method,
            "covariance": self.estimate.covariance.kind,
            "sessions": [
                {
                    "name": session.name,
                    "payload": payload,
                    "rows": session.counts["rows"],
                    "lost_samples": session.counts["lost"],
                    "old_samples": session.counts["stale"],
                    "motor_delay_s": session.delay.seconds if session.delay is not None else None,
                    "motor_delay_std_s": session.delay.std or None if session.delay is not None else None,
                    "joint_delay_s": session.joint_delay.seconds if session.joint_delay is not None else None,
                    "joint_delay_std_s": session.joint_delay.std or None
                    if session.joint_delay is not None
                    else None,
                    "stamp_jitter_s": session.jitter_s,
                    "excitation_hz": session.excitation_hz,
                    "cutoff_hz": session.cutoff_hz,
                }
                for session, payload in zip(self.prepared, self.payloads, strict=True)
            ],
            "counts": self.counts,
            "signals": dataclasses.asdict(self.settings.signals)
            | {"reasons": list(self.known.signal_reasons)},
            "condition": self.condition,
            "condition_normalised": self.condition_normalised,
            "parameters": self.parameters,
            "median_rsd_percent": self.median_rsd_percent,
            "torque_rms": self.torque_rms,
            "assumptions": self.assumptions.to_dict(),
            "essential": None if self.essential is None else self.essential.to_dict(),
            "prior_only": list(self.estimate.prior_only),
            "feasibility": None if self.feasibility is None else self.feasibility.to_dict(),
            "choice": None if self.choice is None else self.choice.to_dict(),
            "warnings": list(self.warnings),
        }

    def records(self) -> list[dict[str, Any]]:
        """`parameters`."""
        return self.parameters

    def plot(self) -> Any:
        """`estimate.plot()`: parameters with their 95 % intervals."""
        return self.estimate.plot()

    def __repr__(self) -> str:
        counts = ", ".join(f"{value} {key.replace('_', ' ')}" for key, value in self.counts.items())
        violated = [check.name for check in self.assumptions.checks if check.holds is False]
        return "\n".join(
            [
                f"Identification of {self.robot}, Model {self.settings.model}, sessions: {len(self.prepared)}",
                f"  parameters: {counts}"
                + ("" if self.essential is None else f", {len(self.essential.names)} essential")
                + f", median relative std {two_digits(self.median_rsd_percent)} %",
                f"  {self._condition}",
                f"  violated assumptions: {', '.join(violated) or 'none'}; warnings: {len(self.warnings)}",
                *(f"  {line.strip()}" for line in repr(self.estimate).splitlines()[:6]),
            ]
        )

    def summary(self) -> str:
        """Counts, sessions, parameters, residuals, assumptions and warnings as text."""
        return text_of(self.pieces())

    def pieces(self) -> list[Piece]:
        """The same with its tables."""
        counts = self.counts
        lines: list[Piece] = [
            f"Model {self.settings.model}: {counts['standard']} parameters, {counts['not_identifiable']} "
            f"not identifiable, {counts['regrouped']} regrouped, {counts['base']} base"
        ]
        for session, payload in zip(self.prepared, self.payloads, strict=True):
            delay = f", motor channel {session.delay}" if session.delay is not None else ""
            if session.joint_delay is not None:
                delay += f", joint torques {session.joint_delay}"
            lines.append(
                f"{session.name}: payload {payload or 'none'}, {session.counts['rows']} rows, "
                f"{session.counts['lost']} samples lost, {session.counts['stale']} repeated or older than their "
                f"stamps{delay}"
            )
            if session.jitter_s is not None:
                lines.append(
                    f"{session.name}: stamps jitter by {1e3 * session.jitter_s:.2g} ms rms about an even sample time; "
                    "times counted by the motion"
                )
        lines += self.known.signal_reasons
        lines.append(self._condition)
        if self.choice is not None:
            lines += ["", *self.choice.pieces()]
        lines += ["", *self.estimate.pieces(), "", *self.assumptions.pieces()]
        if self.essential is not None:
            lines += ["", *self.essential.pieces()]
        which = "base" if self.essential is None else "essential"
        text = f"median relative standard deviation of the {which} parameters: {two_digits(self.median_rsd_percent)} %"
        lines += ["", text]
        if self.feasibility is not None:
            lines += ["", f"{self.feasibility}"]
        if self.warnings:
            lines += ["", *(f"warning: {warning}" for warning in self.warnings)]
        return lines
