"""Recordings as other people keep them: bags, MATLAB files, one value a line, currents, uneven clocks."""

from __future__ import annotations

import bz2
import gzip
import lzma
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from click.testing import CliRunner
from mcap_ros2.writer import Writer
from scipy.io import savemat

from fri.errors import ConfigurationError, DataError
from ident.import_log import LogMapping, import_log, tables
from ident.import_log.bag import read_bag
from ident.import_log.direct import bag_mapping
from ident.import_log.fields import fields
from ident.import_log.recording import Recording
from ident.import_log.tables import read_text
from lwr_driver.configuration import parse
from lwr_driver.session import read_session
from lwr_driver.session.messages import JOINT_STATE, STRING
from runner.cli import main
from tests.ident.import_log.plain_logs import PLAIN, mapping, write_csv
from tests.ident.stock_panda import JOINTS, stock_panda

N = 40
SINE = np.column_stack([np.sin(0.1 * np.arange(N) + k) for k in range(2)])


def imported(folder: Path, source: Path, changed: LogMapping):
    report = import_log(changed, source, folder / "x.mcap")
    return report, read_session(report.path)


@pytest.mark.parametrize(("unit", "size"), [("A", 1.0), ("mA", 1e-3)])
def test_currents_become_torques_by_constant_gear_and_sign(tmp_path: Path, unit: str, size: float) -> None:
    changed = mapping(
        joint_torque=None,
        motor_torque=PLAIN["joint_torque"] | {"unit": unit, "torque_constant": [0.05, 0.1], "sign": [1, -1]},
        transmission={"reduction": [100, -50]},
    )
    _, session = imported(tmp_path, write_csv(tmp_path, ta=[2.0] * 4, tb=[3.0] * 4), changed)
    assert session.motor is not None
    np.testing.assert_allclose(
        session.motor.effort[0], [2 * size * 0.05 * 100, 3 * size * 0.1 * 50], rtol=1e-14
    )


@pytest.mark.parametrize(
    ("torque", "message"),
    [
        ({"unit": "mA"}, "unit `mA` has no size of its own; give `torque_constant`"),
        ({"unit": "Nm", "torque_constant": 0.1}, "goes with a current, and the unit is `Nm`"),
        ({"unit": "A", "torque_constant": 0.1, "side": "joint"}, "is the motor's, before the gear"),
        ({"unit": "A", "torque_constant": 0.1}, "give `transmission"),
        ({"unit": "A", "torque_constant": 0.0}, "`torque_constant` is 0"),
        ({"unit": "rad"}, "cannot have the unit `rad`; use one of Nm, mNm, N, A, mA"),
        ({"unit": "NM"}, "'NM' is not one of .*did you mean `Nm`"),
        ({"unit": "Nm", "file": ["a.txt"]}, "1 files in `file` for 2 joints"),
    ],
)
def test_currents_without_size_and_unknown_units_are_refused(torque: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigurationError, match=message):
        mapping(joint_torque=None, motor_torque=torque)


def matlab(folder: Path, **content: Any) -> tuple[Path, LogMapping]:
    savemat(folder / "run.mat", content)
    return folder / "run.mat", mapping(
        time={"column": "log.t"},
        position={"array": "log.q", "unit": "rad"},
        joint_torque={"array": "tau", "unit": "Nm"},
    )


@pytest.mark.parametrize("rows_are_joints", [False, True])
def test_matlab_structures_are_read_by_name(tmp_path: Path, rows_are_joints: bool) -> None:
    q = SINE.T if rows_are_joints else SINE
    path, changed = matlab(tmp_path, log={"t": np.arange(N) * 0.004, "q": q, "name": "x"}, tau=2 * SINE)
    report, session = imported(tmp_path, path, changed)
    np.testing.assert_array_equal(session.joint.position, SINE)
    np.testing.assert_array_equal(session.joint.effort, 2 * SINE)
    assert any("transposed" in note for note in report.notes) == rows_are_joints


def test_a_matlab_file_of_version_7_3_is_refused_with_advice(tmp_path: Path) -> None:
    path, changed = matlab(tmp_path)
    path.write_bytes(b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM" + bytes(512))
    with pytest.raises(
        DataError, match=r"version 7.3 \(HDF5\); save it again with `save\('run.mat', '-v7'\)`"
    ):
        import_log(changed, path, tmp_path / "x.mcap")
    path.write_bytes(b"no such thing")
    with pytest.raises(DataError, match="not a readable MATLAB file"):
        import_log(changed, path, tmp_path / "x.mcap")


def test_a_file_for_each_joint_with_one_value_a_line(tmp_path: Path) -> None:
    for name, values in (("q", SINE), ("tau", 3 * SINE)):
        for k in range(2):
            np.savetxt(tmp_path / f"{name}{k + 1}.txt", values[:, k], fmt="%.17g")
    np.savetxt(tmp_path / "time.txt", np.arange(N) * 5.0)
    changed = mapping(
        time={"column": 1, "file": "time.txt", "unit": "ms"},
        position={"file": ["q1.txt", "q2.txt"], "unit": "rad"},
        joint_torque={"file": ["tau1.txt", "tau2.txt"], "unit": "Nm"},
    )
    report, session = imported(tmp_path, tmp_path, changed)
    np.testing.assert_array_equal(session.joint.position, SINE)
    assert report.period_s == pytest.approx(0.005)
    np.savetxt(tmp_path / "q2.txt", SINE[1:, 1])
    with pytest.raises(DataError, match=r"q2\.txt: 39 values, q1\.txt has 40; the recording is not whole"):
        import_log(changed, tmp_path, tmp_path / "y.mcap")


@pytest.mark.parametrize(
    ("text", "names", "first"),
    [
        ("a,b\n1,2\n", ("a", "b"), [1, 2]),
        ("# a b\n1 2\n3 4\n", ("a", "b"), [1, 2]),
        ("% made by hand, on a day\n1\t2\t\n", ("1", "2"), [1, 2]),
        ("a;b\n0,5;-1,25e1\n", ("a", "b"), [0.5, -12.5]),
        ("1.5\n2.5\n", ("1",), [1.5]),
        ("q [\u00b0],b\nrad,Nm\n1,2\n", ("q [\u00b0]", "b"), [1, 2]),
    ],
)
def test_text_tables_of_every_habit(
    tmp_path: Path, text: str, names: tuple[str, ...], first: list[float]
) -> None:
    for encoding in ("utf-8", "utf-8-sig", "cp1252", "utf-16"):
        (tmp_path / "a.txt").write_text(text, encoding=encoding)
        table = read_text(tmp_path / "a.txt")
        assert table.names == names
        assert table.values[0].tolist() == first


@pytest.mark.parametrize(("pack", "suffix"), [(gzip, ".gz"), (bz2, ".bz2"), (lzma, ".xz"), (gzip, "")])
@pytest.mark.parametrize("rows", [3, 200_000])
def test_compressed_text_is_read_as_it_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, pack: Any, suffix: str, rows: int
) -> None:
    path = tmp_path / f"a.csv{suffix}"
    path.write_bytes(pack.compress(b"a,b\n" + b"1.5,-2\n" * rows))
    if rows > 3:
        # A long one in batches, never whole.
        monkeypatch.setattr(tables, "_lines", None)
    table = read_text(path)
    assert table.names == ("a", "b")
    np.testing.assert_array_equal(table.values, [[1.5, -2.0]] * rows)


def test_a_folder_of_compressed_text_is_a_recording_and_half_a_file_none(tmp_path: Path) -> None:
    write_csv(tmp_path)
    plain = tmp_path / "arm.csv"
    packed = tmp_path / "arm.csv.gz"
    packed.write_bytes(gzip.compress(plain.read_bytes()))
    plain.unlink()
    assert {one.shown for one in fields(Recording(tmp_path), ())} >= {"arm.csv.gz qa", "arm.csv.gz t"}
    packed.write_bytes(packed.read_bytes()[:-20])
    with pytest.raises(DataError, match=r"arm\.csv\.gz: not readable as text: Compressed file ended"):
        read_text(packed)


def test_a_column_of_words_does_not_keep_the_others_from_being_read(tmp_path: Path) -> None:
    write_csv(tmp_path, mode=["run", "run", "stop", "run"])
    _, session = imported(tmp_path, tmp_path, mapping())
    assert len(session.joint) == 4
    with pytest.raises(DataError, match=r"100 %.*`position` of b"):
        import_log(
            mapping(position=PLAIN["position"] | {"columns": ["qa", "mode"]}), tmp_path, tmp_path / "y.mcap"
        )


@pytest.mark.parametrize("start", [-0.007, -1.0, -3.0e-9])
def test_a_clock_that_begins_below_zero_is_moved_and_said_so(tmp_path: Path, start: float) -> None:
    report, session = imported(tmp_path, write_csv(tmp_path, t=start + np.arange(4) * 0.01), mapping())
    np.testing.assert_allclose(session.joint.log_time * 1e-9, np.arange(4) * 0.01, atol=2e-9)
    assert any(f"begins at {start:.9g} s; all times moved" in note for note in report.notes)


def test_channels_of_one_clock_move_together(tmp_path: Path) -> None:
    write_csv(tmp_path, t=-0.007 + np.arange(4) * 0.01)
    write_csv(tmp_path, t=-0.004 + np.arange(4) * 0.01, name="drive.csv")
    motor = PLAIN["joint_torque"] | {"file": "drive.csv", "time": {"column": "t", "file": "drive.csv"}}
    _, session = imported(tmp_path, tmp_path, mapping(motor_torque=motor))
    assert session.motor is not None
    assert session.joint.log_time[0] == 0
    assert session.motor.log_time[0] == pytest.approx(3_000_000, abs=1)


def test_repeated_samples_are_kept_and_counted(tmp_path: Path) -> None:
    kept = np.repeat(np.arange(5.0), 2)
    times = np.cumsum([0.0, 1.7, 1.2, 0.1, 0.9, 1.0, 1.1, 2.0, 0.3, 1.0]) * 1e-3
    columns = dict.fromkeys(("qa", "qb", "ta", "tb"), kept)
    report, session = imported(tmp_path, write_csv(tmp_path, 10, t=times, **columns), mapping())
    np.testing.assert_array_equal(session.joint.position[:, 0], kept)
    assert report.repeated == 5
    assert "5 samples (50 %) equal to the one before, kept as they are" in str(report)


def test_rows_of_an_arm_polled_too_fast_are_taken_once(tmp_path: Path) -> None:
    kept = np.repeat(np.arange(60.0), 2)
    columns = dict.fromkeys(("qa", "qb", "ta", "tb"), kept)
    times = np.arange(120) * 0.01
    report, session = imported(tmp_path, write_csv(tmp_path, 120, t=times, **columns), mapping())
    np.testing.assert_array_equal(session.joint.position[:, 0], np.arange(60.0))
    np.testing.assert_allclose(session.joint.log_time * 1e-9, times[::2], atol=2e-9)
    assert report.repeated == 0
    assert "60 of 120 rows repeat the one before evenly: recorded at 100 Hz from an arm that" in str(report)


def test_an_arm_at_rest_keeps_its_rows(tmp_path: Path) -> None:
    still = np.concatenate([np.zeros(60), np.arange(60.0)])
    columns = dict.fromkeys(("qa", "qb", "ta", "tb"), still)
    report, session = imported(
        tmp_path, write_csv(tmp_path, 120, t=np.arange(120) * 0.01, **columns), mapping()
    )
    assert (len(session.joint.position), report.repeated) == (120, 60)


def test_equal_stamps_are_refused_with_advice_or_spread_on_request(tmp_path: Path) -> None:
    write_csv(tmp_path, 6, t=[0.0, 0.001, 0.001, 0.001, 0.002, 0.002])
    with pytest.raises(DataError, match="set `equal: spread` in `time` if the clock has coarse steps"):
        import_log(mapping(), tmp_path, tmp_path / "x.mcap")
    report, session = imported(tmp_path, tmp_path, mapping(time=PLAIN["time"] | {"equal": "spread"}))
    expected = [0, 1_000_000, 1_333_333, 1_666_666, 2_000_000, 2_500_000]
    assert session.joint.log_time.tolist() == expected
    assert any(re.fullmatch(r"position +3 samples share the time .*", note) for note in report.notes)


def test_rounded_stamps_of_even_samples_give_even_times_unless_samples_are_lost(tmp_path: Path) -> None:
    spread, even = mapping(time=PLAIN["time"] | {"equal": "spread"}), np.arange(400) * 5e-3
    report, session = imported(tmp_path, write_csv(tmp_path, 400, t=np.round(even, 2)), spread)
    np.testing.assert_allclose(np.diff(session.joint.log_time), 5e6, atol=2e4)
    assert report.holes == 0
    assert any("5 ms apart: the stamps are rounded to 10 ms" in note for note in report.notes)
    gap = np.delete(even, slice(200, 240))
    (tmp_path / "gap").mkdir()
    report, session = imported(tmp_path / "gap", write_csv(tmp_path / "gap", 360, t=np.round(gap, 2)), spread)
    assert np.diff(session.joint.log_time).max() > 0.15e9
    assert not any("rounded" in note for note in report.notes)


@pytest.mark.parametrize(
    ("step", "hint"), [(10.0, "is the `unit` of `time` `ms`?"), (5.0, "`ms`"), (0.002, "")]
)
def test_milliseconds_taken_as_seconds_are_pointed_out(tmp_path: Path, step: float, hint: str) -> None:
    report, _ = imported(tmp_path, write_csv(tmp_path, t=np.arange(4) * step), mapping())
    assert [hint in note for note in report.notes if "apart" in note] == ([True] if hint else [])


@pytest.mark.parametrize("rate", [50.0, 333.0, 1000.0, 5000.0])
def test_any_rate_is_kept(tmp_path: Path, rate: float) -> None:
    report, _ = imported(tmp_path, write_csv(tmp_path, 50, t=np.arange(50) / rate), mapping())
    assert report.period_s == pytest.approx(1 / rate)
    assert not any("apart" in note for note in report.notes)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"joints": ["panda_joint1", "panda_jiont2"]},
            "no joint 'panda_jiont2'; did you mean 'panda_joint2'",
        ),
        (
            {"joints": list(JOINTS[:2]), "tip": "panda_hnad"},
            "no link 'panda_hnad'; did you mean 'panda_hand'",
        ),
        ({"joints": list(JOINTS[:2]), "base": "panda_link5"}, "is not on the chain|does not hang on"),
    ],
)
def test_names_unknown_to_the_urdf_are_refused_at_import(
    tmp_path: Path, changes: dict[str, Any], message: str
) -> None:
    (tmp_path / "panda.urdf").write_text(stock_panda())
    with pytest.raises(ConfigurationError, match=message):
        import_log(
            mapping(urdf="panda.urdf", **changes), write_csv(tmp_path), tmp_path / "x.mcap", beside=tmp_path
        )
    assert not (tmp_path / "x.mcap").exists()


def test_base_and_tip_go_with_the_session(tmp_path: Path) -> None:
    changed = mapping(joints=list(JOINTS[:2]), base="panda_link0", tip="panda_hand")
    report = import_log(changed, write_csv(tmp_path), tmp_path / "x.mcap", urdf=stock_panda())
    metadata = read_session(report.path).metadata
    assert (metadata["base"], metadata["tip"]) == ("panda_link0", "panda_hand")
    assert any("panda_joint3" in note and "held at 0" in note for note in report.notes)


def write_bag(
    path: Path, *, interleaved: bool = True, stamped: bool = True, split: int | None = None
) -> None:
    """A bag of seven arm joints, the order of names changing, with fingers from a second publisher."""
    with path.open("wb") as file:
        writer = Writer(file)
        state = writer.register_msgdef(JOINT_STATE.name, JOINT_STATE.text)
        text = writer.register_msgdef(STRING.name, STRING.text)
        writer.write_message("/robot_description", text, {"data": stock_panda()}, log_time=1, publish_time=1)
        random = np.random.default_rng(5)
        for k in range(N):
            order = random.permutation(7) if interleaved else np.arange(7)
            measured = 1_700_000_000 * 10**9 + k * 4_000_000
            header = {"stamp": {"sec": 0, "nanosec": 0}, "frame_id": ""}
            if stamped:
                header["stamp"] = {"sec": measured // 10**9, "nanosec": measured % 10**9}
            content = {
                "header": header,
                "name": [JOINTS[i] for i in order],
                "position": [float(np.sin(0.1 * k + i)) for i in order],
                "velocity": [float(i) for i in order],
                "effort": [float(10 * i + k) for i in order],
            }
            received = measured + int(random.integers(10**5, 10**6))
            writer.write_message("/joint_states", state, content, log_time=received, publish_time=received)
            fingers = content | {"name": ["f1", "f2"], "position": [0.0, 0.0], "velocity": [], "effort": []}
            writer.write_message(
                "/joint_states", state, fingers, log_time=received + 5, publish_time=received + 5
            )
        writer.finish()


def test_a_bag_is_read_by_the_names_in_each_message(tmp_path: Path) -> None:
    write_bag(tmp_path / "bag.mcap")
    bag = read_bag(tmp_path / "bag.mcap")
    arm, fingers = bag.states
    assert arm.names == JOINTS
    np.testing.assert_allclose(arm.values["position"], np.sin(0.1 * np.arange(N)[:, None] + np.arange(7)))
    np.testing.assert_array_equal(arm.values["effort"], 10 * np.arange(7) + np.arange(N)[:, None])
    assert arm.clock == "stamp"
    assert (fingers.names, tuple(fingers.values)) == (("f1", "f2"), ("position",))
    assert bag.robot_description == stock_panda()


def test_a_joint_of_a_bag_stays_with_half_of_its_values(tmp_path: Path) -> None:
    write_bag(tmp_path / "bag.mcap")
    bag = read_bag(tmp_path / "bag.mcap")
    values = {name: own.copy() for name, own in bag.states[0].values.items()}
    values["position"][: N // 2, 1] = values["effort"][: N // 2 + 1, 3] = np.nan
    holed = replace(bag, states=(replace(bag.states[0], values=values),))
    assert bag_mapping(holed).joints == tuple(name for k, name in enumerate(JOINTS) if k != 3)


def test_a_bag_is_imported_through_a_mapping(tmp_path: Path) -> None:
    write_bag(tmp_path / "bag.mcap")
    changed = parse(
        LogMapping,
        yaml.safe_load("""
            robot: Panda
            joints: [panda_joint2, panda_joint4]
            time: {column: /joint_states/stamp, zero: unix}
            position: {array: /joint_states/position, unit: rad}
            joint_torque: {array: /joint_states/effort, unit: Nm}
        """),
        "mapping",
    )
    report, session = imported(tmp_path, tmp_path / "bag.mcap", changed)
    np.testing.assert_array_equal(session.joint.effort[3], [13.0, 33.0])
    assert report.period_s == pytest.approx(0.004, abs=3e-7)
    assert session.joint.log_time[0] == pytest.approx(1_700_000_000 * 10**9, abs=300)


def test_a_bag_without_stamps_has_the_time_of_its_recorder(tmp_path: Path) -> None:
    write_bag(tmp_path / "bag.mcap", stamped=False)
    assert read_bag(tmp_path / "bag.mcap").states[0].clock == "log_time"
    with (tmp_path / "none.mcap").open("wb") as file:
        writer = Writer(file)
        text = writer.register_msgdef(STRING.name, STRING.text)
        writer.write_message("/note", text, {"data": "x"}, log_time=1, publish_time=1)
        writer.finish()
    with pytest.raises(
        DataError, match=r"no messages of sensor_msgs/JointState .*; topics: /note \(std_msgs/msg/String\)"
    ):
        read_bag(tmp_path / "none.mcap")


def test_the_command_takes_urdf_base_and_tip(tmp_path: Path) -> None:
    (tmp_path / "panda.urdf").write_text(stock_panda())
    (tmp_path / "map.yaml").write_text(yaml.safe_dump(PLAIN | {"joints": list(JOINTS[:2])}))
    words = [
        "import",
        tmp_path / "map.yaml",
        write_csv(tmp_path),
        tmp_path / "x.mcap",
        "--urdf",
        tmp_path / "panda.urdf",
    ]
    refused = CliRunner().invoke(main, [*map(str, words), "--tip", "panda_hnad"])
    assert refused.exit_code == 2
    assert "did you mean 'panda_hand'?" in refused.output
    done = CliRunner().invoke(main, [*map(str, words), "--tip", "panda_hand", "--base", "panda_link0"])
    assert done.exit_code == 0, done.output
    assert read_session(tmp_path / "x.mcap").robot_description == stock_panda()
