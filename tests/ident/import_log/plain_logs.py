"""A log of two joints in a text file, and its mapping."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ident.import_log import LogMapping
from lwr_driver.configuration import parse

JOINTS = ["a", "b"]
PLAIN: dict[str, Any] = {
    "robot": "bench arm",
    "joints": JOINTS,
    "time": {"column": "t", "file": "arm.csv"},
    "position": {"file": "arm.csv", "columns": ["qa", "qb"], "unit": "rad"},
    "joint_torque": {"file": "arm.csv", "columns": ["ta", "tb"], "unit": "Nm"},
}


def mapping(**changes: Any) -> LogMapping:
    return parse(LogMapping, PLAIN | changes, "mapping.yaml")


def write_csv(folder: Path, rows: int = 4, name: str = "arm.csv", **columns: Any) -> Path:
    table = {
        "t": np.arange(rows) * 0.01,
        "qa": np.linspace(0, 1, rows),
        "qb": np.linspace(1, 2, rows),
        "ta": np.linspace(-1, 1, rows),
        "tb": np.linspace(3, 4, rows),
    } | columns
    lines = [",".join(table)]
    for row in zip(*table.values(), strict=True):
        lines.append(",".join(value if isinstance(value, str) else repr(float(value)) for value in row))
    (folder / name).write_text("\n".join(lines) + "\n")
    return folder
