"""The files of a recording, each read once, and the columns of a signal in them."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from fri.errors import DataError
from ident.import_log.bag import bag_files, read_bag
from ident.import_log.mapping import Signal
from ident.import_log.tables import ARCHIVES, Floats, Table, read_arrays, read_text


@dataclass
class Recording:
    """The files of a recording.

    source : a file, a ROS 2 bag, or the folder of the files named in the mapping.
    notes : decisions of the reading that the user should know.
    """

    source: Path
    delimiter: str | None = None
    header: bool | None = None
    notes: list[str] = field(default_factory=list)
    _tables: dict[Path, dict[str, Table]] = field(default_factory=dict, repr=False)
    _digests: dict[Path, str] = field(default_factory=dict, repr=False)

    def path(self, file: str | None) -> Path:
        """The file named by a signal, or the source itself."""
        if file is None:
            if self.source.is_dir() and not bag_files(self.source):
                raise DataError(
                    f"{self.source} is a folder and the mapping names no `file`; give the file itself"
                )
            path = self.source
        else:
            path = (self.source if self.source.is_dir() else self.source.parent) / file
        if not path.exists():
            near = sorted(item.name for item in path.parent.iterdir()) if path.parent.is_dir() else []
            raise DataError(
                f"{path}: no such file; the mapping needs it. The folder has {', '.join(near[:12]) or 'nothing'}"
            )
        return path

    @property
    def digests(self) -> dict[str, str]:
        """SHA-256 of every file read, by name."""
        return {path.name: digest for path, digest in self._digests.items()}

    def tables(self, path: Path) -> dict[str, Table]:
        """All tables of a file by name; that of a text file is called ``."""
        if path not in self._tables:
            parts = bag_files(path)
            for part in parts or [path]:
                self._digest(part)
            if parts:
                self._tables[path] = read_bag(path).tables()
            elif path.suffix.lower() in ARCHIVES:
                self._tables[path] = read_arrays(path)
            else:
                self._tables[path] = {"": read_text(path, self.delimiter, self.header)}
        return self._tables[path]

    def column(self, file: str | None, column: str | int) -> Floats:
        """One column (n,) of a text file, or one array."""
        path = self.path(file)
        tables = self.tables(path)
        if "" in tables:
            return _column(path, tables[""], column)
        values = self._array(path, str(column)).values
        if 1 not in values.shape:
            raise DataError(f"{path}: array {column!r} has shape {values.shape}; times are one-dimensional")
        return np.asarray(values.reshape(-1))

    def columns(self, signal: Signal, joints: tuple[str, ...], what: str) -> Floats:
        """The columns (n, joints) of a signal, as they stand in the file."""
        if isinstance(signal.file, tuple):
            return self._side_by_side(signal, signal.file, what)
        path = self.path(signal.file)
        tables = self.tables(path)
        if "" in tables:
            if signal.array is not None:
                raise DataError(
                    f"{path}: `{what}` names the array {signal.array!r}, but the file is a plain text"
                )
            table, label = tables[""], str(path)
        else:
            if signal.array is None:
                raise DataError(f"{path}: `{what}` needs `array`, one of {', '.join(tables)}")
            table, label = self._array(path, signal.array), f"{path}: array {signal.array!r}"
        if signal.columns is not None:
            return np.column_stack([_column(path, table, column) for column in signal.columns])
        if set(joints) <= set(table.names):
            return np.column_stack([_column(path, table, name) for name in joints])
        if table.values.shape[1] == len(joints):
            return np.asarray(table.values)
        if table.values.shape[0] == len(joints) and signal.array is not None:
            self.notes.append(f"{what:<15} array {signal.array} has a row for each joint and is transposed")
            return np.asarray(table.values.T)
        raise DataError(
            f"{label} has {table.values.shape[1]} columns for {len(joints)} joints; name them in `columns` of `{what}`"
        )

    def _side_by_side(self, signal: Signal, files: tuple[str, ...], what: str) -> Floats:
        columns = []
        for index, file in enumerate(files):
            path = self.path(file)
            table = self.tables(path).get("")
            if table is None or (table.values.shape[1] != 1 and signal.columns is None):
                raise DataError(
                    f"{path}: `{what}` has a file for each joint; each needs one value a line, or `columns`"
                )
            columns.append(_column(path, table, 1 if signal.columns is None else signal.columns[index]))
            if len(columns[-1]) != len(columns[0]):
                raise DataError(
                    f"{path}: {len(columns[-1])} values, {files[0]} has {len(columns[0])}; the recording is not whole"
                )
        return np.column_stack(columns)

    def _array(self, path: Path, name: str) -> Table:
        tables = self.tables(path)
        if name not in tables:
            raise DataError(f"{path}: no array {name!r}; it has {', '.join(tables)}")
        values = tables[name].values
        if values.dtype.kind != "f" or values.ndim != 2:
            raise DataError(f"{path}: array {name!r} has type {values.dtype}; numbers are needed")
        return tables[name]

    def _digest(self, path: Path) -> None:
        try:
            with path.open("rb") as file:
                self._digests[path] = hashlib.file_digest(file, "sha256").hexdigest()
        except OSError as error:
            raise DataError(f"{path}: cannot be read: {error.strerror}") from error


def _column(path: Path, table: Table, column: str | int) -> Floats:
    names = table.names
    if isinstance(column, int):
        if not 1 <= column <= len(names):
            raise DataError(f"{path}: no column {column}; columns are numbered 1 to {len(names)}")
        return np.asarray(table.values[:, column - 1])
    if names.count(column) > 1:
        raise DataError(f"{path}: {names.count(column)} columns are called {column!r}; name them by number")
    if column not in names:
        raise DataError(f"{path}: no column {column!r}; it has {', '.join(names)}")
    return np.asarray(table.values[:, names.index(column)])
