"""Messages and the live line on standard error, by rich; plain text where nobody watches."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, TextIO

from lwr_driver.listing import Listing, Piece

if TYPE_CHECKING:  # rich is imported on the first use at a terminal: help pages and pipes go without
    from rich.console import Console, ConsoleOptions, RenderResult
    from rich.live import Live
    from rich.padding import Padding
    from rich.text import Text

STYLES = {"good": "green", "look": "yellow", "bad": "red"}
"""Colour by verdict."""

# Verdict words in the cells of tables.
_VERDICTS = {
    **dict.fromkeys(("ok", "good", "yes", "holds", "harmless", "kept"), "green"),
    **dict.fromkeys(("look", "note", "hint", "differs", "advice"), "yellow"),
    **dict.fromkeys(("FAIL", "bad", "NO", "VIOLATED", "violated"), "bold red"),
}
_WIDE = 60
_BARS = (6, 24)
_GAP = 2
_REFRESH_HZ = 4.0

_shown: list[StatusLine] = []


def watched(stream: TextIO) -> bool:
    """Whether a person watches `stream`: a terminal that moves its cursor, and no CI job."""
    dumb = os.environ.get("TERM", "").lower() in ("dumb", "unknown")
    return stream.isatty() and not dumb and not os.environ.get("CI")


def console(stream: TextIO) -> Console:
    """The console of a watched stream. Colours follow `NO_COLOR`, the width follows the window."""
    from rich.console import Console

    return Console(file=stream, highlight=False, markup=False, emoji=False)


def write(piece: Piece, style: str = "", *, stream: TextIO | None = None, command: bool = False) -> None:
    """Write text or a table above the live line, by default to standard error; on a terminal to fit and in colour.

    command : for the shell; a broken line goes on behind a backslash.
    """
    stream = sys.stderr if stream is None else stream
    if not watched(stream):
        stream.write(f"{piece}\n")
        stream.flush()
        return
    above = next((one for one in _shown if one.stream is stream), None)
    if above is None:
        clear()
    place = console(stream) if above is None or above.console is None else above.console
    if isinstance(piece, Listing):
        for table in piece.fitted(place.width):
            place.print(_table(table))
        return
    for line in piece.split("\n"):
        place.print(_hung(line, place.width, style, command))


def answer(*pieces: Piece) -> None:
    """Write results to standard output."""
    for piece in pieces:
        write(piece, stream=sys.stdout)


def next_step(command: str, stream: TextIO | None = None) -> None:
    """Write the next shell command, by default to standard output."""
    write(command, "bold", stream=sys.stdout if stream is None else stream, command=True)


def clear() -> None:
    """Remove the live line, before a question or the end."""
    for status in list(_shown):
        status.clear()


def _table(listing: Listing) -> Padding:
    """A table for the screen, verdict words in colour."""
    from rich.padding import Padding
    from rich.table import Table
    from rich.text import Text

    table = Table(box=None, pad_edge=False, padding=(0, 2, 0, 0), header_style="bold")
    for name, right in zip(listing.head, listing.numbers(), strict=True):
        table.add_column(Text(name), justify="right" if right else "left", no_wrap=right, overflow="fold")
    for row in listing.rows:
        table.add_row(*(Text(cell, style=_VERDICTS.get(cell, "")) for cell in row))
    return Padding(table, (0, 0, 0, listing.indent), expand=False)


def _hung(line: str, width: int, style: str, command: bool) -> Text:
    """A line broken between words, continued under its indentation; a path is broken behind a slash."""
    from rich.text import Text

    indent = len(line) - len(line.lstrip())
    hang = " " * min(indent + 2, width // 4)
    width -= 2 if command else 0
    rows, row = [], line[:indent]
    for number, word in enumerate(line[indent:].replace(" %", "\u00a0%").split(" ")):
        glued = f"{row} {word}" if number else row + word
        if len(glued) <= width:
            row = glued
            continue
        if number:
            rows.append(row + " " * command)
            row = hang
        *whole, word = list(_pieces(word, width - len(hang))) or [""]
        for piece in whole:
            rows.append(row + piece)
            row = ""
        row += word
    text = ("\\\n" if command else "\n").join([*rows, row]).replace("\u00a0", " ")
    return Text(text, style=style, no_wrap=True, overflow="ignore")


def _pieces(word: str, width: int) -> Iterator[str]:
    """Pieces of a word that end behind a slash, none longer than `width`."""
    while word:
        cut = len(word) if len(word) <= width else word.rfind("/", 0, width) + 1
        cut = cut or width
        yield word[:cut]
        word = word[cut:]


def duration(seconds: float) -> str:
    """A time as minutes and seconds, 0:07, or with hours, 1:02:03."""
    minutes, rest = divmod(max(0, round(seconds)), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"


@dataclass
class _Line:
    """The live line. fraction : of the work done, None if unknown. details : the most important first."""

    heading: str = ""
    fraction: float | None = None
    details: Sequence[str] = ()
    began: float = field(default_factory=time.monotonic)
    first: float = 0.0

    def left(self) -> str:
        """Remaining time at the pace so far."""
        passed, done = time.monotonic() - self.began, (self.fraction or 0.0) - self.first
        if done <= 0.0 or passed < 1.0:
            return "-:--"
        return duration(passed * (1.0 - self.first - done) / done)

    def text(self, width: int) -> Text:
        """The line within `width` columns, one left free."""
        from rich.text import Text

        width -= 1
        passed = time.monotonic() - self.began
        wide = width >= _WIDE
        if self.fraction is None:
            head, bar, tail = self.heading, 0, duration(passed)
        else:
            share = min(max(self.fraction, 0.0), 1.0)
            bar = min(max(width // 5, _BARS[0]), _BARS[1])
            tail = f"{100 * share:3.0f} %  {self.left()} left" if wide else self.left()
            head = self.heading
        room = width - len(tail) - _GAP - (bar + _GAP if bar else 0)
        line = Text(no_wrap=True, overflow="crop")
        line.append(head if len(head) <= room else head[: room - 1] + "…", style="bold")
        if bar:
            done = round(bar * share)
            line.append(" " * _GAP)
            line.append("━" * done, style="green")
            line.append("─" * (bar - done), style="bright_black")
        line.append(" " * _GAP + tail, style="cyan")
        for detail in self.details:
            if len(line) + _GAP + len(detail) <= width:
                line.append(" " * _GAP + detail, style="bright_black")
        return line

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        yield self.text(options.max_width)


class StatusLine:
    """The progress of a command: one live line below its messages where a person watches, else messages only.

    stream : standard error by default; results go to standard output.
    """

    def __init__(self, stream: TextIO | None = None) -> None:
        self.stream = stream if stream is not None else sys.stderr
        self._watched = watched(self.stream)
        self._line = _Line()
        self._live: Live | None = None
        self._task = ""
        self._told: set[str] = set()
        self.console = console(self.stream) if self._watched else None

    def show(self, task: str, fraction: float | None = None, *details: str, phase: str = "") -> None:
        """Show progress. task : such as a session; phase : of it; fraction : of the task, 0 to 1, None if unknown.

        details : the most important first; those without room are left out. In a pipe, a task with a fraction is told
        once.
        """
        if task != self._task:
            self._task, self._told = task, set()
            self._line = _Line(first=fraction or 0.0)
            if not self._watched and fraction is not None:
                self.say(task)
        if self._watched:
            heading = f"{task}: {phase}" if phase else task
            new = heading != self._line.heading
            self._line.heading, self._line.fraction, self._line.details = heading, fraction, details
            self._draw(new)

    def wait(self, awaited: str, since_s: float, seen: str, advice: str) -> None:
        """Say once what is awaited, with the advice, and count the seconds. advice : none is needed if empty."""
        self._task = f"waiting for {awaited}"
        text = f"{self._task}. {advice}"
        if advice and text not in self._told:
            self._told.add(text)
            self.say(text)
        if self._watched:
            self._line = _Line(self._task, None, seen.split(", "), time.monotonic() - since_s)
            self._draw()

    def say(self, text: str, style: str = "") -> None:
        """Write a lasting message above the live line."""
        if self._watched:
            write(text, style, stream=self.stream)
        else:
            self.stream.write(text + "\n")
            self.stream.flush()

    def clear(self) -> None:
        """Remove the live line."""
        if self._live is not None:
            self._live.stop()
            self._live = None
            _shown.remove(self)
        self._task = ""

    def _draw(self, at_once: bool = False) -> None:
        """Draw the line with the next refresh, or at once, as a phase that ends before it."""
        if self._live is None:
            from rich.live import Live

            self._live = Live(
                self._line,
                console=self.console,
                refresh_per_second=_REFRESH_HZ,
                transient=True,
                redirect_stdout=False,
                redirect_stderr=False,
            )
            self._live.start()
            _shown.append(self)
        self._live.update(self._line, refresh=at_once)
