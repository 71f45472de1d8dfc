"""The experiment file: arm, controller, payloads, motions, and the steps of an experiment."""

from __future__ import annotations

import dataclasses
import hashlib
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import numpy.typing as npt
import pinocchio as pin

from fri.errors import ConfigurationError
from fri.handshake import find_handshake
from fri.quantities import FileName, Name, Share, check, entries, within
from lwr_driver.arm.cell import PayloadShape
from lwr_driver.arm.load import check_load
from lwr_driver.configuration import CONFIGS, find, parse, read_mapping, read_text
from lwr_driver.extent import LONGEST_EXCITATION_S, Harmonics, Period, Periods
from lwr_driver.places import Place
from lwr_driver.session.motor_torque import KrlMotorTorque
from runner.contact import ContactPlan

DEFAULT = CONFIGS / "experiments/default.yaml"

Mass = Annotated[float, within(0.0, 14.0, "kg", above=True, note="twice the rated payload")]
_Place = Annotated[float, within(-0.5, 0.5, "m")]
_Moment = Annotated[float, within(-5.0, 5.0, "kg m²")]
_Angle = Annotated[float, within(-3.0, 3.0, "rad")]
_Frequency = Annotated[float, within(0.1, 500.0, "Hz")]


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

    name: Name
    mass: Mass
    com: tuple[_Place, _Place, _Place]
    inertia: tuple[_Moment, _Moment, _Moment, _Moment, _Moment, _Moment] = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    shape: PayloadShape | None = None

    def __post_init__(self) -> None:
        plain = self.name and "/" not in self.name and not self.name.startswith(".")
        _require(plain, f"payload name {self.name!r}: use a plain word, it becomes part of names")
        _require(self.name != "none", "payload name 'none' means the empty flange; leave the key out instead")
        _require(self.name.isprintable(), f"payload name {self.name!r}: use letters that can be printed")
        try:
            check(self)
            check_load(self.mass, self.com, self.inertia)
        except ConfigurationError as error:
            raise ConfigurationError(f"payload {self.name}: {error}") from error

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

    name: Name
    payload: Payload | None = None
    validation: bool = False

    def __post_init__(self) -> None:
        _require_word(
            self.name, f"session name {self.name!r}: letters, digits, - and _ only, it names a file"
        )


@dataclass(frozen=True)
class Excitation:
    """The exciting motion, equation (9): periodic, at rest at both ends of each period."""

    period_s: Period = 20.0
    harmonics: Harmonics = 5
    periods: Periods = 2
    speed_scale: Share = 1.0
    plan: FileName | None = None
    validation_plan: FileName | None = None
    seed: Annotated[int, within(0, 2**32 - 2)] = 1

    def __post_init__(self) -> None:
        check(self)
        duration = self.periods * self.period_s
        _require(
            self.plan is not None or duration <= LONGEST_EXCITATION_S,
            f"{self.periods} periods of {self.period_s:g} s last {duration:g} s, limit {LONGEST_EXCITATION_S:g} s; "
            "lower `periods` or `period_s`",
        )
        _require(
            self.plan is None or self.speed_scale == 1,
            f"excitation.speed_scale {self.speed_scale} does not apply to the motion of excitation.plan "
            f"{self.plan}; leave speed_scale out, or plan a slower motion with `lwr-run plan`",
        )


@dataclass(frozen=True)
class Moves:
    """Approach and return: resting position `home` [rad] and speed."""

    home: tuple[_Angle, ...] = (0.0, 0.5, 0.0, -1.3, 0.0, 0.8, 0.0)
    speed_scale: Annotated[float, within(0.01, 1.0, "share")] = 0.2
    settle_s: Annotated[float, within(0.5, 60.0, "s", note="the arm must come to rest")] = 1.0
    brake_s: Annotated[float, within(0.0, 60.0, "s")] = 0.5
    clearance_m: Annotated[float, within(0.0, 0.5, "m")] = 0.03
    max_start_distance_rad: Annotated[float, within(0.01, 6.0, "rad")] = 3.0

    def __post_init__(self) -> None:
        check(self)


@dataclass(frozen=True)
class Link:
    """The FRI connection: this PC's address, the controller's, and the handshake of its KRL program."""

    address: Annotated[str, entries(1, 253)] = "127.0.0.1"
    port: Annotated[int, within(0, 65535)] = 49938
    controller: Annotated[str, entries(1, 253)] | None = None
    handshake: Name = "lwr_identification"
    quality_s: Annotated[float, within(0.01, 60.0, "s")] = 1.0

    def __post_init__(self) -> None:
        check(self)
        find_handshake(self.handshake)


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
    estimator: Name = "wls"
    cutoff_hz: _Frequency | None = None
    decimate_hz: _Frequency | None = None

    def __post_init__(self) -> None:
        check(self)


@dataclass(frozen=True)
class DiagnosisPlan:
    """The diagnosis at the end of an experiment.

    run : diagnose model errors. reference : healthy-arm baseline, a model file of `lwr-run commission`.
    sure : least confidence of a finding with look-alikes; below it a discriminating experiment is offered.
    """

    run: bool = True
    reference: FileName | None = None
    # ident.diagnosis.outcome.claims_in_words.SURE, not imported here: commands would start slower
    sure: Annotated[float, within(0.5, 1.0, "share", below=True, note="0.8 is usual")] = 0.8

    def __post_init__(self) -> None:
        check(self)


@dataclass(frozen=True)
class Replan:
    """Further rounds, each with a motion planned with the estimate so far.

    rounds : their number. problem : file of the planning problem; arm, cell, sessions, knowledge and prior come
    from the experiment.
    """

    rounds: Annotated[int, within(0, 20)] = 0
    problem: FileName = "plans/replan.yaml"

    def __post_init__(self) -> None:
        check(self)


@dataclass(frozen=True)
class Experiment:
    """A whole experiment as its file describes it; every key but `name` has a default.

    sealed : whether an effect is hidden in the emulated arm; its true parameters then stay out of the results.
    """

    name: Name
    arm: FileName = "lwr4plus.yaml"
    cell: FileName = "cell.yaml"
    backend: Literal["emulator", "fri"] = "emulator"
    emulator: FileName = "emulator/default.yaml"
    emulator_settings: dict[str, Any] = field(default_factory=dict)
    lock_step: bool = True
    transport: Literal["in_process", "udp"] = "in_process"
    serial: Annotated[str, entries(0, 64)] = ""
    link: Link = field(default_factory=Link)
    motor_torque: MotorTorque = field(default_factory=MotorTorque)
    excitation: Excitation = field(default_factory=Excitation)
    moves: Moves = field(default_factory=Moves)
    contact: ContactPlan = field(default_factory=ContactPlan)
    identification: Identification = field(default_factory=Identification)
    diagnosis: DiagnosisPlan = field(default_factory=DiagnosisPlan)
    replan: Replan = field(default_factory=Replan)
    sessions: Annotated[tuple[SessionPlan, ...], entries(1, 100)] = (SessionPlan("unloaded"),)
    source: Path = field(default=Path(), init=False)
    folder: Path = field(default=Path(), init=False)
    text: str = field(default="", init=False, repr=False)
    sealed: bool = field(default=False, init=False)

    def __post_init__(self) -> None:
        check(self)
        _require_word(self.name, f"name {self.name!r}: letters, digits, - and _ only, it names a folder")
        names = [session.name for session in self.sessions]
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
        """Read and check an experiment file, or that of a laboratory's folder.

        beside : folder for the files named in it, by default its own. ConfigurationError with file, key, value and
        advice.
        """
        inside = Path(name, "experiment.yaml")
        # A folder of results has one too: it is a record, not a laboratory.
        laboratory = inside.is_file() and not Path(name, "progress.json").exists()
        path = find(inside if laboratory else name)
        experiment = parse(cls, read_mapping(path), path)
        folder = path.parent if beside is None else beside
        vars(experiment).update(source=path, folder=folder, text=read_text(path))
        return experiment

    @classmethod
    def commanded(cls, name: str | Path, *, implied: bool) -> Experiment:
        """As `load`, for a command that moves the arm. implied : nobody named the file.

        ConfigurationError for a real arm by an implied file: whoever forgot the name may be in the wrong folder.
        """
        experiment = cls.load(name)
        if implied and experiment.backend == "fri":
            raise ConfigurationError(
                f"{experiment.source} moves a real arm, and was taken because it lies in this folder; name it on the "
                f"command line to move the arm: {Path(name).name}"
            )
        return experiment

    def changed(self, *, sealed: bool | None = None, **values: Any) -> Experiment:
        """The same experiment and file with other values of some keys."""
        other = dataclasses.replace(self, **values)
        sealed = self.sealed if sealed is None else sealed
        vars(other).update(source=self.source, folder=self.folder, text=self.text, sealed=sealed)
        return other

    @property
    def hosted(self) -> bool:
        """Whether the emulator's process takes the driver's loop in."""
        return self.backend == "emulator" and self.lock_step and self.transport == "in_process"

    @property
    def emulator_path(self) -> Path:
        """Path of the emulator's configuration."""
        return find(self.emulator, beside=self.folder)

    @property
    def uid(self) -> str:
        """Hash of the file and of the emulator's settings in force, twelve hexadecimal digits."""
        settings = repr(sorted(self.emulator_settings.items()))
        return hashlib.sha256(f"{self.text}{settings}".encode()).hexdigest()[:12]

    def session_uid(self, name: str) -> str:
        """Uid of the session `name` begun now.

        The clock tells recordings by one file apart; those of the emulator in lock step differ by their settings alone.
        """
        begun = "" if self.lock_step else f"-{datetime.now(UTC):%Y%m%dT%H%M%S%f}"
        return f"{self.uid}-{name}{begun}"

    def home(self, joints: int) -> npt.NDArray[np.float64]:
        """Resting position of the arm [rad], shape (joints,)."""
        given = len(self.moves.home)
        where = Place.of(self.source).line_of("moves").line_of("home")
        _require(given == joints, f"{where}: moves.home has {given} joints, the arm has {joints}")
        return np.asarray(self.moves.home, dtype=np.float64)

    def payloads(self) -> dict[str, Payload]:
        """The announced payloads by name."""
        return {plan.payload.name: plan.payload for plan in self.sessions if plan.payload is not None}

    @property
    def heaviest(self) -> Payload | None:
        """The announced payload with the largest mass, or None."""
        return max(reversed(self.payloads().values()), key=lambda payload: payload.mass, default=None)
