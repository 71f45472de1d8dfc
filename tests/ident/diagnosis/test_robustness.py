"""Sessions as they come: any channel, rate, length and arm; never a crash, never a claim without ground."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fri.errors import DataError
from ident.diagnosis import Diagnosis, DiagnosisSettings, diagnose
from ident.diagnosis.causes.candidates import Dictionary
from ident.diagnosis.causes.tolerances import tolerances
from ident.diagnosis.outcome.signatures import signature_bench
from ident.dynamics.kinematics import Chain
from ident.dynamics.regressor import torque
from ident.rows.filters import SignalSettings, low_pass
from lwr_driver.session import JointColumns, Session

NOISE = 0.04


def arm(joints: int = 2) -> Chain:
    rows = [{"name": "one", "alpha": np.pi / 2}, {"name": "two", "d": 0.4}, {"name": "three", "d": 0.3}]
    return Chain.from_table(rows[:joints])


def bodies(joints: int) -> np.ndarray:
    table = np.zeros((joints, 10))
    for k in range(joints):
        mass, reach = 4.0 - k, 0.1 + 0.05 * k
        table[k, [9, 6, 7]] = mass, mass * reach, 0.1 * mass * reach
        table[k, [0, 3, 5]] = 0.02, mass * reach**2 + 0.02, mass * reach**2 + 0.02
    return table


def session(
    seconds: float = 12.0,
    rate: float = 250.0,
    *,
    joints: int = 2,
    seed: int = 1,
    motor: bool = True,
    joint: bool = True,
    band_hz: float | None = None,
    moving: tuple[bool, ...] = (True, True, True),
    extra: float = 0.0,
    name: str = "a.mcap",
) -> Session:
    """A motion of sines that does not repeat, on a healthy arm; `extra` is a spring at joint 2 [Nm/rad^3]."""
    random = np.random.default_rng(seed)
    time = np.arange(0.0, seconds, 1.0 / rate)
    q, qd, qdd = np.zeros((3, len(time), joints))
    for w in 2 * np.pi * np.array([0.11, 0.23, 0.37, 0.71]):
        a, p = random.uniform(0.2, 0.5, joints), random.uniform(0.0, 6.3, joints)
        a = a * np.array(moving[:joints])
        q += a * np.sin(w * time[:, None] + p)
        qd += a * w * np.cos(w * time[:, None] + p)
        qdd -= a * w**2 * np.sin(w * time[:, None] + p)
    sign = np.sign(qd)
    link = torque(arm(joints), q, qd, qdd, bodies(joints)) + 0.1 * sign + 0.1
    link[:, 1] += extra * q[:, 1] ** 3
    drive = link + 0.4 * qdd + 2.0 * qd + 1.5 * sign
    channels = [values + NOISE * random.normal(size=q.shape) for values in (link, drive)]
    if band_hz is not None:
        channels = [low_pass(values, 1.0 / rate, band_hz) for values in channels]
    stamps = (time * 1e9).astype(np.int64) + 10**15 + seed * 10**12
    empty, count = np.zeros((len(time), 0)), np.arange(1, len(time) + 1)

    def columns(topic: str, position: np.ndarray, effort: np.ndarray) -> JointColumns:
        return JointColumns(
            topic, arm(joints).joint_names, stamps, stamps, count, position, empty, effort, name
        )

    return Session(
        Path(name),
        {"robot": "small", "payload": "none"},
        {},
        arm(joints).joint_names,
        columns("/joint_states", q, channels[0] if joint else empty),
        columns("/motor_states", empty, channels[1]) if motor else None,
    )


def sound(found: Diagnosis) -> Diagnosis:
    """The same, once it is known to be printable, storable and within its own limits."""
    json.dumps(found.to_dict(), allow_nan=False)
    assert str(found)
    joints = found.base_model.structure.chain.n
    for finding in found.claims:
        assert 0.0 <= finding.confidence <= 1.0
        assert all(1 <= j <= joints for j in finding.joints)
    for model in (found.base_model, found.extended_model):
        assert np.all(np.isfinite(model.values))
        assert np.all(np.isfinite(model.std))
    return found


@pytest.mark.parametrize(
    "kind",
    [
        {"rate": 50.0},
        {"rate": 1000.0},
        {"rate": 5000.0, "seconds": 6.0},
        {"seconds": 5.0},
        pytest.param({"seconds": 40.0, "rate": 100.0}, marks=pytest.mark.long),
        {"motor": False},
        {"joint": False},
        {"joints": 3, "joint": False},
        {"joints": 3, "motor": False},
        {"band_hz": 2.0},
        pytest.param({"band_hz": 8.0, "rate": 500.0}, marks=pytest.mark.long),
        {"band_hz": 3.0, "joint": False},
        {"moving": (False, True)},
        {"moving": (True, False)},
    ],
    ids=str,
)
def test_a_healthy_arm_is_called_healthy_whatever_was_recorded(kind: dict) -> None:
    found = sound(diagnose([session(**kind)], arm(kind.get("joints", 2))))
    assert found.claims == ()
    notes = " ".join(found.notes)
    assert ("low-passed" in notes) == ("band_hz" in kind)
    assert ("no motion of" in notes) == ("moving" in kind)
    assert ("no motor torque" in notes) == (not kind.get("motor", True))


@pytest.mark.parametrize(
    "kind", [{}, {"motor": False}, {"joint": False}, {"rate": 50.0}, {"band_hz": 2.0}], ids=str
)
def test_a_strong_spring_is_found_in_one_session_of_any_kind(kind: dict) -> None:
    found = sound(diagnose([session(seconds=20.0, extra=6.0, **kind)], arm()))
    first = found.claims[0]
    assert first.joints == (2,)
    names = {first.cause, *(cause for cause, joints, _ in first.alternatives if joints == (2,))}
    assert "cable_spring" in names
    if kind.get("motor", True) is False and first.side == "sensor":
        assert first.confidence < 0.8


def test_a_joint_torque_that_never_changes_is_no_cause() -> None:
    dead = session()
    dead.joint.effort[:, 1] = 0.0
    found = sound(diagnose([dead], arm()))
    assert all(f.confidence < 0.8 for f in found.claims if f.side == "joint")


def test_one_session_for_fitting_and_testing() -> None:
    assert sound(diagnose([session()], arm(), test=[session(name="b.mcap")])).claims == ()


def test_the_session_for_testing_may_be_the_older_one() -> None:
    older = session(seed=1, name="older.mcap")
    assert sound(diagnose([session(seed=2)], arm(), test=[older])).claims == ()


def test_a_session_with_and_one_without_motor_torque() -> None:
    pair = [session(seed=1), session(seed=2, motor=False, name="b.mcap")]
    assert sound(diagnose(pair, arm())).claims == ()


def test_a_session_with_and_one_without_joint_torque() -> None:
    pair = [session(seed=1), session(seed=2, joint=False, name="b.mcap")]
    assert sound(diagnose(pair, arm())).claims == ()


def test_missing_values_are_refused() -> None:
    broken = session()
    broken.joint.effort[100, 0] = np.nan
    with pytest.raises(DataError, match=r"a\.mcap"):
        diagnose([broken], arm())


@pytest.mark.parametrize("seconds", [0.02, 0.3])
def test_a_session_that_is_too_short_is_refused(seconds: float) -> None:
    with pytest.raises(DataError, match=r"a\.mcap"):
        diagnose([session(seconds=seconds)], arm())


def test_two_seconds_say_nothing() -> None:
    assert sound(diagnose([session(seconds=2.0)], arm())).claims == ()


def test_a_session_in_which_nothing_moves_is_refused() -> None:
    with pytest.raises(DataError, match="moves"):
        diagnose([session(moving=(False, False))], arm())


def test_of_a_long_session_windows_from_beginning_to_end_are_used() -> None:
    long = session(seconds=90.0, rate=50.0, extra=6.0)
    found = sound(diagnose([long], arm(), settings=DiagnosisSettings(most_s=30.0)))
    time = found.states["joint"].time
    assert 25.0 < len(time) * np.median(np.diff(time)) < 40.0
    assert time[0] < 5.0
    assert time[-1] > 75.0
    assert found.claims[0].cause == "cable_spring"


def test_a_compliance_is_tolerated_within_what_is_unknown_of_it() -> None:
    bench = signature_bench([session()], arm())
    bench.nominal.arm = replace(
        bench.nominal.arm,
        encoder="motor",
        encoder_known=True,
        compliance=np.full(2, 1e-4),
        compliance_std=np.array([0.5e-4, 1e-7]),
    )
    dictionary = Dictionary(bench.nominal, bench.evidence, ["joint_elasticity"])
    found = {one.name: one.size for one in tolerances(dictionary, DiagnosisSettings())}
    # A stated stiffness to a factor of two, and one learned from healthy sets to a usual share.
    assert found["compliance 1"] == pytest.approx(1e-4)
    assert found["compliance 2"] == pytest.approx(0.12e-4)


def test_a_fit_of_no_possible_arm_leaves_links_that_move_on_springs() -> None:
    bench = signature_bench([session()], arm())
    nominal = bench.nominal
    nominal.arm = replace(nominal.arm, encoder="motor", compliance=np.full(2, 1e-4))
    nominal.refine(-bench.evidence.full.values[: len(nominal.base)])
    for motion in nominal.motions:
        assert np.abs(motion.q).max() < 10.0
    for rows in nominal.rows.values():
        assert np.isfinite(rows.matrix[rows.valid.T]).all()


def test_rows_beside_a_start_or_a_stop_are_left_out_as_far_as_the_low_pass_reaches() -> None:
    """The filtered speed of a joint that starts is above zero before it moves, and no friction follows it."""
    recorded, cutoff = session(rate=100.0), 8.0
    joint, time = recorded.joint, np.arange(0.0, 12.0, 0.01)
    place = np.clip(np.mod(time, 2.0), 0.0, 1.0)
    step = place**3 * (10.0 - 15.0 * place + 6.0 * place**2)
    position = np.where(np.mod(time, 4.0) < 2.0, step, 1.0 - step)
    moved = replace(joint, position=np.column_stack([position, joint.position[:, 1]]))
    settings = DiagnosisSettings(signals=SignalSettings(cutoff_hz=cutoff))
    bench = signature_bench([replace(recorded, joint=moved)], arm(), settings=settings)
    for rows in bench.nominal.rows.values():
        valid = rows.time[rows.valid[:, 0]]
        assert len(valid) > 50
        since = np.mod(valid, 2.0)
        assert since.min() > 0.5 / cutoff
        assert since.max() < 1.0 - 0.5 / cutoff
