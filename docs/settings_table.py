"""Writes the table in docs/identify_settings.md and configs/identify.yaml anew: python docs/settings_table.py."""

from __future__ import annotations

from pathlib import Path

from runner.estimation import KEYS, Key

PAGE = Path(__file__).with_name("identify_settings.md")
TEMPLATE = Path(__file__).parents[1] / "configs/identify.yaml"
MARK = "The keys, with a dot between a section and its key:\n"
HEAD = """\
# Settings of `lwr-run identify --settings FILE`. Every key is here with its default; copy what you change.
# Written by `python docs/settings_table.py`; docs/identify_settings.md has the same as a table.
"""


def table() -> str:
    """All keys as a table."""
    head = "| key | unit | range | default | meaning |\n| --- | --- | --- | --- | --- |\n"
    return head + "".join(
        f"| `{key.name}` | {key.unit} | {key.range} | {key.default} | {key.meaning} |\n" for key in KEYS
    )


def template() -> str:
    """All keys as a settings file with their defaults."""
    lines, section = [HEAD.rstrip()], ""
    for key in KEYS:
        head, mark, name = key.name.rpartition(".")
        if head != section:
            lines += ["", f"{head}:"] if head else []
            section = head
        value, _, meaning = key.default.partition(": ")
        lines.append(f"{'  ' if mark else ''}{name}: {value}".ljust(32) + f"# {comment(key, meaning)}")
    return "\n".join(lines) + "\n"


def comment(key: Key, null: str) -> str:
    """Meaning, unit, range and the meaning of null."""
    unit = f" [{key.unit}]" if key.unit else ""
    extra = "; ".join(text for text in (key.range, f"null: {null}" if null else "") if text)
    return f"{key.meaning.replace('`', '')}{unit}" + (f"; {extra.replace('`', '')}" if extra else "")


if __name__ == "__main__":
    text = PAGE.read_text(encoding="utf-8")
    PAGE.write_text(text[: text.index(MARK) + len(MARK)] + "\n" + table(), encoding="utf-8")
    TEMPLATE.write_text(template(), encoding="utf-8")
