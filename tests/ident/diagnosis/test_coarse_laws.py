"""A strong cause whose law is coarse, and a claim that motions not fitted do not bear out."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from ident.diagnosis import diagnose
from ident.diagnosis.causes.candidates import Candidate
from ident.diagnosis.causes.model_form import model_form_error
from ident.diagnosis.gain.products import Rows
from ident.diagnosis.outcome.signatures import signature_bench
from ident.dynamics.kinematics import Chain
from ident.effects import find_effect
from tests.ident.diagnosis.changes import Make, Signals, pair, stribeck


def odd_hose(s: Signals) -> None:
    """Pulls with a form that no law of a hose has, and rubs."""
    angle = s["q"][:, 2]
    pull = 0.25 * np.tanh(6.0 * (angle - 0.1)) + 0.12 * np.sin(7.0 * angle)
    s["motor"][:, 2] += pull
    s["joint"][:, 2] += pull


@pytest.mark.slow
def test_what_a_hose_of_another_form_leaves_is_no_second_cause(make: Make, chain: Chain) -> None:
    """A third of it is a wave of the angle, so its name is open."""
    found = diagnose(pair(make, odd_hose), chain)
    assert {(f.cause, f.joints) for f in found.claims} == {("cable_spring", (3,))}
    assert found.claims[0].confidence == 0.7
    assert 3 in {u.joint for u in found.unexplained}


@pytest.mark.slow
@pytest.mark.parametrize(("joint", "named"), [(2, {2}), (3, {2, 3})], ids=["its own rows", "others"])
def test_what_the_least_error_of_a_strong_law_explains_is_no_second_cause(
    make: Make, chain: Chain, joint: int, named: set[int]
) -> None:
    def both(s: Signals) -> None:
        for _ in range(8):
            stribeck(s)
        s["motor"][:, joint - 1] += (
            0.035 * np.sin(4.0 * s["q"][:, joint - 1]) * np.sign(s["qd"][:, joint - 1])
        )

    found = diagnose(pair(make, both), chain)
    assert {j for f in found.claims for j in f.joints} == named
    assert len(found.claims) == len(named)
    assert max(found.claims, key=lambda f: f.gain).cause == "stribeck"


@pytest.mark.parametrize("cause", ["joint_elasticity", "backlash"])
def test_a_turn_about_the_vertical_is_nothing_beyond_its_law(make: Make, chain: Chain, cause: str) -> None:
    dictionary = signature_bench([make("a.mcap", 1)], chain).dictionary

    def beyond(joint: int) -> Rows | None:
        return model_form_error(dictionary, SimpleNamespace(candidate=Candidate(find_effect(cause), joint)))

    assert beyond(0) is None
    assert beyond(1)


@pytest.mark.long
def test_a_cause_is_claimed_only_where_a_motion_that_was_not_fitted_shows_it_too(
    make: Make, chain: Chain
) -> None:
    train = pair(make, stribeck)
    same = diagnose(train, chain, test=[make("c.mcap", 3, stribeck, 2)])
    assert [(f.cause, f.joints) for f in same.claims] == [("stribeck", (2,))]
    gone = diagnose(train, chain, test=[make("c.mcap", 3, None, 2)])
    assert not gone.claims
