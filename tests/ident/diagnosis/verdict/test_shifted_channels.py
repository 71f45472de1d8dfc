"""Late channels: what stands beside the delay that remains after a shift."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from ident.diagnosis.causes.candidates import Candidate
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

    tolerated = {"motor delay": column(1e-3), f"habit 1: {delay.cause} 0": column(-4e-3)}
    selection: Any = SimpleNamespace(claims=[], tolerated=tolerated)
    rest, std = _rest(bench, selection, delay.cause)
    assert rest == pytest.approx(LATE_S, abs=max(3.0 * std, 2e-4))
