"""Reading YAML files into frozen dataclasses, with errors that name the file, the key and the remedy."""

from __future__ import annotations

import contextlib
import dataclasses
import difflib
import math
import os
import reprlib
import types
import typing
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Annotated, Any, TypeVar

import yaml

from fri.errors import ConfigurationError
from fri.quantities import LONGEST_LIST, LONGEST_TEXT, check_value, check_values, metas
from lwr_driver.places import Place
from lwr_driver.references import frozen_file, note
from lwr_driver.yaml_text import Dumper, RepeatedKeyError, yaml_content

CONFIGS = Path(__file__).resolve().parents[1] / "configs"

_LONGEST_SHOWN = 80
_LONGEST_PATH = 1000
_LARGEST_FILE = 50_000_000  # [bytes]

T = TypeVar("T")


def yaml_text(content: Any) -> str:
    """Plain content as YAML that `read_yaml` reads back, keys in their order."""
    return yaml.dump(
        content, Dumper=Dumper, sort_keys=False, allow_unicode=True, default_flow_style=None, width=120
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

    beside : folder of the file naming it; the name is looked for there, then in the project's `configs/`, never in
    the working directory. In the frozen files of an experiment only the files of its start are found.
    None for a name from the command line: the working directory, then `configs/`.

    Raises ConfigurationError with the places tried.
    """
    try:
        wanted = as_path(name, "configuration file").expanduser()
    except RuntimeError as error:
        raise ConfigurationError(f"file {_shown(name)!r} cannot be looked for: {error}") from error
    frozen = None if beside is None else frozen_file(beside, str(name))
    if frozen is not None:
        return frozen
    folders = [Path.cwd() if beside is None else beside, CONFIGS]
    places = [wanted] if wanted.is_absolute() else [folder / wanted for folder in folders]
    for place in places:
        try:
            if place.is_file():
                found = place.resolve()
                note(beside, str(name), found)
                return found
        except OSError as error:
            raise ConfigurationError(
                f"file {_shown(name)!r} cannot be looked for: {error.strerror}"
            ) from error
    folder = next((place for place in places if place.is_dir()), None)
    if folder is not None:
        inside = sorted(path.name for path in folder.glob("*.yaml"))[:5]
        named = f"name a file in it: {', '.join(inside)}" if inside else "name a file"
        raise ConfigurationError(f"{_shown(name)} is a folder; {named}")
    tried = ", ".join(_shown(place, 4 * _LONGEST_SHOWN) for place in places)
    raise ConfigurationError(f"file {_shown(name)!r} not found; tried {tried}; {_near(wanted, places)}")


def _near(wanted: Path, places: Iterable[Path]) -> str:
    """Advice on a name of no file: one that is near, if there is any."""
    there: list[str] = []
    for folder in (place.parent for place in places):
        with contextlib.suppress(OSError):
            there += (entry.name for entry in folder.iterdir() if entry.is_file())
    near = difflib.get_close_matches(wanted.name, there, n=1)
    return f"did you mean {wanted.with_name(near[0])}?" if near else "correct the name"


def _shown(name: str | Path, longest: int = _LONGEST_SHOWN) -> str:
    """The beginning of a long name, for a message."""
    text = str(name)
    return text if len(text) <= longest else f"{text[:longest]}..."


def read_text(path: Path) -> str:
    """Text of a configuration file; ConfigurationError if it cannot be read or is far too large."""
    if path.is_dir():
        raise ConfigurationError(f"{path}: is a folder; give a file in it")
    try:
        size = path.stat().st_size
        if size > _LARGEST_FILE:
            raise ConfigurationError(
                f"{path}: {size / 1e6:.0f} MB, limit {_LARGEST_FILE / 1e6:.0f} MB; this is no configuration file"
            )
        return path.read_text(encoding="utf-8")
    except (OSError, ValueError) as error:
        if isinstance(error, ConfigurationError):
            raise
        raise ConfigurationError(f"{path}: cannot be read: {error}") from error


def read_yaml(path: Path) -> Any:
    """Parsed content of a YAML file (safe types only), with the position of a syntax error in the message."""
    text = read_text(path)
    try:
        return yaml_content(text)
    except RepeatedKeyError as error:
        raise ConfigurationError(f"{path}:{error.second}: {error}; keep one of them") from error
    except (yaml.YAMLError, ValueError, RecursionError, AttributeError, TypeError) as error:
        mark = getattr(error, "problem_mark", None)
        where = path if mark is None else f"{path}:{mark.line + 1}"
        raise ConfigurationError(f"{where}: not valid YAML: {error}") from error


def read_mapping(path: Path) -> dict[str, Any]:
    """Parsed content of a YAML file with a mapping at its top level."""
    content = read_yaml(path)
    if not isinstance(content, dict):
        raise ConfigurationError(f"{path}: the top level must be a mapping of keys, found {_kind(content)}")
    return content


def parse(cls: type[T], content: Any, where: str | Path | Place) -> T:
    """Build the dataclass `cls` from `content`; unknown or missing keys and wrong types are errors.

    Understood: nested dataclasses, `tuple[X, ...]`, fixed tuples, `dict[str, X]`, `X | None`, `Literal`,
    bool, int, float, str and Path; numbers must be finite and within the range declared beside their key
    (`fri.quantities`). where : file of the content, for messages with its line, or a text; also in front of an
    error of the dataclass's own `__post_init__`.
    """
    place = Place.of(where)
    if not isinstance(content, Mapping):
        raise ConfigurationError(f"{place}: expected a mapping of keys, found {_kind(content)}")
    hints = typing.get_type_hints(cls, include_extras=True)
    fields = {field.name: field for field in dataclasses.fields(typing.cast(Any, cls)) if field.init}
    for key in content:
        if key not in fields:
            near = difflib.get_close_matches(_shown(str(key)), fields, n=1, cutoff=0.5)
            advice = f"did you mean `{near[0]}`?" if near else f"known keys: {', '.join(fields)}"
            raise ConfigurationError(f"{place.line_of(str(key))}: unknown key `{_shown(str(key))}`; {advice}")
    values = {}
    for name, field in fields.items():
        if name in content:
            values[name] = _convert(hints[name], content[name], place.key(name))
        elif field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING:
            raise ConfigurationError(f"{place}: key `{name}` is missing")
    try:
        return cls(**values)
    except ConfigurationError as error:
        raise ConfigurationError(f"{place.named_in(str(error), content)}: {error}") from error


def _convert(hint: Any, value: Any, where: Place) -> Any:
    if typing.get_origin(hint) is Annotated:
        inner, ranges = metas(hint)
        converted = _convert(inner, value, where)
        check_value(converted, ranges, where)
        return converted
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if hint is Any:
        return value
    if origin in (typing.Union, types.UnionType):
        return _convert_union(arguments, value, where)
    if origin is typing.Literal:
        if not any(value is word or (type(value) is type(word) and value == word) for word in arguments):
            near = difflib.get_close_matches(
                _plain(value).lower(), [str(word).lower() for word in arguments], n=1
            )
            meant = next((word for word in arguments if [str(word).lower()] == near), None)
            hint = "" if meant is None else f"; did you mean `{meant}`?"
            raise ConfigurationError(
                f"{where}: {_plain(value)!r} is not one of {', '.join(map(str, arguments))}{hint}"
            )
        return value
    if origin is tuple:
        return _convert_tuple(arguments, value, where)
    if origin is dict:
        if not isinstance(value, Mapping):
            raise ConfigurationError(f"{where}: expected a mapping, found {_kind(value)}")
        return {
            str(key): _convert(arguments[1], item, where.key(str(key), f".{_shown(str(key))}"))
            for key, item in value.items()
        }
    if dataclasses.is_dataclass(hint):
        return parse(typing.cast(type, hint), value, where)
    return _convert_scalar(hint, value, where)


def _convert_union(options: tuple[Any, ...], value: Any, where: Place) -> Any:
    if value is None and type(None) in options:
        return None
    failures = []
    known = [option for option in options if option is not type(None)]
    for option in sorted(known, key=lambda option: not _alike(option, value)):
        try:
            return _convert(option, value, where)
        except ConfigurationError as error:
            failures.append(error)
    raise failures[0]


def _alike(hint: Any, value: Any) -> bool:
    """Whether a value is of the kind of a hint, whatever its content."""
    hint = metas(hint)[0]
    origin = typing.get_origin(hint)
    if isinstance(value, Mapping):
        return origin is dict or dataclasses.is_dataclass(hint)
    if isinstance(value, (list, tuple)):
        return origin is tuple
    if isinstance(value, str):
        return hint in (str, Path) or origin is typing.Literal
    return hint is type(value) or (hint is float and isinstance(value, int))


def _convert_tuple(arguments: tuple[Any, ...], value: Any, where: Place) -> tuple[Any, ...]:
    if not isinstance(value, (list, tuple)):
        raise ConfigurationError(f"{where}: expected a list, found {_kind(value)}")
    alike = len(arguments) == 2 and arguments[1] is Ellipsis
    if alike and len(value) > LONGEST_LIST:
        raise ConfigurationError(f"{where}: {len(value)} entries, limit {LONGEST_LIST}; shorten the list")
    kinds = [metas(arguments[0])] * len(value) if alike else [metas(hint) for hint in arguments]
    if len(value) != len(kinds):
        raise ConfigurationError(f"{where}: expected {len(kinds)} entries, found {len(value)}")
    if alike and kinds and kinds[0][0] is float and all(map(_is_number, value)):
        # The long lists: nothing is said of a single entry but its range.
        numbers = tuple(map(float, value))
        check_values(numbers, kinds[0][1], where)
        return numbers
    converted = tuple(
        _convert(kind, item, where.entry(index, _label(item, index)))
        for index, ((kind, _), item) in enumerate(zip(kinds, value, strict=True))
    )
    for _, ranges in kinds[:1]:
        check_values(converted, ranges, where)
    for index, ((_, ranges), item) in enumerate(zip(kinds, converted, strict=True)):
        check_value(item, ranges, where.entry(index))
    return converted


def _is_number(value: Any) -> bool:
    """Whether a value is a finite number of usual size."""
    return (type(value) is float and math.isfinite(value)) or (type(value) is int and abs(value) < 2**53)


def _label(item: Any, index: int) -> str:
    """The name of an entry of a list, or its index."""
    name = item.get("name") if isinstance(item, Mapping) else None
    return _shown(name) if isinstance(name, str) and name.isprintable() else str(index)


def _convert_scalar(hint: Any, value: Any, where: Place) -> Any:
    if hint is float and isinstance(value, (int, float)) and not isinstance(value, bool):
        try:
            number = float(value)
        except OverflowError:
            number = math.inf
        if not math.isfinite(number):
            raise ConfigurationError(f"{where}: {_plain(value)} is not a finite number of usual size")
        return number
    longest = LONGEST_TEXT if hint is str else _LONGEST_PATH
    if isinstance(value, str) and (len(value) > longest or "\0" in value):
        raise ConfigurationError(
            f"{where}: a text of {len(value)} characters, limit {longest}, without zero bytes; shorten it"
        )
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
    raise ConfigurationError(
        f"{where}: expected {expected.get(hint, hint)}, found {_found(value)}{_as_number(hint, value)}"
    )


def _as_number(hint: Any, value: Any) -> str:
    """How to write a number that YAML reads as a text, such as 1e6, or as one with a fraction; "" for others."""
    try:
        number = float(value) if hint in (int, float) and not isinstance(value, bool) else math.nan
    except (TypeError, ValueError, OverflowError):
        return ""
    if not math.isfinite(number) or abs(number) >= 2**53 or (hint is int and not number.is_integer()):
        return ""
    return f"; write {int(number)}" if number.is_integer() else f"; write {number!r}"


def _plain(value: Any) -> str:
    """A value of any size and depth in a message."""
    if isinstance(value, str):
        return _shown(value)
    try:
        return _shown(reprlib.repr(value))
    except ValueError:  # a whole number too long to be written
        return "a very long number"


def _found(value: Any) -> str:
    return (
        f"{_kind(value)} {_plain(value)!r}" if isinstance(value, str) else f"{_kind(value)} {_plain(value)}"
    )


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
