"""The live status line: what the arm does now, how far the motion is, how good the link is."""

from __future__ import annotations

import sys
import time
from typing import TextIO

__all__ = ["StatusLine"]

BAR = 24


class StatusLine:
    """One line, rewritten in place on a terminal; on anything else one line per phase.

    Parameters
    ----------
    stream : where to write; standard error by default, so that results can be piped.
    interval_s : at most one rewrite in this time.
    """

    def __init__(self, stream: TextIO | None = None, interval_s: float = 0.2) -> None:
        self._stream = stream if stream is not None else sys.stderr
        self._interval = interval_s
        self._live = self._stream.isatty()
        self._next = 0.0
        self._heading = ""
        self._width = 0

    def show(self, heading: str, fraction: float, detail: str) -> None:
        """Show progress: `heading` (session and phase), `fraction` of the motion 0 to 1, `detail` text."""
        now = time.monotonic()
        if self._live and (now >= self._next or fraction >= 1.0 or heading != self._heading):
            filled = round(BAR * min(max(fraction, 0.0), 1.0))
            bar = "█" * filled + "░" * (BAR - filled)
            text = f"{heading:<26} {bar} {100 * fraction:3.0f} %  {detail}"
            self._stream.write("\r" + text.ljust(self._width))
            self._stream.flush()
            self._width = len(text)
            self._next = now + self._interval
        elif not self._live and heading != self._heading:
            self._stream.write(f"{heading}  {detail}\n")
            self._stream.flush()
        self._heading = heading

    def say(self, text: str) -> None:
        """A line that stays, above the status line."""
        self.clear()
        self._stream.write(text + "\n")
        self._stream.flush()

    def clear(self) -> None:
        """Remove the status line."""
        if self._live and self._width:
            self._stream.write("\r" + " " * self._width + "\r")
            self._stream.flush()
        self._width = 0
        self._heading = ""
