"""Ctrl-C while the arm moves: once stops within limits, twice drops the link."""

from __future__ import annotations

import signal
from collections.abc import Callable
from types import FrameType, TracebackType
from typing import Self

__all__ = ["Interrupts"]


class Interrupts:
    """Turns SIGINT (and SIGTERM, as one Ctrl-C) into a first and a second request.

    Use as a context manager around a motion. Outside of it Python's own handling is restored.

    on_first : called at the first interrupt: ask for the jerk-limited stop.
    on_second : called at the second: stop answering, so that the controller falls back by itself.
    """

    def __init__(self, on_first: Callable[[], None], on_second: Callable[[], None]) -> None:
        self._actions = (on_first, on_second)
        self._previous: dict[int, object] = {}
        self.count = 0

    def __enter__(self) -> Self:
        for number in (signal.SIGINT, signal.SIGTERM):
            self._previous[number] = signal.signal(number, self._handle)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for number, previous in self._previous.items():
            signal.signal(number, previous)  # type: ignore[arg-type]

    def _handle(self, number: int, frame: FrameType | None) -> None:
        self.count += 1
        if self.count <= len(self._actions):
            self._actions[self.count - 1]()
