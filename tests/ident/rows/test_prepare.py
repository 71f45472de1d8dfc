"""Spans, row grids, blocks, clocks and binned sums on the way from channels to rows, one by one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fri.errors import DataError
from ident.dynamics.structure import DriveMotion, ModelStructure
from ident.rows import observation
from ident.rows.binned import _add_means, bins
from ident.rows.class_rows import ClassRows
from ident.rows.content import Recall
from ident.rows.delay import Delay, DelayData, estimate_delay
from ident.rows.filtered_motion import _cut
from ident.rows.filters import SignalSettings, half_width, low_pass, settling
from ident.rows.prepare import _mean_torque, _row_grid, _valid, _windows, clock_ns, prepare
from ident.rows.prepared import Passage, TorqueChannel
from ident.rows.signal_choice import _Bench, _excerpt, _reversal_s, _with_decimation
from ident.rows.timebase import stretches
from lwr_driver.session import Phase
from tests.ident import estimation_arm as arm

FIVE_HZ = SignalSettings(decimate_hz=2.0)


def test_rows_of_separate_spans_go_from_the_first_to_the_last() -> None:
    grid, rows = _row_grid([(1.0, 3.0), (5.0, 6.0)], False, FIVE_HZ)
    np.testing.assert_allclose(grid, 1.0 + 0.2 * np.arange(26))
    assert rows is None
    alone, rows = _row_grid([(0.5, 2.5)], True, FIVE_HZ)
    np.testing.assert_allclose(alone, 0.5 + 0.2 * np.arange(11))
    assert rows is None


@pytest.mark.parametrize(
    ("windows", "rows"),
    [
        ([(0.0, 4.0), (4.0, 8.0), (8.0, 12.0)], 20),
        # Joined within half a row, equal within a tenth, the last one late by less than a row.
        ([(0.0, 4.0), (4.09, 8.09), (8.18, 12.18)], 20),
        ([(0.0, 4.0), (4.11, 8.11), (8.22, 12.22)], None),
        ([(0.0, 4.0), (4.0, 8.019), (8.019, 12.0)], 20),
        ([(0.0, 4.0), (4.0, 8.021), (8.021, 12.0)], None),
        ([(0.0, 4.0), (4.0, 8.0), (8.0, 11.81)], 20),
        ([(0.0, 4.0), (4.0, 8.0), (8.0, 11.79)], None),
        ([(0.0, 4.0), (4.0, 8.0), (8.0, 12.019)], 20),
        ([(0.0, 4.0), (4.0, 8.0), (8.0, 12.021)], None),
        ([(0.0, 0.05), (0.05, 0.1)], 1),
    ],
)
def test_equal_joined_periods_share_their_rows(windows: list[tuple[float, float]], rows: int | None) -> None:
    grid, found = _row_grid(windows, True, FIVE_HZ)
    assert found == rows
    if rows is not None:
        assert len(grid) == rows * len(windows)
        length = np.mean([b - a for a, b in windows[:-1]])
        np.testing.assert_allclose(grid, windows[0][0] + length / rows * np.arange(len(grid)))
    assert _row_grid(windows, False, FIVE_HZ)[1] is None


def test_rows_lie_in_the_periods_else_in_the_excitation_else_everywhere() -> None:
    session = arm.session(motor=False, periods=2, period_s=4.0, run_in_s=1.0)
    times = (session.joint.publish_time - session.joint.publish_time[0]) * 1e-9
    assert _windows(session, times) == (
        [(1.0, pytest.approx(5.0)), (pytest.approx(5.0), pytest.approx(9.0))],
        True,
    )
    plain = replace(session, phases=tuple(m for m in session.phases if not m.name.startswith("period")))
    found, periods = _windows(plain, times)
    assert (found, periods) == ([(0.0, pytest.approx(9.0))], False)
    assert _windows(replace(session, phases=()), times) == ([(0.0, pytest.approx(10.0))], False)
    # A phase of no length has no rows.
    start = session.joint.log_time[0]
    empty = (Phase(int(start), "excitation"), Phase(int(start), "brake"))
    assert _windows(replace(session, phases=empty), times) == ([(0.0, pytest.approx(10.0))], False)


def test_the_source_tells_the_time_if_it_has_a_clock() -> None:
    columns = arm.session(motor=False).joint
    np.testing.assert_array_equal(clock_ns(columns), columns.publish_time)
    for publish, own in (
        (np.arange(len(columns)) // (len(columns) - 1), True),
        (np.zeros(len(columns)), False),
    ):
        changed = replace(columns, publish_time=publish.astype(np.int64))
        np.testing.assert_array_equal(clock_ns(changed), changed.publish_time if own else columns.log_time)


@pytest.mark.parametrize("rate_hz", [20.0, 40.0])
def test_a_slow_channel_has_the_cut_offs_that_it_carries(rate_hz: float) -> None:
    session = arm.session(motor=False, rate_hz=rate_hz, period_s=6.0)
    prepared = prepare(session, advise=False)
    assert prepared.cutoff_hz == pytest.approx(0.2 * rate_hz)
    assert prepared.row_time_s == pytest.approx(0.2)
    assert (prepared.periods, prepared.period_rows, prepared.has_motor) == (2, 30, False)
    assert prepared.without_samples().passages == ()
    assert (prepared.jitter_s, prepared.uid) == (None, "")


def test_a_session_without_any_torque_is_refused_for_the_joint_side() -> None:
    session = arm.session(period_s=4.0)
    bare = replace(session.joint, effort=session.joint.effort[:, :0])
    for one, motor in (
        (replace(session, joint=bare, motor=None), True),
        (replace(session, joint=bare), False),
    ):
        with pytest.raises(DataError, match="has no effort, so no joint torque"):
            prepare(one, motor=motor)
    found = prepare(replace(session, joint=bare), advise=False)
    assert found.mean_torque == ()
    assert not any(passage.joint_valid.any() for passage in found.passages)
    assert found.delay is not None
    assert found.delay.how == "no joint torque to compare the motor channel with"
    silent = replace(session.motor, effort=session.motor.effort[:, :0])
    with pytest.raises(DataError, match="/motor_states has no effort"):
        prepare(replace(session, motor=silent))


def test_a_flag_of_a_torque_stays_at_its_sample_whatever_the_clock() -> None:
    session = arm.session(motor=False, period_s=4.0, sensors=arm.Sensors(joint=0.1))
    shifted = replace(session.joint, publish_time=session.joint.publish_time + 7_000_000_000)
    effort = session.joint.effort.copy()
    effort[1000, 2] += 30.0
    for joint in (session.joint, shifted):
        before, after = (
            prepare(replace(session, joint=replace(joint, effort=some)), advise=False).passages[0].joint
            for some in (joint.effort, effort)
        )
        places = np.argwhere(after.flagged & ~before.flagged)
        assert set(places[:, 1]) == {2}
        # The median of five may take a neighbour on a slope with it.
        assert np.abs(after.times[places[:, 0]] - 4.0).min() == pytest.approx(0.0, abs=1e-9)
        assert np.abs(after.times[places[:, 0]] - 4.0).max() < 0.009
        assert not after.known[places[:, 0], 2].any()


def channel(count: int = 400, known: np.ndarray | None = None, drive: bool = False) -> TorqueChannel:
    """Two joints at 250 Hz."""
    times = 0.004 * np.arange(count)
    q = np.column_stack([np.sin(times), np.cos(times)])
    mask = np.ones((count, 2), dtype=bool) if known is None else known
    motion = DriveMotion(q + 1.0, q + 2.0) if drive else None
    return TorqueChannel("joint", times, q, q + 3.0, q + 4.0, q + 5.0, ~mask, mask, motion, 0.004)


@pytest.mark.parametrize("drive", [False, True])
def test_a_channel_at_some_samples_keeps_all_its_arrays_together(drive: bool) -> None:
    whole = channel(drive=drive)
    assert len(whole.arrays) == (9 if drive else 7)
    same = whole.on([2.0 * np.asarray(array, dtype=float) for array in whole.arrays])
    part = whole.at(np.array([3, 5]))
    for one, double, few in zip(whole.arrays, same.arrays, part.arrays, strict=True):
        np.testing.assert_array_equal(double, 2.0 * np.asarray(one, dtype=float))
        np.testing.assert_array_equal(few, one[[3, 5]])
    assert (part.side, part.period_s) == ("joint", 0.004)


@pytest.mark.parametrize(("share", "usable"), [(0.3, True), (0.5, False)])
def test_a_row_with_less_than_the_known_share_of_its_filter_is_left_out(share: float, usable: bool) -> None:
    known = np.ones((2000, 2), dtype=bool)
    # Every sample of the second half is unknown: a row at its beginning has half of its filter.
    known[1000:, 1] = False
    settings = replace(FIVE_HZ.settled(250.0), known_share=share + 0.05)
    valid = _valid(channel(2000, known), np.array([2.0, 3.998, 6.0]), settings)
    assert valid[:, 0].tolist() == [True] * 3
    assert valid[:, 1].tolist() == [True, usable, False]


def passage(times: np.ndarray, torque: np.ndarray, rows: np.ndarray, core: tuple[float, float]) -> Passage:
    none = np.zeros((len(rows), 1), dtype=bool)
    column = np.zeros((len(times), 1))
    mask = np.ones((len(times), 1), dtype=bool)
    made = TorqueChannel("joint", times, column, column, column, torque[:, None], ~mask, mask)
    return Passage(rows, np.arange(len(rows)), made, none, None, None, core, rows)


def test_the_mean_torque_counts_each_sample_between_the_rows_once() -> None:
    times = np.arange(10.0)
    torque = np.array([100.0, -1.0, 2.0, -3.0, 4.0, 5.0, -6.0, 7.0, 8.0, 100.0])
    rows = np.array([1.0, 8.0])
    halves = [
        passage(times, torque, rows, (-np.inf, 4.5)),
        passage(times, torque, rows, (4.5, np.inf)),
    ]
    assert _mean_torque(halves) == (pytest.approx(36.0 / 8.0),)
    assert [one.continues for one in halves] == [False, True]
    both = replace(halves[0].joint, torque=np.column_stack([torque, 2.0 * torque]))
    assert _mean_torque([replace(halves[0], joint=both)]) == (pytest.approx(10.0 / 4.0), pytest.approx(5.0))
    assert _mean_torque([passage(times, torque, np.array([20.0, 21.0]), (-np.inf, np.inf))]) == (0.0,)


def test_a_sample_on_the_edge_of_two_blocks_belongs_to_the_later_one() -> None:
    times = np.array([3.0, 4.0, 5.0])
    first, second = (
        passage(times, np.zeros(3), np.array([3.0, 5.0]), core) for core in ((-np.inf, 4.0), (4.0, np.inf))
    )
    assert first.own(times).tolist() == [True, False, False]
    assert second.own(times).tolist() == [False, True, True]
    whole = Passage(first.rows, first.index, first.joint, first.joint_valid, None, None)
    assert whole.own(times).all()
    assert not whole.continues


def test_blocks_cover_a_stretch_once_and_overlap_by_the_reach_of_their_filters() -> None:
    time = 0.01 * np.arange(60_001)
    ((part,), _) = stretches(time, time[:, None], np.zeros(len(time), dtype=bool), 0.01, 0.02)
    settings = SignalSettings().settled(100.0)
    assert list(_cut(part, settings, False)) == [((0, 60_001), (-np.inf, np.inf))]
    found = list(_cut(part, settings, True))
    # Two minutes each, and the rest with the last one.
    assert len(found) == 4
    assert (found[0][0][0], found[-1][0][1]) == (0, 60_001)
    assert (found[0][1][0], found[-1][1][1]) == (-np.inf, np.inf)
    for k, ((low, high), (begin, end)) in enumerate(found):
        if k:
            assert begin == found[k - 1][1][1]
            assert begin == pytest.approx(0.2 + 120.0 * k - 0.005)
            assert 1.0 < begin - 0.01 * low < 20.0
        if k < 3:
            assert 1.0 < 0.01 * high - end < 20.0
    assert len(list(_cut(part, settings, True))[1:3]) == 2
    # At 1 kHz twelve neighbours are averaged: blocks and their overlaps are whole numbers of twelve.
    fast = list(_cut(replace(part, dt=0.001, count=600_001), SignalSettings().settled(1000.0), True))
    assert len(fast) == 4
    for (low, high), (begin, _) in fast[1:]:
        first = round((begin + 0.0005) / 0.001)
        assert ((first - 200) % 12, (first - low) % 12) == (0, 0)
        assert high == 600_001 or (high - 200) % 12 == (first - low) % 12
    # A wide band of the rows: the delay reaches farther, over its kernel, its search and its low-pass.
    (_, ((low, _), (begin, _)), *_) = _cut(part, SignalSettings(decimate_hz=8.0).settled(100.0), True)
    reach = half_width(5.0, 40.0) + 0.1 + settling(15.0)
    assert begin - 0.01 * low == pytest.approx(reach + 0.5, abs=0.011)
    short = replace(part, count=24_039)
    assert len(list(_cut(short, settings, True))) == 1
    assert len(list(_cut(replace(part, count=24_041), settings, True))) == 2


# -- rows and bins -------------------------------------------------------------------------------------------


def test_a_row_next_to_unknown_is_not_blown_up() -> None:
    share = np.array([0.04, 0.051, -0.04, -0.2, 1.0, 0.0])
    assert observation._total(share).tolist() == [1.0, 0.051, 1.0, -0.2, 1.0, 1.0]


@pytest.mark.parametrize("factor", [1, 3, 5])
def test_means_of_known_samples_are_taken_over_all_samples(factor: int) -> None:
    random = np.random.default_rng(0)
    table, known = random.normal(size=(2, 3, 17)), random.integers(0, 2, (3, 17)).astype(float)
    table[0, 1], table[1, 0, 0], table[1, 2, :16] = 0.0, 0.0, 0.0
    found = observation._known_means(table, known, factor)
    count = 17 // factor
    expected = (table * known)[:, :, : count * factor].reshape(6, count, factor).mean(axis=2)
    np.testing.assert_allclose(found, expected, atol=1e-12)
    out = np.ones((3, count, 2))
    _add_means(table, factor, out)
    plain = table[:, :, : count * factor].reshape(2, 3, count, factor).mean(axis=3)
    np.testing.assert_allclose(out, 1.0 + plain.transpose(1, 2, 0), atol=1e-12)
    np.testing.assert_allclose(bins(table[0].T, factor), plain[0].T, atol=1e-12)


def test_rows_of_equal_phase_are_averaged_if_no_period_lacks_one() -> None:
    index = np.array([0, 1, 3, 4, 5, 7, 8, 9, 11])
    matrix = np.arange(18.0).reshape(9, 2)
    target, slope = 10.0 * index, -1.0 * index
    found = observation._averaged(matrix, target, slope, index.astype(np.int64), 4, 3)
    # Phase 2 is missing everywhere, phases 0, 1 and 3 are there three times.
    assert found[3].tolist() == [0, 1, 3]
    np.testing.assert_allclose(
        found[0], [matrix[[0, 3, 6]].mean(0), matrix[[1, 4, 7]].mean(0), matrix[[2, 5, 8]].mean(0)]
    )
    np.testing.assert_allclose(found[1], [40.0, 50.0, 70.0])
    np.testing.assert_allclose(found[2], [-4.0, -5.0, -7.0])
    fewer = observation._averaged(matrix[1:], target[1:], slope[1:], index[1:].astype(np.int64), 4, 3)
    assert fewer[3].tolist() == [1, 3]
    none = observation._averaged(matrix[:2], target[:2], slope[:2], index[:2].astype(np.int64), 4, 3)
    assert [len(part) for part in none] == [0, 0, 0, 0]


def bench(band: float | None) -> _Bench:
    return _Bench((), (), None, np.zeros(0, dtype=np.int64), False, (), band, 1.0, None)  # type: ignore[arg-type]


@pytest.mark.parametrize(("band", "smoothed"), [(None, False), (39.0, True), (41.0, False), (4.0, True)])
def test_rows_pass_half_the_band_of_an_earlier_filter_where_their_rate_carries_it(
    band: float | None, smoothed: bool
) -> None:
    rows = type("Rows", (), {"time": 0.02 * np.arange(200)})()
    values = np.random.default_rng(0).normal(size=(200, 2))
    found = bench(band)._smooth(values, rows)
    expected = low_pass(values, 0.02, 0.5 * band) if smoothed and band else values
    np.testing.assert_allclose(found, expected, atol=1e-12)
    single = type("Rows", (), {"time": np.zeros(1)})()
    np.testing.assert_array_equal(bench(band)._smooth(values[:1], single), values[:1])


def test_an_earlier_filter_over_the_widest_window_leaves_the_reversals_in() -> None:
    count = 400
    speed = np.sin(0.2 * np.arange(count))
    rows = {
        ("joint", 0): ClassRows(
            speed[:, None], 2.0 * speed, speed, np.ones((count, 0)), np.ones(count, dtype=bool),
            np.arange(count) // 50, (), (slice(0, count),), np.arange(1), 1,
        )
    }  # fmt: skip
    for band, nothing in ((9.9, True), (10.1, False)):
        said: list[str] = []
        assert _reversal_s(rows, band, 0.01, said) == 0.0
        assert ("nothing left out" in said[0]) == nothing


@pytest.mark.parametrize(("motor", "band"), [(True, True), (False, False)])
def test_an_earlier_filter_of_the_motor_torques_counts_where_these_are_used(motor: bool, band: bool) -> None:
    session = arm.session(sensors=arm.Sensors(position=1e-6, joint=0.05, motor=0.1), period_s=4.0)
    spectrum = np.fft.rfft(session.motor.effort, axis=0)
    spectrum[np.fft.rfftfreq(len(session.motor), 0.004) > 8.0] = 0.0
    smooth = np.fft.irfft(spectrum, len(session.motor), axis=0)
    session = replace(session, motor=replace(session.motor, effort=smooth))
    found = _with_decimation(FIVE_HZ, [session], 250.0, motor, [], Recall())
    assert found == (FIVE_HZ, pytest.approx(8.0, abs=0.5) if band else None)


def test_an_excerpt_begins_with_the_motion_and_ends_with_the_recording() -> None:
    session = arm.session(motor=True, run_in_s=3.0, period_s=4.0, periods=2)
    assert _excerpt(session, 14.0) is session
    start = session.joint.log_time[0]
    part = _excerpt(session, 5.0)
    assert part.motor is not None
    assert (part.joint.log_time[0] - start, part.duration_s) == (3_000_000_000, pytest.approx(5.0, abs=0.005))
    late = _excerpt(session, 12.0)
    assert late.joint.log_time[0] - start == 2_000_000_000
    plain = _excerpt(replace(session, phases=()), 5.0)
    assert plain.joint.log_time[0] == start


# -- delay ---------------------------------------------------------------------------------------------------


def test_an_unknown_delay_may_be_a_sample_time_of_the_slowest_part() -> None:
    def still(step: float) -> DelayData:
        time, none = 0.004 * np.arange(100), np.zeros((100, 1))
        when = step * np.arange(40)
        return DelayData(time, none, none, none, none > 1.0, when, np.zeros((40, 1)), (0.0, 0.4))

    found = estimate_delay([still(0.01), still(0.02)], ("a",))
    assert (found.seconds, found.std) == (0.0, pytest.approx(0.02))
    assert estimate_delay([], ("a",)).std == 0.0


@pytest.mark.parametrize(("estimate", "early"), [(-0.0021, True), (-0.0019, False)])
def test_elastic_joints_look_early_by_two_milliseconds(estimate: float, early: bool) -> None:
    assert Delay.of(estimate, 0.0, "how", {}, 1.0).early == early
    assert Delay(0.0, 0.0, "how").interval == (0.0, 0.0)
    assert (Delay(0.0, 0.0, "how").estimate, Delay(0.0, 0.0, "how").disagreement) == (0.0, 1.0)
    assert Delay(0.001, 0.002, "how").interval == (0.0, pytest.approx(0.001 + 1.96 * 0.002))


def test_a_still_joint_loses_all_its_rows_and_the_others_none() -> None:
    session = arm.session(still=(2,), period_s=6.0)
    counts = prepare(session, SignalSettings(motor_delay_s=0.0, reversal_s=0.0)).counts
    assert counts["rows"] > 50
    for side in ("joint", "motor"):
        assert counts[f"{side}_rows_dropped"] == counts["rows"]


def test_the_sample_time_is_that_of_the_counter() -> None:
    session = arm.session(motor=False, period_s=4.0)
    # Every second sample is lost between two of the others.
    kept = np.concatenate([np.arange(600), np.arange(600, len(session.joint), 2)])
    fields = ("log_time", "publish_time", "sequence", "position", "velocity", "effort")
    some = replace(session.joint, **{name: getattr(session.joint, name)[kept] for name in fields})
    for sequence, period_s in ((some.sequence, 0.004), (np.zeros_like(some.sequence), 0.008)):
        (passage,) = prepare(replace(session, joint=replace(some, sequence=sequence)), advise=False).passages
        assert passage.joint.period_s == pytest.approx(period_s)


def test_held_torques_of_the_joint_channel_are_counted_and_flagged() -> None:
    session = arm.session(sensors=arm.Sensors(joint=0.02), period_s=4.0)
    effort = session.joint.effort.copy()
    effort[1200:1240] = effort[1199]
    prepared = prepare(replace(session, joint=replace(session.joint, effort=effort)), advise=False)
    assert prepared.counts["joint_torque_held"] == 40
    (passage,) = prepared.passages
    assert passage.joint.flagged.all(axis=1).sum() == 40
    bare = replace(session.joint, effort=effort[:, :0])
    assert prepare(replace(session, joint=bare), advise=False).counts["joint_torque_held"] == 0


def test_advice_names_the_rates_of_both_channels() -> None:
    settings = SignalSettings(cutoff_hz=9.0, decimate_hz=2.0, motor_delay_s=0.0)
    session = arm.session(rate_hz=40.0, sensors=arm.Sensors(motor_step_s=0.25))
    said = " ".join(prepare(session, settings).warnings)
    assert "above a fifth of the sampling rate 40 Hz" in said
    assert "rows at 5 Hz exceed the motor channel's 4.0 Hz" in said


def test_a_commanded_motion_without_error_is_the_measured_one() -> None:
    session = arm.session(motor=False, command=True, period_s=4.0)
    prepared = prepare(session, advise=False)
    motion = observation.commanded(session, prepared)
    assert motion is not None
    (measured,), (sent,) = prepared.passages, motion.passages
    for name in ("q", "qd", "qdd"):
        np.testing.assert_allclose(getattr(sent.joint, name), getattr(measured.joint, name), atol=1e-6)


@pytest.mark.parametrize("extra", range(9))
def test_a_stretch_of_a_few_samples_between_gaps_gives_no_row_and_no_error(extra: int) -> None:
    session = arm.session(period_s=4.0, sensors=arm.Sensors(joint=0.1, motor=0.1))
    cut = round(SignalSettings().settled(1.0 / session.joint.period_s).edge / session.joint.period_s)
    # Around t = 8.2 s, a time of a row; the gaps are longer than any bridge.
    first = round(8.2 / session.joint.period_s) - cut - extra // 2
    last = first + 2 * cut + extra
    kept = np.ones(len(session.joint), dtype=bool)
    kept[first - 20 : first] = kept[last : last + 20] = False
    fields = ("log_time", "publish_time", "sequence", "position", "velocity", "effort")
    joint = replace(session.joint, **{name: getattr(session.joint, name)[kept] for name in fields})
    holed = replace(session, joint=joint)
    prepared = prepare(holed, advise=False)
    assert prepared.counts["stretches"] == 3
    inside = (8.0, 8.4)
    for passage in prepared.passages:
        near = (passage.rows > inside[0]) & (passage.rows < inside[1])
        assert not passage.joint_valid[near].any()
    for model in (1, 2, 3):
        structure = ModelStructure(arm.chain(), model)
        rows = observation.observe([prepared], [None], structure)
        assert rows.groups
        assert all(
            np.isfinite(group.matrix).all() and np.isfinite(group.target).all() for group in rows.groups
        )


def test_no_row_is_built_across_a_jump_of_a_position() -> None:
    session = arm.session(motor=False, period_s=6.0)
    whole, turned = session.joint.position, session.joint.position.copy()
    turned[1000:, 4] -= 2.0 * np.pi
    before, after = (
        prepare(replace(session, joint=replace(session.joint, position=q)), advise=False)
        for q in (whole, turned)
    )
    jump = session.joint.publish_time[1000] * 1e-9 - session.joint.publish_time[0] * 1e-9
    assert (before.counts["position_jumps"], before.counts["stretches"]) == (0, 1)
    assert (after.counts["position_jumps"], after.counts["stretches"]) == (1, 2)
    rows = np.concatenate([passage.rows for passage in after.passages])
    assert np.abs(rows - jump).min() > 0.05
    speeds = [np.abs(p.joint.qd).max() for part in (before, after) for p in part.passages]
    assert max(speeds[1:]) < 1.05 * speeds[0]
