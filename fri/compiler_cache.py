"""The place of compiled code (numba's cache), beside the code of a checkout, else in the user's cache folder.

An installed package keeps `~/.cache/lwr-identification/numba` (or `$XDG_CACHE_HOME/...`): nothing stays in the
installation after it is removed, and this folder can be removed at any time. Where neither can be written, as in
containers, a private temporary folder serves; without one numba ends with "cannot cache function". The place is private
to the user: cached code is executed. `NUMBA_CACHE_DIR` names another.
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
    own = user_cache()
    if _writable(own):
        _name(own)
        return
    for place in _fallbacks():
        if _private(place):
            _name(place)
            return


def user_cache() -> Path:
    """Folder of an installed package's compiled code."""
    home = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
    return Path(home) / "lwr-identification/numba"


def _name(place: Path) -> None:
    os.environ[_VARIABLE] = str(place)
    if "numba" in sys.modules:
        # It has read its settings already.
        sys.modules["numba"].config.CACHE_DIR = str(place)


def _usable() -> bool:
    named = os.environ.get(_VARIABLE)
    if named:
        return _writable(Path(named))
    checkout = (_ROOT / "pyproject.toml").is_file()
    return checkout and all(_writable(_ROOT / package / "__pycache__") for package in _PACKAGES)


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
