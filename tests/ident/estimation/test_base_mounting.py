from __future__ import annotations

import dataclasses
import re
from pathlib import Path

import numpy as np
import pytest

from fri.errors import ConfigurationError
from ident.dynamics.kinematics import Chain
from ident.dynamics.regressor import torque
from ident.estimation.automatic import choose
from ident.estimation.identification import IdentificationSettings, Known
from ident.estimation.identify import identify
from ident.estimation.mounting import find_mounting, tilt_columns
from ident.estimators import nearest_consistent
from ident.rows.filters import SignalSettings
from ident.rows.observation import observe
from ident.rows.prepare import prepare
from ident.rows.prepared import TorqueChannel
from lwr_driver.configuration import find
from lwr_driver.session import JointColumns, Session
from tests.ident import estimation_arm

RATE_HZ = 100.0
MODEL_1 = IdentificationSettings(model=1, essential=None, estimator="physical")


def upright() -> Chain:
    return Chain.from_urdf(find("lwr4plus.urdf"))


def recorded(gravity: np.ndarray, *, seed: int, seconds: float = 30.0) -> Session:
    """A Fourier motion of the arm under `gravity`, friction and offsets included, with sensor noise."""
    random = np.random.default_rng(seed)
    chain = dataclasses.replace(upright(), gravity=gravity)
    t = np.arange(0.0, seconds, 1.0 / RATE_HZ)
    q, qd, qdd = (np.zeros((len(t), 7)) for _ in range(3))
    for harmonic in range(1, 6):
        w = 2.0 * np.pi * harmonic / 20.0
        amplitude = random.uniform(0.1, 0.3, 7)
        phase = random.uniform(0.0, 2.0 * np.pi, 7)
        q += amplitude * np.sin(w * t[:, None] + phase)
        qd += amplitude * w * np.cos(w * t[:, None] + phase)
        qdd -= amplitude * w**2 * np.sin(w * t[:, None] + phase)
    inertial = nearest_consistent(upright().urdf_inertials())
    effort = torque(chain, q, qd, qdd, inertial) + 0.4 * np.sign(qd) + 0.2 * qd + 0.3
    effort += random.normal(scale=0.1, size=effort.shape)
    clock = np.rint(t * 1e9).astype(np.int64)
    joint = JointColumns(
        "/joint_states",
        chain.joint_names,
        clock + 10**18,
        clock,
        np.zeros(len(t), dtype=np.int64),
        q,
        np.zeros((len(t), 0)),
        effort,
    )
    return Session(Path(f"session_{seed}.mcap"), {"payload": "none"}, None, chain.joint_names, joint)


def leaning(about_x: float, about_y: float) -> np.ndarray:
    """Gravity in the axes of a base rotated by small angles about x and then y."""
    cx, sx, cy, sy = np.cos(about_x), np.sin(about_x), np.cos(about_y), np.sin(about_y)
    rotation = np.array([[1, 0, 0], [0, cx, -sx], [0, sx, cx]]) @ np.array(
        [[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]]
    )
    return rotation.T @ np.array([0.0, 0.0, -9.81])


@pytest.mark.parametrize("angles", [(0.03, -0.01), (-0.005, 0.002)])
def test_a_lean_of_the_base_is_found_with_its_sign(angles: tuple[float, float]) -> None:
    truth = leaning(*angles)
    found = find_mounting([recorded(truth, seed=4)], upright(), MODEL_1, known=Known())
    skewed = dataclasses.replace(found, axes=np.array([[1.0, -2.03e-23, 1e-9], [-1e-17, 1.0, 0.0]]))
    assert "about [1, 0, 0]" in str(skewed)
    assert "about [0, 1, 0]" in str(skewed)
    assert found.converged
    np.testing.assert_allclose(found.tilt_rad, angles, atol=1.5e-3)
    assert np.all(np.abs(found.tilt_rad - angles) < 4.0 * found.std)
    np.testing.assert_allclose(found.gravity, truth, atol=0.02)
    np.testing.assert_array_equal(found.chain.gravity, found.gravity)
    assert np.linalg.norm(found.gravity) == pytest.approx(9.81)
    assert found.p_value < 0.01
    np.testing.assert_array_equal(found.axes, [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])


def test_an_upright_base_stays_upright() -> None:
    probabilities = []
    for seed in range(4):
        log = recorded(leaning(0.0, 0.0), seed=seed)
        found = find_mounting([log], upright(), MODEL_1, known=Known())
        assert np.rad2deg(np.linalg.norm(found.tilt_rad)) < 0.1
        probabilities.append(found.p_value)
    assert min(probabilities) > 0.01


def test_the_masses_of_a_placeholder_do_not_hold_the_base_upright(tmp_path: Path) -> None:
    path = tmp_path / "light.urdf"
    path.write_text(re.sub(r'<mass value="[^"]*"', '<mass value="0.01"', find("lwr4plus.urdf").read_text()))
    found = choose([recorded(leaning(0.03, -0.01), seed=4)], Chain.from_urdf(path), MODEL_1)
    assert found.choice is not None
    mounting = found.choice.mounting
    assert mounting is not None
    assert mounting.tilt_rad[0] == pytest.approx(0.03, abs=0.01)
    assert np.all(np.abs(mounting.tilt_rad - [0.03, -0.01]) < 2.0 * mounting.std)


def test_the_lean_is_part_of_what_is_printed_and_stored() -> None:
    log = recorded(leaning(0.03, 0.0), seed=1)
    found = find_mounting([log], upright(), MODEL_1, known=Known())
    assert str(found).startswith("the base leans by 1.7")
    content = found.to_dict()
    assert content["converged"] is True
    assert content["gravity"] == found.gravity.tolist()
    assert content["assumed_gravity"] == [0.0, 0.0, -9.81]


def test_model_3_and_a_chain_without_gravity_are_refused() -> None:
    session = recorded(leaning(0.0, 0.0), seed=1, seconds=10.0)
    with pytest.raises(ConfigurationError, match="Model 3 has no gravity"):
        find_mounting([session], upright(), dataclasses.replace(MODEL_1, model=3))
    weightless = dataclasses.replace(upright(), gravity=np.zeros(3))
    with pytest.raises(ConfigurationError, match="no gravity"):
        find_mounting([session], weightless, MODEL_1)


def test_the_columns_of_a_tilt_are_the_torques_of_a_turned_gravity_on_both_sides_and_of_the_payload() -> None:
    arm = estimation_arm.chain()
    sessions = [estimation_arm.at_125_hz(), estimation_arm.at_125_hz(loaded=True)]
    settings = IdentificationSettings(essential=None, signals=SignalSettings(10.0, decimate_hz=2.0))
    found = identify(sessions, arm, settings)
    columns = tilt_columns(found, sessions)
    structure, count = found.structure, 0
    assert structure.sides == ("motor", "joint")
    assert structure.payloads == ("payload",)
    for k, axis in enumerate(np.eye(3)[:2]):
        # Gravity turned about the axis, linear in the angle.
        chain = dataclasses.replace(arm, gravity=-np.cross(axis, arm.gravity))
        turned = dataclasses.replace(structure, chain=chain, without=("offl", "offm"))
        for record, session in enumerate(sessions):
            whole = prepare(session, found.settings.signals, log=False)
            still = dataclasses.replace(
                whole,
                passages=tuple(
                    dataclasses.replace(p, **{side: at_rest(getattr(p, side)) for side in ("joint", "motor")})
                    for p in whole.passages
                ),
            )
            groups = observe([still], [found.payloads[record]], turned, columns=found.base.columns).groups
            mine = [c for c, g in zip(columns, found.problem.groups, strict=True) if g.record == record]
            for group, column in zip(groups, mine, strict=True):
                expected = group.matrix @ found.estimate.values
                np.testing.assert_allclose(column[:, k], expected, rtol=1e-9, atol=1e-9)
                count += bool(np.any(expected))
    assert count > 20


def at_rest(channel: TorqueChannel) -> TorqueChannel:
    zero = np.zeros_like(channel.qd)
    return dataclasses.replace(channel, qd=zero, qdd=zero, drive=None)
