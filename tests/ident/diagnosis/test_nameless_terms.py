"""Torques without a name: fitted by the variables they depend on, written and read like any effect."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from fri.errors import ConfigurationError
from ident.diagnosis import Diagnosis, DiagnosisSettings, diagnose
from ident.diagnosis.causes.probes import find_remainders
from ident.diagnosis.outcome.signatures import signature_bench
from ident.dynamics.kinematics import Chain
from ident.effects import NAMELESS, check_entry
from ident.effects.nameless import KNOTS
from ident.model import read_model, write_model
from lwr_driver.session import Session

Make = Callable[..., Session]
Signals = dict[str, np.ndarray]


def drag_by_neighbour(s: Signals) -> None:
    """Friction of joint 2 by the speed of joint 3: in no catalogue."""
    s["motor"][:, 1] += 0.5 * np.abs(s["qd"][:, 2]) * np.tanh(5.0 * s["qd"][:, 2] ** 2)


@pytest.fixture(scope="module")
def make(make_250_hz: Make) -> Make:
    """What is looked for here is small."""
    return make_250_hz


@pytest.fixture(scope="module")
def found(make: Make, chain: Chain) -> Diagnosis:
    fitted = [make("a.mcap", 1, drag_by_neighbour), make("b.mcap", 2, drag_by_neighbour, 1)]
    return diagnose(fitted, chain, test=[make("c.mcap", 5, drag_by_neighbour, 2)])


def test_what_has_no_name_becomes_a_term_with_its_variables(found: Diagnosis) -> None:
    assert not any(f.confidence >= 0.8 for f in found.claims)
    (term,) = found.nameless
    assert (term.side, term.joint) == ("motor", 2)
    assert "qd3" in term.depends_on
    assert term.test_rms_after < 0.6 * term.test_rms_before
    assert term.interval[0] > 0.0
    assert found.to_dict()["nameless"][0]["depends_on"] == list(term.depends_on)


def test_the_extended_model_has_the_term_after_its_file_is_read_again(
    found: Diagnosis, make: Make, tmp_path: Path
) -> None:
    write_model(found.extended_model, tmp_path / "extended.yaml")
    model = read_model(tmp_path / "extended.yaml")
    session = make("d.mcap", 6, drag_by_neighbour, 3)
    q, rate = session.joint.position, 250.0
    qd, qdd = np.gradient(q, 1.0 / rate, axis=0), np.gradient(np.gradient(q, axis=0), axis=0) * rate**2
    assert session.motor is not None
    errors = {
        name: np.std((session.motor.effort - m.torque(q, qd, qdd, side="motor"))[100:-100, 1])
        for name, m in (("base", found.base_model), ("extended", model))
    }
    assert errors["extended"] < 0.6 * errors["base"]
    own = model.effects[len(found.base_model.effects) :]
    # A variable with several factors is one term.
    variables = dict.fromkeys(entry["form"].split()[0] for entry in own)
    assert found.extension == tuple(f"nameless_motor(2: {variable})" for variable in variables)
    assert "nameless_motor(2: qd3)" in found.extension


def test_friction_by_the_speed_of_a_neighbour_is_one_term(make: Make, chain: Chain) -> None:
    def stiffer(s: Signals) -> None:
        s["motor"][:, 1] += 0.3 * np.abs(s["qd"][:, 2]) * np.sign(s["qd"][:, 1])

    fitted = [make("a.mcap", 1, stiffer), make("b.mcap", 2, stiffer, 1)]
    found = diagnose(fitted, chain, test=[make("c.mcap", 5, stiffer, 2)])
    assert any(one.depends_on[:2] == ("qd3", "sign(qd2)") for one in found.nameless)
    assert not any(f.confidence >= 0.8 for f in found.claims)


def test_a_large_function_of_another_joint_is_held_against_its_kind_on_the_healthy_arm(
    make: Make, chain: Chain
) -> None:
    dictionary = signature_bench([make("a.mcap", 1, drag_by_neighbour)], chain).dictionary
    any_kind = {("nameless_motor", 1): 1e6}

    def remainders(limits: dict[str, float]) -> list[tuple[str, int]]:
        null = any_kind | {(f"nameless_motor {kind}", 1): limit for kind, limit in limits.items()}
        found = find_remainders(dictionary, DiagnosisSettings(), null)
        return [(one.side, one.joint) for one in found if "qd3" in one.depends_on]

    assert ("motor", 2) not in remainders({})
    assert ("motor", 2) in remainders({"qd": 5.0})
    assert ("motor", 2) not in remainders({"q": 5.0, "q sign(qd)": 5.0})


def _entry(form: str) -> dict[str, object]:
    values = {f"value_{k + 1}": {"value": 0.0, "std": 0.0, "unit": "Nm"} for k in range(KNOTS)}
    return {
        "cause": NAMELESS["motor"].cause,
        "joints": [1],
        "form": form,
        "parameters": {**values, "low": {"value": -1.0}, "high": {"value": 1.0}},
    }


def test_a_term_of_unknown_variables_is_refused() -> None:
    check_entry(_entry("q2 sign(qd1)"), 3)
    with pytest.raises(ConfigurationError, match="give a variable such as"):
        check_entry(_entry("temperature"), 3)


def test_a_term_acts_in_a_simulated_arm_as_in_the_model(chain: Chain) -> None:
    effect = NAMELESS["motor"]
    parameters = {f"value_{k + 1}": float(k) for k in range(KNOTS)} | {"low": 0.0, "high": 6.0}
    run = effect.simulate(0, parameters, "q2")

    class Plant:
        cycle_s = 1e-3
        position = np.array([0.0, 2.5, 0.0])
        motor_velocity = np.zeros(3)
        joint_torque = np.zeros(3)

    class Loads:
        motor_torque = np.zeros(3)

    run.start(3, np.random.default_rng(0))
    loads = Loads()
    run.load(0.0, Plant(), loads)  # type: ignore[arg-type]
    assert loads.motor_torque == pytest.approx([-2.5, 0.0, 0.0])
