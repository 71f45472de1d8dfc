"""Places of results, tried before the work begins: a wrong path costs no measurement."""

from __future__ import annotations

import contextlib
import errno
import os
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import click

from fri.errors import ConfigurationError, FileError

_BLOCK = bytes(4096)


def check_file(path: Path) -> Path:
    """Try whether a file can be written at `path`, which stays as it is. Raises FileError with advice."""
    _try(path.parent, path)
    if path.is_dir():
        raise _refusal(errno.EISDIR, path)
    if path.exists() and not os.access(path, os.W_OK):
        raise _refusal(errno.EACCES, path)
    return path


def check_folder(path: Path) -> Path:
    """Try whether files can be written to the folder `path`, existing or to be made. Raises FileError."""
    place = path
    while not os.path.lexists(place) and place != place.parent:
        place = place.parent
    _try(place, path)
    return path


def _try(folder: Path, wanted: Path) -> None:
    try:
        # The folder may be there and the name still be too long.
        with contextlib.suppress(FileNotFoundError):
            wanted.lstat()
        with tempfile.TemporaryFile(dir=folder) as trial:
            trial.write(_BLOCK)
            trial.flush()
    except OSError as error:
        raise FileError.of(error, f"{wanted} cannot be written") from error


def _refusal(number: int, path: Path) -> FileError:
    return FileError.of(OSError(number, os.strerror(number)), f"{path} cannot be written")


def check_replacement(path: Path, kind: OutputFile, forced: bool) -> None:
    """Raise ConfigurationError for a file, or a folder with files, that exists and may not be replaced."""
    if forced or not path.exists() or (isinstance(kind, OutputFolder) and not kind.replaces):
        return
    if not isinstance(kind, OutputFolder):
        advice = "choose another name" + (", or replace it with --force" if kind.replaces else "")
        raise ConfigurationError(f"{path} exists; {advice}")
    if not path.is_dir() or any(path.iterdir()):
        raise ConfigurationError(
            f"{path} is not empty, or no folder; choose another one, or replace its files with --force"
        )


def default_output(path: Path, forced: bool) -> Path:
    """`path`, the place of an output without a name, if it can be written."""
    check_file(path)
    check_replacement(path, OUTPUT_FILE, forced)
    return path


@contextlib.contextmanager
def set_aside(path: Path) -> Iterator[None]:
    """Move an existing file away for the work; it comes back if the work fails, else it is removed."""
    if not path.exists():
        yield
        return
    kept = path.with_name(f"{path.name}.replaced")
    path.replace(kept)
    try:
        yield
    except BaseException:
        kept.replace(path)
        raise
    kept.unlink()


class OutputFile(click.Path):
    """A file to be written, tried as the command line is read.

    replaces : `--force` replaces an existing one.
    """

    def __init__(self, *, replaces: bool = True) -> None:
        super().__init__(path_type=Path)
        self.replaces = replaces

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """The path, after `check_file`."""
        return check_file(Path(value))


class OutputFolder(OutputFile):
    """A folder to be filled, tried as the command line is read."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """The path, after `check_folder`."""
        return check_folder(Path(value))


OUTPUT_FILE, OUTPUT_FOLDER = OutputFile(), OutputFolder()
NEW_FILE, NEW_FOLDER = OutputFile(replaces=False), OutputFolder(replaces=False)


def new_folder(folder: Path, advice: str = "choose another --results") -> None:
    """Make an empty folder for results. ConfigurationError, with the advice, if this is impossible."""
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise ConfigurationError(f"{folder} is not empty, or no folder; {advice}")
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigurationError(f"{folder} cannot be made: {error.strerror}; {advice}") from error
