"""The tree of a KRL program: expressions, statements, declarations, subprograms, modules."""

from __future__ import annotations

from dataclasses import dataclass, field


@dataclass(frozen=True)
class Constant:
    """A number, truth value, text, or enumeration value (`#CMD`, kept with its mark)."""

    value: float | int | bool | str


@dataclass(frozen=True)
class Name:
    """A variable, in capitals: `LWR_PHASE`, `$FRI_TO_INT[3]`, `$LOAD.CM.X`, `TOOL_DATA[2].X`.

    name : up to the first index, fields included. index : the first one. rest : further fields and indices
    """

    name: str
    index: Expression | None = None
    rest: tuple[str | Expression, ...] = ()


@dataclass(frozen=True)
class Aggregate:
    """`{A1 0, A2 90}`: fields in capitals with their values; `kind` of `{MSG_T: ...}` is left out."""

    items: tuple[tuple[str, Expression], ...]


@dataclass(frozen=True)
class Unary:
    """NOT, B_NOT or a minus."""

    operator: str
    operand: Expression


@dataclass(frozen=True)
class Binary:
    """Two operands and their operator."""

    operator: str
    left: Expression
    right: Expression


@dataclass(frozen=True)
class Call:
    """A function or subprogram by its name in capitals, and its line."""

    name: str
    arguments: tuple[Expression, ...]
    line: int = 0


Expression = Constant | Name | Aggregate | Unary | Binary | Call


@dataclass(frozen=True)
class Assign:
    """`target = value`."""

    target: Name
    value: Expression
    line: int


@dataclass(frozen=True)
class Branch:
    """IF."""

    condition: Expression
    then: tuple[Statement, ...]
    otherwise: tuple[Statement, ...]
    line: int


@dataclass(frozen=True)
class Switch:
    """SWITCH: (values, block) in order, then DEFAULT."""

    subject: Expression
    cases: tuple[tuple[tuple[Expression, ...], tuple[Statement, ...]], ...]
    default: tuple[Statement, ...]
    line: int


@dataclass(frozen=True)
class Loop:
    """LOOP, or WHILE with a condition."""

    body: tuple[Statement, ...]
    condition: Expression | None
    line: int


@dataclass(frozen=True)
class Repeat:
    """REPEAT ... UNTIL condition."""

    body: tuple[Statement, ...]
    condition: Expression
    line: int


@dataclass(frozen=True)
class For:
    """FOR variable = first TO last STEP step."""

    variable: Name
    first: Expression
    last: Expression
    body: tuple[Statement, ...]
    line: int
    step: Expression = Constant(1)


@dataclass(frozen=True)
class WaitFor:
    """WAIT FOR condition."""

    condition: Expression
    line: int


@dataclass(frozen=True)
class WaitSeconds:
    """WAIT SEC time [s]."""

    seconds: Expression
    line: int


@dataclass(frozen=True)
class Move:
    """A motion to a goal: `PTP`, or with `relative` PTP_REL."""

    goal: Expression
    line: int
    relative: bool = False


@dataclass(frozen=True)
class Halt:
    """HALT: waits for the start key."""

    line: int


@dataclass(frozen=True)
class Leave:
    """EXIT (a loop) or RETURN (a subprogram, with the value of a function)."""

    what: str
    line: int
    value: Expression | None = None


@dataclass(frozen=True)
class Ignored:
    """A statement without effect here, such as INTERRUPT or LIN; its text is told once."""

    text: str
    line: int


Statement = (
    Assign
    | Branch
    | Switch
    | Loop
    | Repeat
    | For
    | WaitFor
    | WaitSeconds
    | Move
    | Halt
    | Leave
    | Ignored
    | Call
)


@dataclass(frozen=True)
class Declaration:
    """A variable with its type and first value; `size` for an array, 0 for a plain one."""

    name: str
    kind: str
    size: int
    value: Constant | Aggregate | None
    line: int


@dataclass(frozen=True)
class Subprogram:
    """DEF or DEFFCT: its parameters (name, whether by value), its own variables, its statements."""

    name: str
    body: tuple[Statement, ...]
    parameters: tuple[tuple[str, bool], ...] = ()
    declarations: dict[str, Declaration] = field(default_factory=dict)
    function: bool = False


@dataclass(frozen=True)
class Source:
    """A module: its subprograms by name (the first is the main program), the variables of its data list, and
    the first values of array elements there; `external` subprograms come from other modules.
    """

    main: str
    subprograms: dict[str, Subprogram]
    declarations: dict[str, Declaration] = field(default_factory=dict)
    elements: tuple[Assign, ...] = ()
    external: frozenset[str] = frozenset()
