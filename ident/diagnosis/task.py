"""The task of a diagnosis, and its state between the steps."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

from ident.diagnosis.bench import DiagnosisBench, prepare_bench
from ident.diagnosis.evidence import Floats, Rows
from ident.diagnosis.held_out import HeldOut, held_out
from ident.diagnosis.nominal import NominalArm
from ident.diagnosis.recording import SessionRecord
from ident.diagnosis.reference import Reference
from ident.diagnosis.result import Finding, SimulationError
from ident.diagnosis.selection import Selection, select
from ident.diagnosis.settings import DiagnosisSettings
from ident.diagnosis.usual_sizes import Healthy
from ident.model import DynamicModel
from lwr_driver.session import Session

Simulate = Callable[[DynamicModel, "Sequence[Session]"], SimulationError | None]
"""Replays sessions with a model and returns the error; provided by the runner."""


@dataclass(frozen=True, eq=False)
class Task:
    """The input of a diagnosis, see `diagnose`. sessions, test : as given. arm : the nominal arm.

    causes : names to consider, None for all. model : the present model, None for the base model. sound : whether no
    channel is broken.
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

    @property
    def everything(self) -> list[Session]:
        """Fitted and held-out sessions in the order of their beginnings, that of the recordings."""
        return sorted([*self.sessions, *self.test], key=lambda s: s.start)

    @cached_property
    def healthy(self) -> Healthy | None:
        """What healthy sets say of the candidates."""
        return None if self.reference is None else self.reference.healthy()

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
        return select(bench.dictionary, bench.evidence, self.settings, self.healthy)


@dataclass(frozen=True, eq=False)
class Baseline:
    """The base model alone: its residuals on held-out rows, its parameters (p,) and their covariance."""

    held: HeldOut
    values: Floats
    covariance: Floats

    @classmethod
    def of(cls, bench: DiagnosisBench, tolerated: Sequence[Rows]) -> Baseline:
        """Fitted on a bench, with tolerated deviations."""
        evidence = bench.evidence
        held, p = held_out(evidence, tolerated), evidence.base_count
        return cls(held, evidence.full.values[:p].copy(), evidence.covariance()[:p, :p])


@dataclass(frozen=True, eq=False)
class State:
    """A diagnosis in progress.

    timing : findings of late channels, already shifted on the bench. loads : of payloads of another mass.
    baseline : before the shift. left_out : causes dropped from the candidates.
    """

    bench: DiagnosisBench
    selection: Selection
    timing: tuple[Finding, ...] = ()
    loads: tuple[Finding, ...] = ()
    baseline: Baseline | None = None
    notes: tuple[str, ...] = ()
    left_out: tuple[str, ...] = ()
