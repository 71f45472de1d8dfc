from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from fri import compiler_cache


@pytest.fixture
def sealed(monkeypatch, tmp_path):
    """A computer on which only the given folders can be written; returns the environment's cache folder."""

    def seal(*writable: Path) -> str | None:
        monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
        monkeypatch.setenv("HOME", str(tmp_path / "home"))
        monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
        monkeypatch.setattr(compiler_cache.tempfile, "gettempdir", lambda: str(tmp_path))
        allowed = tuple(map(str, writable))
        monkeypatch.setattr(compiler_cache, "_writable", lambda folder: str(folder).startswith(allowed))
        compiler_cache.provide()
        return os.environ.get("NUMBA_CACHE_DIR")

    yield seal
    os.environ.pop("NUMBA_CACHE_DIR", None)


def test_a_checkout_that_can_be_written_needs_no_other_place(sealed):
    assert sealed("/") is None


def test_else_the_cache_folder_of_the_user_serves(sealed, tmp_path):
    assert sealed(tmp_path / "home") == str(tmp_path / "home/.cache/lwr-identification/numba")


def test_an_installed_package_leaves_its_folder_alone(sealed, tmp_path, monkeypatch):
    monkeypatch.setattr(compiler_cache, "_ROOT", tmp_path / "site-packages")
    assert sealed("/") == str(tmp_path / "home/.cache/lwr-identification/numba")


def test_without_both_a_private_temporary_place_serves(sealed, tmp_path):
    place = tmp_path / f"lwr-run-{os.getuid()}"
    assert sealed(place) == str(place)
    assert place.stat().st_mode & 0o777 == 0o700


def test_a_place_that_others_can_write_is_not_trusted(sealed, tmp_path):
    place = tmp_path / f"lwr-run-{os.getuid()}"
    place.mkdir()
    place.chmod(0o777)
    assert sealed(place) is None


def test_a_named_place_that_cannot_be_written_is_replaced(sealed, tmp_path, monkeypatch):
    place = tmp_path / f"lwr-run-{os.getuid()}"
    delenv = monkeypatch.delenv
    monkeypatch.setattr(
        monkeypatch, "delenv", lambda name, **_: None if "NUMBA" in name else delenv(name, **_)
    )
    monkeypatch.setenv("NUMBA_CACHE_DIR", "/nowhere")
    assert sealed(place) == str(place)


def test_the_place_is_there_once_the_package_is_imported(tmp_path):
    environment = {**os.environ, "NUMBA_CACHE_DIR": "/proc/nowhere", "HOME": str(tmp_path)}
    environment.pop("XDG_CACHE_HOME", None)
    command = [sys.executable, "-c", "import fri, os; print(os.environ['NUMBA_CACHE_DIR'])"]
    found = subprocess.run(
        command, env=environment, capture_output=True, text=True, check=True
    ).stdout.strip()
    assert Path(found) == tmp_path / ".cache/lwr-identification/numba"
    assert Path(found).is_dir()
