"""Recordings made elsewhere: text, NPZ and MATLAB files and ROS 2 bags to session logs.

`LogMapping.load` reads the mapping file, `import_log` writes the session, `guess_mapping` guesses a mapping from names,
`read_recording` reads session logs and bags alike. Nothing is filtered or resampled on the way: a value is converted
(unit, sign, scale, gear, offset, turns of an angle that wraps) and written, or the import stops with an error.
"""

from __future__ import annotations

from ident.import_log.conversion import import_log
from ident.import_log.direct import read_recording
from ident.import_log.guess import Guess, Known, guess_mapping
from ident.import_log.mapping import (
    Coupling,
    LogMapping,
    PeriodMarks,
    Signal,
    TimeBase,
    Transmission,
    mapping_path,
)
from ident.import_log.periods import Periods, find_periods
from ident.import_log.report import ImportReport

__all__ = [
    "Coupling",
    "Guess",
    "ImportReport",
    "Known",
    "LogMapping",
    "PeriodMarks",
    "Periods",
    "Signal",
    "TimeBase",
    "Transmission",
    "find_periods",
    "guess_mapping",
    "import_log",
    "mapping_path",
    "read_recording",
]
