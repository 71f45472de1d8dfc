"""Child processes of this interpreter, with this project's modules and no others of the same names."""

from __future__ import annotations

import os
import sys
from collections.abc import Mapping
from pathlib import Path

_ROOT = Path(__file__).resolve().parents[1]


def command(*arguments: str) -> list[str]:
    """Command line of a child with `arguments` such as `-m`, `runner.live`.

    Modules are never taken from the working folder (`-P`): a `numbers.py` beside an experiment stays unread.
    """
    return [sys.executable, "-P", *arguments]


def environment() -> Mapping[str, str]:
    """Environment of the child: this project first, then the parent's paths; one thread for BLAS."""
    given = os.environ.get("PYTHONPATH", "").split(os.pathsep)
    # An empty place would mean the working folder again.
    places = [str(_ROOT), *(os.path.abspath(place) for place in given if place)]
    return {**os.environ, "PYTHONPATH": os.pathsep.join(places), "OPENBLAS_NUM_THREADS": "1"}
