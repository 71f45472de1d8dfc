"""Exported programs have the effects of the model that follow from the present motion, and name the others."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ident.effects import check_entry, entry_of, find_effect
from ident.formats import Program, export, standard_model, to_c, to_numpy
from ident.formats.read_back import check_c
from ident.model.dynamic_model import DynamicModel


def entry(cause: str, *joints: int, form: str | None = None, **values: float) -> dict[str, Any]:
    found = entry_of(find_effect(cause), joints, {name: (value, 0.1) for name, value in values.items()}, form)
    check_entry(found, 7)
    return found


KNOTS = {f"value_{k + 1}": float(np.sin(k)) for k in range(7)}
CARRIED = [
    entry("stribeck", 2, amplitude=1.5, velocity=0.05),
    entry("stribeck", 2, amplitude=1.5, velocity=0.5, exponent=2.0),
    entry("viscous_nonlinear", 3, coefficient=2.0, exponent=0.6),
    entry("friction_asymmetry", 1, form="viscous and Coulomb", viscous=0.5, coulomb=0.3),
    entry("friction_load", 2, 4, factor=0.1),
    entry("friction_position", 2, form="wave", cosine=0.4, sine=0.2, cycles_per_turn=2.0),
    entry("friction_position", 2, form="spot", cosine=0.4, centre=0.2, half_width=0.5),
    entry("presliding_hysteresis", 2, form="smooth in speed", amplitude=1.0, velocity=0.05),
    entry("gear_ripple", 2, cosine=0.4, sine=0.2, cycles_per_turn=2.0, gear_ratio=100.0, compliance=1e-4),
    entry("motor_torque_gain", 2, error=0.1),
    entry("motor_torque_gain", 2, form="saturating", error=0.1, cubic=0.001),
    entry("cable_spring", 4, form="hardening", stiffness=1.0, quadratic=0.2, cubic=0.3),
    entry("cable_spring", 4, form="taut below", stiffness=1.0, slack=0.1),
    entry("cable_spring", 4, form="play", stiffness=1.0, slack=0.1, play=0.2),
    entry("base_tilt", tilt_x=0.02, tilt_y=-0.01),
    entry("payload_error", mass=0.5, moment_x=0.1, moment_y=0.0, moment_z=0.02),
    entry("joint_zero_offset", 3, offset=0.01),
    entry("encoder_eccentricity", 3, cosine=0.01, sine=0.02, cycles_per_turn=1.0),
    entry("nameless_motor", 3, form="qd3 load2", low=-1.0, high=1.0, **KNOTS),
    entry("nameless_motor", 3, form="qdd3 sign(qd2)", low=-1.0, high=1.0, **KNOTS),
    entry("nameless_joint", 3, form="q3", low=-1.0, high=1.0, **KNOTS),
]
WITH_MEMORY = entry("presliding_hysteresis", 2, amplitude=1.0, length=0.05)
OF_A_SENSOR = entry("sensor_gain", 3, error=0.1)


def states() -> np.ndarray:
    found = np.random.default_rng(1).normal(size=(3, 40, 7))
    found[1, :15] *= 0.05
    return found


@pytest.mark.parametrize("effect", CARRIED, ids=lambda one: " ".join([one["cause"], one.get("form", "")]))
def test_the_program_has_the_models_torque(truth_model: DynamicModel, effect: dict[str, Any]) -> None:
    model, space = replace(truth_model, effects=(effect,)), {}
    exec(to_numpy(standard_model(model, payload="load")), space)
    bare = truth_model.torque(*states(), payload="load", side="motor")
    wanted = [model.torque(*states(), payload="load", side=side) for side in ("motor", "joint")]
    assert max(np.abs(wanted[0] - bare).max(), np.abs(wanted[1] - bare).max()) > 0.1
    np.testing.assert_allclose(space["inverse_dynamics"](*states()), wanted, atol=1e-9)


@pytest.mark.skipif(not shutil.which("cc"), reason="no C compiler")
def test_c_has_all_of_them_together(truth_model: DynamicModel) -> None:
    model = replace(truth_model, effects=tuple(CARRIED))
    assert check_c(to_c(standard_model(model)), model, None, "arm") == ""


def test_what_has_a_memory_is_named_and_the_error_of_a_sensor_is_no_torque(
    truth_model: DynamicModel, tmp_path: Path
) -> None:
    model = replace(truth_model, effects=(CARRIED[0], WITH_MEMORY, OF_A_SENSOR))
    program = Program.of(standard_model(model))
    assert program.missing == [WITH_MEMORY]
    assert program.carried == (CARRIED[0],)
    done = export(model, tmp_path / "arm.py", tmp_path / "arm.urdf")
    assert "Effects of the model missing in arm.py: presliding_hysteresis (A2)." in done.notes
    assert (
        "Effects of the model missing in arm.urdf: stribeck (A2), presliding_hysteresis (A2)." in done.notes
    )
    assert "With the model's effects: stribeck." in (tmp_path / "arm.py").read_text()


def test_a_wrong_payload_weighs_on_the_payload_alone(truth_model: DynamicModel) -> None:
    model = replace(
        truth_model, effects=(entry("payload_error", mass=0.5, moment_x=0.1, moment_y=0, moment_z=0),)
    )
    np.testing.assert_array_equal(model.torque(*states()), truth_model.torque(*states()))
    assert (
        np.abs(model.torque(*states(), payload="load") - truth_model.torque(*states(), payload="load")).max()
        > 0.1
    )


def test_errors_of_sensors_are_named_beside_the_true_torque(
    truth_model: DynamicModel, tmp_path: Path
) -> None:
    done = export(replace(truth_model, effects=(OF_A_SENSOR,)), tmp_path / "arm.py", tmp_path / "arm.c")
    for text in ((tmp_path / "arm.py").read_text(), (tmp_path / "arm.c").read_text()):
        assert "tau_joint: torque behind the gear, without the errors of the sensors" in text
        assert "sensor_gain (E1: error 0.1)" in text
        assert "measured=True" in text
    assert any("Torques in arm.py, arm.c are the true ones" in note for note in done.notes)
