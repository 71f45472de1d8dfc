"""Settings that hold for all tests."""

import fcntl
import gc
import logging
import os
import shutil
import signal
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import settings

# Before numpy is imported: the matrices are small, and test processes run side by side.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

# Programs started by tests import this tree, wherever the environment was installed from, and the tests' own modules.
ROOT = str(Path(__file__).resolve().parents[1])
os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, (ROOT, os.environ.get("PYTHONPATH"))))

# No test asserts a wall-clock time: a busy computer is not a failure.
settings.register_profile("project", deadline=None)
settings.load_profile("project")

# A shell starts what runs in its background with Ctrl-C ignored, and children inherit that; some tests press Ctrl-C.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_auto_num_workers() -> int | None:
    """One for each processor, threads of one core too: with more, each test takes longer and the whole no less."""
    return len(os.sched_getaffinity(0)) if "PYTEST_XDIST_AUTO_NUM_WORKERS" not in os.environ else None


def pytest_collection_finish() -> None:
    """Spare the collector of garbage the search through all modules and tests, which live to the end."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(20_000, 20, 20)


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """What is long is slow too; files with slow tests come first, so that all processes end at about one time.

    By their names, so that files of one folder, which share what is made once, seldom wait for each other.
    """
    for item in items:
        if item.get_closest_marker("long"):
            item.add_marker("slow")
    slow = {item.path for item in items if item.get_closest_marker("slow")}
    items.sort(key=lambda item: (item.path not in slow, item.path.name, item.path))


@pytest.fixture(scope="session")
def made_once(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str, Callable[[Path], None]], Path]:
    """Gives a folder that all processes of the run share, filled by the first that asks for its name.

    What is in it is for reading: others look at it at the same time.
    """
    base = tmp_path_factory.getbasetemp()
    root = base.parent if "PYTEST_XDIST_WORKER" in os.environ else base

    def once(name: str, fill: Callable[[Path], None]) -> Path:
        folder, made = root / name, root / f"{name}.made"
        with (root / f"{name}.lock").open("w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            if not made.exists():
                shutil.rmtree(folder, ignore_errors=True)
                folder.mkdir()
                fill(folder)
                made.touch()
        return folder

    return once


@pytest.fixture(autouse=True)
def level_of_the_log() -> Iterator[None]:
    """Commands run in the process of the tests set it, and the next test expects the usual one."""
    before = logging.getLogger().level
    yield
    logging.getLogger().setLevel(before)


@pytest.fixture(scope="session")
def chrome() -> Iterator[Any]:
    """The one browser of a process."""
    from tests.runner.report.view_rig import browser, chromium

    if chromium() is None:
        pytest.skip("no chromium on this computer; install the system's package `chromium`")
    with browser() as opened_browser:
        yield opened_browser
