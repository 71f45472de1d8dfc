"""Search of KRL modules for unknown names and wrong numbers of arguments, before they run."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import Any

from fri import krl_tree as tree
from fri.errors import ConfigurationError
from fri.krl_system import FUNCTIONS, STRUCTURES, System, Table


@lru_cache(maxsize=1024)
def split(name: str) -> tuple[str, tuple[str, ...]]:
    """A dotted name and its fields: `$LOAD` and (`CM`, `X`)."""
    title, *fields = name.split(".")
    return title, tuple(fields)


class Check:
    """`remarks` after `run` : what the modules ask for and do not get."""

    def __init__(
        self,
        sources: Sequence[tree.Source],
        programs: Mapping[str, tuple[int, tree.Subprogram]],
        name: str,
    ) -> None:
        self._sources, self._programs, self._name = sources, programs, name
        self._known: dict[str, tree.Declaration] = {}
        self._parameters: frozenset[str] = frozenset()
        self._external: frozenset[str] = frozenset()
        self.remarks: list[str] = []

    def run(self) -> None:
        """Look through all subprograms. Raises ConfigurationError with the line."""
        for source in self._sources:
            self._external = source.external - set(self._programs)
            for subprogram in source.subprograms.values():
                self._known = {**source.declarations, **subprogram.declarations}
                self._parameters = frozenset(name for name, _ in subprogram.parameters)
                self._part(subprogram.body, 0)

    def _remark(self, line: int, text: str) -> None:
        if not any(known.endswith(text) for known in self.remarks):
            self.remarks.append(f"{self._name}, line {line}: {text}")

    def _statement(self, statement: tree.Statement) -> None:
        if isinstance(statement, tree.Ignored):
            word = statement.text.split("(")[0].split()
            named = " ".join(word[:2]) if word[0].upper() == "GLOBAL" else word[0]
            self._remark(statement.line, f"{named.upper()} has no effect on the emulated controller")
            return
        for value in vars(statement).values():
            if isinstance(value, (tuple, *_NODES)):
                self._part(value, statement.line)
        if isinstance(statement, (tree.Assign, tree.For)):
            target = statement.target if isinstance(statement, tree.Assign) else statement.variable
            title = split(target.name)[0]
            own = title in self._known or title in self._parameters
            if not own and System.read_only(title):
                raise self._error(statement.line, f"{title} cannot be written")

    def _part(self, value: Any, line: int) -> None:
        if isinstance(value, tuple):
            for item in value:
                if isinstance(item, (tuple, *_NODES)):
                    self._part(item, line)
        elif isinstance(value, tree.Name):
            self._variable(value, line)
        elif isinstance(value, tree.Call):
            self._call(value)
        elif isinstance(value, (tree.Unary, tree.Binary)):
            for inner in vars(value).values():
                self._part(inner, line)
        elif isinstance(value, tree.Aggregate):
            for _, inner in value.items:
                self._part(inner, line)
        elif isinstance(value, tree.Statement):
            self._statement(value)

    def _call(self, call: tree.Call) -> None:
        known = self._programs.get(call.name)
        if known is not None:
            low = high = len(known[1].parameters)
            low = 0
        elif call.name in FUNCTIONS:
            low, high = FUNCTIONS[call.name]
        elif call.name in self._external:
            self._remark(
                call.line, f"{call.name} of another module is passed over; put its .src beside the program"
            )
            low, high = 0, len(call.arguments)
        else:
            raise self._error(call.line, f"there is no function {call.name}")
        if not low <= len(call.arguments) <= high:
            raise self._error(call.line, f"{call.name} takes {high} arguments, not {len(call.arguments)}")
        # Texts and states for output are not read.
        if call.name not in ("SWRITE", "SREAD", "CWRITE", "BAS"):
            self._part(call.arguments, call.line)

    def _variable(self, name: tree.Name, line: int) -> None:
        title, fields = split(name.name)
        declared = self._known.get(title)
        if declared is not None:
            self._fields(
                STRUCTURES.get(declared.kind) if not declared.size else None, fields, name.name, line
            )
        elif title not in self._parameters:
            template = System.template(title)
            if template is None and title.startswith("$") and not title.startswith("$FRI"):
                self._remark(
                    line, f"the emulated controller does not have {title}; it is a plain variable here"
                )
            elif template is None:
                raise self._error(line, f"there is no variable {title}")
            self._fields(template, fields, name.name, line)
            if System.array(title) and name.index is None:
                raise self._error(line, f"{title} needs an index")
        self._part(name.index, line)
        self._part(name.rest, line)

    def _fields(self, template: Any, fields: Sequence[str], name: str, line: int) -> None:
        for field in fields:
            if not isinstance(template, dict) or isinstance(template, Table) or not template:
                return
            if field not in template:
                raise self._error(line, f"there is no variable {name}")
            template = template[field]

    def _error(self, line: int, text: str) -> ConfigurationError:
        return ConfigurationError(f"{self._name}, line {line}: {text}")


_NODES = (
    tree.Constant, tree.Name, tree.Aggregate, tree.Unary, tree.Binary, tree.Call, tree.Assign, tree.Branch,
    tree.Switch, tree.Loop, tree.Repeat, tree.For, tree.WaitFor, tree.WaitSeconds, tree.Move, tree.Halt,
    tree.Leave, tree.Ignored,
)  # fmt: skip
