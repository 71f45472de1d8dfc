"""Pieces that commands share: options in groups, and values with a grammar of their own."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, TypeVar

import click

__all__ = ["GroupedCommand", "coupling_option", "gear_ratio_option", "json_option", "number_or"]

Decorated = TypeVar("Decorated", bound=Callable[..., Any])


def json_option(command: Decorated) -> Decorated:
    """The option --json, the same for every command that reports."""
    option = click.option("--json", "as_json", is_flag=True, help="Machine-readable output.")
    return option(command)


def coupling_option(command: Decorated) -> Decorated:
    """The option --coupling, the same for every command that fits a model."""
    option = click.option(
        "--coupling", multiple=True, metavar="A:B", help="Two joints with coupled drives, such as A5:A6."
    )
    return option(command)


def gear_ratio_option(command: Decorated) -> Decorated:
    """The option --gear-ratio, for arms without an arm file."""
    option = click.option(
        "--gear-ratio",
        metavar="N[,N...]",
        help="Motor turns for a turn of the joint, for all joints or one a joint; default: of the arm file.",
    )
    return option(command)


class GroupedCommand(click.Command):
    """A command whose help lists its options under headings.

    groups : heading -> names of the options as the function has them; the others come last under "Options"
    """

    def __init__(self, *arguments: Any, groups: Mapping[str, tuple[str, ...]], **named: Any) -> None:
        super().__init__(*arguments, **named)
        self.groups = groups

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the options, group by group."""
        records = {parameter.name: parameter.get_help_record(ctx) for parameter in self.get_params(ctx)}
        shown: set[str | None] = set()
        for heading, names in self.groups.items():
            found = [record for name in names if (record := records[name]) is not None]
            shown.update(names)
            with formatter.section(heading):
                formatter.write_dl(found)
        rest = [record for name, record in records.items() if record is not None and name not in shown]
        with formatter.section("Options"):
            formatter.write_dl(rest)


class _NumberOr(click.ParamType):
    """A number, or one of some words."""

    def __init__(self, *words: str) -> None:
        self.words = words
        self.name = "|".join(("number", *words))

    def get_metavar(self, param: click.Parameter, ctx: click.Context | None = None) -> str:
        return f"[{self.name}]"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float | str:
        if isinstance(value, (int, float)):
            return float(value)
        if value in self.words:
            return str(value)
        try:
            return float(value)
        except ValueError:
            self.fail(f"{value!r} is neither a number nor one of {', '.join(self.words)}", param, ctx)


def number_or(*words: str) -> click.ParamType:
    """Type of an option that takes a number or one of `words`."""
    return _NumberOr(*words)
