"""The emulator's configuration file: `configs/emulator/*.yaml` as frozen dataclasses. SI units throughout.

A file may name another one under `base`; its keys then replace those of the base, mapping by mapping.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, Literal

import yaml

from fri.errors import ConfigurationError
from fri.policy import KrcPolicy
from lwr_driver.configuration import find, parse, read_mapping

JOINTS = 7
Joints = tuple[float, float, float, float, float, float, float]


def _numbers(owner: object, names: tuple[str, ...]) -> Iterator[tuple[str, float]]:
    for name in names:
        value = getattr(owner, name)
        for number in value if isinstance(value, tuple) else (value,):
            yield name, number


def _non_negative(owner: object, *names: str) -> None:
    for name, number in _numbers(owner, names):
        if number < 0.0:
            raise ConfigurationError(f"{name} {number} is negative")


def _positive(owner: object, *names: str) -> None:
    for name, number in _numbers(owner, names):
        if number <= 0.0:
            raise ConfigurationError(f"{name} {number} must be above zero")


@dataclass(frozen=True)
class Plugin:
    """A class from outside, `package.module:Class`, and its keyword arguments."""

    type: str
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

    mass: float = 0.0
    com: tuple[float, float, float] = (0.0, 0.0, 0.0)
    inertia: tuple[float, float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        _non_negative(self, "mass")


@dataclass(frozen=True)
class RobotConfig:
    """The true arm.

    urdf : kinematics. parameters : file with the standard parameters and the named payloads, or an identified
    `model.yaml` together with its effects
    payload : on the flange at the start, by its name in `payloads` or `parameters`. payloads : more of them by name
    gravity : acceleration of gravity in the axes of the base [m/s^2]; (0, 0, 9.81) for an arm at the ceiling
    stiffness [Nm/rad], damping [Nm s/rad] of the joints; brake_torque [Nm]
    substeps : steps of the joint dynamics within 1 ms
    effects : physics beyond the nominal equations (see `sim_backend.plant.Effect`)
    plant : other physics altogether, called with `model, drive, random, **options` (see
    `sim_backend.plant.Plant`); the `effects` act on its sensors only
    """

    urdf: str = "lwr4plus.urdf"
    parameters: str = "table2.yaml"
    payload: str = "none"
    payloads: dict[str, LoadData] = field(default_factory=dict)
    gravity: tuple[float, float, float] = (0.0, 0.0, -9.81)
    start_position: Joints = (0.0, 0.5, 0.0, -1.3, 0.0, 0.8, 0.0)
    stiffness: Joints = (15e3, 15e3, 12e3, 12e3, 8e3, 6e3, 6e3)
    damping: Joints = (15.0, 15.0, 10.0, 10.0, 3.0, 1.0, 0.5)
    brake_torque: Joints = (300.0, 300.0, 200.0, 200.0, 150.0, 80.0, 80.0)
    substeps: int = 4
    effects: tuple[Plugin, ...] = ()
    plant: Plugin | None = None

    def __post_init__(self) -> None:
        _positive(self, "stiffness", "substeps")
        _non_negative(self, "damping", "brake_torque")
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

    urdf: str = "lwr4plus.urdf"
    load: LoadData = field(default_factory=LoadData)
    gravity: tuple[float, float, float] = (0.0, 0.0, 9.81)
    stiffness: Joints = (10e3, 10e3, 10e3, 10e3, 10e3, 7.5e3, 7.5e3)
    position_gain: Joints = (9e3, 9e3, 6e3, 6e3, 3e3, 2e3, 2e3)
    velocity_gain: Joints = (250.0, 250.0, 160.0, 160.0, 60.0, 40.0, 40.0)
    torque_gain: Joints = (0.5, 0.5, 0.5, 0.5, 0.5, 0.5, 0.5)
    viscous: Joints = (15.0, 17.0, 7.1, 10.5, 4.9, 3.3, 1.8)
    coulomb: Joints = (13.5, 15.0, 7.9, 9.0, 5.0, 4.0, 3.75)
    coulomb_speed: float = 0.01
    torque_limit: Joints = (200.0, 200.0, 120.0, 120.0, 100.0, 50.0, 50.0)
    impedance_torque_gain: float = 4.0
    motor_inertia: Joints = (3.0, 2.5, 2.0, 2.0, 0.8, 0.4, 0.4)
    free_damping: Joints = (10.0, 10.0, 8.0, 8.0, 3.0, 1.0, 1.0)
    velocity_cutoff_hz: float = 150.0
    command_cutoff_hz: float = 40.0
    model_period_ms: int = 20
    external_cutoff_hz: float = 10.0
    settle_s: float = 1.0

    def __post_init__(self) -> None:
        _positive(self, "stiffness", "torque_limit", "coulomb_speed", "velocity_cutoff_hz")
        _positive(self, "command_cutoff_hz", "model_period_ms", "external_cutoff_hz")
        _non_negative(self, "impedance_torque_gain", "motor_inertia", "free_damping")
        _non_negative(self, "position_gain", "velocity_gain", "torque_gain", "viscous", "coulomb", "settle_s")


@dataclass(frozen=True)
class SensorConfig:
    """The sensors. Noise is white at 1 kHz, given as its standard deviation.

    position_sensor : side of the elastic joint of the published position
    """

    position_sensor: Literal["link", "motor"] = "link"
    position_resolution: Joints = (6e-6,) * 7
    position_noise: Joints = (0.0,) * 7
    motor_position_resolution: Joints = (1e-6,) * 7
    joint_torque_noise: Joints = (0.39, 0.39, 0.23, 0.23, 0.23, 0.086, 0.086)
    joint_torque_offset: Joints = (0.0,) * 7
    joint_torque_resolution: Joints = (0.02, 0.02, 0.01, 0.01, 0.01, 0.005, 0.005)
    motor_torque_noise: Joints = (0.5, 0.5, 0.3, 0.3, 0.2, 0.1, 0.1)
    motor_torque_resolution: Joints = (0.05, 0.05, 0.03, 0.03, 0.02, 0.01, 0.01)
    temperature: float = 35.0

    def __post_init__(self) -> None:
        _non_negative(self, *(f.name for f in fields(self) if f.name.endswith(("_resolution", "_noise"))))


@dataclass(frozen=True)
class KrlRealsConfig:
    """Motor torques in KRL reals: `$FRI_TO_REA[reals]`, loop counter in `$FRI_TO_INT[counter_int]`; indices
    from 1.

    tick_ms : the interpreter's loop; between ticks the value holds. delay_ms : age of the value when it is
    written
    """

    enabled: bool = True
    reals: tuple[int, int, int, int, int, int, int] = (1, 2, 3, 4, 5, 6, 7)
    counter_int: int = 1
    tick_ms: int = 12
    delay_ms: int = 0

    def __post_init__(self) -> None:
        _positive(self, "tick_ms")
        _non_negative(self, "delay_ms")
        for index in (*self.reals, self.counter_int):
            if not 1 <= index <= 16:
                raise ConfigurationError(f"KRL variable index {index} is outside 1 to 16")
        if len(set(self.reals)) != len(self.reals):
            raise ConfigurationError(f"reals {list(self.reals)} names a variable twice")


@dataclass(frozen=True)
class TraceConfig:
    """The controller's own recording, 1 kHz, on its own clock.

    clock_offset : its clock at time zero [s]. clock_rate_error : gain of its clock per second
    delay_ms : age of the motor torques in it
    longest_s : older samples are dropped
    """

    clock_offset: float = 812.4375
    clock_rate_error: float = 1.5e-5
    delay_ms: int = 0
    longest_s: float = 900.0

    def __post_init__(self) -> None:
        _non_negative(self, "delay_ms")
        _positive(self, "longest_s")


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

    program: str = "stanford"
    autostart: bool = True
    mode: Literal["T1", "T2", "AUT", "EXT"] = "EXT"
    period_ms: int = 1
    local_host: str = "127.0.0.1"
    local_port: int = 0
    position_min: Joints = (-2.9671, -2.0944, -2.9671, -2.0944, -2.9671, -2.0944, -2.9671)
    position_max: Joints = (2.9671, 2.0944, 2.9671, 2.0944, 2.9671, 2.0944, 2.9671)
    velocity: Joints = (2.0944, 2.0944, 2.7925, 2.7925, 4.3633, 3.8397, 3.8397)
    acceleration: Joints = (20.94, 20.94, 27.93, 27.93, 43.63, 76.79, 76.79)
    uptime_s: float = 3600.0
    answer_delay_s: float = 1e-4
    patience_s: float = 10.0
    leave_s: float = 300.0

    def __post_init__(self) -> None:
        if not 1 <= self.period_ms <= 100:
            raise ConfigurationError(f"period_ms {self.period_ms} is outside 1 to 100")
        _positive(self, "velocity", "acceleration", "patience_s", "leave_s")
        _non_negative(self, "answer_delay_s", "uptime_s")


@dataclass(frozen=True)
class KrlConfig:
    """The KRL interpreter; no document of KUKA gives its speed.

    statement_ms : time of a statement [ms]. halt_s : time until somebody presses start after HALT [s]
    currents : whether `$CURR_ACT` exists. variables : values for variables of the program's data list
    """

    statement_ms: float = 0.1
    halt_s: float = 1.0
    currents: bool = True
    variables: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        _non_negative(self, "statement_ms", "halt_s")
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

    schema_version: int = 1
    seed: int = 1
    robot: RobotConfig = field(default_factory=RobotConfig)
    controller: ControllerConfig = field(default_factory=ControllerConfig)
    sensors: SensorConfig = field(default_factory=SensorConfig)
    krl_reals: KrlRealsConfig = field(default_factory=KrlRealsConfig)
    trace: TraceConfig = field(default_factory=TraceConfig)
    fri: FriConfig = field(default_factory=FriConfig)
    krl: KrlConfig = field(default_factory=KrlConfig)
    policy: KrcPolicy = field(default_factory=KrcPolicy)
    limits: str = "lwr4plus.yaml"
    faults: tuple[dict[str, Any], ...] = ()
    schedule: tuple[dict[str, Any], ...] = ()
    source: Path = field(default=Path(), init=False)

    def __post_init__(self) -> None:
        if self.schema_version != 1:
            raise ConfigurationError(
                f"schema_version {self.schema_version} is unknown; this software reads 1"
            )
        if self.seed < 0:
            raise ConfigurationError(f"seed {self.seed} is negative")

    def beside(self, name: str) -> Path:
        """Path of the file `name` of this configuration."""
        return find(name, beside=self.source.parent)


def load_configuration(
    name: str | Path = "emulator/default.yaml", overrides: Mapping[str, Any] | None = None
) -> EmulatorConfig:
    """Read and check an emulator configuration.

    overrides : values by dotted key (`robot.payload`) in place of those of the file
    Raises ConfigurationError with file, key, value and advice.
    """
    path = find(name)
    content = _with_base(path, ())
    for key, value in (overrides or {}).items():
        _put(content, key, value)
    config = parse(EmulatorConfig, content, str(path))
    object.__setattr__(config, "source", path)
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


def _with_base(path: Path, seen: tuple[Path, ...]) -> dict[str, Any]:
    if path in seen:
        raise ConfigurationError(f"{path}: `base` leads back to this file")
    content = read_mapping(path)
    base = content.pop("base", None)
    if base is None:
        return content
    if not isinstance(base, str):
        raise ConfigurationError(f"{path}: `base` must be the name of a file, found {base!r}")
    return _merge(_with_base(find(base, beside=path.parent), (*seen, path)), content)


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
