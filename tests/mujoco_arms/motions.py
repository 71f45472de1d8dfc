"""Cases with shorter motions."""

from __future__ import annotations

from dataclasses import replace
from typing import Any


def shortened(case: Any, seconds: float) -> Any:
    """The case with the beginnings of its motions, of the reference days too."""
    rows = round(seconds * 1000)

    def short(day: Any) -> Any:
        return tuple(replace(setup, q=setup.q[:rows], qd=setup.qd[:rows]) for setup in day)

    return replace(case, healthy=short(case.healthy), reference=tuple(map(short, case.reference)))
