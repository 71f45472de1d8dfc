"""Cases: the same from the same seed, as visible as wanted, and felt where they are said to be."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("mujoco", reason="needs the extra `generator`")

from benchmarks.mujoco_arms.cases import ALL, Bench, changed, draw, record, sized
from benchmarks.mujoco_arms.recording import write
from benchmarks.mujoco_arms.simulation import simulate
from benchmarks.mujoco_arms.strength import found_strength
from lwr_driver.session import read_session
from tests.mujoco_arms.motions import shortened

# Faults that change an angle are felt at the joints that carry its weight.
_OF_ONE_TORQUE = [
    *sorted(name for name, one in ALL.items() if one.where != "arm" and one.side in ("motor", "sensor")),
    *("cable_spring", "stop_cushion"),
]


def test_kind_and_seed_give_the_same_log(tmp_path: Path) -> None:
    for name in ("a", "b"):
        setup = shortened(draw(3, "healthy", arm="lwr4plus"), 2.0).healthy[1]
        write(tmp_path / f"{name}.mcap", setup, simulate(setup.plant, setup.q, setup.qd))
    assert (tmp_path / "a.mcap").read_bytes() == (tmp_path / "b.mcap").read_bytes()


def test_logs_are_sessions(tmp_path: Path, lwr) -> None:
    setup = lwr.healthy[1]
    session = read_session(write(tmp_path / "a.mcap", setup, simulate(setup.plant, setup.q, setup.qd)))
    assert session.metadata["payload"] == setup.label.payload
    assert session.joint.position.shape[1] == lwr.arm.kind.size
    assert np.isfinite(session.motor.effort).all()


def test_days_differ_and_the_arm_does_not() -> None:
    case = draw(5, "healthy", arm="lwr4plus")
    one, other = (day[0].plant.drive for day in case.reference)
    assert (one["inertia"] == other["inertia"]).all()
    for name, most in (("coulomb", 0.1), ("viscous", 0.15)):
        change = other[name] / one[name]
        assert (change != 1.0).all()
        assert (np.abs(np.log(change)) < 2.0 * most + 0.03).all()


@pytest.fixture(scope="module")
def stribeck() -> Bench:
    """The bench of a case with a hidden cause."""
    return Bench(shortened(draw(2, "single", "stribeck", "lwr4plus"), 15.0))


@pytest.mark.slow
@pytest.mark.parametrize("target", [1.15, 2.0])
def test_strength_makes_the_wanted_visibility(stribeck: Bench, target: float) -> None:
    case = replace(stribeck.case, hidden=(replace(stribeck.case.hidden[0], target=target),))
    found = sized(case, stribeck, np.random.default_rng(1)).hidden[0]
    assert found.rho == pytest.approx(target, rel=0.1)


def test_search_stays_within_the_strengths() -> None:
    strength, rho = found_strength(lambda p: 1.0 + 1e-6 * p, 2.0, 0.1, 3.0)
    assert 0.1 < strength <= 3.0
    assert rho < 1.1


@pytest.mark.slow
@pytest.mark.parametrize("name", _OF_ONE_TORQUE)
def test_a_fault_changes_the_torque_of_its_joint_most(name: str, lwr, bench) -> None:
    cause = ALL[name]
    kind = "wear" if name == "wear" else "single" if cause.listed else "outside"
    hidden = draw(9, kind, name, "lwr4plus").hidden[0]
    hidden = replace(
        hidden,
        variant=replace(hidden.variant, peaks=bench.peaks()),
        strength=float(np.sqrt(np.prod(cause.strengths))),
    )
    setups, parameters = changed(lwr, [hidden])
    assert parameters[0]
    joint = hidden.variant.joint
    motor, sensor = np.zeros((2, lwr.arm.kind.size))
    for loaded in (1, 2):
        setup, healthy = setups[loaded], lwr.healthy[loaded]
        one = record(setup, simulate(setup.plant, setup.q, setup.qd))
        other = record(healthy, bench.healthy[loaded])
        motor += np.mean(((one.motor - other.motor) / lwr.arm.kind.effort) ** 2, axis=0)
        sensor += np.mean(((one.joint - other.joint) / lwr.arm.kind.effort) ** 2, axis=0)
    if cause.side == "sensor" and name != "aliased_hum":
        assert sensor.argmax() == joint
        assert not motor.any()
        return
    assert motor.argmax() == joint
    if cause.side != "joint":
        assert motor[joint] > sensor[joint]
