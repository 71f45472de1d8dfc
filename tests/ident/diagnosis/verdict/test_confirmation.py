"""Held-out data refute what they neither show beyond chance nor feel."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from ident.diagnosis import diagnose
from ident.diagnosis.causes.candidates import Candidate, Trial
from ident.diagnosis.causes.claims import Claim
from ident.diagnosis.gain.score import Score
from ident.diagnosis.outcome.result import Finding, FindingEvidence, Value
from ident.diagnosis.settings import DiagnosisSettings
from ident.diagnosis.verdict.confirmation import _one_way, _refuted
from ident.diagnosis.verdict.findings import sizeless
from ident.dynamics.kinematics import Chain
from ident.effects import EFFECTS, Shape
from lwr_driver.session import Session

BENCH: Any = SimpleNamespace(evidence=SimpleNamespace(settings=DiagnosisSettings()))


def refuted(
    after: float, fallen: tuple[float, float], *, cause: str = "friction_asymmetry", hardly: bool = False
) -> bool:
    effect = EFFECTS[cause]
    score = Score(2000.0, 2000.0, np.ones(1), 0.1, lambda: (np.eye(1), 40))
    claim = Claim(Trial(Candidate(effect, 3), Shape(), score, {}), score)
    evidence = FindingEvidence(-2000.0, 1e-12, 0.1, after, (-0.01, 0.03))
    finding = Finding(
        cause, effect.side, (4,), parameters={}, evidence=evidence, confidence=0.7, tell_apart="", gain=2000.0
    )
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


def test_the_weaker_half_of_friction_in_one_direction_is_never_sure() -> None:
    def claim(cause: str, gain: float, joint: int = 3) -> Claim:
        score = Score(gain, gain, np.ones(1), 0.1, lambda: (np.eye(1), 40))
        rows = {("motor", joint): np.ones((4, 1))}
        return Claim(Trial(Candidate(EFFECTS[cause], joint), Shape(), score, rows), score)

    friction, spring = claim("friction_position", 900.0), claim("cable_spring", 400.0)
    assert _one_way(spring, [friction, spring])
    assert not _one_way(friction, [friction, spring])
    assert not _one_way(spring, [claim("friction_position", 900.0, joint=2), spring])
    assert not _one_way(spring, [claim("gear_ripple", 900.0), spring])


@pytest.mark.parametrize(
    ("cause", "sizes", "told"),
    [
        ("friction_temperature", {"change": (-0.3, 3.1), "time_constant": (283.0, 3000.0)}, False),
        (
            "cable_spring",
            {"stiffness": (0.06, 0.05), "quadratic": (-0.04, 0.03), "cubic": (0.009, 0.005)},
            False,
        ),
        (
            "cable_spring",
            {"stiffness": (0.06, 0.01), "quadratic": (-0.04, 0.03), "cubic": (0.009, 0.005)},
            True,
        ),
        ("stribeck", {"amplitude": (2.4, 2.0), "velocity": (0.06, 0.01), "exponent": (3.0, 1.9)}, False),
        ("stribeck", {"amplitude": (0.6, 0.1), "velocity": (0.06, 0.01), "exponent": (3.0, 1.9)}, True),
        # Its one parameter is a shape.
        ("joint_torque_delay", {"delay": (0.0005, 0.001)}, True),
    ],
)
def test_a_cause_of_no_size_is_no_finding(
    cause: str, sizes: dict[str, tuple[float, float]], told: bool
) -> None:
    values = {name: Value(*size, "1") for name, size in sizes.items()}
    evident = FindingEvidence(0.0, 1e-9, 0.1, 0.09, (0.0, 0.0), ())
    finding = Finding(
        cause, "motor", (1,), parameters=values, evidence=evident, confidence=0.9, tell_apart="", gain=50.0
    )
    assert sizeless(finding) != told
    assert not sizeless(replace(finding, alternatives=(("contact", (), -40.0),)))


def test_a_cause_that_held_out_sessions_refute_is_listed_among_the_doubted(
    make: Callable[..., Session], chain: Chain
) -> None:
    """A spring at the second joint while the sessions of the fit were recorded, and none in the held-out one."""

    def hose(s: dict[str, np.ndarray]) -> None:
        torque = 6.0 * s["q"][:, 1]
        s["joint"][:, 1] += torque
        s["motor"][:, 1] += torque

    sprung = [make("a.mcap", 1, hose), make("b.mcap", 2, hose, 1)]
    found = diagnose(sprung, chain, test=[make("c.mcap", 3, None)])
    refuted = [f for f in found.doubted if f.confidence == 0.0]
    assert [(f.cause, f.joints) for f in refuted] == [("cable_spring", (2,))]
    assert not any(f.cause == "cable_spring" for f in found.claims)
