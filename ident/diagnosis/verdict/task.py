"""The task of a diagnosis, and its state between the steps."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from ident.diagnosis.causes.selection import Selection, select
from ident.diagnosis.causes.tolerances import Deviation, Tolerance
from ident.diagnosis.causes.usual_sizes import Healthy
from ident.diagnosis.gain.evidence import Evidence
from ident.diagnosis.gain.held_out import HeldOut, held_out
from ident.diagnosis.gain.products import Floats, Rows
from ident.diagnosis.healthy.bench import DiagnosisBench, prepare_bench
from ident.diagnosis.healthy.reference import Reference
from ident.diagnosis.outcome.result import Finding, SimulationError
from ident.diagnosis.rows.nominal_arm import NominalArm
from ident.diagnosis.rows.recording import SessionRecord
from ident.diagnosis.settings import DiagnosisSettings
from ident.effects import DELAYS
from ident.model import DynamicModel
from lwr_driver.session import Session

Simulate = Callable[[DynamicModel, "Sequence[Session]"], SimulationError | None]
"""Replays sessions with a model and returns the error; provided by the runner."""


@dataclass(frozen=True, eq=False)
class Task:
    """The input of a diagnosis, see `diagnose`. sessions, test : as given. arm : the nominal arm.

    causes : names to consider, None for all. model : the present model, None for the base model. sound : whether no
    channel is broken. apart : channels whose delay is clearly not the healthy arm's, with the
    difference and its standard deviation [s].
    """

    sessions: Sequence[Session]
    test: Sequence[Session]
    arm: NominalArm
    recordings: tuple[SessionRecord, ...]
    settings: DiagnosisSettings
    reference: Reference | None
    causes: Sequence[str] | None
    model: DynamicModel | None
    simulate: Simulate | None
    sound: bool = True
    apart: Mapping[str, tuple[float, float]] = field(default_factory=dict)

    @property
    def everything(self) -> list[Session]:
        """Fitted and held-out sessions in the order of their beginnings, that of the recordings."""
        return sorted([*self.sessions, *self.test], key=lambda s: s.start)

    @cached_property
    def healthy(self) -> Healthy | None:
        """What healthy sets say of the candidates."""
        late = [DELAYS[side].cause for side in self.apart]
        return None if self.reference is None else self.reference.healthy().without(late)

    @property
    def limits(self) -> Mapping[tuple[str, int], float] | None:
        """Upper limit of each candidate's gain in a healthy set."""
        return None if self.healthy is None else self.healthy.limits

    def bench(self, arm: NominalArm, reference: Reference | None, *, fit_compliance: bool) -> DiagnosisBench:
        """Rows, noise and candidates for an arm."""
        return prepare_bench(
            arm, self.recordings, self.settings, reference, self.causes, fit_compliance=fit_compliance
        )

    def select(self, bench: DiagnosisBench) -> Selection:
        """The causes supported by the data of a bench."""
        return select(bench.dictionary, self.settings, self.healthy)


@dataclass(frozen=True, eq=False)
class ModelFit:
    """A fit of a model: base parameters (p,), their covariance, and the tolerated deviations beside them."""

    values: Floats
    covariance: Floats
    beside: Sequence[Deviation]

    @classmethod
    def of(cls, evidence: Evidence, columns: Sequence[Rows], beside: Sequence[Tolerance]) -> ModelFit:
        """Fitted with columns of the model and tolerated deviations of one column each; those that last beside these
        columns stay in the evidence. What is clear beside all deviations of a day may not be beside these alone."""
        evidence.replace([*columns, *(one.rows for one in beside)])
        p, values, covariance = evidence.base_count, evidence.full.values, evidence.covariance()
        first = len(values) - len(beside)
        std = np.sqrt(np.maximum(np.diag(covariance)[first:], 0.0))
        found = [Deviation(*one) for one in zip(beside, values[first:].tolist(), std.tolist(), strict=True)]
        if not all(one.stays for one in found):
            return cls.of(evidence, columns, [one.tolerance for one in found if one.stays])
        return cls(values[:p].copy(), covariance[:p, :p], found)


@dataclass(frozen=True, eq=False)
class Baseline:
    """The base model alone: its residuals on held-out rows beside what differs from day to day, and its fit."""

    held: HeldOut
    fit: ModelFit

    @classmethod
    def of(cls, bench: DiagnosisBench, tolerated: Sequence[Rows], staying: Sequence[Tolerance]) -> Baseline:
        """Fitted on a bench. tolerated : deviations beside the rows. staying : those beside the model."""
        held = held_out(bench.evidence, tolerated)
        return cls(held, ModelFit.of(bench.evidence, (), staying))


@dataclass(frozen=True, eq=False)
class State:
    """A diagnosis in progress.

    timing : findings of late channels, already shifted on the bench. corrected : channels shifted as well whose delay
    is no finding, of which a note tells. hardly : findings hardly believed of some of these. loads : of payloads of
    another mass. baseline : before the shift. left_out : causes dropped from the candidates.
    """

    bench: DiagnosisBench
    selection: Selection
    timing: tuple[Finding, ...] = ()
    corrected: tuple[str, ...] = ()
    hardly: tuple[Finding, ...] = ()
    loads: tuple[Finding, ...] = ()
    baseline: Baseline | None = None
    notes: tuple[str, ...] = ()
    left_out: tuple[str, ...] = ()
