from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from ident.diagnosis.causes.candidates import Candidate, Dictionary, Trial
from ident.diagnosis.causes.contest import Contest, same_moment
from ident.diagnosis.gain.score import Score
from ident.diagnosis.settings import DiagnosisSettings
from ident.effects import EFFECTS, Shape


def push(time: float, duration: float, session: float = 1.0) -> Trial:
    shape = {"time": time, "duration": duration, "session": session, "link": 5.0}
    return Trial(Candidate(EFFECTS["contact"], -1), shape, cast(Score, None), {})


def test_what_a_push_leaves_while_it_lasts_is_no_second_one() -> None:
    first = push(4.0, 1.0)
    assert same_moment(push(4.4, 0.3), first)
    assert same_moment(push(4.7, 0.3), first)
    assert not same_moment(push(6.0, 0.3), first)
    assert not same_moment(push(4.0, 1.0, session=2.0), first)
    load = Trial(
        Candidate(EFFECTS["payload_change"], -1), {"time": 4.0, "session": 1.0}, cast(Score, None), {}
    )
    assert not same_moment(load, first)


def scored(gain: float, *coefficients: float, std: float = 1.0) -> Score:
    c = np.array(coefficients)
    return Score(gain, gain, c, 0.1, lambda: (std**2 * np.eye(len(c)), 60))


def test_of_two_pushes_that_a_search_of_times_brought_together_the_stronger_is_told() -> None:
    first, second = (
        replace(push(at, 0.8), score=scored(gain, 5.0)) for at, gain in ((17.7, 900.0), (17.5, 60.0))
    )
    contest = Contest(None, DiagnosisSettings())  # type: ignore[arg-type]
    assert contest.leftover(second, [first])
    assert not contest.leftover(first, [second])


@pytest.mark.parametrize(("std", "form"), [(0.2, "linear"), (0.02, "hardening")])
def test_a_spring_hardens_only_where_its_bend_is_beyond_chance(std: float, form: str) -> None:
    spring = EFFECTS["cable_spring"]
    bent = Trial(
        Candidate(spring, 3), Shape(spring.form_of("hardening")), scored(900.0, 0.5, -0.3, -0.1, std=std), {}
    )

    def plain(candidate: Candidate, shape: Shape) -> Trial:
        return Trial(candidate, shape, scored(890.0, 1.0), {})

    given: Any = SimpleNamespace(trial=plain, evidence=SimpleNamespace(settings=DiagnosisSettings()))
    assert Dictionary._simplified(given, bent).shape.form_name == form
    other = replace(bent, shape=Shape(spring.form_of("cubic")))
    assert Dictionary._simplified(given, other) is other
