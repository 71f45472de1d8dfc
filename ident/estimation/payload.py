"""The ten parameters of a payload from a known arm model and a loaded session.

With the arm's parameters chi known with covariance S, the rows of the loaded session are::

    y - A chi = P x + e         x = XX XY XZ YY YZ ZZ MX MY MZ M of the payload in the frame of the last link

x is estimated by weighted least squares, and its covariance has two parts: that of the residual, robust to
serial correlation, and that of the arm model, G A S A' G' with G the estimator's matrix. The second does not
shrink with more data of the loaded arm.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fri.errors import ConfigurationError, DataError
from ident.dynamics.base_set import numeric_base
from ident.dynamics.parameters import INERTIAL, PER_LINK, Floats, to_com
from ident.dynamics.physical import project, reference_bodies
from ident.dynamics.structure import Condition, ModelStructure
from ident.dynamics.tables import Tabular, rows_of
from ident.estimation.validate import seen_sessions, signals_for
from ident.estimators.covariance import CovarianceSettings
from ident.estimators.least_squares import WeightedLeastSquares
from ident.estimators.problem import Problem
from ident.model.dynamic_model import DynamicModel
from ident.model.model_file import Model, as_model
from ident.rows.filters import SignalSettings
from ident.rows.observation import observe
from ident.rows.prepare import prepare
from ident.rows.sessions import payload_name, stated_mass
from lwr_driver.listing import Listing, Piece, text_of
from lwr_driver.session import Session, Sessions, as_sessions

_BODY = len(INERTIAL)
_LINK = len(PER_LINK)


@dataclass(frozen=True, eq=False)
class PayloadEstimate(Tabular):
    """A payload's parameters; prints itself.

    values, covariance : (10,), (10, 10) in the frame of the last link, from residual and arm model together.
    arm_covariance : (10, 10), the arm model's part of it (zero when the model has no covariance).
    cross : (10, p), covariance with the arm model's parameters.
    consistent : (10,) the nearest physically consistent body. exact : whether it is the estimate itself.
    announced_kg : mass in the session's metadata, None without.
    residual : rms of the rows by joint and side [Nm], of a prismatic joint [N].
    offsets : estimated shifts of the torque offsets by joint, empty for fixed offsets. torque_units : by the names of
        `residual` and `offsets`.
    """

    payload: str
    session: str
    robot: str
    names: tuple[str, ...]
    units: tuple[str, ...]
    values: Floats
    covariance: Floats
    arm_covariance: Floats
    cross: Floats
    consistent: Floats
    exact: bool
    announced_kg: float | None
    residual: dict[str, float]
    offsets: dict[str, float] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    torque_units: dict[str, str] = field(default_factory=dict)

    @property
    def std(self) -> Floats:
        """Standard deviations (10,)."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def mass(self) -> float:
        """Mass [kg]."""
        return float(self.values[9])

    @property
    def mass_std(self) -> float:
        """Standard deviation of the mass [kg]."""
        return float(self.std[9])

    @property
    def com(self) -> Floats:
        """Centre of mass (3,) in the frame of the last link [m]."""
        return self.values[6:9] / self.mass

    @property
    def com_std(self) -> Floats:
        """Standard deviation (3,) of the centre of mass, to first order [m]."""
        slope = np.zeros((3, _BODY))
        slope[:, 6:9] = np.eye(3) / self.mass
        slope[:, 9] = -self.com / self.mass
        return np.sqrt(np.einsum("ij,jk,ik->i", slope, self.covariance, slope))

    @property
    def mass_deviation(self) -> float:
        """Estimated minus announced mass in standard deviations; NaN without an announced mass."""
        if self.announced_kg is None:
            return math.nan
        return (self.mass - self.announced_kg) / self.mass_std

    @property
    def verdict(self) -> str:
        """The estimated mass against the announced one, in words."""
        if self.announced_kg is None:
            return "no mass was announced for this payload"
        difference = self.mass - self.announced_kg
        percent = 100.0 * difference / self.announced_kg if self.announced_kg else math.inf
        text = (
            f"announced {self.announced_kg:.3f} kg: {difference:+.3f} kg ({percent:+.1f} %), "
            f"{abs(self.mass_deviation):.1f} standard deviations"
        )
        if abs(self.mass_deviation) <= 3.0:
            return f"{text}; they agree"
        if abs(percent) <= 3.0:
            return f"{text}; more than chance: the torque sensors' gain or parts not weighed"
        return f"{text}; they contradict: check the mounted payload and the announced mass"

    def to_dict(self) -> dict[str, Any]:
        """Plain content for JSON."""
        return {
            "schema_version": 1,
            "robot": self.robot,
            "session": self.session,
            "payload": self.payload,
            "parameters": self.records(),
            "mass_kg": self.mass,
            "mass_std_kg": self.mass_std,
            "com_m": self.com.tolist(),
            "com_std_m": self.com_std.tolist(),
            "announced_kg": self.announced_kg,
            "verdict": self.verdict,
            "consistent_exact": self.exact,
            "residual_rms_nm": self.residual,
            "offset_shifts_nm": self.offsets,
            "notes": list(self.notes),
        }

    def records(self) -> list[dict[str, Any]]:
        """One row for each of the ten parameters."""
        values, std, bodies = self.values.tolist(), self.std.tolist(), self.consistent.tolist()
        return rows_of(name=self.names, unit=self.units, value=values, std=std, consistent=bodies)

    @property
    def centre(self) -> str:
        """The centre of mass in mm with its standard deviations, to their first digit."""
        shown = []
        for c, s in zip(1e3 * self.com, 1e3 * self.com_std, strict=True):
            digits = max(1, -math.floor(math.log10(s))) if 0.0 < s < math.inf else 1
            shown.append(f"{c:z.{digits}f} ± {s:.{digits}f}")
        return f"{', '.join(shown)} mm"

    @property
    def _mass_and_com(self) -> list[str]:
        return [
            f"  mass {self.mass:.4f} ± {self.mass_std:.4f} kg; {self.verdict}",
            f"  centre of mass x, y, z: {self.centre}",
        ]

    def __repr__(self) -> str:
        return "\n".join(
            [
                f"Payload {self.payload!r} of {self.robot} from {self.session}",
                *self._mass_and_com,
                f"  physically consistent: {'yes' if self.exact else 'no, see `consistent`'}; residual rms up to "
                f"{self.largest_residual}",
            ]
        )

    def listing(self) -> Listing:
        """The ten parameters as a table."""
        arm = np.sqrt(np.diag(self.arm_covariance))
        rows = [
            (name, f"{value:.5g}", f"{std:.2g}", f"{of_arm:.2g}", f"{body:.5g}", unit)
            for name, value, std, of_arm, body, unit in zip(
                self.names, self.values, self.std, arm, self.consistent, self.units, strict=True
            )
        ]
        return Listing(("", "estimate", "std", "of it arm", "consistent", "unit"), rows)

    @property
    def largest_residual(self) -> str:
        """The largest rms of the residual, with its unit."""
        key = max(self.residual, key=lambda name: self.residual[name])
        return f"{self.residual[key]:.3f} {self.torque_units.get(key, 'Nm')}"

    def _in_units(self, values: Mapping[str, float], form: str) -> str:
        """Torques behind a title: the unit first if all have it, else behind each."""
        units = [self.torque_units.get(key, "Nm") for key in values]
        mixed = len(set(units)) > 1
        shown = (
            f"{key} {value:{form}}" + f" {unit}" * mixed
            for (key, value), unit in zip(values.items(), units, strict=True)
        )
        return ("" if mixed else f" [{units[0]}]") + f": {', '.join(shown)}"

    def pieces(self) -> list[Piece]:
        """The table, mass and centre of mass, the consistent body, residuals and notes."""
        lines: list[Piece] = [
            f"Payload {self.payload!r} of {self.robot}, {self.session}, in the frame of the last link",
            self.listing(),
        ]
        mass, _, tensor = to_com(self.consistent)
        moments = ", ".join(f"{value:.4g}" for value in np.linalg.eigvalsh(tensor))
        lines += [
            *self._mass_and_com,
            f"  consistent body: {float(mass):.4f} kg, principal moments {moments} kg m^2"
            + (" (the estimate itself)" if self.exact else ""),
            f"  residual rms{self._in_units(self.residual, '.3f')}",
        ]
        if self.offsets:
            lines.append(f"  offsets moved since the arm model by{self._in_units(self.offsets, '+.3f')}")
        return [*lines, *(f"  {note}" for note in self.notes)]

    def __str__(self) -> str:
        return text_of(self.pieces())


def identify_payload(
    model: Model,
    sessions: Sessions,
    *,
    settings: SignalSettings | None = None,
    covariance: CovarianceSettings | None = None,
    free_offsets: bool = False,
) -> PayloadEstimate:
    """Estimate the payload of one or more sessions with the same payload, given a model of the arm.

    model : a model or the path of its file. sessions : a session, the path of a log, or several of either.
    settings : of the signals; default those of the model.
    free_offsets : estimate new torque offsets too, because sensor zeros move between mountings.

    Raises DataError for a session without payload, for different payloads or other joints, and for a motion
    too poor for the ten parameters (they are named); ConfigurationError for arguments of a wrong type, a model
    without a rigid part, and one with a payload inside its arm.
    """
    model = as_model(model)
    sessions = as_sessions(sessions)
    if not sessions:
        raise DataError("no session given; name a session with the payload mounted")
    if model.structure.sides == ("difference",):
        raise ConfigurationError(
            f"the model of {model.robot} describes torque differences, unchanged by a payload; use Model 1 or 2"
        )
    payload = _payload_name(sessions)
    structure, arm_columns, body, offset_columns = _structure(model, payload, free_offsets)
    chosen = [session.select(structure.chain.joint_names) for session in sessions]
    signals = signals_for(model, settings)
    prepared = [prepare(session, signals, motor="motor" in structure.sides) for session in chosen]
    known = _arm_parameters(model)
    columns = np.concatenate([arm_columns, body, offset_columns])
    names = [structure.names[c] for c in columns]
    rows = observe(prepared, [payload] * len(prepared), structure, columns=columns, names=names)
    problem = _reduced(rows, model.values[known], [structure.units[c] for c in columns])
    problem.require_rank()
    fitted = WeightedLeastSquares(covariance or CovarianceSettings()).fit(problem)
    influence = _influence(rows, fitted.weights, len(arm_columns))
    if model.covariance is None:
        arm = np.zeros((len(fitted.values),) * 2)
        cross = np.zeros((len(fitted.values), len(model.values)))
        notes: tuple[str, ...] = (
            "The arm model has no covariance: the standard deviations hold for a perfectly known arm.",
        )
    else:
        arm = influence @ model.covariance[np.ix_(known, known)] @ influence.T
        cross = -influence @ model.covariance[known]
        notes = ()
    flags = seen_sessions(model, sessions)
    shared = [session.path.name for session, flag in zip(sessions, flags, strict=True) if flag]
    if shared:
        notes = (
            *notes,
            f"WARNING: the arm model was fitted to {', '.join(shared)} too, so the errors of arm and payload are not "
            "independent and the standard deviations too small; take an arm model of other sessions, or the payload "
            "estimate that is part of this one.",
        )
    whole = fitted.covariance.matrix + arm
    values = fitted.values[:_BODY]
    if values[9] <= 0.0:
        raise DataError(
            f"payload {payload!r}: the estimated mass is {values[9]:.3f} kg; it was not mounted, or the arm "
            "model was identified with it: check the sessions' metadata"
        )
    found = project(
        np.eye(_BODY), values, reference_bodies(values, gyration_m=0.005), covariance=whole[:_BODY, :_BODY]
    )
    return PayloadEstimate(
        payload=payload,
        session=", ".join(session.path.name for session in sessions),
        robot=model.robot,
        names=tuple(structure.names[c] for c in body),
        units=tuple(structure.units[c] for c in body),
        values=values,
        covariance=whole[:_BODY, :_BODY],
        arm_covariance=arm[:_BODY, :_BODY],
        cross=cross[:_BODY],
        consistent=found.bodies[0],
        exact=found.exact,
        announced_kg=next((m for m in map(stated_mass, sessions) if m is not None), None),
        residual={fit.label: fit.rms for fit in fitted.classes},
        torque_units={fit.label: fit.unit for fit in fitted.classes}
        | {structure.names[c]: structure.units[c] for c in offset_columns},
        offsets={
            structure.names[c]: float(v) for c, v in zip(offset_columns, fitted.values[_BODY:], strict=True)
        },
        notes=notes,
    )


def with_payload(model: DynamicModel, estimate: PayloadEstimate) -> DynamicModel:
    """The arm model with the payload, covariances between the two included.

    Raises ConfigurationError for a payload already in the model, and for payload parameters regrouped with the
    arm's under the model's conditions.
    """
    if estimate.payload in model.structure.payloads:
        raise ConfigurationError(f"the model has a payload {estimate.payload!r} already; nothing was added")
    structure = replace(model.structure, payloads=(*model.structure.payloads, estimate.payload))
    base = None
    names = model.names
    if model.base is not None:
        loaded = Condition(estimate.payload, model.structure.sides)
        base = numeric_base(structure, (*model.base.conditions, loaded))
        columns = [base.columns.tolist().index(column) for column in model.columns if column in base.columns]
        if len(columns) != len(model.columns) or any(name not in base.names for name in estimate.names):
            raise ConfigurationError(
                f"payload {estimate.payload!r} regroups with the arm's parameters under the conditions of "
                "this model; identify the arm from an unloaded session first"
            )
        names = tuple(base.names[k] for k in columns)
    covariance = None
    if model.covariance is not None:
        covariance = np.block([[model.covariance, estimate.cross.T], [estimate.cross, estimate.covariance]])
    return DynamicModel(
        robot=model.robot,
        structure=structure,
        names=(*names, *estimate.names),
        values=np.concatenate([model.values, estimate.values]),
        covariance=covariance,
        base=base,
        provenance={**model.provenance, "payload": {"name": estimate.payload, "session": estimate.session}},
        effects=model.effects,
    )


def _payload_name(sessions: Sequence[Session]) -> str:
    found = {payload_name(session) or "none" for session in sessions}
    if len(found) > 1:
        raise DataError(
            f"the sessions carry different payloads ({', '.join(sorted(found))}); identify each by itself"
        )
    name = found.pop()
    if name == "none":
        raise DataError(
            f"{sessions[0].path.name}: its metadata announce no payload; give a loaded session, or correct "
            "the metadata if a payload was mounted"
        )
    return name


def _structure(
    model: DynamicModel, payload: str, free_offsets: bool
) -> tuple[ModelStructure, NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """Structure of the arm with this payload alone; columns of the arm, the payload and free offsets."""
    own = model.structure
    if model.base is not None and all(c.payload is not None for c in model.base.conditions):
        raise ConfigurationError(
            f"the model of {model.robot} was identified with a payload mounted all the time, so its arm "
            "contains that payload; identify the arm with an unloaded session"
        )
    structure = replace(own, payloads=(payload,))
    names = [own.names[column] for column in model.columns[_arm_parameters(model)]]
    # Couplings stand behind the payloads' columns, so places are found by name.
    arm = np.array([structure.index(name) for name in names], dtype=np.int64)
    link = structure.chain.n
    body = np.arange(_LINK * link, _LINK * link + _BODY)
    symbol = "offl" if "joint" in structure.sides else "offm"
    offsets = [structure.index(f"{symbol}{k + 1}") for k in range(structure.chain.n)] if free_offsets else []
    return structure, arm, body, np.array(offsets, dtype=np.int64)


def _arm_parameters(model: DynamicModel) -> NDArray[np.int64]:
    """The model's parameters of the arm, without those of its payloads."""
    first, count = _LINK * model.structure.chain.n, _LINK * len(model.structure.payloads)
    return np.flatnonzero((model.columns < first) | (model.columns >= first + count))


def _reduced(rows: Problem, chi: Floats, units: Sequence[str]) -> Problem:
    """The rows minus the torque of the arm's parameters `chi`, with the remaining columns."""
    arm = len(chi)
    groups = [
        replace(
            group,
            matrix=np.ascontiguousarray(group.matrix[:, arm:]),
            target=group.target - group.matrix[:, :arm] @ chi,
        )
        for group in rows.groups
    ]
    return replace(rows, names=rows.names[arm:], groups=tuple(groups), units=tuple(units[arm:]))


def _influence(rows: Problem, weights: Floats, arm: int) -> Floats:
    """G A (k, p): fall of the estimate per unit of the arm's parameters."""
    count = len(rows.names) - arm
    normal, mixed = np.zeros((count, count)), np.zeros((count, arm))
    for group, number in zip(rows.groups, rows.class_of_group, strict=True):
        free, known = group.matrix[:, arm:], group.matrix[:, :arm]
        normal += weights[number] * free.T @ free
        mixed += weights[number] * free.T @ known
    return np.asarray(np.linalg.solve(normal, mixed), dtype=np.float64)
