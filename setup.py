"""Bakes the commit into wheels and source archives: `runner/commit.txt`, read where there is no checkout."""

from __future__ import annotations

import subprocess
from pathlib import Path
from typing import Any

from setuptools import setup
from setuptools.command.build_py import build_py
from setuptools.command.sdist import sdist

ROOT = Path(__file__).resolve().parent
NAME = "runner/commit.txt"


def commit() -> str:
    """Commit of the checkout, with `+` after local changes; that of a source archive without one; else nothing."""
    if (ROOT / ".git").exists():
        ask: Any = {"cwd": ROOT, "text": True, "stderr": subprocess.DEVNULL}
        try:
            head = subprocess.check_output(["git", "rev-parse", "HEAD"], **ask).strip()
            changed = subprocess.check_output(["git", "status", "--porcelain", "--untracked-files=no"], **ask)
            return head + ("+" if changed.strip() else "")
        except (OSError, subprocess.SubprocessError):
            return ""
    baked = ROOT / NAME
    return baked.read_text(encoding="utf-8").strip() if baked.is_file() else ""


def bake(folder: Path) -> None:
    """Write the commit into a tree of packages."""
    if text := commit():
        (folder / NAME).parent.mkdir(parents=True, exist_ok=True)
        (folder / NAME).write_text(f"{text}\n", encoding="utf-8")


class BuildPy(build_py):
    """The packages of a wheel; an editable installation asks git."""

    def run(self) -> None:
        """Copy the packages and write the commit."""
        super().run()
        if not self.editable_mode:
            bake(Path(self.build_lib))


class Sdist(sdist):
    """The source archive."""

    def make_release_tree(self, base_dir: str, files: Any) -> None:
        """Copy the sources and write the commit."""
        super().make_release_tree(base_dir, files)
        bake(Path(base_dir))


setup(cmdclass={"build_py": BuildPy, "sdist": Sdist})
