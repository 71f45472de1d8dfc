"""Positions of the motors told from those of the links, on rows whose error by the twist is known."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from ident.rows.class_rows import ByClass, ClassRows
from ident.rows.encoder_side import USUAL_TWIST_RAD, AtMotors, at_motors
from ident.rows.filters import SignalSettings

EFFORT = np.array([80.0])
USUAL = float(EFFORT[0] / USUAL_TWIST_RAD)
BLOCKS, ROWS = 20, 30

Errors = dict[str, Callable[[float], float]]


def rows_with(errors: dict[str, float]) -> ByClass:
    """Rows of one joint with so large an error on each side; the same numbers at each call."""
    random = np.random.default_rng(0)
    count = BLOCKS * ROWS
    made: ByClass = {}
    for side, scale in errors.items():
        matrix = random.normal(size=(count, 1))
        # Blocks differ, as in recordings.
        own = scale * (1.0 + 0.01 * np.repeat(random.normal(size=BLOCKS), ROWS))
        torque = 2.0 * matrix[:, 0] + own * random.normal(size=count)
        made[side, 0] = ClassRows(
            matrix, torque, np.ones(count), np.ones((count, 0)), np.ones(count, dtype=bool),
            np.repeat(np.arange(BLOCKS), ROWS), (), (slice(0, count),), np.array([0]), 1,
        )  # fmt: skip
    return made


def told(errors: Errors, settings: SignalSettings | None = None) -> AtMotors | None:
    """What is told of rows whose error on each side depends on the twist over the usual one."""

    def at(twist: float) -> ByClass:
        # A little of chance in each block.
        random = np.random.default_rng(round(1e3 * twist))
        rows = rows_with({side: error(twist) for side, error in errors.items()})
        for own in rows.values():
            own.torque[:] += 1e-3 * random.normal(size=len(own.torque))
        return rows

    def rows_of(settings: SignalSettings) -> ByClass:
        assert settings.encoder == "motor"
        assert settings.stiffness_nm_rad is not None
        return at(USUAL / settings.stiffness_nm_rad[0])

    return at_motors(rows_of, at(0.0), settings or SignalSettings(), EFFORT)


def least_at(twist: float, gain: float = 0.1) -> Callable[[float], float]:
    """Error that is least at a twist, less there by `gain`."""
    return lambda at: float(np.exp(gain * ((at - twist) ** 2 / twist**2 - 1.0)))


def steady(_twist: float) -> float:
    return 1.0


@pytest.mark.parametrize("true", [0.25, 0.5, 1.0, 2.0])
def test_the_twist_of_the_least_error_is_found(true: float) -> None:
    found = told({"joint": least_at(true), "motor": steady})
    assert found is not None
    assert found.settings.stiffness_nm_rad == (USUAL / true,)


def test_a_twist_too_small_for_any_geared_joint_stands_for_something_else() -> None:
    assert told({"joint": least_at(0.17)}) is None


def test_a_side_that_the_twist_makes_worse_says_that_there_is_none() -> None:
    def worse(twist: float) -> float:
        return float(np.exp(0.03 * twist))

    assert told({"joint": least_at(1.0), "motor": worse}) is None


def test_stated_positions_of_the_motors_need_no_proof() -> None:
    found = told({"joint": least_at(0.1)}, SignalSettings(encoder="motor"))
    assert found is not None
    assert found.settings.stiffness_nm_rad == (USUAL / 0.25,)


@pytest.mark.parametrize(("factor", "expected"), [(1.0, True), (0.1, False)])
def test_a_stated_stiffness_is_held_against_the_data_alone(factor: float, expected: bool) -> None:
    found = told({"joint": least_at(1.0)}, SignalSettings(stiffness_nm_rad=(factor * USUAL,)))
    assert (found is not None) == expected


def test_without_joint_torques_nothing_is_told() -> None:
    assert told({"motor": least_at(1.0)}) is None
