"""The terminal: commands and their shared options, results as JSON, Ctrl-C."""

from __future__ import annotations

import dataclasses
import difflib
import json
import logging
import math
import signal
from collections.abc import Callable, Iterator, Mapping
from enum import Enum
from functools import partial
from pathlib import Path
from types import FrameType
from typing import Any, Self

import click

from fri.errors import ConfigurationError, DataError, FileError
from lwr_driver.configuration import CONFIGS
from runner import status
from runner.output import OutputFile, check_replacement

_FORCE = "runner.force"
_HELD = "runner.held"
_LEVELS = (logging.WARNING, logging.INFO, logging.DEBUG)


class InputPath(click.Path):
    """A file or folder to be read. It must exist when the command runs; the shell completes it."""

    def __init__(self) -> None:
        super().__init__(path_type=Path)

    def require(self, path: Path, option: str = "") -> None:
        """Raise ConfigurationError, with a name that is near, unless `path` exists. option : with that path."""
        try:
            path.stat()
        except FileNotFoundError:
            folder = path.parent
            there = [entry.name for entry in folder.iterdir()] if folder.is_dir() else []
            near = difflib.get_close_matches(path.name, there, n=1)
            if near:
                advice = f"did you mean {folder / near[0]}?"
            else:
                advice = (
                    "correct the path"
                    if folder.is_dir()
                    else f"there is no folder {folder}; correct the path"
                )
            subject = f"{option} {path}".strip()
            raise ConfigurationError(f"{subject}: no such file or folder; {advice}") from None
        except OSError as error:
            raise FileError.of(error, f"{path} cannot be read") from error


class FiniteRange(click.FloatRange):
    """A finite number within a range."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """The number; `nan` and `inf` are refused."""
        number = super().convert(value, param, ctx)
        if not math.isfinite(number):
            self.fail(f"{number} is no finite number.", param, ctx)
        return number


PATH = InputPath()
NAMED_FILE = click.Path()
"""A file of that path, or of that name in `configs/`; the shell completes files."""


def default_file() -> str:
    """The `experiment.yaml` of a laboratory in the working folder, else the default one, on the emulator.

    A real arm is not moved by a file that nobody named: see `commanded`.
    """
    here = Path("experiment.yaml")
    # A folder of results has one too: it is a record, not a laboratory.
    if here.is_file() and not Path("progress.json").exists():
        return str(here)
    return str(CONFIGS / "experiments/default.yaml")


def implied(argument: str = "file") -> bool:
    """Whether nobody named the file of the present command."""
    source = click.get_current_context().get_parameter_source(argument)
    return source is None or source.name in ("DEFAULT", "DEFAULT_MAP")


def verbosity() -> int:
    """How often `-v` was given, before the command or behind it."""
    context = click.get_current_context(silent=True)
    return 0 if context is None else int(context.find_root().params.get("verbose") or 0)


def log_more(times: int) -> None:
    """Set the level of the log by the number of `-v`."""
    logging.getLogger().setLevel(_LEVELS[min(times, 2)])


def _verbose(context: click.Context, parameter: click.Parameter, value: int) -> None:
    if value:
        root = context.find_root()
        root.params["verbose"] = int(root.params.get("verbose") or 0) + value
        log_more(root.params["verbose"])


def _force(context: click.Context, parameter: click.Parameter, value: bool) -> None:
    context.meta[_FORCE] = value


def forced() -> bool:
    """Whether existing files may be replaced, by `--force`."""
    context = click.get_current_context(silent=True)
    return context is not None and bool(context.meta.get(_FORCE))


def tell(result: Any, as_json: bool) -> None:
    """Write a result to standard output: as JSON, else its tables, lines or text."""
    if as_json:
        click.echo(to_json(result.to_dict() if hasattr(result, "to_dict") else result))
    else:
        status.answer(*(result.pieces() if hasattr(result, "pieces") else [str(result)]))


def hold_json(content: Mapping[str, Any]) -> None:
    """Print this JSON object at the end of the command; an error until then is added to it."""
    click.get_current_context().meta[_HELD] = dict(content)


def held_json(context: click.Context) -> dict[str, Any]:
    """The content of `hold_json`, once; empty without any."""
    found: dict[str, Any] = context.meta.pop(_HELD, {})
    return found


def ask(question: str) -> bool:
    """Ask a person; the sentences before the question are wrapped above it."""
    status.clear()
    said, _, last = question.rpartition(". ")
    if said:
        status.write(f"{said}.")
    return click.confirm(last, default=False, err=True)


class Verb(click.Command):
    """A command with a check of its paths before its work: inputs must exist, outputs must not.

    `--verbose` belongs to each, `--force` to those with outputs.
    """

    def __init__(self, *arguments: Any, **named: Any) -> None:
        super().__init__(*arguments, **named)
        if any(isinstance(one.type, OutputFile) and one.type.replaces for one in self.params):
            about = "Replace what exists."
            self.params.append(
                click.Option(["--force"], is_flag=True, expose_value=False, callback=_force, help=about)
            )
        about = "Tables on the screen and more in the log; -vv every detail."
        self.params.append(
            click.Option(["-v", "--verbose"], count=True, expose_value=False, callback=_verbose, help=about)
        )

    def invoke(self, ctx: click.Context) -> Any:
        """Run the command, after a look at its files."""
        for parameter, path in self._paths(ctx):
            if isinstance(parameter.type, OutputFile):
                check_replacement(path, parameter.type, forced())
            elif isinstance(parameter.type, InputPath):
                parameter.type.require(path, parameter.opts[0] if isinstance(parameter, click.Option) else "")
        return super().invoke(ctx)

    def _paths(self, ctx: click.Context) -> Iterator[tuple[click.Parameter, Path]]:
        # Outputs first: a wrong place is told whatever the inputs are.
        for parameter in sorted(self.params, key=lambda one: not isinstance(one.type, OutputFile)):
            value = ctx.params.get(parameter.name or "")
            for path in value if isinstance(value, tuple) else (value,):
                if isinstance(path, Path):
                    yield parameter, path


verb = partial(click.command, cls=Verb)


json_option = click.option("--json", "as_json", is_flag=True, help="Machine-readable output.")
coupling_option = click.option(
    "--coupling", multiple=True, metavar="A:B", help="Two joints with coupled drives, such as A5:A6."
)
gear_ratio_option = click.option(
    "--gear-ratio",
    metavar="N[,N...]",
    help="Motor turns per joint turn, one for all or one per joint; default: from the reference or the arm file.",
)


stiffness_option = click.option(
    "--stiffness",
    metavar="K[,K...]",
    help="Of the joints [Nm/rad], one for all or one per joint, known within a factor of two; default: from the arm "
    "file.",
)


def arm_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """The options of a diagnosis on its arm: `arm`, `urdf`, `coupling`, `gear_ratio`, `stiffness`."""
    about = "Arm file (stiffness, gear ratios); default: the one of the sessions' robot."
    for option in (
        stiffness_option,
        gear_ratio_option,
        coupling_option,
        click.option("--urdf", type=PATH, help="Kinematics; default: the one in the first session."),
        click.option("--arm", type=NAMED_FILE, help=about),
    ):
        command = option(command)
    return command


class GroupedCommand(Verb):
    """A command with its options under headings in the help.

    groups : heading -> parameter names of the options; all others follow under "Options".
    """

    def __init__(self, *arguments: Any, groups: Mapping[str, tuple[str, ...]], **named: Any) -> None:
        super().__init__(*arguments, **named)
        self.groups = groups

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the options, group by group."""
        options = (one for one in self.get_params(ctx) if isinstance(one, click.Option))
        records = {option.name: option.get_help_record(ctx) for option in options}
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


_STOPPING = tuple(
    getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGTSTP", "SIGQUIT") if hasattr(signal, name)
)


class Interrupts:
    """Ctrl-C during a motion, as a context manager. SIGTERM, Ctrl-Z and Ctrl-\\ count as one Ctrl-C.

    A suspended runner could not stop the arm any more, which its own process drives on.

    on_first : called at the first interrupt; requests the jerk-limited stop. on_second : called at the second;
    stops the answers, and the controller leaves command mode by itself.
    """

    def __init__(self, on_first: Callable[[], None], on_second: Callable[[], None]) -> None:
        self._actions = (on_first, on_second)
        self._previous: dict[int, Any] = {}
        self.count = 0

    def __enter__(self) -> Self:
        for number in _STOPPING:
            self._previous[number] = signal.signal(number, self._handle)
        return self

    def __exit__(self, *_: object) -> None:
        for number, previous in self._previous.items():
            signal.signal(number, previous)

    def _handle(self, number: int, frame: FrameType | None) -> None:
        self.count += 1
        if self.count <= len(self._actions):
            self._actions[self.count - 1]()
