"""Imports ahead of their use, in a thread, while this process waits for the motions of an emulated arm."""

from __future__ import annotations

import contextlib
import importlib
import threading


def import_ahead(*modules: str) -> threading.Thread:
    """Import modules in the background; a failure shows where they are used. Returns the thread."""

    def work() -> None:
        for module in modules:
            with contextlib.suppress(Exception):
                importlib.import_module(module)

    thread = threading.Thread(target=work, name="import ahead", daemon=True)
    thread.start()
    return thread
