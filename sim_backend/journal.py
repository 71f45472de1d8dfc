"""The emulator's events on the terminal: the session's with `-v`, its finer changes with `-vv`."""

from __future__ import annotations

import logging
from typing import Any

from fri.states import Event, EventKind

log = logging.getLogger("emulator")

_ENTERED = (EventKind.OPENED, EventKind.STARTED, EventKind.STOPPED, EventKind.CLOSED)


class Journal:
    """Writes to the log `emulator`, with the controller's time. Repeated refusals are told once."""

    def __init__(self) -> None:
        self.time_s = 0.0
        self._refused = ""
        self._seen: dict[str, Any] = {}
        self.detailed = log.isEnabledFor(logging.DEBUG)

    def _tell(self, level: int, text: str) -> None:
        log.log(level, "%10.3f s  %s", self.time_s, text)

    def event(self, event: Event) -> None:
        """An event of the session."""
        if event.kind is EventKind.REFUSED:
            level = logging.DEBUG if event.text == self._refused else logging.WARNING
            self._refused = event.text
            self._tell(level, event.text)
            return
        self._refused = ""
        mode = {EventKind.STARTED: "CMD", EventKind.CLOSED: "OFF"}.get(event.kind, "MON")
        dropped = "" if event.kind in _ENTERED else "dropped: "
        self._tell(logging.INFO, f"{mode}: {dropped}{event.text}")

    def say(self, text: str) -> None:
        """A message of the KRL program or of the operator."""
        self._tell(logging.INFO, text)

    def warn(self, text: str) -> None:
        """Something that the user must see without `-v`."""
        self._tell(logging.WARNING, text)

    def watch(self, **values: Any) -> None:
        """Tell changes of `values`; for `-vv`."""
        for name, value in values.items():
            if name in self._seen and self._seen[name] != value:
                self._tell(logging.DEBUG, f"{name.replace('_', ' ')} {value}")
            self._seen[name] = value
