"""`python -m runner`, and the entry point of `lwr-run`: Ctrl-C counts from the first import on."""

from __future__ import annotations

import sys

_ABORTED = 4
"""Exit code of `fri.errors.OperatorError`, whose import may be what is interrupted."""


def main() -> None:
    """Run the command line."""
    try:
        from runner.cli import main as command
    except KeyboardInterrupt:
        sys.stderr.write("aborted\n")
        sys.exit(_ABORTED)
    command(prog_name="lwr-run")


if __name__ == "__main__":
    main()
