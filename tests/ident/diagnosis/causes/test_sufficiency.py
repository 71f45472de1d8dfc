"""What of a healthy arm's own law is known too badly for a claim."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np

from ident.diagnosis.causes.candidates import Candidate, Trial
from ident.diagnosis.causes.healthy_null import HealthyNull
from ident.diagnosis.causes.sufficiency import Sufficiency
from ident.diagnosis.causes.tolerances import Kind, Tolerance
from ident.diagnosis.causes.usual_sizes import Healthy
from ident.diagnosis.gain.score import Score
from ident.diagnosis.settings import DiagnosisSettings
from ident.effects import EFFECTS, Shape

KEY = ("stribeck", 0)


def test_a_law_like_the_arms_own_is_a_claim_where_the_healthy_sets_were_as_slow() -> None:
    """A drop of 2 Nm beside an own law that may be 2.5 Nm larger."""
    motion = np.abs(np.sin(np.linspace(0.0, 40.0, 400)))[:, None]
    rows = {("motor", 0): np.exp(-((motion / 0.1) ** 2))}
    own = Tolerance(Kind.SIZE, 0, rows, 2.5, KEY)
    tolerated = SimpleNamespace(known=[own])
    found = Score(600.0, 600.0, np.array([2.0]), 1.0, lambda: (np.eye(1) / 150.0, 40))
    trial = Trial(Candidate(EFFECTS["stribeck"], 0), Shape(velocity=0.05), found, rows)
    dictionary = SimpleNamespace(
        nearest=lambda trial: "v",
        information=lambda candidate: {"v": 150.0},
        nominal=SimpleNamespace(rows={"motor": SimpleNamespace(valid=np.ones((400, 1), dtype=bool))}),
    )

    def carried(information: dict[str, float]) -> bool:
        """information : of the healthy sets on the shape."""
        healthy = Healthy({KEY: 1.0}, {KEY: information})
        null = HealthyNull(dictionary, DiagnosisSettings(), healthy)  # type: ignore[arg-type]
        return Sufficiency(dictionary, null, tolerated).carried(trial)  # type: ignore[arg-type]

    assert carried({"v": 150.0})
    assert carried({"v": 10.0})
    assert not carried({"v": 1.0})
    assert not carried({})
