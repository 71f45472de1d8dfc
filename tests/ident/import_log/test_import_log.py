from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from click.testing import CliRunner
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from fri.errors import ConfigurationError, DataError
from ident.dynamics.kinematics import Chain
from ident.dynamics.session_chain import session_chain
from ident.import_log import LogMapping, import_log
from ident.import_log.tables import read_text
from ident.rows.prepare import prepare
from lwr_driver.configuration import CONFIGS
from lwr_driver.session import read_session
from lwr_driver.session.summary import summarise
from runner.cli import main
from tests.ident.import_log.plain_logs import PLAIN, mapping, write_csv


def test_plain_columns_arrive_bit_for_bit(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    values = {name: rng.normal(size=50) for name in ("qa", "qb", "ta", "tb")}
    report = import_log(mapping(), write_csv(tmp_path, 50, **values), tmp_path / "x.mcap")
    session = read_session(report.path)
    np.testing.assert_array_equal(session.joint.position, np.column_stack([values["qa"], values["qb"]]))
    np.testing.assert_array_equal(session.joint.effort, np.column_stack([values["ta"], values["tb"]]))
    assert session.joint_names == ("a", "b")
    assert session.motor is None
    assert report.rows == {"/joint_states": 50}


def test_the_urdf_of_the_mapping_comes_with_the_session(tmp_path: Path) -> None:
    report = import_log(
        mapping(urdf="lwr4plus.urdf", joints=["A2", "E1"]), write_csv(tmp_path), tmp_path / "x.mcap"
    )
    session = read_session(report.path)
    assert session.robot_description is not None
    assert Chain.from_urdf(session.robot_description).n == 7
    assert session_chain(session).joint_names == ("A2", "E1")
    assert "A1 on the chain, without measurement, held at 0" in report.notes


@settings(max_examples=25, deadline=None)
@given(
    hnp.arrays(np.float64, (6, 2), elements=st.floats(-1e6, 1e6)),
    st.lists(st.floats(1e-4, 0.1), min_size=6, max_size=6),
)
def test_no_sample_and_no_time_is_lost_or_changed(
    tmp_path_factory: pytest.TempPathFactory, torque: np.ndarray, steps: list[float]
) -> None:
    folder = tmp_path_factory.mktemp("arm")
    times = np.cumsum(steps)
    write_csv(folder, 6, t=times, ta=torque[:, 0], tb=torque[:, 1])
    import_log(mapping(), folder, folder / "x.mcap")
    session = read_session(folder / "x.mcap")
    np.testing.assert_array_equal(session.joint.effort, torque)
    np.testing.assert_allclose(session.joint.log_time * 1e-9, times, rtol=0, atol=0.51e-9)


def test_degrees_signs_scales_and_offsets(tmp_path: Path) -> None:
    changed = mapping(
        position=PLAIN["position"] | {"unit": "deg", "sign": [1, -1]},
        joint_torque=PLAIN["joint_torque"] | {"unit": "mNm", "sign": -1, "scale": [2.0, 1.0]},
        offset_rad=[0.5, -0.25],
    )
    import_log(changed, write_csv(tmp_path, qa=[10.0] * 4, qb=[20.0] * 4, ta=[5e3] * 4), tmp_path / "x.mcap")
    session = read_session(tmp_path / "x.mcap")
    np.testing.assert_allclose(
        session.joint.position[0], [np.radians(10) + 0.5, np.radians(-20) - 0.25], rtol=1e-15
    )
    np.testing.assert_allclose(session.joint.effort[0], [-10.0, -3e-3], rtol=1e-15)


def test_motor_side_keeps_position_and_power_through_coupled_gears(tmp_path: Path) -> None:
    rng = np.random.default_rng(2)
    motor_torque, motor_position = rng.normal(size=(2, 30, 2))
    changed = mapping(
        position=PLAIN["position"] | {"side": "motor"},
        velocity=PLAIN["position"] | {"side": "motor", "unit": "rad/s"},
        motor_torque=PLAIN["joint_torque"] | {"side": "motor"},
        transmission={"reduction": [45, -32], "coupling": [{"motor": "b", "joint": "a", "ratio": 32}]},
        joint_torque=None,
    )
    write_csv(
        tmp_path,
        30,
        qa=motor_position[:, 0],
        qb=motor_position[:, 1],
        ta=motor_torque[:, 0],
        tb=motor_torque[:, 1],
    )
    import_log(changed, tmp_path, tmp_path / "x.mcap")
    session = read_session(tmp_path / "x.mcap")
    assert session.motor is not None
    q, tau = session.joint.position, session.motor.effort
    np.testing.assert_allclose(45 * q[:, 0], motor_position[:, 0], atol=1e-14)
    np.testing.assert_allclose(32 * q[:, 0] - 32 * q[:, 1], motor_position[:, 1], atol=1e-14)
    power = np.sum(tau * session.joint.velocity, axis=1)
    np.testing.assert_allclose(power, np.sum(motor_torque * motor_position, axis=1), rtol=1e-12, atol=1e-13)
    assert session.joint.effort.shape[1] == 0
    assert session.metadata["motor_torque_source"].startswith("import")


def test_npz_arrays_and_unix_times(tmp_path: Path) -> None:
    times = 1460034860.0 + np.cumsum([0.0, 0.0034, 0.0065, 0.005])
    q = np.arange(8.0).reshape(4, 2)
    np.savez(tmp_path / "run.npz", times=times, q=q, tau=q[:, ::-1])
    changed = mapping(
        time={"column": "times", "zero": "unix"},
        position={"array": "q", "unit": "rad"},
        joint_torque={"array": "tau", "columns": [2, 1], "unit": "Nm"},
    )
    report = import_log(changed, tmp_path / "run.npz", tmp_path / "x.mcap")
    session = read_session(tmp_path / "x.mcap")
    np.testing.assert_array_equal(session.joint.effort, q)
    assert session.metadata["utc_start"].startswith("2016-04-07T13:14:20")
    np.testing.assert_allclose(np.diff(session.joint.log_time) * 1e-9, np.diff(times), atol=2e-9)
    assert report.shortest_s < report.longest_s


def test_motor_channel_may_have_its_own_clock(tmp_path: Path) -> None:
    write_csv(tmp_path, 10)
    (tmp_path / "drive.txt").write_text("\n".join(f"{0.02 * k + 0.003} {k} {2 * k}" for k in range(5)))
    changed = mapping(
        motor_torque={
            "file": "drive.txt",
            "columns": [2, 3],
            "unit": "A",
            "scale": 0.5,
            "time": {"column": 1},
        },
        header=False,
        time={"column": 1, "file": "arm.csv"},
        position={"file": "arm.csv", "columns": [2, 3], "unit": "rad"},
        joint_torque={"file": "arm.csv", "columns": [4, 5], "unit": "Nm"},
    )
    text = (tmp_path / "arm.csv").read_text().split("\n", 1)[1]
    (tmp_path / "arm.csv").write_text(text)
    import_log(changed, tmp_path, tmp_path / "x.mcap")
    session = read_session(tmp_path / "x.mcap")
    assert session.motor is not None
    np.testing.assert_array_equal(session.motor.effort, [[0.5 * k, k] for k in range(5)])
    np.testing.assert_array_equal(session.motor.log_time, [20_000_000 * k + 3_000_000 for k in range(5)])


def test_the_same_recording_has_the_same_uid_and_other_rows_another(tmp_path: Path) -> None:
    write_csv(tmp_path, 20)
    whole = import_log(mapping(), tmp_path, tmp_path / "a.mcap")
    again = import_log(mapping(), tmp_path, tmp_path / "b.mcap")
    part = import_log(mapping(), tmp_path, tmp_path / "c.mcap", rows=(0, 10))
    assert whole.uid == again.uid != part.uid
    session = read_session(part.path)
    assert len(session.joint) == 10
    assert session.metadata["imported_rows"] == "0:10 of 20"


@pytest.mark.parametrize(
    ("columns", "message"),
    [
        (
            {"ta": ["1", "nan", "nan", ""]},
            r"3 of 4 rows \(75 %\) are without one of their values, first row 1 \(`joint_torque` of a\); at most 50 %",
        ),
        ({"qa": ["1", "x", "1", "1"]}, "line 3, column 'qa' holds 'x'"),
        ({"t": [0.0, 0.2, 0.1, 0.3]}, "time 0.1 s in row 2 follows 0.2 s"),
        ({"t": [0.0, 0.1, 0.1, 0.3]}, "times must increase"),
        ({"t": ["0", "nan", "", "NA"]}, r"3 of 4 rows \(75 %\).*\(the time of `position`, the time of"),
    ],
)
def test_bad_rows_are_named(tmp_path: Path, columns: dict[str, Any], message: str) -> None:
    write_csv(tmp_path, 4, **columns)
    with pytest.raises(DataError, match=message):
        import_log(mapping(), tmp_path, tmp_path / "x.mcap")
    assert not (tmp_path / "x.mcap").exists()


def test_rows_without_a_value_are_left_out_of_their_topic_and_told(tmp_path: Path) -> None:
    number = np.arange(12.0)
    texts = {name: [f"{value:g}" for value in number] for name in ("t", "qa", "qb", "ta", "tb")}
    texts["qb"][3], texts["ta"][4], texts["ta"][7], texts["tb"][3], texts["t"][9] = "nan", "", "NA", "inf", ""
    write_csv(tmp_path, 12, **texts)
    write_csv(tmp_path, 12, name="drive.csv", tb=[*texts["tb"][4:], "", "", "1", "2"])
    drive = {
        "file": "drive.csv",
        "columns": ["ta", "tb"],
        "unit": "Nm",
        "time": {"column": "t", "file": "drive.csv"},
    }
    report = import_log(mapping(motor_torque=drive), tmp_path, tmp_path / "x.mcap", rows=(1, 12))
    session = read_session(report.path)
    kept = [1, 2, 5, 6, 8, 10, 11]
    np.testing.assert_array_equal(session.joint.log_time * 1e-9, kept)
    np.testing.assert_array_equal(session.joint.position[:, 1], kept)
    np.testing.assert_array_equal(session.joint.effort[:, 0], kept)
    assert session.motor is not None
    assert len(session.motor) == 9
    joint, motor = report.left_out
    assert joint.startswith("4 of 11 rows (36.4 %) without one of their values, first row 3 (")
    assert "(`position` of b, `joint_torque`, the time of `position`, the time of `joint_torque`)" in joint
    assert motor.startswith(
        "2 of 11 rows (18.2 %) without one of their values, first row 8 (`motor_torque` of b)"
    )
    assert f"  left out  {joint}\n" in str(report)


def test_an_empty_last_cell_is_a_missing_value_in_any_table(tmp_path: Path) -> None:
    for mark in (",", ";", "\t"):
        rows = [f"{k}{mark}{mark}{k}" for k in range(3)] + [f"{k}{mark}{k}{mark}" for k in range(3)]
        for count in (1, 60_000):
            (tmp_path / "a.csv").write_text("\n".join([f"a{mark}b{mark}c", *(rows * count)]) + "\n")
            values = read_text(tmp_path / "a.csv").values
            np.testing.assert_array_equal(np.isnan(values).sum(axis=0), [0, 3 * count, 3 * count])


def test_a_short_row_is_an_error(tmp_path: Path) -> None:
    write_csv(tmp_path)
    (tmp_path / "arm.csv").write_text((tmp_path / "arm.csv").read_text() + "0.5,1,2\n")
    with pytest.raises(DataError, match="line 6 has 3 columns, the first has 5"):
        import_log(mapping(), tmp_path, tmp_path / "x.mcap")


def test_channels_of_unequal_length_are_an_error(tmp_path: Path) -> None:
    write_csv(tmp_path, 5)
    write_csv(tmp_path, 4, name="torque.csv")
    changed = mapping(joint_torque=PLAIN["joint_torque"] | {"file": "torque.csv"})
    with pytest.raises(DataError, match="4 rows, its time column 't' has 5"):
        import_log(changed, tmp_path, tmp_path / "x.mcap")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"joint_torque": None}, "no torque"),
        ({"offset_rad": [1.0]}, "1 entries for 2 joints"),
        ({"position": PLAIN["position"] | {"unit": "Nm"}}, "cannot have the unit"),
        ({"position": PLAIN["position"] | {"side": "motor"}}, "give `transmission: {reduction"),
        ({"position": PLAIN["position"] | {"sign": [1, 2]}}, "is outside -1 to 1"),
        ({"position": PLAIN["position"] | {"unit": "counts"}}, "needs? `scale`|give `scale`"),
        ({"position": PLAIN["position"] | {"columns": ["qa"]}}, "1 `columns` for 2 joints"),
        ({"time": {"column": "t", "rate_hz": 10}}, "and not both"),
        ({"transmission": {"reduction": [0, 1]}}, "no inverse"),
        ({"transmission": {"reduction": [1]}}, "1 entries for 2 joints"),
        (
            {
                "transmission": {
                    "reduction": [1, 1],
                    "coupling": [{"motor": "x", "joint": "a", "ratio": 1}],
                }
            },
            "names joint 'x'",
        ),
        ({"positon": 1}, "did you mean `position`"),
    ],
)
def test_a_mapping_that_makes_no_sense_is_refused(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigurationError, match=message):
        mapping(**changes)


def test_lost_samples_are_counted_in_the_report(tmp_path: Path) -> None:
    times = np.delete(np.arange(20) * 0.01, [5, 6, 12])
    report = import_log(mapping(), write_csv(tmp_path, 17, t=times), tmp_path / "x.mcap")
    assert (report.holes, report.lost) == (2, 3)
    assert "  lost      3 samples; 2 intervals are longer than 1.75 periods\n" in str(report)
    assert "kept as recorded" in str(report)


@pytest.mark.parametrize("jitter", [0.0, 0.3])
def test_an_import_counts_lost_and_old_samples_as_an_estimate_does(tmp_path: Path, jitter: float) -> None:
    rng = np.random.default_rng(3)
    number = np.delete(np.arange(4000), rng.choice(4000, 200, replace=False))
    old = rng.choice(len(number) - 10, 100, replace=False) + 5
    number[old] = number[old - 1]  # a late sample is read twice
    time = number * 2e-3
    columns = {"qa": np.sin(time), "qb": np.cos(1.3 * time), "ta": np.sin(2 * time), "tb": np.cos(time)}
    stamps = np.delete(np.arange(4000), rng.choice(4000, 200, replace=False)) * 2e-3
    stamps = np.sort(stamps + jitter * 2e-3 * rng.uniform(size=len(stamps)))
    report = import_log(
        mapping(), write_csv(tmp_path, len(stamps), t=stamps, **columns), tmp_path / "out.mcap"
    )
    counts = prepare(read_session(tmp_path / "out.mcap"), motor=False, log=False).counts
    assert (report.lost, report.old) == (counts["lost"], counts["stale"])
    assert report.old > 50
    assert f"  lost      {report.lost} samples" in str(report)
    # An import counts its rows, not the samples of the source.
    topics = str(summarise(read_session(tmp_path / "out.mcap")).topics())
    assert f"{report.lost}" not in topics
    assert re.search(r"/joint_states +\d+ +[\d.]+ +- ", topics)


def test_missing_column_and_missing_file_name_what_there_is(tmp_path: Path) -> None:
    write_csv(tmp_path)
    with pytest.raises(DataError, match="no column 'qz'; it has t, qa, qb, ta, tb"):
        import_log(
            mapping(position=PLAIN["position"] | {"columns": ["qa", "qz"]}), tmp_path, tmp_path / "x.mcap"
        )
    with pytest.raises(DataError, match="no such file; the mapping needs it"):
        import_log(mapping(position=PLAIN["position"] | {"file": "no.csv"}), tmp_path, tmp_path / "x.mcap")


def test_command_imports_and_reports(tmp_path: Path) -> None:
    write_csv(tmp_path, 20)
    (tmp_path / "map.yaml").write_text(yaml.safe_dump(PLAIN))
    arguments = [str(tmp_path / "map.yaml"), str(tmp_path), str(tmp_path / "x.mcap")]
    result = CliRunner().invoke(main, ["import", *arguments, "--payload", "flange", "--payload-mass", "1.5"])
    assert result.exit_code == 0, result.output
    assert "/joint_states 20 (recording: 20)" in result.output
    session = read_session(tmp_path / "x.mcap")
    assert (session.metadata["payload"], session.metadata["payload_mass"]) == ("flange", "1.5")
    assert "mapping.yaml" in session.attachments


@pytest.mark.parametrize("command", [["diagnose", "--out", "found"], ["validate", "model.yaml"]])
def test_other_commands_point_to_the_import_of_a_table(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, command: list[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("data.csv").write_text("t,q1,tau1\n0,1,2\n")
    Path("model.yaml").write_text(
        (CONFIGS.parent / "tests" / "hidden_physics" / "reference.yaml").read_text()
    )
    result = CliRunner().invoke(main, [*command, "data.csv"])
    assert result.exit_code == 7
    assert "`lwr-run import MAPPING data.csv data.mcap`" in result.output
    assert not Path("found").exists()


@pytest.mark.parametrize("path", sorted((CONFIGS / "imports").glob("*.yaml")), ids=lambda path: path.stem)
def test_shipped_mappings_parse(path: Path) -> None:
    assert LogMapping.load(path.stem).robot


def test_an_angle_that_wraps_is_unwrapped_and_a_jump_is_told(tmp_path: Path) -> None:
    time = np.arange(600) * 0.01
    turning, zeroed = 3.0 + np.sin(time), np.cos(time)
    wrapped = (turning + np.pi) % (2.0 * np.pi) - np.pi
    zeroed[400:] += 0.8
    source = write_csv(tmp_path, 600, qa=wrapped, qb=zeroed)
    report = import_log(mapping(), source, tmp_path / "out.mcap")
    position = read_session(tmp_path / "out.mcap").joint.position
    np.testing.assert_allclose(position[:, 0], turning, atol=1e-12)
    np.testing.assert_array_equal(position[:, 1], zeroed)
    behind = 0.01 * (1 + int(np.argmax(np.abs(np.diff(wrapped)) > 3.0)))
    assert report.unwrapped == (
        f"position of a: 2 steps of 360 deg in one sample taken back, first at {behind:.4g} s",
    )
    assert f"  unwrapped {report.unwrapped[0]}\n" in str(report)
    assert any(
        note.startswith("b position: jumps by 0.808 rad in one sample at 4 s") for note in report.notes
    )
