"""Values in a KRL program: its variables, and expressions worked out with them."""

from __future__ import annotations

import operator
from collections.abc import Callable, Collection, Mapping, Sequence
from functools import partial
from typing import Any

from fri import krl_tree as tree
from fri.krl_check import split
from fri.krl_system import Path, System, first_value, get, put

_OPERATORS: dict[str, Callable[[Any, Any], Any]] = {
    "AND": lambda a, b: a and b,
    "OR": lambda a, b: a or b,
    "EXOR": operator.ne,
    "B_AND": operator.and_,
    "B_OR": operator.or_,
    "B_EXOR": operator.xor,
    "==": operator.eq,
    "<>": operator.ne,
    "<": operator.lt,
    ">": operator.gt,
    "<=": operator.le,
    ">=": operator.ge,
    "+": operator.add,
    "-": operator.sub,
    "*": operator.mul,
}


class Frame:
    """A subprogram at work: its module and its own variables."""

    def __init__(self, module: int, values: dict[str, Any]) -> None:
        self.module, self.values = module, values
        self.result: Any = None


class Values:
    """Variables of the modules `sources` and of the subprograms at work, and those of the controller in `system`.

    programs : names of the subprograms; `call` runs one within an expression, for its result
    frames : of the subprograms at work, innermost last; modules : variables of the data lists
    """

    def __init__(
        self,
        sources: Sequence[tree.Source],
        programs: Collection[str],
        system: System,
        call: Callable[[tree.Call], Any],
    ) -> None:
        self._programs, self._system, self._call = programs, system, call
        # By identity: prepared expressions, and places of variables without indices to be worked out.
        self._evaluators: dict[int, Callable[[], Any]] = {}
        self._places: dict[int, tuple[str, Path]] = {}
        self.frames = [Frame(0, {})]
        self.modules: list[dict[str, Any]] = []
        for number, source in enumerate(sources):
            self.modules.append({})
            self.frames[:] = [Frame(number, {})]
            self.modules[-1].update(self.first_values(source.declarations))
            for element in source.elements:
                self.write(element.target, self.of(element.value))
        self.frames[:] = [Frame(0, {})]

    def first_values(self, declarations: Mapping[str, tree.Declaration]) -> dict[str, Any]:
        """First values of declared variables."""
        return {
            one.name: first_value(one.kind, one.size) if one.value is None else self.of(one.value)
            for one in declarations.values()
        }

    def of(self, expression: tree.Expression) -> Any:
        """The value of an expression."""
        evaluate = self._evaluators.get(id(expression))
        if evaluate is None:
            self._evaluators[id(expression)] = evaluate = self.evaluator(expression)
        return evaluate()

    def evaluator(self, expression: tree.Expression) -> Callable[[], Any]:
        """The value of an expression as a function, prepared once."""
        if isinstance(expression, tree.Constant):
            constant = expression.value
            return lambda: constant
        if isinstance(expression, tree.Name):
            return self._reader(expression)
        if isinstance(expression, tree.Binary):
            left, right = self.evaluator(expression.left), self.evaluator(expression.right)
            apply = _quotient if expression.operator == "/" else _OPERATORS[expression.operator]
            return lambda: apply(left(), right())
        if isinstance(expression, tree.Unary):
            operand = self.evaluator(expression.operand)
            if expression.operator == "NOT":
                return lambda: not operand()
            return (lambda: ~operand()) if expression.operator == "B_NOT" else (lambda: -operand())
        if isinstance(expression, tree.Aggregate):
            items = [(name, self.evaluator(value)) for name, value in expression.items]
            return lambda: {name: value() for name, value in items}
        if expression.name in self._programs:
            return partial(self._call, expression)
        arguments = [self.evaluator(one) for one in expression.arguments]
        return lambda: self._system.call(expression.name, [one() for one in arguments])

    def write(self, name: tree.Name, value: Any) -> None:
        """Set a variable."""
        title, path = self._place(name)
        owner = self._owner(title)
        if owner is None:
            self._system.write(title, path, value)
        else:
            owner[title] = put(owner[title], path, value, title)

    def writer(self, name: tree.Name) -> Callable[[Any], None]:
        """To set a variable, as a function; without indices to be worked out its place is found once."""
        if not _fixed(name):
            return partial(self.write, name)
        title, path = self._place(name)
        frames, modules, outside = self.frames, self.modules, self._system.writer(title, path)

        def write(value: Any) -> None:
            frame = frames[-1]
            owner = frame.values
            if title not in owner:
                owner = modules[frame.module]
                if title not in owner:
                    outside(value)
                    return
            owner[title] = put(owner[title], path, value, title)

        return write

    def _reader(self, name: tree.Name) -> Callable[[], Any]:
        """As `writer`, for the value of a variable."""
        if not _fixed(name):
            return partial(self._read, name)
        title, path = self._place(name)
        frames, modules, outside = self.frames, self.modules, self._system.reader(title, path)

        def read() -> Any:
            frame = frames[-1]
            owner = frame.values
            if title not in owner:
                owner = modules[frame.module]
                if title not in owner:
                    return outside()
            return get(owner[title], path, title) if path else owner[title]

        return read

    def _read(self, name: tree.Name) -> Any:
        title, path = self._place(name)
        owner = self._owner(title)
        return self._system.read(title, path) if owner is None else get(owner[title], path, title)

    def _place(self, name: tree.Name) -> tuple[str, Path]:
        """A variable's name and path."""
        known = self._places.get(id(name))
        if known is not None:
            return known
        title, fields = split(name.name)
        path: list[str | int | tuple[int, ...]] = list(fields)
        indices: list[int] = []
        for step in _steps(name):
            if isinstance(step, str):
                path += [tuple(indices) if len(indices) > 1 else indices[0]] if indices else []
                path.append(step[1:])
                indices = []
            else:
                indices.append(int(self.of(step)))
        path += [tuple(indices) if len(indices) > 1 else indices[0]] if indices else []
        if _fixed(name):
            self._places[id(name)] = title, tuple(path)
        return title, tuple(path)

    def _owner(self, title: str) -> dict[str, Any] | None:
        """The variables with one of this name: the subprogram's, its module's; None for the controller's."""
        frame = self.frames[-1]
        if title in frame.values:
            return frame.values
        known = self.modules[frame.module]
        return known if title in known else None


def _steps(name: tree.Name) -> tuple[str | tree.Expression, ...]:
    """Fields and indices of a variable from the first index on."""
    return ((name.index,) if name.index is not None else ()) + name.rest


def _fixed(name: tree.Name) -> bool:
    """Whether all indices are constant."""
    return all(isinstance(step, (str, tree.Constant)) for step in _steps(name))


def _quotient(left: Any, right: Any) -> Any:
    """KRL divides whole numbers without remainder."""
    whole = isinstance(left, int) and isinstance(right, int)
    return int(left / right) if whole else left / right
