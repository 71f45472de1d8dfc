from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from fri.errors import ConfigurationError
from ident.dynamics.kinematics import Chain
from ident.effects import EFFECTS, ArmMotion, Setting, Shape, check_entry, find_effect
from ident.effects.friction import dahl_step
from ident.effects.load import leaning, slide
from ident.effects.motion import dahl
from tests.ident.effects.swing import swing

TABLE = {
    "motor": {
        "stribeck",
        "viscous_nonlinear",
        "friction_asymmetry",
        "friction_load",
        "friction_temperature",
        "friction_position",
        "presliding_hysteresis",
        "gear_ripple",
        "motor_torque_gain",
    },
    "joint": {
        "backlash",
        "joint_elasticity",
        "cable_spring",
        "base_tilt",
        "payload_error",
        "payload_change",
        "joint_zero_offset",
        "encoder_eccentricity",
        "contact",
    },
    "sensor": {
        "sensor_gain",
        "sensor_crosstalk",
        "sensor_hysteresis",
        "sensor_saturation",
        "sensor_offset_drift",
        "sensor_ripple",
    },
    "timing": {"motor_torque_delay", "joint_torque_delay", "lost_samples"},
}
CONTACT = {"time": 0.5, "duration": 0.5, "session": 1.0, "link": 3.0}


@pytest.fixture(scope="module")
def motion(chain: Chain, bodies: np.ndarray) -> ArmMotion:
    w, phase = np.pi * np.array([1.0, 1.5, 2.0]), np.array([0.3, 1.0, 2.0])
    return swing(chain, bodies, w, phase, 0.002, inertia=0.4, session=0)


def setting() -> Setting:
    spread = np.array([[-0.6, 0.6]] * 3)
    return Setting(
        1, (4.0,), np.full(3, 100.0), np.full(3, 20.0), np.ones(3, dtype=bool), np.full(3, 2.0), spread
    )


def shapes(cause: str) -> list[Shape]:
    effect = EFFECTS[cause]
    timed = [Shape(form, time=0.3, session=1) for form in effect.onsets]
    return [*effect.shapes(setting(), 1), *timed] or [Shape(**CONTACT) if cause == "contact" else Shape()]


def test_causes_and_sides_are_those_of_the_table() -> None:
    for side, causes in TABLE.items():
        assert {e.cause for e in EFFECTS.values() if e.side == side} == causes


@pytest.mark.parametrize("cause", sorted(EFFECTS))
def test_torque_is_the_columns_times_the_coefficients(cause: str, motion: ArmMotion) -> None:
    effect = EFFECTS[cause]
    for shape in shapes(cause)[:3]:
        columns = effect.columns(motion, 1, shape)
        assert len(columns) <= len(effect.linear) or not effect.linear
        for column in columns:
            for part in (column.motor, column.joint):
                if part is not None:
                    assert part.shape in ((len(motion.time),), (len(motion.time), 3))
                    assert np.all(np.isfinite(part))
        parameters = {**{p.name: 0.01 * (k + 1) for k, p in enumerate(effect.linear)}, **shape}
        motor, joint = effect.torque(motion, 1, parameters, shape.form)
        assert motor.shape == joint.shape == (len(motion.time), 3)
        expected = sum(
            (
                0.01 * (k + 1) * (c.wide(1, 3)[0] if c.motor is not None else 0.0)
                for k, c in enumerate(columns)
            ),
            np.zeros((len(motion.time), 3)),
        )
        np.testing.assert_allclose(motor, expected, atol=1e-12)


def test_no_friction_falls_below_the_speed_of_the_slowest_rows() -> None:
    stribeck, slowest = EFFECTS["stribeck"], replace(setting(), standstill_rad_s=0.05)
    assert min(shape["velocity"] for shape in stribeck.shapes(slowest, 1)) == 0.08
    assert stribeck.least(slowest, 1)["velocity"] == 0.05


def test_sensor_causes_leave_the_motor_torque_alone(motion: ArmMotion) -> None:
    for cause in TABLE["sensor"]:
        assert all(c.motor is None for c in EFFECTS[cause].columns(motion, 1, shapes(cause)[0]))


def test_motor_causes_leave_the_joint_torque_alone(motion: ArmMotion) -> None:
    for cause in TABLE["motor"]:
        assert all(c.joint is None for c in EFFECTS[cause].columns(motion, 1, shapes(cause)[0]))


def test_zero_offset_column_is_the_torque_of_a_shifted_joint(motion: ArmMotion) -> None:
    (column,) = EFFECTS["joint_zero_offset"].columns(motion, 1, Shape())
    shift = np.array([0.0, 1e-3, 0.0])
    expected = motion.rigid_torque(motion.q + shift, motion.qd, motion.qdd) - motion.joint_torque
    assert column.joint is not None
    np.testing.assert_allclose(1e-3 * column.joint, expected, atol=1e-4)


def test_tilt_column_is_gravity_of_a_tilted_base(motion: ArmMotion) -> None:

    from ident.dynamics.regressor import gravity_torque

    angle = 1e-3
    tilted = replace(motion.chain, gravity=9.81 * np.array([0.0, -np.sin(angle), -np.cos(angle)]))
    change = gravity_torque(tilted, motion.q, motion.bodies) - gravity_torque(
        motion.chain, motion.q, motion.bodies
    )
    # A base turned by +angle about x sees (0, 0, -g) turned by -angle: (0, -g sin, -g cos).
    column, _ = EFFECTS["base_tilt"].columns(motion, 0, Shape())
    assert column.joint is not None
    np.testing.assert_allclose(angle * column.joint, change, atol=2e-5)


def test_dahl_turns_over_within_its_length() -> None:
    path = np.concatenate([np.linspace(0.0, 1.0, 500), np.linspace(1.0, 0.99, 100)])
    state = dahl(path, 0.01, 0.0)
    assert state[499] == pytest.approx(1.0, abs=1e-9)
    assert state[-1] == pytest.approx(-1.0 + 2.0 * np.exp(-1.0), abs=1e-6)


def test_a_simulated_effect_turns_as_dahl_does_along_the_whole_path() -> None:
    path = np.concatenate([np.linspace(0.0, 0.02, 50), np.full(5, 0.02), np.linspace(0.02, 0.015, 30)])
    run: Any = SimpleNamespace(state=None)
    steps = [dahl_step(run, float(here), 0.01) for here in path]
    np.testing.assert_allclose(steps, dahl(path, 0.01, 0.0), rtol=1e-14)


def test_unknown_cause_names_the_nearest() -> None:
    with pytest.raises(ConfigurationError, match="did you mean 'stribeck'"):
        find_effect("stribek")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"joints": [8]}, "between 1 and 7"),
        ({"joints": []}, "the joints it acts on"),
        ({"parameters": {"slope": {"value": 1.0}}}, "no parameter 'slope'"),
        ({"cause": "gremlins"}, "unknown"),
    ],
)
def test_wrong_entries_are_refused(change: dict[str, object], message: str) -> None:
    entry = {
        "cause": "stribeck",
        "side": "motor",
        "joints": [2],
        "parameters": {"velocity": {"value": 0.1}},
        **change,
    }
    with pytest.raises(ConfigurationError, match=message):
        check_entry(entry, 7)


def test_a_payload_does_not_come_loose_metres_from_the_flange() -> None:
    effect, shape = EFFECTS["payload_change"], Shape(time=5.0, session=1.0)
    assert effect.plausible(np.array([-0.5, 0.02, 0.0, -0.1]), shape)
    assert effect.plausible(np.array([0.0, 0.3, 0.0, 0.4]), shape)
    assert not effect.plausible(np.array([0.4, 3.2, 0.0, 1.2]), shape)
    assert not effect.plausible(np.array([-60.0, 0.0, 0.0, -9.0]), shape)


@pytest.mark.parametrize(
    ("stated", "pulls"),
    [
        ({"stiffness": 2.0 + 3 * 0.7 * 0.09, "quadratic": -0.63, "cubic": 0.7}, "hardening"),
        ({"stiffness": 2.0, "slack": 0.1, "play": 0.2}, "play"),
    ],
)
def test_a_hose_pulls_in_the_rows_as_in_a_simulation(
    motion: ArmMotion, stated: dict[str, float], pulls: str
) -> None:
    """Hardening about 0.3 rad, less the torque at zero, which no motion tells from an offset; and play about 0.1."""
    effect = EFFECTS["cable_spring"]
    angle = motion.q[:, 1]
    rest = 2.0 * (angle - 0.3) + 0.7 * (angle - 0.3) ** 3 + 0.6 + 0.7 * 0.027
    wanted = (
        rest
        if pulls == "hardening"
        else 2.0 * np.sign(angle - 0.1) * np.maximum(np.abs(angle - 0.1) - 0.2, 0)
    )
    motor, joint = effect.torque(motion, 1, stated, pulls)
    assert joint[:, 1] == pytest.approx(wanted, abs=1e-9)
    assert motor[:, 1] == pytest.approx(wanted, abs=1e-9)
    simulated = effect.simulate(1, stated, pulls)
    for row in (0, 300, 900):
        loads = SimpleNamespace(link_torque=np.zeros(3))
        simulated.load(0.0, SimpleNamespace(position=motion.q[row]), loads)
        assert loads.link_torque[1] == pytest.approx(-wanted[row], abs=1e-9)


def test_a_rough_spot_grips_in_the_rows_as_in_a_simulation(motion: ArmMotion) -> None:
    effect = EFFECTS["friction_position"]
    spot = {"cosine": 0.6, "centre": 0.2, "half_width": 0.3}
    grip = motion.direction[:, 1] * effect.torque(motion, 1, spot, "spot")[0][:, 1]
    away = np.abs(motion.q[:, 1] - 0.2)
    assert np.all(grip[away >= 0.3] == 0.0)
    assert grip[np.argmin(away)] == pytest.approx(0.6, abs=1e-3)
    half = np.argmin(np.abs(away - 0.15))
    assert grip[half] == pytest.approx(0.3, abs=0.02)
    simulated = effect.simulate(1, spot, "spot")
    for row in (0, 300, int(half), int(np.argmin(away))):
        loads = SimpleNamespace(Fcm=np.full(3, 1.5))
        simulated.load(0.0, SimpleNamespace(motor_position=motion.q[row]), loads)
        assert loads.Fcm == pytest.approx([1.5, 1.5 + grip[row], 1.5], abs=1e-9)


def test_a_rough_spot_without_a_width_is_refused() -> None:
    spot = {"cosine": {"value": 0.6}, "centre": {"value": 0.2}}
    entry = {"cause": "friction_position", "joints": [2], "form": "spot", "parameters": spot}
    with pytest.raises(ConfigurationError, match="needs `half_width`"):
        check_entry(entry, 7)


def test_viscous_friction_rises_from_standstill_on() -> None:
    thinning = EFFECTS["viscous_nonlinear"].plausible
    assert thinning(np.array([2.0]), Shape(exponent=0.4))
    assert thinning(np.array([-1.5]), Shape(exponent=1.6))
    # A friction that falls as the speed rises is Stribeck's.
    assert not thinning(np.array([-2.0]), Shape(exponent=0.4))


def test_loose_payload_lies_where_gravity_pulls_it(motion: ArmMotion) -> None:
    lean = leaning(motion)
    pose = motion.chain.forward(motion.q[7])[-1][:3, :3]
    down = motion.chain.gravity / np.linalg.norm(motion.chain.gravity)
    np.testing.assert_allclose(lean[7], pose.T @ down, atol=1e-12)
    effect, when = EFFECTS["payload_change"], {"time": 1.0, "session": float(motion.session + 1)}
    loose = effect.columns(motion, 0, effect.shape_of(when, "loose"))
    firm = effect.columns(motion, 0, effect.shape_of(when, "jump"))
    assert (len(loose), len(firm)) == (3, 4)
    after = motion.time >= 1.0
    for axis, (one, other) in enumerate(zip(loose, firm, strict=False)):
        assert one.joint is not None
        assert other.joint is not None
        assert not np.any(one.joint[~after])
        np.testing.assert_allclose(one.joint, slide(lean)[:, axis, None] * other.joint)


def test_drive_warms_up_by_the_power_of_its_friction(motion: ArmMotion) -> None:
    effect = EFFECTS["friction_temperature"]

    def at(speed: float, form: str) -> np.ndarray:
        steady = replace(motion, motor_speed=np.full_like(motion.q, speed), slip=None)
        (column,) = effect.columns(steady, 1, effect.shape_of({"time_constant": 1.5}, form))
        assert column.motor is not None
        return column.motor / steady.drive_friction[:, 1]

    expected = 1.0 - np.exp(-motion.time / 1.5)
    np.testing.assert_allclose(at(1.0, "heated by friction"), expected, atol=2e-3)
    np.testing.assert_allclose(at(0.3, "within a session"), expected)
    assert at(2.0, "heated by friction")[-1] > 2.0 * at(1.0, "heated by friction")[-1] - 1e-9
    assert at(0.3, "heated by friction")[-1] < 0.3 * expected[-1] + 1e-9


@pytest.mark.parametrize("cycles", [1, 2])
def test_an_eccentric_encoder_errs_in_the_motion_of_the_drive_as_well(cycles: int, motion: ArmMotion) -> None:
    """Drive inertia and viscous friction see the slope and curvature of the reading error, in the motor torque only."""
    effect, size = EFFECTS["encoder_eccentricity"], 1e-5
    q, qd, qdd = (values[:, 1] for values in (motion.q, motion.qd, motion.qdd))
    slope, curvature = cycles * np.cos(cycles * q), -(cycles**2) * np.sin(cycles * q)
    true = motion.motor_speed.copy()
    true[:, 1] -= size * slope * qd
    friction = (motion.friction(true) - motion.friction(motion.motor_speed))[:, 1]
    expected = friction / size - motion.inertia[1] * (curvature * qd**2 + slope * qdd)
    _, sine = effect.columns(motion, 1, Shape(cycles_per_turn=cycles))
    assert sine.motor is not None
    assert sine.joint is not None
    own = sine.motor - sine.joint
    np.testing.assert_allclose(own[:, 1], expected, atol=1e-6)
    assert np.std(expected) > 0.1
    assert not np.any(own[:, [0, 2]])


@pytest.mark.parametrize("cause", ["motor_torque_delay", "joint_torque_delay"])
def test_no_delay_falls_between_the_shapes_that_are_tried(cause: str) -> None:
    effect = EFFECTS[cause]
    (share,) = effect.linear
    setting = SimpleNamespace(compared=True)
    tried = np.array([shape["delay"] for shape in effect.shapes(setting, 0)])  # type: ignore[arg-type]
    for delay in np.linspace(0.0012, 0.04, 400):
        for true in (delay, -delay):
            found = true / tried
            assert np.any((found > 1.1 * share.low) & (found < 0.95 * share.high)), true


@pytest.mark.parametrize("cause", sorted(EFFECTS))
def test_columns_of_a_part_are_those_of_the_whole_motion(cause: str, motion: ArmMotion) -> None:
    effect, whole = EFFECTS[cause], replace(motion)
    middle, scattered = slice(700, 1300), np.arange(100, 1900, 7)
    parts = [(some, whole.part(some)) for some in (middle, scattered)]
    for shape in shapes(cause):
        columns = effect.columns(motion, 1, shape)
        for some, part in parts:
            for column, own in zip(columns, effect.columns(part, 1, shape), strict=True):
                for side in ("motor", "joint"):
                    expected, found = getattr(column, side), getattr(own, side)
                    assert (expected is None) == (found is None)
                    if expected is not None:
                        # Elastic joints: a difference of torques over 1e-5 or 1e-4.
                        np.testing.assert_allclose(found, expected[some], rtol=1e-7, atol=1e-8)
                        assert side in effect.seen_by


def test_a_part_far_from_its_neighbours_has_the_step_of_the_whole(motion: ArmMotion) -> None:
    part = motion.part(np.array([10, 500, 1500]))
    assert part.dt == motion.dt
    around = motion.part(slice(500, 600)).around(0.01)
    assert around.time[0] < motion.time[500] - 0.01
    assert around.time[-1] > motion.time[599] + 0.01


def test_another_zero_of_a_joint_turns_the_phase_of_its_ripple() -> None:
    ripple, zero = EFFECTS["gear_ripple"], EFFECTS["joint_zero_offset"]
    shape, some = Shape(cycles_per_turn=2.0, gear_ratio=100.0), np.array([0.1, 0.0])
    assert ripple.follows_from(shape, some, zero, Shape(), np.array([-2e-3]))
    assert not ripple.follows_from(shape, some, zero, Shape(), np.array([2e-4]))
    assert not ripple.follows_from(shape, some, EFFECTS["base_tilt"], Shape(), np.array([2e-3, 0.0]))
