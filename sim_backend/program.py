"""KRL programs for the emulated controller: those of configs/krl by name, a laboratory's own by its file."""

from __future__ import annotations

import re
from pathlib import Path

from fri.errors import ConfigurationError
from fri.krl import KrlProgram
from fri.krl_system import Machinery
from lwr_driver.configuration import CONFIGS, find

PUBLISHED = ("stanford", "ros_control", "rcprg")
"""Programs without motor currents of their own."""


def program_names() -> tuple[str, ...]:
    """Names of the programs of configs/krl."""
    return tuple(sorted(path.stem for path in (CONFIGS / "krl").glob("*.src")))


def krl_program(
    name: str,
    period_ms: int | None = None,
    machinery: Machinery | None = None,
    *,
    beside: Path | None = None,
    statement_ms: float = 0.0,
    halt_s: float = 1.0,
    **settings: float | int | str,
) -> KrlProgram:
    """A program, ready to start.

    name : in configs/krl, or path of a `.src` file, also in the folder `beside`; its `.dat`, and the `.src` files of
    subprograms that it calls, lie beside it. period_ms : FRI cycle of a program with the variable `LWR_CYCLE`
    machinery : motor currents, load data and arm; None leaves all at zero. statement_ms, halt_s : see `KrlProgram`
    settings : values for its data list

    Raises ConfigurationError, with the line, for a program that cannot be run.
    """
    text = _source(name, beside)
    source, data = _read(text), _data(text)
    called = {word.upper() for word in re.findall(r"([A-Za-z_]\w*)\s*\(", source)}
    modules = {
        path.stem: (_read(path), _data(path))
        for path in sorted(text.parent.iterdir())
        if path.suffix.lower() == ".src" and path != text and path.stem.upper() in called
    }
    program = KrlProgram(
        source,
        data,
        settings,
        machinery,
        text.stem,
        statement_ms=statement_ms,
        halt_s=halt_s,
        modules=modules,
    )
    if period_ms is not None and "LWR_CYCLE" not in settings:
        program.preset("LWR_CYCLE", period_ms)
    return program


def _source(name: str, beside: Path | None) -> Path:
    if name in program_names():
        return find(f"krl/{name}.src")
    if not name.lower().endswith(".src"):
        raise ConfigurationError(
            f"KRL program {name!r} is unknown; known: {', '.join(program_names())}, or give the path of a .src file"
        )
    return find(name, beside=beside)


def _data(source: Path) -> str:
    """Text of the data list of a program, empty without one; file names on the controller have no case."""
    for path in sorted(source.parent.iterdir()):
        if path.suffix.lower() == ".dat" and path.stem.lower() == source.stem.lower():
            return _read(path)
    return ""


def _read(path: Path) -> str:
    try:
        content = path.read_bytes()
    except OSError as error:
        raise ConfigurationError(f"{path}: cannot be read: {error.strerror}") from error
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError:
        # The controller's editor writes the code page of Windows.
        return content.decode("cp1252", errors="replace")
