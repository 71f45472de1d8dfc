"""The KRL programs that the emulated controller can run, by name."""

from __future__ import annotations

from fri.errors import ConfigurationError
from fri.krl import PROGRAMS, KrlProgram
from fri.krl_machine import Machinery, SourceProgram
from lwr_driver.configuration import find

__all__ = ["OWN_PROGRAM", "krl_program"]

OWN_PROGRAM = "lwr_identification"
"""The program of configs/krl, whose text itself is run."""


def krl_program(name: str, period_ms: int, machinery: Machinery | None = None) -> KrlProgram:
    """Program `name`, ready to start with an FRI cycle of `period_ms`.

    machinery : motor currents and load data for the program of configs/krl; None leaves both at zero
    """
    if name == OWN_PROGRAM:
        folder = find(f"krl/{OWN_PROGRAM}.src").parent
        text, data = ((folder / f"{OWN_PROGRAM}.{end}").read_text(encoding="utf-8") for end in ("src", "dat"))
        return SourceProgram(text, data, {"LWR_CYCLE": period_ms}, machinery, OWN_PROGRAM)
    if name not in PROGRAMS:
        known = ", ".join((OWN_PROGRAM, *PROGRAMS))
        raise ConfigurationError(f"KRL program {name!r} is unknown; known: {known}")
    return PROGRAMS[name](period_ms)
