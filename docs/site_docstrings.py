"""An extension of griffe: the lines `name : meaning` of a docstring become a list."""

from __future__ import annotations

import re
from typing import Any

import griffe

_ENTRY = re.compile(r"^([A-Za-z_][\w, ]*) : (.*)$")


def listed(text: str) -> str:
    """A docstring with its entries as a list; lines further in go on with their entry."""
    lines: list[str] = []
    inside = False
    for line in text.splitlines():
        found = _ENTRY.match(line)
        if found:
            if not inside and lines and lines[-1]:
                lines.append("")
            names = ", ".join(f"`{name.strip()}`" for name in found[1].split(","))
            lines.append(f"- {names}: {found[2]}")
            inside = True
        elif inside and line.strip():
            lines.append(f"    {line.strip()}")
        else:
            inside = False
            lines.append(line)
    return "\n".join(lines)


class Lists(griffe.Extension):
    """Turns the docstrings of all objects."""

    def on_object(self, *, obj: griffe.Object, **named: Any) -> None:
        """Called for each object that is read."""
        if obj.docstring is not None:
            obj.docstring.value = listed(obj.docstring.value)
