"""Recursive Newton-Euler of a chain with given parameters as expressions of q, qd and qdd.

The customised algorithm of Khalil and Kleinfinger (1987): modified Denavit-Hartenberg frames, inertia about
the frame origins, and U = [alpha]x + [omega]x[omega]x formed once a link. With base parameters most of the
ten numbers of a link are zero and create no terms.

The graph of expressions simplifies itself. Equal expressions are one node (hash consing), so common
subexpressions are found by construction. Constants are folded; terms with a zero, factors of one and double signs
vanish; signs move outwards, so that `a - b` and `b - a` share a node.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from ident.formats.standard import StandardModel


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
        """A function of `FUNCTIONS`: of the operand, and of numbers such as the width of `tanh` and `deadband`."""
        if operand.value is not None:
            return self.const(FUNCTIONS[function](operand.value, *arguments))
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
        """Operands of node `index`."""
        kind, *rest = self.nodes[index]
        if kind in ("const", "input"):
            return ()
        if kind in ("add", "sub", "mul"):
            return int(rest[0]), int(rest[1])
        return (int(rest[0]),)

    def needed(self, outputs: Sequence[Expression]) -> list[int]:
        """Nodes needed for the outputs, operands first."""
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


FUNCTIONS: dict[str, Callable[..., float]] = {
    "sin": math.sin,
    "cos": math.cos,
    "exp": math.exp,
    "abs": abs,
    "sign": _sign,
    "tanh": lambda value, width: math.tanh(value / width),
    "deadband": lambda value, width: 0.0 if abs(value) <= width else _sign(value),
    "power": math.pow,
    "max": max,
    "min": min,
}
"""The functions of the programs: of a value, and for some of a number."""


def cross(a: Vector, b: Vector) -> Vector:
    """a x b."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


def dot(a: Sequence[Expression], b: Sequence[Expression]) -> Expression:
    """Sum of the products of the entries."""
    total = a[0] * b[0]
    for x, y in zip(a[1:], b[1:], strict=True):
        total = total + x * y
    return total


_Matrix = tuple[Vector, Vector, Vector]


def torques(
    graph: Graph,
    model: StandardModel,
    q: Sequence[Expression],
    qd: Sequence[Expression],
    qdd: Sequence[Expression],
) -> dict[str, list[Expression]]:
    """Torque of every joint for each side of the model: "joint", "motor", "difference"."""
    rigid = rigid_torque(graph, model, q, qd, qdd)
    joint, motor_only = [], []
    for k in range(model.chain.n):
        inertia, *friction = (graph.const(value) for value in model.drive[k])
        fvl, fcl, offl, fvm, fcm, offm = friction
        sign = speed_sign(graph, model, qd[k])
        joint.append(rigid[k] + (fvl * qd[k] + (fcl * sign + offl)))
        motor_only.append(inertia * qdd[k] + (fvm * qd[k] + (fcm * sign + offm)))
    for coupling in model.couplings:
        a, b = coupling.joints
        both = qd[a] + qd[b]
        shared = graph.const(coupling.viscous) * both + graph.const(coupling.coulomb) * speed_sign(
            graph, model, both
        )
        inertia = graph.const(coupling.inertia)
        motor_only[a] = motor_only[a] + (inertia * qdd[b] + shared)
        motor_only[b] = motor_only[b] + (inertia * qdd[a] + shared)
    motor = [after + before for after, before in zip(joint, motor_only, strict=True)]
    return {"joint": joint, "motor": motor, "difference": motor_only}


def speed_sign(graph: Graph, model: StandardModel, speed: Expression) -> Expression:
    """The model's function for the sign of a speed."""
    if model.coulomb_kind == "sign":
        return graph.call("sign", speed)
    return graph.call(model.coulomb_kind, speed, model.coulomb_width)


def rigid_torque(
    graph: Graph,
    model: StandardModel,
    q: Sequence[Expression],
    qd: Sequence[Expression],
    qdd: Sequence[Expression],
) -> list[Expression]:
    """Torque of every joint for the rigid bodies alone."""
    chain, zero = model.chain, graph.const(0.0)
    omega: Vector = (zero, zero, zero)
    alpha: Vector = (zero, zero, zero)
    x, y, z = (graph.const(-value) for value in chain.gravity)
    acceleration: Vector = (x, y, z)
    spin: _Matrix = ((zero, zero, zero),) * 3
    wrenches: list[tuple[Vector, Vector]] = []
    turns: list[_Turn] = []
    for k in range(chain.n):
        turn = _Turn(graph, model, k, q[k])
        turns.append(turn)
        # The origin of frame k moves with link k - 1.
        acceleration = turn.into(_add(acceleration, _times(spin, turn.arm)))
        omega, alpha = turn.into(omega), turn.into(alpha)
        if chain.prismatic[k]:
            two = graph.const(2.0)
            slide: Vector = (omega[1] * (two * qd[k]), -(omega[0] * (two * qd[k])), qdd[k])
            acceleration = _add(acceleration, slide)
        else:
            alpha = (alpha[0] + omega[1] * qd[k], alpha[1] - omega[0] * qd[k], alpha[2] + qdd[k])
            omega = (omega[0], omega[1], omega[2] + qd[k])
        products, spin = _spin(omega, alpha)
        wrenches.append(_wrench(graph, model, k, alpha, acceleration, products, spin))
    result = [zero] * chain.n
    force: Vector = (zero, zero, zero)
    moment: Vector = (zero, zero, zero)
    for k in reversed(range(chain.n)):
        own_force, own_moment = wrenches[k]
        force, moment = _add(own_force, force), _add(own_moment, moment)
        result[k] = force[2] if chain.prismatic[k] else moment[2]
        if k:
            force, moment = turns[k].out_of(force), turns[k].out_of(moment)
            moment = _add(moment, cross(turns[k].arm, force))
    return result


class _Turn:
    """Rotation and arm of frame k in frame k - 1, kept as Rx(alpha) Rz(theta): right angles cost nothing."""

    def __init__(self, graph: Graph, model: StandardModel, k: int, q: Expression) -> None:
        chain = model.chain
        cosine, sine = (graph.const(float(values[k])) for values in chain.cos_sin_alpha)
        self._ca, self._sa = cosine, sine
        zero_theta, zero_r = graph.const(float(chain.theta[k])), graph.const(float(chain.r[k]))
        if chain.prismatic[k]:
            self._ct, self._st = _cos_sin(graph, zero_theta, float(chain.theta[k]), None)
            r = zero_r + q
        else:
            self._ct, self._st = _cos_sin(graph, q, float(chain.theta[k]), q)
            r = zero_r
        self.arm: Vector = (graph.const(float(chain.d[k])), -(sine * r), cosine * r)

    def into(self, v: Vector) -> Vector:
        """A vector of frame k - 1 in frame k."""
        x, y, z = v[0], self._ca * v[1] + self._sa * v[2], self._ca * v[2] - self._sa * v[1]
        return self._ct * x + self._st * y, self._ct * y - self._st * x, z

    def out_of(self, v: Vector) -> Vector:
        """A vector of frame k in frame k - 1."""
        x, y, z = self._ct * v[0] - self._st * v[1], self._st * v[0] + self._ct * v[1], v[2]
        return x, self._ca * y - self._sa * z, self._sa * y + self._ca * z


def _cos_sin(
    graph: Graph, angle: Expression, theta: float, q: Expression | None
) -> tuple[Expression, Expression]:
    """cos and sin of q + theta; multiples of a right angle are exact and cost nothing."""
    quarters = theta / 1.5707963267948966
    nearest = round(quarters)
    if q is None:
        if abs(quarters - nearest) < 1e-12:
            values = ((1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0))[nearest % 4]
            return graph.const(values[0]), graph.const(values[1])
        return graph.call("cos", angle), graph.call("sin", angle)
    if abs(quarters - nearest) < 1e-12:
        c, s = graph.call("cos", q), graph.call("sin", q)
        return ((c, s), (-s, c), (-c, -s), (s, -c))[nearest % 4]
    total = q + graph.const(theta)
    return graph.call("cos", total), graph.call("sin", total)


def _spin(w: Vector, a: Vector) -> tuple[Vector, _Matrix]:
    """Products w2 w3, w1 w3, w1 w2 and the matrix U = [a]x + [w]x[w]x."""
    w11, w22, w33 = w[0] * w[0], w[1] * w[1], w[2] * w[2]
    w12, w13, w23 = w[0] * w[1], w[0] * w[2], w[1] * w[2]
    matrix: _Matrix = (
        (-(w22 + w33), w12 - a[2], w13 + a[1]),
        (w12 + a[2], -(w11 + w33), w23 - a[0]),
        (w13 - a[1], w23 + a[0], -(w11 + w22)),
    )
    return (w23, w13, w12), matrix


def _wrench(
    graph: Graph,
    model: StandardModel,
    k: int,
    alpha: Vector,
    acceleration: Vector,
    products: Vector,
    u: _Matrix,
) -> tuple[Vector, Vector]:
    """Force and moment about the origin of frame k for the motion of link k."""
    xx, xy, xz, yy, yz, zz, mx, my, mz, m = (float(value) for value in model.inertial[k])
    c = graph.const
    first: Vector = (c(mx), c(my), c(mz))
    mass = c(m)
    force = _add((mass * acceleration[0], mass * acceleration[1], mass * acceleration[2]), _times(u, first))
    w23, w13, w12 = products
    moment: Vector = (
        c(xx) * alpha[0] + c(zz - yy) * w23 - c(xy) * u[2][0] + c(xz) * u[1][0] + c(yz) * (u[1][1] - u[2][2]),
        c(yy) * alpha[1] + c(xx - zz) * w13 + c(xy) * u[2][1] - c(yz) * u[0][1] + c(xz) * (u[2][2] - u[0][0]),
        c(zz) * alpha[2] + c(yy - xx) * w12 - c(xz) * u[1][2] + c(yz) * u[0][2] + c(xy) * (u[0][0] - u[1][1]),
    )
    return force, _add(moment, cross(first, acceleration))


def _add(a: Vector, b: Vector) -> Vector:
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


def _times(matrix: _Matrix, v: Vector) -> Vector:
    x, y, z = (row[0] * v[0] + row[1] * v[1] + row[2] * v[2] for row in matrix)
    return x, y, z
