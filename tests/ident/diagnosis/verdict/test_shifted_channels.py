"""Late channels: what stands beside the delay that remains after a shift."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from ident.diagnosis.causes.candidates import Candidate
from ident.diagnosis.causes.selection import Selection
from ident.diagnosis.causes.tolerances import Deviation, Kind, Tolerance
from ident.diagnosis.outcome.signatures import signature_bench
from ident.diagnosis.verdict.late_channels import _rest
from ident.dynamics.kinematics import Chain
from ident.effects import DELAYS, Shape
from lwr_driver.session import Session

LATE_S = 2e-3


def test_the_remaining_delay_stands_beside_no_other_column_of_the_same(
    make: Callable[..., Session], chain: Chain
) -> None:
    def late(s: dict[str, np.ndarray]) -> None:
        for j in range(chain.n):
            s["motor"][:, j] = np.interp(s["time"] - LATE_S, s["time"], s["motor"][:, j])

    bench = signature_bench([make("a.mcap", 1, late), make("b.mcap", 2, late, 1)], chain)
    delay = DELAYS["motor"]

    def column(length_s: float) -> Any:
        return bench.dictionary.rows(Candidate(delay, -1), Shape(delay=length_s))

    place = (delay.cause, -1)
    same = (
        Tolerance(Kind.DELAY, -1, column(1e-3), 1e-3, place),
        Tolerance(Kind.HABIT, 0, column(-4e-3), np.inf, place),
    )
    selection = Selection([], [Deviation(one, 0.0, 1e-3) for one in same])
    rest, std = _rest(bench, selection, delay.cause)
    assert rest == pytest.approx(LATE_S, abs=max(3.0 * std, 2e-4))
