"""`lwr-run`: the commands a person types; each verb is a module of its own, imported when it is used."""

from __future__ import annotations

import importlib
import logging
import os
import sys
from typing import Any

import click

from fri.errors import LwrError, OperatorError

# Before numpy is imported: the matrices are small, and a second BLAS thread costs more than it gives.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

__all__ = ["main"]

VERBS = {
    "doctor": "is this computer ready, and the link, and the controller?",
    "experiment": "plan, drive, log, swap the payload, estimate: the whole chain",
    "plan": "an optimal exciting motion inside all limits",
    "check": "dry run of an experiment file: every check, no motion",
    "preview": "the planned motion in 3D in the browser, before anything moves",
    "report": "report.html of a finished experiment, figures as SVG",
    "emulator": "run the emulated controller and arm until interrupted",
    "identify": "estimate a model from session logs",
    "validate": "hold a model against sessions that it has not seen",
    "commission": "learn the healthy arm, for later diagnoses to be held against",
    "diagnose": "what the simulation gets wrong, by cause and joint; extends the model",
    "compare": "two models, parameter by parameter, with significance",
    "payload": "the payload's ten parameters from a known arm and one session",
    "export": "a model as URDF, MJCF, or stand-alone C and numpy code",
    "info": "what a session log contains",
    "recover": "make a session log whole whose recorder was killed",
    "attach": "add a controller's trace file to a session log",
    "import": "turn other people's CSV and NPZ files into a session log",
    "completion": "what bash, zsh or fish need to complete commands and options",
}
MODULES = {"import": "import_log"}

EXIT_CODES = """\b
Exit codes:
  0 success          4 aborted by the operator
  1 internal error   5 robot or controller fault
  2 usage or file    6 link fault
  3 refused          7 measurements unusable"""


class Verbs(click.Group):
    """A group whose commands are imported only when they are called, so that help is instant."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Names in the order in which a person meets them."""
        return list(VERBS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """The command of that name, imported now."""
        if cmd_name not in VERBS:
            return None
        module = importlib.import_module(f"runner.commands.{MODULES.get(cmd_name, cmd_name)}")
        command: click.Command = module.command
        return command

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """List the verbs without importing them."""
        with formatter.section("Commands"):
            formatter.write_dl(list(VERBS.items()))

    def invoke(self, ctx: click.Context) -> Any:
        """Run the command; an error of ours becomes one message and its exit code."""
        try:
            return super().invoke(ctx)
        except LwrError as error:
            click.secho(f"{type(error).__name__}: {error}", fg="red", err=True)
            ctx.exit(error.exit_code)
        except (KeyboardInterrupt, click.Abort):
            click.echo("aborted", err=True)
            ctx.exit(OperatorError.exit_code)


@click.group(cls=Verbs, epilog=EXIT_CODES, context_settings={"help_option_names": ["-h", "--help"]})
@click.option("-v", "--verbose", count=True, help="Say more: -v for what happens, -vv for every detail.")
@click.version_option(package_name="lwr-identification", prog_name="lwr-run")
def main(verbose: int) -> None:
    """Identify the dynamics of a KUKA LWR4+: drive the arm, log the motion, estimate the model.

    \b
    lwr-run experiment                   the whole chain against the built-in emulator
    lwr-run check my_lab.yaml            every check of an experiment file, no motion
    lwr-run identify a.mcap b.mcap       a model from logs
    """
    level = (logging.WARNING, logging.INFO, logging.DEBUG)[min(verbose, 2)]
    logging.basicConfig(level=level, format="%(levelname)s %(name)s: %(message)s", stream=sys.stderr)


if __name__ == "__main__":
    main()
