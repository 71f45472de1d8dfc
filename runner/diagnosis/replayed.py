"""Error of the simulated sessions over time, without and with the extension, as plots need it, kept in a file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fri.errors import DataError
from runner.replay import Replayed

__all__ = ["FILE", "QUANTITIES", "ReplayErrors"]

Floats = NDArray[np.float64]

FILE = "replay.npz"
QUANTITIES = ("position", "motor", "joint")

_MODELS = ("base", "extended")


@dataclass(frozen=True, eq=False)
class ReplayErrors:
    """Measured less simulated (m, n) over the first session that was replayed, by model and quantity.

    position [rad], motor and joint torque [Nm]. duration_s : of what was replayed; the rows are spread evenly over it.
    """

    session: str
    duration_s: float
    errors: Mapping[tuple[str, str], Floats]

    @classmethod
    def of(cls, session: str, done: Sequence[Replayed]) -> ReplayErrors:
        """From the replay with the base model and, where there is one, with the extended model."""
        errors = {
            (model, quantity): getattr(one, quantity)
            for model, one in zip(_MODELS, done, strict=False)
            for quantity in QUANTITIES
            if getattr(one, quantity) is not None
        }
        return cls(session, done[0].duration_s, errors)

    def save(self, path: Path) -> None:
        """Write the file, in single precision."""
        columns = {
            f"{model}.{quantity}": e.astype(np.float32) for (model, quantity), e in self.errors.items()
        }
        np.savez_compressed(
            path,
            session=np.array(self.session),
            duration_s=np.array(self.duration_s),
            **columns,  # type: ignore[arg-type]
        )

    @classmethod
    def load(cls, path: Path) -> ReplayErrors:
        """Read the file. Raises DataError where it is broken."""
        try:
            with np.load(path, allow_pickle=False) as content:
                errors = {
                    (model, quantity): content[f"{model}.{quantity}"].astype(float)
                    for model in _MODELS
                    for quantity in QUANTITIES
                    if f"{model}.{quantity}" in content
                }
                return cls(str(content["session"]), float(content["duration_s"]), errors)
        except (OSError, ValueError, KeyError) as error:
            raise DataError(f"{path}: cannot be read: {error}; run the diagnosis again") from error
