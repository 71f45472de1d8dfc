"""The order of packages and rooms as docs/architecture.md states it, and no circle of imports."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from functools import cache
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
PACKAGES = ("fri", "lwr_driver", "ident", "sim_backend", "runner")
# Imports within a function that may lead back, each with its reason.
LATE = {
    (
        "ident.estimation.identify",
        "ident.estimation.automatic",
    ): "estimator `auto` identifies with other estimators",
    ("sim_backend.robot", "sim_backend.model_arm"): "an arm without an identified model starts twice as fast",
}
FILES = {
    ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"): path
    for package in PACKAGES
    for path in (ROOT / package).rglob("*.py")
}


def imports(node: ast.AST) -> Iterator[str]:
    """Modules imported anywhere below a node, in functions too; those for type checkers only are left out."""
    if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING":
        return
    if isinstance(node, ast.Import):
        yield from (alias.name for alias in node.names)
    elif isinstance(node, ast.ImportFrom):
        inner = (f"{node.module}.{alias.name}" for alias in node.names)
        yield from (name if name in FILES else str(node.module) for name in inner)
    for child in ast.iter_child_nodes(node):
        yield from imports(child)


@cache
def graph() -> dict[str, set[str]]:
    """Modules of this project that each module imports."""
    return {
        name: {found for found in imports(ast.parse(path.read_text(encoding="utf-8"))) if found in FILES}
        - {name}
        for name, path in FILES.items()
    }


def order(first: str) -> dict[str, int]:
    """Level by name, 0 at the bottom, from the line of the document that begins with `first`."""
    line = re.search(rf"^{first} <.*$", (ROOT / "docs/architecture.md").read_text(), re.MULTILINE)
    assert line is not None
    return {name: level for level, part in enumerate(line[0].split(" < ")) for name in part.split(", ")}


@pytest.mark.parametrize(
    ("first", "prefix"), [("fri", ""), ("dynamics", "ident."), ("settings", "ident.diagnosis.")]
)
def test_imports_go_down_the_stated_order(first: str, prefix: str) -> None:
    levels = order(first)
    members = {name.removeprefix(prefix).partition(".")[0] for name in FILES if name.startswith(prefix)}
    assert {*levels} == members
    for module, found in graph().items():
        for other in found:
            mine, its = (name.removeprefix(prefix).partition(".")[0] for name in (module, other))
            if module.startswith(prefix) and other.startswith(prefix) and mine != its:
                assert levels[mine] > levels[its], f"{module} imports {other}"


def test_no_module_imports_itself_by_way_of_others() -> None:
    for (module, other), reason in LATE.items():
        assert other in graph()[module], f"{module} no longer imports {other}: {reason}"
    late = {module: {other for m, other in LATE if m == module} for module in graph()}
    TopologicalSorter({module: found - late[module] for module, found in graph().items()}).prepare()


def test_ident_has_no_loose_modules() -> None:
    assert [path.name for path in (ROOT / "ident").glob("*.py")] == ["__init__.py"]
