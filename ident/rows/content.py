"""Results kept by the content of what they are computed from: equal data are computed once.

Screening, choice of the signal settings and delay of a recording take most of an estimate's time, and the same
recordings are estimated several times: with several estimators, by sides, with and without a session.
"""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import PurePath
from typing import Any, Generic, TypeVar

import numpy as np

from lwr_driver.session import Session
from lwr_driver.session.spool import release, spans

Result = TypeVar("Result")
_PLAIN = (str, bytes, bool, int, float, np.generic, PurePath, type(None))


class Kept(Generic[Result]):
    """The latest results by the content of their arguments, `most` at most; the arguments are not kept."""

    def __init__(self, most: int) -> None:
        self._most = most
        self._found: dict[bytes, Result] = {}

    def of(self, make: Callable[..., Result], *arguments: Any) -> Result:
        """make(*arguments), or what it gave for equal arguments. TypeError for an argument without plain content."""
        key = content(*arguments)
        found = self._found.pop(key) if key in self._found else make(*arguments)
        self._found[key] = found
        while len(self._found) > self._most:
            self._found.pop(next(iter(self._found)))
        return found


class Recall:
    """Results of the steps of one command on the same sessions.

    Arrays and columns count by identity and must not change, plain values by value. It keeps them.
    """

    def __init__(self) -> None:
        self._found: dict[Any, dict[tuple[Any, ...], tuple[tuple[Any, ...], Any]]] = {}

    def of(self, make: partial[Result], *things: Any, most: int = 64) -> Result:
        """make(), or what its function gave for the same things; of the latest `most` results of the function."""
        results = self._found.setdefault(make.func, {})
        key = tuple(thing if isinstance(thing, _PLAIN) else id(thing) for thing in things)
        found: tuple[tuple[Any, ...], Result] = results.pop(key) if key in results else (things, make())
        results[key] = found
        while len(results) > most:
            results.pop(next(iter(results)))
        return found[1]


def content(*things: Any) -> bytes:
    """Digest of plain values, arrays, dataclasses, sequences and mappings, of their types and their order.

    A session counts with its channels, phases and metadata; the rest of its log has no part in rows.
    """
    known: dict[int, bytes] = {}
    whole = hashlib.sha256()
    for thing in things:
        _add(thing, whole, known)
    return whole.digest()


def _add(thing: Any, whole: Any, known: dict[int, bytes]) -> None:
    if isinstance(thing, np.ndarray) and not thing.dtype.hasobject:
        if id(thing) not in known:  # blocks of a stretch share arrays
            known[id(thing)] = _of_array(thing)
        whole.update(known[id(thing)])
    elif isinstance(thing, _PLAIN):
        whole.update(f"{type(thing).__name__} {thing!r};".encode())
    elif isinstance(thing, Mapping):
        _add_all("mapping", [part for item in thing.items() for part in item], whole, known)
    elif isinstance(thing, Sequence):
        _add_all("sequence", thing, whole, known)
    elif isinstance(thing, (set, frozenset)):
        _add_all("set", sorted(thing, key=repr), whole, known)
    elif dataclasses.is_dataclass(thing) and not isinstance(thing, type):
        if isinstance(thing, Session):
            thing = dataclasses.replace(thing, status=None, controller_model=None, attachments={})
        parts = [getattr(thing, field.name) for field in dataclasses.fields(thing)]
        _add_all(type(thing).__qualname__, parts, whole, known)
    else:
        raise TypeError(f"{type(thing).__name__} has no plain content")


def _add_all(kind: str, parts: Sequence[Any], whole: Any, known: dict[int, bytes]) -> None:
    whole.update(f"{kind} of {len(parts)}:".encode())
    for part in parts:
        _add(part, whole, known)


def _of_array(array: np.ndarray) -> bytes:
    own = hashlib.sha256(f"array {array.shape} {array.dtype};".encode())
    if array.ndim:
        for some in spans(len(array)):
            own.update(np.ascontiguousarray(array[some]).data)
        release(array)
    else:
        own.update(array.tobytes())
    return own.digest()
