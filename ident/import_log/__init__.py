"""Import of recordings made elsewhere: CSV and NPZ files to a session log, through a mapping file.

`LogMapping.load` reads the mapping file, `import_log` writes the session. Nothing is filtered, resampled or
repaired on the way: a value is converted (unit, sign, scale, gear, offset) and written, or the import stops
with an error.
"""

from __future__ import annotations

from ident.import_log.conversion import import_log
from ident.import_log.mapping import LogMapping

__all__ = ["LogMapping", "import_log"]
