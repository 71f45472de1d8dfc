"""What was running: versions of this software, of Python and of the packages that decide the numbers."""

from __future__ import annotations

import functools
import platform
import subprocess
from importlib import metadata
from pathlib import Path

__all__ = ["git_commit", "software", "versions"]

PACKAGES = ("numpy", "scipy", "pin", "ruckig", "numba", "mcap")
DISTRIBUTION = "lwr-identification"


def software() -> str:
    """Name and version of this software."""
    return f"{DISTRIBUTION} {metadata.version(DISTRIBUTION)}"


@functools.cache
def git_commit() -> str:
    """Commit of the checkout that runs, with `+` where files differ from it; empty outside of a checkout."""
    root = Path(__file__).resolve().parents[1]
    try:
        commit = _git(root, "rev-parse", "HEAD")
        return commit + ("+" if _git(root, "status", "--porcelain", "--untracked-files=no") else "")
    except (OSError, subprocess.SubprocessError):
        return ""


def versions() -> dict[str, str]:
    """Versions by package, with Python, the platform and the commit of this software."""
    found = {name: metadata.version(name) for name in PACKAGES}
    return {
        "software": software(),
        "git_commit": git_commit(),
        "python": platform.python_version(),
        "platform": platform.platform(),
        **found,
    }


def _git(root: Path, *arguments: str) -> str:
    done = subprocess.run(
        ["git", *arguments], cwd=root, capture_output=True, text=True, timeout=10, check=True
    )
    return done.stdout.strip()
