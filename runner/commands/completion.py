"""`lwr-run completion`: what a shell needs to complete commands, options and files."""

from __future__ import annotations

import click
from click.shell_completion import get_completion_class

_VARIABLE = "_LWR_RUN_COMPLETE"


@click.command("completion")
@click.argument("shell", type=click.Choice(("bash", "zsh", "fish")))
@click.pass_context
def command(context: click.Context, shell: str) -> None:
    """Print the completion script for SHELL.

    \b
    lwr-run completion bash >> ~/.bashrc
    lwr-run completion zsh >> ~/.zshrc
    lwr-run completion fish > ~/.config/fish/completions/lwr-run.fish
    """
    kind = get_completion_class(shell)
    assert kind is not None
    root = context.find_root()
    # Written without asking the shell for its version, so that it may be made for another computer.
    script = kind(root.command, {}, "lwr-run", _VARIABLE)
    click.echo(script.source_template % script.source_vars())
