"""KRL source text as a tree (`fri.krl_tree`), for the language of programs beside FRI.

Read are DEF and DEFFCT with parameters, data lists, declarations of any type, EXT, structures in braces, IF, SWITCH,
LOOP, WHILE, REPEAT, FOR, WAIT FOR, WAIT SEC, PTP, HALT, calls and assignments. Interrupts, Cartesian motions and
switching actions become `Ignored`. Anything else is an error with its line.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import replace

from fri.errors import ConfigurationError
from fri.krl_tree import (
    Aggregate,
    Assign,
    Binary,
    Branch,
    Call,
    Constant,
    Declaration,
    Expression,
    For,
    Halt,
    Ignored,
    Leave,
    Loop,
    Move,
    Name,
    Repeat,
    Source,
    Statement,
    Subprogram,
    Switch,
    Unary,
    WaitFor,
    WaitSeconds,
)

_TOKEN = re.compile(
    r"""\s*(?:(?P<number>\d+\.\d*(?:[Ee][+-]?\d+)?|\.\d+(?:[Ee][+-]?\d+)?|\d+[Ee][+-]?\d+|\d+)
    |(?P<code>'[HhBb][0-9A-Fa-f]+')
    |(?P<text>"[^"]*")
    |(?P<enum>\#\w+)
    |(?P<name>\$?[A-Za-z_][\w$]*(?:\.[A-Za-z_]\w*)*)
    |(?P<field>\.[A-Za-z_]\w*)
    |(?P<mark><>|<=|>=|==|[-+*/()\[\]{},:=<>]))""",
    re.VERBOSE,
)
_BLOCK_ENDS = {
    "ENDIF", "ELSE", "ENDLOOP", "ENDWHILE", "ENDFOR", "UNTIL", "ENDSWITCH", "CASE", "DEFAULT", "END", "ENDFCT",
}  # fmt: skip
_IGNORED = {
    "INTERRUPT", "TRIGGER", "BRAKE", "RESUME", "ANOUT", "ANIN", "DIGIN", "PULSE", "CONTINUE", "LIN", "LIN_REL",
    "CIRC", "CIRC_REL", "SLIN", "SPTP", "SCIRC", "SPLINE", "SIGNAL", "IMPORT", "STRUC", "ENUM",
}  # fmt: skip
_STATEMENTS = {
    "IF", "SWITCH", "LOOP", "WHILE", "REPEAT", "FOR", "WAIT", "PTP", "PTP_REL", "HALT", "EXIT", "RETURN", "GOTO",
    "DEF", "DEFFCT", "EXT", "EXTFCT", "DEFDAT", "ENDDAT",
}  # fmt: skip
_OPERATORS = {"AND", "OR", "EXOR", "NOT", "B_AND", "B_OR", "B_EXOR", "B_NOT"}
_KEYWORDS = _BLOCK_ENDS | _STATEMENTS | _IGNORED | _OPERATORS | {"TRUE", "FALSE", "THEN", "TO", "STEP"}


def parse_source(text: str, data: str = "", name: str = "KRL program") -> Source:
    """The tree of a module from its `.src` and `.dat` texts. Raises ConfigurationError with the line."""
    list_name = f"data list of {name}"
    declarations: dict[str, Declaration] = {}
    elements: list[Assign] = []
    external: set[str] = set()
    for number, line in _lines(data):
        _data_line(_Line(line, number, list_name), declarations, elements, external)
    reader = _Reader(list(_lines(text)), name, external)
    subprograms: dict[str, Subprogram] = {}
    while reader.more:
        found = reader.subprogram()
        if found.name in subprograms:
            raise ConfigurationError(f"{name}: holds {found.name} twice")
        subprograms[found.name] = found
    if not subprograms:
        raise ConfigurationError(f"{name}: holds no DEF")
    return Source(
        next(iter(subprograms)),
        subprograms,
        declarations,
        tuple(elements),
        frozenset(external - set(subprograms)),
    )


def _lines(text: str) -> Iterator[tuple[int, str]]:
    """Lines with content and their numbers, without comments, fold marks and file attributes."""
    for number, line in enumerate(text.splitlines(), 1):
        quoted = line.split('"')
        for place in range(0, len(quoted), 2):
            before, mark, _ = quoted[place].partition(";")
            if mark:
                quoted = [*quoted[:place], before]
                break
        content = '"'.join(quoted).strip()
        if content and not content.startswith("&"):
            yield number, content


def _data_line(
    line: _Line, declarations: dict[str, Declaration], elements: list[Assign], external: set[str]
) -> None:
    """One line of a data list."""
    words = [text for _, text in line.tokens[:2]]
    word = words[-1] if words[0] == "GLOBAL" else words[0]
    if word in ("DEFDAT", "ENDDAT", "IMPORT", "STRUC", "ENUM"):
        return
    if word in ("EXT", "EXTFCT", "EXTP", "EXTFCTP"):
        external.add(_external(line))
        return
    found = _declare(line)
    if found is not None:
        declarations.update(found)
        return
    kind, title = line.take()
    known = declarations.get(title)
    if kind != "name" or known is None:
        raise line.error(f"{line.text!r} declares nothing")
    target = line.variable(title)
    line.take("=")
    value = line.whole_expression()
    if target.index is not None or target.rest:
        elements.append(Assign(target, value, line.number))
        return
    if known.kind == "CHAR" and isinstance(value, Constant) and isinstance(value.value, str):
        if known.size and len(value.value) > known.size:
            raise line.error(f"the text does not fit into {known.name}")
    elif "[]" in line.text or not isinstance(value, (Constant, Aggregate)):
        raise line.error(f"the text does not fit into {known.name}")
    declarations[title] = replace(known, value=value)


def _external(line: _Line) -> str:
    """Name of the subprogram of an EXT line."""
    words = [text for kind, text in line.tokens if kind == "name"]
    if "(" not in line.text or len(words) < 2:
        raise line.error(f"{line.text!r} names no subprogram")
    before = [text for kind, text in line.tokens[: [t for _, t in line.tokens].index("(")] if kind == "name"]
    return before[-1]


def _declare(line: _Line) -> dict[str, Declaration] | None:
    """Variables declared in a line; None for any other line."""
    tokens, at = line.tokens, 0
    words = [text for _, text in tokens]
    if "SIGNAL" in words[:2] and tokens[words.index("SIGNAL") + 1 :][:1]:
        # An input or output, or the number in several: a variable that nothing is wired to.
        title = words[words.index("SIGNAL") + 1]
        return {title: Declaration(title, "INT" if "TO" in words else "BOOL", 0, None, line.number)}
    while at < len(tokens) and tokens[at][1] in ("DECL", "GLOBAL", "CONST"):
        at += 1
    plain = at == 0 or tokens[at - 1][1] == "GLOBAL"
    kinds = [kind for kind, _ in tokens[at : at + 2]]
    if kinds != ["name", "name"] or tokens[at][1] in _KEYWORDS or tokens[at + 1][1] in _KEYWORDS:
        if plain:
            return None
        raise line.error(f"{line.text!r} is no declaration")
    line.at = at
    kind = line.take()[1]
    found = {}
    while True:
        word, title = line.take()
        if word != "name":
            raise line.error(f"{title!r} is no declaration")
        size = 0
        if line.skip("["):
            sizes = []
            while line.peek != "]":
                sizes.append(line.expression())
                if not line.skip(","):
                    break
            line.take("]")
            whole = [one.value for one in sizes if isinstance(one, Constant) and isinstance(one.value, int)]
            if len(whole) != len(sizes):
                raise line.error(f"the size of {title} is no whole number")
            size = 1
            for one in whole:
                size *= one
            size = size if whole else 0
        value: Expression | None = None
        if line.skip("="):
            value = line.expression()
            if isinstance(value, Unary) and isinstance(value.operand, Constant):
                value = Constant(-float(value.operand.value))
            if not isinstance(value, (Constant, Aggregate)):
                raise line.error(f"{line.text!r}: the value of {title} is no constant")
        first = value if isinstance(value, (Constant, Aggregate)) else None
        found[title] = Declaration(title, kind, size, first, line.number)
        if not line.skip(","):
            break
    line.end()
    return found


class _Line:
    """The tokens of one line, read from left to right."""

    def __init__(self, text: str, number: int, name: str) -> None:
        self.text, self.number, self._name = text, number, name
        self.tokens: list[tuple[str, str]] = []
        place = 0
        while place < len(text.rstrip()):
            match = _TOKEN.match(text, place)
            if match is None:
                raise self.error(f"{text[place:]!r} is not understood")
            kind = match.lastgroup
            assert kind is not None
            self.tokens.append((kind, match[kind] if kind == "text" else match[kind].upper()))
            place = match.end()
        self.at = 0

    def error(self, text: str) -> ConfigurationError:
        return ConfigurationError(f"{self._name}, line {self.number}: {text}")

    @property
    def peek(self) -> str:
        return self.tokens[self.at][1] if self.at < len(self.tokens) else ""

    def take(self, wanted: str | None = None) -> tuple[str, str]:
        if self.at >= len(self.tokens):
            raise self.error(f"the line ends where {wanted or 'something'} is expected")
        token = self.tokens[self.at]
        if wanted is not None and token[1] != wanted:
            raise self.error(f"found {token[1]!r} where {wanted!r} is expected")
        self.at += 1
        return token

    def skip(self, wanted: str) -> bool:
        if self.peek == wanted:
            self.at += 1
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
        while self.peek in ("OR", "EXOR", "B_OR", "B_EXOR"):
            left = Binary(self.take()[1], left, self._conjunction())
        return left

    def _conjunction(self) -> Expression:
        left = self._comparison()
        while self.peek in ("AND", "B_AND"):
            left = Binary(self.take()[1], left, self._comparison())
        return left

    def _comparison(self) -> Expression:
        if self.peek in ("NOT", "B_NOT"):
            return Unary(self.take()[1], self._comparison())
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
        if self.peek == ":":
            raise self.error("the geometric operator `:` is not run by the emulated controller")
        return left

    def _factor(self) -> Expression:
        kind, text = self.take()
        if text == "-":
            return Unary("-", self._factor())
        if text == "+":
            return self._factor()
        if text == "(":
            inner = self.expression()
            self.take(")")
            return inner
        if text == "{":
            return self._aggregate()
        if kind == "number":
            return Constant(int(text) if text.isdigit() else float(text))
        if kind == "code":
            return Constant(int(text[2:-1], 16 if text[1] == "H" else 2))
        if kind == "text":
            return Constant(text[1:-1])
        if kind == "enum" or text in ("TRUE", "FALSE"):
            return Constant(text if kind == "enum" else text == "TRUE")
        if kind != "name" or text in _KEYWORDS:
            raise self.error(f"{text!r} is no value")
        return self.call(text) if self.peek == "(" else self.variable(text)

    def _aggregate(self) -> Aggregate:
        """The rest of `{KIND: FIELD value, FIELD[] "text"}`."""
        if self.at + 1 < len(self.tokens) and self.tokens[self.at + 1][1] == ":":
            self.at += 2
        items: list[tuple[str, Expression]] = []
        while self.peek != "}":
            kind, title = self.take()
            if kind != "name":
                raise self.error(f"{title!r} is no field")
            if self.skip("["):
                if self.peek != "]":
                    title = f"{title}[{self.take()[1]}]"
                self.take("]")
            items.append((title, self.expression()))
            if not self.skip(","):
                break
        self.take("}")
        return Aggregate(tuple(items))

    def variable(self, text: str) -> Name:
        """A variable from its name on, with indices and fields; `HOST[]` is the whole text."""
        steps: list[str | Expression] = []
        while True:
            if self.skip("["):
                while self.peek != "]":
                    steps.append(self.expression())
                    if not self.skip(","):
                        break
                self.take("]")
            elif self.at < len(self.tokens) and self.tokens[self.at][0] == "field":
                steps.append(self.take()[1])
            else:
                break
        if not steps:
            return Name(text)
        first, *rest = steps
        if isinstance(first, str):
            return Name(text, None, tuple(steps))
        return Name(text, first, tuple(rest))

    def call(self, text: str) -> Call:
        """A call from its opening bracket on; an argument left out is left out."""
        self.take("(")
        arguments: list[Expression] = []
        while self.peek != ")":
            if self.skip(","):
                continue
            arguments.append(self.expression())
            if self.peek not in (",", ")"):
                break
        self.take(")")
        return Call(text, tuple(arguments), self.number)


class _Reader:
    """The lines of a module, block by block."""

    def __init__(self, lines: list[tuple[int, str]], name: str, external: set[str]) -> None:
        self._lines, self._name, self._external = lines, name, external
        self._at = 0
        self._declared: dict[str, Declaration] = {}

    @property
    def more(self) -> bool:
        return self._at < len(self._lines)

    def subprogram(self) -> Subprogram:
        line = self._next()
        line.skip("GLOBAL")
        function = line.skip("DEFFCT")
        if function:
            line.take()
            if line.skip("["):
                line.take("]")
        else:
            line.take("DEF")
        title = line.take()[1]
        parameters = self._parameters(line)
        self._declared = {}
        closing = "ENDFCT" if function else "END"
        block = self._block(closing)
        self._next()
        return Subprogram(title, block, parameters, self._declared, function)

    @staticmethod
    def _parameters(line: _Line) -> tuple[tuple[str, bool], ...]:
        """`(a:IN, b[]:OUT)`: names, and whether by value; without a mark by reference."""
        found = []
        line.take("(")
        while line.peek != ")":
            title, by_value = line.take()[1], False
            if line.skip("["):
                while not line.skip("]"):
                    line.take()
            if line.skip(":"):
                by_value = line.take()[1] == "IN"
            found.append((title, by_value))
            if not line.skip(","):
                break
        line.take(")")
        line.end()
        return tuple(found)

    def _next(self) -> _Line:
        if not self.more:
            raise ConfigurationError(f"{self._name}: the text ends within a block")
        number, text = self._lines[self._at]
        self._at += 1
        return _Line(text, number, self._name)

    def _keyword(self) -> str:
        if not self.more:
            raise ConfigurationError(f"{self._name}: the text ends within a block")
        match = re.match(r"\w*", self._lines[self._at][1])
        return match[0].upper() if match else ""

    def _block(self, *ends: str) -> tuple[Statement, ...]:
        """Statements up to one of `ends`; this line remains. Declarations are gathered."""
        found: list[Statement] = []
        while (word := self._keyword()) not in ends:
            if word in _BLOCK_ENDS:
                line = self._next()
                raise line.error(f"{word} closes nothing; {' or '.join(ends)} is expected")
            line = self._next()
            declared = _declare(line)
            if declared is not None:
                self._declared.update(declared)
            elif word in ("EXT", "EXTFCT"):
                self._external.add(_external(line))
            else:
                found.append(self._statement(line))
        return tuple(found)

    def _statement(self, line: _Line) -> Statement:
        kind, word = line.take()
        if word in _IGNORED or (word == "GLOBAL" and line.peek in _IGNORED):
            if word == "SPLINE":
                self._skip_to("ENDSPLINE")
            return Ignored(line.text, line.number)
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
        if word == "REPEAT":
            line.end()
            body = self._block("UNTIL")
            closing = self._next()
            closing.take()
            return Repeat(body, closing.whole_expression(), line.number)
        if word == "FOR":
            return self._for(line)
        if word == "WAIT":
            what = line.take()[1]
            if what not in ("FOR", "SEC"):
                raise line.error("WAIT takes FOR or SEC")
            value = line.whole_expression()
            return WaitFor(value, line.number) if what == "FOR" else WaitSeconds(value, line.number)
        if word in ("PTP", "PTP_REL"):
            goal = line.expression()
            if not line.peek.startswith("C_"):  # approximate positioning
                line.end()
            return Move(goal, line.number, word == "PTP_REL")
        if word == "HALT":
            line.end()
            return Halt(line.number)
        if word in ("EXIT", "RETURN"):
            result = line.whole_expression() if word == "RETURN" and line.peek else None
            line.end()
            return Leave(word, line.number, result)
        if kind != "name" or word in _KEYWORDS:
            raise line.error(f"{line.text!r} is no statement of a program that can be run here")
        if line.peek == "(":
            call = line.call(word)
            line.end()
            return call
        target = line.variable(word)
        line.take("=")
        return Assign(target, line.whole_expression(), line.number)

    def _skip_to(self, ending: str) -> None:
        while self._keyword() != ending:
            self._next()
        self._next()

    def _for(self, line: _Line) -> For:
        variable = line.variable(line.take()[1])
        line.take("=")
        first = line.expression()
        line.take("TO")
        last = line.expression()
        step: Expression = line.expression() if line.skip("STEP") else Constant(1)
        line.end()
        body = self._block("ENDFOR")
        self._next()
        return For(variable, first, last, body, line.number, step)

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
