"""Results of a fleet on disk: Parquet tables by arm, one file a day, and triangular factors.

    STORE/ARM/parameters/2026-03-12.parquet   day, name, unit, value, std
              errors/...                      day, joint, side, rms [Nm], sigma [Nm], rows
              findings/...                    day, cause, joints, confidence, delta_bic, statement
              sessions/...                    day, uid, file, payload, status, note
              factors/2026-03-12.npz          triangular factor of the day's weighted rows
              model.yaml                      of the first day; its signal settings hold for all days
              together.yaml                   of all days since the last change
              reference.yaml                  healthy-arm baseline, of the first days

`pandas.read_parquet("STORE/ARM/parameters")`, polars and duckdb read a table as a whole. A day's sessions file is
written last, so a day without it is worked on again.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import date
from pathlib import Path
from typing import Any

import numpy as np

from fri.errors import ConfigurationError, DataError
from ident.estimators.problem import TriangularFactor
from runner.file_names import MODEL
from runner.fleet.days import dated, day_of

TABLES: Mapping[str, Sequence[tuple[str, str]]] = {
    "parameters": (("name", "string"), ("unit", "string"), ("value", "float64"), ("std", "float64")),
    "errors": (
        ("joint", "string"),
        ("side", "string"),
        ("rms", "float64"),
        ("sigma", "float64"),
        ("rows", "int64"),
    ),
    "findings": (
        ("cause", "string"),
        ("joints", "string"),
        ("confidence", "float64"),
        ("delta_bic", "float64"),
        ("statement", "string"),
    ),
    "sessions": (
        ("uid", "string"),
        ("file", "string"),
        ("payload", "string"),
        ("status", "string"),
        ("note", "string"),
    ),
}
"""Columns of each table with their types, after `arm`, `day` (null without a date) and `part`."""

Row = Mapping[str, Any]


@dataclass(frozen=True)
class ArmStore:
    """The results of one arm."""

    folder: Path

    @property
    def name(self) -> str:
        """The arm."""
        return self.folder.name

    @property
    def model(self) -> Path:
        """Model of the first day."""
        return self.folder / MODEL

    @property
    def reference(self) -> Path:
        """Healthy-arm baseline."""
        return self.folder / "reference.yaml"

    @property
    def together(self) -> Path:
        """Model of all days since the last change."""
        return self.folder / "together.yaml"

    def days(self) -> tuple[str, ...]:
        """Keys of the days with results, in order."""
        return tuple(sorted((path.stem for path in (self.folder / "sessions").glob("*.parquet")), key=day_of))

    def write(self, key: str, table: str, rows: Sequence[Row]) -> None:
        """Write a day's rows of a table, whole or not at all."""
        import pyarrow
        import pyarrow.parquet

        day, _, part = key.partition("_")
        kinds = {"string": pyarrow.string(), "float64": pyarrow.float64(), "int64": pyarrow.int64()}
        columns = {
            "arm": pyarrow.array([self.name] * len(rows), pyarrow.string()),
            "day": pyarrow.array(
                [date.fromisoformat(day) if dated(key) else None] * len(rows), pyarrow.date32()
            ),
            "part": pyarrow.array([int(part or 1)] * len(rows), pyarrow.int64()),
        }
        for name, kind in TABLES[table]:
            columns[name] = pyarrow.array([row[name] for row in rows], kinds[kind])
        target = self.folder / table / f"{key}.parquet"
        target.parent.mkdir(parents=True, exist_ok=True)
        draft = target.with_suffix(".part")
        pyarrow.parquet.write_table(pyarrow.table(columns), draft)
        draft.replace(target)

    def read(self, table: str) -> list[dict[str, Any]]:
        """All rows of a table, by day. `key` : of the day."""
        import pyarrow.parquet

        rows: list[dict[str, Any]] = []
        for path in sorted((self.folder / table).glob("*.parquet")):
            try:
                found = pyarrow.parquet.read_table(path).to_pylist()
            except (OSError, ValueError) as error:
                raise DataError(
                    f"{path} cannot be read: {error}; remove the day's files, and `lwr-run batch` makes them again"
                ) from error
            rows += [{**row, "key": path.stem} for row in found]
        return rows

    def write_factor(self, key: str, names: Sequence[str], factor: TriangularFactor) -> None:
        """Keep a day's triangular factor (p + 1, p + 1) of its rows in units of their noise."""
        target = self.folder / "factors" / f"{key}.npz"
        target.parent.mkdir(parents=True, exist_ok=True)
        with target.open("wb") as file:
            np.savez(file, names=np.array(names), r=factor.r, rows=factor.rows)

    def factors(self) -> dict[str, tuple[tuple[str, ...], TriangularFactor]]:
        """Names and factor of each day."""
        found = {}
        for path in sorted((self.folder / "factors").glob("*.npz")):
            with np.load(path) as data:
                names = tuple(map(str, data["names"]))
                found[path.stem] = names, TriangularFactor(data["r"], int(data["rows"]))
        return found


@dataclass(frozen=True)
class FleetStore:
    """The results of all arms, a folder each."""

    folder: Path

    def arms(self) -> tuple[ArmStore, ...]:
        """All arms with results, by name."""
        if not self.folder.is_dir():
            return ()
        return tuple(ArmStore(path) for path in sorted(self.folder.iterdir()) if (path / "sessions").is_dir())

    def arm(self, name: str) -> ArmStore:
        """One arm. ConfigurationError for an unknown name, with the known ones."""
        found = {arm.name: arm for arm in self.arms()}
        if name not in found:
            known = ", ".join(found) or "none"
            raise ConfigurationError(f"{self.folder} holds no arm {name!r}; arms: {known}")
        return found[name]

    def uids(self) -> set[str]:
        """Identities of all logs that need no further work; those of a failed day are tried again."""
        rows = (row for arm in self.arms() for row in arm.read("sessions"))
        return {str(row["uid"]) for row in rows if row["status"] in ("taken", "left out")}
