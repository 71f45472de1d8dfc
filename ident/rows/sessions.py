"""The arguments of a function: sessions, their payloads, and the check of a type."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from fri.errors import ConfigurationError, DataError
from lwr_driver.session import Session


def require(value: Any, kind: type, name: str, advice: str) -> None:
    """Raise ConfigurationError, with advice, when the argument `name` is not of the type `kind`."""
    if not isinstance(value, kind):
        raise ConfigurationError(
            f"`{name}` must be of type {kind.__name__}, not {type(value).__name__} {value!r:.60}; {advice}"
        )


def payload_name(session: Session) -> str | None:
    """Name of the payload in a session's metadata; None for the bare arm."""
    name = session.metadata.get("payload", "none").strip()
    return None if name in ("", "none") else name


def stated_mass(session: Session) -> float | None:
    """Mass of the payload in a session's metadata [kg]; None without. Raises DataError for other text."""
    stated = session.metadata.get("payload_mass", "")
    try:
        return float(stated) if stated else None
    except ValueError as error:
        raise DataError(
            f"{session.path.name}: `payload_mass` {stated!r} in the metadata is no number"
        ) from error


def recorded_couplings(sessions: Sequence[Session]) -> tuple[str, ...]:
    """Coupled pairs of joints in the metadata of imported sessions, each as `A5:A6`."""
    return tuple(
        dict.fromkeys(pair for one in sessions for pair in one.metadata.get("couplings", "").split())
    )
