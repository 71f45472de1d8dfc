"""Changes of drives that leave no residual, told against the healthy arm."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.signal import lfilter

from ident.diagnosis import Diagnosis, Reference, commission, diagnose
from ident.diagnosis.healthy.day_spread import habit
from ident.diagnosis.healthy.reference import INERTIA_BY_PHASE
from ident.diagnosis.outcome.result import Unexplained
from ident.diagnosis.verdict import wear as of_wear
from ident.dynamics.kinematics import Chain
from lwr_driver.session import Session
from tests.ident.diagnosis.changes import Make, Signals, pair

pytestmark = pytest.mark.slow


def friction(share: float, joint: int = 1) -> Callable[[Signals], None]:
    """More friction in the motor torque of a joint of the known arm."""

    def change(s: Signals) -> None:
        v = s["qd"][:, joint]
        s["motor"][:, joint] += share * (0.6 * np.sign(v) + 0.8 * v)

    return change


@pytest.fixture(scope="module")
def of_worn_arm(make: Make, chain: Chain, reference: Reference) -> Diagnosis:
    return diagnose(pair(make, friction(1.0)), chain, reference=reference)


def worn(found: Diagnosis) -> dict[tuple[int, ...], dict[str, float]]:
    return {
        f.joints: {name: v.value for name, v in f.parameters.items()}
        for f in found.findings
        if f.cause == "wear"
    }


def test_more_friction_is_wear_of_that_joint_with_its_size(
    reference: Reference, of_worn_arm: Diagnosis
) -> None:
    model = reference.model
    healthy = model.value("Fcm2"), model.value("Fvm2")
    added = 0.6, 0.8
    found = of_worn_arm
    sizes = worn(found)[2,]
    (finding,) = [f for f in found.findings if f.cause == "wear"]
    for name, was, more in zip(("coulomb", "viscous"), healthy, added, strict=True):
        value = finding.parameters[name]
        assert sizes[name] == pytest.approx(more / was, abs=3.0 * value.std)
    assert finding.evidence.test_rms_before > 1.5 * finding.evidence.test_rms_after
    assert "wear" in str(found)


def test_a_healthy_day_and_an_arm_without_reference_show_no_wear(
    make: Make, chain: Chain, reference: Reference
) -> None:
    healthy, alone = (
        diagnose(pair(make, seed=31), chain, reference=reference),
        diagnose(pair(make, friction(1.0)), chain),
    )
    assert not worn(healthy)
    assert not worn(alone)
    (told,) = [note for note in healthy.notes if "wear of a drive would show" in note]
    for label in ("inertia", "viscous friction", "Coulomb friction"):
        (percent,) = re.findall(rf"{label} ([0-9.]+) %", told)
        assert 3.0 <= float(percent) < 60.0
    assert not any("wear of a drive would show" in note for note in alone.notes)


def test_a_usual_gain_of_a_sensor_is_no_wear_of_its_drive(
    make: Make, chain: Chain, reference: Reference
) -> None:
    """Of a joint that holds much weight a per cent of the sensor is more torque than its inertia."""
    share = 2.5 * reference.gain_std

    def scaled(s: Signals) -> None:
        s["joint"][:, 1] *= 1.0 + share

    assert not worn(diagnose(pair(make, scaled), chain, reference=reference))


def test_a_law_that_shares_the_friction_with_the_healthy_one_is_no_wear_beside_itself(
    make: Make, chain: Chain, reference: Reference
) -> None:
    def swell(s: Signals) -> None:
        v = s["qd"][:, 1]
        s["motor"][:, 1] += 1.5 * np.sign(v) * np.abs(v) ** 0.4 - 0.8 * v

    found = diagnose(pair(make, swell), chain, reference=reference)
    assert [f.joints for f in found.findings] == [(2,)]
    assert not worn(found)


def test_a_torque_of_no_name_bends_the_parameters_and_is_no_wear(
    make: Make, chain: Chain, reference: Reference
) -> None:
    def lagging(s: Signals) -> None:
        step = float(np.median(np.diff(s["time"])))
        s["motor"][:, 1] += 3.0 * lfilter([step / 0.1], [1.0, step / 0.1 - 1.0], s["qd"][:, 1])

    found = diagnose(pair(make, lagging), chain, reference=reference)
    assert not worn(found)
    assert any((u.side, u.joint) == ("motor", 2) for u in (*found.nameless, *found.unexplained))


@pytest.mark.parametrize(("side", "joint", "left"), [("motor", 2, 7.0), ("joint", 2, 7.0), ("joint", 1, 0.0)])
def test_what_the_sensor_of_a_joint_shows_beyond_a_name_bends_its_drive_too(
    monkeypatch: pytest.MonkeyPatch, side: str, joint: int, left: float
) -> None:
    rest = SimpleNamespace(side=side, joint=joint, gain=7.0)
    monkeypatch.setattr(of_wear, "find_remainders", lambda *_: [rest])
    bench: Any = SimpleNamespace(
        evidence=SimpleNamespace(replace=lambda _: None, settings=None), dictionary=None
    )
    reference: Any = SimpleNamespace(limits=dict)
    assert of_wear._left(bench, reference, [], [rest], 1) == left  # type: ignore[list-item]


def test_an_error_far_beyond_that_of_the_healthy_days_is_unexplained_though_no_variable_explains_it(
    make: Make, chain: Chain, reference: Reference
) -> None:
    calm = {side: values.copy() for side, values in reference.left.items()}
    calm["motor"][1] /= 5.0
    found = diagnose(pair(make, seed=31), chain, reference=replace(reference, left=calm))
    assert not found.findings
    assert [(u.side, u.joint, u.depends_on) for u in found.unexplained] == [("motor", 2, ())]
    assert all(
        u.test_rms > u.noise_floor for u in found.unexplained
    )  # the limit is what the error is held against
    assert "far beyond that of the healthy days" in str(found)
    assert "no single variable" in str(found)
    assert not diagnose(pair(make, seed=31), chain, reference=reference).unexplained


def test_an_error_within_the_noise_is_not_unexplained() -> None:
    assert not Unexplained("motor", 2, ("speed",), 0.3, 0.31).beyond_noise
    assert Unexplained("motor", 2, ("speed",), 0.32, 0.31).beyond_noise
    assert Unexplained(
        "motor", 2, ("speed",), float("nan"), 0.31
    ).beyond_noise  # no held-out row tells otherwise


def test_wear_is_no_part_of_the_extension(of_worn_arm: Diagnosis) -> None:
    found = of_worn_arm
    assert not any(name.startswith("wear") for name in found.extension)
    assert all(entry["cause"] != "wear" for entry in found.extended_model.effects)


def test_an_arm_that_changes_from_day_to_day_has_to_change_more_to_be_worn(make: Make, chain: Chain) -> None:
    restless = commission(
        [
            [
                make("a.mcap", 11 + 10 * k, friction(share, 0)),
                make("b.mcap", 12 + 10 * k, friction(share, 0), 1),
            ]
            for k, share in enumerate((-0.8, 0.8))
        ],
        chain,
    )
    assert not worn(diagnose(pair(make, friction(0.5)), chain, reference=restless))


def test_habit_of_a_calm_arm_is_less_than_usual_and_of_a_restless_one_more() -> None:
    names = tuple(f"Fcm{k}" for k in range(1, 8))
    tiny = np.eye(7) * 1e-8
    calm = habit(names, [np.ones(7), np.ones(7)], [tiny, tiny], {})
    rng = np.random.default_rng(0)
    days = [1.0 + 0.2 * rng.normal(size=7) for _ in range(2)]
    restless = habit(names, days, [tiny, tiny], {})
    single = habit(names, [np.ones(7)], [tiny], {})
    assert np.all(calm < 0.3 * single)
    assert np.all(restless > 4.0 * single)


def test_habit_of_an_offset_is_measured_by_the_torque_of_its_rows() -> None:
    names = ("offm1", "offl1")
    rms = {"motor": np.array([10.0]), "joint": np.array([20.0])}
    found = habit(names, [np.zeros(2)], [np.eye(2) * 1e-8], rms)
    assert np.sqrt(found) == pytest.approx([0.1, 0.2])
    alone = habit(names[1:], [np.zeros(1)], [np.eye(1) * 1e-8], {"motor": rms["motor"]})
    assert np.sqrt(alone) == pytest.approx([0.1])


def test_zeros_of_sensors_may_scatter_with_their_ranges() -> None:
    names = tuple(f"offl{k}" for k in range(1, 7))
    ranges, rms = np.array([150.0, 150.0, 150.0, 28.0, 28.0, 28.0]), {"joint": np.full(6, 2.0)}
    rng = np.random.default_rng(0)
    days = [rng.uniform(-0.004, 0.004, 6) * ranges for _ in range(2)]
    own = [np.eye(6) * 1e-8] * 2
    found = np.sqrt(habit(names, days, own, rms, ranges)) / ranges
    assert np.all((found > 0.5 * 0.0023) & (found < 2.5 * 0.0023))
    calm = [np.zeros(6), 1e-3 * rng.normal(size=6)]
    assert habit(names, calm, own, rms, ranges) == pytest.approx(habit(names, calm, own, rms), rel=0.02)


def test_parameters_bent_by_each_motion_scatter_with_their_uncertainty() -> None:
    """First moments near zero: no share of their value tells how far an incomplete model moves them."""
    names = tuple(f"MX{k}" for k in range(2, 8))
    own = 1e-3
    rng = np.random.default_rng(1)
    steady, bent = (
        [sigma * rng.normal(size=6) + np.array([0.0, 0.01, 0.0, -0.01, 0.02, 0.0]) for _ in range(3)]
        for sigma in (own, 6.0 * own)
    )
    covariances = [np.eye(6) * own**2] * 3
    assert np.all(np.sqrt(habit(names, steady, covariances, {})) < own)
    found = np.sqrt(habit(names, bent, covariances, {}))
    assert np.all((found > 2.0 * own) & (found < 12.0 * own))


def test_slow_motor_samples_leave_a_drive_inertia_uncertain_by_their_phase(
    make: Make, chain: Chain, reference: Reference
) -> None:
    def heavier(s: Signals) -> None:
        inertia = reference.model.value("Ia2")
        s["motor"][:, 1] += 0.4 * inertia * np.gradient(s["qd"][:, 1], s["time"])

    def slow(session: Session) -> Session:
        assert session.motor is not None
        fields = ("log_time", "publish_time", "sequence", "position", "velocity", "effort")
        kept = {name: getattr(session.motor, name)[::3] for name in fields}
        return replace(session, motor=replace(session.motor, **kept))

    fast = pair(make, heavier)
    std = []
    for sessions in (fast, [slow(s) for s in fast]):
        found = diagnose(sessions, chain, reference=reference)
        (finding,) = [f for f in found.findings if f.cause == "wear" and f.joints == (2,)]
        inertia = finding.parameters["inertia"]
        assert inertia.value == pytest.approx(0.4, abs=4.0 * inertia.std)
        std.append(inertia.std)
    assert std[1] ** 2 > std[0] ** 2 + 0.9 * INERTIA_BY_PHASE**2 / 3.0


def test_another_inertia_is_sure_only_behind_a_known_stiffness(
    make: Make, chain: Chain, reference: Reference
) -> None:
    """A wrong stiffness looks like inertia, and differs in that with the motion."""

    def heavier(s: Signals) -> None:
        inertia = reference.model.value("Ia2")
        s["motor"][:, 1] += 0.4 * inertia * np.gradient(s["qd"][:, 1], s["time"])

    sessions, bends = pair(make, heavier), np.full(3, 1e-6)
    confidence = []
    for share in (0.01, 0.5):
        elastic = replace(reference, compliance=bends, compliance_std=share * bends)
        found = diagnose(sessions, chain, reference=elastic)
        (finding,) = [f for f in found.findings if f.cause == "wear" and f.joints == (2,)]
        confidence.append(finding.confidence)
    known, unknown = confidence
    assert unknown <= 0.75 < known


def test_behind_published_motors_the_stiffness_of_all_joints_counts() -> None:
    def stiff(encoder: Any, joint: int, *std: float) -> bool:
        arm: Any = SimpleNamespace(encoder=encoder, compliance=np.full(3, 1e-4), compliance_std=np.array(std))
        return of_wear._stiff(arm, joint)

    assert stiff("motor", 0, 1e-6, 1e-6, 1e-6)
    assert not stiff("motor", 0, 1e-6, 5e-5, 1e-6)
    assert stiff("link", 0, 1e-6, 5e-5, 1e-6)
    assert not stiff("link", 1, 1e-6, 5e-5, 1e-6)


def test_a_gain_beyond_the_usual_is_told_with_its_own_size(
    make: Make, chain: Chain, reference: Reference
) -> None:
    # Half of it would be a usual gain of another day.
    true = 5.5 * reference.gain_std

    def scaled(s: Signals) -> None:
        s["joint"][:, 1] *= 1.0 + true

    found = diagnose(pair(make, scaled), chain, reference=reference)
    (finding,) = [f for f in found.findings if f.cause == "sensor_gain"]
    assert finding.joints == (2,)
    error = finding.parameters["error"]
    # That of other days is in its interval.
    assert reference.gain_std < error.std < 0.3 * true
    assert error.value == pytest.approx(true, abs=3.0 * error.std)


def bent(share: float) -> Callable[[Signals], None]:
    """A further law in the friction of joint 2, all of which is larger by a share."""

    def change(s: Signals) -> None:
        v = s["qd"][:, 1]
        law = 1.5 * np.sign(v) * np.abs(v) ** 0.4
        s["motor"][:, 1] += law + share * (1.5 * np.sign(v) + 2.5 * v + law)

    return change


def test_wear_of_a_drive_with_a_law_of_its_own_is_a_share_of_its_whole_friction(
    make: Make, chain: Chain
) -> None:
    """Coulomb and viscous friction and the law are hardly independent; only their sum is known."""
    healthy = commission([pair(make, bent(0.0), seed=11), pair(make, bent(0.0), seed=21)], chain)
    assert ("viscous_nonlinear", [2]) in [(e["cause"], e["joints"]) for e in healthy.model.effects]
    sessions = pair(make, bent(0.5), seed=31)
    found = diagnose(sessions, chain, reference=healthy)
    (finding,) = found.findings
    assert (finding.cause, finding.joints) == ("wear", (2,))
    for name in ("coulomb", "viscous"):
        assert finding.parameters[name].value == pytest.approx(0.5, abs=0.1)
    speed = np.concatenate([np.gradient(s.joint.position[:, 1], 1e-9 * s.joint.log_time) for s in sessions])
    law = np.sign(speed) * (1.5 + 2.5 * np.abs(speed) + 1.5 * np.abs(speed) ** 0.4)
    assert finding.evidence.test_rms_before == pytest.approx(0.5 * np.sqrt(np.mean(law**2)), rel=0.25)


def test_a_habit_of_friction_is_a_share_of_the_whole_law() -> None:
    """A viscous part near zero beside a law of the speed changes as much as the two together."""
    names, tiny = ("Fvm1", "Fvm2"), np.eye(2) * 1e-8
    days = [np.array([0.1, 8.0]), np.array([-0.9, 8.8])]
    whole = habit(names, days, [tiny, tiny], {}, sizes=np.array([10.0, 8.4]))
    assert np.all(np.sqrt(whole) < 0.1 * np.array([10.0, 8.4]))
    assert np.sqrt(whole[0]) > 0.5
    # Of its own size it would make the other joint's as uncertain as a whole.
    assert np.sqrt(habit(names, days, [tiny, tiny], {})[1]) > 0.5 * 8.4
