"""Pages of the site that are made from the code: commands, Python API, messages, pictures; a hook of MkDocs.

README, CHANGELOG, CONTRIBUTING and the guide of the KRL program become pages, too, with their links turned.
"""

from __future__ import annotations

import ast
import importlib
import re
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import click

from fri import errors
from runner.cli import EXIT_CODES, VERBS, main

ROOT = Path(__file__).resolve().parents[1]
# Files outside of docs/ that become pages.
PAGES = {
    "index.md": "README.md",
    "changes.md": "CHANGELOG.md",
    "contributing.md": "CONTRIBUTING.md",
    "krl.md": "configs/krl/README.md",
    "notebook.md": "docs/notebook.ipynb",
}
PACKAGES = ("fri", "lwr_driver", "ident", "sim_backend", "runner")
API = {
    "ident": "the face for scripts and notebooks",
    "ident.estimators": "estimators",
    "ident.effects": "causes of model error",
    "lwr_driver.arm": "the description of an arm",
    "lwr_driver.session": "session logs",
    "ident.import_log": "recordings of other programs",
    "runner.schema": "schemas of the files",
    "fri.errors": "errors",
}
WHO = {
    "ConfigurationError": "A file, an option or an argument (exit code 2)",
    "FileError": "A file or folder that the system refuses (exit code 2)",
    "RefusedError": "A check before the motion (exit code 3)",
    "OperatorError": "The person at the arm (exit code 4)",
    "RobotError": "The arm or its controller (exit code 5)",
    "NetworkError": "Cable, address or real-time PC (exit code 6)",
    "DataError": "Recorded or imported measurements (exit code 7)",
}


def turned(text: str, page: str) -> str:
    """A text with its links from the place of a file to that of its page."""
    source = ROOT / PAGES.get(page, f"docs/{page}")

    def turn(found: re.Match[str]) -> str:
        label, target, anchor = found[1], found[2], found[3] or ""
        if "://" in target or not target:
            return found[0]
        there = (source.parent / target).resolve()
        if re.fullmatch(r"[\w./]+\.(md|ipynb)", label):
            # A page has no ending.
            label = Path(label).stem.replace("_", " ")
        for name, file in PAGES.items():
            if there == ROOT / file:
                return f"[{label}]({name}{anchor})"
        if there.is_relative_to(ROOT / "docs") and there.suffix not in (".ipynb", ".py"):
            return f"[{label}]({there.relative_to(ROOT / 'docs')}{anchor})"
        # Files of the repository are named, not linked: the site is read without it.
        return label if label.startswith("`") else f"{label} (`{there.relative_to(ROOT)}`)"

    return re.sub(r"(?<!!)\[((?:[^\[\]]|\[[^\]]*\])*)\]\(([^)#\s]*)(#[^)\s]*)?\)", turn, text)


def commands_page() -> str:
    """Every command with its arguments and options, from the declarations of the command line."""
    parts = ["# Commands\n", f"```text\n{EXIT_CODES.replace(chr(8), '').strip()}\n```\n"]
    with click.Context(main, info_name="lwr-run", **main.context_settings) as top:
        for name in VERBS:
            command = main.get_command(top, name)
            assert command is not None
            with click.Context(command, info_name=name, parent=top) as context:
                parts.append(_command(name, command, context))
    return "\n".join(parts)


def _command(name: str, command: click.Command, context: click.Context) -> str:
    usage = " ".join(command.collect_usage_pieces(context))
    prose, *examples = re.split(r"^\s*\x08\s*$", str(command.help), flags=re.MULTILINE)
    rows = [
        f"| `{', '.join((*p.opts, *p.secondary_opts))}` | {_kind(p, context)} | {_cell(p.help)} |"
        for p in command.params
        if isinstance(p, click.Option)
    ]
    text = [f"## {name}\n", f"```text\nlwr-run {name} {usage}\n```\n", _paragraphs(prose)]
    text += [f"```text\n{_paragraphs(example)}\n```\n" for example in examples]
    text += ["| option | value | meaning |\n| --- | --- | --- |", *rows, ""]
    return "\n".join(text)


def _paragraphs(text: str) -> str:
    return "\n".join(line.strip() for line in text.strip().splitlines()) + "\n"


def _cell(text: str | None) -> str:
    return (text or "").replace("|", "\\|").replace("<", "&lt;")


def _kind(option: click.Option, context: click.Context) -> str:
    if option.is_flag or option.count:
        return "flag"
    word = option.make_metavar(context).strip("[]").replace("|", "\\|")
    shown = option.default
    return f"`{word}`" + (f", default {shown}" if option.show_default and shown is not None else "")


def api_page() -> str:
    """The public names of the packages, from their docstrings."""
    parts = [
        "# Python API\n",
        "A script needs [the face](#ident) alone; [python.md](python.md) shows it at work.\n",
    ]
    for name, meaning in API.items():
        module = importlib.import_module(name)
        names = sorted(getattr(module, "__all__", [])) or [
            key for key, value in vars(module).items() if getattr(value, "__module__", "") == name
        ]
        parts += [f"## {name} {{#{name}}}\n", f"{meaning.capitalize()}.\n"]
        for public in names:
            value = getattr(module, public, None)
            home = getattr(value, "__module__", None)
            if not callable(value) or home is None or not home.startswith(PACKAGES):
                continue
            parts.append(f"::: {home}.{value.__qualname__}\n    options: {{heading_level: 3}}\n")
    return "\n".join(parts)


@dataclass(frozen=True)
class Message:
    """A message of an error: class, text with `...` for values, module and line."""

    error: str
    text: str
    module: str
    line: int


def messages() -> Iterator[Message]:
    """The messages of all errors raised in the code, with their values left out."""
    for package in PACKAGES:
        for path in sorted((ROOT / package).rglob("*.py")):
            tree = ast.parse(path.read_text(encoding="utf-8"))
            for node in ast.walk(tree):
                call = node.exc if isinstance(node, ast.Raise) else None
                if not isinstance(call, ast.Call) or not isinstance(call.func, ast.Name) or not call.args:
                    continue
                kind = getattr(errors, call.func.id, None)
                text = _template(call.args[0])
                if kind is not None and len(re.sub(r"[.\s:;,]", "", text)) > 10:
                    place = path.relative_to(ROOT)
                    yield Message(call.func.id, text, str(place), node.lineno)


def _template(node: ast.expr) -> str:
    """The text of an expression, `...` for each value in it."""
    if isinstance(node, ast.Constant):
        return str(node.value)
    if isinstance(node, ast.JoinedStr):
        return re.sub(r"(?:\.\.\. ?)+\.\.\.", "...", "".join(_template(part) for part in node.values))
    if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Add):
        return _template(node.left) + _template(node.right)
    return "..."


@cache
def notebook() -> tuple[str, dict[str, bytes]]:
    """The notebook as Markdown with the outputs that it stores, and its figures by name."""
    from nbconvert import MarkdownExporter

    text, found = MarkdownExporter().from_filename(str(ROOT / PAGES["notebook.md"]))
    # Tables of pandas get the style of the site, and scroll on narrow screens.
    text = re.sub(
        r'<table border="1" class="dataframe">|<style scoped>.*?</style>', _plain_table, text, flags=re.DOTALL
    )
    return text.replace("![png](", "![Figure of the cell above]("), found["outputs"]


def _plain_table(found: re.Match[str]) -> str:
    return "<table>" if found[0].startswith("<table") else ""


def notebook_page() -> str:
    """The notebook with the outputs that the tests compare."""
    return notebook()[0]


def messages_page() -> str:
    """Every message of an error, by who must act."""
    found = list(messages())
    text = ["# All messages\n"]
    text.append(
        "Every error is one message with subject, value, limit and advice; `...` stands for a value or a name. "
        "The exit code says who must act. Search for two words of your message; "
        "[troubleshooting.md](troubleshooting.md) explains the frequent ones.\n"
    )
    for kind, who in WHO.items():
        lines = sorted(
            {m.text.strip().removeprefix("...: ") for m in found if m.error == kind}, key=str.lower
        )
        if lines:
            text += [f"## {who}\n", *(f"- {_code(line)}" for line in lines), ""]
    return "\n".join(text)


def _code(line: str) -> str:
    return f"`` {' '.join(line.split())} ``"


def pictures_page() -> str:
    """Every picture of the documents with its words, and the page that shows it."""
    parts = [
        "# Pictures\n",
        "Made by `make pictures`, by `make screenshot` in a browser, and by the benchmarks.\n",
    ]
    seen = set()
    # In the order of the navigation.
    pages = re.findall(r"(\w+\.md)$", (ROOT / "mkdocs.yml").read_text(encoding="utf-8"), re.MULTILINE)
    for page in (ROOT / "docs" / name for name in pages if (ROOT / "docs" / name).is_file()):
        for words, file in re.findall(r"!\[([^\]]*)\]\((images/[^)]+)\)", page.read_text(encoding="utf-8")):
            if file not in seen:
                seen.add(file)
                parts.append(
                    f"![{words}]({file})\n\n{words} ([{page.stem.replace('_', ' ')}]({page.name}))\n"
                )
    return "\n".join(parts)


MADE = {
    "commands.md": commands_page,
    "api.md": api_page,
    "messages.md": messages_page,
    "pictures.md": pictures_page,
    "notebook.md": notebook_page,
}
"""Pages made from the code, by name."""


def generated() -> dict[str, str]:
    """Text of each page that is not a file of docs/."""
    return {
        **{p: (ROOT / f).read_text(encoding="utf-8") for p, f in PAGES.items() if p not in MADE},
        **{page: make() for page, make in MADE.items()},
    }


def on_files(files: Any, config: Any) -> Any:
    """Add the pages made here."""
    from mkdocs.structure.files import File

    for name, content in {**generated(), **notebook()[1]}.items():
        files.append(File.generated(config, name, content=content))
    return files


def on_page_markdown(markdown: str, page: Any, config: Any, files: Any) -> str:
    """Turn the links of a page."""
    text = turned(markdown, page.file.src_uri)
    # Blocks that take long are marked for the tests; pictures of the README lie in docs/.
    return re.sub(r"^```(\w+) slow$", r"```\1", text, flags=re.MULTILINE).replace(
        "](docs/images/", "](images/"
    )
