"""What results need in a notebook: optional packages, and figures."""

from __future__ import annotations

from importlib import import_module
from typing import Any

from fri.errors import ConfigurationError


def optional(package: str, use: str, instead: str, extra: str = "notebook") -> Any:
    """The imported package. Raises ConfigurationError, with advice, where it is not installed.

    use : what needs it. instead : what works without it. extra : of this package, with it.
    """
    try:
        return import_module(package)
    except ImportError as error:
        raise ConfigurationError(
            f"{use} needs {package.partition('.')[0]}, which is not installed; install it "
            f"(`pip install 'lwr-identification[{extra}]'`) or use {instead}"
        ) from error


def subplots(rows: int, columns: int = 1, **settings: Any) -> Any:
    """The axes (rows * columns,) of a new figure."""
    from matplotlib import pyplot

    _, axes = pyplot.subplots(rows, columns, squeeze=False, layout="constrained", **settings)
    return axes.ravel()
