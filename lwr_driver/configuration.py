"""Reading YAML files into frozen dataclasses, with errors that name the file, the key and the remedy."""

from __future__ import annotations

import dataclasses
import difflib
import math
import os
import re
import types
import typing
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar

import yaml

from fri.errors import ConfigurationError

CONFIGS = Path(__file__).resolve().parents[1] / "configs"

_LONGEST_SHOWN = 80

T = TypeVar("T")


class _Loader(yaml.SafeLoader):
    """SafeLoader with the numbers of YAML 1.2: `5e-05` is one too, without a point and without a sign."""


class _Dumper(yaml.SafeDumper):
    """SafeDumper that quotes every text `_Loader` would read as a number."""


for _kind_of_yaml in (_Loader, _Dumper):
    _kind_of_yaml.add_implicit_resolver(
        "tag:yaml.org,2002:float",
        re.compile(r"^[-+]?(?:[0-9][0-9_]*\.?[0-9_]*|\.[0-9][0-9_]*)[eE][-+]?[0-9]+$"),
        list("-+.0123456789"),
    )


def yaml_text(content: Any) -> str:
    """Plain content as YAML that `read_yaml` reads back, keys in their order."""
    return yaml.dump(
        content, Dumper=_Dumper, sort_keys=False, allow_unicode=True, default_flow_style=None, width=120
    )


def expect(value: Any, kind: type, subject: str, advice: str) -> None:
    """Raise ConfigurationError, with the advice, unless `value` is of the type `kind`."""
    if not isinstance(value, kind):
        raise ConfigurationError(f"{subject}: expected {_called(kind)}, found {_found(value)}; {advice}")


def as_path(value: Any, subject: str) -> Path:
    """`value` as a path; ConfigurationError unless it is a text or a path."""
    path = os.fspath(value) if isinstance(value, (str, os.PathLike)) else None
    if not isinstance(path, str):
        raise ConfigurationError(
            f"{subject}: expected a path, found {_found(value)}; give it as text or pathlib.Path"
        )
    return Path(path)


def find(name: str | Path, *, beside: Path | None = None) -> Path:
    """Path of the configuration file `name`.

    Tried in order: the working directory, the folder `beside` of the file naming it, the project's
    `configs/`. Raises ConfigurationError with the places tried.
    """
    try:
        wanted = as_path(name, "configuration file").expanduser()
    except RuntimeError as error:
        raise ConfigurationError(f"file {_shown(name)!r} cannot be looked for: {error}") from error
    folders = [Path.cwd(), *([] if beside is None else [beside]), CONFIGS]
    places = [wanted] if wanted.is_absolute() else [folder / wanted for folder in folders]
    for place in places:
        try:
            if place.is_file():
                return place.resolve()
        except OSError as error:
            raise ConfigurationError(
                f"file {_shown(name)!r} cannot be looked for: {error.strerror}"
            ) from error
    tried = ", ".join(str(place) for place in places)
    raise ConfigurationError(f"file {str(name)!r} not found; tried {tried}")


def _shown(name: str | Path) -> str:
    """The beginning of a long name, for a message."""
    text = str(name)
    return text if len(text) <= _LONGEST_SHOWN else f"{text[:_LONGEST_SHOWN]}..."


def read_yaml(path: Path) -> Any:
    """Parsed content of a YAML file (safe types only), with the position of a syntax error in the message."""
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigurationError(f"{path}: cannot be read: {error}") from error
    try:
        return yaml.load(text, _Loader)
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise ConfigurationError(f"{path}: not valid YAML: {error}") from error


def read_mapping(path: Path) -> dict[str, Any]:
    """Parsed content of a YAML file with a mapping at its top level."""
    content = read_yaml(path)
    if not isinstance(content, dict):
        raise ConfigurationError(f"{path}: the top level must be a mapping of keys, found {_kind(content)}")
    return content


def parse(cls: type[T], content: Any, where: str) -> T:
    """Build the dataclass `cls` from `content`; unknown or missing keys and wrong types are errors.

    Understood: nested dataclasses, `tuple[X, ...]`, fixed tuples, `dict[str, X]`, `X | None`, `Literal`,
    bool, int, float, str and Path; numbers must be finite. `where` names the file, also in front of an error
    of the dataclass's own `__post_init__`.
    """
    if not isinstance(content, Mapping):
        raise ConfigurationError(f"{where}: expected a mapping of keys, found {_kind(content)}")
    hints = typing.get_type_hints(cls)
    fields = {field.name: field for field in dataclasses.fields(typing.cast(Any, cls)) if field.init}
    for key in content:
        if key not in fields:
            near = difflib.get_close_matches(str(key), fields, n=1, cutoff=0.5)
            advice = f"did you mean `{near[0]}`?" if near else f"known keys: {', '.join(fields)}"
            raise ConfigurationError(f"{where}: unknown key `{key}`; {advice}")
    values = {}
    for name, field in fields.items():
        if name in content:
            values[name] = _convert(hints[name], content[name], f"{where}: `{name}`")
        elif field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING:
            raise ConfigurationError(f"{where}: key `{name}` is missing")
    try:
        return cls(**values)
    except ConfigurationError as error:
        raise ConfigurationError(f"{where}: {error}") from error


def _convert(hint: Any, value: Any, where: str) -> Any:
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if hint is Any:
        return value
    if origin in (typing.Union, types.UnionType):
        return _convert_union(arguments, value, where)
    if origin is typing.Literal:
        if value not in arguments:
            near = difflib.get_close_matches(
                str(value).lower(), [str(word).lower() for word in arguments], n=1
            )
            meant = next((word for word in arguments if [str(word).lower()] == near), None)
            hint = "" if meant is None else f"; did you mean `{meant}`?"
            raise ConfigurationError(
                f"{where}: {value!r} is not one of {', '.join(map(str, arguments))}{hint}"
            )
        return value
    if origin is tuple:
        return _convert_tuple(arguments, value, where)
    if origin is dict:
        if not isinstance(value, Mapping):
            raise ConfigurationError(f"{where}: expected a mapping, found {_kind(value)}")
        return {str(key): _convert(arguments[1], item, f"{where}.{key}") for key, item in value.items()}
    if dataclasses.is_dataclass(hint):
        return parse(typing.cast(type, hint), value, where)
    return _convert_scalar(hint, value, where)


def _convert_union(options: tuple[Any, ...], value: Any, where: str) -> Any:
    if value is None and type(None) in options:
        return None
    failures = []
    for option in options:
        if option is type(None):
            continue
        try:
            return _convert(option, value, where)
        except ConfigurationError as error:
            failures.append(error)
    raise failures[0]


def _convert_tuple(arguments: tuple[Any, ...], value: Any, where: str) -> tuple[Any, ...]:
    if not isinstance(value, (list, tuple)):
        raise ConfigurationError(f"{where}: expected a list, found {_kind(value)}")
    if len(arguments) == 2 and arguments[1] is Ellipsis:
        return tuple(_convert(arguments[0], item, f"{where}[{index}]") for index, item in enumerate(value))
    if len(value) != len(arguments):
        raise ConfigurationError(f"{where}: expected {len(arguments)} entries, found {len(value)}")
    return tuple(
        _convert(hint, item, f"{where}[{index}]")
        for index, (hint, item) in enumerate(zip(arguments, value, strict=True))
    )


def _convert_scalar(hint: Any, value: Any, where: str) -> Any:
    if hint is float and isinstance(value, (int, float)) and not isinstance(value, bool):
        if not math.isfinite(value):
            raise ConfigurationError(f"{where}: {value} is not a finite number")
        return float(value)
    if hint is Path and isinstance(value, str):
        return Path(value)
    if hint in (int, str, bool) and type(value) is hint:
        return value
    expected = {
        float: "a number",
        int: "a whole number",
        str: "a text",
        bool: "true or false",
        Path: "a path",
    }
    raise ConfigurationError(f"{where}: expected {expected.get(hint, hint)}, found {_kind(value)} {value!r}")


def _found(value: Any) -> str:
    return f"{_kind(value)} {_shown(repr(value))}"


def _called(kind: type) -> str:
    return f"{'an' if kind.__name__[0] in 'AEIOU' else 'a'} {kind.__name__}"


def _kind(value: Any) -> str:
    names = {
        dict: "a mapping",
        list: "a list",
        str: "the text",
        bool: "the truth value",
        type(None): "nothing",
    }
    return names.get(type(value), f"the {type(value).__name__}")
