"""Wheel and source archive: built, installed into an empty environment, run, removed without a rest."""

from __future__ import annotations

import json
import os
import re
import shutil
import site
import subprocess
import sys
from collections.abc import Iterator
from importlib import metadata
from pathlib import Path

import pytest
import yaml

from runner.computer import git_commit
from tests.archives import unpack
from tests.docs.conftest import SHORT
from tests.docs.markdown import ROOT

BUILD = "import sys; from setuptools import build_meta as b; print(getattr(b, sys.argv[1])(sys.argv[2]))"
CACHES = {".cache/lwr-identification", ".cache/matplotlib", ".config/matplotlib"}


def build(what: str, source: Path, out: Path) -> Path:
    done = subprocess.run(
        [sys.executable, "-c", BUILD, what, str(out)], cwd=source, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    return out / done.stdout.split()[-1]


def pip(python: Path, *words: str) -> None:
    command = [sys.executable, "-m", "pip", "--python", str(python), "--disable-pip-version-check", *words]
    # Of this environment nothing is to be seen.
    environment = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
    done = subprocess.run(command, capture_output=True, text=True, env=environment)
    assert done.returncode == 0, done.stderr


def dependencies() -> Iterator[str]:
    """Folders of the present environment's packages, without this project's own."""
    for folder in map(Path, site.getsitepackages()):
        yield str(folder)
        for path in folder.glob("*.pth"):
            # A plain import is of a module that adds folders.
            yield from re.findall(r"^import \w+$", path.read_text(), re.MULTILINE)


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Built from the source archive, and that from the files of the checkout."""
    if int(metadata.version("setuptools").split(".")[0]) < 77:
        pytest.skip("setuptools 77 is needed; `make test` installs it")
    if not (ROOT / ".git").exists():
        pytest.skip("no checkout")
    place = tmp_path_factory.mktemp("package")
    source = place / "source"
    subprocess.run(["git", "clone", "--quiet", "--no-checkout", str(ROOT), str(source)], check=True)
    listed = subprocess.check_output(["git", "ls-files", "-co", "--exclude-standard"], cwd=ROOT, text=True)
    for name in listed.splitlines():
        if (ROOT / name).is_file():
            (source / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(ROOT / name, source / name)
    subprocess.run(["git", "reset", "--quiet"], cwd=source, check=True)
    archive = build("build_sdist", source, place)
    unpack(archive, place)
    return build("build_wheel", place / archive.name.removesuffix(".tar.gz"), place)


@pytest.mark.long
def test_the_wheel_runs_an_experiment_and_leaves_only_a_cache(wheel: Path, tmp_path: Path) -> None:
    venv, home, work = (tmp_path / name for name in ("venv", "home", "work"))
    home.mkdir()
    work.mkdir()
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", str(venv)], check=True)
    python = venv / "bin/python"
    packages = next((venv / "lib").glob("python*/site-packages"))
    before = set(packages.iterdir())
    pip(python, "install", "--no-deps", "--no-index", str(wheel))
    # The dependencies come from the present environment.
    (packages / "dependencies.pth").write_text("\n".join(dependencies()) + "\n")
    environment = {"HOME": str(home), "PATH": str(venv / "bin"), "OPENBLAS_NUM_THREADS": "1"}

    def lwr_run(*words: str) -> str:
        done = subprocess.run(
            [venv / "bin/lwr-run", *words], cwd=work, env=environment, capture_output=True, text=True
        )
        assert done.returncode == 0, done.stderr
        return done.stdout

    where = "import runner; print(runner.__file__)"
    found = subprocess.check_output([python, "-c", where], cwd=work, env=environment, text=True)
    assert found.startswith(str(packages))
    (work / "short.yaml").write_text(yaml.safe_dump(SHORT))
    lwr_run("experiment", "short.yaml", "--yes", "--out", "results")
    versions = json.loads((work / "results/summary.json").read_text())["versions"]
    assert versions["git_commit"].rstrip("+") == git_commit().rstrip("+") != ""
    assert versions["software"] == f"lwr-identification {metadata.version('lwr-identification')}"
    assert json.loads(lwr_run("schema", "experiment"))["title"] == "experiment"
    # The default experiment of the wheel, from an empty folder.
    lwr_run("check")
    (packages / "dependencies.pth").unlink()
    pip(python, "uninstall", "--yes", "lwr-identification")
    assert set(packages.iterdir()) == before
    assert not list((venv / "bin").glob("lwr*"))
    files = {path.relative_to(home) for path in home.rglob("*") if path.is_file()}
    assert {"/".join(path.parts[:2]) for path in files} <= CACHES
    assert any(path.suffix == ".nbi" for path in files)
