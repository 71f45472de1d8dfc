"""Output paths are tried before the work, and no command ends in a traceback."""

from __future__ import annotations

import errno
import os
import re
import subprocess
import sys
from pathlib import Path

import click
import pytest
from click.testing import CliRunner

from fri.errors import FileError
from runner import cli
from runner.cli import main
from runner.output import check_file, check_folder

# Inputs do not exist: whoever complains about them has begun to work before looking at the place.
WITH_OUTPUT = (
    "identify no.mcap --out {}/m.yaml",
    "identify no.mcap --results {}/m",
    "commission no.mcap --out {}/m.yaml",
    "diagnose no.mcap --out {}/m",
    "payload no.yaml no.mcap --out {}/m.yaml",
    "export no.yaml {}/m.urdf",
    "recover no.mcap --out {}/m.mcap",
    "recover {}/no.mcap",
    "attach no.mcap no.csv --out {}/m.mcap",
    "attach {}/no.mcap no.csv",
    "import no no.csv {}/m.mcap",
    "report no --figures {}/m",
    "report {}",
    "plan --out {}/m.yaml",
    "preview --out {}/m.html",
    "replay no --out {}/m.gif",
    "experiment --out {}/m",
)


@pytest.mark.parametrize("line", WITH_OUTPUT)
def test_a_place_that_cannot_be_written_is_told_before_the_work(line: str, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("no folder")
    place = str(tmp_path / "file")
    result = CliRunner().invoke(main, line.format(place).split())
    assert result.exit_code == 2, result.output
    assert result.output.startswith("FileError: "), result.output
    assert place in result.output
    assert "Not a directory; a part of the path is a file" in result.output
    assert os.listdir(tmp_path) == ["file"]


def test_a_file_needs_its_folder_and_a_folder_makes_its_own(tmp_path: Path) -> None:
    with pytest.raises(FileError, match="make the folder first"):
        check_file(tmp_path / "none" / "m.yaml")
    assert check_folder(tmp_path / "a" / "b") == tmp_path / "a" / "b"
    assert check_file(tmp_path / "m.yaml") == tmp_path / "m.yaml"
    with pytest.raises(FileError, match="name a file in it"):
        check_file(tmp_path)
    with pytest.raises(FileError, match="choose a shorter name"):
        check_file(tmp_path / ("n" * 300))
    assert os.listdir(tmp_path) == []


def test_an_existing_file_is_left_as_it_is(tmp_path: Path) -> None:
    (tmp_path / "m.yaml").write_text("kept")
    check_file(tmp_path / "m.yaml")
    assert (tmp_path / "m.yaml").read_text() == "kept"


def test_a_full_disk_is_noticed_by_the_trial(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(dir: Path) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr("runner.output.tempfile.TemporaryFile", full)
    with pytest.raises(FileError, match=r"m\.yaml cannot be written: No space left on device; make room"):
        check_file(tmp_path / "m.yaml")


@pytest.mark.parametrize(
    ("error", "code", "words"),
    [
        (
            OSError(errno.ENOSPC, "No space left on device", "report.txt"),
            2,
            "report.txt: No space left.*make room",
        ),
        (PermissionError(errno.EACCES, "Permission denied", "x"), 2, "x: Permission denied; its owner"),
        (MemoryError(), 2, "memory: .*end other programs"),
        (ZeroDivisionError("division by zero"), 1, "internal error, ZeroDivisionError.*Please report"),
        (RecursionError("too deep"), 1, "internal error, RecursionError: too deep"),
        (KeyboardInterrupt(), 4, "aborted"),
    ],
)
def test_no_command_ends_in_a_traceback(
    error: BaseException, code: int, words: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    @click.command("info")
    def broken() -> None:
        raise error

    monkeypatch.setattr(cli.Verbs, "get_command", lambda self, context, name: broken)
    result = CliRunner().invoke(main, ["info"])
    assert result.exit_code == code
    assert isinstance(result.exception, SystemExit)
    assert re.search(words, result.output)
    assert "Traceback" not in result.output


def test_a_reader_that_stops_reading_is_no_error() -> None:
    program = f"{sys.executable} -P -m runner.cli --help | true"
    done = subprocess.run(["bash", "-c", program], capture_output=True, text=True)
    assert "Traceback" not in done.stderr


@pytest.mark.slow
def test_a_module_of_that_name_beside_the_experiment_is_not_read(tmp_path: Path) -> None:
    for name in ("numbers", "json", "signal"):
        (tmp_path / f"{name}.py").write_text("raise RuntimeError('read by a child process')")
    code = (
        "from lwr_driver.driver import Driver, LinkSettings; from lwr_driver.arm import Arm\n"
        "from runner.laboratory import free_port; from sim_backend.process import EmulatorProcess\n"
        "port = free_port('127.0.0.1')\n"
        "with EmulatorProcess(lock_step=True, fri_port=port):\n"
        "    with Driver(Arm.load(), LinkSettings('127.0.0.1', port, lock_step=True)) as driver:\n"
        "        print(driver.connect().state)\n"
    )
    done = subprocess.run([sys.executable, "-P", "-c", code], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == "MON"
