"""The C client, compiled on the spot where there is a compiler."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

__all__ = ["client", "start"]

_SOURCE = Path(__file__).with_name("client.c")


def client(folder: Path) -> Path | None:
    """The program in `folder`; None without a compiler."""
    compiler = shutil.which("cc") or shutil.which("gcc") or shutil.which("clang")
    if compiler is None:
        return None
    program = folder / "client"
    subprocess.run([compiler, "-O2", "-Wall", "-o", str(program), str(_SOURCE), "-lm"], check=True)
    return program


def start(
    program: Path,
    port: int,
    *,
    priority: int = 0,
    cpu: int = -1,
    style: str = "hold",
    handshake: str = "stanford",
    packets: int = 0,
) -> subprocess.Popen[str]:
    """Start it, with a priority of SCHED_FIFO or none (0); its output is `received commanded`."""
    command = [str(program), str(port), str(priority), str(cpu), style, handshake, str(packets)]
    return subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
