"""Faults on the wire: what each does, that seeds repeat, and that lock step knows which answers can come."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fri.errors import ConfigurationError
from sim_backend.faults import FaultyWire, WireFault

PERIOD = 1e-3
KINDS = ["loss", "burst", "delay", "jitter", "duplicate", "reorder", "truncate", "corrupt"]


def wire(*faults, seed=5):
    made = FaultyWire(np.random.SeedSequence(seed), PERIOD)
    for fault in faults:
        made.inject(fault, 0)
    return made


def packet(number):
    return number.to_bytes(2, "little") + bytes(range(100))


def leave(made, cycles):
    """[(cycle, number, awaited)] of what goes to the PC when packet n is made in cycle n."""
    return [
        (cycle, parcel.sequence, parcel.awaited)
        for cycle in range(cycles)
        for parcel in made.outgoing(packet(cycle), cycle, cycle)
    ]


def arrive(made, cycles, age_s=1e-4):
    """[(cycle, number, age)] of what reaches the session when answer n arrives in cycle n."""
    reached = []
    for cycle in range(cycles):
        made.incoming(packet(cycle), age_s, cycle)
        reached += [(cycle, int.from_bytes(d[:2], "little"), age) for d, age in made.due(cycle)]
    return reached


def test_a_wire_without_faults_passes_everything():
    assert leave(wire(), 5) == [(n, n, "yes") for n in range(5)]
    assert [entry[:2] for entry in arrive(wire(), 5)] == [(n, n) for n in range(5)]
    assert wire().quiet


def test_loss_has_the_stated_probability_in_one_direction():
    lossy = wire(WireFault("loss", "to_pc", probability=0.1))
    assert 1740 < len(leave(lossy, 2000)) < 1860
    assert len(arrive(lossy, 200)) == 200


def test_burst_loses_neighbours():
    left = leave(wire(WireFault("burst", "to_pc", 0.01, length=4)), 3000)
    lost = sorted(set(range(3000)) - {n for _, n, _ in left})
    runs = np.split(lost, np.flatnonzero(np.diff(lost) != 1) + 1)
    assert min(len(run) for run in runs[:-1]) >= 4


def test_delay_to_the_pc_comes_later_and_is_awaited_then():
    assert leave(wire(WireFault("delay", "to_pc", length=3, cycles=1)), 5) == [
        (1, 1, "yes"),
        (2, 2, "yes"),
        (3, 0, "no"),
        (3, 3, "yes"),
        (4, 4, "yes"),
    ]


def test_delay_of_everything_keeps_the_order_and_awaits_each():
    assert leave(wire(WireFault("delay", "to_pc", length=2)), 5) == [
        (2, 0, "yes"),
        (3, 1, "yes"),
        (4, 2, "yes"),
    ]


def test_reordered_packets_are_overtaken_in_both_directions():
    numbers = [n for _, n, _ in leave(wire(WireFault("reorder", "to_pc", cycles=1)), 4)]
    assert numbers == [1, 0, 2, 3]
    arrived = [(cycle, n) for cycle, n, _ in arrive(wire(WireFault("reorder", "to_krc", cycles=1)), 4)]
    assert arrived == [(1, 1), (1, 0), (2, 2), (3, 3)]


def test_duplicates_come_after_the_original_and_are_not_awaited():
    assert leave(wire(WireFault("duplicate", "to_pc", cycles=1)), 3) == [
        (0, 0, "yes"),
        (1, 0, "no"),
        (1, 1, "yes"),
        (2, 2, "yes"),
    ]
    assert [n for _, n, _ in arrive(wire(WireFault("duplicate", "to_krc", cycles=1)), 2)] == [0, 0, 1]


def test_damaged_packets_are_not_counted_on():
    damaged = wire(WireFault("truncate", "to_pc", cycles=1))
    assert damaged.outgoing(packet(0), 0, 0) == []
    first, second = damaged.outgoing(packet(1), 1, 1)
    assert len(first.datagram) < len(packet(0))
    assert (first.awaited, second.awaited) == ("no", "yes")
    flipped = wire(WireFault("corrupt", "to_pc", cycles=1, bits=3))
    flipped.outgoing(packet(0), 0, 0)
    first, _ = flipped.outgoing(packet(1), 1, 1)
    changed = np.frombuffer(first.datagram, np.uint8) ^ np.frombuffer(packet(0), np.uint8)
    assert 1 <= int(np.unpackbits(changed).sum()) <= 3
    assert first.awaited == "perhaps"


def test_jitter_towards_the_controller_ages_answers():
    ages = [
        age + cycle * PERIOD - n * PERIOD
        for cycle, n, age in arrive(wire(WireFault("jitter", "to_krc", length=2)), 400)
    ]
    assert min(ages) >= 1e-4
    assert 1.8e-3 < max(ages) < 2.1e-3
    assert np.mean(ages) == pytest.approx(1.1e-3, rel=0.1)


def test_foreign_datagrams_name_their_host_and_leave_ours_alone():
    parcels = wire(WireFault("foreign", "to_pc", host="127.0.0.9")).outgoing(packet(0), 0, 0)
    assert [(p.host, p.awaited) for p in parcels] == [("127.0.0.9", "no"), (None, "yes")]
    beside = wire(WireFault("foreign", "to_krc", imitate=False)).incoming(packet(0), 0.0, 0)
    assert [host for host, _ in beside] == ["127.0.0.2"]


def test_a_fault_ends_after_its_cycles():
    lossy = wire(WireFault("loss", "to_pc", cycles=3))
    assert [n for _, n, _ in leave(lossy, 6)] == [3, 4, 5]
    assert lossy.quiet


@given(
    st.lists(
        st.builds(
            WireFault,
            st.sampled_from(
                ["loss", "burst", "delay", "jitter", "duplicate", "reorder", "truncate", "corrupt"]
            ),
            st.sampled_from(["to_pc", "to_krc", "both"]),
            st.floats(0.0, 0.5),
            length=st.integers(1, 5),
        ),
        max_size=4,
    ),
    st.integers(0, 2**32),
)
@settings(max_examples=60, deadline=None)
def test_any_mixture_repeats_with_its_seed_and_invents_nothing(faults, seed):
    first, second = wire(*faults, seed=seed), wire(*faults, seed=seed)
    left = leave(first, 60)
    assert left == leave(second, 60)
    assert arrive(first, 60) == arrive(second, 60)
    awaited = [n for _, n, a in left if a == "yes"]
    # What is awaited is new to the PC each time, and never from the future.
    assert awaited == sorted(set(awaited))
    assert all(n <= cycle for cycle, n, _ in left)
    # In a cycle with anything at all, the last datagram is one that will be answered.
    last = {cycle: a for cycle, _, a in left}
    assert all(a == "yes" for a in last.values())


@pytest.mark.parametrize("bad", [{"probability": 1.5}, {"length": 0}, {"cycles": 0}, {"bits": 0}])
def test_impossible_faults_are_refused(bad):
    with pytest.raises(ConfigurationError):
        WireFault("loss", **bad)
