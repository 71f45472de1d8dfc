"""The place of a key in a YAML file, for error messages: `my_lab.yaml:12: `moves`: `home``.

The line is looked up when a message is made: reading a file costs nothing more.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import yaml

from lwr_driver.yaml_text import Loader

Key = str | int


@dataclass(frozen=True)
class Place:
    """A key, as text `FILE:LINE: KEYS`; without the line at the top level, or if no file has the key.

    head : in place of the file for content from elsewhere.
    files : those with the content, by precedence. given : dotted keys with a value from elsewhere, without a line.
    keys : way to the value; shown : the same for people.
    """

    head: str
    files: tuple[Path, ...] = ()
    given: frozenset[str] = frozenset()
    keys: tuple[Key, ...] = ()
    shown: str = ""

    @classmethod
    def of(cls, where: str | Path | Place) -> Place:
        """The top level of a file, or of content from elsewhere, described by a text."""
        if isinstance(where, Place):
            return where
        return cls(str(where), (where,) if isinstance(where, Path) else ())

    def key(self, name: str, shown: str | None = None) -> Place:
        """A key of this mapping."""
        text = f"{self.shown}: `{name}`" if shown is None else f"{self.shown}{shown}"
        return Place(self.head, self.files, self.given, (*self.keys, name), text)

    def entry(self, index: int, label: str = "") -> Place:
        """An entry of this list; label : its name."""
        text = f"{self.shown}[{label or index}]"
        return Place(self.head, self.files, self.given, (*self.keys, index), text)

    def line_of(self, key: Key) -> Place:
        """This mapping, at the line of one of its keys."""
        return Place(self.head, self.files, self.given, (*self.keys, key), self.shown)

    def named_in(self, message: str, content: Mapping[Any, Any]) -> Place:
        """This mapping, at the line of the first of its keys named in a message."""
        for word in re.findall(r"[A-Za-z_]\w*", message):
            if word in content:
                return self.line_of(word)
        return self

    def __str__(self) -> str:
        dotted = ".".join(str(key) for key in self.keys)
        if self.keys and not any(f"{dotted}.".startswith(f"{name}.") for name in self.given):
            for file in self.files:
                line = line_of(file, self.keys)
                if line is not None:
                    return f"{file}:{line}{self.shown}"
        return f"{self.head}{self.shown}"


def line_of(file: Path, keys: tuple[Key, ...]) -> int | None:
    """Line of a key in a YAML file, from 1; None if the file does not have it."""
    try:
        node = _composed(file, file.stat().st_mtime_ns)
    except (OSError, ValueError, yaml.YAMLError, RecursionError):
        return None
    line = None
    for key in keys:
        found = _child(node, key)
        if found is None:
            return None
        line, node = found
    return line


@lru_cache(maxsize=4)
def _composed(file: Path, changed_ns: int) -> yaml.Node | None:
    return yaml.compose(file.read_text(encoding="utf-8"), Loader)


def _child(node: yaml.Node | None, key: Key) -> tuple[int, yaml.Node] | None:
    """Line and value of a key of a mapping, or of an entry of a list."""
    if isinstance(node, yaml.SequenceNode) and isinstance(key, int):
        if key >= len(node.value):
            return None
        return node.value[key].start_mark.line + 1, node.value[key]
    if not isinstance(node, yaml.MappingNode):
        return None
    for name, value in reversed(node.value):
        if name.value == str(key):
            return name.start_mark.line + 1, value
    return next((found for merged in _merged(node) if (found := _child(merged, key))), None)


def _merged(node: yaml.MappingNode) -> Iterator[yaml.Node]:
    """The mappings that a mapping takes over with `<<`."""
    for name, value in node.value:
        if name.tag == "tag:yaml.org,2002:merge":
            yield from value.value if isinstance(value, yaml.SequenceNode) else [value]
