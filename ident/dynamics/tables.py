"""Results as tables: a data frame, and HTML in a notebook."""

from __future__ import annotations

import html
import math
from collections.abc import Iterable
from typing import Any

from lwr_driver.notebook import optional


class Tabular:
    """Base of the results with one row for each parameter, joint or session."""

    def records(self) -> list[dict[str, Any]]:
        """The rows of the table, each a mapping from the name of a column to its value."""
        raise NotImplementedError

    def to_dataframe(self) -> Any:
        """The rows as `pandas.DataFrame`. Raises ConfigurationError without pandas."""
        pandas = optional("pandas", f"{type(self).__name__}: to_dataframe()", "records()")
        return pandas.DataFrame(self.records())

    def _repr_html_(self) -> str:
        """First line of the text form and the rows as HTML."""
        rows = self.records()
        title = f"<p>{html.escape(repr(self).splitlines()[0])}</p>"
        if not rows:
            return title
        names = list(dict.fromkeys(name for row in rows for name in row))
        head = "".join(f"<th>{html.escape(name)}</th>" for name in names)
        body = "".join(
            "<tr>" + "".join(f"<td>{_cell(row.get(name))}</td>" for name in names) + "</tr>" for row in rows
        )
        return f"{title}<table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"


def rows_of(**columns: Iterable[Any]) -> list[dict[str, Any]]:
    """Rows of a table from its columns of equal length."""
    return [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]


def _cell(value: Any) -> str:
    if value is None or (isinstance(value, float) and math.isnan(value)):
        return ""
    return html.escape(f"{value:.5g}" if isinstance(value, float) else str(value))
