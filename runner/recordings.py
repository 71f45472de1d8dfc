"""Recordings on the command line: session logs, ROS 2 bags, and others through a guessed mapping.

The guess is shown and confirmed. Mapping and session logs are written, so the import can be repeated and corrected.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from fri.errors import ConfigurationError, DataError
from runner.status import write
from runner.terminal import FiniteRange, ask

if TYPE_CHECKING:
    from ident.import_log import Guess, Known
    from lwr_driver.session import Session

GUESSED = ("yes", "joints", "rate_hz", "torque", "torque_constant", "gear_ratio")
"""Parameters of `guess_options`."""


def _numbers(context: click.Context, parameter: click.Parameter, value: str | None) -> tuple[float, ...]:
    try:
        return () if value is None else tuple(float(part) for part in value.split(","))
    except ValueError:
        raise click.BadParameter(
            f"{value!r} is no list of numbers such as 100,101", context, parameter
        ) from None


def guess_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Options of a command that takes recordings other than session logs."""
    options = (
        click.option("--yes", is_flag=True, help="Take the guessed columns without asking."),
        click.option(
            "--joints",
            metavar="A,B,...",
            help="Joints of the model, as in the URDF; default: by name or number of the columns.",
        ),
        click.option(
            "--rate-hz",
            type=FiniteRange(min=0, min_open=True),
            help="Rate of a recording without times.",
        ),
        click.option(
            "--torque",
            type=click.Choice(["joint", "motor"]),
            default="joint",
            show_default=True,
            help="A plain torque is the joint sensor's, or the motor's after the gear.",
        ),
        click.option(
            "--torque-constant", callback=_numbers, metavar="K[,K...]", help="Motors' Nm/A, for currents."
        ),
        click.option(
            "--gear-ratio",
            callback=_numbers,
            metavar="N[,N...]",
            help="Motor turns per joint turn, for currents.",
        ),
    )
    for option in reversed(options):
        command = option(command)
    return command


def read_recordings(
    paths: Sequence[Path],
    *,
    urdf: Path | None,
    folder: Path,
    base: str | None = None,
    tip: str | None = None,
    yes: bool = False,
    joints: str | None = None,
    rate_hz: float | None = None,
    torque: str = "joint",
    torque_constant: tuple[float, ...] = (),
    gear_ratio: tuple[float, ...] = (),
) -> list[Session]:
    """Sessions from paths of any kind, in their order.

    folder : for `NAME.mapping.yaml` and the session logs of recordings that need a mapping. The first of these gives
        the columns of all that have them; others get a mapping of their own. Raises ConfigurationError without a URDF,
        or without a confirmation.
    """
    from ident.import_log import Known, read_recording
    from ident.import_log.bag import bag_files

    named = () if joints is None else tuple(name.strip() for name in joints.split(","))

    def read(path: Path) -> Session:
        side = torque == "motor"
        return read_recording(path, status=False, motor=side, joints=named, urdf=urdf, base=base, tip=tip)

    foreign = [path for path in paths if not (path.suffix == ".mcap" or bag_files(path))]
    if foreign:
        known = Known(named, base, tip, rate_hz, torque, torque_constant, gear_ratio)
        return _read_foreign(paths, foreign, read, urdf, known, folder, yes=yes)
    if rate_hz or torque_constant or gear_ratio:
        raise ConfigurationError(
            f"{paths[0]} names its joints and quantities; --rate-hz, --torque-constant and --gear-ratio are for "
            "recordings with guessed columns"
        )
    from ident.dynamics.session_chain import recorded_rests

    logs = [read(path) for path in paths]
    for log in logs[1:]:
        _same_rests(recorded_rests(logs[0].metadata), recorded_rests(log.metadata), log.path)
    return logs


def _read_foreign(
    paths: Sequence[Path],
    foreign: Sequence[Path],
    read: Callable[[Path], Session],
    urdf: Path | None,
    known: Known,
    folder: Path,
    *,
    yes: bool,
) -> list[Session]:
    """As `read_recordings`, where the `foreign` ones among the paths need a mapping; `read` reads the others."""
    from ident.import_log import guess_mapping, import_log
    from ident.import_log.tables import unpacked
    from lwr_driver.session import read_session

    missing = [path for path in foreign if not path.exists()]
    if missing:
        raise DataError(f"{missing[0]}: no such file or folder")
    if urdf is None:
        raise ConfigurationError(
            f"{foreign[0]}: no session log; name the arm's URDF with --urdf to import it"
        )
    guess = guess_mapping(foreign[0], urdf, known)
    for other in foreign[1:] if guess.mapping.held else ():
        _same_rests(guess.mapping.held or {}, guess_mapping(other, urdf, known).mapping.held or {}, other)
    _confirm(guess, yes)
    folder.mkdir(parents=True, exist_ok=True)
    _write_mapping(guess, folder / f"{unpacked(foreign[0]).stem}.mapping.yaml")
    names = dict(zip(foreign, _names(foreign), strict=True))
    sessions = []
    for path in paths:
        if path not in names:
            sessions.append(read(path))
            continue
        target = folder / f"{names[path]}.mcap"
        _clear(target)
        try:
            report = import_log(guess.mapping, path, target)
        except DataError as error:
            own = _of_other_columns(path, guess, lambda other: guess_mapping(other, urdf, known), error)
            _confirm(own, yes)
            _write_mapping(own, folder / f"{names[path]}.mapping.yaml")
            report = import_log(own.mapping, path, target)
        write(f"{report}\n")
        sessions.append(read_session(target, status=False))
    return sessions


def _of_other_columns(path: Path, first: Guess, guessed: Callable[[Path], Guess], error: DataError) -> Guess:
    """The guess of a recording that the columns of the first do not fit. Raises `error` if its names tell no others."""
    try:
        own = guessed(path)
    except DataError:
        raise error from None
    if own.mapping == first.mapping or set(own.mapping.joints) != set(first.mapping.joints):
        raise error
    return own


def _write_mapping(guess: Guess, file: Path) -> None:
    if file.exists() and not file.read_text(encoding="utf-8").startswith(guess.HEAD):
        raise ConfigurationError(
            f"{file} exists and was not guessed; use it with `lwr-run import`, or remove it"
        )
    file.write_text(guess.text, encoding="utf-8")
    write(f"{file}\n")


def _same_rests(first: Mapping[str, float], other: Mapping[str, float], path: Path) -> None:
    """Refuse recordings with joints at rest elsewhere than in the first: their kinematics differ."""
    from ident.import_log.rests import RESTING_RAD

    for name in first.keys() | other.keys():
        places = [rests.get(name) for rests in (first, other)]
        if None in places or abs(float(places[0] or 0.0) - float(places[1] or 0.0)) > RESTING_RAD:
            raise ConfigurationError(
                f"{path}: joint {name} rests at {places[1]} rad, in the first recording at {places[0]} rad; identify "
                "them one by one"
            )


def at_terminal() -> bool:
    """Whether a person can answer."""
    return sys.stdin.isatty()


def _show(guess: Guess) -> None:
    for piece in guess.pieces():
        write(piece)


def _confirm(guess: Guess, yes: bool) -> None:
    if yes:
        _show(guess)
    elif not at_terminal():
        raise ConfigurationError(
            f"the columns of {guess.source} are a guess, to be confirmed at a terminal or with --yes:\n{guess}\n"
            f"or correct this mapping file and use `lwr-run import`:\n\n{guess.text}"
        )
    else:
        _show(guess)
        if not ask("Is this right?"):
            raise ConfigurationError(f"correct this mapping file and use `lwr-run import`:\n\n{guess.text}")


def _names(paths: Sequence[Path]) -> list[str]:
    """Names of the session logs: that of the recording, with its folder's where two are alike."""
    from ident.import_log.tables import unpacked

    stems = [unpacked(path).stem for path in paths]
    return [
        stem if stems.count(stem) == 1 else f"{path.resolve().parent.name}_{stem}"
        for path, stem in zip(paths, stems, strict=True)
    ]


def _clear(target: Path) -> None:
    """Remove an earlier import; ConfigurationError for any other file of that name."""
    if not target.exists():
        return
    from lwr_driver.session import read_session

    try:
        imported = read_session(target, status=False).metadata.get("experiment") == "import"
    except DataError:
        imported = False
    if not imported:
        raise ConfigurationError(f"{target} exists and is no import; choose another folder with --results")
    target.unlink()
