"""Cases with shorter motions."""

from __future__ import annotations

from dataclasses import replace
from typing import Any


def shortened(case: Any, seconds: float) -> Any:
    """The case with the beginnings of its motions."""
    rows = round(seconds * 1000)
    return replace(
        case, healthy=tuple(replace(setup, q=setup.q[:rows], qd=setup.qd[:rows]) for setup in case.healthy)
    )
