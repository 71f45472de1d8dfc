"""The emulator as a process of its own: repeatable, and gone when it has to be."""

import os
import select
import signal
import subprocess
import sys

import pytest
from pc import QUICK, Pc, free_port, gentle

from fri.errors import ConfigurationError, NetworkError
from sim_backend.process import EmulatorProcess


def emulator(port, **options):
    options["settings"] = QUICK | options.get("settings", {})
    return EmulatorProcess(fri_port=port, **options)


def test_two_processes_with_one_seed_send_the_same_bytes():
    runs = []
    for _ in range(2):
        port = free_port()
        with Pc(port, gentle) as pc, emulator(port, seed=7, period_ms=2) as machine:
            pc.run(800)
            status = machine.status()
            runs.append(pc.measured)
    assert runs[0] == runs[1]
    assert status["state"] == "CMD"


def test_it_ends_with_its_block_and_the_pendant_says_so():
    with emulator(free_port()) as machine:
        pid = machine.pid
        pendant = machine.pendant
        assert pid is not None
        assert machine.running
    assert not machine.running
    with pytest.raises(ProcessLookupError):
        os.kill(pid, 0)
    with pytest.raises((NetworkError, OSError)):
        pendant.status()


def test_shutdown_over_the_pendant_ends_it():
    with emulator(free_port()) as machine:
        machine.pendant.shutdown()
        assert machine.wait() == 0


def test_it_dies_with_a_parent_that_was_killed():
    script = (
        "from sim_backend.process import EmulatorProcess; import sys, time\n"
        f"machine = EmulatorProcess(fri_port={free_port()}, settings={QUICK!r}); machine.start()\n"
        "print(machine.pid, flush=True); time.sleep(60)"
    )
    parent = subprocess.Popen([sys.executable, "-c", script], stdout=subprocess.PIPE, text=True)
    assert parent.stdout is not None
    child = int(parent.stdout.readline())
    descriptor = os.pidfd_open(child)
    os.kill(parent.pid, signal.SIGKILL)
    parent.wait()
    ended, _, _ = select.select([descriptor], [], [], 10.0)
    os.close(descriptor)
    parent.stdout.close()
    assert ended, "the emulator outlived its killed parent by 10 s"


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"robot.payload": "piano"}, "piano"),
        ({"robot.payloda": "x"}, "payload"),
        ({"fri.period_ms": 200}, "200"),
    ],
)
def test_wrong_configuration_is_reported_by_the_parent(settings, message):
    with pytest.raises(ConfigurationError, match=message):
        EmulatorProcess(fri_port=free_port(), settings=settings).start()
