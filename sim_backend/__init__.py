"""The arm and its controller in software, behind the same UDP protocol as the real ones.

::

    from sim_backend import Emulator

    with Emulator(fri_port=49951) as emulator:
        print(emulator)
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import fri  # noqa: F401 - finds a place for compiled code

if TYPE_CHECKING:
    from sim_backend.process import Emulator

__all__ = ["Emulator"]


def __getattr__(name: str) -> Any:
    # Imported on first use, so that `import sim_backend` stays cheap.
    if name in __all__:
        from sim_backend import process

        return getattr(process, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])
