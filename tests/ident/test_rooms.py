"""The rooms of `ident` import only lower ones, and no two of its modules import each other."""

from __future__ import annotations

import ast
from pathlib import Path

import ident

ROOT = Path(ident.__file__).parent
BELOW = {
    "dynamics": set(),
    "estimators": {"dynamics"},
    "rows": {"dynamics", "estimators"},
    "effects": {"dynamics", "estimators", "rows"},
    "model": {"dynamics", "effects"},
    "export": {"dynamics", "model"},
    "estimation": {"dynamics", "estimators", "rows", "effects", "model"},
    "import_log": set(),
}


def imports() -> dict[str, set[str]]:
    """Modules of `ident` imported by each of them, also inside functions."""
    names = {
        "ident." + ".".join(path.relative_to(ROOT).with_suffix("").parts): path for path in ROOT.rglob("*.py")
    }
    names = {name.removesuffix(".__init__"): path for name, path in names.items()}
    found: dict[str, set[str]] = {}
    for name, path in names.items():
        wanted: set[str] = set()
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("ident"):
                deep = {f"{node.module}.{alias.name}" for alias in node.names}
                wanted |= deep & set(names) or {str(node.module)}
        found[name] = wanted
    return found


def test_rooms_import_only_what_stands_below_them() -> None:
    for module, wanted in imports().items():
        room = module.split(".")[1] if "." in module else ""
        for other in {name.split(".")[1] for name in wanted if "." in name} - {room}:
            assert room not in BELOW or other in BELOW[room], f"{module} imports {other}"


def test_no_module_imports_itself_by_way_of_others() -> None:
    graph = imports()
    done: set[str] = set()

    def visit(module: str, way: tuple[str, ...]) -> None:
        assert module not in way, " -> ".join((*way[way.index(module) :], module))
        if module not in done:
            for other in sorted(graph.get(module, ())):
                visit(other, (*way, module))
            done.add(module)

    for module in graph:
        visit(module, ())


def test_no_loose_modules() -> None:
    assert [path.name for path in ROOT.glob("*.py")] == ["__init__.py"]
