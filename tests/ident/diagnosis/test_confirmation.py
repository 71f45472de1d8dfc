"""Held-out data refute what they neither show beyond chance nor feel."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from ident.diagnosis.candidates import Candidate, Trial
from ident.diagnosis.confirmation import _refuted
from ident.diagnosis.evidence import Score
from ident.diagnosis.result import Evident, Finding
from ident.diagnosis.selection import Claim
from ident.diagnosis.settings import DiagnosisSettings
from ident.effects import EFFECTS, Shape

BENCH: Any = SimpleNamespace(evidence=SimpleNamespace(settings=DiagnosisSettings()))


def refuted(
    after: float, fallen: tuple[float, float], *, cause: str = "friction_asymmetry", hardly: bool = False
) -> bool:
    effect = EFFECTS[cause]
    score = Score(2000.0, 2000.0, np.ones(1), 0.1, lambda: (np.eye(1), 40))
    claim = Claim(Trial(Candidate(effect, 3), Shape(), score, {}), score)
    evidence = Evident(-2000.0, 1e-12, 0.1, after, (-0.01, 0.03))
    finding = Finding(cause, effect.side, (4,), {}, evidence, 0.7, (), "", 2000.0)
    return _refuted(claim, finding, BENCH, fallen, hardly)


@pytest.mark.parametrize("fallen", [(-10.0, 40.0), (-1.0, 40.0)])
def test_a_claim_that_held_out_data_do_not_show_needs_to_be_felt(fallen: tuple[float, float]) -> None:
    assert refuted(0.097, fallen)
    assert not refuted(0.09, fallen)


def test_a_sure_fall_needs_no_size_and_the_larger_part_below_zero_refutes() -> None:
    assert not refuted(0.097, (1.0, 40.0))
    assert refuted(0.09, (-40.0, 10.0))


def test_held_out_data_refute_no_event_and_nothing_that_they_hardly_excite() -> None:
    assert not refuted(0.1, (-10.0, 10.0), cause="contact")
    assert not refuted(0.1, (-10.0, 10.0), hardly=True)
