"""References of YAML files to their JSON Schemas, by which an editor finds them: a comment in the first line,
`# yaml-language-server: $schema=FILE`. `runner.schema` makes the schemas.
"""

from __future__ import annotations

import re
import shutil
from pathlib import Path

from fri.errors import ConfigurationError
from lwr_driver.configuration import CONFIGS, read_text

FOLDER = CONFIGS / "schemas"
_MARK = "# yaml-language-server: $schema="
_REFERENCE = re.compile(rf"^{re.escape(_MARK)}(\S+)[^\n]*\n", re.MULTILINE)


def kinds() -> list[str]:
    """The kinds of files with a schema."""
    return sorted(path.stem for path in FOLDER.glob("*.json"))


def referring(text: str, schema_file: str | Path) -> str:
    """The text of a YAML file with a reference to its schema in the first line, in place of an older one."""
    return f"{_MARK}{schema_file}\n{_REFERENCE.sub('', text)}"


def reference(text: str) -> str | None:
    """The schema file that a YAML file refers to, None without one."""
    found = _REFERENCE.search(text)
    return None if found is None else found[1]


def kind_of(text: str) -> str | None:
    """The kind of a YAML file by its reference to a schema, None without one."""
    name = Path(reference(text) or "").stem
    return name if name in kinds() else None


def refer(path: Path, name: str | None = None) -> Path:
    """Let a copy of a template refer to the schema of this installation; returns the schema's file.

    name : kind of the file, by default that of the reference it came with. ConfigurationError without either.
    """
    text = read_text(path)
    kind = name or kind_of(text)
    if kind not in kinds():
        known = ", ".join(kinds())
        raise ConfigurationError(
            f"{path}: the file refers to no schema; name its kind, one of {known}"
            if kind is None
            else f"schema {kind!r} is unknown; known: {known}"
        )
    target = FOLDER / f"{kind}.json"
    path.write_text(referring(text, target), encoding="utf-8")
    return target


def hand_out(folder: Path) -> list[Path]:
    """Give a folder with copies of templates the schemas they refer to, in `schemas/`; returns those written.

    The copies then refer to these, so the folder can be moved to another computer.
    """
    written = []
    for path in sorted(folder.glob("*.yaml")):
        text = read_text(path)
        if (kind := kind_of(text)) is not None:
            written.append(folder / "schemas" / f"{kind}.json")
            written[-1].parent.mkdir(exist_ok=True)
            shutil.copyfile(FOLDER / f"{kind}.json", written[-1])
            path.write_text(referring(text, f"schemas/{kind}.json"), encoding="utf-8")
    return written
