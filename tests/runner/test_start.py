"""Ctrl-C while the command line is imported, and in the emulator's process."""

from __future__ import annotations

import subprocess
import sys
from types import ModuleType
from typing import Any

import pytest

from runner.__main__ import main


def test_an_interrupt_of_the_imports_is_an_abort(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    class Interrupted(ModuleType):
        def __getattr__(self, name: str) -> Any:
            raise KeyboardInterrupt

    monkeypatch.setitem(sys.modules, "runner.cli", Interrupted("runner.cli"))
    with pytest.raises(SystemExit) as ended:
        main()
    assert (ended.value.code, capsys.readouterr().err) == (4, "aborted\n")


def test_the_emulator_of_a_command_leaves_the_interrupt_to_it() -> None:
    code = "import signal, sim_backend.__main__; print(signal.getsignal(signal.SIGINT) is signal.SIG_IGN)"
    done = subprocess.run(
        [sys.executable, "-c", code, "--follow-stdin"], capture_output=True, text=True, check=True
    )
    assert done.stdout == "True\n"
