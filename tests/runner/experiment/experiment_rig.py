"""A short experiment on the emulator, and what the tests look at afterwards."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml
from click.testing import CliRunner
from mcap.reader import make_reader

from runner.cli import main

SHORT: dict[str, Any] = {
    "name": "short",
    "emulator_settings": {"fri.period_ms": 5},
    "excitation": {"period_s": 6.0, "harmonics": 3, "periods": 1, "seed": 3},
    "moves": {"home": [0.0, 0.5, 0.0, -1.3, 0.0, 0.8, 0.0], "speed_scale": 0.5, "settle_s": 0.5},
    "diagnosis": {"run": False},
    "sessions": [
        {"name": "unloaded"},
        {"name": "loaded", "payload": {"name": "paper_load", "mass": 3.34, "com": [0.0, -0.066, 0.144]}},
    ],
}


@dataclass(frozen=True)
class Finished:
    """Exit code and text of a command, and the folder of its results."""

    code: int
    text: str
    folder: Path


def experiment_file(folder: Path, **changes: Any) -> Path:
    """The short experiment with some keys changed, as a file."""
    path = folder / "short.yaml"
    path.write_text(yaml.safe_dump({**SHORT, **changes}), encoding="utf-8")
    return path


def run(*arguments: str) -> Finished:
    """`lwr-run` with these arguments; an exception that is no error of ours fails the test."""
    result = CliRunner().invoke(main, list(arguments), catch_exceptions=True)
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    lines = result.stdout.strip().splitlines()
    return Finished(result.exit_code, result.output, _folder(lines[-1]) if lines else Path())


def _folder(last: str) -> Path:
    """The folder of the results, from `open FOLDER/report.html`, the last line of the output."""
    return Path(last.removeprefix("open ")).parent


def messages(path: Path) -> list[tuple[str, int, int, int, bytes]]:
    """Every message of a log: topic, sequence, log time, publish time, content."""
    with path.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        return [
            (channel.topic, message.sequence, message.log_time, message.publish_time, message.data)
            for _, channel, message in reader.iter_messages(log_time_order=False)
        ]


def records(path: Path) -> tuple[dict[str, dict[str, str]], dict[str, bytes]]:
    """Metadata records and attachments of a log by name."""
    with path.open("rb") as stream:
        metadata = {record.name: dict(record.metadata) for record in make_reader(stream).iter_metadata()}
    with path.open("rb") as stream:
        attached = {item.name: item.data for item in make_reader(stream).iter_attachments()}
    return metadata, attached
