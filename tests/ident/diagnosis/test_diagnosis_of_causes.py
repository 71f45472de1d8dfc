from __future__ import annotations

import functools
import importlib
import json
from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace
from typing import Any, Literal

import numpy as np
import pytest

from fri.errors import DataError
from ident.diagnosis import ArmData, Diagnosis, Reference, diagnose
from ident.diagnosis.rows.recording import sensor_limits
from ident.dynamics.kinematics import Chain
from ident.dynamics.regressor import torque
from ident.model.model_file import model_text, read_model
from ident.rows.data_quality import clipped_at, stuck_at
from ident.rows.data_quality import stale as old
from lwr_driver.session import Session
from tests.ident.diagnosis.changes import Make, Signals, pair, stribeck


def load_friction(s: Signals) -> None:
    s["motor"][:, 1] += 0.03 * np.abs(s["joint"][:, 1]) * np.sign(s["qd"][:, 1])


def cable(s: Signals) -> None:
    pull = 0.1 * s["q"][:, 2] ** 3
    s["motor"][:, 2] += pull
    s["joint"][:, 2] += pull


def hose(s: Signals) -> None:
    pull = 0.3 * (s["q"][:, 1] + 0.8 * s["q"][:, 2])
    for side in ("motor", "joint"):
        s[side][:, 1] += pull
        s[side][:, 2] += 0.8 * pull


def sensor_gain(s: Signals) -> None:
    s["joint"][:, 1] *= 1.03


def rough_spot(s: Signals) -> None:
    q, qd = s["q"][:, 1], s["qd"][:, 1]
    s["motor"][:, 1] += 0.3 * np.sign(qd) * np.exp(-0.5 * ((q - 0.3) / 0.2) ** 2)


def crosstalk(s: Signals) -> None:
    s["joint"][:, 0] += 0.02 * s["joint"][:, 1]


def drift(s: Signals) -> None:
    s["joint"][:, 2] += 0.1 * (1.0 - np.exp(-s["time"] / 8.0))


def clipped(s: Signals) -> None:
    top = 0.85 * np.abs(s["joint"][:, 1]).max()
    s["joint"][:, 1] = np.clip(s["joint"][:, 1], -top, top)


def late_motor(s: Signals) -> None:
    old = s["time"] - 0.012
    s["motor"][:] = np.column_stack([np.interp(old, s["time"], c) for c in s["motor"].T])


@pytest.fixture(scope="module")
def healthy(make: Make, chain: Chain) -> Diagnosis:
    return diagnose(pair(make), chain)


@pytest.fixture(scope="module")
def diagnosed(make: Make, chain: Chain) -> Callable[[Callable[[Signals], None]], Diagnosis]:
    """The diagnosis of a pair of sessions with a change, made once for all tests of it."""
    return functools.cache(lambda change: diagnose(pair(make, change), chain))


def test_says_nothing_where_nothing_is_wrong(healthy: Diagnosis) -> None:
    assert healthy.claims == ()
    assert healthy.unexplained == ()
    assert "No model error is detectable" in str(healthy)


def test_base_model_alone_leaves_only_noise(healthy: Diagnosis) -> None:
    for side, values in healthy.rms_base.items():
        np.testing.assert_allclose(values, healthy.noise_floor[side], rtol=0.12)


@pytest.mark.parametrize(
    ("change", "cause", "joints", "parameter", "value"),
    [
        (stribeck, "stribeck", (2,), "amplitude", 0.3),
        (load_friction, "friction_load", (2,), "factor", 0.03),
        (rough_spot, "friction_position", (2,), "centre", 0.3),
        (cable, "cable_spring", (3,), "stiffness", 0.1),
        (hose, "cable_spring", (2,), "ratio", 0.8),
        (sensor_gain, "sensor_gain", (2,), "error", 0.03),
        (crosstalk, "sensor_crosstalk", (1,), "factor", 0.02),
        (drift, "sensor_offset_drift", (3,), "drift", 0.1),
        pytest.param(clipped, "sensor_saturation", (2,), "limit", None, marks=pytest.mark.long),
        (late_motor, "motor_torque_delay", (), "delay", 0.012),
    ],
)
def test_names_cause_and_joint_first(
    diagnosed: Callable[[Callable[[Signals], None]], Diagnosis],
    change: Callable[[Signals], None],
    cause: str,
    joints: tuple[int, ...],
    parameter: str,
    value: float | None,
) -> None:
    found = diagnosed(change)
    first = found.claims[0]
    assert (first.cause, first.joints) == (cause, joints)
    assert first.evidence.p_value < 1e-5
    assert first.evidence.gain_interval_95[1] > 0.0
    if value is not None:
        estimate = first.parameters[parameter]
        assert abs(estimate.value - value) < 4.0 * estimate.std + 0.05 * abs(value)
    content = json.loads(json.dumps(found.to_dict(), allow_nan=False))
    assert [*content["findings"], *content["character"]][0]["cause"] == cause


def test_speed_and_exponent_are_sought_together(make: Make, chain: Chain) -> None:
    """They make up for each other: one after the other ends beside the best fit, with deviations that do not cover."""

    def gaussian(s: Signals) -> None:
        v = s["qd"][:, 1]
        s["motor"][:, 1] += 0.5 * np.sign(v) * np.exp(-((np.abs(v) / 0.2) ** 1.5))

    (found,) = diagnose(pair(make, gaussian), chain, causes=["stribeck"]).claims
    for name, true in (("amplitude", 0.5), ("velocity", 0.2), ("exponent", 1.5)):
        value = found.parameters[name]
        assert abs(value.value - true) < 2.5 * value.std, name
        assert value.std < 0.3 * true, name


def test_extended_model_is_an_ordinary_model(
    diagnosed: Callable[[Callable[[Signals], None]], Diagnosis],
) -> None:
    found = diagnosed(stribeck)
    again = read_model(_loaded(model_text(found.extended_model)))
    assert [e["cause"] for e in again.effects] == ["stribeck"]
    q = np.array([[0.1, 0.2, 0.3]])
    slow, fast = np.full((1, 3), 0.01), np.full((1, 3), 1.0)
    for speed, share in ((slow, np.exp(-0.01 / 0.15)), (fast, np.exp(-1.0 / 0.15))):
        zero = np.zeros((1, 3))
        extra = again.torque(q, speed, zero, side="motor") - again.linear_torque(q, speed, zero, side="motor")
        assert extra[0, 1] == pytest.approx(0.3 * share, abs=0.08)
        assert extra[0, 0] == 0.0


def test_gain_is_measured_on_sessions_never_fitted(make: Make, chain: Chain) -> None:
    test = [make("c.mcap", 9, load_friction, 2)]
    found = diagnose(pair(make, load_friction), chain, test=test)
    assert found.test == ("c.mcap",)
    assert found.train == ("a.mcap", "b.mcap")
    assert found.rms_extended["motor"][1] < 0.97 * found.rms_base["motor"][1]


@pytest.mark.slow
def test_constant_payload_error_needs_the_reference(
    make: Make, chain: Chain, bodies: np.ndarray, reference: Reference
) -> None:
    from ident.dynamics.regressor import torque

    def heavier(s: Signals) -> None:
        extra = np.zeros((3, 10))
        extra[2, 9], extra[2, 6] = 0.2, 0.04
        qdd = np.gradient(s["qd"], s["time"], axis=0)
        add = torque(chain, s["q"], s["qd"], qdd, extra)
        s["joint"] += add
        s["motor"] += add

    sessions = pair(make, heavier, seed=5)
    alone = diagnose(sessions, chain)
    assert alone.claims == ()
    assert any("no reference" in note for note in alone.notes)
    found = diagnose(sessions, chain, reference=reference)
    assert found.claims[0].cause == "payload_error"


def test_reference_alone_claims_nothing(make: Make, chain: Chain, reference: Reference) -> None:
    assert diagnose(pair(make, seed=5), chain, reference=reference).claims == ()


@pytest.mark.slow
def test_what_shows_faintly_is_unsure_and_named_only_where_held_out_sessions_bear_it_out(
    make: Make, chain: Chain, reference: Reference
) -> None:
    def faint(s: Signals) -> None:
        v = s["qd"][:, 1]
        s["motor"][:, 1] += 0.11 * np.sign(v) * np.exp(-np.abs(v) / 0.15)

    fitted, held = pair(make, faint, seed=5), [make(f"{k}.mcap", k, faint, k) for k in (10, 11, 12)]
    (found,) = diagnose(fitted, chain, test=held, reference=reference).claims
    assert (found.cause, found.joints) == ("stribeck", (2,))
    assert found.confidence <= 0.7
    without_it = [make(f"{k}.mcap", k, None, k) for k in (10, 11, 12)]
    assert diagnose(fitted, chain, test=without_it, reference=reference).claims == ()


@pytest.mark.slow
def test_reference_knows_how_late_a_channel_is(make: Make, chain: Chain, reference: Reference) -> None:
    def late(s: Signals) -> None:
        s["joint"][:] = np.column_stack([np.interp(s["time"] - 0.0013, s["time"], c) for c in s["joint"].T])

    sessions = pair(make, late, seed=5)
    (found,) = diagnose(sessions, chain, reference=reference).claims
    assert found.cause == "joint_torque_delay"
    assert found.parameters["delay"].value == pytest.approx(0.0013, abs=3e-4)
    assert diagnose(sessions, chain).claims == ()


def test_a_delay_that_slow_rows_contradict_is_known_no_better_than_their_difference(
    make: Make,
    chain: Chain,
    diagnosed: Callable[[Callable[[Signals], None]], Diagnosis],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    (plain,) = diagnosed(late_motor).claims
    module = importlib.import_module("ident.diagnosis.verdict.late_channels")
    monkeypatch.setattr(module, "slow_delay", lambda *_: (0.0135, 1e-4))
    (late,) = diagnose(pair(make, late_motor), chain).claims
    assert plain.parameters["delay"].std < 5e-4
    assert late.parameters["delay"].value == plain.parameters["delay"].value
    assert late.parameters["delay"].std == pytest.approx(0.0015, abs=2e-4)
    assert late.evidence.p_value == plain.evidence.p_value


def test_a_late_channel_hardly_believed_is_a_doubted_name_beside_its_note(
    make: Make, chain: Chain, monkeypatch: pytest.MonkeyPatch
) -> None:
    module = importlib.import_module("ident.diagnosis.verdict.late_channels")
    monkeypatch.setattr(module, "believable", lambda _: False)
    found = diagnose(pair(make, late_motor), chain)
    assert found.claims == ()
    assert [one.cause for one in found.doubted] == ["motor_torque_delay"]
    assert any("the evidence is too small for a finding" in note for note in found.notes)


def test_gain_of_a_late_channel_counts_from_before_it_was_put_in_time(make: Make, chain: Chain) -> None:
    first, second = pair(make, late_motor)
    found = diagnose([first], chain, test=[second])
    (late,) = found.claims
    base, extended = found.rms_base["motor"], found.rms_extended["motor"]
    assert base[0] > 2.0 * extended[0]
    assert late.evidence.test_rms_before > 2.0 * late.evidence.test_rms_after
    # The drives' inertia had absorbed a part of it.
    assert found.changes
    assert np.any(found.base_model.values != found.extended_model.values)


def test_without_a_reference_the_tick_of_another_clock_is_no_delay(make: Make, chain: Chain) -> None:
    sessions = []
    for session in pair(make, late_motor):
        motor = session.motor
        assert motor is not None
        columns = ("log_time", "publish_time", "position", "velocity", "effort")
        thin = {name: getattr(motor, name)[::3] for name in columns}
        thin["sequence"] = motor.sequence[: len(thin["effort"])]
        sessions.append(replace(session, motor=replace(motor, **thin)))
    found = diagnose(sessions, chain)
    assert found.claims == ()
    assert any("motor torques come" in note and "without a reference" in note for note in found.notes)


def test_without_a_reference_the_wait_for_the_next_packet_is_no_delay(make: Make, chain: Chain) -> None:
    def waiting(s: Signals) -> None:
        old = s["time"] - 0.006
        s["motor"][:] = np.column_stack([np.interp(old, s["time"], c) for c in s["motor"].T])

    found = diagnose(pair(make, waiting), chain)
    assert found.claims == ()
    assert any("motor torques come" in note and "a delay below 8 ms" in note for note in found.notes)


@pytest.mark.parametrize("encoder", ["link", "motor"])
def test_a_gap_that_is_never_crossed_may_be_a_zero_that_is_off(
    make: Make, chain: Chain, bodies: np.ndarray, reference: Reference, encoder: Literal["link", "motor"]
) -> None:
    def turned(s: Signals) -> None:
        # A smaller motion, in which the second link never stands upright; its drive has 0.4 kg m^2 and 2.5 Nm s/rad.
        small = np.array([1.0, 0.3, 1.0])
        q, qd = s["q"], s["qd"]
        qdd = np.gradient(qd, s["time"], axis=0)
        change = torque(chain, small * q, small * qd, small * qdd, bodies) - torque(chain, q, qd, qdd, bodies)
        s["joint"] += change
        s["motor"] += change
        s["motor"][:, 1] -= 0.7 * (0.4 * qdd[:, 1] + 2.5 * qd[:, 1])
        q *= small
        qd *= small
        s["q"][:, 1] += 0.02

    sessions = pair(make, turned)
    loads = np.concatenate([session.joint.effort[:, 1] for session in sessions])
    assert np.all(loads > 0.0)
    (found,) = diagnose(sessions, chain, reference=replace(reference, encoder=encoder)).claims
    assert (found.cause, found.joints) == ("joint_zero_offset", (2,))
    rivals = [(cause, joints) for cause, joints, _ in found.alternatives]
    if encoder == "link":
        assert found.confidence > 0.8
        assert ("backlash", (2,)) not in rivals
    else:
        assert found.confidence < 0.8
        assert rivals == [("backlash", (2,))]


def test_zero_of_each_session_is_no_function_of_the_angle(
    make: Make, chain: Chain, reference: Reference
) -> None:
    def low(s: Signals) -> None:
        s["joint"][:, 1] -= 0.12

    def high(s: Signals) -> None:
        s["joint"][:, 1] += 0.05

    sessions = [make("a.mcap", 5, low), make("b.mcap", 6, high, 1)]
    (found,) = diagnose(sessions, chain, reference=reference).claims
    assert (found.cause, found.joints, found.mode) == ("sensor_offset_drift", (2,), "between")
    assert found.parameters["drift"].value == pytest.approx(0.17, abs=0.02)
    assert found.parameters["zero"].value == pytest.approx(-0.12, abs=0.02)


def test_zero_that_drifts_steadily_is_told_by_its_rate(
    make: Make, chain: Chain, reference: Reference
) -> None:
    def creeps(s: Signals) -> None:
        s["joint"][:, 1] += 0.6 * s["time"] / 60.0

    (found,) = diagnose(pair(make, creeps, seed=5), chain, reference=reference).claims
    assert (found.cause, found.joints) == ("sensor_offset_drift", (2,))
    assert found.form == "steadily within a session"
    drift = found.parameters["drift"]
    assert drift.value == pytest.approx(0.6, abs=3.0 * drift.std)
    assert drift.std < 0.06


def test_zero_that_drifts_in_one_session_alone_is_told_with_its_session(
    make: Make, chain: Chain, reference: Reference
) -> None:
    def creeps(s: Signals) -> None:
        s["joint"][:, 1] += 0.6 * s["time"] / 60.0

    sessions = [make("a.mcap", 5), make("b.mcap", 6, creeps, 1)]
    found = diagnose(sessions, chain, reference=reference)
    (claim,) = found.claims
    assert (claim.cause, claim.joints) == ("sensor_offset_drift", (2,))
    assert claim.form == "steadily within one session"
    drift = claim.parameters["drift"]
    assert drift.value == pytest.approx(0.6, abs=3.0 * drift.std)
    assert claim.parameters["session"].value == 2
    assert "in b.mcap alone" in str(found)
    # What one session has, a further one has not.
    assert not found.extended_model.effects


@pytest.mark.slow
@pytest.mark.parametrize("undone", [False, True])
def test_zero_that_jumps_within_a_session_is_told_with_its_moment(
    make: Make, chain: Chain, reference: Reference, undone: bool
) -> None:
    def jumps(s: Signals) -> None:
        s["joint"][s["time"] >= 7.3, 1] += 0.15

    def stays(s: Signals) -> None:
        s["joint"][:, 1] += 0.0 if undone else 0.15

    sessions = [make("a.mcap", 5, jumps), make("b.mcap", 6, stays, 1)]
    found = diagnose(sessions, chain, reference=reference)
    (claim,) = found.claims
    assert (claim.cause, claim.joints, claim.mode) == ("sensor_offset_drift", (2,), "within")
    assert claim.form == f"step within a session{', undone after it' if undone else ''}"
    assert claim.parameters["drift"].value == pytest.approx(0.15, abs=0.02)
    assert claim.parameters["time"].value == pytest.approx(7.3, abs=0.3)
    assert claim.parameters["session"].value == 1
    # A moment of a session has no place in a model of the arm.
    assert not found.extended_model.effects


@pytest.mark.slow
@pytest.mark.parametrize(
    ("size", "turns", "phase", "commissioned"),
    [
        (0.12, 2.0, -0.5 * np.pi, False),
        # The base parameters share what the drive shows with the sensor's rows, and something fits it there.
        (0.15, 1.0, 0.8, True),
    ],
)
def test_unknown_physics_is_not_named_with_confidence(
    make: Make,
    chain: Chain,
    reference: Reference,
    size: float,
    turns: float,
    phase: float,
    commissioned: bool,
) -> None:
    def strange(s: Signals) -> None:
        s["motor"][:, 1] += size * np.sign(s["qd"][:, 1]) * np.cos(turns * s["q"][:, 0] + phase)

    found = diagnose(pair(make, strange), chain, reference=reference if commissioned else None)
    assert all(f.confidence < 0.8 for f in found.claims)
    assert any(
        u.joint == 2 and u.side == "motor" and "q1" in u.depends_on
        for u in (*found.nameless, *found.unexplained)
    )


@pytest.mark.slow
def test_scale_that_follows_another_angle_is_no_sure_gain(
    make: Make, chain: Chain, reference: Reference
) -> None:
    def bent(s: Signals) -> None:
        s["joint"][:, 1] *= 1.05 + 0.05 * np.sin(s["q"][:, 0] + 0.4)

    found = diagnose(pair(make, bent), chain, reference=reference)
    assert all(f.confidence < 0.8 for f in found.claims)
    rest = (*found.nameless, *found.unexplained)
    (left,) = [u for u in rest if u.joint == 2 and u.side == "joint"]
    assert {"q1", "load2"} <= set(left.depends_on)


@pytest.mark.slow
def test_a_sensor_that_reads_less_the_more_it_is_loaded_is_no_sure_gain(
    make: Make, chain: Chain, reference: Reference
) -> None:
    def bent(s: Signals) -> None:
        s["joint"][:, 1] *= 1.0 - 0.004 * np.abs(s["joint"][:, 1])

    found = diagnose(pair(make, bent), chain, reference=reference)
    assert all(f.confidence < 0.8 for f in found.claims)
    rest = (*found.nameless, *found.unexplained)
    (left,) = [u for u in rest if u.joint == 2 and u.side == "joint"]
    assert "load2" in left.depends_on


@pytest.mark.slow
def test_friction_that_follows_the_acceleration_is_not_named_with_confidence(
    make: Make, chain: Chain, reference: Reference
) -> None:
    def inertial(s: Signals) -> None:
        s["motor"][:, 1] += 0.1 * np.abs(np.gradient(s["qd"][:, 1], s["time"])) * np.sign(s["qd"][:, 1])

    found = diagnose(pair(make, inertial), chain, reference=reference)
    assert all(f.confidence < 0.8 for f in found.claims)
    assert any(
        u.joint == 2 and u.side == "motor" and "qdd2" in u.depends_on
        for u in (*found.nameless, *found.unexplained)
    )


def test_what_shakes_the_arm_is_told_with_its_frequency(
    make: Make, chain: Chain, reference: Reference
) -> None:
    def shaken(s: Signals) -> None:
        s["motor"][:, 1] += 0.08 * np.sin(2.0 * np.pi * 1.37 * s["time"] + 0.4)

    found = diagnose(pair(make, shaken), chain, reference=reference)
    assert found.claims == ()
    assert [(u.side, u.joint, u.depends_on) for u in found.unexplained] == [("motor", 2, ("time",))]
    (note,) = [note for note in found.notes if "swings" in note]
    assert "motor torque" in note
    assert float(note.partition("swings at ")[2].split()[0]) == pytest.approx(1.37, abs=0.025)


@pytest.mark.parametrize(("every", "causes"), [(200, ["lost_samples"]), (600, ["lost_samples"]), (1500, [])])
def test_samples_older_than_they_say_are_left_out(
    make: Make, chain: Chain, every: int, causes: list[str]
) -> None:
    def stale(s: Signals) -> None:
        rows = np.arange(150, len(s["time"]), every)
        for name in ("q", "joint"):
            columns = [np.interp(s["time"][rows] - 0.006, s["time"], c) for c in s[name].T]
            s[name][rows] = np.column_stack(columns)

    sessions, (healthy, _) = pair(make, stale), pair(make)
    assert not old(healthy.joint).any()
    joint = sessions[0].joint
    times = (joint.log_time[old(joint)] - joint.log_time[0]) * 1e-9
    apart = np.abs(times[:, None] - 8e-3 * np.arange(150, len(sessions[0].joint), every))
    assert apart.min(axis=0).max() < 0.01
    assert apart.min(axis=1).max() < 0.02
    found = diagnose(sessions, chain)
    assert [finding.cause for finding in found.claims] == causes
    assert found.unexplained == ()


def test_a_sensor_that_clips_for_a_moment_is_no_contact(make: Make, chain: Chain) -> None:
    """Too few blocks to be significant, and nothing that a push could do."""
    sessions = pair(make)
    limit = float(np.sort(np.concatenate([one.joint.effort[:, 1] for one in sessions]))[-60])
    clipped = [
        replace(one, joint=replace(one.joint, effort=np.minimum(one.joint.effort, [np.inf, limit, np.inf])))
        for one in sessions
    ]
    limits = [clipped_at(one.joint) for one in (*sessions, *clipped)]
    assert np.isnan(limits[0]).all()
    assert np.isnan(limits[1]).all()
    assert np.nanmax([one[1] for one in limits]) == limit
    (found,) = diagnose(clipped, chain).claims
    assert (found.cause, found.joints) == ("sensor_saturation", (2,))
    assert found.parameters["limit"].value == pytest.approx(limit, abs=1e-9)


def at_most(session: Session, limit: float) -> Session:
    effort = np.minimum(session.joint.effort, [np.inf, limit, np.inf])
    return replace(session, joint=replace(session.joint, effort=effort))


def test_a_limit_in_held_out_samples_alone_is_told(make: Make, chain: Chain) -> None:
    """No session fitted reaches it, so no fit gains by it."""
    sessions = pair(make)
    top = max(float(one.joint.effort[:, 1].max()) for one in sessions)
    further = make("c.mcap", 3)
    more = replace(further.joint, effort=further.joint.effort * [1.0, 3.0, 1.0])
    clipped = at_most(replace(further, joint=more), 1.05 * top)
    found = [f for f in diagnose(sessions, chain, test=[clipped]).findings if f.cause == "sensor_saturation"]
    assert [(f.joints, f.form, f.confidence) for f in found] == [((2,), "seen in the samples", 0.99)]
    assert found[0].parameters["limit"].value == 1.05 * top


def test_different_ends_of_the_samples_are_no_limit() -> None:
    def record(*limits: float) -> Any:
        return SimpleNamespace(has_effort=True, clipped=np.array(limits))

    none = np.nan
    limits = sensor_limits([record(none, 5.0, 5.0), record(3.0, 5.0, 8.0)], 3)
    np.testing.assert_array_equal(limits, [3.0, 5.0, none])


def test_rest_and_coarse_or_held_samples_are_no_clipping(make: Make) -> None:
    columns = make("a.mcap", 1).joint
    coarse = replace(columns, effort=np.round(columns.effort))
    assert np.isnan(clipped_at(coarse)).all()
    still, effort = columns.position.copy(), columns.effort.copy()
    top = int(np.argmax(effort[:, 1]))
    effort[top : top + 200] = effort[top]
    assert np.isnan(clipped_at(replace(columns, effort=effort))).all()
    still[top : top + 200] = still[top]
    effort[top : top + 200, 0] += np.arange(200)
    assert np.isnan(clipped_at(replace(columns, position=still, effort=effort))).all()


def test_small_motor_torques_that_are_not_reported_are_seen(make: Make, chain: Chain) -> None:
    def unreported(session: Session) -> Session:
        assert session.motor is not None
        effort = session.motor.effort.copy()
        effort[np.abs(effort[:, 1]) < 2.0, 1] = 0.0
        return replace(session, motor=replace(session.motor, effort=effort))

    healthy = pair(make)
    sessions = [unreported(session) for session in healthy]
    assert [stuck_at(one.motor, one.joint) for one in healthy if one.motor is not None] == [(), ()]
    for one in sessions:
        assert one.motor is not None
        (stuck,) = stuck_at(one.motor, one.joint)
        assert (stuck.joint, stuck.value) == (1, 0.0)
    found = diagnose(sessions, chain)
    assert found.claims == ()
    assert [(u.side, u.joint, u.depends_on) for u in found.unexplained] == [("motor", 2, ("load2",))]
    assert any("motor torque of two reads exactly 0 Nm" in note for note in found.notes)


@pytest.mark.parametrize(("times", "causes"), [((6.0,), ["contact"]), ((6.0, 16.0), [])])
def test_what_recurs_in_each_period_is_no_push(
    make: Make, chain: Chain, times: tuple[float, ...], causes: list[str]
) -> None:
    def pushed(s: Signals) -> None:
        for time in times:
            on = np.abs(s["time"] - 1.5 - time) < 0.2
            s["joint"][on, 1] += 2.0
            s["motor"][on, 1] += 2.0

    found = diagnose([make("a.mcap", 1, pushed), make("b.mcap", 2, None, 1)], chain, causes=["contact"])
    assert [f.cause for f in found.claims] == causes


@pytest.mark.parametrize(
    ("answer", "causes"), [(0.25, {"sensor_ripple"}), (1.0, {"sensor_ripple", "gear_ripple"})]
)
def test_a_controller_that_answers_to_ripple_is_no_second_cause(
    make: Make, chain: Chain, answer: float, causes: set[str]
) -> None:
    def rippled(s: Signals) -> None:
        ripple = 0.2 * np.cos(40.0 * s["q"][:, 1])
        s["joint"][:, 1] += ripple
        s["motor"][:, 1] += answer * ripple

    known = ArmData(gear_ratio=np.full(3, 40.0))
    found = diagnose(pair(make, rippled), chain, arm=known, causes=["sensor_ripple", "gear_ripple"])
    assert {f.cause for f in found.claims} == causes


def test_held_samples_are_seen(make: Make, chain: Chain) -> None:
    sessions = pair(make)
    effort = sessions[0].joint.effort.copy()
    rows = np.arange(50, len(effort), 40)
    effort[rows] = effort[rows - 1]
    sessions[0] = replace(sessions[0], joint=replace(sessions[0].joint, effort=effort))
    found = diagnose(sessions, chain)
    lost = [f for f in found.claims if f.cause == "lost_samples"]
    assert lost
    assert lost[0].parameters["share"].value == pytest.approx(len(rows) / len(effort), rel=0.05)
    # The mode is `within` or `between`, no prose.
    assert "mode" not in lost[0].to_dict()
    assert lost[0].detail is not None
    assert lost[0].detail in " ".join(str(lost[0]).split())


def test_one_session_without_motor_channel(make: Make, chain: Chain) -> None:
    found = diagnose([replace(make("a.mcap", 1), motor=None)], chain)
    assert found.claims == ()
    assert found.model_number == 1
    assert any("no motor torque" in note for note in found.notes)
    assert any(note.startswith("one session: changes from session to session") for note in found.notes)
    assert not any("usable" in note for note in found.notes)
    assert found.to_dict()["baseline"]["test_rms"]["motor"] is None


def test_what_no_row_shows_is_told(make: Make, chain: Chain) -> None:
    alone = [replace(s, joint=replace(s.joint, effort=s.joint.effort[:, :0])) for s in pair(make)]
    found = diagnose(alone, chain, causes=["stribeck"])
    assert any(note.startswith("no joint torque: ") for note in found.notes)
    assert not any(note.startswith("one session") for note in found.notes)
    found = diagnose(pair(make), chain, test=[replace(make("c.mcap", 9), motor=None)], causes=["stribeck"])
    assert np.isnan(found.rms_base["motor"]).all()
    assert any("no row of the motor torque is usable in the held-out data" in note for note in found.notes)
    assert not any("row of the joint torque" in note for note in found.notes)


def test_no_session_is_an_error(chain: Chain) -> None:
    with pytest.raises(DataError, match="no session given"):
        diagnose([], chain)


def _loaded(text: str) -> dict[str, object]:
    import yaml

    content = yaml.safe_load(text)
    assert isinstance(content, dict)
    return content
