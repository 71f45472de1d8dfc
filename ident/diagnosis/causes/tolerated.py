"""What is tolerated beside the accepted causes: the deviations of the nominal arm, and habits of these days."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import cached_property

import numpy as np

from ident.diagnosis.causes.candidates import Dictionary, Trial
from ident.diagnosis.causes.tolerances import Deviation, Kind, Tolerance, tolerances
from ident.diagnosis.gain.evidence import Evidence
from ident.diagnosis.gain.products import Rows, width_of
from ident.diagnosis.settings import DiagnosisSettings


class Tolerated:
    """The tolerated deviations in the rows of a dictionary.

    deviations : those within their tolerance, in the present fit.
    """

    def __init__(self, dictionary: Dictionary, settings: DiagnosisSettings) -> None:
        self.dictionary, self.settings = dictionary, settings
        self.deviations: Sequence[Deviation] = ()
        self._accepted: Sequence[Trial] = ()

    @property
    def evidence(self) -> Evidence:
        """That of the dictionary."""
        return self.dictionary.evidence

    @cached_property
    def known(self) -> list[Tolerance]:
        """All of them, within their tolerance or not."""
        return tolerances(self.dictionary, self.settings)

    @property
    def rows(self) -> list[Rows]:
        """Rows of the deviations within their tolerance."""
        return [one.tolerance.rows for one in self.deviations]

    @property
    def habits(self) -> list[Tolerance]:
        """Candidates of a gain as on healthy days."""
        return [one for one in self.known if one.kind is Kind.HABIT]

    def add_habit(self, trial: Trial) -> None:
        """Tolerate a trial of any size."""
        self.known.append(Tolerance(Kind.HABIT, len(self.habits), trial.rows, np.inf, trial.candidate.key))

    def beside(self, accepted: Sequence[Trial]) -> None:
        """Base with the accepted columns and the deviations within their tolerance, but for those of an accepted
        cause: of two equal columns each would take a half."""
        self._accepted = accepted
        taken = {t.candidate.key for t in accepted}
        entries = [one for one in self.known if one.of not in taken]
        fixed = [t.rows for t in accepted]
        place = self.evidence.base_count + sum(width_of(rows) for rows in fixed)
        inside = entries
        while True:
            self.evidence.replace([*fixed, *(one.rows for one in inside)])
            values = self.evidence.full.values[place:]
            over = [abs(v) * one.unit / max(one.size, 1e-300) for one, v in zip(inside, values, strict=True)]
            if max(over, default=0.0) <= 1.0:
                break
            # Without the farthest one the others may be inside.
            inside = [one for one, share in zip(inside, over, strict=True) if share < max(over)]
        # A motion without information on a deviation leaves its variance open.
        std = np.sqrt(np.maximum(np.diag(self.evidence.full.inverse), 0.0))[place:]
        self.deviations = [
            Deviation(one, float(v) * one.unit, float(s) * one.unit)
            for one, v, s in zip(inside, values, std, strict=True)
        ]

    @contextmanager
    def only(self, some: Sequence[Tolerance]) -> Iterator[None]:
        """Some of them alone for a while, beside the same accepted causes."""
        known, deviations, present = self.known, self.deviations, self.evidence.extra
        self.known = list(some)
        try:
            self.beside(self._accepted)
            yield
        finally:
            self.known, self.deviations = known, deviations
            self.evidence.replace(present)
