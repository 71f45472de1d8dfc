"""Effects of a model as expressions: numpy's functions, applied to symbols in place of samples.

An effect has one law, its columns. Where they follow from the present motion alone, they are worked out here on
expressions of q, qd and qdd. An effect with a memory (a hysteresis, a low-pass, a course over time) asks for more than
that, and no function of the present motion can have it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, cast

import numpy as np
from numpy.lib.mixins import NDArrayOperatorsMixin
from numpy.typing import ArrayLike, NDArray

from ident.effects import ArmMotion, in_force
from ident.formats.newton_euler import Expression, Graph, rigid_torque, speed_sign, torques
from ident.formats.standard import StandardModel

Torques = dict[str, list[Expression]]
"""Torque of every joint by side."""
Entry = Mapping[str, Any]

_LARGEST_PRODUCT = 4
"""Largest whole power written as a product."""


class NeedsMore(Exception):
    """The torque of an effect needs more than the present motion, or a function that the programs do not have."""


class Traced(NDArrayOperatorsMixin):
    """An array of expressions with numpy's arithmetic, of one sample. values : (1,) or (1, n)."""

    def __init__(self, graph: Graph, values: ArrayLike) -> None:
        self.graph = graph
        self.values: NDArray[np.object_] = np.asarray(values, dtype=object)

    @property
    def ndim(self) -> int:
        """Number of dimensions."""
        return self.values.ndim

    def __len__(self) -> int:
        return len(self.values)

    def __getitem__(self, key: Any) -> Traced:
        return Traced(self.graph, self.values[key])

    def __array_ufunc__(self, ufunc: np.ufunc, method: str, *inputs: Any, **more: Any) -> Traced:
        rule = _RULES.get(ufunc.__name__)
        if rule is None or method != "__call__" or more:
            raise NeedsMore(ufunc.__name__)
        parts = [part.values if isinstance(part, Traced) else part for part in inputs]
        return Traced(self.graph, np.frompyfunc(partial(rule, self.graph), len(parts), 1)(*parts))

    def __array__(self, *_: Any, **__: Any) -> NDArray[Any]:
        raise NeedsMore("an array of numbers")

    def clip(self, low: float, high: float, out: None = None) -> Traced:
        """Limited to both sides, for `numpy.clip`."""
        return cast(Traced, np.minimum(np.maximum(self, low), high))

    def expressions(self) -> list[Expression]:
        """The entries."""
        return [_expression(self.graph, value) for value in self.values.ravel()]


class TracedMotion:
    """The present motion as effects see it, of `ArmMotion` what does not depend on other times.

    model : with the bodies of its effects. q, qd, qdd : n expressions each. linear : torques of the linear model.
    """

    def __init__(
        self,
        graph: Graph,
        model: StandardModel,
        q: Sequence[Expression],
        qd: Sequence[Expression],
        qdd: Sequence[Expression],
        linear: Torques,
    ) -> None:
        self._graph, self._model = graph, model
        self._q, self._qd, self._qdd = q, qd, qdd
        self.chain, self.n, self.bodies, self.loaded = model.chain, model.chain.n, model.bodies, model.loaded
        self.q, self.qd, self.qdd = (self._row(values) for values in (q, qd, qdd))
        self.motor_speed, self.motor_acceleration = self.qd, self.qdd
        self.inertia, self.viscous = model.drive[:, 0], model.drive[:, 4]
        self.direction = self._row([speed_sign(graph, model, speed) for speed in qd])
        own = linear["joint"] if "joint" in model.sides else self._rigid(model.bodies, q, qd, qdd)
        self.joint_torque = self._row(own)
        self.motor_torque = self._row(linear["motor"] if "motor" in model.sides else own)

    def __getattr__(self, name: str) -> Any:
        raise NeedsMore(name)

    def motor_angle(self, joint: int, compliance: float) -> Traced:
        """Position of a motor, as of `ArmMotion`."""
        return self.q[:, joint] + compliance * self.joint_torque[:, joint]

    def torque_of(self, bodies: NDArray[np.float64]) -> Traced:
        """Rigid torque of other bodies (n, 10)."""
        return self._row(self._rigid(bodies, self._q, self._qd, self._qdd))

    def gravity_along(self, direction: NDArray[np.float64]) -> Traced:
        """Gravity torque in a field of 9.81 m/s^2 along `direction` (3,), in frame 0."""
        chain = replace(self.chain, gravity=9.81 * np.asarray(direction, dtype=np.float64))
        still = [self._graph.const(0.0)] * self.n
        return self._row(self._rigid(self.bodies, self._q, still, still, replace(self._model, chain=chain)))

    def displaced(self, joint: int, shift: Any, rate: Any, acceleration: Any) -> Traced:
        """Change of the rigid torque when a link is at q + shift."""
        q, qd, qdd = moved = [list(values) for values in (self._q, self._qd, self._qdd)]
        for values, change in zip(moved, (shift, rate, acceleration), strict=True):
            values[joint] = (
                values[joint] + Traced(self._graph, getattr(change, "values", change)).expressions()[0]
            )
        there = self._rigid(self.bodies, q, qd, qdd)
        here = self._rigid(self.bodies, self._q, self._qd, self._qdd)
        return self._row([a - b for a, b in zip(there, here, strict=True)])

    def _rigid(
        self,
        bodies: NDArray[np.float64],
        q: Sequence[Expression],
        qd: Sequence[Expression],
        qdd: Sequence[Expression],
        model: StandardModel | None = None,
    ) -> list[Expression]:
        return rigid_torque(self._graph, replace(model or self._model, inertial=bodies), q, qd, qdd)

    def _row(self, values: Sequence[Expression]) -> Traced:
        row = np.empty((1, len(values)), dtype=object)
        row[0] = values
        return Traced(self._graph, row)


def torques_with_effects(
    graph: Graph,
    model: StandardModel,
    q: Sequence[Expression],
    qd: Sequence[Expression],
    qdd: Sequence[Expression],
) -> tuple[Torques, list[Entry]]:
    """Torques of each side, as `newton_euler.torques`, with the effects of the model; and the effects left out.

    One that needs more than the present motion is left out.
    """
    total = torques(graph, model, q, qd, qdd)
    if not model.effects:
        return total, []
    motion = cast(ArmMotion, TracedMotion(graph, model, q, qd, qdd, dict(total)))
    missing = []
    for entry in model.effects:
        try:
            parts = _torque(graph, entry, motion)
        except NeedsMore:
            missing.append(entry)
            continue
        total = {side: [a + b for a, b in zip(total[side], parts[side], strict=True)] for side in total}
    return total, missing


def _torque(graph: Graph, entry: Entry, motion: ArmMotion) -> Torques:
    """Torque of an entry of a model's effects by side."""
    zero = graph.const(0.0)
    sums: Torques = {side: [zero] * motion.n for side in ("motor", "joint")}
    for effect, joint, values, form in in_force([entry]):
        for size, column in effect.weighted(motion, joint, values, form):
            for side, part in (("motor", column.motor), ("joint", column.joint)):
                if part is None:
                    continue
                # A constant column is an array of numbers.
                found = cast(Traced, size * Traced(graph, getattr(part, "values", part)))
                places = range(motion.n) if found.ndim == 2 else (joint,)
                for k, value in zip(places, found.expressions(), strict=True):
                    sums[side][k] = sums[side][k] + value
    difference = [a - b for a, b in zip(sums["motor"], sums["joint"], strict=True)]
    return {**sums, "difference": difference}


def _expression(graph: Graph, value: Any) -> Expression:
    return value if isinstance(value, Expression) else graph.const(float(value))


def _number(value: Any) -> float:
    """A number, for an operand that the programs need as one."""
    known = value.value if isinstance(value, Expression) else float(value)
    if known is None:
        raise NeedsMore("a power or a limit that changes")
    return known


def _power(graph: Graph, base: Any, exponent: Any) -> Expression:
    one, power = _expression(graph, base), _number(exponent)
    if not power.is_integer() or not 1.0 <= power <= _LARGEST_PRODUCT:
        return graph.call("power", one, power)
    product = one
    for _ in range(int(power) - 1):
        product = product * one
    return product


def _limit(kind: str) -> Callable[..., Expression]:
    def limited(graph: Graph, a: Any, b: Any) -> Expression:
        if isinstance(a, Expression) and a.value is None:
            return graph.call(kind, a, _number(b))
        return graph.call(kind, _expression(graph, b), _number(a))

    return limited


def _called(kind: str, *arguments: float) -> Callable[..., Expression]:
    return lambda graph, a: graph.call(kind, _expression(graph, a), *arguments)


_RULES: dict[str, Callable[..., Expression]] = {
    "add": lambda graph, a, b: _expression(graph, a) + _expression(graph, b),
    "subtract": lambda graph, a, b: _expression(graph, a) - _expression(graph, b),
    "multiply": lambda graph, a, b: _expression(graph, a) * _expression(graph, b),
    "divide": lambda graph, a, b: graph.const(1.0 / _number(b)) * _expression(graph, a),
    "negative": lambda graph, a: -_expression(graph, a),
    "power": _power,
    "maximum": _limit("max"),
    "minimum": _limit("min"),
    "absolute": _called("abs"),
    "sign": _called("sign"),
    "sin": _called("sin"),
    "cos": _called("cos"),
    "exp": _called("exp"),
    "tanh": _called("tanh", 1.0),
}
"""Expressions for numpy's functions by their names."""
