"""Records of a diagnosis for plots: residuals, replay errors, look-alikes."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fri.errors import DataError
from ident.diagnosis import Diagnosis
from ident.diagnosis.outcome.look_alikes import LookAlikes, Trace
from ident.diagnosis.outcome.result import RowStates
from runner.replay import Replayed

Floats = NDArray[np.float64]

RESIDUALS, REPLAY, LOOK_ALIKES = "residuals.npz", "replay.npz", "look_alikes.npz"
QUANTITIES = ("position", "motor", "joint")

_MODELS = ("base", "extended")
_ROWS = ("time", "session", "block", "position", "speed", "load", "base", "extended")
_TRACE = ("time", "session", "position", "velocity", "load", "motor_angle", "first", "second", "measured")


@dataclass(frozen=True, eq=False)
class SideResiduals(RowStates):
    """Rows of one side with the residual (m, n) of base and extended model [Nm], NaN in unused rows."""

    base: Floats
    extended: Floats


@dataclass(frozen=True, eq=False)
class Residuals:
    """Held-out residuals by side. sessions : names in their order. gear_ratio : (n,). named : any finding."""

    joint_names: tuple[str, ...]
    sessions: tuple[str, ...]
    gear_ratio: Floats
    sides: dict[str, SideResiduals]
    named: bool

    @classmethod
    def of(cls, diagnosis: Diagnosis, gear_ratio: Floats | None) -> Residuals:
        """From a diagnosis."""
        names = diagnosis.base_model.structure.chain.joint_names
        sides = {}
        for side, base in diagnosis.residuals.get("base", {}).items():
            state, extended = diagnosis.states[side], diagnosis.residuals["extended"][side]
            sides[side] = SideResiduals(
                **vars(state), base=base, extended=extended if extended.shape == base.shape else base
            )
        ratio = np.ones(len(names)) if gear_ratio is None else np.asarray(gear_ratio, dtype=float)
        return cls(names, diagnosis.numbered, ratio, sides, bool(diagnosis.extension))

    def save(self, path: Path) -> None:
        """Write the file, in single precision."""
        columns: dict[str, Any] = {
            f"{side}.{name}": getattr(rows, name).astype(np.float32)
            for side, rows in self.sides.items()
            for name in _ROWS
        }
        np.savez_compressed(
            path,
            joint_names=np.array(self.joint_names),
            sessions=np.array(self.sessions),
            gear_ratio=self.gear_ratio,
            named=np.array(self.named),
            **columns,
        )

    @classmethod
    def load(cls, path: Path) -> Residuals:
        """Read the file. Raises DataError for a broken one."""
        with _opened(path) as content:
            sides = {
                side: SideResiduals(*(content[f"{side}.{name}"].astype(float) for name in _ROWS))
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


@dataclass(frozen=True, eq=False)
class ReplayErrors:
    """Measured minus simulated (m, n) over the first replayed session, by model and quantity.

    position [rad], motor and joint torque [Nm]. duration_s : of the replay; the rows are spread evenly over it.
    """

    session: str
    duration_s: float
    errors: Mapping[tuple[str, str], Floats]

    @classmethod
    def of(cls, session: str, done: Sequence[Replayed]) -> ReplayErrors:
        """From the replay with the base model and, if any, with the extended model."""
        errors = {
            (model, quantity): getattr(one, quantity)
            for model, one in zip(_MODELS, done, strict=False)
            for quantity in QUANTITIES
            if getattr(one, quantity) is not None
        }
        return cls(session, done[0].duration_s, errors)

    def save(self, path: Path) -> None:
        """Write the file, in single precision."""
        columns: dict[str, Any] = {".".join(key): e.astype(np.float32) for key, e in self.errors.items()}
        session, duration = np.array(self.session), np.array(self.duration_s)
        np.savez_compressed(path, session=session, duration_s=duration, **columns)

    @classmethod
    def load(cls, path: Path) -> ReplayErrors:
        """Read the file. Raises DataError for a broken one."""
        with _opened(path) as content:
            errors = {
                (model, quantity): content[f"{model}.{quantity}"].astype(float)
                for model in _MODELS
                for quantity in QUANTITIES
                if f"{model}.{quantity}" in content
            }
            return cls(str(content["session"]), float(content["duration_s"]), errors)


def write_look_alikes(found: Sequence[LookAlikes], path: Path) -> None:
    """Write the traces, in single precision; the rest is in `to_dict`."""
    columns: dict[str, Any] = {}
    for number, pair in enumerate(found):
        columns[f"{number}.rows"] = np.array([f"{trace.side}.{trace.joint}" for trace in pair.traces])
        for k, trace in enumerate(pair.traces):
            columns |= {f"{number}.{k}.{name}": getattr(trace, name).astype(np.float32) for name in _TRACE}
    np.savez_compressed(path, **columns)


def read_look_alikes(path: Path, entries: Sequence[Mapping[str, Any]]) -> tuple[LookAlikes, ...]:
    """Traces from the file, the rest from plain content. Raises DataError for broken ones."""
    found = []
    with _opened(path) as content:
        for number, entry in enumerate(entries):
            traces = []
            for k, label in enumerate(content[f"{number}.rows"]):
                side, joint = str(label).split(".")
                columns = (content[f"{number}.{k}.{name}"].astype(float) for name in _TRACE)
                traces.append(Trace(side, int(joint), *columns))
            found.append(LookAlikes.from_dict(entry, traces))
    return tuple(found)


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    """The arrays of a file; errors of reading and of its content as DataError."""
    try:
        with np.load(path, allow_pickle=False) as content:
            yield content
    except (OSError, ValueError, KeyError, TypeError, IndexError) as error:
        raise DataError(f"{path}: cannot be read: {error}; run the diagnosis again") from error
