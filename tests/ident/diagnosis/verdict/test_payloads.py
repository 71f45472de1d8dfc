"""A payload of another mass is told by the base parameters before anything else."""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from ident.diagnosis.healthy.reference import Reference, announced_masses, last_body
from ident.diagnosis.verdict.payloads import (
    OtherMass,
    UnstatedBody,
    other_masses,
    payload_finding,
    payload_findings,
    unchecked_masses,
    unstated_body,
    with_masses,
)
from ident.diagnosis.verdict.task import Task
from ident.dynamics.base_set import BaseSet, numeric_base
from ident.dynamics.kinematics import Chain
from ident.dynamics.structure import Condition, ModelStructure
from ident.model import DynamicModel
from tests.ident.diagnosis.references import bare_reference

MASSES = {"weight": 2.0, "other": None}


@pytest.fixture(scope="module")
def base(chain: Chain) -> BaseSet:
    structure = ModelStructure(chain, 1, ("weight",))
    return numeric_base(structure, (Condition(None, ("joint",)), Condition("weight", ("joint",))))


def bench(base: BaseSet, mass: float, std: float) -> Any:
    place = next(iter(announced_masses(base, MASSES)))
    values, covariance = np.zeros(len(base)), np.zeros((len(base),) * 2)
    values[place], covariance[place, place] = mass, std**2
    evidence = SimpleNamespace(extra=["kept"], free=lambda: (values, covariance))
    evidence.free_inverse = lambda: 1e-4 * np.eye(len(base))
    evidence.beside = lambda extra: nullcontext(setattr(evidence, "held", list(extra)))
    nominal = SimpleNamespace(base=base, masses=MASSES, arm=SimpleNamespace(chain=base.structure.chain))
    return SimpleNamespace(evidence=evidence, nominal=nominal)


def healthy(base: BaseSet, mass: float, std: float) -> Reference:
    place = next(iter(announced_masses(base, MASSES)))
    values, covariance = np.zeros(len(base)), 1e-6 * np.eye(len(base))
    values[place], covariance[place, place] = mass, std**2
    model = DynamicModel("arm", base.structure, base.names, values, covariance, base)
    return bare_reference(model, habits=True, masses=MASSES)


def test_a_mass_is_held_against_the_healthy_one_or_the_announced_one(base: BaseSet) -> None:
    said = bench(base, 2.6, 0.01)
    (one,) = other_masses(said, None)
    assert (one.payload, one.mass, one.expected) == ("weight", 2.6, 2.0)
    assert "2.600 ± 0.041 kg by these sessions alone, 2.000 kg expected" in one.text
    assert said.evidence.held == []
    # Findings are in the order of what they take off the error of the rows.
    assert payload_finding(one).gain == pytest.approx(0.6**2 / 1e-4)
    # The healthy arm weighed 2.6 kg under this label, too.
    assert not other_masses(said, healthy(base, 2.6, 0.02))
    (changed,) = other_masses(said, healthy(base, 2.2, 0.02))
    assert changed.expected == pytest.approx(2.2)


@pytest.mark.parametrize(("mass", "std"), [(2.6, 0.3), (2.08, 0.01), (2.0, 0.01)])
def test_an_uncertain_or_small_difference_is_none(base: BaseSet, mass: float, std: float) -> None:
    assert not other_masses(bench(base, mass, std), None)


def test_a_stated_mass_that_nothing_is_held_against_is_told(base: BaseSet) -> None:
    other = replace(healthy(base, 2.0, 0.02), masses={"other": None})
    alone = numeric_base(base.structure, (Condition("weight", ("joint",)),))
    assert unchecked_masses(alone, MASSES, other) == ["weight"]
    # Beside sessions without it the mass is a parameter; that of the healthy arm's payload is compared with it.
    assert unchecked_masses(base, MASSES, other) == []
    assert unchecked_masses(alone, MASSES, healthy(base, 2.0, 0.02)) == []
    assert unchecked_masses(alone, {"weight": 3.0}, healthy(base, 2.0, 0.02)) == ["weight"]
    assert unchecked_masses(alone, {"weight": None}, other) == []


def test_the_finding_says_the_mass_and_is_surer_for_a_clearer_one() -> None:
    clear, faint = (
        payload_finding(OtherMass("weight", 2.0 + more, 2.0, 0.04, 12.0, 1e3)) for more in (0.8, 0.2)
    )
    assert clear.cause == "payload_error"
    assert clear.parameters["mass"].value == pytest.approx(0.8)
    assert clear.confidence > faint.confidence > 0.5


def test_a_payload_gets_its_own_mass_in_its_recordings_alone() -> None:
    from dataclasses import dataclass

    @dataclass(frozen=True)
    class Recording:
        payload: str | None
        payload_mass: float | None

    task = Task((), (), None, (Recording("weight", 2.0), Recording(None, None)), None, None, None, None, None)  # type: ignore[arg-type]
    changed = with_masses(task, {"weight": 2.6})
    assert [one.payload_mass for one in changed.recordings] == [2.6, None]


BODY = np.array([0.4, 0.02, 0.01, 0.03, *[0.0] * 6])


def carried(base: BaseSet, healthy: Reference, body: Any, turned: tuple[Any, ...] = ()) -> Any:
    """A bench of sessions with a body on the last link, and causes that turn the base parameters."""
    values = healthy.model.values + last_body(base) @ body
    said = bench(base, 2.0, 0.01)
    said.evidence.compared = True
    said.evidence.free = lambda: (values, 1e-8 * np.eye(len(base)))
    said.evidence.free_inverse = lambda: np.eye(len(base))
    products = [SimpleNamespace(alone=np.reshape(one, (1, 1, -1))) for one in turned]
    causes = [SimpleNamespace(effect=None, products=one) for one in products]
    said.dictionary = SimpleNamespace(candidates=causes, products=lambda cause: [cause.products])
    return said


def test_a_body_that_no_session_states_shows_against_the_healthy_arm(base: BaseSet) -> None:
    arm = healthy(base, 2.0, 0.02)
    found = unstated_body(carried(base, arm, BODY), arm)
    assert found is not None
    assert found.values[:4] == pytest.approx(BODY[:4], abs=2e-3)
    told = payload_finding(found)
    assert list(told.parameters) == ["mass", "moment_x", "moment_y", "moment_z"]
    assert told.parameters["mass"].value == pytest.approx(0.4, abs=2e-3)
    # With it the healthy arm is that of these sessions.
    again = arm.carrying(found.values, found.covariance)
    assert np.allclose(again.model.values, arm.model.values + last_body(base) @ found.values)
    assert unstated_body(carried(base, again, 0.0 * BODY), again) is None


def test_no_body_is_told_that_another_cause_or_chance_explains(base: BaseSet) -> None:
    arm = healthy(base, 2.0, 0.02)
    change = last_body(base) @ BODY
    assert unstated_body(carried(base, arm, 1e-3 * BODY), arm) is None
    # First moments without a mass are of something else.
    assert unstated_body(carried(base, arm, BODY * np.r_[0.2, np.ones(9)]), arm) is None
    assert unstated_body(carried(base, arm, BODY, (change,)), arm) is None
    other = np.zeros(len(base))
    other[0] = 1.0
    assert unstated_body(carried(base, arm, BODY, (other,)), arm) is not None


def test_no_body_is_told_of_differences_that_another_cause_explains_better(base: BaseSet) -> None:
    """A tilt turns the same parameters and others; what is left of it beside a body is no chance, but much."""
    arm = healthy(base, 2.0, 0.02)
    turned = last_body(base) @ BODY + np.random.default_rng(2).normal(size=len(base))

    def told(body: Any, also: Any, causes: tuple[Any, ...] = ()) -> Any:
        found = carried(base, arm, body, causes)
        values, covariance = found.evidence.free()
        found.evidence.free = lambda: (values + also, covariance)
        return unstated_body(found, arm)

    assert told(0.0 * BODY, turned, (turned,)) is None
    beside = told(3.0 * BODY, turned, (turned,))
    assert beside is not None
    assert beside.values[0] == pytest.approx(1.2, abs=0.05)
    # Differences that nothing explains widen the deviations of a body.
    alone, noisy = told(3.0 * BODY, 0.0), told(3.0 * BODY, 0.02 * turned)
    assert noisy.covariance[0, 0] > 2.0 * alone.covariance[0, 0]
    assert noisy.square < alone.square


def unstated(mass: float) -> UnstatedBody:
    values = np.array([mass, 0.03, 0.01, 0.09, *[0.0] * 6])
    return UnstatedBody(values, np.diag([0.1, *[0.01] * 9]) ** 2, 60.0, 12.0, 900.0)


@pytest.mark.parametrize(
    ("body", "more", "told"),
    [
        # A body in the bare session alone makes the payload lighter by as much.
        (1.2, -1.2, [(None, ("bare.mcap", "other.mcap"), 1.2)]),
        # The same body below the payload, too; then no mass counts from it.
        (1.2, None, [(None, ("bare.mcap", "loaded.mcap", "other.mcap"), 1.2)]),
        (None, -1.2, [("weight", ("loaded.mcap",), -1.2)]),
        (1.2, 0.9, [("weight", ("loaded.mcap",), 2.1), (None, ("bare.mcap", "other.mcap"), 1.2)]),
        (1.2, -2.0, [("weight", ("loaded.mcap",), -0.8), (None, ("bare.mcap", "other.mcap"), 1.2)]),
    ],
)
def test_a_mass_counts_from_what_the_bare_flange_carries(
    body: float | None, more: float | None, told: list[tuple[str | None, tuple[str, ...], float]]
) -> None:
    mounted = {"bare.mcap": None, "loaded.mcap": "weight", "other.mcap": "other"}
    records: Any = [SimpleNamespace(name=name, payload=payload) for name, payload in mounted.items()]
    others = [] if more is None else [OtherMass("weight", 3.0 + more, 3.0, 0.1, 12.0, 900.0)]
    found = payload_findings(others, None if body is None else unstated(body), records)
    assert [(one.payload, one.sessions) for one in found] == [(payload, names) for payload, names, _ in told]
    masses = [one.parameters["mass"].value for one in found]
    assert masses == pytest.approx([mass for *_, mass in told])
    for one in found:
        content = one.to_dict()
        assert (content["payload"], content["sessions"]) == (one.payload, list(one.sessions))
        said = " ".join(str(one).split())
        assert f"{f'payload {one.payload!r} ' if one.payload else ''}in {', '.join(one.sessions)}." in said


def test_a_mass_beside_a_body_is_as_uncertain_as_both() -> None:
    one = OtherMass("weight", 3.5, 3.0, 0.3, 12.0, 100.0).with_body(unstated(0.5))
    assert one.mass == pytest.approx(4.0)
    assert one.std == pytest.approx(np.hypot(0.3, 0.1))
    assert one.fall == pytest.approx(400.0)
