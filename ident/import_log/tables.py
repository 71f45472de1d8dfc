"""Tables of numbers in files: text (CSV, one value a line), NPZ and NPY archives, MATLAB files."""

from __future__ import annotations

import bz2
import gzip
import lzma
import math
import zipfile
import zlib
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from fri.errors import DataError
from lwr_driver.session.spool import Growing

Floats = NDArray[np.float64]
_COMMENTS = ("#", "%")
_MISSING = ("", "NA", "N/A", "null", "NULL", "None")
# Beginning of a text that shows its layout, and longest part of it in memory.
_HEAD_BYTES, _BATCH_BYTES = 2**20, 2**23
# First bytes of compressed files.
_UNPACK: dict[bytes, Callable[[Path], Any]] = {
    b"\x1f\x8b": gzip.open,
    b"BZh": bz2.open,
    b"\xfd7zXZ\0": lzma.open,
}
_PACKED = frozenset({".gz", ".bz2", ".xz"})
_UNREADABLE = (OSError, EOFError, zlib.error, lzma.LZMAError)


@dataclass(frozen=True)
class Table:
    """Columns of a file: names (numbers from 1 without a header) and values (n, m)."""

    names: tuple[str, ...]
    values: Any


def unpacked(path: Path) -> Path:
    """The name without the suffix of a compression."""
    return path.with_suffix("") if path.suffix.lower() in _PACKED else path


def read_text(path: Path, delimiter: str | None = None, header: bool | None = None) -> Table:
    """A text table: comma, semicolon, tab or blanks, a decimal comma where the comma separates nothing; plain, or
    compressed by gzip, bzip2 or xz.

    header : whether the first row holds names; None decides by its content. Comment lines begin with # or %; the
    one before the numbers has the names if it has as many words as columns. Rows of words below the names, such as
    units, are passed over, and a column that begins with a word is nan. So is a missing value: an empty cell, or a word
    that other programs write for it. DataError with line and column.
    """
    long = _long(path, delimiter, header)
    if long is not None:
        return long
    layout = _layout(path, _lines(path), delimiter, header)
    rows, mark, width = layout.rows, layout.mark, layout.width
    values = _fast(rows, mark, width)
    if values is None:
        values = np.empty((len(rows), width))
        first = _split(rows[0][1], mark, width)
        words = {k for k, part in enumerate(first) if part not in _MISSING and not _is_number(part)}
        for index, (number, line) in enumerate(rows):
            parts = _split(line, mark, width)
            values[index] = _row(path, number, parts, width, layout.names, words if layout.named else set())
    return Table(layout.names or _numbers(width), values)


@dataclass(frozen=True)
class _Layout:
    """Names and mark between columns of a text, and its numbered rows of numbers, with points."""

    names: tuple[str, ...]
    named: bool
    mark: str | None
    width: int
    rows: list[tuple[int, str]]


def _layout(path: Path, lines: list[str], delimiter: str | None, header: bool | None) -> _Layout:
    rows = [(number, line) for number, line in enumerate(lines, 1) if line.strip()]
    comment = next((k for k, (_, line) in enumerate(rows) if line.lstrip()[0] not in _COMMENTS), len(rows))
    above = rows[comment - 1][1].strip().lstrip("".join(_COMMENTS)) if comment else ""
    rows = [(number, line) for number, line in rows[comment:] if line.lstrip()[0] not in _COMMENTS]
    first = rows[0][1] if rows else ""
    found = next((m for m in (";", ",", "\t") if m in first.strip()), None)
    mark = found if delimiter is None else delimiter
    point = "." if mark == "," else ","
    titled = bool(rows) and not any(map(_is_number, _split(first.replace(point, "."), mark)))
    if header and rows and not titled:
        raise DataError(f"{path}: the first row {first[:60]!r} holds numbers, no names; leave `header` out")
    named = titled if header is None else header
    if len(rows) < 1 + named:
        raise DataError(f"{path}: holds no rows of numbers")
    names = tuple(_split(first, mark)) if named else ()
    rows = [(number, line.replace(point, ".")) for number, line in rows[named:]]
    while named and len(rows) > 1 and not any(map(_is_number, _split(rows[0][1], mark))):
        rows = rows[1:]
    width = len(names) if named else len(_split(rows[0][1], mark))
    if not named and len(_split(above, mark)) == width and not all(map(_is_number, _split(above, mark))):
        names = tuple(_split(above, mark))
    return _Layout(names, named, mark, width, rows)


def _long(path: Path, delimiter: str | None, header: bool | None) -> Table | None:
    """A long plain table, batch after batch by pyarrow; None for a short one, and for one it cannot read."""
    try:
        with _opened(path) as file:
            head = file.read(_HEAD_BYTES)
            if len(head) < _HEAD_BYTES:
                return None
        text = head[: head.rindex(b"\n")].decode("utf-8-sig")
        layout = _layout(path, text.splitlines(), delimiter, header)
    except (*_UNREADABLE, ValueError, DataError):
        # The slow way says what is wrong.
        return None
    numbers = layout.rows[0][1]
    if layout.mark is None or len(layout.mark) != 1 or len(numbers.split(layout.mark)) != layout.width:
        return None
    decimal = "," if layout.mark != "," and "." not in text.splitlines()[layout.rows[0][0] - 1] else "."
    from pyarrow import ArrowException, csv, float64

    names = list(_numbers(layout.width))
    found = Growing()
    try:
        with (
            _opened(path) as file,
            csv.open_csv(
                file,
                read_options=csv.ReadOptions(
                    column_names=names,
                    skip_rows=layout.rows[0][0] - 1,
                    block_size=_BATCH_BYTES,
                    use_threads=False,
                ),
                parse_options=csv.ParseOptions(delimiter=layout.mark),
                convert_options=csv.ConvertOptions(
                    column_types=dict.fromkeys(names, float64()),
                    null_values=list(_MISSING),
                    decimal_point=decimal,
                ),
            ) as batches,
        ):
            for batch in batches:
                found.append(
                    np.column_stack([column.to_numpy(zero_copy_only=False) for column in batch.columns])
                )
    except (*_UNREADABLE, ArrowException, ValueError):
        return None
    return Table(layout.names or _numbers(layout.width), found.array())


def _opened(path: Path) -> IO[bytes]:
    """The bytes of a text file, unpacked where its first bytes say so."""
    with path.open("rb") as file:
        head = file.read(max(map(len, _UNPACK)))
    unpack = next((unpack for magic, unpack in _UNPACK.items() if head.startswith(magic)), None)
    return path.open("rb") if unpack is None else unpack(path)


def _lines(path: Path) -> list[str]:
    try:
        with _opened(path) as file:
            data = file.read()
    except _UNREADABLE as error:
        raise DataError(f"{path}: not readable as text: {error}") from error
    for encoding in ("utf-16",) if data[:2] in (b"\xff\xfe", b"\xfe\xff") else ("utf-8-sig", "cp1252"):
        try:
            text = data.decode(encoding)
        except UnicodeDecodeError:
            continue
        if "\0" not in text:
            return text.splitlines()
    raise DataError(f"{path}: not readable as text, neither UTF-8 nor Windows text")


def _numbers(width: int) -> tuple[str, ...]:
    return tuple(str(k + 1) for k in range(width))


def _fast(rows: list[tuple[int, str]], mark: str | None, width: int) -> Floats | None:
    """The table by numpy's own reader; None unless every row is a plain row of numbers."""
    try:
        values = np.loadtxt(
            [line.strip().rstrip(mark or " ") for _, line in rows], delimiter=mark, ndmin=2, comments=None
        )
    except ValueError:
        return None
    return values if values.shape == (len(rows), width) else None


def _split(line: str, mark: str | None, width: int = 1) -> list[str]:
    """The cells of a line, without an empty one behind the `width` that it has at least."""
    parts = [part.strip().strip('"') for part in line.strip(" \r\n" if mark == "\t" else None).split(mark)]
    return parts[:-1] if len(parts) > width and parts[-1] == "" else parts


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _row(
    path: Path, number: int, parts: list[str], width: int, names: tuple[str, ...], words: Collection[int]
) -> list[float]:
    """The numbers of a row; those missing and of the columns `words` are nan."""
    if len(parts) != width:
        raise DataError(
            f"{path}: line {number} has {len(parts)} columns, the first has {width}; the file is not whole"
        )
    values = []
    for index, part in enumerate(parts):
        if index in words or part in _MISSING:
            values.append(math.nan)
            continue
        if not _is_number(part):
            column = names[index] if names else str(index + 1)
            raise DataError(f"{path}: line {number}, column {column!r} holds {part!r}; a number is needed")
        values.append(float(part))
    return values


def read_arrays(path: Path) -> dict[str, Table]:
    """The arrays of an NPZ, NPY or MATLAB file by name, those of structures as `structure.field`.

    One-dimensional arrays have one column. DataError for an unreadable file.
    """
    arrays = _READERS[path.suffix.lower()](path)
    tables = {}
    for name, values in arrays.items():
        if values.dtype.kind in "fiub" and values.ndim in (1, 2) and values.size:
            values = values.reshape(len(values), -1).astype(np.float64)
            tables[name] = Table(_numbers(values.shape[1]), values)
        else:
            tables[name] = Table((), values)
    return tables


def _numpy_arrays(path: Path) -> dict[str, Any]:
    try:
        with path.open("rb") as file:
            found = np.load(file, allow_pickle=False)
            if isinstance(found, np.ndarray):
                return {path.stem: found}
            return {key: found[key] for key in found.files}
    except (OSError, ValueError, zipfile.BadZipFile, EOFError) as error:
        raise DataError(f"{path}: not a readable {path.suffix[1:].upper()} archive: {error}") from error


def _matlab_arrays(path: Path) -> dict[str, Any]:
    from scipy.io import loadmat
    from scipy.io.matlab import MatReadError

    try:
        content = loadmat(path, simplify_cells=True)
    except NotImplementedError:
        raise DataError(
            f"{path}: a MATLAB file of version 7.3 (HDF5); save it again with `save('{path.name}', '-v7')`"
        ) from None
    except (OSError, ValueError, TypeError, KeyError, IndexError, EOFError, MatReadError) as error:
        raise DataError(f"{path}: not a readable MATLAB file: {error}") from error
    found: dict[str, Any] = {}

    def collect(name: str, value: Any) -> None:
        if isinstance(value, Mapping):
            for key, item in value.items():
                collect(f"{name}.{key}" if name else str(key), item)
        elif isinstance(value, np.ndarray):
            found[name] = value

    collect("", {key: value for key, value in content.items() if not key.startswith("__")})
    return found


_READERS: dict[str, Callable[[Path], dict[str, Any]]] = {
    ".npz": _numpy_arrays,
    ".npy": _numpy_arrays,
    ".mat": _matlab_arrays,
}
ARCHIVES = frozenset(_READERS)
"""Suffixes of files with named arrays."""
