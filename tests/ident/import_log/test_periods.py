"""Periods of the excitation, found in positions or marked by the mapping."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from fri.errors import ConfigurationError, DataError
from ident.import_log import LogMapping, Periods, find_periods, import_log
from ident.rows.filters import SignalSettings
from ident.rows.prepare import prepare
from lwr_driver.configuration import parse
from lwr_driver.session import read_session

Floats = NDArray[np.float64]

PERIOD_S = 8.0
APPROACH_S = 3.0


def course(time: Floats) -> Floats:
    """A smooth motion of three joints with a period, at rest at its ends."""
    phase = 2.0 * np.pi * time / PERIOD_S
    first = np.sin(phase) - 0.5 * np.sin(2.0 * phase)
    second = 0.6 * (np.cos(phase) - np.cos(3.0 * phase))
    third = 0.4 * (np.cos(2.0 * phase) - np.cos(phase)) + 0.2 * (np.sin(phase) - np.sin(5.0 * phase) / 5.0)
    return np.column_stack([first, second, third])


def motion(periods: float, rate_hz: float, *, approach: bool = True) -> tuple[Floats, Floats]:
    """Approach, whole or broken periods, and the way back."""
    lead = APPROACH_S if approach else 0.0
    time = np.arange(round((2.0 * lead + periods * PERIOD_S) * rate_hz)) / rate_hz
    away = np.clip(np.maximum(lead - time, time - lead - periods * PERIOD_S) / max(lead, 1e-9), 0.0, 1.0)
    inside = np.clip(time - lead, 0.0, periods * PERIOD_S)
    offset = np.array([0.5, -0.3, 0.7]) * (away**2 * (3.0 - 2.0 * away))[:, None]
    return time, course(inside) + offset


def close(found: Periods | None, count: int, slack_s: float = 0.1) -> bool:
    return (
        found is not None
        and found.count == count
        and abs(found.period_s - PERIOD_S) < 1e-3
        and abs(found.start_s - APPROACH_S) < slack_s
    )


@pytest.mark.parametrize("rate_hz", [50.0, 333.0, 1000.0])
@pytest.mark.parametrize("noise", [0.0, 1e-4, 5e-3])
@pytest.mark.parametrize("count", [2, 5])
def test_periods_between_approach_and_return_are_found(rate_hz: float, noise: float, count: int) -> None:
    time, q = motion(count, rate_hz)
    q = q + noise * np.random.default_rng(1).normal(size=q.shape)
    assert close(find_periods(time, q), count, slack_s=0.4)


@pytest.mark.parametrize("rate_hz", [50.0, 1000.0])
def test_nothing_but_two_periods_are_two_periods(rate_hz: float) -> None:
    found = find_periods(*motion(2, rate_hz, approach=False))
    assert found is not None
    assert (found.count, found.start_s) == (2, 0.0)
    assert found.period_s == pytest.approx(PERIOD_S, abs=1e-4)


@pytest.mark.parametrize("rate_hz", [50.0, 1000.0])
@pytest.mark.parametrize("periods", [1.0, 1.5, 1.9])
def test_less_than_two_periods_are_none(rate_hz: float, periods: float) -> None:
    for approach in (True, False):
        assert find_periods(*motion(periods, rate_hz, approach=approach)) is None


def test_uneven_stamps_and_repeated_samples_do_not_hide_them() -> None:
    time, q = motion(3, 1000.0)
    random = np.random.default_rng(2)
    held = np.maximum.accumulate(np.where(random.random(len(q)) < 0.08, 0, np.arange(len(q))))
    assert close(find_periods(time + random.uniform(-4e-4, 4e-4, len(time)), q[held]), 3)


def test_a_joint_at_rest_has_no_say() -> None:
    time, q = motion(2, 100.0)
    q = np.column_stack([q, np.full(len(q), 0.3)]) + 1e-5 * np.random.default_rng(3).normal(size=(len(q), 4))
    assert close(find_periods(time, q), 2)


def test_one_joint_with_another_motion_is_enough_for_none() -> None:
    time, q = motion(2, 100.0)
    q[:, 2] += 0.02 * np.sin(1.3 * time) * (time > APPROACH_S + PERIOD_S)
    assert find_periods(time, q) is None


@pytest.mark.parametrize("seed", range(5))
def test_a_motion_without_repetition_has_none(seed: int) -> None:
    random = np.random.default_rng(seed)
    time = np.arange(0.0, 40.0, 0.01)
    rates = random.uniform(0.2, 4.0, (4, 6))
    q = np.sum(np.sin(rates * time[:, None, None] + random.uniform(0.0, 6.0, (4, 6))) / rates, axis=2)
    assert find_periods(time, q) is None


def test_rest_noise_and_too_few_samples_have_none() -> None:
    time = np.arange(0.0, 20.0, 0.01)
    noise = np.random.default_rng(4).normal(size=(len(time), 2))
    assert find_periods(time, np.full((len(time), 2), 0.1)) is None
    assert find_periods(time, 0.1 + 1e-4 * noise) is None
    assert find_periods(time[:5], noise[:5]) is None


# ---- imports ----


def mapping(**changes: Any) -> LogMapping:
    plain: dict[str, Any] = {
        "robot": "bench arm",
        "joints": ["a", "b", "c"],
        "time": {"column": "t"},
        "position": {"columns": [2, 3, 4], "unit": "rad"},
        "joint_torque": {"columns": [5, 6, 7], "unit": "Nm"},
    }
    return parse(LogMapping, plain | changes, "mapping.yaml")


def recording(folder: Path, time: Floats, q: Floats) -> Path:
    path = folder / "arm.csv"
    head = "t,qa,qb,qc,ta,tb,tc"
    np.savetxt(
        path, np.column_stack([time, q, 10.0 * q]), delimiter=",", header=head, comments="", fmt="%.9g"
    )
    return path


@pytest.mark.parametrize("rate_hz", [50.0, 1000.0])
def test_an_import_marks_them_and_says_so(tmp_path: Path, rate_hz: float) -> None:
    path = recording(tmp_path, *motion(3, rate_hz))
    report = import_log(mapping(), path, tmp_path / "x.mcap")
    assert "periods   3 of 8 s, from" in str(report)
    assert any("periods found in the positions" in note for note in report.notes)
    session = read_session(report.path)
    assert [phase.name for phase in session.phases] == ["period 1", "period 2", "period 3", "hold"]
    assert session.metadata["periods"] == "found in the positions"
    prepared = prepare(session, SignalSettings(cutoff_hz=4.0))
    assert prepared.periods == 3
    assert prepared.period_rows is not None


def test_rows_know_periods_that_end_between_samples(tmp_path: Path) -> None:
    """At 47 Hz a period is no whole number of samples."""
    report = import_log(mapping(), recording(tmp_path, *motion(3, 47.0)), tmp_path / "x.mcap")
    assert prepare(read_session(report.path), SignalSettings(cutoff_hz=4.0)).periods == 3


def test_rows_know_periods_up_to_the_last_sample(tmp_path: Path) -> None:
    path = recording(tmp_path, *motion(2, 50.0, approach=False))
    report = import_log(mapping(), path, tmp_path / "x.mcap")
    assert prepare(read_session(report.path), SignalSettings(cutoff_hz=4.0)).periods == 2


def test_an_import_without_repetition_is_used_whole(tmp_path: Path) -> None:
    report = import_log(mapping(), recording(tmp_path, *motion(1.5, 100.0)), tmp_path / "x.mcap")
    assert report.periods is None
    assert "periods" not in str(report)
    assert read_session(report.path).phases == ()


def test_a_repetition_in_a_long_other_motion_is_told_and_not_marked(tmp_path: Path) -> None:
    """Marks would keep most of the recording from the estimate."""
    time, q = motion(2, 100.0)
    further = np.arange(0.01, 30.0, 0.01)
    other = q[-1] + np.sin(np.outer(further, [0.7, 1.1, 1.9]) ** 1.2)
    whole = np.append(time, time[-1] + further), np.vstack([q, other])
    assert close(find_periods(*whole), 2, slack_s=0.3)
    report = import_log(mapping(), recording(tmp_path, *whole), tmp_path / "x.mcap")
    assert report.periods is None
    assert any("the motion repeats, 2 of" in note and "is not marked" in note for note in report.notes)
    assert read_session(report.path).phases == ()


def test_the_mapping_marks_them(tmp_path: Path) -> None:
    path = recording(tmp_path, *motion(3, 100.0))
    marks = {"period_s": PERIOD_S, "start_s": APPROACH_S, "count": 2}
    report = import_log(mapping(periods=marks), path, tmp_path / "x.mcap")
    assert report.periods is not None
    assert (report.periods.count, report.periods.start_s) == (2, APPROACH_S)
    assert any("from the mapping" in note for note in report.notes)
    spans = read_session(report.path).spans("period")
    assert [stop - start for start, stop in spans] == [8 * 10**9] * 2


def test_start_and_number_are_enough(tmp_path: Path) -> None:
    path = recording(tmp_path, *motion(3, 100.0, approach=False))
    report = import_log(mapping(periods={"count": 3}), path, tmp_path / "x.mcap")
    assert report.periods is not None
    assert report.periods.period_s == pytest.approx(PERIOD_S)
    assert report.periods.deviation < 1e-3


def test_marks_that_the_motion_does_not_keep_are_doubted(tmp_path: Path) -> None:
    path = recording(tmp_path, *motion(3, 100.0))
    report = import_log(mapping(periods={"period_s": 7.0, "start_s": 3.0}), path, tmp_path / "x.mcap")
    assert any("does not repeat with 7 s" in note for note in report.notes)


def test_a_count_of_zero_marks_nothing(tmp_path: Path) -> None:
    path = recording(tmp_path, *motion(3, 100.0))
    report = import_log(mapping(periods={"count": 0}), path, tmp_path / "x.mcap")
    assert report.periods is None
    assert read_session(report.path).phases == ()


def test_marks_beyond_the_recording_are_an_error(tmp_path: Path) -> None:
    path = recording(tmp_path, *motion(3, 100.0))
    with pytest.raises(DataError, match=r"end at 43 s, the recording at 30 s; correct"):
        import_log(mapping(periods={"period_s": 8, "start_s": 3, "count": 5}), path, tmp_path / "x.mcap")


@pytest.mark.parametrize("marks", [{}, {"period_s": 0.0}, {"period_s": 2.0, "start_s": -1.0}, {"count": -1}])
def test_marks_that_make_no_sense_are_refused(marks: dict[str, Any]) -> None:
    with pytest.raises(ConfigurationError, match="period"):
        mapping(periods=marks)
