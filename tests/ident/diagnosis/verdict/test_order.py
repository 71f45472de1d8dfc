"""Findings come in the order of the part of the avoidable error that each removes."""

from __future__ import annotations

import numpy as np

from ident.diagnosis.outcome.result import Finding, FindingEvidence
from ident.diagnosis.verdict.findings import in_order

FLOOR = {"motor": np.array([0.3, 0.1]), "joint": np.array([0.1, 0.1])}


def finding(
    name: str, before: float, after: float, *rows: tuple[str, int], gain: float = 0.0, confidence: float = 0.9
) -> Finding:
    shown = FindingEvidence(0.0, 1e-9, before, after, (0.0, 0.0), rows)
    return Finding(
        name, "motor", (1,), parameters={}, evidence=shown, confidence=confidence, tell_apart="", gain=gain
    )


def test_the_power_removed_in_units_of_the_noise_comes_before_any_chi_square() -> None:
    large = finding("large", 0.5, 0.3, ("motor", 1), gain=9e9)
    # Less of it, in a row with a third of the noise.
    clear = finding("clear", 0.3, 0.1, ("joint", 1), gain=2.0)
    # Over two rows, of noise 0.1 and 0.3, so of a mean power of 0.05.
    both = finding("both", 0.5, 0.3, ("motor", 1), ("joint", 1), gain=1.0)
    assert [f.cause for f in in_order([large, clear, both], FLOOR)] == ["clear", "both", "large"]


def test_what_no_row_measures_is_placed_by_its_gain_and_equal_ones_stay_as_they_were() -> None:
    counted = finding("counted", 0.0, 0.0, gain=20.0)
    payload = finding("payload", 0.0, 0.0, gain=500.0)
    first, second = (finding(name, 0.2, 0.05, ("joint", 1), gain=100.0) for name in ("first", "second"))
    harmful = finding("harmful", 0.2, 0.3, ("joint", 1), gain=50.0)
    given = [counted, harmful, first, payload, second]
    names = ["payload", "first", "second", "harmful", "counted"]
    assert [f.cause for f in in_order(given, FLOOR)] == names
