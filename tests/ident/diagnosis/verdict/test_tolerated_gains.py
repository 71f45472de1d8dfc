"""Gains of torque sensors that a diagnosis tolerates and tells."""

from __future__ import annotations

import pytest

from ident.diagnosis.causes.tolerances import HABITUAL, Deviation, Kind, Tolerance
from ident.diagnosis.verdict.conclusion import tolerated_gains

DAY = 0.01


@pytest.mark.parametrize(
    ("value", "std", "told"),
    [(0.028, 0.003, True), (-0.028, 0.003, True), (0.02, 0.003, False), (0.028, 0.012, False)],
)
def test_a_gain_unusual_for_a_day_is_told_though_tolerated(value: float, std: float, told: bool) -> None:
    tolerance = Tolerance(Kind.GAIN, 1, {}, HABITUAL * DAY, ("sensor_gain", 1))
    lines = tolerated_gains([Deviation(tolerance, value, std)], ["one", "two"])
    assert bool(lines) is told
    if told:
        (line,) = lines
        assert "two reads 2.8 ± 0.3 % too " + ("much" if value > 0.0 else "little") in line
        assert "1 % from day to day" in line
