"""Tests and benchmarks are packages of the project's root, imported by their full names."""

from __future__ import annotations

import ast
import importlib
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.parametrize("package", ["tests", "benchmarks"])
def test_modules_are_found_without_changes_of_the_search_path(package: str) -> None:
    for module in (ROOT / package).rglob("*.py"):
        assert (module.parent / "__init__.py").is_file(), f"{module.parent} is no package"
        source = module.read_text(encoding="utf-8")
        for change in ("sys." + "path", "syspath" + "_prepend"):
            assert change not in source, f"{module}: {change}"


def test_no_test_module_takes_from_another() -> None:
    """What several need is in a module of its own."""
    for module in (ROOT / "tests").rglob("*.py"):
        for node in ast.walk(ast.parse(module.read_text(encoding="utf-8"))):
            name = str(node.module) if isinstance(node, ast.ImportFrom) else ""
            assert not name.rpartition(".")[2].startswith("test_"), f"{module} imports {name}"


@pytest.mark.parametrize("package", ["fri", "lwr_driver", "ident", "sim_backend", "runner"])
def test_a_module_has_every_name_that_it_offers(package: str) -> None:
    for path in (ROOT / package).rglob("*.py"):
        if "__all__" in path.read_text(encoding="utf-8"):
            name = ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")
            module = importlib.import_module(name)
            assert [one for one in getattr(module, "__all__", ()) if not hasattr(module, one)] == [], name
