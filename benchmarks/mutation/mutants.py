"""Small changes of a source file, as cosmic-ray makes them, without those that change nothing but text."""

from __future__ import annotations

import difflib
import hashlib
import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import parso
from cosmic_ray.mutating import mutate_code
from cosmic_ray.operators.binary_operator_replacement import _MUTATION_OPERATORS as BINARY
from cosmic_ray.operators.boolean_replacer import (
    AddNot,
    ReplaceAndWithOr,
    ReplaceFalseWithTrue,
    ReplaceOrWithAnd,
    ReplaceTrueWithFalse,
)
from cosmic_ray.operators.break_continue import ReplaceBreakWithContinue, ReplaceContinueWithBreak
from cosmic_ray.operators.comparison_operator_replacement import _OPERATORS as COMPARISON
from cosmic_ray.operators.exception_replacer import ExceptionReplacer
from cosmic_ray.operators.number_replacer import NumberReplacer
from cosmic_ray.operators.operator import Operator
from cosmic_ray.operators.unary_operator_replacement import _MUTATION_OPERATORS as UNARY
from cosmic_ray.operators.zero_iteration_for_loop import ZeroIterationForLoop

#: The modules under trial, by stratum of the sample: files, or folders with all their files.
STRATA: Mapping[str, tuple[str, ...]] = {
    "fri": ("fri",),
    "lwr_driver": (
        "lwr_driver/guard.py",
        "lwr_driver/loop.py",
        "lwr_driver/cycle_rows.py",
        "lwr_driver/means.py",
        "lwr_driver/setpoint.py",
    ),
    "ident/dynamics": ("ident/dynamics",),
    "ident/rows": ("ident/rows",),
    "ident/estimators": ("ident/estimators",),
    "runner/experiment": ("runner/experiment.py",),
}

# cosmic-ray knows every pair of operators. Most of them, such as a shift of floats, fail at once and show nothing.
_PAIRS: tuple[str, ...] = (
    *("Add_Sub", "Sub_Add", "Mul_Div", "Div_Mul", "FloorDiv_Mul", "Mod_FloorDiv", "Pow_Mul"),
    *("LShift_RShift", "RShift_LShift", "BitOr_BitAnd", "BitAnd_BitOr"),
    *("Eq_NotEq", "NotEq_Eq", "Is_IsNot", "IsNot_Is"),
    *("Lt_LtE", "Lt_GtE", "LtE_Lt", "LtE_Gt", "Gt_GtE", "Gt_LtE", "GtE_Gt", "GtE_Lt"),
    *("Delete_USub", "Delete_Not", "Delete_Invert"),
)
# Text for a reader: no test pins its words.
_TEXT = {"__repr__", "__str__", "summary", "describe"}
# The order of their first two arguments does not matter.
_SYMMETRIC = {"min", "max", "np.minimum", "np.maximum", "np.array_equal", "np.allclose", "np.logaddexp"}
_QUIET = re.compile(r"\b(_?log|logger|logging|warnings)\.")


def _replace(node: Any, code: str) -> Any:
    """`node` with other code in the same place."""
    new = parso.parse(node.get_first_leaf().prefix + code)
    new.parent = node.parent
    return new


class _Own(Operator):
    """An operator that makes one change of a node at most."""

    @classmethod
    def examples(cls) -> tuple:
        return ()

    def changed(self, node: Any) -> str | None:
        """The code of the node after the change, or None for no change."""
        raise NotImplementedError

    def mutation_positions(self, node: Any) -> Iterator[tuple]:
        if self.changed(node) is not None:
            yield node.start_pos, node.end_pos

    def mutate(self, node: Any, index: int) -> Any:
        code = self.changed(node)
        assert code is not None
        return _replace(node, code)


class RemoveStatement(_Own):
    """A call, an assignment to an attribute or an element, an augmented assignment, or a raise becomes `pass`."""

    def changed(self, node: Any) -> str | None:
        if node.parent is None or node.parent.type != "simple_stmt":
            return None
        if node.type in ("atom_expr", "power"):
            return "pass" if node.children[-1].get_code().startswith("(") else None
        if node.type == "raise_stmt":
            return "pass"
        if node.type != "expr_stmt" or node.children[1].type == "annassign":
            return None
        augmented = node.children[1].get_code().strip() != "="
        return "pass" if augmented or node.children[0].type in ("atom_expr", "power") else None


class ReturnNone(_Own):
    """`return value` becomes `return None`."""

    def changed(self, node: Any) -> str | None:
        if node.type != "return_stmt" or node.children[1].get_code().strip() == "None":
            return None
        return "return None"


class SwapArguments(_Own):
    """The first two positional arguments of a call change places."""

    def changed(self, node: Any) -> str | None:
        if node.type != "arglist" or node.parent.type != "trailer":
            return None
        first, comma, second = node.children[:3]
        if any(part.type == "argument" for part in (first, second)):
            return None
        rest = "".join(child.get_code() for child in node.children[3:])
        if node.parent.parent.get_code().strip().startswith(tuple(f"{name}(" for name in _SYMMETRIC)):
            return None
        one, two = (part.get_code(include_prefix=False) for part in (first, second))
        return None if one == two else f"{two}{comma.get_code()} {one}{rest}"


OPERATORS: tuple[type[Operator], ...] = (
    *(kind for kind in (*BINARY, *COMPARISON, *UNARY) if kind.__name__.split("_", 1)[1] in _PAIRS),
    AddNot,
    ReplaceAndWithOr,
    ReplaceOrWithAnd,
    ReplaceTrueWithFalse,
    ReplaceFalseWithTrue,
    ReplaceBreakWithContinue,
    ReplaceContinueWithBreak,
    ExceptionReplacer,
    NumberReplacer,
    ZeroIterationForLoop,
    RemoveStatement,
    ReturnNone,
    SwapArguments,
)


@dataclass(frozen=True)
class Mutant:
    """A change of one file.

    file : path from the root. line, last : of the changed node, from 1. operator, occurrence : as cosmic-ray counts.
    """

    file: str
    line: int
    last: int
    operator: str
    occurrence: int

    def code(self, source: str) -> str:
        """The changed source."""
        kind = next(kind for kind in OPERATORS if kind.__name__ == self.operator)
        code = mutate_code(source, kind(), self.occurrence)
        assert code is not None, self
        return code


def mutants_of(file: str, source: str) -> list[Mutant]:
    """All mutants of a file, without those equivalent by construction."""
    tree = parso.parse(source)
    found = []
    for kind in OPERATORS:
        operator, occurrence = kind(), 0
        for node in _nodes(tree):
            for (line, _), (last, _) in operator.mutation_positions(node):
                if not _only_text(node, kind):
                    found.append(Mutant(file, line, last, kind.__name__, occurrence))
                occurrence += 1
    return sorted(found, key=lambda m: (m.line, m.operator, m.occurrence))


def _nodes(node: Any) -> Iterator[Any]:
    yield node
    for child in getattr(node, "children", ()):
        yield from _nodes(child)


def _only_text(node: Any, kind: type[Operator]) -> bool:
    """Whether the change concerns annotations, decorators, text, logs, the error in a raise, or a `strict`."""
    below, above = node, node.parent
    # An error if the code is wrong, and nothing else.
    if above is not None and above.type == "argument" and above.children[0].get_code().strip() == "strict":
        return True
    while above is not None:
        if above.type in ("fstring", "decorator", "import_from", "import_name"):
            return True
        if above.type == "raise_stmt" and kind is not RemoveStatement:
            return True
        if above.type == "annassign" and below is above.children[1]:
            return True
        if above.type in ("param", "tfpdef") and ":" in above.get_code() and _in_annotation(above, below):
            return True
        if above.type == "funcdef" and (above.name.value in _TEXT or below is above.annotation):
            return True
        if above.type == "if_stmt" and "TYPE_CHECKING" in above.children[1].get_code():
            return True
        if above.type == "simple_stmt" and _QUIET.search(above.get_code()):
            return True
        if above.type == "expr_stmt" and above.get_code().lstrip().startswith(("__all__", "__slots__")):
            return True
        below, above = above, above.parent
    return False


def _in_annotation(above: Any, below: Any) -> bool:
    annotation = above.annotation if above.type == "param" else above.children[2]
    return below is annotation or (above.type == "param" and below.type == "tfpdef")


def change(before: str, after: str) -> tuple[str, str]:
    """The lines that differ, before and after, each joined and stripped."""
    old, new = [], []
    for line in difflib.ndiff(before.splitlines(), after.splitlines()):
        if line[:2] == "- ":
            old.append(line[2:].strip())
        elif line[:2] == "+ ":
            new.append(line[2:].strip())
    return " ".join(old), " ".join(new)


def files(root: Path, places: Sequence[str]) -> list[str]:
    """Python files of these files and folders, paths from the root."""
    found: list[Path] = []
    for place in places:
        path = root / place
        found += [path] if path.is_file() else sorted(path.rglob("*.py"))
    return [str(path.relative_to(root)) for path in found]


def sample(root: Path, number: int, seed: int, only: Sequence[str] = ()) -> list[Mutant]:
    """`number` mutants of all strata, each with its share of all mutants.

    A mutant's place in the draw depends on the seed and on its own line alone: a change elsewhere draws the same ones.
    only : beginnings of paths; the sample is drawn from these files
    """
    by_stratum = {
        stratum: [
            drawn
            for file in files(root, places)
            if not only or file.startswith(tuple(only))
            for drawn in _drawn(file, (root / file).read_text("utf-8"), seed)
        ]
        for stratum, places in STRATA.items()
    }
    total = sum(map(len, by_stratum.values()))
    number = min(number, total)
    exact = {stratum: number * len(all_) / max(total, 1) for stratum, all_ in by_stratum.items()}
    counts = {stratum: int(share) for stratum, share in exact.items()}
    for stratum in sorted(exact, key=lambda s: counts[s] - exact[s])[: number - sum(counts.values())]:
        counts[stratum] += 1
    return [
        mutant
        for stratum, all_ in by_stratum.items()
        for _, mutant in sorted(all_, key=lambda item: item[0])[: counts[stratum]]
    ]


def _drawn(file: str, source: str, seed: int) -> Iterator[tuple[bytes, Mutant]]:
    """All mutants of a file, each with a number to draw by."""
    lines, seen = source.splitlines(), Counter[str]()
    for mutant in mutants_of(file, source):
        text = "\n".join(line.strip() for line in lines[mutant.line - 1 : mutant.last])
        name = f"{file} {mutant.operator} {text}"
        yield hashlib.sha256(f"{seed} {seen[name]} {name}".encode()).digest(), mutant
        seen[name] += 1
