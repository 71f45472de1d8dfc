"""The arm and its controller in software, behind the same UDP protocol as the real ones.

::

    from sim_backend import Emulator

    with Emulator(fri_port=49951) as emulator:
        print(emulator)
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from fri.on_first_use import on_first_use

if TYPE_CHECKING:
    from sim_backend.process import Emulator

__all__ = ["Emulator"]


__getattr__, __dir__ = on_first_use(globals(), {".process": ("Emulator",)})
