"""Guessed columns: quantity by name, joints by the URDF, units by the numbers."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.io import savemat

from fri.errors import ConfigurationError, DataError
from ident.dynamics.session_chain import session_chain
from ident.import_log import Guess, Known, LogMapping, guess_mapping, import_log
from ident.import_log.fields import Field, split_name
from lwr_driver.session import read_session
from tests.ident.stock_panda import JOINTS, stock_panda

N, RATE = 400, 250.0
T = np.arange(N) / RATE
PHASE = np.arange(7)
Q = 0.8 * np.sin(2.0 * T[:, None] + PHASE)
QD = 1.6 * np.cos(2.0 * T[:, None] + PHASE)
QDD = -3.2 * np.sin(2.0 * T[:, None] + PHASE)
TAU = np.cos(3.0 * T[:, None]) * np.arange(1.0, 8.0) + 5.0
DEG = 180.0 / np.pi


@pytest.fixture
def arm(tmp_path: Path) -> Path:
    (tmp_path / "panda.urdf").write_text(stock_panda(floating=True, head=True))
    return tmp_path / "panda.urdf"


def write(path: Path, names: list[str] | None, *blocks: np.ndarray, mark: str = ",") -> Path:
    table = np.hstack([block.reshape(N, -1) for block in blocks])
    lines = [mark.join(f"{value:.12g}" for value in row) for row in table]
    head = [mark.join(names)] if names else []
    path.write_text("\n".join(head + lines) + "\n")
    return path


def columns(pattern: str, first: int = 1) -> list[str]:
    return [pattern.format(k=k + first, joint=JOINTS[k]) for k in range(7)]


def session(guess: Guess, source: Path, folder: Path):
    import_log(guess.mapping, source, folder / "out.mcap")
    return read_session(folder / "out.mcap")


NAMINGS: dict[str, tuple[str, str, str, str]] = {
    "letters": ("t", "q{k}", "dq{k}", "tau{k}"),
    "words": ("Time", "Position{k}", "Velocity{k}", "TorqueSm{k}"),
    "joint names": ("stamp", "{joint}_pos", "{joint}_vel", "{joint}_effort"),
    "brackets": ("timestamp_s", "state.q[{k}]", "state.qd[{k}]", "state.tau_J[{k}]"),
    "between": ("time", "joint_{k}_position", "joint_{k}_velocity", "joint_{k}_torque"),
    "German": ("Zeit", "Achse {k} Ist", "Geschwindigkeit {k}", "Moment {k}"),
    "units": ("t [s]", "ang {k}", "angvel {k} [rad/s]", "T J{k} (Nm)"),
    "angles": ("clock", "th_{k}", "thd_{k}", "trq_{k}"),
}


@pytest.mark.parametrize("naming", NAMINGS)
def test_columns_are_known_by_their_names(naming: str, arm: Path, tmp_path: Path) -> None:
    time, q, qd, tau = NAMINGS[naming]
    aside = ["tau_J_d{k}", "target_q_{k}", "temp_{k}", "q_filtered{k}"]
    names = [time, *(name for pattern in (*aside, q, qd, tau) for name in columns(pattern))]
    path = write(tmp_path / "run.csv", names, T, TAU + 9, Q + 9, Q * 0, Q * 1.1, Q, QD, TAU)
    guess = guess_mapping(path, arm)
    read = session(guess, path, tmp_path)
    assert read.joint_names == JOINTS
    for found, expected in ((read.joint.position, Q), (read.joint.velocity, QD), (read.joint.effort, TAU)):
        np.testing.assert_allclose(found, expected, rtol=1e-10, atol=1e-10)
    assert len(guess.unused) == 4
    assert all(
        place in str(guess) for place in (q.format(k=1, joint=JOINTS[0]), "not used:", "within the limits")
    )


def test_the_mapping_file_of_a_guess_repeats_it(arm: Path, tmp_path: Path) -> None:
    names = ["t", *columns("q{k}"), *columns("tau{k}")]
    guess = guess_mapping(write(tmp_path / "run.csv", names, T, Q, TAU), arm)
    (tmp_path / "run.yaml").write_text(guess.text)
    assert LogMapping.load(tmp_path / "run.yaml") == guess.mapping


@pytest.mark.parametrize(
    ("angle", "rate", "units"),
    [
        (1.0, 1.0, ("rad", "rad/s")),
        (DEG, DEG, ("deg", "deg/s")),
        (DEG, 1.0, ("deg", "rad/s")),
        (1.0, DEG / 6, ("rad", "rpm")),
    ],
)
def test_units_of_angles_and_rates_follow_from_limits_and_derivative(
    angle: float, rate: float, units: tuple[str, str], arm: Path, tmp_path: Path
) -> None:
    names = ["t", *columns("q{k}"), *columns("dq{k}"), *columns("tau{k}")]
    path = write(tmp_path / "run.csv", names, T, Q * angle, QD * rate, TAU)
    guess = guess_mapping(path, arm)
    assert guess.mapping.velocity is not None
    assert (guess.mapping.position.unit, guess.mapping.velocity.unit) == units
    np.testing.assert_allclose(session(guess, path, tmp_path).joint.velocity, QD, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize(("unit", "size"), [("s", 1.0), ("ms", 1e3), ("us", 1e6), ("ns", 1e9)])
@pytest.mark.parametrize("start", [0.0, 1.7e9])
def test_the_unit_of_time_follows_from_its_steps(
    unit: str, size: float, start: float, arm: Path, tmp_path: Path
) -> None:
    times = [f"{(start + t) * size:.6f}" for t in T]
    rows = [
        ",".join([time, *map(str, q), *map(str, tau)]) for time, q, tau in zip(times, Q, TAU, strict=True)
    ]
    path = tmp_path / "run.csv"
    path.write_text("\n".join([",".join(["t", *columns("q{k}"), *columns("tau{k}")]), *rows]))
    found = guess_mapping(path, arm).mapping.time
    assert (found.unit, found.zero) == (unit, "unix" if start else "start")


@pytest.mark.parametrize(("step", "unit"), [(0.1, "s"), (0.4, "s"), (100.0, "ms")])
@pytest.mark.parametrize("angle", [1.0, DEG])
@pytest.mark.parametrize("with_velocity", [False, True])
def test_a_slow_recording_has_the_unit_of_its_motion(
    step: float, unit: str, angle: float, with_velocity: bool, arm: Path, tmp_path: Path
) -> None:
    times = np.arange(N) * step
    at = times[:, None] * (1.0 if unit == "s" else 1e-3)
    q, qd = 0.8 * np.sin(0.7 * at + PHASE), 0.56 * np.cos(0.7 * at + PHASE)
    names = ["t", *columns("q{k}"), *(columns("dq{k}") if with_velocity else []), *columns("tau{k}")]
    parts = [times, q * angle, *([qd * angle] if with_velocity else []), 9.0 * np.sin(q)]
    guess = guess_mapping(write(tmp_path / "run.csv", names, *parts), arm)
    assert guess.mapping.time.unit == unit
    assert guess.mapping.position.unit == ("rad" if angle == 1.0 else "deg")


def test_a_fast_recording_is_not_taken_for_a_slow_one(arm: Path, tmp_path: Path) -> None:
    names = ["t", *columns("q{k}"), *columns("dq{k}"), *columns("tau{k}")]
    fast = np.arange(len(T)) * 0.2
    path = write(tmp_path / "run.csv", names, fast, Q, QD * (T[1] - T[0]) / 2e-4, TAU)
    assert guess_mapping(path, arm).mapping.time.unit == "ms"


def test_coarse_stamps_are_spread(arm: Path, tmp_path: Path) -> None:
    names = ["t", *columns("q{k}"), *columns("tau{k}")]
    path = write(tmp_path / "run.csv", names, np.floor(T * 100) / 100, Q, TAU)
    guess = guess_mapping(path, arm)
    assert guess.mapping.time.equal == "spread"
    assert "equal times spread" in str(guess)
    np.testing.assert_allclose(session(guess, path, tmp_path).joint.log_time * 1e-9, T, atol=5.1e-3)


def test_a_table_without_names_is_told_by_its_derivatives(arm: Path, tmp_path: Path) -> None:
    path = write(tmp_path / "run.csv", None, Q, QD, QDD, TAU)
    guess = guess_mapping(path, arm)
    assert guess.mapping.time.rate_hz == RATE
    assert guess.mapping.joint_torque is not None
    assert guess.mapping.joint_torque.columns == tuple(range(22, 29))
    read = session(guess, path, tmp_path)
    np.testing.assert_allclose(read.joint.velocity, QD, rtol=1e-9, atol=1e-9)
    with pytest.raises(DataError, match="these may be torques: columns 8 to 14; columns 15 to 21"):
        guess_mapping(write(tmp_path / "two.csv", None, Q, TAU, 2 * TAU + Q), arm)
    with pytest.raises(DataError, match="5 columns without names"):
        guess_mapping(write(tmp_path / "few.csv", None, Q[:, :5]), arm)


def test_arrays_of_npz_and_matlab_files(arm: Path, tmp_path: Path) -> None:
    content = {"times": T, "positions": Q, "torques": TAU, "target_positions": Q + 1}
    np.savez(tmp_path / "run.npz", **content)
    savemat(tmp_path / "run.mat", {"log": {"t": T, "q": Q.T, "tau": TAU.T}})
    for name, position in (("run.npz", "positions"), ("run.mat", "log.q")):
        guess = guess_mapping(tmp_path / name, arm)
        assert guess.mapping.position.array == position
        (tmp_path / "out.mcap").unlink(missing_ok=True)
        np.testing.assert_array_equal(session(guess, tmp_path / name, tmp_path).joint.position, Q)


@pytest.mark.parametrize("one_a_joint", [False, True])
def test_a_folder_of_text_files(one_a_joint: bool, arm: Path, tmp_path: Path) -> None:
    folder = tmp_path / "run"
    folder.mkdir()
    np.savetxt(folder / "time.txt", T, fmt="%.17g")
    for name, values in (("joint_position_measured", Q), ("joint_torque", TAU)):
        for k in range(7 if one_a_joint else 0):
            np.savetxt(folder / f"{name}_{k}.txt", values[:, k], fmt="%.17g")
        if not one_a_joint:
            np.savetxt(folder / f"{name}.txt", values, fmt="%.17g", delimiter="\t")
    guess = guess_mapping(folder, arm)
    np.testing.assert_array_equal(session(guess, folder, tmp_path).joint.effort, TAU)


def test_currents_need_their_constant_and_gear(arm: Path, tmp_path: Path) -> None:
    names = ["t", *columns("q{k}"), *columns("current{k}")]
    path = write(tmp_path / "run.csv", names, T, Q, 1000 * TAU)
    with pytest.raises(DataError, match="is a current; give --torque-constant"):
        guess_mapping(path, arm)
    with pytest.raises(ConfigurationError, match="--gear-ratio has 2 numbers for 7 joints"):
        guess_mapping(path, arm, Known(torque_constant=(0.1,), gear_ratio=(1.0, 2.0)))
    guess = guess_mapping(path, arm, Known(torque_constant=(0.1,), gear_ratio=(100.0,)))
    motor = session(guess, path, tmp_path).motor
    assert motor is not None
    np.testing.assert_allclose(motor.effort, 10 * TAU)


@pytest.mark.parametrize(("torque", "channel"), [("joint", "joint_torque"), ("motor", "motor_torque")])
def test_the_side_of_a_plain_torque_is_the_users_word(
    torque: str, channel: str, arm: Path, tmp_path: Path
) -> None:
    path = write(tmp_path / "run.csv", ["t", *columns("q{k}"), *columns("tau{k}")], T, Q, TAU)
    assert set(guess_mapping(path, arm, Known(torque=torque)).mapping.signals) == {"position", channel}


def test_extra_columns_of_fingers_are_left_out(arm: Path, tmp_path: Path) -> None:
    joints = [*JOINTS, "panda_finger_joint1", "panda_finger_joint2"]
    names = ["time", *(f"{joint}.{what}" for what in ("position", "effort") for joint in joints)]
    path = write(tmp_path / "run.csv", names, T, np.hstack([Q, Q[:, :2]]), np.hstack([TAU, TAU[:, :2] * 0]))
    read = session(guess_mapping(path, arm), path, tmp_path)
    assert read.joint_names == JOINTS
    np.testing.assert_allclose(read.joint.effort, TAU, rtol=1e-10)


@pytest.mark.parametrize("size", [1.0, DEG])
def test_a_prismatic_finger_is_held_in_metres(size: float, arm: Path, tmp_path: Path) -> None:
    fingers = [f"panda_finger_joint{k}" for k in (1, 2)]
    names = ["t", *columns("{joint}_pos"), *(f"{name}_pos" for name in fingers), *columns("{joint}_effort")]
    open_ = np.full((N, 2), 0.02)
    path = write(tmp_path / "run.csv", names, T, size * Q, open_, TAU)
    guess = guess_mapping(path, arm, Known(joints=JOINTS))
    held = guess.mapping.held
    assert held
    assert set(held.values()) == {0.02}
    assert {row[2] for row in guess.rows if row[0] == "held"} == {"m"}


def test_joints_at_rest_are_held_where_they_rest(arm: Path, tmp_path: Path) -> None:
    kept = ("panda_joint2", "panda_joint4")
    moving = np.isin(PHASE, (1, 3))
    q = np.where(moving, Q, 0.1 * PHASE + 0.001 * np.sin(T[:, None]))
    path = write(tmp_path / "run.csv", ["t", *columns("q{k}"), *columns("tau{k}")], T, q, TAU)
    guess = guess_mapping(path, arm, Known(joints=kept))
    rests = {name: 0.1 * k for k, name in enumerate(JOINTS) if name not in kept}
    assert guess.mapping.held == pytest.approx(rests, abs=2e-3)
    read = session(guess, path, tmp_path)
    np.testing.assert_allclose(read.joint.effort, TAU[:, moving], rtol=1e-10)
    assert session_chain(read).joint_names == kept
    fixed = {name for name in JOINTS if f'name="{name}" type="fixed"' in str(session_chain(read).urdf)}
    assert fixed == set(rests)
    with pytest.raises(DataError, match=r"panda_joint4 moves by .* rad; name it in --joints"):
        guess_mapping(path, arm, Known(joints=kept[:1]))


@pytest.mark.parametrize(
    ("names", "blocks", "known", "message"),
    [
        (["t", *columns("a{k}")], (T, Q), {}, r"no position by its name. Found, .*a1 \.\.\. a7 \(7\)"),
        (["t", *columns("q{k}")], (T, Q), {}, "no torque by its name"),
        ([*columns("q{k}"), *columns("tau{k}")], (Q, TAU), {}, "give the rate of the samples with --rate-hz"),
        (["t", *columns("q{k}"), *columns("tau{k}")], (T, 6e3 * Q, TAU), {}, "outside the limits .*A motor's angle"),
        (["t", *columns("q{k}")[:6], *columns("tau{k}")], (T, Q[:, :6], TAU), {"joints": JOINTS}, "6 columns for"),
        (["t", *columns("q{k}"), *columns("tau{k}")], (T * 1e5, Q, TAU), {}, None),
        (["t", *columns("q{k}"), *columns("tau{k}")[:6]], (T, Q, TAU[:, :6]), {}, "6 columns of torque for 7"),
        (["t", *columns("q{k}"), *columns("dq{k}"), *columns("tau{k}")], (T[::-1], Q, QD, TAU), {}, "t go back in "),
        (["t", *columns("q{k}")[:6], *columns("tau{k}")[:6]], (T, Q[:, :6], TAU[:, :6]), {}, "no serial arms with 6"),
    ],
)  # fmt: skip
def test_what_cannot_be_told_is_said(
    names: list[str], blocks: Any, known: dict[str, Any], message: str | None, arm: Path, tmp_path: Path
) -> None:
    path = write(tmp_path / "run.csv", names, *blocks)
    if message is None:
        assert guess_mapping(path, arm, Known(**known)).mapping.time.unit == "us"
        return
    with pytest.raises((DataError, ConfigurationError), match=message):
        guess_mapping(path, arm, Known(**known))


def test_a_column_of_times_with_a_step_back_is_left_out_with_the_reason(arm: Path, tmp_path: Path) -> None:
    names = ["t", *columns("q{k}"), *columns("dq{k}"), *columns("tau{k}")]
    path = write(tmp_path / "run.csv", names, np.where(np.arange(N) < 50, T, T - 0.3), Q, QD, TAU)
    assert "; t goes back in row 50 (counted from 0) and is not used" in str(guess_mapping(path, arm))


@pytest.mark.parametrize(
    ("times", "said"),
    [
        (
            np.where(np.arange(N) == 80, T - 0.1, T),
            r"in 1 of 400 rows, first in row 80 \(counted from 0\), 0.22 after",
        ),
        (
            T[np.r_[:100, 90 : N - 10]],
            "in row 100 .*the time of row 90 again: remove the rows that repeat others",
        ),
    ],
    ids=["a stamp too early", "rows twice"],
)
def test_a_column_of_times_that_nearly_rises_is_named_with_the_row(
    times: np.ndarray, said: str, arm: Path, tmp_path: Path
) -> None:
    path = write(tmp_path / "run.csv", ["t", *columns("q{k}"), *columns("tau{k}")], times, Q, TAU)
    with pytest.raises(DataError, match=f"the times of t go back .*{said}.*--rate-hz"):
        guess_mapping(path, arm)


def test_a_time_twice_is_told_with_its_row(arm: Path, tmp_path: Path) -> None:
    times = np.where(np.arange(N) == 80, T[79], T)
    path = write(tmp_path / "run.csv", ["t", *columns("q{k}"), *columns("tau{k}")], times, Q, TAU)
    assert "equal times spread: 1 row, first row 80 (counted from 0)" in str(guess_mapping(path, arm))


@pytest.mark.parametrize(
    ("name", "quantity"),
    [
        ("actual_q_", "position"), ("target_q_", None), ("actual_current_", "current"), ("qDot", "velocity"),
        ("ddq", "acceleration"), ("tau_ext_hat_filtered", None), ("TorqueCur", "torque"),
        ("currentPosition", "position"), ("actual_TCP_speed_", None), ("joint_temperatures", None),
        ("efforts", "torque"), ("Achse  Ist", "position"), ("Achse  Soll", None), ("Moment ", "torque"),
        ("Achse  Istmoment", "torque"), ("Achse  Ist Drehmoment", "torque"), ("Achse  Strom", "current"),
        ("Gelenk  Geschwindigkeit", "velocity"), ("Achse ", None), ("angvel_", "velocity"), ("jointPos", "position"),
        ("motortorque_", "torque"), ("actvel", "velocity"), ("axis_spd_", "velocity"), ("T_mot J (Nm)", "torque"),
        ("J  [rad/s]", "velocity"), ("J (°)", "position"), ("J (°C)", None), ("J  [rad/s^2]", "acceleration"),
        ("T_d J (Nm)", None), ("qpos", "position"), ("jtau", "torque"), ("state.q[]", "position"),
    ],
)  # fmt: skip
def test_words_of_a_name(name: str, quantity: str | None) -> None:
    assert Field(name, ("",) * 3, np.zeros((2, 3))).quantity == quantity


def test_a_torque_of_one_motor_by_its_unit_is_no_time() -> None:
    one = Field("T_mot J (Nm)", ("1",), np.zeros((2, 1)))
    assert (one.quantity, one.of_motor) == ("torque", True)


def test_a_joint_in_a_name_is_found_whole() -> None:
    assert split_name("joint_10_pos", ["joint_1", "joint_10"]) == ("_pos", "joint_10")
    assert split_name("q12", ["joint_1"]) == ("q", "12")
    assert split_name("ddq3 [rad/s^2]", []) == ("ddq [rad/s^2]", "3")
    assert split_name("state.q[3]", []) == ("state.q[]", "3")
    assert split_name("J3 pos 16bit", []) == ("J pos 16bit", "3")
    assert split_name("T_mot J1 (Nm)", []) == ("T_mot J (Nm)", "1")
    assert split_name("PANDA_JOINT1.effort", JOINTS) == (".effort", "panda_joint1")


@pytest.mark.parametrize(
    ("pattern", "unit"),
    [
        ("tau{k}_mNm", "mNm"),
        ("tau_{k} [mNm]", "mNm"),
        ("tau_mNm_{k}", "mNm"),
        ("torque{k}(mN.m)", "mNm"),
        ("tau{k}_Nmm", "mNm"),
        ("effort_mnm_{k}", "mNm"),
        ("tau{k}_Nm", "Nm"),
        ("TauNm{k}", "Nm"),
        ("tau{k}", "Nm"),
    ],
)
def test_the_unit_of_a_torque_is_read_from_its_name(
    pattern: str, unit: str, arm: Path, tmp_path: Path
) -> None:
    size = 1e3 if unit == "mNm" else 1.0
    names = ["t", *columns("q{k}"), *columns(pattern)]
    path = write(tmp_path / "run.csv", names, T, Q, TAU * size)
    guess = guess_mapping(path, arm)
    assert guess.mapping.joint_torque is not None
    assert guess.mapping.joint_torque.unit == unit
    np.testing.assert_allclose(session(guess, path, tmp_path).joint.effort, TAU, rtol=1e-9)


def test_small_currents_in_milliamperes_are_known_by_their_name(arm: Path, tmp_path: Path) -> None:
    for pattern, unit in (("current_{k} [mA]", "mA"), ("current_{k} [A]", "A"), ("gammA_current_{k}", "A")):
        names = ["t", *columns("q{k}"), *columns(pattern)]
        path = write(tmp_path / "run.csv", names, T, Q, TAU)
        guess = guess_mapping(path, arm, Known(torque_constant=(0.1,), gear_ratio=(100.0,)))
        assert guess.mapping.motor_torque is not None
        assert guess.mapping.motor_torque.unit == unit


def test_a_velocity_left_out_is_followed_by_the_reason(arm: Path, tmp_path: Path) -> None:
    names = ["t", *columns("q{k}"), *columns("dq{k}"), *columns("tau{k}")]
    holed = QD.copy()
    holed[17, 3] = np.nan
    for rate, reason in (
        (holed, "missing values in 1 row, first in row 17"),
        (QD[::-1], "not dq/dt of the positions in any unit"),
    ):
        guess = guess_mapping(write(tmp_path / "run.csv", names, T, Q, rate, TAU), arm)
        assert guess.mapping.velocity is None
        assert guess.unused == (f"dq1 ... dq7 ({reason})",)
        assert f"not used: dq1 ... dq7 ({reason})" in str(guess)


def test_rows_without_a_position_or_a_time_do_not_keep_the_others_from_the_guess(
    arm: Path, tmp_path: Path
) -> None:
    names = ["t", *columns("q{k}"), *columns("dq{k}"), *columns("tau{k}")]
    q, t, qd = Q.copy(), T.copy(), QD.copy()
    q[5:300:7, 2] = t[11] = qd[13, 1] = np.nan
    path = write(tmp_path / "run.csv", names, t, q, qd, TAU)
    guess = guess_mapping(path, arm)
    assert guess.unused == ("dq1 ... dq7 (missing values in 1 row, first in row 13)",)
    report = import_log(guess.mapping, path, tmp_path / "x.mcap")
    (said,) = report.left_out
    assert "first row 5 (" in said
    whole = np.column_stack([T, Q, TAU])
    whole[5:300:7] = np.nan
    np.savetxt(tmp_path / "run.txt", whole)
    assert guess_mapping(tmp_path / "run.txt", arm).mapping.position.columns == tuple(range(2, 9))
    q[: len(q) // 2 + 1, 2] = np.nan
    with pytest.raises(
        DataError, match=r"q7 has missing values in \d+ rows of \d+, first in row 0; at most 50 %"
    ):
        guess_mapping(write(tmp_path / "run.csv", names, T, q, QD, TAU), arm)


def moving(arm: Path, tmp_path: Path, q: np.ndarray, qd: np.ndarray, t: np.ndarray = T) -> Guess:
    names = ["t", *columns("q{k}"), *columns("dq{k}"), *columns("tau{k}")]
    return guess_mapping(write(tmp_path / "run.csv", names, t, q, qd, TAU), arm)


def test_velocities_stay_beside_a_hole_a_jump_and_a_wrap(arm: Path, tmp_path: Path) -> None:
    jump, wrap = Q.copy(), Q.copy()
    jump[250:] += 0.7
    wrap[:, 6] = (Q[:, 6] + 3.0 + np.pi) % (2.0 * np.pi) - np.pi
    late = np.where(T > 0.8, T + 3.0, T)
    assert np.ptp(wrap[:, 6]) > 6.0
    for q, t in ((jump, T), (wrap, T), (Q, late)):
        guess = moving(arm, tmp_path, q, QD, t)
        assert guess.mapping.velocity is not None
        assert "1.00 times dq/dt" in str(guess)


@pytest.mark.parametrize("joint", [1, 3])
def test_a_position_in_another_unit_than_the_others_is_named(joint: int, arm: Path, tmp_path: Path) -> None:
    some = Q.copy()
    some[:, joint] *= DEG
    scale = ", ".join("0.0174533" if k == joint else "1" for k in range(7))
    with pytest.raises(DataError, match=f"{JOINTS[joint]} in deg, the other joints in rad.*") as error:
        moving(arm, tmp_path, some, QD)
    assert f"`unit: rad` and `scale: [{scale}]` in `position`" in str(error.value)
    others = Q * DEG
    others[:, joint] = Q[:, joint]
    with pytest.raises(DataError, match=f"{JOINTS[joint]} in rad, the other joints in deg"):
        moving(arm, tmp_path, others, QD)


@pytest.mark.parametrize("speeds", ["rad/s", "with the positions", "none"])
@pytest.mark.parametrize(("unit", "size"), [("rad", 1.0), ("deg", DEG)])
@pytest.mark.parametrize("mistake", ["sign", "order", "zero"])
def test_most_joints_tell_the_unit_and_one_beyond_its_limits_is_named(
    mistake: str, unit: str, size: float, speeds: str, arm: Path, tmp_path: Path
) -> None:
    # Elbow and third joint bend to one side only.
    text = arm.read_text()
    for name, limits in ((JOINTS[3], (-2.9, -0.1)), (JOINTS[1], (-1.0, 1.0))):
        first, found, rest = text.partition(f'name="{name}"')
        low, high = limits
        arm.write_text(
            first + found + rest.replace('lower="-2.9" upper="2.9"', f'lower="{low}" upper="{high}"', 1)
        )
        text = arm.read_text()
    true = Q.copy()
    true[:, 3] -= 1.5
    wrong = true.copy()
    if mistake == "sign":
        wrong[:, 3] *= -1.0
    elif mistake == "order":
        wrong[:, [1, 3]] = wrong[:, [3, 1]]
    else:
        wrong[:, 3] += np.pi
    names = ["t", *columns("q{k}"), *(columns("dq{k}") if speeds != "none" else []), *columns("tau{k}")]
    rates = [] if speeds == "none" else [QD * (1.0 if speeds == "rad/s" else size)]
    for q, odd in ((true, []), (wrong, [3] if mistake != "order" else [1, 3])):
        guess = guess_mapping(write(tmp_path / "run.csv", names, T, size * q, *rates, TAU), arm)
        assert guess.mapping.position.unit == unit
        (row,) = (row for row in guess.rows if row[0] == "position")
        _, _, outside = row[3].partition("outside its limits: ")
        assert [name for name in JOINTS if name in outside] == [JOINTS[k] for k in odd]


def test_degrees_of_an_arm_that_moves_few_joints_far_are_degrees(arm: Path, tmp_path: Path) -> None:
    q = np.where(np.isin(PHASE, (1, 3)), DEG, 1.0) * Q
    names = ["t", *columns("q{k}"), *columns("tau{k}")]
    guess = guess_mapping(write(tmp_path / "run.csv", names, T, q, TAU), arm)
    assert guess.mapping.position.unit == "deg"


def test_a_velocity_in_another_unit_than_the_others_is_left_out_with_the_reason(
    arm: Path, tmp_path: Path
) -> None:
    some = QD.copy()
    some[:, 2] *= DEG
    guess = moving(arm, tmp_path, Q, some)
    assert guess.mapping.velocity is None
    assert f"57.3 times as large over dq/dt at {JOINTS[2]} as at the others" in str(guess)
    some[:, 2] = 5.0 * np.random.default_rng(1).normal(size=N)
    assert f"not dq/dt of the positions in any unit, at {JOINTS[2]}" in str(moving(arm, tmp_path, Q, some))


def test_a_factor_of_all_velocities_alike_is_said(arm: Path, tmp_path: Path) -> None:
    said = "a clock or a scale is off"
    assert f"1.10 times dq/dt in this unit, in all joints: {said}" in str(moving(arm, tmp_path, Q, 1.1 * QD))
    spread = 1.0 + 0.05 * np.arange(7)
    for healthy in (QD, 1.02 * QD, spread * QD):
        assert said not in str(moving(arm, tmp_path, Q, healthy))


def test_a_rate_follows_from_velocities_in_degrees(arm: Path, tmp_path: Path) -> None:
    names = [*columns("q{k}"), *columns("dq{k}"), *columns("tau{k}")]
    guess = guess_mapping(write(tmp_path / "run.csv", names, DEG * Q, DEG * QD, TAU), arm)
    assert guess.mapping.time.rate_hz == RATE
    assert guess.mapping.velocity is not None
    assert guess.mapping.velocity.unit == "deg/s"
