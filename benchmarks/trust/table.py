"""Results of the campaign: lines of a table, kept in a JSON file from which a broken-off campaign goes on."""

from __future__ import annotations

import json
import os
import platform
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime
from functools import cache
from pathlib import Path
from typing import Any

from runner.computer import git_commit

__all__ = ["Ledger", "Line", "stamp"]


@cache
def stamp() -> dict[str, str]:
    """Commit, with + for changes not committed, and date at the first call."""
    commit = git_commit()
    return {"commit": commit[:7] + commit[40:], "date": datetime.now(UTC).date().isoformat()}


@dataclass
class Line:
    """One line of the table.

    section, what : its name. runs, failed : how many runs, and how many of them broke a promise
    figures : numbers by name. failures : what was wrong, the first few, with what repeats the run
    """

    section: str
    what: str
    runs: int = 0
    failed: int = 0
    figures: dict[str, Any] = field(default_factory=dict)
    failures: list[str] = field(default_factory=list)

    def count(self, complaints: list[str], name: str = "") -> None:
        """Count a run with its complaints."""
        self.runs += 1
        self.failed += bool(complaints)
        if complaints and len(self.failures) < 20:
            self.failures += [f"{name}: {complaint}" if name else complaint for complaint in complaints]

    def markdown(self) -> str:
        """The line as a row of a table."""
        figures = "; ".join(f"{name} {_plain(value)}" for name, value in self.figures.items())
        return f"| {self.what} | {self.runs} | {self.failed} | {figures} |".replace("|  |", "| |")

    def __str__(self) -> str:
        figures = "  ".join(f"{name} {_short(value)}" for name, value in self.figures.items())
        return f"{self.section:<10} {self.what:<34} {self.runs:>6} {self.failed:>6}  {figures}".rstrip()


def _short(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.4g}"
    return json.dumps(value) if isinstance(value, list | dict) else str(value)


def _plain(value: Any) -> str:
    if isinstance(value, dict):
        return ", ".join(f"{name} {_plain(item)}" for name, item in value.items())
    if isinstance(value, list):
        return " to ".join(map(_plain, value))
    return "none" if value is None else _short(value).replace("|", "/")


class Ledger:
    """All lines and the finished pieces of work, in one file, written after every piece.

    seed : of the campaign; a file of another seed is not continued
    """

    def __init__(self, path: Path | None, seed: int) -> None:
        self.path, self.seed = path, seed
        self.lines: dict[tuple[str, str], Line] = {}
        self.done: dict[str, list[str]] = {}
        if path is not None and path.exists():
            content = json.loads(path.read_text())
            if content["seed"] != seed:
                raise SystemExit(f"{path} is of seed {content['seed']}; choose another file or --seed")
            for entry in content["lines"]:
                self.lines[entry["section"], entry["what"]] = Line(**entry)
            self.done = content["done"]

    def line(self, section: str, what: str) -> Line:
        """The line, new if there is none."""
        return self.lines.setdefault((section, what), Line(section, what))

    def has(self, section: str, piece: str) -> bool:
        """Whether a piece of work is done already."""
        return piece in self.done.get(section, [])

    def finish(self, section: str, piece: str) -> None:
        """Mark a piece as done and write everything down."""
        self.done.setdefault(section, []).append(piece)
        self.save()

    def forget(self, section: str) -> None:
        """Drop what is known of a section."""
        self.done.pop(section, None)
        self.lines = {key: line for key, line in self.lines.items() if key[0] != section}

    def join(self, other: Ledger) -> None:
        """Take over the lines of another ledger of the same seed, none of which may be here already."""
        twice = [" ".join(key) for key in other.lines if key in self.lines]
        if twice:
            raise SystemExit(f"{', '.join(twice)}: in {self.path} and in {other.path}; join one of them only")
        self.lines |= other.lines
        for section, done in other.done.items():
            self.done[section] = [*self.done.get(section, []), *done]

    def save(self) -> None:
        """Write the file, whole or not at all."""
        if self.path is None:
            return
        draft = self.path.with_suffix(self.path.suffix + ".new")
        content = {
            "seed": self.seed,
            "machine": f"{platform.machine()}, {os.cpu_count()} processors",
            "python": platform.python_version(),
            "lines": [asdict(line) for line in self.lines.values()],
            "done": self.done,
        }
        draft.write_text(json.dumps(content, indent=1))
        draft.replace(self.path)

    def table(self, section: str | None = None) -> str:
        """The lines as text."""
        head = f"{'section':<10} {'what':<34} {'runs':>6} {'failed':>6}  figures"
        chosen = [line for line in self.lines.values() if section in (None, line.section)]
        return "\n".join([head, *map(str, chosen)])

    def markdown(self, sections: tuple[str, ...]) -> str:
        """The lines of the sections as tables of Markdown, one each."""
        blocks = []
        for section in sections:
            rows = [line for line in self.lines.values() if line.section == section]
            if not rows:
                continue
            head = f"### {section}\n\n| | runs | failed | |\n| --- | ---: | ---: | --- |"
            blocks.append("\n".join([head, *(line.markdown() for line in rows)]))
        return "\n\n".join(blocks)

    @property
    def failed(self) -> int:
        """Runs that broke a promise."""
        return sum(line.failed for line in self.lines.values())
