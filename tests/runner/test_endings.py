"""The last lines of a command: the numbers of a summary."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from ident.diagnosis.outcome.look_alikes import LookAlikes
from lwr_driver.session import describe
from runner.commands.commission import _percent
from runner.ending import compared, numbers_of, of_session
from tests.lwr_driver.session.session_samples import plain_messages, ros_session


def session(motor: float | None, joint: float | None = None) -> dict[str, Any]:
    return {
        "motor_delay_s": motor,
        "motor_delay_std_s": 2e-4,
        "joint_delay_s": joint,
        "joint_delay_std_s": 1e-4,
    }


@pytest.mark.parametrize(
    ("sessions", "told"),
    [
        ([session(0.0), session(None)], None),
        ([session(2e-3), session(0.0, 0.0)], "motor torques 0.0 to 2.0 ms after the positions, ± 0.2 ms"),
        ([session(0.0), session(0.0)], None),
        (
            [session(0.0, -1e-3), session(0.0, 0.0)],
            "joint torques 0.0 to 1.0 ms before the positions, ± 0.1 ms",
        ),
        (
            [session(2e-3, -1e-3), session(3e-3)],
            "motor torques 2.0 to 3.0 ms after the positions, ± 0.2 ms; "
            "joint torques 1.0 ms before the positions, ± 0.1 ms",
        ),
    ],
)
def test_delays_in_use_are_told(sessions: list[dict[str, Any]], told: str | None) -> None:
    # As `Identification.to_dict` has them, and as summary.json.
    for summary in ({"sessions": sessions}, {"sessions": [], "prepared": sessions}):
        assert dict(numbers_of(summary)).get("delay") == told


def test_the_torque_error_is_that_of_the_worst_session_and_of_held_out_ones_where_there_are() -> None:
    fit = [{"torque_error": {"joint": 0.03, "motor": 0.04}}, {"torque_error": {"joint": 0.02, "motor": 0.05}}]
    held = [{"seen": False, "torque_error": {"joint": 0.06}}]
    assert (
        dict(numbers_of({"sessions": [], "fit": fit}))["torque error"]
        == "joint 2.00 %, motor 5.00 % on data of the estimate"
    )
    assert (
        dict(numbers_of({"sessions": [], "fit": fit, "validation": held}))["torque error"]
        == "joint 6.00 % on held-out data"
    )


@pytest.mark.parametrize(
    ("slides", "words"),
    [
        ({"z": 2.04e-4}, "of 2 drives turns over 3 mrad and 0.2 mm, in the model: "),
        ({"z": 1e-3, "y": 2e-3}, "of 3 drives turns over 3 mrad and 1 to 2 mm, in the model: "),
    ],
)
def test_lengths_of_sliding_joints_are_told_in_millimetres(slides: dict[str, float], words: str) -> None:
    error = {"without": 5.2, "with": 4.9}
    turning = {"length_rad": {"A1": 3e-3}, "length_m": slides, "torque_error_percent": error}
    choice = {"chosen": "wls", "used": "wls", "candidates": [{"title": "wls", "held_back_percent": 1.0}]}
    told = dict(numbers_of({"sessions": [], "choice": choice | {"friction_turns": turning}}))["friction"]
    assert told.startswith(words)


@pytest.mark.parametrize(
    ("lengths", "words"),
    [
        ({"A1": 2.04e-3, "A2": 0.104}, "of 2 drives turns over 2 to 100 mrad, in the model: "),
        ({"A1": 2.04e-3}, "of one drive turns over 2 mrad, in the model: "),
        ({"A1": 1e-5, "A2": 2e-5}, "of 2 drives stays at rest as it was, in the model: "),
    ],
)
def test_lengths_of_turning_friction_are_told_without_exponents(
    lengths: dict[str, float], words: str
) -> None:
    turning = {
        "length_rad": lengths,
        "torque_error_percent": {"without": 5.2, "with": 4.9},
    }
    choice = {"chosen": "wls", "used": "wls", "candidates": [{"title": "wls", "held_back_percent": 1.0}]}
    told = dict(numbers_of({"sessions": [], "choice": choice | {"friction_turns": turning}}))["friction"]
    assert told.startswith(words)


def test_a_bag_of_another_program_is_identified_and_not_recovered(tmp_path: Path) -> None:
    ros_session(tmp_path / "bag.mcap", plain_messages(300)[0])
    found = describe(tmp_path / "bag.mcap")
    ending = of_session(found)
    assert (ending.level, "recorded by another program" in ending.sentence) == ("good", True)
    assert ending.next_step.startswith("lwr-run identify")
    own = of_session(replace(found, metadata={"robot": "arm"}))
    assert "the recorder died" in own.sentence
    assert own.next_step.startswith("lwr-run recover")


def test_a_comparison_of_causes_asked_for_has_a_line() -> None:
    pair = LookAlikes(
        0, ("cable_spring", (5,)), ("base_tilt", ()), 0.25, (40.0, 9.0), ("angle", "angle"), ("slow", "slow")
    )
    name, value = compared(pair, ("A1", "A2", "E1", "A3", "A4"))
    assert name == "cable_spring A4 or base_tilt"
    assert value.startswith("told apart by these sessions: overlap 0.250, rest 38.7")
    assert compared(replace(pair, alike=1.0), ("A1",) * 5)[1].startswith("not told apart")


@pytest.mark.parametrize(
    ("spread", "told"), [(0.3141, "0.31 %"), (217.3, "220 %"), (1e9, "> 1000 %"), (None, None)]
)
def test_the_spread_of_the_parameters_is_the_one_of_the_estimate(
    spread: float | None, told: str | None
) -> None:
    summary = {
        "sessions": [],
        "counts": {"base": 9},
        "essential": {"count": 7, "loss_percent": 0.5, "names": []},
        "median_rsd_percent": spread,
    }
    text = dict(numbers_of(summary))["parameters"]
    assert text == "9 estimated, 7 essential" + (f", median relative std {told}" if told else "")


def test_parameters_of_no_real_body_have_a_line_unless_they_are_warned_of() -> None:
    real = {"real": False, "possible": True, "text": "no real bodies: ZZ7"}
    assert dict(numbers_of({"sessions": [], "feasibility": real}))["real bodies"] == "no real bodies: ZZ7"
    for other in (real | {"possible": False}, real | {"real": True}):
        assert "real bodies" not in dict(numbers_of({"sessions": [], "feasibility": other}))


@pytest.mark.parametrize(
    ("condition", "told"),
    [(68.79999, "68.8"), (12345.678, "12350"), (5.405e18, "infinite: the motion does not")],
)
def test_a_condition_number_of_rounding_is_told_as_infinite(condition: float, told: str) -> None:
    assert dict(numbers_of({"sessions": [], "condition": condition}))["condition number"].startswith(told)


@pytest.mark.parametrize(
    ("share", "told"), [(0.0, "–"), (0.09, "9"), (0.49, "49"), (0.5, "unknown"), (16.4, "unknown")]
)
def test_a_stiffness_known_no_better_than_a_stated_one_is_unknown(share: float, told: str) -> None:
    assert _percent(share * 2e-4, 2e-4) == told
    assert _percent(share, 0.0) == "–"
