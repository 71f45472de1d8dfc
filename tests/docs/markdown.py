"""Fenced blocks of the documents: what is run, and what is slow."""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
DOCUMENTS = tuple(
    sorted(
        path.relative_to(ROOT)
        for path in (
            ROOT / "README.md",
            ROOT / "CONTRIBUTING.md",
            *ROOT.glob("docs/*.md"),
            *ROOT.glob("configs/**/*.md"),
        )
    )
)
_FENCE = re.compile(r"^```(\w*)( slow)?\n(.*?)^```$", re.MULTILINE | re.DOTALL)
_EXIT = re.compile(r"exits with (\d)")


@dataclass(frozen=True)
class Block:
    """A fenced block: language, whether it takes long, text, line where it begins."""

    language: str
    slow: bool
    text: str
    line: int


@dataclass(frozen=True)
class Command:
    """A line of a shell block: words, expected exit code, file that takes the output."""

    words: tuple[str, ...]
    code: int
    output: str | None
    slow: bool
    line: int

    @property
    def text(self) -> str:
        return shlex.join(self.words)


def blocks(document: Path, language: str) -> list[Block]:
    text = (ROOT / document).read_text(encoding="utf-8")
    return [
        Block(match[1], bool(match[2]), match[3], text[: match.start()].count("\n") + 2)
        for match in _FENCE.finditer(text)
        if match[1] == language
    ]


def commands(document: Path) -> Iterator[Command]:
    for block in blocks(document, "bash"):
        for offset, line in enumerate(block.text.splitlines()):
            command, _, comment = line.partition(" #")
            words = shlex.split(command)
            if not words:
                continue
            output = None
            if ">" in words:
                output = words[words.index(">") + 1]
                words = words[: words.index(">")]
            wanted = _EXIT.search(comment)
            yield Command(
                tuple(words), int(wanted[1]) if wanted else 0, output, block.slow, block.line + offset
            )
