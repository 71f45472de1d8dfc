"""The experiment file: arm, controller, payloads, motions, and the steps of an experiment."""

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
from lwr_driver.arm.cell import PayloadShape
from lwr_driver.configuration import find, parse, read_mapping
from lwr_driver.session.motor_torque import KrlMotorTorque
from runner.contact import ContactPlan

DEFAULT = "experiments/default.yaml"


def _require(condition: object, message: str) -> None:
    if not condition:
        raise ConfigurationError(message)


def _require_word(name: str, message: str) -> None:
    _require(name.replace("-", "").replace("_", "").isalnum(), message)


@dataclass(frozen=True)
class Payload:
    """The payload on the flange as announced: from scale and drawing, not from identification.

    mass : kg. com : centre of mass in the frame of link 7 [m].
    inertia : XX XY XZ YY YZ ZZ about the centre of mass [kg m²], zero if unknown.
    shape : outer shape for the collision check; None omits the payload there.
    """

    name: str
    mass: float
    com: tuple[float, float, float]
    inertia: tuple[float, float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    shape: PayloadShape | None = None

    def __post_init__(self) -> None:
        plain = self.name and "/" not in self.name and not self.name.startswith(".")
        _require(plain, f"payload name {self.name!r}: use a plain word, it becomes part of names")
        _require(self.name != "none", "payload name 'none' means the empty flange; leave the key out instead")
        _require(0 < self.mass <= 50, f"payload {self.name}: mass {self.mass} kg is outside 0 to 50 kg")

    def body(self) -> pin.Inertia:
        """The payload as a rigid body in the frame of link 7."""
        xx, xy, xz, yy, yz, zz = self.inertia
        return pin.Inertia(
            self.mass, np.asarray(self.com), np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        )


@dataclass(frozen=True)
class SessionPlan:
    """One motion of the arm with one payload, logged as `NAME.mcap`.

    validation : held-out session with another motion.
    """

    name: str
    payload: Payload | None = None
    validation: bool = False

    def __post_init__(self) -> None:
        _require_word(
            self.name, f"session name {self.name!r}: letters, digits, - and _ only, it names a file"
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
        _require(self.period_s > 0, f"period_s {self.period_s} s is not positive")
        _require(self.harmonics >= 2, f"harmonics {self.harmonics} is below 2; rest at both ends needs two")
        _require(
            self.periods >= 1, f"periods {self.periods} is below 1; at least one whole period is recorded"
        )
        _require(0 < self.speed_scale <= 1, f"speed_scale {self.speed_scale} is outside 0 to 1")
        _require(
            self.plan is None or self.speed_scale == 1,
            f"excitation.speed_scale {self.speed_scale} does not apply to the motion of excitation.plan "
            f"{self.plan}; leave speed_scale out, or plan a slower motion with `lwr-run plan`",
        )


@dataclass(frozen=True)
class Moves:
    """Approach and return: resting position `home` [rad] and speed."""

    home: tuple[float, ...] = (0.0, 0.5, 0.0, -1.3, 0.0, 0.8, 0.0)
    speed_scale: float = 0.2
    settle_s: float = 1.0
    brake_s: float = 0.5
    clearance_m: float = 0.03
    max_start_distance_rad: float = 3.0

    def __post_init__(self) -> None:
        _require(0 < self.speed_scale <= 1, f"speed_scale {self.speed_scale} is outside 0 to 1")
        _require(
            self.settle_s >= 0.5, f"settle_s {self.settle_s} s is below 0.5 s; the arm must come to rest"
        )
        _require(self.clearance_m >= 0, f"clearance_m {self.clearance_m} m is negative")


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
        _require(0 <= self.port <= 65535, f"port {self.port} is outside 0 to 65535")


@dataclass(frozen=True)
class MotorTorque:
    """Source of the motor torques; the FRI packet has none.

    krl_reals : `$FRI_TO_REA`, written by the KRL program, with a counter in `$FRI_TO_INT`; see `krl`.
    trace_file : the controller's own recording, imported after each motion and aligned by the data.
    none : for Model 1.
    """

    source: Literal["krl_reals", "trace_file", "none"] = "krl_reals"
    krl: KrlMotorTorque = field(default_factory=KrlMotorTorque)


@dataclass(frozen=True)
class Identification:
    """Model, estimator and filters of the estimate."""

    model: Literal[1, 2, 3] = 2
    estimator: str = "wls"
    cutoff_hz: float | None = None
    decimate_hz: float | None = None


@dataclass(frozen=True)
class DiagnosisPlan:
    """The diagnosis at the end of an experiment.

    run : diagnose model errors. reference : healthy-arm baseline, a model file of `lwr-run commission`.
    sure : least confidence of a finding with look-alikes; below it a discriminating experiment is offered.
    """

    run: bool = True
    reference: str | None = None
    sure: float = 0.8  # ident.diagnosis.statements.SURE, not imported here: commands would start slower

    def __post_init__(self) -> None:
        _require(0.5 <= self.sure < 1.0, f"sure {self.sure} is outside 0.5 to 1; 0.8 is usual")


@dataclass(frozen=True)
class Replan:
    """Further rounds, each with a motion planned with the estimate so far.

    rounds : their number. problem : file of the planning problem; arm, cell, sessions, knowledge and prior come
    from the experiment.
    """

    rounds: int = 0
    problem: str = "plans/replan.yaml"

    def __post_init__(self) -> None:
        _require(self.rounds >= 0, f"replan.rounds {self.rounds} is negative")


@dataclass(frozen=True)
class Experiment:
    """A whole experiment as its file describes it; every key but `name` has a default.

    sealed : whether an effect is hidden in the emulated arm; its true parameters then stay out of the results.
    """

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
    contact: ContactPlan = field(default_factory=ContactPlan)
    identification: Identification = field(default_factory=Identification)
    diagnosis: DiagnosisPlan = field(default_factory=DiagnosisPlan)
    replan: Replan = field(default_factory=Replan)
    sessions: tuple[SessionPlan, ...] = (SessionPlan("unloaded"),)
    source: Path = field(default=Path(), init=False)
    folder: Path = field(default=Path(), init=False)
    text: str = field(default="", init=False, repr=False)
    sealed: bool = field(default=False, init=False)

    def __post_init__(self) -> None:
        _require_word(self.name, f"name {self.name!r}: letters, digits, - and _ only, it names a folder")
        names = [session.name for session in self.sessions]
        _require(names, "sessions is empty; list at least one motion")
        for name in names:
            count = names.count(name)
            _require(count == 1, f"session name {name!r} is used {count} times; names must differ")
        known = {session.payload for session in self.sessions if not session.validation}
        _require(known, "every session is for validation; an estimate needs another one")
        for session in self.sessions:
            _require(
                session.payload is None or session.payload in known,
                f"session {session.name!r} validates with the payload {getattr(session.payload, 'name', '')!r}, not "
                "identified by another session; give the payload a session without `validation`",
            )
        _require(
            self.backend != "fri" or not self.lock_step,
            "lock_step is for the emulator; set `lock_step: false` with backend fri",
        )

    @classmethod
    def load(cls, name: str | Path = DEFAULT, *, beside: Path | None = None) -> Experiment:
        """Read and check an experiment file. ConfigurationError with file, key, value and advice.

        beside : folder for the files named in it, by default its own.
        """
        path = find(name)
        experiment = parse(cls, read_mapping(path), str(path))
        folder = path.parent if beside is None else beside
        vars(experiment).update(source=path, folder=folder, text=path.read_text(encoding="utf-8"))
        return experiment

    def changed(self, *, sealed: bool | None = None, **values: Any) -> Experiment:
        """The same experiment and file with other values of some keys."""
        other = dataclasses.replace(self, **values)
        sealed = self.sealed if sealed is None else sealed
        vars(other).update(source=self.source, folder=self.folder, text=self.text, sealed=sealed)
        return other

    @property
    def emulator_path(self) -> Path:
        """Path of the emulator's configuration."""
        return find(self.emulator, beside=self.folder)

    @property
    def uid(self) -> str:
        """Hash of the file, twelve hexadecimal digits."""
        return hashlib.sha256(self.text.encode()).hexdigest()[:12]

    def home(self, joints: int) -> npt.NDArray[np.float64]:
        """Resting position of the arm [rad], shape (joints,)."""
        given = len(self.moves.home)
        _require(given == joints, f"{self.source}: moves.home has {given} joints, the arm has {joints}")
        return np.asarray(self.moves.home, dtype=np.float64)

    def payloads(self) -> dict[str, Payload]:
        """The announced payloads by name."""
        return {plan.payload.name: plan.payload for plan in self.sessions if plan.payload is not None}

    @property
    def heaviest(self) -> Payload | None:
        """The announced payload with the largest mass, or None."""
        return max(reversed(self.payloads().values()), key=lambda payload: payload.mass, default=None)
