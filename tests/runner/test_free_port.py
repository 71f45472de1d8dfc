"""A UDP port for an emulator and its driver."""

from __future__ import annotations

import socket

import pytest

from fri.errors import NetworkError
from runner import laboratory
from runner.laboratory import free_port


def test_a_port_is_free_and_none_that_another_program_gets_by_itself(monkeypatch: pytest.MonkeyPatch) -> None:
    port = free_port("127.0.0.1")
    monkeypatch.setattr(laboratory, "_UNASSIGNED", range(port, port + 2))
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as held:
        held.bind(("127.0.0.1", port))
        assert free_port("127.0.0.1") == port + 1
        monkeypatch.setattr(laboratory, "_UNASSIGNED", range(port, port + 1))
        with pytest.raises(NetworkError, match="no UDP port"):
            free_port("127.0.0.1")
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as another:
        another.bind(("127.0.0.1", 0))
        assert another.getsockname()[1] >= 32768 > port
