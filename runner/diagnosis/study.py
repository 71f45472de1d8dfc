"""A study: the diagnosis of sessions with replay in simulation, measured gains, look-alikes and its folder of files."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fri.errors import ConfigurationError
from ident.diagnosis import ArmData, Diagnosis, DiagnosisSettings, Reference, diagnose
from ident.diagnosis.healthy.bench import known_drives
from ident.diagnosis.outcome.claims_in_words import SURE
from ident.diagnosis.outcome.look_alikes import LookAlikes, Place, look_alikes
from ident.diagnosis.outcome.statements import Statements, statements
from ident.dynamics.kinematics import Chain
from ident.dynamics.session_chain import session_chain
from ident.dynamics.structure import Coupling
from ident.effects import find_effect
from ident.model import DynamicModel
from ident.model.model_file import write_model
from lwr_driver.arm import Arm
from lwr_driver.session import Session
from runner.diagnosis.discriminating import Discriminating, foresee
from runner.diagnosis.records import (
    LOOK_ALIKES,
    REPLAY,
    RESIDUALS,
    ReplayErrors,
    Residuals,
    write_look_alikes,
)
from runner.file_names import DETAILS, DIAGNOSIS
from runner.replay import Replay
from runner.terminal import write_json

EXTENDED = "model_extended.yaml"
TEXT = "diagnosis.txt"


@dataclass(frozen=True, eq=False)
class Material:
    """The fitted sessions, and the data of the arm."""

    sessions: tuple[Session, ...]
    chain: Chain
    arm: ArmData
    reference: Reference | None


@dataclass(frozen=True, eq=False)
class Study:
    """A diagnosis with its limits, look-alikes and discriminating experiments.

    notes : limits of the data and of the replay. pairs : look-alikes, side by side. replayed : errors of the simulation
    over time. offers : discriminating experiments. material : the inputs. sure : confidence below which a finding with
    alternatives is open.
    """

    diagnosis: Diagnosis
    notes: tuple[str, ...]
    residuals: Residuals
    pairs: tuple[LookAlikes, ...] = ()
    replayed: ReplayErrors | None = None
    offers: tuple[Discriminating, ...] = field(default=())
    material: Material | None = field(default=None, repr=False)
    sure: float = SURE

    @property
    def said(self) -> Statements:
        """All that the diagnosis says."""
        content, details = self.diagnosis.to_dict(), self.details()
        return statements(content, details, details["joints"])

    def __str__(self) -> str:
        return self.said.text()

    def with_offers(self, offers: Sequence[Discriminating]) -> Study:
        """The same with discriminating experiments and their expected effect."""
        pairs, given = self.pairs, self.material
        if offers and pairs and given is not None:
            inputs = (given.sessions, given.chain, offers, given.arm, given.reference)
            pairs = foresee(pairs, self.diagnosis, *inputs)
        return replace(self, offers=tuple(offers), pairs=pairs)

    def details(self) -> dict[str, Any]:
        """Plain content of details.json: everything beside diagnosis.json."""
        return {
            "schema_version": 1,
            **self.diagnosis.details,
            "sure": self.sure,
            "notes": list(self.notes),
            "look_alikes": [pair.to_dict() for pair in self.pairs],
            "deciding_motions": [offer.to_dict() for offer in self.offers],
        }

    def write(self, folder: Path) -> None:
        """Write everything into `folder`: numbers, model, text, residuals, discriminating experiments."""
        folder.mkdir(parents=True, exist_ok=True)
        (folder / REPLAY).unlink(missing_ok=True)
        write_json(folder / DIAGNOSIS, self.diagnosis.to_dict())
        write_json(folder / DETAILS, self.details())
        write_model(self.diagnosis.extended_model, folder / EXTENDED)
        (folder / TEXT).write_text(f"{self}\n", encoding="utf-8")
        self.residuals.save(folder / RESIDUALS)
        write_look_alikes(self.pairs, folder / LOOK_ALIKES)
        if self.replayed is not None:
            self.replayed.save(folder / REPLAY)
        for offer in self.offers:
            offer.plan.save(folder / offer.file)


def replaceable(folder: Path) -> None:
    """Refuse a folder with other files than a diagnosis. Raises ConfigurationError."""
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
    sure: float = SURE,
    jobs: int = -1,
) -> Study:
    """Diagnose `sessions` and measure the gain.

    arm : description of the arm, for stiffness and gear ratios; without it the simulated joints are stiff.
    data : of its drives; default: from the description.
    model : the present model, replayed beside the extended one. reference : model of `lwr-run commission`.
    compare : causes to put side by side besides those of open findings. sure : see `Study`. jobs : threads, -1 for
        one a core.
    Raises DataError for unusable sessions.
    """
    healthy = None if reference is None else Reference.of(reference)
    data = known_drives(arm_data(arm, chain) if data is None else data, healthy)
    everything = sorted([*sessions, *test], key=lambda s: s.start)
    replay = None
    if simulate:
        encoder = healthy.encoder if healthy is not None and healthy.sets else None
        replay = Replay(_stiffness(arm, healthy), everything, encoder=encoder)
    logs, held_out = list(sessions), list(test)
    found = diagnose(
        logs,
        chain,
        test=held_out,
        arm=data,
        model=model,
        reference=healthy,
        settings=DiagnosisSettings(jobs=jobs),
        simulate=replay,
    )
    pairs, unshown = look_alikes(found, sessions, chain, compare, arm=data, reference=healthy)
    notes = list(found.notes)
    if replay is not None:
        notes += replay.notes
    notes += unshown
    return Study(
        found,
        tuple(notes),
        Residuals.of(found, data.gear_ratio),
        pairs,
        _first_replay(replay),
        material=Material(tuple(sessions), chain, data, healthy),
        sure=sure,
    )


def _first_replay(replay: Replay | None) -> ReplayErrors | None:
    if replay is None or not replay.first:
        return None
    name = replay.first[0][0]
    return ReplayErrors.of(name, [done for session, done in replay.first if session == name])


def _stiffness(arm: Arm | None, healthy: Reference | None) -> NDArray[np.float64] | None:
    """Of the joints (n,) [Nm/rad], infinite for a rigid one, from the reference or from the description of the arm;
    None if unknown."""
    if healthy is not None and np.any(healthy.compliance > 0.0):
        with np.errstate(divide="ignore"):
            return np.asarray(1.0 / healthy.compliance)
    return None if arm is None else np.asarray(arm.stiffness, dtype=float)


def chain_of(sessions: Sequence[Session], urdf: Path | None) -> Chain:
    """Kinematics of the first session's joints, from a URDF file or from the session."""
    return session_chain(sessions[0], urdf)


def arm_data(
    arm: Arm | None,
    chain: Chain,
    coupling: Sequence[str] = (),
    gear_ratio: str | None = None,
    stiffness: str | None = None,
) -> ArmData:
    """Stiffness and gear ratios of an arm file, and the options of the command line about the drives.

    coupling : each `A:B`, two joints with coupled drives. gear_ratio, stiffness [Nm/rad] : `N` for all joints or
    `N,N,...`, in place of the arm file's. Raises ConfigurationError for unknown joints and wrong numbers.
    """
    pairs = tuple(map(Coupling.of, coupling))
    for name in (name for pair in pairs for name in pair.joints):
        if name not in chain.joint_names:
            raise ConfigurationError(f"--coupling: no joint {name!r}; joints: {', '.join(chain.joint_names)}")
    ratio = None if arm is None else arm.gear_ratio.astype(float)
    if gear_ratio is not None:
        ratio = _each_joint("--gear-ratio", gear_ratio, chain.n)
    stiff = None if arm is None else arm.stiffness
    if stiffness is not None:
        stiff = _each_joint("--stiffness", stiffness, chain.n)
    return ArmData(stiff, ratio, pairs)


def asked(text: str, names: Sequence[str]) -> Place:
    """Cause and joint from `cause(joint)` or `cause:joint`, the joint by name or number from 1, none for the whole arm.

    Raises ConfigurationError for unknown causes and joints.
    """
    match = re.fullmatch(r"\s*(\w+)\s*(?:\(([^()]*)\)|:(.*))?\s*", text)
    if match is None:
        raise ConfigurationError(f"--compare {text!r}: write a cause and its joint, such as cable_spring:5")
    effect = find_effect(match.group(1))
    word = (match.group(2) or match.group(3) or "").strip()
    if effect.whole_arm:
        return effect.cause, ()
    if word in names:
        return effect.cause, (list(names).index(word) + 1,)
    if not word.isdigit() or not 1 <= int(word) <= len(names):
        raise ConfigurationError(
            f"--compare {text!r}: {effect.cause} belongs to a joint, 1 to {len(names)} or one of {', '.join(names)}; "
            f"write {effect.cause}:{names[0]}"
        )
    return effect.cause, (int(word),)


def _each_joint(option: str, text: str, n: int) -> NDArray[np.float64]:
    try:
        values = np.array([float(part) for part in text.split(",")])
    except ValueError:
        raise ConfigurationError(f"{option} {text!r} is no number or list such as 100,100,160") from None
    if len(values) not in (1, n) or not np.all((values > 0.0) & np.isfinite(values)):
        raise ConfigurationError(
            f"{option} {text!r}: one number above zero for all joints, or one for each of the {n} joints"
        )
    return np.broadcast_to(values, n).copy()
