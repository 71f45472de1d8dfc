"""The dynamic model of a serial arm: planning, identification, validation and diagnosis from session logs.

Names are imported on first use, so `import ident` is cheap. The packages below (`ident.estimation`,
`ident.diagnosis`, ...) hold the details.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from fri.on_first_use import on_first_use

if TYPE_CHECKING:
    from ident.diagnosis import commission, diagnose
    from ident.dynamics import Chain
    from ident.estimation import (
        IdentificationSettings,
        compare,
        cross_validate,
        identify,
        identify_payload,
        known_settings,
        validate,
    )
    from ident.excitation import plan
    from ident.formats import export
    from ident.model import read_model, write_model
    from lwr_driver.session import read_session

    __version__: str

__all__ = [
    "Chain",
    "IdentificationSettings",
    "__version__",
    "commission",
    "compare",
    "cross_validate",
    "diagnose",
    "export",
    "identify",
    "identify_payload",
    "known_settings",
    "plan",
    "read_model",
    "read_session",
    "validate",
    "write_model",
]

_HOMES = {
    "ident.diagnosis": ("commission", "diagnose"),
    "ident.dynamics": ("Chain",),
    "ident.estimation": (
        "IdentificationSettings",
        "compare",
        "cross_validate",
        "identify",
        "identify_payload",
        "known_settings",
        "validate",
    ),
    "ident.excitation": ("plan",),
    "ident.formats": ("export",),
    "ident.model": ("read_model", "write_model"),
    "lwr_driver.session": ("read_session",),
}


_find, __dir__ = on_first_use(globals(), _HOMES)


def __getattr__(name: str) -> Any:
    return _version() if name == "__version__" else _find(name)


def _version() -> str:
    from importlib import metadata

    try:
        return metadata.version("lwr-identification")
    except metadata.PackageNotFoundError:
        return "0+unknown"
