"""The emulator's configuration file: `configs/emulator/*.yaml` as frozen dataclasses. SI units throughout.

A file may name another one under `base`; its keys then replace those of the base, mapping by mapping.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import yaml

from fri.errors import ConfigurationError
from fri.policy import KrcPolicy
from fri.quantities import FileName, Name, Version, check, entries, within
from lwr_driver.configuration import CONFIGS, find, parse, read_mapping
from lwr_driver.places import Place

JOINTS = 7
_FILES = (("robot", "urdf"), ("robot", "parameters"), ("controller", "urdf"), ("", "limits"))

_Number = TypeVar("_Number")
Joints = tuple[_Number, _Number, _Number, _Number, _Number, _Number, _Number]
"""Seven numbers, one for each joint."""

_Angles = Joints[Annotated[float, within(-6.3, 6.3, "rad")]]
_Stiffness = Joints[Annotated[float, within(10.0, 1e7, "Nm/rad")]]
_Gains = Joints[Annotated[float, within(0.0, 1e6)]]
_Torques = Joints[Annotated[float, within(0.0, 1e4, "Nm")]]
_Offsets = Joints[Annotated[float, within(-1e3, 1e3, "Nm")]]
_MotorLimits = Joints[Annotated[float, within(1.0, 1e4, "Nm")]]
_Resolution = Joints[Annotated[float, within(0.0, 0.1, "rad")]]
_Speeds = Joints[Annotated[float, within(0.05, 50.0, "rad/s")]]
_Accelerations = Joints[Annotated[float, within(0.5, 5000.0, "rad/s²")]]
_Cutoff = Annotated[float, within(0.01, 10_000.0, "Hz")]
_Delay = Annotated[int, within(0, 10_000, "ms")]
_Index = Annotated[int, within(1, 16)]
_Metres = Annotated[float, within(-0.5, 0.5, "m")]
_Moment = Annotated[float, within(-5.0, 5.0, "kg m²")]
_Acceleration = Annotated[float, within(-30.0, 30.0, "m/s²")]
_Gravity = tuple[_Acceleration, _Acceleration, _Acceleration]


@dataclass(frozen=True)
class Plugin:
    """A class from outside, `package.module:Class`, and its keyword arguments."""

    type: Annotated[str, entries(3, 200)]
    options: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        module, _, name = self.type.partition(":")
        if not module or not name.isidentifier():
            raise ConfigurationError(f"type {self.type!r} is not of the form `package.module:Class`")


@dataclass(frozen=True)
class LoadData:
    """Load data in the controller: mass [kg], centre of mass in the frame of link 7 [m], inertia about it
    [kg m^2].
    """

    mass: Annotated[float, within(0.0, 50.0, "kg")] = 0.0
    com: tuple[_Metres, _Metres, _Metres] = (0.0, 0.0, 0.0)
    inertia: tuple[_Moment, _Moment, _Moment, _Moment, _Moment, _Moment] = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        check(self)


@dataclass(frozen=True)
class RobotConfig:
    """The true arm.

    urdf : kinematics. parameters : file with the standard parameters and the named payloads, or an identified
    `model.yaml` together with its effects
    payload : on the flange at the start, by its name in `payloads` or `parameters`. payloads : more of them by name
    gravity : acceleration of gravity in the axes of the base [m/s^2]; (0, 0, 9.81) for an arm at the ceiling
    stiffness [Nm/rad], damping [Nm s/rad] of the joints; brake_torque [Nm]
    substeps : steps of the joint dynamics within 1 ms
    effects : physics beyond the nominal equations (see `sim_backend.plant.PlantEffect`)
    plant : other physics altogether, called with `model, drive, random, **options` (see
    `sim_backend.plant.Plant`); the `effects` act on its sensors only
    """

    urdf: FileName = "lwr4plus.urdf"
    parameters: FileName = "emulator/table2.yaml"
    payload: Name = "none"
    payloads: dict[str, LoadData] = field(default_factory=dict)
    gravity: _Gravity = (0.0, 0.0, -9.81)
    start_position: _Angles = (0.0, 0.5, 0.0, -1.3, 0.0, 0.8, 0.0)
    stiffness: _Stiffness = (15e3, 15e3, 12e3, 12e3, 8e3, 6e3, 6e3)
    damping: _Gains = (15.0, 15.0, 10.0, 10.0, 3.0, 1.0, 0.5)
    brake_torque: _Torques = (300.0, 300.0, 200.0, 200.0, 150.0, 80.0, 80.0)
    substeps: Annotated[int, within(1, 200)] = 4
    effects: Annotated[tuple[Plugin, ...], entries(0, 100)] = ()
    plant: Plugin | None = None

    def __post_init__(self) -> None:
        if "none" in self.payloads:
            raise ConfigurationError(
                "payloads has an entry `none`, the name of the empty flange; name it otherwise"
            )


@dataclass(frozen=True)
class ControllerConfig:
    """The joint position controller and its model of the arm.

    urdf : the controller's model of the arm, CAD-like; its inertias differ from the truth
    load : load data at the start. gravity : `$GRAVITATION`, the opposite of `robot.gravity` if the controller knows
    the mounting [m/s^2]. stiffness : the controller's value of the joint stiffness [Nm/rad]
    position_gain [Nm/rad], velocity_gain [Nm s/rad], torque_gain [-] : feedback of motor position and
    velocity and of the joint torque. viscous [Nm s/rad], coulomb [Nm] : friction compensation by the commanded
    velocity, linear below coulomb_speed [rad/s]. torque_limit [Nm] of the motors, referred to the joint
    impedance_torque_gain [-] : torque feedback under joint impedance and gravity compensation; motor_inertia
    [kg m^2] : the controller's value, for the damping of the springs. free_damping [Nm s/rad] : of gravity compensation
    velocity_cutoff_hz : filter on the motor velocity; command_cutoff_hz : filter on the commanded velocity
    model_period_ms : period of the Jacobian and the mass matrix in the packet
    external_cutoff_hz : filter of the estimated external torque
    settle_s : time under control before the first packet
    """

    urdf: FileName = "lwr4plus.urdf"
    load: LoadData = field(default_factory=LoadData)
    gravity: _Gravity = (0.0, 0.0, 9.81)
    stiffness: _Stiffness = (10e3, 10e3, 10e3, 10e3, 10e3, 7.5e3, 7.5e3)
    position_gain: _Gains = (9e3, 9e3, 6e3, 6e3, 3e3, 2e3, 2e3)
    velocity_gain: _Gains = (250.0, 250.0, 160.0, 160.0, 60.0, 40.0, 40.0)
    torque_gain: _Gains = (0.5, 0.5, 0.5, 0.5, 0.5, 0.5, 0.5)
    viscous: _Gains = (15.0, 17.0, 7.1, 10.5, 4.9, 3.3, 1.8)
    coulomb: _Torques = (13.5, 15.0, 7.9, 9.0, 5.0, 4.0, 3.75)
    coulomb_speed: Annotated[float, within(1e-6, 10.0, "rad/s")] = 0.01
    torque_limit: _MotorLimits = (200.0, 200.0, 120.0, 120.0, 100.0, 50.0, 50.0)
    impedance_torque_gain: Annotated[float, within(0.0, 1e6)] = 4.0
    motor_inertia: Joints[Annotated[float, within(0.0, 100.0, "kg m²")]] = (3.0, 2.5, 2.0, 2.0, 0.8, 0.4, 0.4)
    free_damping: _Gains = (10.0, 10.0, 8.0, 8.0, 3.0, 1.0, 1.0)
    velocity_cutoff_hz: _Cutoff = 150.0
    command_cutoff_hz: _Cutoff = 40.0
    model_period_ms: Annotated[int, within(1, 10_000, "ms")] = 20
    external_cutoff_hz: _Cutoff = 10.0
    settle_s: Annotated[float, within(0.0, 60.0, "s")] = 1.0


@dataclass(frozen=True)
class SensorConfig:
    """The sensors. Noise is white at 1 kHz, given as its standard deviation.

    position_sensor : side of the elastic joint of the published position
    """

    position_sensor: Literal["link", "motor"] = "link"
    position_resolution: _Resolution = (6e-6,) * 7
    position_noise: _Resolution = (0.0,) * 7
    motor_position_resolution: _Resolution = (1e-6,) * 7
    joint_torque_noise: _Torques = (0.39, 0.39, 0.23, 0.23, 0.23, 0.086, 0.086)
    joint_torque_offset: _Offsets = (0.0,) * 7
    joint_torque_resolution: _Torques = (0.02, 0.02, 0.01, 0.01, 0.01, 0.005, 0.005)
    motor_torque_noise: _Torques = (0.5, 0.5, 0.3, 0.3, 0.2, 0.1, 0.1)
    motor_torque_resolution: _Torques = (0.05, 0.05, 0.03, 0.03, 0.02, 0.01, 0.01)
    temperature: Annotated[float, within(-50.0, 200.0, "°C")] = 35.0


@dataclass(frozen=True)
class KrlRealsConfig:
    """Motor torques in KRL reals: `$FRI_TO_REA[reals]`, loop counter in `$FRI_TO_INT[counter_int]`; indices
    from 1.

    tick_ms : the interpreter's loop; between ticks the value holds. delay_ms : age of the value when it is
    written
    """

    enabled: bool = True
    reals: tuple[_Index, _Index, _Index, _Index, _Index, _Index, _Index] = (1, 2, 3, 4, 5, 6, 7)
    counter_int: _Index = 1
    tick_ms: Annotated[int, within(1, 1000, "ms")] = 12
    delay_ms: _Delay = 0

    def __post_init__(self) -> None:
        if len(set(self.reals)) != len(self.reals):
            raise ConfigurationError(f"reals {list(self.reals)} names a variable twice")


@dataclass(frozen=True)
class TraceConfig:
    """The controller's own recording, 1 kHz, on its own clock.

    clock_offset : its clock at time zero [s]. clock_rate_error : gain of its clock per second
    delay_ms : age of the motor torques in it
    longest_s : older samples are dropped
    """

    clock_offset: Annotated[float, within(-1e9, 1e9, "s")] = 812.4375
    clock_rate_error: Annotated[float, within(-0.1, 0.1)] = 1.5e-5
    delay_ms: _Delay = 0
    longest_s: Annotated[float, within(1.0, 3600.0, "s")] = 900.0


@dataclass(frozen=True)
class FriConfig:
    """The link: `friSetup` and `friOpen`, the KRL program, and the controller's limits.

    program : KRL program by its name in configs/krl, or a `.src` file of the laboratory. autostart : it runs from the
    beginning. mode : operating mode at the beginning
    velocity [rad/s], acceleration [rad/s^2] : limits; beyond them the controller drops the session
    answer_delay_s : age of an undisturbed answer in lock step
    patience_s : in lock step and command mode, wall time before an answer counts as missing
    leave_s : in lock step, wall time without an answer before the client counts as gone; at once if its port is closed
    """

    program: FileName = "stanford"
    autostart: bool = True
    mode: Literal["T1", "T2", "AUT", "EXT"] = "EXT"
    period_ms: Annotated[int, within(1, 100, "ms")] = 1
    local_host: Annotated[str, entries(1, 253)] = "127.0.0.1"
    local_port: Annotated[int, within(0, 65535)] = 0
    position_min: _Angles = (-2.9671, -2.0944, -2.9671, -2.0944, -2.9671, -2.0944, -2.9671)
    position_max: _Angles = (2.9671, 2.0944, 2.9671, 2.0944, 2.9671, 2.0944, 2.9671)
    velocity: _Speeds = (2.0944, 2.0944, 2.7925, 2.7925, 4.3633, 3.8397, 3.8397)
    acceleration: _Accelerations = (20.94, 20.94, 27.93, 27.93, 43.63, 76.79, 76.79)
    uptime_s: Annotated[float, within(0.0, 1e8, "s")] = 3600.0
    answer_delay_s: Annotated[float, within(0.0, 1.0, "s")] = 1e-4
    patience_s: Annotated[float, within(0.001, 3600.0, "s")] = 10.0
    leave_s: Annotated[float, within(0.001, 1e6, "s")] = 300.0

    def __post_init__(self) -> None:
        for low, high in zip(self.position_min, self.position_max, strict=True):
            if not low < high:
                raise ConfigurationError(f"position_min {low} is not below position_max {high}")


@dataclass(frozen=True)
class KrlConfig:
    """The KRL interpreter; no document of KUKA gives its speed.

    statement_ms : time of a statement [ms]. halt_s : time until somebody presses start after HALT [s]
    currents : whether `$CURR_ACT` exists. variables : values for variables of the program's data list
    """

    statement_ms: Annotated[float, within(0.0, 1000.0, "ms")] = 0.1
    halt_s: Annotated[float, within(0.0, 3600.0, "s")] = 1.0
    currents: bool = True
    variables: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for name, value in self.variables.items():
            if not isinstance(value, (bool, int, float, str)):
                raise ConfigurationError(
                    f"variables: {name} is {value!r}; give a number, a truth value or a text"
                )


@dataclass(frozen=True)
class EmulatorConfig:
    """A whole emulator configuration.

    limits : arm file with the limits of the command monitor
    faults : faults on the wire from the start. schedule : the operator's actions without request
    """

    schema_version: Version = 1
    seed: Annotated[int, within(0, 2**63 - 1)] = 1
    robot: RobotConfig = field(default_factory=RobotConfig)
    controller: ControllerConfig = field(default_factory=ControllerConfig)
    sensors: SensorConfig = field(default_factory=SensorConfig)
    krl_reals: KrlRealsConfig = field(default_factory=KrlRealsConfig)
    trace: TraceConfig = field(default_factory=TraceConfig)
    fri: FriConfig = field(default_factory=FriConfig)
    krl: KrlConfig = field(default_factory=KrlConfig)
    policy: KrcPolicy = field(default_factory=KrcPolicy)
    limits: FileName = "lwr4plus.yaml"
    faults: Annotated[tuple[dict[str, Any], ...], entries(0, 1000)] = ()
    schedule: Annotated[tuple[dict[str, Any], ...], entries(0, 1000)] = ()
    source: Path = field(default=Path(), init=False)
    place: Place = field(default=Place(""), init=False, repr=False, compare=False)

    def beside(self, name: str) -> Path:
        """Path of the file `name` of this configuration."""
        return find(name, beside=self.source.parent)


def load_configuration(
    name: str | Path = CONFIGS / "emulator/default.yaml", overrides: Mapping[str, Any] | None = None
) -> EmulatorConfig:
    """Read and check an emulator configuration.

    overrides : values by dotted key (`robot.payload`) in place of those of the file
    Raises ConfigurationError with file, key, value and advice.
    """
    path = find(name)
    content, files = _with_base(path, ())
    for key, value in (overrides or {}).items():
        _put(content, key, value)
    place = Place(str(path), files, frozenset(overrides or {}))
    config = parse(EmulatorConfig, content, place)
    vars(config).update(source=path, place=place)
    return config


def read_settings(settings: Iterable[str]) -> dict[str, Any]:
    """Texts `KEY=VALUE` of a command line as overrides; the values are YAML."""
    found: dict[str, Any] = {}
    for setting in settings:
        key, equals, text = setting.partition("=")
        if not equals or not key:
            raise ConfigurationError(f"--set {setting!r} is not of the form KEY=VALUE")
        try:
            found[key] = yaml.safe_load(text)
        except yaml.YAMLError as error:
            raise ConfigurationError(f"--set {setting!r}: the value is not valid YAML") from error
    return found


def _with_base(path: Path, seen: tuple[Path, ...]) -> tuple[dict[str, Any], tuple[Path, ...]]:
    """The content of a file and those below it, and the files by precedence."""
    content = read_mapping(path)
    base = content.pop("base", None)
    if base is None:
        return content, (path,)
    where = Place.of(path).line_of("base")
    if not isinstance(base, str):
        raise ConfigurationError(f"{where}: `base` must be the name of a file, found {base!r}")
    below = find(base, beside=path.parent)
    if below in (*seen, path):
        raise ConfigurationError(f"{where}: `base` leads back to {below}")
    under, files = _with_base(below, (*seen, path))
    return _merge(_resolved(under, below.parent), content), (path, *files)


def _resolved(content: dict[str, Any], beside: Path) -> dict[str, Any]:
    """The content of a base with its file names found beside the base itself."""
    for section, key in _FILES:
        place = content.get(section) if section else content
        if isinstance(place, dict) and isinstance(place.get(key), str):
            place[key] = str(find(place[key], beside=beside))
    link = content.get("fri")
    if isinstance(link, dict) and str(link.get("program")).lower().endswith(".src"):
        link["program"] = str(find(link["program"], beside=beside))
    return content


def _merge(below: dict[str, Any], above: Mapping[str, Any]) -> dict[str, Any]:
    merged = dict(below)
    for key, value in above.items():
        if isinstance(value, Mapping) and isinstance(merged.get(key), Mapping):
            merged[key] = _merge(dict(merged[key]), value)
        else:
            merged[key] = value
    return merged


def _put(content: dict[str, Any], key: str, value: Any) -> None:
    *path, last = key.split(".")
    place = content
    for name in path:
        inner = place.get(name)
        place[name] = dict(inner) if isinstance(inner, Mapping) else {}
        place = place[name]
    place[last] = value
