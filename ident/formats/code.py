"""Stand-alone inverse dynamics in C and in numpy, generated from the expressions of a model.

The program is independent of this project: C99 with <math.h>, or Python with numpy. It computes the torques of
the model to rounding, and lists its number of operations.
"""

from __future__ import annotations

import keyword
import re
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from fri.errors import ConfigurationError
from ident.effects import parameter_values
from ident.formats.newton_euler import FUNCTIONS, Expression, Graph, torques
from ident.formats.standard import StandardModel
from ident.formats.traced import torques_with_effects

_LONGEST_INLINE = 3


@dataclass(frozen=True, eq=False)
class Program:
    """The inverse dynamics of a model as a graph: outputs by name, and their operations.

    outputs : n expressions of "tau_joint", "tau_motor" (or "tau_difference") and "gravity" (joint side).
    missing : the effects of the model that are no function of the present motion.
    """

    model: StandardModel
    graph: Graph
    outputs: dict[str, list[Expression]]
    gravity: list[Expression]
    missing: list[Mapping[str, Any]]

    @classmethod
    def of(cls, model: StandardModel) -> Program:
        """The inverse dynamics of `model`."""
        graph, n = Graph(), model.chain.n
        q, qd, qdd = ([graph.input(name, k) for k in range(n)] for name in ("q", "qd", "qdd"))
        found, missing = torques_with_effects(graph, model, q, qd, qdd)
        rest = [graph.const(0.0)] * n
        gravity = torques(graph, model, q, rest, rest)["joint"]
        held = [
            expression - graph.const(float(model.drive[k, 3])) for k, expression in enumerate(gravity)
        ]  # without offl: the weight alone
        wanted = {f"tau_{side}": found[side] for side in model.sides}
        has_bodies = "joint" in model.sides or "motor" in model.sides
        return cls(model, graph, wanted, held if has_bodies else [], missing)

    @property
    def carried(self) -> tuple[Mapping[str, Any], ...]:
        """The effects that are part of the torques."""
        return tuple(entry for entry in self.model.effects if entry not in self.missing)

    @property
    def operations(self) -> dict[str, int]:
        """Number of multiplications, additions (subtractions) and function calls of the inverse dynamics."""
        flat = [expression for outputs in self.outputs.values() for expression in outputs]
        kinds = Counter(str(self.graph.nodes[index][0]) for index in self.graph.needed(flat))
        calls = sum(kinds[name] for name in FUNCTIONS)
        return {"multiplications": kinds["mul"], "additions": kinds["add"] + kinds["sub"], "functions": calls}


def to_c(model: StandardModel, name: str = "arm") -> str:
    """C99 source with `<name>_inverse_dynamics` and `<name>_gravity`.

    Raises ConfigurationError for an invalid name of a C function.
    """
    if not re.fullmatch(r"[A-Za-z_]\w*", name) or keyword.iskeyword(name):
        raise ConfigurationError(
            f"name {name!r} cannot begin a C function; use letters, digits and underscores"
        )
    program = Program.of(model)
    n = model.chain.n
    arguments = ", ".join(f"const double {item}[{n}]" for item in ("q", "qd", "qdd"))
    results = ", ".join(f"double {output}[{n}]" for output in program.outputs)
    lines = [
        f"void {name}_inverse_dynamics({arguments}, {results})",
        "{",
        *_body(program, program.outputs, _C),
        "}",
    ]
    if program.gravity:
        lines += [
            "",
            "/* Torque of the arm at rest, without friction and offsets. */",
            f"void {name}_gravity(const double q[{n}], double gravity[{n}])",
            "{",
            *_body(program, {"gravity": program.gravity}, _C),
            "}",
        ]
    body = "\n".join(lines)
    helpers = [text for call, text in _C_HELPERS.items() if f"{call}(" in body]
    head = [
        "/*",
        *(f" * {line}".rstrip() for line in _head(program)),
        " */",
        "#include <math.h>",
        *helpers,
        "",
        "",
    ]
    return "\n".join(head) + body + "\n"


def to_numpy(model: StandardModel) -> str:
    """Python source with `inverse_dynamics(q, qd, qdd)` and `gravity(q)` on arrays (..., n)."""
    program = Program.of(model)
    n = model.chain.n
    names = ", ".join(program.outputs)
    lines = [
        '"""' + _head(program)[0],
        "",
        *_head(program)[1:],
        '"""',
        "",
        "import numpy as np",
        "",
        f"JOINTS = {list(model.chain.joint_names)!r}",
        "",
        "",
        "def inverse_dynamics(q, qd, qdd):",
        f'    """{names} of q, qd, qdd, arrays of shape (..., {n})."""',
        "    q, qd, qdd = (np.moveaxis(np.asarray(x, dtype=float), -1, 0) for x in (q, qd, qdd))",
        *_body(program, program.outputs, _NUMPY),
        f"    return {', '.join(f'_stack({output}, q[0])' for output in program.outputs)}",
    ]
    if program.gravity:
        lines += [
            "",
            "",
            "def gravity(q):",
            f'    """Torque (..., {n}) of the arm at rest, without friction and offsets."""',
            "    q = np.moveaxis(np.asarray(q, dtype=float), -1, 0)",
            *_body(program, {"gravity": program.gravity}, _NUMPY),
            "    return _stack(gravity, q[0])",
        ]
    lines += [
        "",
        "",
        "def _stack(columns, like):",
        "    return np.stack([np.broadcast_to(column, like.shape) for column in columns], axis=-1)",
    ]
    return "\n".join(lines) + "\n"


@dataclass(frozen=True)
class _Language:
    assign: str
    calls: dict[str, str]
    array: bool


_C = _Language(
    "const double {name} = {value};",
    {
        "sin": "sin({0})",
        "cos": "cos({0})",
        "exp": "exp({0})",
        "abs": "fabs({0})",
        "sign": "sign_of({0})",
        "tanh": "tanh({0} / {1})",
        "deadband": "sign_beyond({0}, {1})",
        "power": "pow({0}, {1})",
        "max": "fmax({0}, {1})",
        "min": "fmin({0}, {1})",
    },
    False,
)
_C_HELPERS = {
    "sign_of": "\nstatic double sign_of(double x) { return (double)((x > 0.0) - (x < 0.0)); }",
    "sign_beyond": "\nstatic double sign_beyond(double x, double width)\n"
    "{ return (double)((x > width) - (x < -width)); }",
}
_NUMPY = _Language(
    "{name} = {value}",
    {
        "sin": "np.sin({0})",
        "cos": "np.cos({0})",
        "exp": "np.exp({0})",
        "abs": "np.abs({0})",
        "sign": "np.sign({0})",
        "tanh": "np.tanh({0} / {1})",
        "deadband": "np.sign({0}) * (np.abs({0}) > {1})",
        "power": "np.power({0}, {1})",
        "max": "np.maximum({0}, {1})",
        "min": "np.minimum({0}, {1})",
    },
    True,
)


def _body(program: Program, outputs: dict[str, list[Expression]], language: _Language) -> list[str]:
    """Statements for the outputs, each shared subexpression once."""
    graph = program.graph
    flat = [expression for expressions in outputs.values() for expression in expressions]
    needed = graph.needed(flat)
    uses = Counter(operand for index in needed for operand in graph.operands(index))
    uses.update(expression.index for expression in flat)
    text: dict[int, tuple[str, int, int]] = {}
    lines, number = [], 0
    for index in needed:
        value, strength, depth = _write(graph, index, text, language)
        named = graph.nodes[index][0] not in ("const", "input") and (
            uses[index] > 1 or depth > _LONGEST_INLINE
        )
        # A sign costs nothing, so it never gets a name.
        if named and graph.nodes[index][0] != "neg":
            name = f"t{number}"
            number += 1
            lines.append("    " + language.assign.format(name=name, value=value))
            text[index] = (name, 4, 0)
        else:
            text[index] = (value, strength, depth)
    if not language.array:
        read = {str(graph.nodes[index][1]) for index in needed if graph.nodes[index][0] == "input"}
        arguments = ("q", "qd", "qdd") if outputs is program.outputs else ("q",)
        lines += [f"    (void){name};" for name in arguments if name not in read]
    for output, expressions in outputs.items():
        values = [text[expression.index][0] for expression in expressions]
        if language.array:
            lines.append(f"    {output} = [{', '.join(values)}]")
        else:
            lines += [f"    {output}[{k}] = {value};" for k, value in enumerate(values)]
    return lines


def _write(
    graph: Graph, index: int, text: dict[int, tuple[str, int, int]], language: _Language
) -> tuple[str, int, int]:
    """Text of a node, how strongly it binds (1 sum, 2 product, 3 sign, 4 atom) and its depth."""
    kind, *rest = graph.nodes[index]
    if kind == "const":
        value = repr(float(rest[0]))
        return value, 4 if value[0] != "-" else 3, 0
    if kind == "input":
        return f"{rest[0]}[{rest[1]}]", 4, 0
    operands = [text[operand] for operand in graph.operands(index)]
    depth = 1 + max(operand[2] for operand in operands)
    if kind in language.calls:
        arguments = [operands[0][0], *(repr(float(value)) for value in rest[1:])]
        if kind == "tanh":
            arguments[0] = _bound(operands[0], 2)
        return language.calls[str(kind)].format(*arguments), 4, depth
    if kind == "neg":
        return f"-{_bound(operands[0], 3)}", 3, operands[0][2]
    symbol, strength = {"add": (" + ", 1), "sub": (" - ", 1), "mul": (" * ", 2)}[str(kind)]
    left = _bound(operands[0], strength)
    right = _bound(operands[1], strength + (kind != "add") if kind != "mul" else 3)
    if right.startswith("-"):
        right = f"({right})"
    return f"{left}{symbol}{right}", strength, depth


def _bound(operand: tuple[str, int, int], strength: int) -> str:
    return operand[0] if operand[1] >= strength else f"({operand[0]})"


def _head(program: Program) -> list[str]:
    count = program.operations
    model = program.model
    lines = [
        f"Inverse dynamics of {model.title or 'a serial arm'}.",
        "Generated code: change the model, not this file.",
        f"Joints, base to tip: {' '.join(model.chain.joint_names)}. SI units: rad, rad/s, rad/s^2, Nm.",
        *(f"{output}: {_meaning(model, output)}" for output in program.outputs),
        f"{count['multiplications']} multiplications, {count['additions']} additions, "
        f"{count['functions']} functions.",
        f"Coulomb friction: {_COULOMB[model.coulomb_kind].format(model.coulomb_width)}.",
        *model.notes,
        *_effects(program),
    ]
    return [_comment(line) for line in lines]


def _effects(program: Program) -> list[str]:
    """Lines on the effects of the model in the program, and on those that are not."""
    held = list(dict.fromkeys(str(entry["cause"]) for entry in program.carried))
    part = [f"With the model's effects: {', '.join(held)}."] if held else []
    return [*part, *program.model.without(program.missing), *sensor_errors(program.model)]


def _meaning(model: StandardModel, output: str) -> str:
    if output == "tau_joint" and model.sensors:
        return "torque behind the gear, without the errors of the sensors that the model has."
    return _MEANING[output]


def sensor_errors(model: StandardModel, file: str = "this file") -> tuple[str, ...]:
    """Note on the errors of the sensors, which are part of no torque of a program; none without any."""
    if not model.sensors:
        return ()
    named = []
    for entry in model.sensors:
        joints = ", ".join(model.chain.joint_names[int(joint) - 1] for joint in entry["joints"])
        values = ", ".join(f"{name} {value:.4g}" for name, value in parameter_values(entry).items())
        named.append(f"{entry['cause']} ({': '.join(filter(None, (joints, values)))})")
    return (
        f"Torques in {file} are the true ones; a sensor shows them with its error: {'; '.join(named)}. "
        "Python's `model.torque(..., measured=True)` has these errors.",
    )


def _comment(text: str) -> str:
    """One line without the ends of a C comment or a Python docstring."""
    return " ".join(text.split()).replace("*/", "* /").replace("\\", "/").replace('"""', "'")


_COULOMB = {
    "sign": "sign of the speed",
    "deadband": "sign of the speed, zero up to {0:g} rad/s",
    "tanh": "tanh(speed / {0:g} rad/s) for the sign of the speed",
}


_MEANING = {
    "tau_joint": "torque behind the gear, as the joint torque sensor measures it.",
    "tau_motor": "motor torque referred to the joint side.",
    "tau_difference": "motor torque minus joint torque.",
}
