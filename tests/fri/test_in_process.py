"""The network inside one process, and both ends of the link on it."""

from __future__ import annotations

import numpy as np
import pytest

from fri.controller_end import ControllerEnd
from fri.errors import NetworkError
from fri.in_process import Network
from fri.krc import KrcPolicy, KrcSession, Sample
from fri.remote import LinkEventKind, RemoteEnd
from tests.fri.fri_rig import LIMITS, Q_START, QUICK

HERE, THERE = ("127.0.0.1", 5000), ("127.0.0.2", 6000)


def test_datagrams_arrive_in_order_with_their_source_and_as_copies() -> None:
    network = Network()
    here, there = network.bind(*HERE), network.bind(*THERE)
    content = bytearray(b"one")
    here.sendto(content, THERE)
    content[:] = b"two"
    here.sendto(content, THERE)
    buffer = bytearray(2)
    assert there.recvfrom(100) == (b"one", HERE)
    assert there.recvfrom_into(buffer) == (2, HERE)
    assert bytes(buffer) == b"tw"
    with pytest.raises(BlockingIOError):
        there.recvfrom_into(buffer)


def test_a_closed_port_refuses_and_its_address_is_free_again() -> None:
    network = Network()
    here, there = network.bind(*HERE), network.bind(*THERE)
    with pytest.raises(OSError, match="in use"):
        network.bind(*THERE)
    there.close()
    with pytest.raises(ConnectionRefusedError):
        here.sendto(b"lost", THERE)
    assert network.bind(*THERE).getsockname() == THERE
    free = {network.bind("127.0.0.1").getsockname() for _ in range(3)}
    assert len(free) == 3


def test_both_ends_exchange_packets_and_notice_the_end_of_the_other() -> None:
    network = Network()
    remote = RemoteEnd("127.0.0.1", 5000, network=network)
    with pytest.raises(NetworkError, match="cannot bind"):
        RemoteEnd("127.0.0.1", 5000, network=network)
    controller = ControllerEnd(remote.address, network=network)
    session = KrcSession(LIMITS, Q_START, KrcPolicy(**QUICK))
    session.fri_open(1)
    for _ in range(3):
        assert remote.receive(10.0) is None  # nothing is there, and nothing waits
        controller.send(session.packet(Sample()))
        assert remote.pending()
        assert remote.receive(0.0) is not None
        remote.answer()
        datagram = controller.receive(10.0)
        assert datagram is not None
        assert session.receive(datagram)
        session.close_cycle()
    assert np.array_equal(remote.command["jnt_pos"], np.float32(Q_START))
    assert remote.received == 3
    remote.close()
    controller.send(session.packet(Sample()))
    assert controller.refused > 0


def test_cycles_ahead_of_time_are_counted_and_told_once_until_they_pause() -> None:
    network = Network()
    session = KrcSession(LIMITS, Q_START, KrcPolicy(**QUICK))
    session.fri_open(2)
    with (
        RemoteEnd("127.0.0.1", 0, network=network) as remote,
        ControllerEnd(remote.address, network=network) as end,
    ):
        told = []
        for cycle in range(2000):
            end.send(session.packet(Sample()))
            assert remote.receive(0.0) is not None
            session.close_cycle()
            if cycle in (1, 2, 900, 1950):
                remote.tell_ahead(2, "early")
                told.append(sum(event.kind is LinkEventKind.AHEAD for event in remote.events))
    # A thousand packets without one make the next one news.
    assert told == [1, 1, 1, 2]
    assert remote.ahead == 8
