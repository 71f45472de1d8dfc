"""A place for compiled code (numba's cache) where neither installation nor home can be written, as in containers.

Without one numba ends with "cannot cache function". The place is private to the user: cached code is executed.
"""

from __future__ import annotations

import contextlib
import os
import stat
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

_ROOT = Path(__file__).resolve().parents[1]
_PACKAGES = ("lwr_driver", "ident", "sim_backend")
_VARIABLE = "NUMBA_CACHE_DIR"


def provide() -> None:
    """Name a place in `NUMBA_CACHE_DIR` if numba would find none; child processes inherit it.

    If even temporary folders cannot be written, nothing is changed.
    """
    if _usable():
        return
    for place in _fallbacks():
        if _private(place):
            os.environ[_VARIABLE] = str(place)
            if "numba" in sys.modules:
                # It has read its settings already.
                sys.modules["numba"].config.CACHE_DIR = str(place)
            return


def _usable() -> bool:
    named = os.environ.get(_VARIABLE)
    if named:
        return _writable(Path(named))
    if all(_writable(_ROOT / package / "__pycache__") for package in _PACKAGES):
        return True
    home = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
    return _writable(Path(home) / "numba")


def _writable(folder: Path) -> bool:
    """Whether files can be made in the folder, itself made if missing; tried, for modes tell only half."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return True
    except OSError:
        return False


def _fallbacks() -> Iterator[Path]:
    name = f"lwr-run-{os.getuid()}"
    with contextlib.suppress(FileNotFoundError):
        yield Path(tempfile.gettempdir()) / name
    yield Path("/dev/shm") / name


def _private(folder: Path) -> bool:
    """Make the folder; False unless it is this user's alone."""
    try:
        folder.mkdir(mode=0o700, exist_ok=True)
        found = folder.lstat()
    except OSError:
        return False
    mine = stat.S_ISDIR(found.st_mode) and found.st_uid == os.getuid()
    return mine and not stat.S_IMODE(found.st_mode) & 0o077 and _writable(folder)
