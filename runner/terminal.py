"""The terminal: shared options, results as JSON, the status line, Ctrl-C."""

from __future__ import annotations

import dataclasses
import json
import math
import signal
import sys
import time
from collections.abc import Callable, Mapping
from enum import Enum
from pathlib import Path
from types import FrameType
from typing import Any, Self, TextIO

import click

from fri.errors import DataError

PATH = click.Path(path_type=Path)
_BAR = 24


json_option = click.option("--json", "as_json", is_flag=True, help="Machine-readable output.")
coupling_option = click.option(
    "--coupling", multiple=True, metavar="A:B", help="Two joints with coupled drives, such as A5:A6."
)
gear_ratio_option = click.option(
    "--gear-ratio",
    metavar="N[,N...]",
    help="Motor turns per turn of the joint, one for all or one per joint; default: from the arm file.",
)


class GroupedCommand(click.Command):
    """A command with its options under headings in the help.

    groups : heading -> parameter names of the options; all others follow under "Options".
    """

    def __init__(self, *arguments: Any, groups: Mapping[str, tuple[str, ...]], **named: Any) -> None:
        super().__init__(*arguments, **named)
        self.groups = groups

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the options, group by group."""
        records = {parameter.name: parameter.get_help_record(ctx) for parameter in self.get_params(ctx)}
        shown = {name for names in self.groups.values() for name in names}
        rest = tuple(str(name) for name in records if name not in shown)
        for heading, names in (*self.groups.items(), ("Options", rest)):
            with formatter.section(heading):
                formatter.write_dl([record for name in names if (record := records[name]) is not None])


def plain(value: Any) -> Any:
    """`value` as content for JSON.

    Dataclasses and mappings become dicts, sequences and arrays lists, enumerations names, non-finite numbers
    None, and anything else text.
    """
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {field.name: plain(getattr(value, field.name)) for field in dataclasses.fields(value)}
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if type(value).__module__ == "numpy":  # help pages do without its import
        return plain(value.tolist())
    if isinstance(value, (list, tuple, set, frozenset)):
        return [plain(item) for item in value]
    if isinstance(value, Enum):
        return value.name
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return value if value is None or isinstance(value, (bool, int, str)) else str(value)


def to_json(value: Any) -> str:
    """`plain(value)` as text."""
    return json.dumps(plain(value), indent=1)


def write_json(path: Path, content: Any) -> None:
    """Write `plain(content)` in one step, read back first; ConfigurationError for a place that cannot be written."""
    # Imported on first use: the help pages need no models.
    from ident.model.model_file import write_checked

    expected = plain(content)

    def check(text: str) -> None:
        try:
            again = json.loads(text)
        except ValueError as error:
            raise DataError(f"no JSON: {error}") from error
        if again != expected:
            raise DataError("the content read back differs from that written")

    write_checked(path, to_json(content) + "\n", check)


class StatusLine:
    """One line, rewritten in place on a terminal; elsewhere one line per phase.

    stream : standard error by default; results go to standard output. interval_s : shortest time between rewrites.
    """

    def __init__(self, stream: TextIO | None = None, interval_s: float = 0.2) -> None:
        self._stream = stream if stream is not None else sys.stderr
        self._interval = interval_s
        self._live = self._stream.isatty()
        self._next = 0.0
        self._heading = ""
        self._width = 0

    def show(self, heading: str, fraction: float, detail: str) -> None:
        """Show progress: `heading` (session and phase), `fraction` of the motion from 0 to 1, `detail`."""
        now = time.monotonic()
        if self._live and (now >= self._next or fraction >= 1.0 or heading != self._heading):
            filled = round(_BAR * min(max(fraction, 0.0), 1.0))
            bar = "█" * filled + "░" * (_BAR - filled)
            text = f"{heading:<26} {bar} {100 * fraction:3.0f} %  {detail}"
            self._write("\r" + text.ljust(self._width))
            self._width = len(text)
            self._next = now + self._interval
        elif not self._live and heading != self._heading:
            self._write(f"{heading}  {detail}\n")
        self._heading = heading

    def say(self, text: str) -> None:
        """Print a permanent line above the status line."""
        self.clear()
        self._write(text + "\n")

    def clear(self) -> None:
        """Remove the status line."""
        if self._live and self._width:
            self._write("\r" + " " * self._width + "\r")
        self._width, self._heading = 0, ""

    def _write(self, text: str) -> None:
        self._stream.write(text)
        self._stream.flush()


class Interrupts:
    """Ctrl-C during a motion, as a context manager. SIGTERM counts as one Ctrl-C.

    on_first : called at the first interrupt; requests the jerk-limited stop. on_second : called at the second;
    stops the answers, and the controller leaves command mode by itself.
    """

    def __init__(self, on_first: Callable[[], None], on_second: Callable[[], None]) -> None:
        self._actions = (on_first, on_second)
        self._previous: dict[int, Any] = {}
        self.count = 0

    def __enter__(self) -> Self:
        for number in (signal.SIGINT, signal.SIGTERM):
            self._previous[number] = signal.signal(number, self._handle)
        return self

    def __exit__(self, *_: object) -> None:
        for number, previous in self._previous.items():
            signal.signal(number, previous)

    def _handle(self, number: int, frame: FrameType | None) -> None:
        self.count += 1
        if self.count <= len(self._actions):
            self._actions[self.count - 1]()
