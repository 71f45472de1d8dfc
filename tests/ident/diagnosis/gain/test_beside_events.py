"""Held-back gains beside further columns."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from ident.diagnosis.causes.candidates import Candidate
from ident.diagnosis.outcome.signatures import signature_bench
from ident.dynamics.kinematics import Chain
from ident.effects import find_effect
from tests.ident.diagnosis.changes import Make, Signals, pair, stribeck


def test_gains_beside_a_moment_are_those_without_it(make: Make, chain: Chain) -> None:
    """Of an event that lies in one held-back part but for its edge, the other parts tell nothing."""

    def pushed(s: Signals) -> None:
        stribeck(s)
        s["motor"][at(s["time"] - s["time"][0]), 1] += 400.0

    def at(time: np.ndarray) -> np.ndarray:
        return (time > 1.0) & (time < 1.3)

    def gain(change: Callable[[Signals], None], *, beside: bool) -> float:
        bench = signature_bench(pair(make, change), chain)
        evidence, rows = bench.evidence, bench.nominal.rows["motor"]
        evidence.replace([])
        if beside:
            start = {r.number: r.start_s for r in bench.nominal.recordings}
            time = rows.time - np.array([start[k] for k in rows.session.tolist()])
            block = evidence.block_of("motor")
            push = np.where(at(time), 400.0, 0.0)
            # Its edge in another part, where a row of noise decides about the whole push.
            mine = evidence.fold[block[np.argmax(push)]]
            push[np.argmax((block >= 0) & (evidence.fold[block] != mine))] = 0.1
            evidence.replace([{("motor", 1): push[:, None]}])
        found = bench.dictionary.best(Candidate(find_effect("stribeck"), 1))
        assert found is not None
        return found.score.gain

    quiet = gain(stribeck, beside=False)
    assert quiet > 100.0
    assert gain(pushed, beside=True) == pytest.approx(quiet, rel=0.01)
