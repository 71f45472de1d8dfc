from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fri.sequence import Arrival, SequenceTracker

T = 0.001


def stamp(number: int, start: float = 0.0, sample_time: float = T) -> float:
    """The controller's clock at packet `number`, with the resolution of the wire."""
    return float(np.float32(start + number * sample_time))


@given(
    first=st.integers(0, 0xFFFF),
    steps=st.lists(st.integers(1, 200), min_size=1, max_size=300),
    uptime=st.sampled_from([0.0, 100.0, 8e3, 7e4]),
)
def test_gaps_are_lost_packets_and_the_counter_is_unwrapped(first, steps, uptime):
    tracker = SequenceTracker()
    number = first
    assert tracker.feed(number & 0xFFFF, stamp(number, uptime), T) is Arrival.NEW
    for step in steps:
        number += step
        assert tracker.feed(number & 0xFFFF, stamp(number, uptime), T) is Arrival.NEW
        assert tracker.sequence == number
    assert tracker.lost == sum(steps) - len(steps)
    assert tracker.repeated == tracker.reordered == tracker.restarts == tracker.suspect == 0


@pytest.mark.parametrize("gap", [40_000, 65_535, 65_536, 65_540, 200_000])
def test_gaps_longer_than_the_counter_are_measured_by_the_clock(gap):
    tracker = SequenceTracker()
    tracker.feed(10, stamp(10), T)
    assert tracker.feed((10 + gap) & 0xFFFF, stamp(10 + gap), T) is Arrival.SUSPECT
    assert tracker.feed((11 + gap) & 0xFFFF, stamp(11 + gap), T) is Arrival.NEW
    assert tracker.sequence == 11 + gap
    assert (tracker.lost, tracker.restarts) == (gap, 0)


def test_a_damaged_timestamp_at_a_gap_is_not_a_long_silence():
    tracker = SequenceTracker()
    for number in range(100):
        tracker.feed(number, stamp(number), T)
    assert tracker.feed(103, stamp(1_000_000), T) is Arrival.SUSPECT
    assert tracker.feed(104, stamp(104), T) is Arrival.NEW
    assert (tracker.sequence, tracker.lost) == (104, 4)


def test_ten_minutes_wrap_nine_times():
    tracker = SequenceTracker()
    for number in range(0, 600_000, 7):
        tracker.feed(number & 0xFFFF, stamp(number), T)
    assert tracker.sequence == 600_000 - 600_000 % 7 - (7 if 600_000 % 7 == 0 else 0)
    assert tracker.restarts == tracker.suspect == 0


def test_repeated_packets_are_counted_and_change_nothing():
    tracker = SequenceTracker()
    for number in range(5):
        tracker.feed(number, stamp(number), T)
    for _ in range(20):
        assert tracker.feed(4, stamp(4), T) is Arrival.REPEATED
    assert tracker.feed(5, stamp(5), T) is Arrival.NEW
    assert (tracker.sequence, tracker.repeated, tracker.lost) == (5, 20, 0)


def test_late_packet_stays_lost():
    tracker = SequenceTracker()
    arrivals = [tracker.feed(n & 0xFFFF, stamp(n), T) for n in (65_534, 65_536, 65_535, 65_537)]
    assert arrivals == [Arrival.NEW, Arrival.NEW, Arrival.REORDERED, Arrival.NEW]
    assert (tracker.sequence, tracker.reordered, tracker.lost) == (65_537, 1, 1)


@given(st.lists(st.integers(0, 12), min_size=20, max_size=150))
def test_a_shuffled_stream_is_never_a_restart(delays):
    order = sorted(range(len(delays)), key=lambda n: (n + delays[n], n))
    tracker = SequenceTracker()
    for number in order:
        # The true order is kept where delays are equal; old runs shorter than forty are no restart.
        tracker.feed(number + 500, stamp(number + 500), T)
    new = tracker.sequence - order[0] - 500 + 1 - tracker.lost
    assert new + tracker.reordered == len(delays) or tracker.restarts


@pytest.mark.parametrize("first", [0, 12_345, 29_000, 40_000])
def test_a_clock_that_begins_anew_is_a_restart(first):
    tracker = SequenceTracker()
    for number in range(30_000, 30_100):
        tracker.feed(number, stamp(number, 500.0), T)
    before = tracker.sequence
    assert tracker.feed(first, stamp(0), T) is Arrival.RESTARTED
    assert tracker.feed(first + 1, stamp(1), T) is Arrival.NEW
    assert (tracker.sequence, tracker.restarts, tracker.lost) == (before + 2, 1, 0)


def test_restart_with_a_later_clock_is_believed_when_the_next_packet_confirms_it():
    tracker = SequenceTracker()
    for number in range(30_000, 30_100):
        tracker.feed(number, stamp(number), T)
    before = tracker.sequence
    assert tracker.feed(0, stamp(0, 900.0), T) is Arrival.SUSPECT
    assert tracker.feed(1, stamp(1, 900.0), T) is Arrival.RESTARTED
    assert (tracker.sequence, tracker.restarts, tracker.lost) == (before + 1, 1, 0)


def test_restart_with_a_later_clock_is_believed_when_its_first_packet_comes_again():
    tracker = SequenceTracker()
    tracker.feed(30_000, stamp(30_000), T)
    assert tracker.feed(5, stamp(0, 900.0), T) is Arrival.SUSPECT
    assert tracker.feed(5, stamp(0, 900.0), T) is Arrival.RESTARTED


def test_late_packets_stay_late_up_to_a_second():
    tracker = SequenceTracker()
    for number in range(3000):
        tracker.feed(number, stamp(number), T)
    assert tracker.feed(2100, stamp(2100), T) is Arrival.REORDERED
    assert tracker.feed(1900, stamp(1900), T) is Arrival.RESTARTED


def test_one_damaged_counter_is_not_a_restart():
    tracker = SequenceTracker()
    for number in range(100, 200):
        tracker.feed(number, stamp(number), T)
    assert tracker.feed(200 ^ 0x4000, stamp(200), T) is Arrival.SUSPECT
    assert tracker.feed(201, stamp(201), T) is Arrival.NEW
    assert (tracker.sequence, tracker.lost, tracker.suspect, tracker.restarts) == (201, 1, 1, 0)


def test_one_damaged_timestamp_changes_nothing():
    tracker = SequenceTracker()
    for number in range(100, 200):
        tracker.feed(number, stamp(number), T)
    assert tracker.feed(200, 1e6, T) is Arrival.NEW
    assert tracker.feed(201, stamp(201), T) is Arrival.NEW
    assert (tracker.sequence, tracker.lost, tracker.restarts) == (201, 0, 0)


def test_another_port_with_an_older_count_is_a_restart_at_once():
    tracker = SequenceTracker()
    for number in range(40):
        tracker.feed(number, stamp(number), T)
    assert tracker.feed(0, stamp(0), T, new_source=True) is Arrival.RESTARTED
    assert tracker.sequence == 40


def test_another_port_that_goes_on_counting_is_no_restart():
    tracker = SequenceTracker()
    tracker.feed(10, stamp(10), T)
    assert tracker.feed(14, stamp(14), T, new_source=True) is Arrival.NEW
    assert (tracker.lost, tracker.restarts) == (3, 0)


def test_restart_shortly_after_the_start_is_seen_by_a_run_of_old_packets():
    tracker = SequenceTracker()
    for number in range(100):
        tracker.feed(number, stamp(number), T)
    arrivals = [tracker.feed(number, stamp(number), T) for number in range(60)]
    assert arrivals.count(Arrival.RESTARTED) == 1
    assert arrivals[-1] is Arrival.NEW


def test_a_controller_without_a_clock_is_followed():
    tracker = SequenceTracker()
    for number in (1, 2, 5, 4, 6):
        tracker.feed(number, 0.0, T)
    assert (tracker.sequence, tracker.lost, tracker.reordered) == (6, 2, 1)


@given(
    history=st.lists(
        st.tuples(st.integers(0, 0xFFFF), st.floats(0.0, 1e4, width=32)), min_size=1, max_size=20
    ),
    timestamp=st.floats(-1e9, 1e9, width=32),
)
def test_packet_that_is_expected_is_new_whatever_its_clock_says(history, timestamp):
    tracker = SequenceTracker()
    assert tracker.expected is None
    for counter, clock in history:
        arrival = tracker.feed(counter, clock, T)
    assert arrival is not Arrival.SUSPECT or tracker.expected is None
    if tracker.expected is not None:
        before = tracker.sequence
        assert tracker.feed(tracker.expected, timestamp, T) is Arrival.NEW
        assert tracker.sequence == before + 1


@pytest.mark.parametrize("sample_time", [0.001, 0.005])
def test_a_clock_that_has_run_for_weeks_is_coarse_and_no_contradiction(sample_time):
    # At 2e6 s float32 has steps of 0.125 s.
    tracker = SequenceTracker()
    number = 100
    for step in (1, 2, 30, 1, 5, 90, 3) * 20:
        number += step
        arrival = tracker.feed(number & 0xFFFF, stamp(number, 2e6, sample_time), sample_time)
        assert arrival is Arrival.NEW
    assert tracker.sequence == number
    assert tracker.suspect == tracker.restarts == tracker.reordered == 0


def test_a_second_packet_in_doubt_confirms_the_first_only_with_a_clock_that_agrees():
    tracker = SequenceTracker()
    for number in range(30_000, 30_100):
        tracker.feed(number, stamp(number), T)
    assert tracker.feed(0, stamp(0, 900.0), T) is Arrival.SUSPECT
    assert tracker.feed(1, stamp(1, 905.0), T) is Arrival.SUSPECT
    assert tracker.feed(2, stamp(2, 905.0), T) is not Arrival.SUSPECT
    assert tracker.suspect == 2


def test_a_second_packet_in_doubt_confirms_the_first_only_with_a_counter_near_it():
    tracker = SequenceTracker()
    for number in range(30_000, 30_100):
        tracker.feed(number, stamp(number), T)
    assert tracker.feed(0, stamp(0, 900.0), T) is Arrival.SUSPECT
    assert tracker.feed(17, stamp(17, 900.0), T) is Arrival.SUSPECT
    assert tracker.feed(33, stamp(33, 900.0), T) is Arrival.RESTARTED


def test_forty_old_packets_in_order_are_a_restart():
    tracker = SequenceTracker()
    for number in range(100):
        tracker.feed(number, stamp(number), T)
    arrivals = [tracker.feed(number, stamp(number), T) for number in range(40)]
    assert arrivals == [Arrival.REORDERED] * 39 + [Arrival.RESTARTED]
    assert (tracker.sequence, tracker.reordered, tracker.lost) == (100, 40, 0)


def test_old_packets_out_of_order_are_no_restart():
    tracker = SequenceTracker()
    for number in range(200):
        tracker.feed(number, stamp(number), T)
    for number in range(0, 160, 2):
        assert tracker.feed(number, stamp(number), T) is Arrival.REORDERED
    assert tracker.reordered == 80


def test_a_new_packet_begins_the_run_of_old_ones_anew():
    tracker = SequenceTracker()
    for number in range(100):
        tracker.feed(number, stamp(number), T)
    for number in range(39):
        assert tracker.feed(number, stamp(number), T) is Arrival.REORDERED
    assert tracker.feed(100, stamp(100), T) is Arrival.NEW
    assert tracker.feed(39, stamp(39), T) is Arrival.REORDERED


@pytest.mark.parametrize(("jump", "arrival"), [(64, Arrival.SUSPECT), (65, Arrival.RESTARTED)])
def test_a_short_jump_with_an_old_clock_is_damage_and_a_long_one_a_restart(jump, arrival):
    tracker = SequenceTracker()
    for number in range(5000):
        tracker.feed(number, stamp(number), T)
    assert tracker.feed(4999 + jump, stamp(10), T) is arrival


@pytest.mark.parametrize(("off", "arrival"), [(17, Arrival.NEW), (20, Arrival.SUSPECT)])
def test_over_a_gap_counter_and_clock_agree_within_sixteen_packets_and_two_percent(off, arrival):
    tracker = SequenceTracker()
    tracker.feed(0, stamp(0), T)
    # 100 packets by the counter; by the clock 100 + off: 16 + 0.02 (100 + off).
    assert tracker.feed(100, stamp(100 + off), T) is arrival
