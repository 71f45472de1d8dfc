"""The shape of a file: a msgspec struct with the keys, types, ranges, defaults and meanings of a reader's dataclass."""

from __future__ import annotations

import dataclasses
import functools
import operator
import re
import types
import typing
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Union, cast

import msgspec

from lwr_driver.yaml_text import yaml_content

MEANINGS = Path(__file__).with_name("meanings.yaml")


@functools.cache
def meanings() -> dict[str, dict[str, str]]:
    """Meaning of each key in a sentence, by the name of its dataclass."""
    content: dict[str, dict[str, str]] = yaml_content(MEANINGS.read_text(encoding="utf-8"))
    return content


def plain(meaning: str) -> str:
    """A meaning without links."""
    return re.sub(r"\[([^]]+)\]\([^)]+\)", r"\1", meaning)


def title(cls: type) -> str:
    """Name of a dataclass in meanings and schemas."""
    return cls.__name__.lstrip("_")


def hints(cls: type, changed: Mapping[str, Any]) -> dict[str, Any]:
    """Type by key of a file; changed : types by `CLASS.key` in place of those declared, None for no key."""
    declared = typing.get_type_hints(cls, include_extras=True)
    keys = [field.name for field in dataclasses.fields(cls) if field.init]
    found = {key: changed.get(f"{title(cls)}.{key}", declared[key]) for key in keys}
    new = {name.split(".")[1]: hint for name, hint in changed.items() if name.startswith(f"{title(cls)}.")}
    return {key: hint for key, hint in ({**found, **new}).items() if hint is not None}


def default(cls: type, key: str, hint: Any) -> Any:
    """Default of a key: `msgspec.NODEFAULT` if it is required, `msgspec.UNSET` if it has none and may be missing."""
    field = next((field for field in dataclasses.fields(cls) if field.name == key), None)
    if field is None:
        # A key read elsewhere.
        parts = (hint, *typing.get_args(hint))
        return msgspec.NODEFAULT if dataclasses.is_dataclass(parts[-1]) else msgspec.UNSET
    if field.default_factory is not dataclasses.MISSING:
        return field.default_factory()
    return msgspec.NODEFAULT if field.default is dataclasses.MISSING else field.default


def shape(hint: Any, changed: Mapping[str, Any], made: dict[type, type]) -> Any:
    """A type with structs in place of dataclasses. made : those built so far."""
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if dataclasses.is_dataclass(hint) and isinstance(hint, type):
        return made[hint] if hint in made else _struct(hint, changed, made)
    if origin is Annotated:
        return cast(Any, Annotated)[(shape(arguments[0], changed, made), *arguments[1:])]
    inner = tuple(part if part is Ellipsis else shape(part, changed, made) for part in arguments)
    if origin in (Union, types.UnionType):
        return _union(inner)
    return cast(Any, origin)[inner] if origin in (tuple, dict) else hint


def _union(parts: Sequence[Any]) -> Any:
    """The union of types held by variables."""
    return functools.reduce(operator.or_, parts)


def word(hint: Any) -> str | None:
    """The only word that a key can have, such as the type of a motion; None for any other key."""
    words = typing.get_args(hint) if typing.get_origin(hint) is typing.Literal else ()
    return words[0] if len(words) == 1 and isinstance(words[0], str) else None


def _struct(cls: type, changed: Mapping[str, Any], made: dict[type, type]) -> type:
    fields: list[Any] = []
    tag: dict[str, Any] = {}
    for key, hint in hints(cls, changed).items():
        value = default(cls, key, hint)
        if value is msgspec.NODEFAULT and (only := word(hint)) is not None:
            tag = {"tag_field": key, "tag": only}
            continue
        text = plain(meanings().get(title(cls), {}).get(key, ""))
        inner = shape(hint, changed, made)
        if value is msgspec.UNSET:
            inner = _union([inner, msgspec.UnsetType])
        described = cast(Any, Annotated)[inner, msgspec.Meta(description=text)]
        if dataclasses.is_dataclass(value) or isinstance(value, dict):
            value = msgspec.field(default_factory=type(value))
        fields.append((key, described, value) if value is not msgspec.NODEFAULT else (key, described))
    made[cls] = msgspec.defstruct(title(cls), fields, forbid_unknown_fields=True, kw_only=True, **tag)
    return made[cls]
