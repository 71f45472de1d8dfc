"""The experiment file: what is to be done, with which arm, at which controller, under which payloads."""

from __future__ import annotations

import dataclasses
import hashlib
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
import pinocchio as pin

from fri.errors import ConfigurationError
from fri.handshake import find_handshake
from ident.diagnosis.statements import SURE
from lwr_driver.arm.cell import PayloadShape
from lwr_driver.configuration import find, parse, read_mapping
from lwr_driver.session.motor_torque import KrlMotorTorque

__all__ = [
    "DiagnosisPlan",
    "Excitation",
    "Experiment",
    "Identification",
    "Link",
    "MotorTorque",
    "Moves",
    "Payload",
    "Replan",
    "SessionPlan",
]

DEFAULT = "experiments/default.yaml"


@dataclass(frozen=True)
class Payload:
    """What hangs on the flange, as announced: from the scale and the drawing, not from identification.

    mass : kg. com : centre of mass in the frame of link 7 [m].
    inertia : XX XY XZ YY YZ ZZ about the centre of mass [kg m²], zero where unknown.
    shape : outer shape for the collision check; None leaves the payload out of it.
    """

    name: str
    mass: float
    com: tuple[float, float, float]
    inertia: tuple[float, float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    shape: PayloadShape | None = None

    def __post_init__(self) -> None:
        if not self.name or "/" in self.name or self.name.startswith("."):
            raise ConfigurationError(
                f"payload name {self.name!r}: use a plain word, it becomes part of names"
            )
        if self.name == "none":
            raise ConfigurationError("payload name 'none' means the empty flange; leave the key out instead")
        if not 0 < self.mass <= 50:
            raise ConfigurationError(f"payload {self.name}: mass {self.mass} kg is outside 0 to 50 kg")

    def body(self) -> pin.Inertia:
        """The payload as a rigid body in the frame of link 7."""
        xx, xy, xz, yy, yz, zz = self.inertia
        return pin.Inertia(
            self.mass, np.asarray(self.com), np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        )


@dataclass(frozen=True)
class SessionPlan:
    """One motion of the arm with one payload; it becomes `NAME.mcap`.

    validation : another motion, which the estimate does not see and is held against.
    """

    name: str
    payload: Payload | None = None
    validation: bool = False

    def __post_init__(self) -> None:
        if not self.name.replace("-", "").replace("_", "").isalnum():
            raise ConfigurationError(
                f"session name {self.name!r}: letters, digits, - and _ only, it names a file"
            )


@dataclass(frozen=True)
class Excitation:
    """The exciting motion, equation (9): periodic, at rest at both ends of each period."""

    period_s: float = 20.0
    harmonics: int = 5
    periods: int = 2
    speed_scale: float = 1.0
    plan: str | None = None
    seed: int = 1

    def __post_init__(self) -> None:
        _positive("period_s", self.period_s, "s")
        if self.harmonics < 2:
            raise ConfigurationError(f"harmonics {self.harmonics} is below 2; rest at both ends needs two")
        if self.periods < 1:
            raise ConfigurationError(
                f"periods {self.periods} is below 1; at least one whole period is recorded"
            )
        if not 0 < self.speed_scale <= 1:
            raise ConfigurationError(f"speed_scale {self.speed_scale} is outside 0 to 1")


@dataclass(frozen=True)
class Moves:
    """Approach and return: where the arm rests [rad], and how gently it goes there."""

    home: tuple[float, ...] = (0.0, 0.5, 0.0, -1.3, 0.0, 0.8, 0.0)
    speed_scale: float = 0.2
    settle_s: float = 1.0
    brake_s: float = 0.5
    clearance_m: float = 0.03
    max_start_distance_rad: float = 3.0

    def __post_init__(self) -> None:
        if not 0 < self.speed_scale <= 1:
            raise ConfigurationError(f"speed_scale {self.speed_scale} is outside 0 to 1")
        if self.settle_s < 0.5:
            raise ConfigurationError(f"settle_s {self.settle_s} s is below 0.5 s; the arm must come to rest")
        if self.clearance_m < 0:
            raise ConfigurationError(f"clearance_m {self.clearance_m} m is negative")


@dataclass(frozen=True)
class Link:
    """The FRI connection: this PC's address, the controller's, and the handshake of its KRL program."""

    address: str = "127.0.0.1"
    port: int = 49938
    controller: str | None = None
    handshake: str = "lwr_identification"
    quality_s: float = 1.0

    def __post_init__(self) -> None:
        find_handshake(self.handshake)
        if not 0 <= self.port <= 65535:
            raise ConfigurationError(f"port {self.port} is outside 0 to 65535")


@dataclass(frozen=True)
class MotorTorque:
    """Where motor torques come from; the FRI packet has none.

    krl_reals : the KRL program publishes them in `$FRI_TO_REA` with a counter in `$FRI_TO_INT`, see `krl`.
    trace_file : the controller's own recording, imported after each motion and aligned by the data.
    none : a valid session for Model 1.
    """

    source: Literal["krl_reals", "trace_file", "none"] = "krl_reals"
    krl: KrlMotorTorque = field(default_factory=KrlMotorTorque)


@dataclass(frozen=True)
class Identification:
    """Which model is estimated from the sessions, and how the signals are prepared."""

    model: Literal[1, 2, 3] = 2
    estimator: str = "wls"
    cutoff_hz: float = 10.0
    decimate_hz: float = 2.0


@dataclass(frozen=True)
class DiagnosisPlan:
    """What the experiment ends with.

    run : look for what the model lacks. reference : model file of `lwr-run commission`, the healthy arm.
    sure : confidence below which a finding with look-alikes is open and asks for a discriminating experiment.
    """

    run: bool = True
    reference: str | None = None
    sure: float = SURE

    def __post_init__(self) -> None:
        if not 0.5 <= self.sure < 1.0:
            raise ConfigurationError(f"sure {self.sure} is outside 0.5 to 1; {SURE} is usual")


@dataclass(frozen=True)
class Replan:
    """Further rounds, each with a motion planned from what the rounds before have taught.

    rounds : how many. problem : the planning problem, whose arm, cell, sessions, knowledge and prior are the
    experiment's own.
    """

    rounds: int = 0
    problem: str = "plans/replan.yaml"

    def __post_init__(self) -> None:
        if self.rounds < 0:
            raise ConfigurationError(f"replan.rounds {self.rounds} is negative")


@dataclass(frozen=True)
class Experiment:
    """A whole experiment as its file describes it; every key but `name` has a default."""

    name: str
    arm: str = "lwr4plus.yaml"
    cell: str = "cell.yaml"
    backend: Literal["emulator", "fri"] = "emulator"
    emulator: str = "emulator/default.yaml"
    emulator_settings: dict[str, Any] = field(default_factory=dict)
    lock_step: bool = True
    serial: str = ""
    link: Link = field(default_factory=Link)
    motor_torque: MotorTorque = field(default_factory=MotorTorque)
    excitation: Excitation = field(default_factory=Excitation)
    moves: Moves = field(default_factory=Moves)
    identification: Identification = field(default_factory=Identification)
    diagnosis: DiagnosisPlan = field(default_factory=DiagnosisPlan)
    replan: Replan = field(default_factory=Replan)
    sessions: tuple[SessionPlan, ...] = (SessionPlan("unloaded"),)
    source: Path = field(default=Path(), init=False)
    folder: Path = field(default=Path(), init=False)
    text: str = field(default="", init=False, repr=False)

    def __post_init__(self) -> None:
        if not self.name or not self.name.replace("-", "").replace("_", "").isalnum():
            raise ConfigurationError(f"name {self.name!r}: letters, digits, - and _ only, it names a folder")
        names = [session.name for session in self.sessions]
        if not names:
            raise ConfigurationError("sessions is empty; list at least one motion")
        for name in names:
            if names.count(name) > 1:
                raise ConfigurationError(
                    f"session name {name!r} is used {names.count(name)} times; names must differ"
                )
        if all(session.validation for session in self.sessions):
            raise ConfigurationError("every session is for validation; an estimate needs one that is not")
        known = {session.payload for session in self.sessions if not session.validation}
        for session in self.sessions:
            if session.validation and session.payload is not None and session.payload not in known:
                raise ConfigurationError(
                    f"session {session.name!r} validates with the payload {session.payload.name!r}, which no "
                    "session before it identifies; give the payload a session without `validation`"
                )
        if self.lock_step and self.backend == "fri":
            raise ConfigurationError("lock_step is for the emulator; set `lock_step: false` with backend fri")

    @classmethod
    def load(cls, name: str | Path = DEFAULT, *, beside: Path | None = None) -> Experiment:
        """Read and check an experiment file; raises ConfigurationError with file, key, value and advice.

        Files that it names are looked for in the folder `beside`, by default the file's own.
        """
        path = find(name)
        experiment = parse(cls, read_mapping(path), str(path))
        object.__setattr__(experiment, "source", path)
        object.__setattr__(experiment, "folder", path.parent if beside is None else beside)
        object.__setattr__(experiment, "text", path.read_text(encoding="utf-8"))
        return experiment

    def changed(self, **values: Any) -> Experiment:
        """The same experiment with other values of some keys; it keeps its file."""
        other = dataclasses.replace(self, **values)
        for name in ("source", "folder", "text"):
            object.__setattr__(other, name, getattr(self, name))
        return other

    @property
    def emulator_path(self) -> Path:
        """Path of the emulator's configuration."""
        return find(self.emulator, beside=self.folder)

    @property
    def uid(self) -> str:
        """Twelve hexadecimal digits that stand for the content of the file."""
        return hashlib.sha256(self.text.encode()).hexdigest()[:12]

    def home(self, joints: int) -> npt.NDArray[np.float64]:
        """Resting position of the arm [rad], shape (joints,)."""
        if len(self.moves.home) != joints:
            raise ConfigurationError(
                f"{self.source}: moves.home has {len(self.moves.home)} joints, the arm has {joints}"
            )
        return np.asarray(self.moves.home, dtype=np.float64)

    def payloads(self) -> dict[str, Payload]:
        """The announced payloads by name."""
        return {plan.payload.name: plan.payload for plan in self.sessions if plan.payload is not None}


def _positive(name: str, value: float, unit: str) -> None:
    if value <= 0:
        raise ConfigurationError(f"{name} {value} {unit} is not positive")
