"""The emulator as a process of its own: repeatable, and gone when it has to be."""

import os
import select
import signal
import subprocess
import sys

import pytest

from fri.errors import ConfigurationError, NetworkError
from runner.laboratory import free_port
from sim_backend import Emulator
from tests.sim_backend.pc import QUICK, Pc, gentle


def emulator(port, **options):
    options["settings"] = QUICK | options.get("settings", {})
    return Emulator(fri_port=port, **options)


def test_two_processes_with_one_seed_send_the_same_bytes():
    runs = []
    for _ in range(2):
        port = free_port("127.0.0.1")
        with Pc(port, gentle) as pc, emulator(port, seed=7, period_ms=2) as machine:
            pc.run(800)
            status = machine.status()
            runs.append(pc.measured)
    assert runs[0] == runs[1]
    assert status["state"] == "CMD"


def test_it_ends_with_its_block_and_the_pendant_says_so():
    with emulator(free_port("127.0.0.1")) as machine:
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
    with emulator(free_port("127.0.0.1")) as machine:
        machine.pendant.shutdown()
        assert machine.wait() == 0


def test_it_dies_with_a_parent_that_was_killed():
    script = (
        "from sim_backend import Emulator; import sys, time\n"
        f"machine = Emulator(fri_port={free_port('127.0.0.1')}, settings={QUICK!r}); machine.start()\n"
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
        Emulator(fri_port=free_port("127.0.0.1"), settings=settings).start()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"fri_port": 99999}, "fri_port 99999 is no whole number from 1 to 65535"),
        ({"fri_port": "49938"}, "fri_port '49938' is no whole number"),
        ({"fri_host": "localhost"}, "fri_host: .*give an IPv4 address such as 127.0.0.1"),
        ({"period_ms": 1.5}, "period_ms 1.5 is no whole number from 1 to 100"),
        ({"seed": -1}, "seed -1 is no whole number of at least 0"),
        ({"settings": ["robot.payload"]}, "is no mapping; give values by dotted key"),
        ({"settings": {"robot.payload": object()}}, "'robot.payload'.*give numbers, texts or lists"),
        ({"config": "nowhere.yaml"}, "nowhere.yaml"),
    ],
)
def test_wrong_arguments_are_refused_before_a_process_starts(arguments, message):
    with pytest.raises(ConfigurationError, match=message):
        Emulator(**arguments)


def test_the_emulator_describes_itself_in_at_most_ten_lines():
    settings = QUICK | {f"sensors.temperature{k}": k for k in range(20)}
    machine = Emulator(fri_port=49951, settings=settings)
    lines = repr(machine).splitlines()
    assert lines[0] == "Emulator default.yaml: not running; `start` it or use `with`"
    assert lines[1] == "  FRI      to 127.0.0.1:49951 in lock step"
    assert lines[-1] == "  and 16 more settings"
    assert len(lines) <= 10
    assert machine.address == ("127.0.0.1", 49951)
    with emulator(free_port("127.0.0.1")) as running:
        assert f"running (process {running.pid})" in repr(running)
        assert str(running.pendant_port) in repr(running)


def test_importing_the_package_is_cheap_and_gives_the_emulator():
    script = (
        "import sys, sim_backend\n"
        "assert not {'numpy', 'numba', 'sim_backend.process'} & set(sys.modules)\n"
        "from sim_backend import Emulator\n"
        "assert 'Emulator' in dir(sim_backend) and 'pinocchio' not in sys.modules\n"
        "sim_backend.Simulator"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert "AttributeError: module 'sim_backend' has no attribute 'Simulator'" in done.stderr
