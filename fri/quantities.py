"""Ranges and units of the numbers in files, declared beside each key: `mass: Annotated[float, within(0, 14, "kg")]`.

A range is a `msgspec.Meta`, so `msgspec.json.schema` finds it, too. `configuration.parse` enforces it for files,
`check` for objects built in Python. A value outside its range, but inside it in another usual unit (degrees for
radians, millimetres for metres, grams for kilograms), is named as such with the mended value.
"""

from __future__ import annotations

import dataclasses
import math
import typing
from collections.abc import Hashable, Iterator, Sequence
from functools import cache
from typing import Annotated, Any, cast

from msgspec import Meta

from fri.errors import ConfigurationError

LONGEST_TEXT = 1_000_000
LONGEST_LIST = 10_000

_DEGREE = math.pi / 180.0
#: By unit: the units often given in its place, with the factor to the right one.
MISTAKEN: dict[str, tuple[tuple[str, float], ...]] = {
    "rad": (("deg", _DEGREE),),
    "rad/s": (("deg/s", _DEGREE),),
    "rad/s²": (("deg/s²", _DEGREE),),
    "rad/s³": (("deg/s³", _DEGREE),),
    "deg": (("rad", 1.0 / _DEGREE),),
    "deg/s": (("rad/s", 1.0 / _DEGREE),),
    "m": (("mm", 1e-3), ("cm", 1e-2)),
    "kg": (("g", 1e-3),),
    "s": (("ms", 1e-3),),
    "kg m²": (("kg cm²", 1e-4), ("kg mm²", 1e-6)),
    "share": (("percent", 1e-2),),
}


def within(
    low: float, high: float, unit: str = "", *, above: bool = False, below: bool = False, note: str = ""
) -> Meta:
    """Range of a number for `Annotated`, ends included unless `above` the low or `below` the high end.

    unit : of the number; "share" for a factor from 0 to 1. note : reason of the limit, for the error message.
    """
    ends: dict[str, Any] = {"gt" if above else "ge": low, "lt" if below else "le": high}
    return Meta(
        **ends, extra={"unit": unit, "note": note}, extra_json_schema={"unit": unit} if unit else None
    )


def entries(least: int, most: int) -> Meta:
    """Number of entries of a list, or of characters of a text, for `Annotated`."""
    return Meta(min_length=least, max_length=most)


Name = Annotated[str, entries(1, 64)]
FileName = Annotated[str, entries(1, 1000)]
Version = Annotated[int, within(1, 1, note="this software reads 1")]
Share = Annotated[float, within(0.0, 1.0, "share", above=True)]
"""A factor above 0, 1 at most."""


def metas(hint: Any) -> tuple[Any, tuple[Meta, ...]]:
    """The type behind `Annotated`, and its ranges."""
    if typing.get_origin(hint) is not Annotated:
        return hint, ()
    inner, *extra = typing.get_args(hint)
    return inner, tuple(entry for entry in extra if isinstance(entry, Meta))


def check_value(value: Any, ranges: Sequence[Meta], subject: object) -> None:
    """Raise ConfigurationError unless a number, a text or a list of values keeps its ranges."""
    for meta in ranges:
        if meta.min_length is not None or meta.max_length is not None:
            _check_length(value, meta.min_length or 0, meta.max_length or LONGEST_LIST, subject)
        elif isinstance(value, (int, float)) and not isinstance(value, bool) and not _inside(value, meta):
            raise ConfigurationError(_complaint(value, value, meta, subject))


def check_values(values: Sequence[Any], ranges: Sequence[Meta], subject: object) -> None:
    """The same for each number of a list; a mistaken unit is mended for the whole list."""
    for meta in ranges:
        for index, value in enumerate(values):
            if isinstance(value, (int, float)) and not isinstance(value, bool) and not _inside(value, meta):
                raise ConfigurationError(_complaint(value, list(values), meta, f"{subject}[{index}]"))


def check(owner: Any) -> None:
    """Raise ConfigurationError unless every number and text of a dataclass keeps the range of its key."""
    for name, hint in _declared(cast(Hashable, type(owner))):
        _check_hint(hint, getattr(owner, name), f"`{name}`")


def suspected(value: Any, unit: str, inside: typing.Callable[[float], bool]) -> str:
    """Sentence on a value that is right in another unit, or "". value : a number or a list of numbers."""
    listed = value if isinstance(value, list) else [value]
    fitting = []
    for other, factor in MISTAKEN.get(unit, ()):
        mended = [factor * number for number in listed]
        if all(inside(number) for number in mended):
            shown = ", ".join(f"{number:.4g}" for number in mended)
            fitting.append((other, f"[{shown}]" if listed is value else shown))
    if not fitting:
        return ""
    others, values = (" or ".join(texts) for texts in zip(*fitting, strict=True))
    wanted = "as a share of 1" if unit == "share" else f"in {unit}"
    return f"it looks like {others}; write it {wanted}: {values}"


def described(meta: Meta) -> str:
    """A range in words: `0.5 to 60 s`, `above 0 to 14 kg`."""
    unit = "" if (extra := _extra(meta)["unit"]) in ("", "share") else f" {extra}"
    if meta.ge is not None and meta.ge == meta.le:
        return f"{_end(meta.ge)}{unit}"
    low = f"above {_end(meta.gt)}" if meta.gt is not None else _end(meta.ge)
    high = f"below {_end(meta.lt)}" if meta.lt is not None else _end(meta.le)
    return f"{low} to {high}{unit}"


def _end(value: Any) -> str:
    """An end of a range; a whole number without an exponent, which YAML may read as a text."""
    whole = isinstance(value, int) or (float(value).is_integer() and abs(value) < 1e9)
    return str(int(value)) if whole else f"{value:g}"


def _extra(meta: Meta) -> dict[str, str]:
    return meta.extra or {"unit": "", "note": ""}


def _complaint(value: float, whole: Any, meta: Meta, subject: object) -> str:
    extra = _extra(meta)
    unit = "" if extra["unit"] in ("", "share") else f" {extra['unit']}"
    advice = suspected(whole, extra["unit"], lambda number: _inside(number, meta))
    reason = f" ({extra['note']})" if extra["note"] else ""
    return f"{subject}: {_shown(value)}{unit} is outside {described(meta)}{reason}" + (
        f"; {advice}" if advice else "; give a value in this range"
    )


def _shown(value: float) -> str:
    """A number in a message; a very long whole number by its size."""
    if isinstance(value, int) and abs(value) >= 10**18:
        return f"a number of {value.bit_length() * 0.30103:.0f} digits"
    return str(value)


def _inside(value: float, meta: Meta) -> bool:
    if isinstance(value, float) and not math.isfinite(value):
        return False
    return not (
        (meta.ge is not None and value < meta.ge)
        or (meta.gt is not None and value <= meta.gt)
        or (meta.le is not None and value > meta.le)
        or (meta.lt is not None and value >= meta.lt)
    )


def _check_length(value: Any, least: int, most: int, subject: object) -> None:
    if not isinstance(value, (str, list, tuple, dict)) or least <= len(value) <= most:
        return
    kind = "characters" if isinstance(value, str) else "entries"
    raise ConfigurationError(
        f"{subject}: {len(value)} {kind}, limits {least} and {most}; "
        + ("shorten it" if len(value) > most else "give more")
    )


@cache
def _declared(cls: Hashable) -> tuple[tuple[str, Any], ...]:
    hints = typing.get_type_hints(cast(Any, cls), include_extras=True)
    return tuple(
        (field.name, hints[field.name]) for field in dataclasses.fields(cast(Any, cls)) if field.init
    )


def _check_hint(hint: Any, value: Any, subject: object) -> None:
    hint, ranges = metas(hint)
    check_value(value, ranges, subject)
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin is tuple and isinstance(value, (tuple, list)):
        for inner in _entry_hints(arguments):
            kind, own = metas(inner)
            check_values(value, own, subject)
            if typing.get_origin(kind) is tuple:
                for index, entry in enumerate(value):
                    _check_hint(kind, entry, f"{subject}[{index}]")
            break
    elif value is not None and origin is not None and origin is not dict:
        for option in arguments:
            if typing.get_origin(option) in (Annotated, tuple):
                _check_hint(option, value, subject)


def _entry_hints(arguments: tuple[Any, ...]) -> Iterator[Any]:
    yield from (argument for argument in arguments if argument is not Ellipsis)
