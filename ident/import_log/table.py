"""Recordings as named columns: CSV (any delimiter, with or without header) and NPZ; refused if not whole."""

from __future__ import annotations

import hashlib
import zipfile
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fri.errors import DataError
from ident.import_log.mapping import Signal

__all__ = ["Recording"]

FloatArray = NDArray[np.float64]


@dataclass
class Recording:
    """The files of a recording, each read once.

    source : a file, or the folder of the files that the mapping names.
    """

    source: Path
    delimiter: str | None = None
    header: bool = True
    _tables: dict[Path, tuple[tuple[str, ...], FloatArray]] = field(default_factory=dict, repr=False)
    _archives: dict[Path, dict[str, FloatArray]] = field(default_factory=dict, repr=False)
    _digests: dict[Path, str] = field(default_factory=dict, repr=False)

    def path(self, file: str | None) -> Path:
        """The file that a signal names, or the source itself."""
        if file is None:
            if self.source.is_dir():
                raise DataError(
                    f"{self.source} is a folder and the mapping names no `file`; give the file itself"
                )
            path = self.source
        else:
            path = (self.source if self.source.is_dir() else self.source.parent) / file
        if not path.is_file():
            raise DataError(f"{path}: no such file; the mapping needs it")
        return path

    @property
    def digests(self) -> dict[str, str]:
        """SHA-256 of every file read, by name."""
        return {path.name: digest for path, digest in self._digests.items()}

    def column(self, file: str | None, column: str | int) -> FloatArray:
        """One column (n,), or one-dimensional NPZ array."""
        path = self.path(file)
        if path.suffix == ".npz":
            values = self._array(path, str(column))
            values = values.reshape(-1) if values.ndim == 2 and 1 in values.shape else values
            if values.ndim != 1:
                raise DataError(
                    f"{path}: array {column!r} has shape {values.shape}; times are one-dimensional"
                )
            return values
        names, values = self._table(path)
        return values[:, _number(path, names, column)]

    def columns(self, signal: Signal, joints: int, what: str) -> FloatArray:
        """The columns (n, joints) of a signal, as they stand in the file."""
        path = self.path(signal.file)
        if path.suffix == ".npz":
            if signal.array is None:
                raise DataError(f"{path}: `{what}` needs `array`, the name of the array in the archive")
            values = self._array(path, signal.array)
            label = f"{path}: array {signal.array!r}"
            names = tuple(str(k + 1) for k in range(values.shape[-1]))
        else:
            if signal.array is not None:
                raise DataError(
                    f"{path}: `{what}` names the array {signal.array!r}, but the file is no NPZ archive"
                )
            names, values = self._table(path)
            label = str(path)
        if values.ndim != 2:
            raise DataError(
                f"{label} has shape {values.shape}; rows of samples with a column for each joint are needed"
            )
        if signal.columns is not None:
            return values[:, [_number(path, names, column) for column in signal.columns]]
        if values.shape[1] != joints:
            raise DataError(
                f"{label} has {values.shape[1]} columns for {joints} joints; "
                f"name them in `columns` of `{what}`"
            )
        return values

    def _array(self, path: Path, name: str) -> FloatArray:
        if path not in self._archives:
            self._digest(path)
            try:
                with np.load(path, allow_pickle=False) as archive:
                    self._archives[path] = {key: archive[key] for key in archive.files}
            except (OSError, ValueError, zipfile.BadZipFile, EOFError) as error:
                raise DataError(f"{path}: not a readable NPZ archive: {error}") from error
        arrays = self._archives[path]
        if name not in arrays:
            raise DataError(f"{path}: no array {name!r}; it has {', '.join(arrays)}")
        values = arrays[name]
        if values.dtype.kind not in "fiu":
            raise DataError(f"{path}: array {name!r} has type {values.dtype}; numbers are needed")
        return values.astype(np.float64)

    def _table(self, path: Path) -> tuple[tuple[str, ...], FloatArray]:
        if path not in self._tables:
            self._digest(path)
            self._tables[path] = _read_csv(path, self.delimiter, self.header)
        return self._tables[path]

    def _digest(self, path: Path) -> None:
        try:
            self._digests[path] = hashlib.sha256(path.read_bytes()).hexdigest()
        except OSError as error:
            raise DataError(f"{path}: cannot be read: {error.strerror}") from error


def _number(path: Path, names: tuple[str, ...], column: str | int) -> int:
    if isinstance(column, int):
        if not 1 <= column <= len(names):
            raise DataError(f"{path}: no column {column}; columns are numbered 1 to {len(names)}")
        return column - 1
    if names.count(column) > 1:
        raise DataError(f"{path}: {names.count(column)} columns are called {column!r}; name them by number")
    if column not in names:
        raise DataError(f"{path}: no column {column!r}; it has {', '.join(names)}")
    return names.index(column)


def _read_csv(path: Path, delimiter: str | None, header: bool) -> tuple[tuple[str, ...], FloatArray]:
    """Column names (numbers from 1 without a header) and the values (n, m) of a text table."""
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise DataError(f"{path}: not readable as text: {error}") from error
    rows = [
        (number, line) for number, line in enumerate(lines, 1) if line.strip() and line.lstrip()[0] != "#"
    ]
    if len(rows) < 1 + header:
        raise DataError(f"{path}: holds no rows of numbers")
    first = rows[0][1]
    mark = (
        delimiter
        if delimiter is not None
        else next((m for m in (",", ";", "\t") if m in first.strip()), None)
    )
    names: tuple[str, ...] = ()
    if header:
        names = tuple(_split(first, mark))
        rows = rows[1:]
        if all(_is_number(name) for name in names):
            raise DataError(
                f"{path}: the first row {first[:60]!r} holds numbers, no names; set `header: false`"
            )
    width = len(names) if header else len(_split(first, mark))
    values = _fast(path, rows, mark, width)
    if values is None:
        values = np.empty((len(rows), width))
        for index, (number, line) in enumerate(rows):
            values[index] = _row(path, number, _split(line, mark), width, names)
    return names or tuple(str(k + 1) for k in range(width)), values


def _fast(path: Path, rows: list[tuple[int, str]], mark: str | None, width: int) -> FloatArray | None:
    """The table by numpy's own reader; None where a row is not a plain row of numbers."""
    try:
        values = np.loadtxt(
            [line.strip().rstrip(mark or " ") for _, line in rows], delimiter=mark, ndmin=2, comments=None
        )
    except ValueError:
        return None
    return values if values.shape == (len(rows), width) else None


def _split(line: str, mark: str | None) -> list[str]:
    parts = [part.strip().strip('"') for part in line.strip().split(mark)]
    return parts[:-1] if len(parts) > 1 and parts[-1] == "" else parts


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _row(path: Path, number: int, parts: list[str], width: int, names: tuple[str, ...]) -> list[float]:
    if len(parts) != width:
        raise DataError(
            f"{path}: line {number} has {len(parts)} columns, the first has {width}; the file is not whole"
        )
    values = []
    for index, part in enumerate(parts):
        if not _is_number(part):
            column = names[index] if names else str(index + 1)
            shown = "is empty" if not part else f"holds {part!r}"
            raise DataError(f"{path}: line {number}, column {column!r} {shown}; a number is needed")
        values.append(float(part))
    return values
