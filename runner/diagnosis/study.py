"""A diagnosis with what surrounds it: replay in simulation, measured gains, plots, files, deciding motions."""

from __future__ import annotations

import json
import logging
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from fri.errors import ConfigurationError
from ident.diagnosis import ArmData, Diagnosis, Reference, diagnose
from ident.dynamics.kinematics import Chain
from ident.model import DynamicModel
from ident.model.model_file import write_model
from lwr_driver.arm import JOINTS, Arm
from lwr_driver.session import Session
from runner.diagnosis.look_alikes import FILE as LOOK_ALIKES
from runner.diagnosis.look_alikes import LookAlikes, Place, look_alikes, write_look_alikes
from runner.diagnosis.measures import Moved, RowGain, moved_parameters, row_gains
from runner.diagnosis.replayed import FILE as REPLAYED
from runner.diagnosis.replayed import ReplayErrors
from runner.diagnosis.residuals import FILE, Residuals
from runner.diagnosis.sources import arm_data
from runner.diagnosis.text import study_text
from runner.replay import Replay

if TYPE_CHECKING:
    from runner.diagnosis.deciding import Deciding

__all__ = ["DETAILS", "DIAGNOSIS", "EXTENDED", "TEXT", "Study", "replaceable", "study"]

DIAGNOSIS = "diagnosis.json"
DETAILS = "details.json"
EXTENDED = "model_extended.yaml"
TEXT = "diagnosis.txt"


@dataclass(frozen=True, eq=False)
class Material:
    """The sessions that were fitted, and what is known of the arm."""

    sessions: tuple[Session, ...]
    chain: Chain
    arm: ArmData
    reference: Reference | None


@dataclass(frozen=True, eq=False)
class Study:
    """A diagnosis, what it gained, what could not be seen, and the motions that would decide what is open.

    sessions : names in the order in which they were run. referenced : whether a healthy reference was at hand.
    pairs : causes that look alike, side by side. replayed : errors of the simulation over time. material : what it
    was made from.
    """

    diagnosis: Diagnosis
    gains: tuple[RowGain, ...]
    moved: tuple[Moved, ...]
    notes: tuple[str, ...]
    residuals: Residuals
    sessions: tuple[str, ...]
    referenced: bool
    pairs: tuple[LookAlikes, ...] = ()
    replayed: ReplayErrors | None = None
    offers: tuple[Deciding, ...] = field(default=())
    material: Material | None = field(default=None, repr=False)

    def __str__(self) -> str:
        return study_text(self)

    def with_offers(self, offers: Sequence[Deciding]) -> Study:
        """The same with motions that would decide, and what is to be expected of them."""
        from runner.diagnosis.foresight import foresee

        pairs, given = self.pairs, self.material
        if offers and pairs and given is not None:
            pairs = foresee(
                pairs,
                self.diagnosis,
                given.sessions,
                given.chain,
                offers,
                arm=given.arm,
                reference=given.reference,
            )
        return replace(self, offers=tuple(offers), pairs=pairs)

    def details(self) -> dict[str, Any]:
        """What the contract of diagnosis.json has no place for."""
        return {
            "schema_version": 1,
            "sessions": list(self.sessions),
            "joints": list(self.residuals.joint_names),
            "reference": self.referenced,
            "rows": [gain.to_dict() for gain in self.gains],
            "base_parameters": [moved.to_dict() for moved in self.moved],
            "notes": list(self.notes),
            "look_alikes": [pair.to_dict() for pair in self.pairs],
            "deciding_motions": [offer.to_dict() for offer in self.offers],
        }

    def write(self, folder: Path) -> None:
        """Write everything into `folder`: numbers, model, text, plots, residuals, deciding motions."""
        from runner.report.look_alike_figures import look_alike_figure
        from runner.report.residual_figures import replay_figures, residual_figures

        folder.mkdir(parents=True, exist_ok=True)
        kinds = ("residual-*.svg", "look-alike-*.svg", "replay-*.svg", REPLAYED)
        for stale in (path for kind in kinds for path in folder.glob(kind)):
            stale.unlink()
        _write_json(self.diagnosis.to_dict(), folder / DIAGNOSIS)
        _write_json(self.details(), folder / DETAILS)
        write_model(self.diagnosis.extended_model, folder / EXTENDED)
        (folder / TEXT).write_text(f"{self}\n", encoding="utf-8")
        self.residuals.save(folder / FILE)
        for side in self.residuals.sides:
            for figure in residual_figures(self.residuals, side):
                figure.save(folder / f"{figure.name}.svg")
        write_look_alikes(self.pairs, folder / LOOK_ALIKES)
        for pair in self.pairs:
            figure = look_alike_figure(pair, self.residuals.joint_names)
            figure.save(folder / f"{figure.name}.svg")
        if self.replayed is not None:
            self.replayed.save(folder / REPLAYED)
            for figure in replay_figures(self.replayed, self.residuals.joint_names):
                figure.save(folder / f"{figure.name}.svg")
        for offer in self.offers:
            offer.plan.save(folder / offer.file)


def replaceable(folder: Path) -> None:
    """Whether a diagnosis may be written there. ConfigurationError where the folder holds anything else than one."""
    if folder.exists() and not folder.is_dir():
        raise ConfigurationError(f"{folder} is a file; name a folder with --out")
    if folder.is_dir() and any(folder.iterdir()) and not (folder / DIAGNOSIS).is_file():
        raise ConfigurationError(
            f"{folder} holds other files than a diagnosis; choose another folder with --out"
        )


def study(
    sessions: Sequence[Session],
    chain: Chain,
    *,
    test: Sequence[Session] = (),
    arm: Arm | None = None,
    data: ArmData | None = None,
    model: DynamicModel | None = None,
    reference: DynamicModel | None = None,
    simulate: bool = True,
    compare: Sequence[tuple[Place, Place]] = (),
) -> Study:
    """Diagnose `sessions` and measure what it is worth.

    arm : description of the arm, for stiffness, gear ratios and the simulation; without it nothing is replayed.
    data : what is known of its drives; default: what the description says.
    model : the present model, the baseline of the simulation. reference : model of `lwr-run commission`.
    compare : causes to put side by side besides those that a finding is in doubt between.
    Raises DataError for sessions that cannot be used.
    """
    healthy = None if reference is None else Reference.of(reference)
    data = arm_data(arm, chain) if data is None else data
    everything = sorted([*sessions, *test], key=lambda s: s.start)
    replay = None
    if simulate and arm is not None:
        replay = Replay(_as_stiff(arm, healthy), everything)
    with _unadvised():
        found = diagnose(
            list(sessions),
            chain,
            test=list(test),
            arm=data,
            model=model,
            reference=healthy,
            simulate=replay,
        )
        pairs, unshown = look_alikes(found, sessions, chain, compare, arm=data, reference=healthy)
    notes = [*found.notes, *_little(found, everything)]
    if replay is not None:
        notes += replay.notes
    elif simulate:
        notes.append(_unsimulated(chain))
    notes += unshown
    names = tuple(session.path.name for session in everything)
    return Study(
        found,
        row_gains(found),
        moved_parameters(found),
        tuple(notes),
        Residuals.of(found, names, data.gear_ratio),
        names,
        healthy is not None,
        pairs,
        _first_replay(replay),
        material=Material(tuple(sessions), chain, data, healthy),
    )


def _first_replay(replay: Replay | None) -> ReplayErrors | None:
    """Errors over the session that was replayed first, with both models where both could be."""
    if replay is None or not replay.first:
        return None
    name = replay.first[0][0]
    return ReplayErrors.of(name, [done for session, done in replay.first if session == name])


def _little(diagnosis: Diagnosis, sessions: Sequence[Session]) -> list[str]:
    """What cannot be claimed because little was recorded."""
    notes = []
    if "joint" not in diagnosis.rms_base:
        notes.append(
            "no joint torque: errors of its sensors cannot be seen, and what acts on the links is told from what acts "
            "in the drives by its shape alone"
        )
    if len(sessions) == 1:
        notes.append(
            "one session: what changes from one session to the next (warm-up, a drifting zero, a payload) cannot be "
            "seen, and errors are measured on parts of the one motion"
        )
    return notes


def _unsimulated(chain: Chain) -> str:
    if chain.n != JOINTS:
        return f"no simulation: the emulator has a controller for {JOINTS} joints, this arm has {chain.n}"
    return "no simulation: the arm is not one that the emulator has; name its description with --arm"


@contextmanager
def _unadvised() -> Iterator[None]:
    """Without advice on settings of the signals, which a diagnosis chooses itself."""

    def wanted(record: logging.LogRecord) -> bool:
        return "raise `" not in record.getMessage()

    logger = logging.getLogger("ident.rows.prepare")
    logger.addFilter(wanted)
    try:
        yield
    finally:
        logger.removeFilter(wanted)


def _as_stiff(arm: Arm, healthy: Reference | None) -> Arm:
    """The arm with the stiffness that commissioning found."""
    if (
        healthy is None
        or len(healthy.compliance) != len(arm.stiffness)
        or not np.all(healthy.compliance > 0.0)
    ):
        return arm
    return replace(arm, stiffness=1.0 / healthy.compliance)


def _write_json(content: dict[str, Any], path: Path) -> None:
    path.write_text(json.dumps(content, indent=1, allow_nan=False) + "\n", encoding="utf-8")
