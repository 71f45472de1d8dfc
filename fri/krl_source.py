"""KRL source text as a tree, for the part of the language used beside FRI.

Assignments, IF, SWITCH, LOOP, WHILE, FOR, EXIT, RETURN, WAIT FOR, WAIT SEC, PTP, calls, DEF without
parameters; INT, REAL, BOOL, CHAR and enumeration variables, declared in the program or in its data list.
Anything else is an error with its line, so a program without errors has no typing mistake.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, field, replace

from fri.errors import ConfigurationError


@dataclass(frozen=True)
class Constant:
    """A number, truth value, text, or enumeration value (`#CMD`, kept with its mark)."""

    value: float | int | bool | str


@dataclass(frozen=True)
class Name:
    """A variable, in capitals: `LWR_PHASE`, `$FRI_TO_INT[3]`, `$LOAD.CM.X`."""

    name: str
    index: Expression | None = None


@dataclass(frozen=True)
class Unary:
    """NOT or a minus."""

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


Expression = Constant | Name | Unary | Binary | Call


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
class For:
    """FOR variable = first TO last."""

    variable: Name
    first: Expression
    last: Expression
    body: tuple[Statement, ...]
    line: int


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
    """PTP to a position of the system."""

    goal: Name
    line: int


@dataclass(frozen=True)
class Leave:
    """EXIT (a loop) or RETURN (a subprogram)."""

    what: str
    line: int


Statement = Assign | Branch | Switch | Loop | For | WaitFor | WaitSeconds | Move | Leave | Call


@dataclass(frozen=True)
class Declaration:
    """A variable with its type and first value; `size` for an array, 0 for a plain one."""

    name: str
    kind: str
    size: int
    value: Constant | None
    line: int


@dataclass(frozen=True)
class Source:
    """A module: its subprograms by name (the first is the main program) and its variables."""

    main: str
    subprograms: dict[str, tuple[Statement, ...]]
    declarations: dict[str, Declaration] = field(default_factory=dict)


_TOKEN = re.compile(
    r"""\s*(?:(?P<number>\d+\.\d*(?:[Ee][+-]?\d+)?|\d+)
    |(?P<text>"[^"]*")
    |(?P<enum>\#\w+)
    |(?P<name>\$?[A-Za-z_][\w$]*(?:\.[A-Za-z_]\w*)*)
    |(?P<mark><>|<=|>=|==|[-+*/()\[\],:=<>]))""",
    re.VERBOSE,
)
_DECLARED = re.compile(r"(?:DECL\s+)?(INT|REAL|BOOL|CHAR|FRISTATE|LOAD)\s+(.+)", re.IGNORECASE)
_BLOCK_ENDS = {"ENDIF", "ELSE", "ENDLOOP", "ENDWHILE", "ENDFOR", "ENDSWITCH", "CASE", "DEFAULT", "END"}
_KEYWORDS = _BLOCK_ENDS | {"AND", "OR", "NOT", "TRUE", "FALSE", "THEN", "TO", "IF", "LOOP", "WHILE", "FOR"}


def parse_source(text: str, data: str = "", name: str = "KRL program") -> Source:
    """The tree of a module from its `.src` and `.dat` texts. Raises ConfigurationError with the line."""
    declarations: dict[str, Declaration] = {}
    for number, line in _lines(data):
        if re.match(r"(DEFDAT|ENDDAT)\b", line, re.IGNORECASE):
            continue
        found = _declare(line, number, f"data list of {name}")
        if found is None:
            found = _filled(line, number, f"data list of {name}", declarations)
        if found is None:
            raise ConfigurationError(f"data list of {name}, line {number}: {line!r} declares nothing")
        declarations.update(found)
    reader = _Reader(list(_lines(text)), name, declarations)
    subprograms: dict[str, tuple[Statement, ...]] = {}
    while reader.more:
        title, block = reader.subprogram()
        subprograms[title] = block
    if not subprograms:
        raise ConfigurationError(f"{name}: holds no DEF")
    return Source(next(iter(subprograms)), subprograms, declarations)


def _lines(text: str) -> Iterator[tuple[int, str]]:
    """Lines with content and their numbers, without comments, fold marks and file attributes."""
    for number, line in enumerate(text.splitlines(), 1):
        content = line.split(";", 1)[0].strip()
        if content and not content.startswith("&"):
            yield number, content


def _declare(line: str, number: int, name: str) -> dict[str, Declaration] | None:
    """Variables declared in a line; None for any other line."""
    match = _DECLARED.fullmatch(line)
    if match is None:
        return None
    kind = match[1].upper()
    found = {}
    for item in match[2].split(","):
        part = re.fullmatch(r"\s*([A-Za-z_]\w*)\s*(?:\[\s*(\d*)\s*\])?\s*(?:=\s*(.+?))?\s*", item)
        if part is None:
            raise ConfigurationError(f"{name}, line {number}: {item.strip()!r} is no declaration")
        value = None
        if part[3] is not None:
            first = _Line(part[3], number, name).whole_expression()
            if isinstance(first, Unary) and isinstance(first.operand, Constant):
                first = Constant(-float(first.operand.value))
            if not isinstance(first, Constant):
                raise ConfigurationError(f"{name}, line {number}: {part[3]!r} is no constant")
            value = first
        title = part[1].upper()
        found[title] = Declaration(title, kind, int(part[2] or 0), value, number)
    return found


def _filled(
    line: str, number: int, name: str, declarations: dict[str, Declaration]
) -> dict[str, Declaration] | None:
    """A text of the data list with its content, from a line `HOST[]="..."`; None for any other line."""
    match = re.fullmatch(r'([A-Za-z_]\w*)\s*\[\s*\]\s*=\s*"([^"]*)"', line)
    if match is None or match[1].upper() not in declarations:
        return None
    known = declarations[match[1].upper()]
    if known.kind != "CHAR" or len(match[2]) > known.size:
        raise ConfigurationError(f"{name}, line {number}: the text does not fit into {known.name}")
    return {known.name: replace(known, value=Constant(match[2]))}


class _Line:
    """The tokens of one line, read from left to right."""

    def __init__(self, text: str, number: int, name: str) -> None:
        self.text, self.number, self._name = text, number, name
        self._tokens: list[tuple[str, str]] = []
        place = 0
        while place < len(text.rstrip()):
            match = _TOKEN.match(text, place)
            if match is None:
                raise self.error(f"{text[place:]!r} is not understood")
            kind = match.lastgroup
            assert kind is not None
            self._tokens.append((kind, match[kind] if kind == "text" else match[kind].upper()))
            place = match.end()
        self._at = 0

    def error(self, text: str) -> ConfigurationError:
        return ConfigurationError(f"{self._name}, line {self.number}: {text}")

    @property
    def peek(self) -> str:
        return self._tokens[self._at][1] if self._at < len(self._tokens) else ""

    def take(self, wanted: str | None = None) -> tuple[str, str]:
        if self._at >= len(self._tokens):
            raise self.error(f"the line ends where {wanted or 'something'} is expected")
        token = self._tokens[self._at]
        if wanted is not None and token[1] != wanted:
            raise self.error(f"found {token[1]!r} where {wanted!r} is expected")
        self._at += 1
        return token

    def skip(self, wanted: str) -> bool:
        if self.peek == wanted:
            self._at += 1
            return True
        return False

    def end(self) -> None:
        if self.peek:
            raise self.error(f"{self.peek!r} is too much")

    def whole_expression(self) -> Expression:
        found = self.expression()
        self.end()
        return found

    def expression(self) -> Expression:
        left = self._conjunction()
        while self.skip("OR"):
            left = Binary("OR", left, self._conjunction())
        return left

    def _conjunction(self) -> Expression:
        left = self._comparison()
        while self.skip("AND"):
            left = Binary("AND", left, self._comparison())
        return left

    def _comparison(self) -> Expression:
        if self.skip("NOT"):
            return Unary("NOT", self._comparison())
        left = self._sum()
        if self.peek in ("==", "<>", "<", ">", "<=", ">="):
            return Binary(self.take()[1], left, self._sum())
        return left

    def _sum(self) -> Expression:
        left = self._product()
        while self.peek in ("+", "-"):
            left = Binary(self.take()[1], left, self._product())
        return left

    def _product(self) -> Expression:
        left = self._factor()
        while self.peek in ("*", "/"):
            left = Binary(self.take()[1], left, self._factor())
        return left

    def _factor(self) -> Expression:
        kind, text = self.take()
        if text == "-":
            return Unary("-", self._factor())
        if text == "(":
            inner = self.expression()
            self.take(")")
            return inner
        if kind == "number":
            return Constant(float(text) if "." in text else int(text))
        if kind == "text":
            return Constant(text[1:-1])
        if kind == "enum" or text in ("TRUE", "FALSE"):
            return Constant(text if kind == "enum" else text == "TRUE")
        if kind != "name" or text in _KEYWORDS:
            raise self.error(f"{text!r} is no value")
        return self._call(text) if self.peek == "(" else self.variable(text)

    def variable(self, text: str) -> Name:
        if not self.skip("["):
            return Name(text)
        # `HOST[]` is the whole text.
        index = None if self.peek == "]" else self.expression()
        self.take("]")
        return Name(text, index)

    def _call(self, text: str) -> Call:
        self.take("(")
        arguments: list[Expression] = []
        while self.peek != ")":
            arguments.append(self.expression())
            if not self.skip(","):
                break
        self.take(")")
        return Call(text, tuple(arguments), self.number)


class _Reader:
    """The lines of a module, block by block."""

    def __init__(self, lines: list[tuple[int, str]], name: str, declarations: dict[str, Declaration]) -> None:
        self._lines, self._name, self._declarations = lines, name, declarations
        self._at = 0

    @property
    def more(self) -> bool:
        return self._at < len(self._lines)

    def subprogram(self) -> tuple[str, tuple[Statement, ...]]:
        line = self._next()
        line.take("DEF")
        title = line.take()[1]
        line.take("(")
        line.take(")")
        line.end()
        while self.more:
            number, text = self._lines[self._at]
            found = _declare(text, number, self._name)
            if found is None:
                break
            self._declarations.update(found)
            self._at += 1
        block = self._block("END")
        self._next()
        return title, block

    def _next(self) -> _Line:
        if not self.more:
            raise ConfigurationError(f"{self._name}: the text ends within a block")
        number, text = self._lines[self._at]
        self._at += 1
        return _Line(text, number, self._name)

    def _keyword(self) -> str:
        if not self.more:
            raise ConfigurationError(f"{self._name}: the text ends within a block")
        return self._lines[self._at][1].split()[0].split("(")[0].upper()

    def _block(self, *ends: str) -> tuple[Statement, ...]:
        """Statements up to one of `ends`; this line remains."""
        found: list[Statement] = []
        while (word := self._keyword()) not in ends:
            if word in _BLOCK_ENDS:
                line = self._next()
                raise line.error(f"{word} closes nothing; {' or '.join(ends)} is expected")
            found.append(self._statement())
        return tuple(found)

    def _statement(self) -> Statement:
        line = self._next()
        kind, word = line.take()
        if word == "IF":
            condition = line.expression()
            line.take("THEN")
            line.end()
            then = self._block("ELSE", "ENDIF")
            otherwise: tuple[Statement, ...] = ()
            if self._next().peek == "ELSE":
                otherwise = self._block("ENDIF")
                self._next()
            return Branch(condition, then, otherwise, line.number)
        if word == "SWITCH":
            return self._switch(line)
        if word in ("LOOP", "WHILE"):
            test = line.expression() if word == "WHILE" else None
            line.end()
            body = self._block(f"END{word}")
            self._next()
            return Loop(body, test, line.number)
        if word == "FOR":
            variable = line.variable(line.take()[1])
            line.take("=")
            first = line.expression()
            line.take("TO")
            last = line.whole_expression()
            body = self._block("ENDFOR")
            self._next()
            return For(variable, first, last, body, line.number)
        if word == "WAIT":
            what = line.take()[1]
            if what not in ("FOR", "SEC"):
                raise line.error("WAIT takes FOR or SEC")
            value = line.whole_expression()
            return WaitFor(value, line.number) if what == "FOR" else WaitSeconds(value, line.number)
        if word == "PTP":
            goal = line.variable(line.take()[1])
            line.end()
            return Move(goal, line.number)
        if word in ("EXIT", "RETURN"):
            line.end()
            return Leave(word, line.number)
        if kind != "name":
            raise line.error(f"{line.text!r} is no statement")
        if line.peek == "(":
            call = line._call(word)
            line.end()
            return call
        target = line.variable(word)
        line.take("=")
        return Assign(target, line.whole_expression(), line.number)

    def _switch(self, line: _Line) -> Switch:
        subject = line.whole_expression()
        cases: list[tuple[tuple[Expression, ...], tuple[Statement, ...]]] = []
        default: tuple[Statement, ...] = ()
        while True:
            head = self._next()
            word = head.take()[1]
            if word == "ENDSWITCH":
                return Switch(subject, tuple(cases), default, line.number)
            if word == "DEFAULT":
                default = self._block("ENDSWITCH")
            elif word == "CASE":
                values = [head.expression()]
                while head.skip(","):
                    values.append(head.expression())
                head.end()
                cases.append((tuple(values), self._block("CASE", "DEFAULT", "ENDSWITCH")))
            else:
                raise head.error(f"{word} within SWITCH; CASE, DEFAULT or ENDSWITCH is expected")
