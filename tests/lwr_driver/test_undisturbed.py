"""Ctrl-C does not break in two what acquires or gives back."""

from __future__ import annotations

import signal
import threading

import pytest

from lwr_driver.realtime import undisturbed


def test_interrupt_comes_when_the_block_is_done():
    done = []

    def work():
        with undisturbed():
            signal.raise_signal(signal.SIGINT)
            done.append("gave back")

    with pytest.raises(KeyboardInterrupt):
        work()
    assert done == ["gave back"]
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_error_of_the_block_is_not_hidden():
    def work():
        with undisturbed():
            signal.raise_signal(signal.SIGINT)
            raise ValueError("broken")

    with pytest.raises(ValueError, match="broken"):
        work()


def test_other_handlers_of_the_signal_stay_in_force(monkeypatch):
    seen = []
    previous = signal.signal(signal.SIGINT, lambda *_: seen.append(1))
    try:
        with undisturbed():
            signal.raise_signal(signal.SIGINT)
            assert seen == [1]
    finally:
        signal.signal(signal.SIGINT, previous)


def test_other_threads_may_use_it():
    found = []

    def work():
        with undisturbed():
            found.append(signal.getsignal(signal.SIGINT))

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert found == [signal.default_int_handler]
