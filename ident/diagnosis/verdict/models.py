"""The models of a diagnosis: the base model, and the extended one with what was found.

Beside every cause the evidence tolerates what differs between healthy days. A day's change is no part of a model: so
each model is fitted with exactly the columns that it holds, beside delays and stiffness, which are no torques. Drives
with a presliding length turn their friction over it in the models as in the rows.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from ident.diagnosis.causes.selection import Selection
from ident.diagnosis.causes.tolerances import Kind, Tolerance
from ident.diagnosis.gain.held_out import HeldOut
from ident.diagnosis.gain.products import Floats
from ident.diagnosis.healthy.bench import DiagnosisBench
from ident.diagnosis.outcome.result import Finding, Nameless
from ident.diagnosis.outcome.torque_errors import TorqueErrors, errors_of_both
from ident.diagnosis.verdict.extension import Member, held_out_with, nameless_terms
from ident.diagnosis.verdict.task import Baseline, ModelFit, State, Task
from ident.effects import PRESLIDING, SENSOR_GAIN, entry_of, parameter_values, sized
from ident.estimation.turning import drive_coulomb
from ident.model import DynamicModel
from ident.model.signals import SIGNALS, signals_entry

Entries = tuple[Mapping[str, Any], ...]

# Least change of a presliding length, or of friction that turns, in its standard deviations.
_CLEAR = 2.0


def staying(selection: Selection) -> list[Tolerance]:
    """The tolerated deviations that stay beside the columns of a model."""
    return [one.tolerance for one in selection.deviations if one.stays]


class Models(NamedTuple):
    """Base model, extended model, what this one has more, and the terms without a name among it."""

    base: DynamicModel
    extended: DynamicModel
    added: Entries
    nameless: tuple[Nameless, ...]


def fitted_models(
    task: Task, state: State, baseline: Baseline, members: Sequence[Member], after: HeldOut
) -> Models:
    """The models, the extended one with the members and the late channels.

    after : held-out rows with the members; the columns of the evidence are theirs, before and afterwards.
    """
    bench, selection = state.bench, state.selection
    evidence, nominal = bench.evidence, bench.nominal
    nameless = nameless_terms(bench, members, selection.nuisance_rows, after, task.settings.seed)
    named = [m.finding for m in members if m.finding is not None]
    effects = (*map(_entry, (*named, *state.timing)), *(e for term in nameless for e in term.entries))
    robot = task.sessions[0].metadata.get("robot", "") or "arm"
    signals = task.settings.signals
    if nominal.arm.encoder == "motor" and not signals.takes_links_back:
        # The rows have the links on their springs; who computes the torque takes them back from the motors.
        signals = nominal.arm.elastic(signals)
    provenance: dict[str, Any] = {
        "sessions": [r.name for r in nominal.recordings if not r.test],
        "estimator": "diagnosis",
        SIGNALS: signals_entry(signals) | nominal.arm.delays,
    }
    structure = replace(nominal.structure, coulomb=task.settings.law or nominal.structure.coulomb)
    base = DynamicModel(
        robot,
        structure,
        nominal.base.names,
        baseline.fit.values,
        baseline.fit.covariance,
        replace(nominal.base, structure=structure),
        provenance,
    )
    own = [rows for m in members for rows in m.rows]
    fit = ModelFit.of(evidence, own, staying(selection))
    evidence.replace([*own, *selection.nuisance_rows])
    extended = replace(base, values=fit.values, covariance=fit.covariance)
    return Models(
        _with_effects(base, bench, selection, baseline.fit, ()),
        _with_effects(extended, bench, selection, fit, effects),
        effects,
        nameless,
    )


def _with_effects(
    model: DynamicModel, bench: DiagnosisBench, selection: Selection, fit: ModelFit, found: Entries
) -> DynamicModel:
    """The model with the healthy arm's effects, the gains of its sensors, the turning of its friction, and `found`."""
    gains = [
        entry_of(SENSOR_GAIN, [one.tolerance.number + 1], {"error": (one.value, one.std)})
        for one in fit.beside
        if one.tolerance.kind is Kind.GAIN
    ]
    turning = turning_friction(model, bench, selection, found)
    sizes = {one.tolerance.number: one.value for one in fit.beside if one.tolerance.kind is Kind.SIZE}
    own = [
        sized(entry, 1.0 + sizes.get(number, 0.0)) for number, entry in enumerate(bench.nominal.arm.healthy)
    ]
    return replace(model, effects=(*own, *gains, *turning, *found))


def turning_friction(
    model: DynamicModel, bench: DiagnosisBench, selection: Selection, found: Entries
) -> list[dict[str, Any]]:
    """Entries of the drives' friction that turns over the arm's presliding lengths of these days, but for what `found`
    says of it."""
    nominal = bench.nominal
    if "motor" not in nominal.rows:
        return []
    level = drive_coulomb(model, sensed="joint" in nominal.rows)
    for entry in found:
        if entry["cause"] == PRESLIDING.cause:
            level[entry["joints"][0] - 1] -= parameter_values(entry)["amplitude"]
    level = np.maximum(level, 0.0)

    def told(kind: Kind) -> Floats:
        """Values (n,) of a kind of deviation over `_CLEAR` standard deviations, else 0."""
        values = np.zeros(len(level))
        for one in selection.deviations:
            if one.tolerance.kind is kind and abs(one.value) > _CLEAR * one.std:
                values[one.tolerance.number] = one.value
        return values

    unknown = replace(
        nominal.arm, presliding=np.where(told(Kind.TURNING) > 0.0, nominal.arm.usual_length, 0.0)
    )
    return [
        *nominal.arm.turning(level, np.exp(told(Kind.LENGTH))),
        *unknown.turning(level * np.minimum(told(Kind.TURNING), 1.0)),
    ]


class Harmless(NamedTuple):
    """Held-out rows and models with the members of the extension that are left, the findings that went, and the errors
    of base and extended model in the held-out sessions."""

    after: HeldOut
    made: Models
    refuted: tuple[Finding, ...]
    errors: tuple[TorqueErrors, TorqueErrors]


def without_harm(
    task: Task, state: State, baseline: Baseline, members: list[Member], after: HeldOut
) -> Harmless:
    """The members without those that raise the torque error of the held-out sessions.

    The rows end at the parallel filter's band; the torque error has all samples, as users compute the torque.
    """
    bench, nuisance = state.bench, state.selection.nuisance_rows
    refuted: list[Finding] = []
    made = fitted_models(task, state, baseline, members, after)
    base, errors = errors_of_both(made.base, made.extended, task.test)
    while members and errors.left_of(base) > 1.0:
        found = []
        for member in members:
            rest = [m for m in members if m is not member]
            held = held_out_with(bench, rest, nuisance)
            models = fitted_models(task, state, baseline, rest, held)
            found.append((TorqueErrors.of(models.extended, task.test), models, held, member))
        errors, made, after, worst = min(found, key=lambda one: one[0].left_of(base))
        members = [m for m in members if m is not worst]
        refuted += [worst.finding] if worst.finding is not None else []
        held_out_with(bench, members, nuisance)
    return Harmless(after, made, tuple(refuted), (base, errors))


def changes_of(base: DynamicModel, extended: DynamicModel) -> dict[str, float]:
    """Largest changes of the base parameters beyond two standard deviations, in these; none between different bases."""
    if extended.std is None or base.names != extended.names:
        return {}
    shift = (extended.values - base.values) / np.maximum(extended.std, 1e-300)
    order = np.argsort(-np.abs(shift))[:10]
    return {base.names[k]: float(shift[k]) for k in order if abs(shift[k]) > 2.0}


def _entry(finding: Finding) -> dict[str, Any]:
    content = finding.to_dict()
    names = ("cause", "side", "joints", "form", "parameters")
    return {name: content[name] for name in names if name in content}
