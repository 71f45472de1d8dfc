"""Tables of the keys of a file, for the documents, and the settings file with every key."""

from __future__ import annotations

import dataclasses
import types
import typing
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Union

import msgspec

from fri.quantities import described, metas
from lwr_driver.configuration import yaml_text
from runner.editor import FOLDER, referring
from runner.schema.schemas import FILES
from runner.schema.shapes import default, hints, meanings, plain, title

SHOWN = 60  # characters of a default in a table
TEMPLATE = FOLDER.parent / "identify.yaml"


@dataclass(frozen=True)
class Row:
    """A key, dotted: default as in YAML ("required" without), range or words, meaning."""

    key: str
    default: str
    range: str
    meaning: str


def rows(name: str) -> list[Row]:
    """The keys of a kind of file, see `runner.schema.FILES`; keys of one dataclass in two places appear once."""
    kind = FILES[name]
    return list(_rows(kind.cls, kind.changed, "", {}))


def _rows(cls: type, changed: Mapping[str, Any], prefix: str, seen: dict[type, str]) -> Iterator[Row]:
    for key, hint in hints(cls, changed).items():
        value = default(cls, key, hint)
        below = [part for part in _parts(hint) if dataclasses.is_dataclass(part) and isinstance(part, type)]
        shown = "required" if value is msgspec.NODEFAULT else _yaml(value)
        meaning = meanings()[title(cls)][key]
        known = [seen[part] for part in below if part in seen]
        yield Row(
            f"{prefix}{key}", shown, _range(hint), meaning + "".join(f"; keys as for `{k}`" for k in known)
        )
        for part in below:
            if part not in seen:
                seen[part] = f"{prefix}{key}"
                yield from _rows(part, changed, f"{prefix}{key}.", seen)


def _parts(hint: Any) -> Iterator[Any]:
    yield hint
    for part in typing.get_args(hint):
        yield from _parts(part)


def _yaml(value: Any) -> str:
    """A default in YAML, nothing for settings with keys of their own."""
    if value is msgspec.UNSET or dataclasses.is_dataclass(value):
        return ""
    if value == "":
        return '""'
    if isinstance(value, tuple):
        value = [_short(entry) for entry in value]
    text = (
        yaml_text([value]).strip() if value is None or isinstance(value, (str, bool, float)) else str(value)
    )
    text = (
        text.removeprefix("[").removesuffix("]")
        if text.startswith("[") and not isinstance(value, list)
        else text
    )
    return text.replace("'", "") if len(text) <= SHOWN else f"{text[:SHOWN]}..."


def _short(entry: Any) -> Any:
    if not dataclasses.is_dataclass(entry):
        return entry
    changed = [f.name for f in dataclasses.fields(entry) if getattr(entry, f.name) != f.default]
    return {key: getattr(entry, key) for key in changed}


def _range(hint: Any) -> str:
    """Range of a number, or of each number of a list, with its unit; or the words."""
    inner, ranges = metas(hint)
    for meta in ranges:
        if meta.min_length is None and meta.max_length is None:
            return described(meta)
    origin, arguments = typing.get_origin(inner), typing.get_args(inner)
    if origin is typing.Literal:
        return ", ".join(map(str, arguments))
    if inner is bool:
        return "true, false"
    if origin in (tuple, Union, types.UnionType, dict):
        found = dict.fromkeys(text for part in arguments if part is not Ellipsis and (text := _range(part)))
        return ", ".join(found)
    return ""


def table(name: str) -> str:
    """The keys of a kind of file as a table in Markdown."""
    head = "| key | default | range | meaning |\n| --- | --- | --- | --- |\n"
    return head + "".join(f"| `{r.key}` | {r.default} | {r.range} | {r.meaning} |\n" for r in rows(name))


def settings_template() -> str:
    """A settings file of `identify` with every key at its default."""
    lines = [
        "# Settings of `lwr-run identify --settings FILE`. Every key is here with its default; copy what you change.",
        "# Written by `python docs/key_tables.py`; docs/identify_settings.md has the same as a table.",
    ]
    section = ""
    found = rows("settings")
    sections = {row.key.rpartition(".")[0] for row in found}
    for row in found:
        head, mark, key = row.key.rpartition(".")
        if row.key in sections:
            lines += ["", f"{key}:".ljust(32) + f"# {_comment(row)}"]
            section = key
            continue
        assert head in ("", section)
        value = row.default or "null"
        lines.append(f"{'  ' if mark else ''}{key}: {value}".ljust(32) + f"# {_comment(row)}")
    return referring("\n".join(lines) + "\n", "schemas/settings.json")


def _comment(row: Row) -> str:
    text = plain(row.meaning).replace("`", "")
    return f"{text} ({row.range})" if row.range and row.range != "true, false" else text


def mark(name: str) -> str:
    """The line before the table of a kind of file in a document; a blank line ends the table."""
    return f"<!-- keys of the {name} file, written by `python docs/key_tables.py` -->\n"


def renewed(text: str) -> str:
    """A document with its tables of keys made anew."""
    for name in FILES:
        if (line := mark(name)) in text:
            before, after = text.split(line)
            rest = after.lstrip("\n").partition("\n\n")[2] if after.strip().startswith("|") else after
            text = f"{before}{line}\n{table(name)}" + (f"\n{rest}" if rest else "")
    return text


def write_documents(docs: Path) -> list[Path]:
    """Renew the tables of all documents in a folder; returns those that changed."""
    changed = []
    for page in sorted(docs.glob("**/*.md")):
        text = page.read_text(encoding="utf-8")
        if (new := renewed(text)) != text:
            page.write_text(new, encoding="utf-8")
            changed.append(page)
    return changed
