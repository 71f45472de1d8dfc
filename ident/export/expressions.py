"""A small graph of expressions that simplifies itself as it is built.

Equal expressions are one node (hash consing), so common subexpressions are found by construction. Constants
are folded; terms with a zero, factors of one and double signs vanish; signs move outwards, so that `a - b`
and `b - a` share a node.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

__all__ = ["Expression", "Graph", "Vector", "cross", "dot"]

_COMMUTATIVE = ("add", "mul")


@dataclass(frozen=True, eq=False)
class Expression:
    """A node of a graph; arithmetic on it makes further nodes of the same graph."""

    graph: Graph
    index: int

    def __add__(self, other: Expression) -> Expression:
        return self.graph.add(self, other)

    def __sub__(self, other: Expression) -> Expression:
        return self.graph.sub(self, other)

    def __mul__(self, other: Expression) -> Expression:
        return self.graph.mul(self, other)

    def __neg__(self) -> Expression:
        return self.graph.neg(self)

    @property
    def value(self) -> float | None:
        """The number, if the expression is one."""
        kind, *rest = self.graph.nodes[self.index]
        return float(rest[0]) if kind == "const" else None


Vector = tuple[Expression, Expression, Expression]
Node = tuple[str | int | float, ...]


class Graph:
    """All expressions of one program. `nodes[i]` is (kind, operands...), operands before the node itself."""

    def __init__(self) -> None:
        self.nodes: list[Node] = []
        self._known: dict[Node, int] = {}

    def const(self, value: float) -> Expression:
        """A number."""
        return self._node(("const", float(value) + 0.0))

    def input(self, name: str, position: int) -> Expression:
        """Entry `position` of the argument `name`."""
        return self._node(("input", name, position))

    def call(self, function: str, operand: Expression, *arguments: float) -> Expression:
        """`sin`, `cos`, `sign`, `tanh` (of operand / argument) or `deadband` (sign, 0 up to the argument)."""
        if operand.value is not None:
            return self.const(_CALLS[function](operand.value, *arguments))
        return self._node((function, operand.index, *arguments))

    def neg(self, a: Expression) -> Expression:
        """-a."""
        if a.value is not None:
            return self.const(-a.value)
        kind, *operands = self.nodes[a.index]
        if kind == "neg":
            return Expression(self, int(operands[0]))
        return self._node(("neg", a.index))

    def add(self, a: Expression, b: Expression) -> Expression:
        """a + b."""
        if a.value is not None and b.value is not None:
            return self.const(a.value + b.value)
        if a.value == 0.0:
            return b
        if b.value == 0.0:
            return a
        (a, minus_a), (b, minus_b) = self._unsigned(a), self._unsigned(b)
        if minus_a and minus_b:
            return self.neg(self._sum(a, b))
        if minus_b:
            return self._difference(a, b)
        if minus_a:
            return self._difference(b, a)
        return self._sum(a, b)

    def sub(self, a: Expression, b: Expression) -> Expression:
        """a - b."""
        return self.add(a, self.neg(b))

    def mul(self, a: Expression, b: Expression) -> Expression:
        """a b."""
        if a.value is not None and b.value is not None:
            return self.const(a.value * b.value)
        (a, minus_a), (b, minus_b) = self._unsigned(a), self._unsigned(b)
        product = self._product(a, b)
        return self.neg(product) if minus_a != minus_b else product

    def _product(self, a: Expression, b: Expression) -> Expression:
        if b.value is not None:
            a, b = b, a
        if a.value == 0.0:
            return a
        if a.value == 1.0:
            return b
        if a.value is not None:
            kind, *operands = self.nodes[b.index]
            if kind == "mul":
                inner = Expression(self, int(operands[0]))
                if inner.value is not None:
                    return self._product(
                        self.const(a.value * inner.value), Expression(self, int(operands[1]))
                    )
        return self._node(("mul", *self._ordered(a, b)))

    def _sum(self, a: Expression, b: Expression) -> Expression:
        return self._node(("add", *self._ordered(a, b)))

    def _difference(self, a: Expression, b: Expression) -> Expression:
        if a.index == b.index:
            return self.const(0.0)
        if ("sub", b.index, a.index) in self._known:
            return self.neg(Expression(self, self._known["sub", b.index, a.index]))
        return self._node(("sub", a.index, b.index))

    def _ordered(self, a: Expression, b: Expression) -> tuple[int, int]:
        """Operands in one order, a constant first."""
        first, second = sorted((a, b), key=lambda e: (e.value is None, e.index))
        return first.index, second.index

    def _unsigned(self, a: Expression) -> tuple[Expression, bool]:
        """The expression without its sign, and whether it had one."""
        if a.value is not None:
            return (self.const(-a.value), True) if a.value < 0.0 else (a, False)
        kind, *operands = self.nodes[a.index]
        return (Expression(self, int(operands[0])), True) if kind == "neg" else (a, False)

    def _node(self, node: Node) -> Expression:
        if node not in self._known:
            self._known[node] = len(self.nodes)
            self.nodes.append(node)
        return Expression(self, self._known[node])

    def operands(self, index: int) -> tuple[int, ...]:
        """Nodes that node `index` is made of."""
        kind, *rest = self.nodes[index]
        if kind in ("const", "input"):
            return ()
        if kind in ("add", "sub", "mul"):
            return int(rest[0]), int(rest[1])
        return (int(rest[0]),)

    def needed(self, outputs: Sequence[Expression]) -> list[int]:
        """Nodes that the outputs depend on, operands first."""
        found: set[int] = set()
        pending = [output.index for output in outputs]
        while pending:
            index = pending.pop()
            if index not in found:
                found.add(index)
                pending.extend(self.operands(index))
        return sorted(found)


def _sign(value: float) -> float:
    return float((value > 0.0) - (value < 0.0))


_CALLS: dict[str, Callable[..., float]] = {
    "sin": math.sin,
    "cos": math.cos,
    "sign": _sign,
    "tanh": lambda value, width: math.tanh(value / width),
    "deadband": lambda value, width: 0.0 if abs(value) <= width else _sign(value),
}


def cross(a: Vector, b: Vector) -> Vector:
    """a x b."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


def dot(a: Sequence[Expression], b: Sequence[Expression]) -> Expression:
    """Sum of the products of the entries."""
    total = a[0] * b[0]
    for x, y in zip(a[1:], b[1:], strict=True):
        total = total + x * y
    return total
