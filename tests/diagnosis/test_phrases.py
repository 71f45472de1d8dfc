"""What a finding says of its cause in words."""

from __future__ import annotations

from typing import Any

import pytest

from ident.effects import EFFECTS
from runner.diagnosis.phrases import described, parameter_rows
from runner.diagnosis.words import CAUSES, named, one_joint, variable_of

NAMES = ("A1", "A2", "E1", "A3", "A4", "A5", "A6")


def plain(cause: str, **values: float) -> dict[str, Any]:
    """Parameters of a cause as diagnosis.json has them."""
    units = {p.name: p.unit for p in EFFECTS[cause].parameters}
    return {name: {"value": value, "std": 0.01, "unit": units[name]} for name, value in values.items()}


@pytest.mark.parametrize("cause", EFFECTS)
def test_every_cause_has_words(cause: str) -> None:
    shown = [p.name for p in EFFECTS[cause].parameters if p.name not in EFFECTS[cause].hidden]
    parameters = plain(cause, **dict.fromkeys(shown, 2.0))
    text = described(cause, parameters, NAMES)
    assert text
    assert "_" not in text
    assert cause in CAUSES
    assert variable_of(cause) in ("velocity", "load", "position", "time", "motor angle")
    assert [name for name, _, _ in parameter_rows(cause, parameters)] == shown
    assert all(meaning for _, _, meaning in parameter_rows(cause, parameters))


@pytest.mark.parametrize(
    ("cause", "values", "said"),
    [
        ("cable_spring", {"stiffness": 0.44, "kind": -2, "slack": 0.11}, "taut below 0.11 ± 0.01 rad (6.3°)"),
        ("cable_spring", {"stiffness": 0.44, "kind": 1, "slack": 0}, "the cube of the angle, 0.44 ± 0.01 Nm/rad³"),
        ("cable_spring", {"stiffness": 1, "kind": 4, "slack": 0.5, "play": 0.2}, "no pull within 0.20 ± 0.01 rad"),
        ("sensor_ripple", {"cosine": 3, "sine": 4, "cycles_per_turn": 4, "ratio": 1},
         "5.00 ± 0.01 Nm, four times a turn of the joint"),
        ("sensor_ripple", {"cosine": 3, "sine": 4, "cycles_per_turn": 2, "ratio": 100}, "twice a turn of the motor"),
        ("friction_position", {"cosine": -0.3, "cycles_per_turn": 0, "centre": 0.2, "reach": 0.5},
         "0.30 ± 0.01 Nm less in the middle of a spot that reaches 0.50 ± 0.01 rad (29°) to either side of 0.20"),
        ("friction_position", {"cosine": 3, "sine": 4, "cycles_per_turn": 2}, "5.00 ± 0.01 Nm, twice a turn"),
        ("sensor_saturation", {"limit": 16.3, "seen": 1}, "no more than 16.30 ± 0.01 Nm; its samples stop there"),
        ("sensor_saturation", {"limit": 16.3}, "no more than 16.30 ± 0.01 Nm"),
        ("sensor_gain", {"error": -0.02}, "reads 2 ± 1 % too little"),
        ("sensor_crosstalk", {"factor": 0.05, "source": 4}, "5 ± 1 % of the torque of joint A3"),
        ("friction_temperature", {"change": -0.2, "time_constant": 0}, "from the first session to the others"),
        ("joint_elasticity", {"compliance": 0.1, "encoder": 1}, "the encoders sit at the motors"),
        ("viscous_nonlinear", {"coefficient": -1.5, "exponent": 1.6}, "grows slower than the speed"),
        ("viscous_nonlinear", {"coefficient": 1.5, "exponent": 1.6}, "grows faster than the speed"),
        ("base_tilt", {"tilt_x": 0.0257, "tilt_y": 0.0}, "tilt x 0.026 ± 0.010 rad (1.5°)"),
    ],
)  # fmt: skip
def test_codes_are_put_into_words(cause: str, values: dict[str, float], said: str) -> None:
    assert said in described(cause, plain(cause, **values), NAMES)


def test_a_form_that_the_words_do_not_know_speaks_by_its_parameters() -> None:
    assert (
        described("cable_spring", plain("cable_spring", stiffness=0.5), NAMES)
        == "stiffness 0.50 ± 0.01 Nm/rad"
    )


def test_joints_are_called_by_name() -> None:
    assert named("sweep joint 7, then joint 2", NAMES) == "sweep joint A6, then joint A2"
    assert one_joint(2, ("joint_1", "joint_2")) == "joint_2"
