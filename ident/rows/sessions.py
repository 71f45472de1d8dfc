"""The sessions given to a function: read ones, paths of logs, or several of either."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any, TypeAlias

from fri.errors import ConfigurationError, DataError
from lwr_driver.session import Session, read_session

__all__ = ["Sessions", "as_sessions", "payload_name", "require", "stated_mass"]

Sessions: TypeAlias = Session | str | Path | Iterable[Session | str | Path]


def as_sessions(value: Sessions) -> list[Session]:
    """A session, the path of a log, or an iterable of these, as a list of sessions; paths are read.

    Raises ConfigurationError for a value of another type and DataError for an unreadable log.
    """
    if isinstance(value, (Session, str, Path)):
        value = [value]
    elif not isinstance(value, Iterable) or isinstance(value, (bytes, bytearray)):
        raise ConfigurationError(f"sessions: {_ADVICE}, not {_kind(value)}")
    return [_session(item) for item in value]


_ADVICE = "give a session, the path of a log (.mcap) or a list of these"


def _session(item: Any) -> Session:
    if isinstance(item, Session):
        return item
    if isinstance(item, (str, Path)):
        return read_session(item)
    raise ConfigurationError(f"sessions: an entry is {_kind(item)}; {_ADVICE}")


def _kind(value: Any) -> str:
    return f"{type(value).__name__} {value!r:.60}"


def require(value: Any, kind: type, name: str, advice: str) -> None:
    """Raise ConfigurationError, with advice, when the argument `name` is not of the type `kind`."""
    if not isinstance(value, kind):
        raise ConfigurationError(f"`{name}` must be of type {kind.__name__}, not {_kind(value)}; {advice}")


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
