"""The models of a diagnosis hold what lasts, and the drives' friction as the rows had it."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from ident.diagnosis.causes.selection import Selection
from ident.diagnosis.causes.tolerances import Deviation, Kind, Tolerance
from ident.diagnosis.rows.nominal_arm import NominalArm
from ident.diagnosis.verdict.models import staying, turning_friction
from ident.diagnosis.verdict.task import ModelFit
from ident.effects import DELAYS, PRESLIDING, entry_of


def selection(*tolerated: tuple[Kind, int, float, float]) -> Selection:
    late = (DELAYS["motor"].cause, -1)
    return Selection(
        [],
        [
            Deviation(Tolerance(kind, number, {}, 1.0, late if number < 0 else None), value, std)
            for kind, number, value, std in tolerated
        ],
    )


def test_a_model_stays_beside_delays_stiffness_and_clear_gains_alone() -> None:
    tolerated = selection(
        (Kind.DELAY, -1, 1e-3, 1e-4),
        (Kind.COMPLIANCE, 1, 1e-5, 1e-6),
        (Kind.GAIN, 0, 0.02, 0.001),
        (Kind.GAIN, 1, 0.02, 0.015),
        (Kind.GAIN, 2, 0.001, 1e-5),
        (Kind.LENGTH, 3, 0.3, 0.1),
    )
    stribeck, late = ("stribeck", 0), (DELAYS["motor"].cause, -1)
    tolerated.deviations = [
        *tolerated.deviations,
        Deviation(Tolerance(Kind.HABIT, 0, {}, np.inf, stribeck), 0.8, 0.1),
        Deviation(Tolerance(Kind.HABIT, 1, {}, np.inf, late), 0.8, 0.1),
    ]
    names = [one.name for one in staying(tolerated)]
    assert names == ["motor delay", "compliance 2", "gain 1", f"habit 2: {late[0]} 0"]


def bench(rows: tuple[str, ...], far_share: float = 0.0) -> Any:
    arm = NominalArm(
        None,  # type: ignore[arg-type]
        np.zeros(2),
        np.ones(2),
        presliding=np.array([0.0, 0.01]),
        far=np.array([0.0, 0.1]),
        far_share=np.array([0.0, far_share]),
    )
    return SimpleNamespace(nominal=SimpleNamespace(arm=arm, rows=dict.fromkeys(rows)))


def model(link: float, motor: float) -> Any:
    return SimpleNamespace(drive=lambda: {"Fcl": np.array([1.0, link]), "Fcm": np.array([1.0, motor])})


def sizes(entries: list[dict[str, Any]]) -> list[tuple[float, float]]:
    assert all(e["cause"] == PRESLIDING.cause and e["joints"] == [2] for e in entries)
    return [(e["parameters"]["amplitude"]["value"], e["parameters"]["length"]["value"]) for e in entries]


def test_the_friction_of_a_drive_turns_over_the_length_of_these_days() -> None:
    entries = turning_friction(
        model(0.5, 4.0), bench(("joint", "motor")), selection((Kind.LENGTH, 1, np.log(1.5), 0.1)), ()
    )
    assert sizes(entries) == [pytest.approx((4.0, 0.015))]


def test_without_joint_torques_friction_of_link_and_drive_is_one() -> None:
    entries = turning_friction(model(4.0, 0.0), bench(("motor",)), selection(), ())
    assert sizes(entries) == [pytest.approx((4.0, 0.01))]


def test_what_was_found_takes_its_part_and_the_rest_may_turn_in_two_lengths() -> None:
    found = entry_of(PRESLIDING, [2], {"amplitude": (1.0, 0.1), "length": (0.05, 0.0)})
    entries = turning_friction(model(0.0, 4.0), bench(("joint", "motor"), 0.25), selection(), (found,))
    assert sizes(entries) == [pytest.approx((2.25, 0.01)), pytest.approx((0.75, 0.1))]


def test_nothing_turns_slowly_without_motor_torques() -> None:
    assert turning_friction(model(1.0, 1.0), bench(("joint",)), selection(), ()) == []


class Fits:
    """Evidence with a fitted value and standard deviation of each set of columns."""

    base_count = 1

    def __init__(self, found: dict[int, tuple[float, float]]) -> None:
        self.found, self.extra = found, list[Any]()

    def replace(self, extra: list[Any]) -> None:
        self.extra = list(extra)

    @property
    def full(self) -> Any:
        return SimpleNamespace(values=np.array([5.0, *(self.found[id(one)][0] for one in self.extra)]))

    def covariance(self) -> np.ndarray:
        return np.diag([0.1, *(self.found[id(one)][1] for one in self.extra)]) ** 2


def test_a_size_that_is_not_clear_beside_the_columns_of_a_model_is_none_of_it() -> None:
    clear, unclear, late = {("motor", 0): np.ones(1)}, {("motor", 1): np.ones(1)}, {("motor", 2): np.ones(1)}
    beside = [
        Tolerance(Kind.SIZE, 0, clear, 1.0),
        Tolerance(Kind.SIZE, 1, unclear, 1.0),
        Tolerance(Kind.DELAY, -1, late, 1.0, (DELAYS["motor"].cause, -1)),
    ]
    evidence: Any = Fits({id(clear): (0.4, 0.1), id(unclear): (0.5, 0.4), id(late): (0.1, 1.0)})
    fit = ModelFit.of(evidence, [], beside)
    assert [one.tolerance for one in fit.beside] == [beside[0], beside[2]]
    assert [id(one) for one in evidence.extra] == [id(clear), id(late)]
    assert fit.values.tolist() == [5.0]
    assert fit.covariance[0, 0] == pytest.approx(0.01)
