"""The healthy arm of motor torques without joint torques beside them: friction at reversals, delay, wear."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from fri.errors import ConfigurationError
from ident.diagnosis import Reference, commission, diagnose
from ident.diagnosis.healthy.reference import shared
from ident.dynamics.base_set import BaseSet, numeric_base
from ident.dynamics.kinematics import Chain
from ident.dynamics.parameters import LINK_FRICTION
from ident.dynamics.structure import Condition, ModelStructure
from ident.effects import PRESLIDING, parameter_values
from ident.effects.motion import dahl
from ident.estimation.validate import validate
from ident.model import DynamicModel
from lwr_driver.session import Session

Make = Callable[..., Session]
Signals = dict[str, np.ndarray]

LENGTH, LATE_S = 4e-3, 3e-3


def turned(more: float = 0.0, longer: float = 1.0) -> Callable[[Signals], None]:
    """Friction of the drives that turns over `LENGTH`, `longer` of them in joint 2 and `more` friction there, and
    torques late by `LATE_S`."""

    def change(s: Signals) -> None:
        for j in range(3):
            along = np.ascontiguousarray(np.cumsum(s["qd"][:, j]) * (s["time"][1] - s["time"][0]))
            state = dahl(along, LENGTH * (longer if j == 1 else 1.0), float(np.sign(s["qd"][0, j])))
            s["motor"][:, j] += 1.5 * (state - np.sign(s["qd"][:, j])) + (more * state if j == 1 else 0.0)
            s["motor"][:, j] = np.interp(s["time"] - LATE_S, s["time"], s["motor"][:, j])

    return change


def alone(make: Make, seed: int, more: float = 0.0, longer: float = 1.0) -> list[Session]:
    change = turned(more, longer)
    made = [make("a.mcap", seed, change), make("b.mcap", seed + 1, change, 1)]
    return [replace(s, joint=replace(s.joint, effort=s.joint.effort[:, :0])) for s in made]


@pytest.fixture(scope="module")
def reference(make: Make, chain: Chain) -> Reference:
    return commission([alone(make, 11), alone(make, 21)], chain)


def test_the_healthy_drives_turn_over_their_path_and_are_late_by_their_delay(reference: Reference) -> None:
    assert reference.presliding is not None
    np.testing.assert_allclose(reference.presliding, LENGTH, rtol=0.2)
    assert reference.motor_delay_s == pytest.approx(LATE_S, abs=5e-4)


def test_a_drive_of_unknown_length_turns_over_that_of_the_others(
    make: Make, chain: Chain, reference: Reference
) -> None:
    assert reference.presliding is not None
    unknown = replace(reference, presliding=reference.presliding * [1.0, 0.0, 1.0])
    found = diagnose(alone(make, 31), chain, reference=unknown)
    assert not found.findings
    turning = [entry for entry in found.base_model.effects if entry["cause"] == PRESLIDING.cause]
    (own,) = (parameter_values(entry) for entry in turning if entry["joints"] == [2])
    assert own["length"] == pytest.approx(LENGTH, rel=0.2)
    assert own["amplitude"] == pytest.approx(found.base_model.drive()["Fcm"][1], rel=0.1)


def test_the_model_of_a_reference_turns_its_friction_as_the_healthy_arm(
    make: Make, reference: Reference
) -> None:
    turning = [entry for entry in reference.model.effects if entry["cause"] == PRESLIDING.cause]
    assert [entry["joints"] for entry in turning] == [[1], [2], [3]]
    (score,) = validate(reference.model, alone(make, 61)[:1], allow_seen=True).scores
    (signs,) = validate(replace(reference.model, effects=()), alone(make, 61)[:1], allow_seen=True).scores
    assert score.relative["motor"] < 0.5 * signs.relative["motor"]


def test_more_friction_is_wear_of_its_joint(make: Make, chain: Chain, reference: Reference) -> None:
    assert not diagnose(alone(make, 31), chain, reference=reference).findings
    findings = diagnose(alone(make, 41, 0.6), chain, reference=reference).findings
    (found,) = [one for one in findings if one.cause == "wear"]
    assert found.joints == (2,)
    # Friction of link and drive are one without joint torques: 0.1 and 1.5 Nm.
    share = found.parameters["coulomb"]
    assert share.value == pytest.approx(0.6 / 1.6, abs=3.0 * share.std)
    assert share.std < 0.1
    assert all(one.confidence < found.confidence for one in findings if one is not found)


@pytest.mark.parametrize("longer", [0.6, 2.2])
def test_another_length_of_these_days_is_no_finding(
    make: Make, chain: Chain, reference: Reference, longer: float
) -> None:
    found = diagnose(alone(make, 51, longer=longer), chain, reference=reference)
    assert not found.findings
    turning = [e for e in found.base_model.effects if e["cause"] == PRESLIDING.cause]
    (length,) = (parameter_values(entry)["length"] for entry in turning if entry["joints"] == [2])
    assert length == pytest.approx(LENGTH * longer, rel=0.1)


def test_a_late_channel_is_held_against_rows_away_from_reversals_where_these_tell_it(
    make: Make, chain: Chain, reference: Reference, monkeypatch: pytest.MonkeyPatch
) -> None:
    def later(s: Signals) -> None:
        turned()(s)
        for torque in s["motor"].T:
            torque[:] = np.interp(s["time"] - 0.008, s["time"], torque)

    made = [make("a.mcap", 71, later), make("b.mcap", 72, later, 1)]
    bare = [replace(s, joint=replace(s.joint, effort=s.joint.effort[:, :0])) for s in made]
    # Slow rows have reversals in them, with friction of the day that turns in another way, and so has each joint.
    module = importlib.import_module("ident.diagnosis.verdict.late_channels")
    monkeypatch.setattr(module, "slow_delay", lambda *_: (0.014, 1e-4))
    monkeypatch.setattr(module, "_late_in_all_joints", lambda *_: False)
    (found,) = diagnose(bare, chain, reference=reference).findings
    assert found.cause == "motor_torque_delay"
    assert found.parameters["delay"].value == pytest.approx(0.008, abs=3e-4)
    assert found.confidence > 0.9


def test_parameters_that_only_the_channels_left_out_tell_stay_those_of_the_healthy_arm(
    make: Make, chain: Chain, reference: Reference
) -> None:
    def interchanged(session: Session) -> Session:
        assert session.motor is not None
        return replace(session, motor=replace(session.motor, effort=session.motor.effort[:, [0, 2, 1]]))

    found = diagnose([interchanged(s) for s in alone(make, 41)], chain, reference=reference)
    assert sorted((one.channel, one.joint) for one in found.data) == [
        ("motor torque", 2),
        ("motor torque", 3),
    ]
    assert not found.findings
    assert np.all(np.isfinite(found.base_model.values))
    assert np.max(np.abs(found.base_model.values)) < 1e2


def test_friction_is_compared_with_that_of_sessions_with_the_same_torques(chain: Chain) -> None:
    both = numeric_base(ModelStructure(chain, 2), (Condition(None, ("motor", "joint")),))
    of_drives = numeric_base(ModelStructure(chain, 2, without=LINK_FRICTION), (Condition(None, ("motor",)),))
    of_links = numeric_base(ModelStructure(chain, 2), (Condition(None, ("motor",)),))

    def compared(a: BaseSet, b: BaseSet) -> set[str]:
        return {a.names[k] for k, _ in shared(a, b, {}, {})}

    assert "Fcm2" in compared(of_drives, of_drives)
    assert "Fcm2" in compared(of_drives, of_links)
    # The drive's friction alone is not that of drive and link.
    assert {name for name in compared(of_drives, both) if name.startswith("F")} == set()


def test_a_reference_with_the_friction_of_its_drives_at_the_links_is_made_anew(
    chain: Chain, reference: Reference
) -> None:
    base = numeric_base(ModelStructure(chain, 2), (Condition(None, ("motor",)),))
    values = np.ones(len(base))
    model = DynamicModel("arm", base.structure, base.names, values, None, base, reference.stored())
    with pytest.raises(ConfigurationError, match="commission the arm again"):
        Reference.of(model)


@pytest.mark.slow
def test_torques_well_before_the_positions_are_no_late_channel(
    make: Make, chain: Chain, reference: Reference
) -> None:
    def before(s: Signals) -> None:
        turned()(s)
        for torque in s["motor"].T:
            torque[:] = np.interp(s["time"] + 0.02, s["time"], torque)

    made = [make("a.mcap", 71, before), make("b.mcap", 72, before, 1)]
    bare = [replace(s, joint=replace(s.joint, effort=s.joint.effort[:, :0])) for s in made]
    assert all(one.side != "timing" for one in diagnose(bare, chain, reference=reference).findings)


@pytest.mark.slow
@pytest.mark.parametrize("cycles", [1.0, 1.5, 2.0])
def test_a_wave_of_the_angle_is_no_sure_spring(
    make: Make, chain: Chain, reference: Reference, cycles: float
) -> None:
    def waved(s: Signals) -> None:
        turned()(s)
        s["motor"][:, 0] += 3.0 * np.sin(cycles * s["q"][:, 0] + 0.7)

    made = [make("a.mcap", 81, waved), make("b.mcap", 82, waved, 1)]
    bare = [replace(s, joint=replace(s.joint, effort=s.joint.effort[:, :0])) for s in made]
    found = diagnose(bare, chain, reference=reference)
    (spring,) = [one for one in found.findings if one.cause == "cable_spring"]
    assert spring.confidence <= 0.7
    assert {term.joint for term in found.nameless} == {1}
