"""Comparison of two models parameter by parameter, and of a model with other predictors of the joint torque.

The two models may come from two robots, dates or estimators. With different base sets, both are expressed in the
combinations determined by both: with K1 and K2 the matrices of the regrouping relations (base = K standard), a
base parameter of one is comparable when its row of K is a combination of the rows of the other.

The other predictors of the joint torque:

* the controller's own mass matrix and gravity torque from the channel `/fri/controller_model`:
  tau = M(q) qdd + g(q), without centrifugal terms and friction, at the times of that channel;
* the CAD model: the inertials of the URDF, without friction;
* another identified model.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fri.errors import ConfigurationError, DataError
from ident.dynamics import regressor
from ident.dynamics.base_set import BaseSet
from ident.dynamics.parameters import Floats
from ident.dynamics.structure import Side
from ident.dynamics.tables import Tabular
from ident.estimation.scores import SessionScore, finite, score_session
from ident.estimation.validate import mounted, predictor, prepared_session
from ident.estimators.estimate import student_tail
from ident.model.dynamic_model import DynamicModel
from ident.model.model_file import Model, as_model
from ident.rows.filters import SignalSettings
from ident.rows.prepared import PreparedSession, TorqueChannel
from ident.rows.sessions import payload_name
from lwr_driver.listing import Listing, Piece, text_of
from lwr_driver.session import Session, Sessions, as_sessions

_SAME_ROW = 1e-8
# Degrees of freedom of a standard deviation counted as known.
_EXACT = 1e6


@dataclass(frozen=True)
class Difference:
    """One parameter in both models.

    z : difference over its standard deviation; NaN without covariances. p : probability of a larger |z|.
    percent : second minus first, of the first [%].
    note : how the parameter is expressed where the base sets differ.
    """

    name: str
    unit: str
    first: float
    second: float
    first_std: float
    second_std: float
    z: float
    p: float
    percent: float
    note: str = ""

    @property
    def difference(self) -> float:
        """Second minus first."""
        return self.second - self.first


@dataclass(frozen=True)
class Comparison(Tabular):
    """All comparable parameters; prints itself.

    level : significance level of a single statement after Holm's correction for their number.
    significant : names with a difference beyond chance at that level.
    p : probability of all differences together by chance, the Cauchy combination of the single ones
        (NaN without covariances). It holds under any correlation and needs no inverse of a covariance
        estimated from a few blocks of data.
    only_first, only_second : parameters determined by one model alone.
    """

    first: str
    second: str
    differences: tuple[Difference, ...]
    level: float
    significant: tuple[str, ...]
    p: float
    only_first: tuple[str, ...] = ()
    only_second: tuple[str, ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """Plain content for JSON."""
        return {
            "schema_version": 1,
            "first": self.first,
            "second": self.second,
            "parameters": [{key: finite(value) for key, value in row.items()} for row in self.records()],
            "level": self.level,
            "p": finite(self.p),
            "only_first": list(self.only_first),
            "only_second": list(self.only_second),
        }

    def records(self) -> list[dict[str, Any]]:
        """One row for each comparable parameter."""
        return [d.__dict__ | {"significant": d.name in self.significant} for d in self.differences]

    def __repr__(self) -> str:
        lines = [f"Comparison of {self.first} and {self.second}"]
        count = f"{len(self.differences)} comparable parameters"
        if not math.isfinite(self.p):
            return "\n".join([*lines, f"  {count}; no significance: a model without covariance"])
        lines.append(
            f"  {count}, {len(self.significant)} differ significantly, p = {self.p:.2g} all together"
        )
        ordered = sorted(self.differences, key=lambda d: -abs(d.z) if math.isfinite(d.z) else 0.0)
        lines += [
            f"  {d.name:<8}{d.first:>11.5g}{d.second:>11.5g} {d.unit}, z = {d.z:.1f}" for d in ordered[:5]
        ]
        return "\n".join(lines)

    def listing(self, *, all_rows: bool = True) -> Listing:
        """The parameters as a table, or the significant differences alone."""
        rows = [
            (
                f"{d.name} *" if d.name in self.significant and all_rows else d.name,
                f"{d.first:.5g}",
                f"{d.first_std:.2g}",
                f"{d.second:.5g}",
                f"{d.second_std:.2g}",
                f"{d.percent:z.1f}",
                f"{d.z:z.1f}",
                d.unit,
                d.note,
            )
            for d in self.differences
            if all_rows or d.name in self.significant
        ]
        head = ("parameter", "first", "±", "second", "±", "diff %", "z", "unit", "as")
        width = len(head) - (not any(row[-1] for row in rows))
        return Listing(head[:width], [row[:width] for row in rows], 0)

    def pieces(self) -> list[Piece]:
        """Names of the models, the table, and what differs beyond chance."""
        lines: list[Piece] = [f"first   {self.first}", f"second  {self.second}", "", self.listing(), ""]
        if math.isfinite(self.p):
            lines.append(
                f"{len(self.significant)} of {len(self.differences)} differ by more than chance (*, level "
                f"{100 * self.level:g} % over all of them together)"
            )
            spread = math.sqrt(np.nanmean([d.z**2 for d in self.differences]))
            lines.append(f"all together by chance: p = {self.p:.2g}; rms of z {spread:.2f}")
        else:
            lines.append("no significance: a model without covariance")
        for title, names in (("only first", self.only_first), ("only second", self.only_second)):
            if names:
                lines.append(f"{title}: {' '.join(names)}")
        return lines

    def __str__(self) -> str:
        return text_of(self.pieces())


def compare(
    first: Model, second: Model, *, level: float = 0.05, labels: tuple[str, str] | None = None
) -> Comparison:
    """Compare two models of the same kinematics, with independent estimates.

    first, second : models or paths of their files.
    level : probability of calling any parameter different when none is (Holm 1979).
    labels : names of the two models in the table.

    A parameter eliminated from one model as not essential counts as 0 there, without uncertainty.
    Raises ConfigurationError for arms of different joints or geometry, and when nothing is comparable.
    """
    first, second = as_model(first, "first"), as_model(second, "second")
    _require_same_arm(first, second)
    first_k, second_k = _matrices(first, second)
    rows, found, only_first = [], [], []
    for k, name in enumerate(_table(first).names):
        target = first_k[k]
        weights, residual = _combination(second_k, target)
        if residual > _SAME_ROW * max(1.0, float(np.abs(target).max())):
            only_first.append(name)
            continue
        rows.append((k, weights))
        note = _note(weights, second, name)
        found.append((name, _table(first).units[k], note))
    only_second = [
        name
        for k, name in enumerate(_table(second).names)
        if _combination(first_k, second_k[k])[1] > _SAME_ROW * max(1.0, float(np.abs(second_k[k]).max()))
    ]
    if not rows:
        raise ConfigurationError(
            f"the models of {first.robot} and {second.robot} have no parameter in common; compare models of "
            "the same number (1, 2 or 3)"
        )
    select = np.zeros((len(rows), len(_table(first).names)))
    mix = np.array([weights for _, weights in rows])
    select[np.arange(len(rows)), [k for k, _ in rows]] = 1.0
    a, b = select @ _values(first), mix @ _values(second)
    # Parameters without a value in either model are left out.
    alive = (np.abs(a) > 0) | (np.abs(b) > 0)
    cov_a, cov_b = _covariance(first), _covariance(second)
    known = cov_a is not None and cov_b is not None
    var_a = np.zeros((len(a),) * 2) if cov_a is None else select @ cov_a @ select.T
    var_b = np.zeros((len(b),) * 2) if cov_b is None else mix @ cov_b @ mix.T
    std_a, std_b = np.sqrt(np.maximum(np.diag(var_a), 0)), np.sqrt(np.maximum(np.diag(var_b), 0))
    total = np.sqrt(std_a**2 + std_b**2)
    with np.errstate(divide="ignore", invalid="ignore"):
        z = np.where(known & (total > 0), (b - a) / total, np.nan)
        percent = np.where(a != 0, 100.0 * (b - a) / np.abs(a), np.inf)
    # Standard deviations from a few dozen blocks are uncertain themselves (Welch 1947).
    freedom = _freedom(first), _freedom(second)
    with np.errstate(divide="ignore", invalid="ignore"):
        both = total**4 / (std_a**4 / freedom[0] + std_b**4 / freedom[1])
    p = 2.0 * student_tail(np.abs(z), np.where(np.isfinite(both), both, np.inf))
    differences = tuple(
        Difference(
            name, unit, float(a[k]), float(b[k]), float(std_a[k]), float(std_b[k]), float(z[k]), float(p[k]),
            float(percent[k]), note,
        )
        for k, (name, unit, note) in enumerate(found)
        if alive[k]
    )  # fmt: skip
    names = labels or (_label(first), _label(second))
    return Comparison(
        first=names[0],
        second=names[1],
        differences=differences,
        level=level,
        significant=_holm(differences, level),
        p=_together(differences),
        only_first=tuple(only_first),
        only_second=tuple(only_second),
    )


def _freedom(model: DynamicModel) -> float:
    """Degrees of freedom of a model's standard deviations; models without count as exact."""
    stated = model.provenance.get("degrees_of_freedom")
    return float(stated) if isinstance(stated, (int, float)) and stated > 0 else _EXACT


def _require_same_arm(first: DynamicModel, second: DynamicModel) -> None:
    one, other = first.structure.chain, second.structure.chain
    if one.n != other.n or not np.array_equal(one.prismatic, other.prismatic):
        raise ConfigurationError(
            f"{first.robot} has {one.n} joints, {second.robot} has {other.n}, or other kinds of joints; "
            "only arms of one kind can be compared"
        )
    for label in ("alpha", "d", "theta", "r"):
        mine, theirs = getattr(one, label), getattr(other, label)
        # The first frame's height above the base moves no torque.
        start = 1 if label == "r" and not one.prismatic[0] else 0
        if not np.allclose(mine[start:], theirs[start:], atol=1e-6):
            raise ConfigurationError(
                f"the models have different geometry (`{label}`: {np.round(mine, 6)} and "
                f"{np.round(theirs, 6)}); their parameters are not of the same bodies"
            )


def _table(model: DynamicModel) -> DynamicModel | BaseSet:
    """Names and units of all parameters, those without a value included."""
    return model if model.base is None else model.base


def _values(model: DynamicModel) -> Floats:
    if model.base is None:
        return model.values
    values = np.zeros(len(model.base))
    values[model.positions] = model.values
    return values


def _covariance(model: DynamicModel) -> Floats | None:
    if model.covariance is None or model.base is None:
        return model.covariance
    full = np.zeros((len(model.base),) * 2)
    full[np.ix_(model.positions, model.positions)] = model.covariance
    return full


def _matrices(first: DynamicModel, second: DynamicModel) -> tuple[Floats, Floats]:
    """K of each on the standard names of both."""
    order = list(dict.fromkeys((*_standard_names(first), *_standard_names(second))))
    place = {name: k for k, name in enumerate(order)}
    result = []
    for model in (first, second):
        own = np.eye(model.structure.n_columns)[model.positions] if model.base is None else model.base.matrix
        full = np.zeros((len(own), len(order)))
        full[:, [place[name] for name in _standard_names(model)]] = own
        result.append(full)
    return result[0], result[1]


def _standard_names(model: DynamicModel) -> list[str]:
    """Standard names, those of payloads by the payload's name: link 8 of one model may be another payload."""
    structure = model.structure
    arm = 17 * structure.chain.n
    names = list(structure.names)
    for number, payload in enumerate(structure.payloads):
        for k in range(arm + 17 * number, arm + 17 * (number + 1)):
            names[k] = f"{names[k]}@{payload}"
    return names


def _combination(rows: Floats, target: Floats) -> tuple[Floats, float]:
    """Weights of the combination of rows nearest to `target`, and the largest entry of the remainder."""
    weights = np.asarray(np.linalg.lstsq(rows.T, target, rcond=1e-12)[0], dtype=np.float64)
    weights[np.abs(weights) < 1e-10] = 0.0
    return weights, float(np.abs(rows.T @ weights - target).max())


def _note(weights: Floats, model: DynamicModel, name: str) -> str:
    """The parameter in terms of the second model; empty for its own parameter of the same name."""
    names = _table(model).names
    used = np.flatnonzero(weights)
    if len(used) == 1 and weights[used[0]] == 1.0 and names[used[0]].rstrip("R") == name.rstrip("R"):
        return ""
    if len(used) == 1 and abs(weights[used[0]] - 1.0) < 1e-9:
        return f"second: {names[used[0]]}" if names[used[0]].rstrip("R") != name.rstrip("R") else ""
    terms = []
    for k in used:
        size = "" if abs(abs(weights[k]) - 1.0) < 1e-9 else f"{abs(weights[k]):.6g} "
        terms.append(("- " if weights[k] < 0 else "+ ") + size + names[k])
    return ("second: " + " ".join(terms)).replace(": + ", ": ")


def _together(differences: tuple[Difference, ...]) -> float:
    """Cauchy combination of the single probabilities (Liu and Xie 2020)."""
    single = np.array([d.p for d in differences if math.isfinite(d.p)])
    if not len(single):
        return math.nan
    statistic = float(np.mean(np.tan((0.5 - np.clip(single, 1e-300, 1.0 - 1e-12)) * np.pi)))
    return 0.5 - math.atan(statistic) / math.pi if statistic < 1e8 else 1.0 / (math.pi * statistic)


def _holm(differences: tuple[Difference, ...], level: float) -> tuple[str, ...]:
    ordered = sorted((d for d in differences if math.isfinite(d.p)), key=lambda d: d.p)
    found = []
    for k, d in enumerate(ordered):
        if d.p > level / (len(ordered) - k):
            break
        found.append(d.name)
    return tuple(found)


def _label(model: DynamicModel) -> str:
    sessions = model.provenance.get("sessions", ())
    count = f", {len(sessions)} sessions" if isinstance(sessions, (list, tuple)) and sessions else ""
    return f"{model.robot} (Model {model.structure.model}, {len(model.names)} parameters{count})"


def competitor_scores(
    model: DynamicModel,
    sessions: Sessions,
    *,
    settings: SignalSettings | None = None,
    others: Mapping[str, DynamicModel] | Sequence[DynamicModel] = (),
) -> tuple[SessionScore, ...]:
    """Scores of every competitor available for each session; joints and URDF are those of the model.

    The controller's model and the URDF compete where the session has joint torques, another model on the sides
    common to both. others : models, or models by the name of their scores.

    Raises ConfigurationError for another model without a side in common.
    """
    found = []
    if not isinstance(others, Mapping):
        others = {f"model of {other.robot}": other for other in others}
    for session in as_sessions(sessions):
        if session.joint.effort.shape[1] and "joint" in model.structure.sides:
            prepared = prepared_session(model, session, settings, blocks=True)
            controller = score_controller_model(prepared, session)
            if controller is not None:
                found.append(controller)
            if model.structure.chain.urdf is not None:
                found.append(score_cad(model, prepared, session))
        found += [_score_other(model, name, other, session, settings) for name, other in others.items()]
    return tuple(found)


def score_cad(model: DynamicModel, prepared: PreparedSession, session: Session) -> SessionScore:
    """The inertials of the URDF, bare arm: rigid joint torque."""
    chain = model.structure.chain
    bodies = chain.urdf_inertials()

    def predict(channel: TorqueChannel, side: Side) -> Floats:
        return regressor.torque(chain, channel.q, channel.qd, channel.qdd, bodies)

    notes = ("CAD: the payload is not in the URDF.",) if payload_name(session) else ()
    return score_session(
        prepared,
        predict,
        ("joint",),
        session,
        "CAD (URDF), no friction",
        notes=notes,
        units=chain.torque_units,
    )


def score_controller_model(prepared: PreparedSession, session: Session) -> SessionScore | None:
    """The controller's mass matrix and gravity; None for a session without that channel.

    Only joint samples with a message of the channel (nearest, within 2 ms) are scored.
    """
    channel = session.controller_model
    if channel is None or not len(channel):
        return None
    if channel.gravity.shape[1] != len(prepared.joint_names):
        raise DataError(
            f"{prepared.name}: /fri/controller_model is of {channel.gravity.shape[1]} joints, the model of "
            f"{len(prepared.joint_names)}; it belongs to another arm"
        )
    reference = session.joint
    own = bool(np.ptp(reference.publish_time) > 0)
    origin = int((reference.publish_time if own else reference.log_time)[0])
    clock = channel.publish_time if own else channel.log_time
    times = np.asarray((clock - origin) * 1e-9, dtype=np.float64)
    passages = []
    for passage in prepared.passages:
        picked, _ = _matched(passage.joint.times, times)
        if len(picked) > 1:
            passages.append(replace(passage, joint=passage.joint.at(picked)))
    if not passages:
        return None

    def predict(samples: TorqueChannel, side: Side) -> Floats:
        _, message = _matched(samples.times, times)
        inertial = np.einsum("nij,nj->ni", channel.mass_matrix[message], samples.qdd)
        return np.asarray(inertial + channel.gravity[message], dtype=np.float64)

    return score_session(
        replace(prepared, passages=tuple(passages)), predict, ("joint",), session, "controller's M(q), g(q)"
    )


def _matched(samples: Floats, times: Floats) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Samples with a message, and these messages."""
    nearest = np.clip(np.searchsorted(samples, times), 1, len(samples) - 1)
    nearest -= samples[nearest] - times > times - samples[nearest - 1]
    close = np.abs(samples[nearest] - times) <= 2e-3
    picked, first = np.unique(nearest[close], return_index=True)
    return picked, np.flatnonzero(close)[first]


def _score_other(
    model: DynamicModel, name: str, other: DynamicModel, session: Session, settings: SignalSettings | None
) -> SessionScore:
    common = tuple(side for side in other.structure.sides if side in model.structure.sides)
    if not common:
        own, theirs = (" and ".join(one.structure.sides) for one in (model, other))
        raise ConfigurationError(
            f"the model of {other.robot} computes the torque of the {theirs} side, the tested one that of the "
            f"{own} side, so they cannot compete; choose models with a side in common"
        )
    prepared = prepared_session(other, session, settings, blocks=not other.remembers)
    predict = predictor(other, mounted(other, session))
    return score_session(prepared, predict, common, session, name, units=other.structure.chain.torque_units)
