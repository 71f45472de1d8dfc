"""`lwr-run`: the command line. Modules of commands are imported on use."""

from __future__ import annotations

import difflib
import errno
import importlib
import logging
import os
import shutil
import sys
import textwrap
import traceback
from pathlib import Path
from typing import Any, NoReturn

import click

from fri.errors import FileError, LwrError, OperatorError
from runner import status

# Before the import of numpy: for small matrices a second BLAS thread costs time.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

log = logging.getLogger(__name__)

_AS_JSON = "runner.as_json"
_NARROW = 52

VERBS = {
    "init": "a new laboratory: experiment file, arm, cell, KRL program",
    "doctor": "examine this computer, the link and the controller",
    "record": "log what the controller sends, nothing is commanded",
    "hold": "enter command mode, hold the pose, leave it",
    "jog": "move one joint by some degrees",
    "home": "move to the home position",
    "experiment": "the whole chain: plan, drive, log, swap the payload, estimate",
    "plan": "an optimal exciting motion within all limits",
    "check": "every check of an experiment file, without motion",
    "preview": "the planned motion in 3D in the browser",
    "replay": "a session beside its simulation in 3D, or as a video",
    "report": "report.html of a finished experiment, figures and tables for a paper",
    "emulator": "run the emulated controller and arm until interrupted",
    "identify": "estimate a model from session logs",
    "validate": "test a model on sessions it was not fitted to",
    "commission": "record a healthy-arm baseline",
    "diagnose": "model errors by cause and joint, and an extended model",
    "compare": "significant differences between two models",
    "batch": "identify and diagnose every arm's every day",
    "trend": "changes of an arm over its days, and arms unlike the others",
    "payload": "the payload's ten parameters from a known arm and one session",
    "export": "a model as URDF, MJCF, or stand-alone C and numpy code",
    "info": "summary of a session log",
    "recover": "repair the log of a killed recorder",
    "attach": "add a controller's trace file to a session log",
    "import": "convert recordings of other programs to a session log",
    "schema": "JSON Schemas of the YAML files, for editors",
    "example": "fetch a public recording of a real arm",
    "completion": "completion script for bash, zsh or fish",
}
FAMILIES = {
    "setup": ("doctor", "emulator", "completion"),
    "steps": ("record", "hold", "jog", "home"),
    "motions": ("plan", "check", "preview"),
    "models": ("validate", "compare", "payload", "export"),
    "fleet": ("batch", "trend"),
    "logs": ("report", "info", "recover", "attach", "import"),
}

EXIT_CODES = """\b
Exit codes:
  0 success          4 aborted by the operator
  1 internal error   5 robot or controller fault
  2 usage or file    6 link fault
  3 refused          7 measurements unusable"""


class Verbs(click.Group):
    """A group with commands imported on use, for instant help."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Names in the order of use."""
        return list(VERBS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """The command of that name, imported now."""
        if cmd_name not in VERBS:
            return None
        family = next((family for family, verbs in FAMILIES.items() if cmd_name in verbs), cmd_name)
        module = importlib.import_module(f"runner.commands.{family}")
        command: click.Command = getattr(module, "command" if family == cmd_name else f"{cmd_name}_command")
        return command

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """The command of the first word; the nearest one is suggested for a misspelt word."""
        name = args[0]
        if name not in VERBS and not name.startswith("-"):
            near = difflib.get_close_matches(name, VERBS, n=1)
            advice = f"did you mean {near[0]!r}?" if near else "`lwr-run -h` lists the commands."
            raise click.UsageError(f"no command {name!r}; {advice}", ctx)
        return super().resolve_command(ctx, args)

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Read the command line; note whether JSON is wanted, for errors come as JSON then."""
        ctx.meta[_AS_JSON] = "--json" in args
        columns = shutil.get_terminal_size().columns
        if columns < _NARROW:  # click writes no less
            ctx.terminal_width = columns
        try:
            return super().parse_args(ctx, args)
        except click.UsageError as error:
            _answer(ctx, error.format_message(), "UsageError", error.exit_code)
            raise _fitted(error) from error

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """List the verbs without importing them."""
        with formatter.section("Commands"):
            formatter.write_dl(list(VERBS.items()))

    def invoke(self, ctx: click.Context) -> Any:
        """Run the command; every error becomes one message and an exit code."""
        try:
            result = super().invoke(ctx)
            _answer(ctx)
            return result
        except LwrError as error:
            _complain(ctx, error)
        except (KeyboardInterrupt, click.Abort):
            status.clear()
            click.echo("aborted", err=True)
            _answer(ctx, "aborted", OperatorError.__name__, OperatorError.exit_code)
            ctx.exit(OperatorError.exit_code)
        except click.UsageError as error:
            _answer(ctx, error.format_message(), type(error).__name__, error.exit_code)
            raise _fitted(error) from error
        except click.ClickException as error:
            _answer(ctx, error.format_message(), type(error).__name__, error.exit_code)
            raise
        except (click.exceptions.Exit, BrokenPipeError):
            raise
        except OSError as error:
            _complain(ctx, FileError.of(error))
        except MemoryError:
            _complain(ctx, FileError.of(OSError(errno.ENOMEM, os.strerror(errno.ENOMEM)), "memory"))
        except Exception as error:
            log.debug("internal error", exc_info=True)
            place = traceback.extract_tb(error.__traceback__)[-1]
            _complain(
                ctx,
                LwrError(
                    f"internal error, {type(error).__name__}: {error} ({Path(place.filename).name}, line "
                    f"{place.lineno}). Please report it with what `lwr-run -vv` prints"
                ),
            )
        finally:
            status.clear()


def _fitted(error: click.UsageError) -> click.UsageError:
    """The error with its message broken for a terminal, where people look at it."""
    if not status.watched(sys.stderr):
        return error
    width = shutil.get_terminal_size().columns
    text = textwrap.fill(f"Error: {error.format_message()}", width, subsequent_indent="  ")
    return click.UsageError(text.removeprefix("Error: "), error.ctx)


def _complain(ctx: click.Context, error: LwrError) -> NoReturn:
    status.write(f"{type(error).__name__}: {error}", "red")
    log.debug("raised here", exc_info=error)
    _answer(ctx, str(error), type(error).__name__, error.exit_code)
    ctx.exit(error.exit_code)


def _answer(ctx: click.Context, error: str = "", kind: str = "", exit_code: int = 0) -> None:
    """Print the JSON object held back, with the error; an error alone if JSON is wanted and none was held."""
    if not ctx.meta.get(_AS_JSON):
        return
    from runner.terminal import held_json, to_json

    content = held_json(ctx)
    if error:
        content |= {"error": error, "kind": kind, "exit_code": exit_code}
    if content:
        click.echo(to_json(content))


class _Screen(logging.Handler):
    """Log records on standard error, above the live line; a warning about data once, however often they are read."""

    def __init__(self) -> None:
        super().__init__()
        self._said: set[str] = set()

    def emit(self, record: logging.LogRecord) -> None:
        """Write one record."""
        if record.name.startswith("ident.") and record.levelno >= logging.WARNING:
            said = record.getMessage()
            if said in self._said:
                return
            self._said.add(said)
        status.write(self.format(record))


@click.group(cls=Verbs, epilog=EXIT_CODES, context_settings={"help_option_names": ["-h", "--help"]})
@click.option(
    "-v", "--verbose", count=True, help="Tables on the screen and more in the log; -vv every detail."
)
@click.version_option(package_name="lwr-identification", prog_name="lwr-run")
def main(verbose: int) -> None:
    """Identify the dynamics of a KUKA LWR4+: drive the arm, log the motion, estimate the model.

    \b
    lwr-run experiment                   the whole chain against the built-in emulator
    lwr-run check my_lab.yaml            every check of an experiment file, no motion
    lwr-run identify a.mcap b.mcap       a model from logs
    """
    level = (logging.WARNING, logging.INFO, logging.DEBUG)[min(verbose, 2)]
    logging.basicConfig(level=level, format="%(levelname)s %(name)s: %(message)s", handlers=[_Screen()])


if __name__ == "__main__":
    main()
