"""Names of this project's modules in docstrings exist."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
FILES = {
    ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"): path
    for folder in ("fri", "lwr_driver", "ident", "sim_backend", "runner", "benchmarks", "tests")
    for path in (ROOT / folder).rglob("*.py")
}
DOTTED = re.compile(r"`([a-z_]\w*(?:\.[A-Za-z_]\w*)+)`")
SUFFIXES = ("html", "json", "jsonl", "md", "py", "yaml")
# Sections of a file, called like a module beside the docstring that tells of them.
KEYS = ("robot.gravity", "robot.payload")


def meant(module: str, name: str) -> str | None:
    """Full name of something in this project, None for one of elsewhere: a file, a key of one, another package."""
    if name.rpartition(".")[2] in SUFFIXES or name in KEYS:
        return None
    first = name.partition(".")[0]
    room = module if FILES[module].name == "__init__.py" else module.rpartition(".")[0]
    if f"{room}.{first}" in FILES:
        return f"{room}.{name}"
    return name if first in FILES else None


def named(module: str) -> Iterator[str]:
    """Full names of this project in the docstrings of a module."""
    text = FILES[module].read_text(encoding="utf-8")
    if not any(meant(module, name) for name in DOTTED.findall(text)):
        return
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
            for name in DOTTED.findall(str(node.value.value)):
                if full := meant(module, name):
                    yield full


@cache
def names_of(module: str) -> tuple[set[str], dict[str, set[str]]]:
    """What a module defines or imports, and the names in each of its classes that has all of its own."""
    tree = ast.parse(FILES[module].read_text(encoding="utf-8"))
    own = [node for node in tree.body if isinstance(node, ast.ClassDef) and not node.bases]
    return bound(tree), {node.name: bound(node) for node in own}


def bound(scope: ast.Module | ast.ClassDef) -> set[str]:
    """Names bound anywhere in a scope, in its functions too, and attributes set there."""
    found = set()
    for node in ast.walk(scope):
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            found.add(node.name)
        elif isinstance(node, ast.alias):
            found.add((node.asname or node.name).partition(".")[0])
        elif isinstance(node, ast.Name | ast.Attribute) and isinstance(node.ctx, ast.Store):
            found.add(node.id if isinstance(node, ast.Name) else node.attr)
    return found


def exists(name: str) -> bool:
    """Whether a full name is a folder, a module, or something within one."""
    if name in FILES or (ROOT / name.replace(".", "/")).is_dir():
        return True
    module = name.rpartition(".")[0]
    while module and module not in FILES:
        module = module.rpartition(".")[0]
    if not module:
        return False
    names, classes = names_of(module)
    first, *rest = name.removeprefix(f"{module}.").split(".")
    return first in names and (not rest or first not in classes or rest[0] in classes[first])


@pytest.mark.parametrize("folder", sorted({module.partition(".")[0] for module in FILES}))
def test_modules_and_their_names_in_docstrings_exist(folder: str) -> None:
    modules = [module for module in FILES if module.partition(".")[0] == folder]
    missing = {(module, name) for module in modules for name in named(module) if not exists(name)}
    assert not missing


@pytest.mark.parametrize(
    ("name", "there"),
    [
        ("ident.diagnosis.verdict.wear", True),
        ("ident.diagnosis.verdict.wear.wear", True),
        ("ident.diagnosis.verdict.wear.gone", False),
        ("ident.diagnosis.gone.wear", False),
        ("sim_backend.plant.Effect", False),
        ("sim_backend.plant.PlantEffect", True),
        ("sim_backend.plant.PlantEffect.gone", False),
        ("runner.schema.FILES", True),
    ],
)
def test_a_name_is_looked_up_in_its_module(name: str, there: bool) -> None:
    assert exists(name) == there
