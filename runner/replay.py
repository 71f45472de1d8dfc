"""Simulation of a session with a model: the same commands to the emulated arm, measured against simulated.

The arm is the emulator's plant with the model's links, drives and effects and with joints as stiff as the
arm's description says, under the emulator's position controller; the sensors are without noise. The
controller of a real arm is another one, so its error of position counts for comparing models, not by itself.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from fri.errors import DataError
from ident.cad_prior import cad_prior
from ident.discrepancy import SimulationError
from ident.effects import Simulated, find_effect
from ident.effects.model_torque import parameter_values
from ident.model import DynamicModel
from ident.parameters import INERTIAL, PER_LINK
from lwr_driver.arm import Arm
from lwr_driver.configuration import find
from lwr_driver.session import Session
from sim_backend.configuration import EmulatorConfig, load_configuration
from sim_backend.controller import ControllerModel, PositionController
from sim_backend.plant import CYCLE_S, Drive, Effect, ElasticArm, Reading
from sim_backend.rigid_body import chain, mass_matrix_floor

__all__ = ["Replay", "replay", "simulated_arm"]

Floats = NDArray[np.float64]

_BIN = 20
_SETTLE = 500


class Replay:
    """Replays sessions of `arm`; call it with a model and sessions.

    longest_s : of each session that is simulated. config : emulator whose controller holds the arm.
    """

    def __init__(self, arm: Arm, *, longest_s: float = 20.0, config: EmulatorConfig | None = None) -> None:
        self.arm = arm
        self.longest_s = longest_s
        self.config = config or load_configuration()

    def __call__(self, model: DynamicModel, sessions: Sequence[Session]) -> SimulationError | None:
        """Error over all sessions; None where none has commands or the model belongs to no arm that moves."""
        squares, count = np.zeros((3, self.arm.stiffness.size)), np.zeros(3)
        for session in sessions:
            if session.command is None or not len(session.command):
                continue
            try:
                parts = replay(model, session, self.arm, self.config, self.longest_s)
            except DataError:
                return None
            for k, part in enumerate(parts):
                if part is not None:
                    squares[k] += np.sum(part**2, axis=0)
                    count[k] += len(part)
        if not count[0]:
            return None
        rms = [np.sqrt(s / c) if c else None for s, c in zip(squares, count, strict=True)]
        assert rms[0] is not None
        return SimulationError(position=rms[0], motor=rms[1], joint=rms[2])


def simulated_arm(model: DynamicModel, payload: str | None, arm: Arm, config: EmulatorConfig) -> ElasticArm:
    """The emulator's plant with a model's parameters and effects.

    Of the standard parameters with the model's torque those next to the URDF's are taken. Raises DataError
    when their mass matrix is not positive definite.
    """
    standard = model.standard_parameters()
    if model.base is not None and model.structure.chain.urdf is not None:
        prior = cad_prior(model.base)
        near = np.zeros(model.structure.n_columns)
        near[prior.bodies] = prior.inertial
        standard = model.standard_parameters(near)
    bodies = model.inertial(payload, standard=standard)
    n = model.structure.chain.n
    changed = chain(find(arm.urdf_path))
    for link, body in enumerate(bodies, start=1):
        changed.inertias[link] = _inertia(dict(zip(INERTIAL, body, strict=True)))
    if mass_matrix_floor(changed) <= 0.0:
        raise DataError("the mass matrix of the model is not positive definite, so it cannot be simulated")
    table = standard[: len(PER_LINK) * n].reshape(n, -1)[:, len(INERTIAL) :]
    rows = {symbol: table[:, k].copy() for k, symbol in enumerate(PER_LINK[len(INERTIAL) :])}
    for symbol in ("Fvl", "Fcl", "Fvm", "Fcm"):
        rows[symbol] = np.maximum(rows[symbol], 0.0)
    rows["Ia"] = np.maximum(rows["Ia"], 1e-3)
    drive = Drive(
        **rows,
        stiffness=np.asarray(arm.stiffness, dtype=float),
        damping=np.array(config.robot.damping, dtype=float),
    )
    effects = [_Plugged(part) for part in _parts(model)]
    return ElasticArm(changed, drive, substeps=config.robot.substeps, effects=effects)


def replay(
    model: DynamicModel, session: Session, arm: Arm, config: EmulatorConfig, longest_s: float
) -> tuple[Floats, Floats | None, Floats | None]:
    """Measured less simulated position (m, n) [rad], motor and joint torque [Nm], in means over 20 ms."""
    chosen = session.select(model.structure.chain.joint_names)
    command = chosen.command
    assert command is not None
    spans = chosen.spans("period") or ((chosen.start, int(chosen.joint.log_time[-1])),)
    start = max(int(spans[0][0]), int(command.log_time[0]), int(chosen.joint.log_time[0]))
    stop = min(int(spans[-1][1]), int(command.log_time[-1]), start + int(longest_s * 1e9))
    grid = np.arange(start, stop, int(CYCLE_S * 1e9))
    wanted = _resampled(command.log_time, command.position, grid)
    payload = chosen.metadata.get("payload", "none").strip()
    known = payload if payload in model.structure.payloads else None
    plant = simulated_arm(model, known, arm, config)
    position, motor, joint = _run(plant, wanted, config)
    errors = [_binned(_resampled(chosen.joint.log_time, chosen.joint.position, grid) - position)]
    motor_error = None
    if chosen.motor is not None and chosen.motor.effort.shape[1]:
        times = chosen.motor.log_time
        inside = (times >= grid[0]) & (times <= grid[-1])
        motor_error = chosen.motor.effort[inside] - _resampled(grid, motor, times[inside])
    joint_error = None
    if chosen.joint.effort.shape[1]:
        joint_error = _binned(_resampled(chosen.joint.log_time, chosen.joint.effort, grid) - joint)
    return errors[0], motor_error, joint_error


class _Plugged(Effect):
    """An effect of the model as the plant calls it."""

    def __init__(self, part: Simulated) -> None:
        self.part = part

    def start(self, joints: int, random: np.random.Generator) -> None:
        self.part.start(joints, random)

    def load(self, time_s: float, plant: object, loads: object) -> None:
        self.part.load(time_s, plant, loads)

    def sense(self, time_s: float, plant: object, reading: object) -> None:
        self.part.sense(time_s, plant, reading)

    def sense_motor(self, time_s: float, plant: object, reading: object) -> None:
        self.part.sense_motor(time_s, plant, reading)


def _parts(model: DynamicModel) -> list[Simulated]:
    """The model's effects, those of a moment left out."""
    found = []
    for entry in model.effects:
        effect = find_effect(str(entry["cause"]))
        if not effect.event:
            values = parameter_values(entry)
            found += [effect.simulate(int(joint) - 1, values) for joint in entry["joints"] or [1]]
    return found


def _run(plant: ElasticArm, wanted: Floats, config: EmulatorConfig) -> tuple[Floats, Floats, Floats]:
    """Position, motor and joint torque (N, n) as noiseless sensors report them."""
    controller = PositionController(config.controller)
    believed = ControllerModel(
        chain(config.beside(config.controller.urdf)),
        config.controller.load,
        config.controller.external_cutoff_hz,
    )
    n = wanted.shape[1]
    reading = Reading(*np.zeros((4, n)))
    out = np.zeros((3, len(wanted), n))
    plant.reset(wanted[0])
    controller.reset(wanted[0], believed.update_gravity(wanted[0]), plant.motor_position)
    for k in range(-_SETTLE, len(wanted)):
        setpoint = wanted[max(k, 0)]
        time_s = max(k, 0) * CYCLE_S
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
            raise DataError("the simulated arm became unstable; the parameters belong to no real arm")
    return out[0], out[1], out[2]


def _inertia(values: dict[str, float]) -> pin.Inertia:
    order = ("MX", "MY", "MZ", "XX", "XY", "YY", "XZ", "YZ", "ZZ")
    mass = values["M"] if abs(values["M"]) > 1e-9 else 1e-9
    return pin.Inertia.FromDynamicParameters(np.array([mass, *(values[name] for name in order)]))


def _resampled(times: NDArray[np.int64], values: Floats, wanted: NDArray[np.int64]) -> Floats:
    base = int(wanted[0])
    at, here = (wanted - base) * 1e-9, (times - base) * 1e-9
    return np.column_stack([np.interp(at, here, column) for column in values.T])


def _binned(values: Floats) -> Floats:
    count = len(values) // _BIN * _BIN
    return values[:count].reshape(-1, _BIN, values.shape[1]).mean(axis=1)
