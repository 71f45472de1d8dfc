"""Findings come in the order of the part of the avoidable error that each removes."""

from __future__ import annotations

import numpy as np

from ident.diagnosis.findings import in_order
from ident.diagnosis.result import Evident, Finding

FLOOR = {"motor": np.array([0.3, 0.1]), "joint": np.array([0.1, 0.1])}


def finding(
    name: str, before: float, after: float, *rows: tuple[str, int], gain: float = 0.0, confidence: float = 0.9
) -> Finding:
    shown = Evident(0.0, 1e-9, before, after, (0.0, 0.0), rows)
    return Finding(name, "motor", (1,), {}, shown, confidence, (), "", gain)


def test_the_share_of_the_power_above_the_noise_comes_before_any_chi_square() -> None:
    half = finding("half", 0.5, np.sqrt(0.17), ("motor", 1), gain=9e9)
    # Of noise 0.1 and 0.3, so of a mean power of 0.05.
    most = finding("most", np.sqrt(0.25), np.sqrt(0.07), ("motor", 1), ("joint", 1), gain=2.0)
    whole = finding("whole", 0.2, 0.1, ("joint", 2), gain=1.0)
    assert [f.cause for f in in_order([half, most, whole], FLOOR)] == ["whole", "most", "half"]


def test_equal_ones_stay_as_they_were_and_what_no_row_measures_comes_last() -> None:
    counted = finding("counted", 0.0, 0.0, confidence=0.8)
    surer = finding("surer", 0.0, 0.0, confidence=0.95)
    unmeasured = finding("unmeasured", 0.0, 0.0, ("motor", 1), confidence=0.99)
    first, second = (finding(name, 0.2, 0.05, ("joint", 1)) for name in ("first", "second"))
    harmful = finding("harmful", 0.2, 0.3, ("joint", 1))
    noise = finding("noise", 0.2, 0.1, ("motor", 1))
    given = [counted, unmeasured, harmful, surer, noise, first, second]
    names = ["first", "second", "noise", "harmful", "unmeasured", "surer", "counted"]
    assert [f.cause for f in in_order(given, FLOOR)] == names
