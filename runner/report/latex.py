"""Tables of a run for a paper: LaTeX with `booktabs`, the same numbers as on the page.

::

    from runner.report.latex import parameter_table, table_1, table_2
    print(parameter_table("experiments/lwr4plus-20260101-120000", columns=2))

Each function returns a `tabular`, to be put in the `table` of a document with `\\\\usepackage{booktabs}`.
"""

from __future__ import annotations

import math
import re
from pathlib import Path

from fri.errors import ConfigurationError
from ident.diagnosis.outcome.statements import Number
from runner.report import tables
from runner.report.folder import ResultFolder
from runner.report.markup import Cell
from runner.report.tables import Table

Results = ResultFolder | str | Path

_SPECIAL = {
    "&": r"\&",
    "%": r"\%",
    "#": r"\#",
    "_": r"\_",
    "$": r"\$",
    "{": r"\{",
    "}": r"\}",
    "~": r"\textasciitilde{}",
}
_SYMBOLS = {"²": "$^2$", "–": "--", "\N{NO-BREAK SPACE}": "~", "±": r"$\pm$", "\\": r"\textbackslash{}",
            "^": r"\textasciicircum{}"}  # fmt: skip
_NAME = re.compile(r"^(XX|XY|XZ|YY|YZ|ZZ|MX|MY|MZ|M|Ia|Fvl|Fvm|Fcl|Fcm|offl|offm)(\d+)(R?)( \*)?$")
_TORQUE = re.compile(r"^\|τ(\d+)\| \[Nm\]$")


def table_1(results: Results) -> str:
    """Table 1 of the paper with the motion of this run as a `tabular`: torques in Nm, by joint."""
    return tabular(tables.table_1(_folder(results)))


def table_2(results: Results, *, columns: int = 1) -> str:
    """Table 2 of the paper beside the estimates of this run as a `tabular` of `columns` blocks side by side."""
    return tabular(tables.table_2(_folder(results)), columns=columns)


def parameter_table(results: Results, *, columns: int = 1) -> str:
    """All base parameters with std, 95 % interval and RSD as a `tabular` of `columns` blocks side by side."""
    return tabular(tables.parameters(_folder(results)), columns=columns)


def save_tables(results: Results, folder: str | Path) -> list[Path]:
    """Write `table_1.tex`, `table_2.tex` and `parameters.tex`; none for a run without estimate.

    The first two are for the arm of the paper alone.
    """
    results = _folder(results)
    if not results.summary.get("parameters"):
        return []
    texts = {"parameters.tex": parameter_table(results, columns=2)}
    if results.published_arm:
        texts = {"table_1.tex": table_1(results), "table_2.tex": table_2(results)} | texts
    paths = [Path(folder) / name for name in texts]
    for path, text in zip(paths, texts.values(), strict=True):
        path.write_text(text, encoding="utf-8")
    return paths


def tabular(table: Table, *, columns: int = 1) -> str:
    """A table as LaTeX; its rows go down the first of `columns` blocks, then down the next."""
    if columns < 1:
        raise ConfigurationError(f"table: {columns} blocks side by side; give 1 or more")
    rows = [[_cell(cell, first=not place) for place, cell in enumerate(row)] for row in table.rows]
    places = range(len(table.head))
    right = [any(isinstance(row[place], Number) for row in table.rows) for place in places]
    block = "".join("r" if number else "l" for number in right)
    head = [_head(name) for name in table.head]
    each = math.ceil(len(rows) / columns)
    empty = [""] * len(head)
    parts = [rows[k * each : (k + 1) * each] for k in range(columns)]
    lines = [
        " & ".join(cell for part in parts for cell in (part[k] if k < len(part) else empty)) + r" \\"
        for k in range(each)
    ]
    blocks = r"@{\qquad}".join([block] * columns)
    return "\n".join(
        [
            "% \\usepackage{booktabs}",
            f"\\begin{{tabular}}{{@{{}}{blocks}@{{}}}}",
            "\\toprule",
            " & ".join(head * columns) + r" \\",
            "\\midrule",
            *lines,
            "\\bottomrule",
            "\\end{tabular}",
            "",
        ]
    )


def _head(name: str) -> str:
    torque = _TORQUE.match(name)
    return rf"$|\tau_{torque[1]}|$" if torque else _escaped(name)


def _cell(cell: Cell, *, first: bool) -> str:
    if isinstance(cell, Number):
        return _number(cell)
    symbol = _NAME.match(cell) if first else None
    if symbol is None:
        return _escaped(cell)
    name, link, regrouped, mark = symbol.groups()
    text = {"offl": "o", "offm": "o", "M": "m"}.get(name, name[0] if name[0] in "FI" else name)
    index = {"Ia": "a", "Fvl": "v,l", "Fvm": "v,m", "Fcl": "c,l", "Fcm": "c,m", "offl": "l", "offm": "m"}.get(
        name, ""
    )
    shown = rf"\mathit{{{text}}}" if len(text) > 1 else text
    lower = rf"\mathrm{{{index}}}{link}" if index else link
    raised = r"^\mathrm{R}" if regrouped else ""
    return f"${shown}_{{{lower}}}{raised}${'$^*$' if mark else ''}"


def _number(number: Number) -> str:
    if number.value is None or math.isnan(number.value):
        return "--"
    if math.isinf(number.value):
        return r"$\infty$" if number.value > 0 else r"$-\infty$"
    if abs(number.value) > number.most:
        return rf"$>{number.most:g}$" if number.value > 0 else rf"$<-{number.most:g}$"
    text = format(number.value, number.form)
    if not text.strip("+-0."):
        text = text.lstrip("+-")
    mantissa, mark, power = text.partition("e")
    if mark:
        return rf"${mantissa}\cdot 10^{{{int(power)}}}$"
    return f"${text}$" if text[0] in "+-" else text


def _escaped(text: str) -> str:
    return "".join(_SYMBOLS.get(sign) or _SPECIAL.get(sign) or sign for sign in text)


def _folder(results: Results) -> ResultFolder:
    return results if isinstance(results, ResultFolder) else ResultFolder.load(results)
