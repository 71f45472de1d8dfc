"""Replay of a session in simulation: the same commands to the emulated arm with a model, measured minus simulated.

The arm is the emulator's plant with the links, drives and effects of the model and the joint stiffness of the arm's
description. The emulator's position controller gets the announced load; the sensors are without noise. The replay
runs in this process, about ten times faster than the session. A real arm has another controller, so the position
error serves only to compare models.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from fri.errors import ConfigurationError, DataError
from ident.diagnosis import SimulationError
from ident.model import DynamicModel
from ident.rows.filters import low_pass
from ident.rows.sessions import payload_name
from lwr_driver.arm import Arm
from lwr_driver.configuration import find, parse
from lwr_driver.session import Session
from runner.experiment_file import Experiment
from sim_backend.configuration import EmulatorConfig, LoadData, load_configuration
from sim_backend.controller import ControllerModel, PositionController
from sim_backend.model_arm import arm_of, is_possible, model_effects
from sim_backend.plant import CYCLE_S, ElasticArm, Reading
from sim_backend.robot import chain, robot_file, true_arm

Floats = NDArray[np.float64]

_BIN = 20
_SETTLE = 500
_POSES = 100
_COMMAND_HZ = 20.0
_LATEST_S = 0.02
"""A command acts at most this much later than it was logged."""


@dataclass(frozen=True, eq=False)
class Replayed:
    """Measured minus simulated, in means over 20 ms: position (m, n) [rad], motor and joint torque [Nm].

    delay_s : of the commands against their log, estimated from the positions. commanded : whether the log has
    commands; otherwise the measured positions were commanded. exact : whether the model itself was simulated, or the
    nearest physically possible one. borrowed : whether the drives (inertia, friction, offset of the motor side) are
    the emulated arm's, for a model without motor side. duration_s : of the simulation.
    """

    position: Floats
    motor: Floats | None
    joint: Floats | None
    delay_s: float
    commanded: bool
    exact: bool
    borrowed: bool
    duration_s: float


class Replay:
    """Replays sessions of `arm`; call it with a model and sessions.

    sessions : all of the diagnosis, for their numbers. longest_s : longest simulated part of a session, extended for
    an effect at a later moment. config : emulator with the controller. first : by call, the first replayed session
    and its replay.
    """

    def __init__(
        self,
        arm: Arm,
        sessions: Sequence[Session] = (),
        *,
        longest_s: float = 60.0,
        config: EmulatorConfig | None = None,
    ) -> None:
        self.arm = arm
        self.longest_s = longest_s
        self.config = config or load_configuration()
        self._failed: dict[str, dict[str, None]] = {}
        self._uncommanded: dict[str, None] = {}
        self._stood_in: dict[str, None] = {}
        self._borrowed: dict[str, None] = {}
        self._order = sorted(session.start for session in sessions)
        self._delays: dict[int, float] = {}
        self.first: list[tuple[str, Replayed]] = []

    def __call__(self, model: DynamicModel, sessions: Sequence[Session]) -> SimulationError | None:
        """Error over all sessions; None if none can be simulated."""
        squares, count = np.zeros((3, len(self.arm.joint_names))), np.zeros(3)
        for session in sessions:
            name = session.path.name
            number = self._order.index(session.start) if session.start in self._order else None
            try:
                done = replay(
                    model,
                    session,
                    self.arm,
                    self.config,
                    self.longest_s,
                    number=number,
                    delay_s=self._delays.get(session.start),
                )
            except (DataError, ConfigurationError) as error:
                self._failed.setdefault(str(error), {})[name] = None
                continue
            self._delays.setdefault(session.start, done.delay_s)
            if not count[0]:
                self.first.append((name, done))
            if not done.commanded:
                self._uncommanded[name] = None
            if not done.exact:
                self._stood_in[name] = None
            if done.borrowed:
                self._borrowed[name] = None
            for k, part in enumerate((done.position, done.motor, done.joint)):
                if part is not None:
                    squares[k] += np.nansum(part**2, axis=0)
                    count[k] += len(part)
        if not count[0]:
            return None
        rms = [np.sqrt(s / c) if c else None for s, c in zip(squares, count, strict=True)]
        assert rms[0] is not None
        return SimulationError(position=rms[0], motor=rms[1], joint=rms[2])

    @property
    def notes(self) -> tuple[str, ...]:
        """Sessions left out and reasons, and other limits of the replay, a sentence each."""
        found = [f"no simulation of {', '.join(names)}: {reason}" for reason, names in self._failed.items()]
        if self._uncommanded:
            found.append(
                f"{', '.join(self._uncommanded)}: no commands in the log, so the simulated arm followed the measured "
                "positions; the position error shows the tracking of the controller, not the response of the arm"
            )
        if self._stood_in:
            found.append(
                f"replay of {', '.join(self._stood_in)}: the estimated inertias are physically impossible, so the "
                "nearest possible arm was simulated; a more exciting motion would improve the estimate"
            )
        if self._borrowed:
            found.append(
                f"replay of {', '.join(self._borrowed)}: the model has no motor side, so drive inertia, motor friction "
                "and motor offset are those of the emulated arm, its true ones for a session of the emulator; the "
                "position and motor errors say nothing about the drives of this arm. Identify Model 2 from a log with "
                "motor torques"
            )
        return tuple(found)


def replay(
    model: DynamicModel,
    session: Session,
    arm: Arm,
    config: EmulatorConfig,
    longest_s: float,
    *,
    number: int | None = None,
    delay_s: float | None = None,
) -> Replayed:
    """Simulate a session from the beginning of its excitation.

    number : of the session in the diagnosis, from 0. delay_s : of the commands; None: estimated from the positions of
    a first simulation. Raises DataError for a model of no possible arm.
    """
    chosen = session.select(model.structure.chain.joint_names)
    source = chosen.command if chosen.command is not None and len(chosen.command) else None
    if source is None and not len(chosen.joint):
        raise DataError("the session holds no positions")
    joint = chosen.joint
    spans = chosen.spans("period") or ((chosen.start, int(joint.log_time[-1])),)
    start, stop = max(int(spans[0][0]), int(joint.log_time[0])), int(spans[-1][1])
    if source is not None:
        start, stop = max(start, int(source.log_time[0])), min(stop, int(source.log_time[-1]))
    latest = max((float(e["parameters"]["time"]["value"]) for e in _events(model, number)), default=0.0)
    stop = min(stop, start + int(max(longest_s, latest + longest_s / 2.0) * 1e9))
    grid = np.arange(start, stop, int(CYCLE_S * 1e9))
    if len(grid) < 2 * _BIN:
        raise DataError(
            f"commands and positions overlap for less than {2 * _BIN * CYCLE_S:g} s; record a longer session"
        )
    bench = _Bench(model, chosen, arm, config, number, begin_s=(start - chosen.start) * 1e-9)
    measured = _resampled(joint.log_time, joint.position, grid)
    if source is None:
        wanted, delay = _smooth(joint.log_time, joint.position, grid), 0.0
        run = bench.run(wanted)
    else:
        wanted = _resampled(source.log_time, source.position, grid)
        delay = 0.0 if delay_s is None else delay_s
        run = bench.run(_late(wanted, delay))
        if delay_s is None:
            delay = _delay(measured, run[0])
            run = bench.run(_late(wanted, delay))
    position, motor, link = run
    motor_error = None
    if chosen.motor is not None and chosen.motor.effort.shape[1]:
        times = chosen.motor.log_time
        inside = (times >= grid[0]) & (times <= grid[-1])
        motor_error = chosen.motor.effort[inside] - _resampled(grid, motor, times[inside])
    joint_error = None
    if joint.effort.shape[1]:
        joint_error = _binned(_resampled(joint.log_time, joint.effort, grid) - link)
    errors = _binned(measured - position), motor_error, joint_error
    return Replayed(*errors, delay, source is not None, bench.exact, bench.borrowed, len(grid) * CYCLE_S)


class _Bench:
    """A simulated arm under its controller, made for one session."""

    def __init__(
        self,
        model: DynamicModel,
        session: Session,
        arm: Arm,
        config: EmulatorConfig,
        number: int | None,
        begin_s: float,
    ) -> None:
        payload = payload_name(session)
        known = payload if payload in model.structure.payloads else None
        stiffness = np.asarray(arm.stiffness, dtype=float)
        damping = np.array(config.robot.damping, dtype=float)
        if len(stiffness) != model.structure.chain.n or len(damping) != len(stiffness):
            raise DataError(
                f"the simulated arm has {len(damping)} joints, the model {model.structure.chain.n}; "
                "other arms have no simulated controller"
            )
        self.config = config
        self.number, self.begin_s, self.model = number, begin_s - _SETTLE * CYCLE_S, model
        poses = session.joint.position[:: max(1, len(session.joint) // _POSES)]
        self.exact = is_possible(model, poses)
        self.borrowed = "motor" not in model.structure.sides
        self.links, self.drive = arm_of(
            model,
            chain(find(arm.urdf_path)),
            known,
            stiffness=stiffness,
            damping=damping,
            poses=poses,
            motors=true_arm(config, robot_file(config))[1] if self.borrowed else None,
        )
        self.load = _announced_load(session)

    def run(self, wanted: Floats) -> tuple[Floats, Floats, Floats]:
        """Noiseless position, motor and joint torque (N, n) for set points (N, n)."""
        config = self.config
        effects = model_effects(self.model, session=self.number, begin_s=self.begin_s)
        plant = ElasticArm(self.links, self.drive, substeps=config.robot.substeps, effects=effects)
        controller = PositionController(config.controller)
        believed = ControllerModel(
            chain(config.beside(config.controller.urdf)), self.load, config.controller.external_cutoff_hz
        )
        n = wanted.shape[1]
        reading = Reading(*np.zeros((4, n)))
        out = np.zeros((3, len(wanted), n))
        plant.reset(wanted[0])
        controller.reset(wanted[0], believed.update_gravity(wanted[0]), plant.motor_position)
        for k in range(-_SETTLE, len(wanted)):
            setpoint = wanted[max(k, 0)]
            time_s = (k + _SETTLE) * CYCLE_S
            reading.position[:], reading.motor_position[:] = plant.position, plant.motor_position
            reading.joint_torque[:] = plant.joint_torque
            for effect in plant.effects:
                effect.sense(time_s, plant, reading)
            torque = controller.cycle(
                setpoint, believed.update_gravity(setpoint), reading.motor_position, reading.joint_torque
            )
            reading.motor_torque[:] = 0.5 * (plant.motor_torque + torque)
            for effect in plant.effects:
                effect.sense_motor(time_s, plant, reading)
            if k >= 0:
                out[0, k], out[1, k], out[2, k] = reading.position, reading.motor_torque, reading.joint_torque
            plant.step(torque)
            if not np.all(np.isfinite(plant.position)):
                raise DataError("the simulated arm became unstable; the parameters are physically impossible")
        return out[0], out[1], out[2]


def _events(model: DynamicModel, number: int | None) -> list[dict[str, Any]]:
    """Entries of effects at a moment of this session."""
    found = []
    for entry in model.effects:
        parameters = entry["parameters"]
        if "time" in parameters and "session" in parameters:
            own = round(float(parameters["session"]["value"])) - 1
            if own == number:
                found.append(dict(entry))
    return found


def attached_experiment(session: Session) -> Experiment | None:
    """The experiment of a session, from the file in its log; None without a readable one."""
    text = session.attachments.get("experiment.yaml")
    try:
        return None if text is None else parse(Experiment, yaml.safe_load(text), "experiment.yaml")
    except (ConfigurationError, yaml.YAMLError) as error:
        logging.getLogger(__name__).info("%s: %s", session.path.name, error)
        return None


def _announced_load(session: Session) -> LoadData:
    """The load data given to the controller, from the experiment file in the log; else the mass alone."""
    payload = payload_name(session)
    if payload is None:
        return LoadData()
    experiment = attached_experiment(session)
    announced = None if experiment is None else experiment.payloads().get(payload)
    if announced is not None:
        return LoadData(announced.mass, announced.com, announced.inertia)
    return LoadData(float(session.metadata.get("payload_mass", 0.0) or 0.0))


def _delay(measured: Floats, simulated: Floats) -> float:
    """Time [s] by which the measured positions (N, n) lag the simulated ones, by least squares of all joints."""
    speed = np.gradient(simulated, CYCLE_S, axis=0)
    offset = np.mean(measured - simulated, axis=0)
    late = -float(np.sum(speed * (measured - simulated - offset)) / max(float(np.sum(speed**2)), 1e-12))
    return float(np.clip(late, 0.0, _LATEST_S))


def _late(wanted: Floats, delay_s: float) -> Floats:
    """Set points (N, n), `delay_s` later."""
    if delay_s <= 0.0:
        return wanted
    at = np.arange(len(wanted)) * CYCLE_S
    return np.column_stack([np.interp(at - delay_s, at, column) for column in wanted.T])


def _smooth(times: NDArray[np.int64], position: Floats, grid: NDArray[np.int64]) -> Floats:
    """Measured positions as a smooth path (N, n) for the controller."""
    here = (times - times[0]) * 1e-9
    step = float(np.median(np.diff(here)))
    even = np.arange(0.0, here[-1], step)
    values = np.column_stack([np.interp(even, here, column) for column in position.T])
    values = low_pass(values, step, min(_COMMAND_HZ, 0.2 / step))
    return np.asarray(CubicSpline(even, values)((grid - times[0]) * 1e-9))


def _resampled(times: NDArray[np.int64], values: Floats, wanted: NDArray[np.int64]) -> Floats:
    base = int(wanted[0])
    at, here = (wanted - base) * 1e-9, (times - base) * 1e-9
    return np.column_stack([np.interp(at, here, column) for column in values.T])


def _binned(values: Floats) -> Floats:
    count = len(values) // _BIN * _BIN
    return values[:count].reshape(-1, _BIN, values.shape[1]).mean(axis=1)
