"""Held-out residuals with all that they can be held against, as plots need them, kept in a file."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fri.errors import DataError
from ident.diagnosis import Diagnosis

__all__ = ["FILE", "Residuals", "SideResiduals"]

Floats = NDArray[np.float64]

FILE = "residuals.npz"

_COLUMNS = ("time", "session", "block", "position", "speed", "load", "base", "extended")


@dataclass(frozen=True, eq=False)
class SideResiduals:
    """Rows of one side, (m,) or (m, n): time in the session [s], number of the session, block, joints' position
    [rad], speed [rad/s] and load [Nm], residual of base and extended model [Nm], NaN where a row is not used.
    """

    time: Floats
    session: Floats
    block: Floats
    position: Floats
    speed: Floats
    load: Floats
    base: Floats
    extended: Floats


@dataclass(frozen=True, eq=False)
class Residuals:
    """Held-out residuals by side. sessions : names in the order in which they were run. gear_ratio : (n,)."""

    joint_names: tuple[str, ...]
    sessions: tuple[str, ...]
    gear_ratio: Floats
    sides: dict[str, SideResiduals]
    named: bool

    @classmethod
    def of(cls, diagnosis: Diagnosis, sessions: Sequence[str], gear_ratio: Floats | None) -> Residuals:
        """From a diagnosis. sessions : names in the order of their beginnings."""
        names = diagnosis.base_model.structure.chain.joint_names
        sides = {}
        for side, base in diagnosis.residuals.get("base", {}).items():
            state, extended = diagnosis.states[side], diagnosis.residuals["extended"][side]
            sides[side] = SideResiduals(
                state.time,
                state.session.astype(float),
                state.block,
                state.position,
                state.speed,
                state.load,
                base,
                extended if extended.shape == base.shape else base,
            )
        ratio = np.ones(len(names)) if gear_ratio is None else np.asarray(gear_ratio, dtype=float)
        return cls(names, tuple(sessions), ratio, sides, bool(diagnosis.findings))

    def save(self, path: Path) -> None:
        """Write the file, in single precision."""
        columns = {
            f"{side}.{name}": getattr(rows, name).astype(np.float32)
            for side, rows in self.sides.items()
            for name in _COLUMNS
        }
        np.savez_compressed(
            path,
            joint_names=np.array(self.joint_names),
            sessions=np.array(self.sessions),
            gear_ratio=self.gear_ratio,
            named=np.array(self.named),
            **columns,  # type: ignore[arg-type]
        )

    @classmethod
    def load(cls, path: Path) -> Residuals:
        """Read the file. Raises DataError where it is broken."""
        try:
            with np.load(path, allow_pickle=False) as content:
                sides = {
                    side: SideResiduals(*(content[f"{side}.{name}"].astype(float) for name in _COLUMNS))
                    for side in ("motor", "joint")
                    if f"{side}.time" in content
                }
                return cls(
                    tuple(map(str, content["joint_names"])),
                    tuple(map(str, content["sessions"])),
                    content["gear_ratio"],
                    sides,
                    bool(content["named"]),
                )
        except (OSError, ValueError, KeyError) as error:
            raise DataError(f"{path}: cannot be read: {error}; run the diagnosis again") from error
