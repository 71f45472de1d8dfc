"""The arm itself: elastic joints, friction and rigid links, advanced 1 ms at a time.

`Plant` is the interface of the physics to the rest of the emulator; tests put other physics in its place.
`ElasticArm` is the plant of the default emulator, a `PlantEffect` an addition to its equations.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
import pinocchio as pin
from numba import njit

from sim_backend import bodies
from sim_backend.robot import Drive, Payload, with_payload
from sim_backend.stiction import advance

CYCLE_S = 1e-3


@runtime_checkable
class Plant(Protocol):
    """An arm of n joints with motors; arrays are (n,) float64 in SI units and keep their identity.

    `position`, `velocity`: links; `motor_position`, `motor_velocity`: motors, referred to the joint;
    `joint_torque`: through the joint, positive if it holds the link against gravity; `motor_torque`: true torque
    of the motor, referred to the joint.
    """

    position: np.ndarray
    velocity: np.ndarray
    motor_position: np.ndarray
    motor_velocity: np.ndarray
    joint_torque: np.ndarray
    motor_torque: np.ndarray

    def reset(self, position: np.ndarray) -> None:
        """Put the links at rest at `position` (n,) in static equilibrium."""

    def step(self, motor_torque: np.ndarray) -> None:
        """Advance by 1 ms under the motor torque (n,) [Nm], held."""

    def mount(self, payload: Payload | None) -> None:
        """Weld `payload` to the last link (None: take it off); motors unmoved, links at rest."""

    def brake(self, engaged: bool) -> None:
        """Close or open the brakes on the motor side."""

    def push(self, torque: np.ndarray) -> None:
        """External torque (n,) on the links [Nm], until changed: a person, a contact."""


@dataclass
class Loads:
    """Torques and friction of the coming cycle, open to the effects; (n,) each.

    `motor_torque` and `link_torque` [Nm] are added on the two sides of the elastic joint, positive in the
    direction of motion (a resisting torque is negative). The friction rows begin with the nominal values;
    sticking stays exact after a change.
    """

    motor_torque: np.ndarray
    link_torque: np.ndarray
    Fvm: np.ndarray
    Fcm: np.ndarray
    offm: np.ndarray
    Fvl: np.ndarray
    Fcl: np.ndarray
    offl: np.ndarray


@dataclass
class Reading:
    """Sensor values of a cycle, (n,) each; an effect on a sensor changes them in place."""

    position: np.ndarray
    motor_position: np.ndarray
    joint_torque: np.ndarray
    motor_torque: np.ndarray


class PlantEffect:
    """Physics beyond the nominal equations; a subclass overrides some of the methods.

    Called once per 1 ms cycle. Its state must follow from its random stream and its arguments only.
    """

    def start(self, joints: int, random: np.random.Generator) -> None:
        """Begin a run of an arm with `joints` joints; `random` is this effect's own stream."""

    def load(self, time_s: float, plant: Plant, loads: Loads) -> None:
        """Change the torques and the friction of the cycle from `time_s` on."""

    def sense(self, time_s: float, plant: Plant, reading: Reading) -> None:
        """Change the reported position and joint torque at `time_s`, for the controller too."""

    def sense_motor(self, time_s: float, plant: Plant, reading: Reading) -> None:
        """Change the reported motor torque at `time_s`."""


@njit(cache=True)
def predict(position, velocity, before, half, middle):  # type: ignore[no-untyped-def]
    """Position and velocity after `half` a cycle [s], from the velocities now and a cycle before.

    Evaluating the link equations there makes them second order. `before` takes the velocity of now.
    """
    for i in range(position.shape[0]):
        middle[1, i] = 1.5 * velocity[i] - 0.5 * before[i]
        middle[0, i] = position[i] + half * middle[1, i]
        before[i] = velocity[i]


class ElasticArm:
    """Two masses per joint (see `stiction`), rigid links and payload (see `bodies`).

    The mass matrix and the gravity, centrifugal and Coriolis torques are evaluated once per cycle, at its
    extrapolated midpoint; the joints advance in `substeps` steps within the cycle.
    """

    def __init__(
        self,
        model: pin.Model,
        drive: Drive,
        *,
        substeps: int = 4,
        cycle_s: float = CYCLE_S,
        effects: Sequence[PlantEffect] = (),
        random: np.random.SeedSequence | None = None,
    ) -> None:
        n = model.nv
        self.bare = model
        self.drive = drive
        self.substeps = substeps
        self.cycle_s = cycle_s
        self.cycles = 0
        self.descents = 0
        self.energy = np.zeros(3)
        self.state = np.zeros((4, n))
        self.motor_position, self.motor_velocity, self.position, self.velocity = self.state
        self.joint_torque = np.zeros(n)
        self.motor_torque = np.zeros(n)
        self.payload: Payload | None = None
        self.effects = tuple(effects)
        self.modes = np.zeros((2, n), dtype=np.int64)
        self.joint = np.array([drive.Ia, drive.stiffness, drive.damping], dtype=float)
        self._nominal = np.array(
            [drive.Fvm, drive.Fcm, drive.offm, drive.Fvl, drive.Fcl, drive.offl], dtype=float
        )
        self.friction = self._nominal.copy()
        self._push = np.zeros(n)
        self.pushed = False
        self.last_velocity = np.zeros(n)
        self._middle = np.zeros((2, n))
        self._mass, self._bias = np.zeros((n, n)), np.zeros(n)
        self.loads = Loads(np.zeros(n), np.zeros(n), *self.friction)
        streams = (random or np.random.SeedSequence(0)).spawn(len(self.effects))
        for effect, stream in zip(self.effects, streams, strict=True):
            effect.start(n, np.random.default_rng(stream))
        self._use(model)
        self.reset(np.zeros(n))

    def _use(self, model: pin.Model) -> None:
        self.model = model
        self._data = model.createData()
        self.chain = bodies.chain_of(model)

    def reset(self, position: np.ndarray) -> None:
        """Links at rest at `position` (n,), with gravity and offset carried by the torsion of the joints."""
        self.position[:] = position
        self.velocity[:] = 0.0
        self.motor_velocity[:] = 0.0
        self.last_velocity[:] = 0.0
        load = pin.computeGeneralizedGravity(self.model, self._data, self.position) + self._nominal[5]
        load -= self._push
        self.motor_position[:] = self.position + load / self.joint[1]
        self.modes[:] = 0
        self.joint_torque[:] = self.joint[1] * (self.motor_position - self.position)

    def mount(self, payload: Payload | None) -> None:
        """Weld `payload` to the last link; the links settle at rest, the motors stay."""
        self.payload = payload
        self._use(with_payload(self.bare, payload))
        self.velocity[:] = 0.0
        self.motor_velocity[:] = 0.0
        self.last_velocity[:] = 0.0
        for _ in range(50):
            load = pin.computeGeneralizedGravity(self.model, self._data, self.position) + self._nominal[5]
            self.position[:] = self.motor_position - (load - self._push) / self.joint[1]
        self.joint_torque[:] = self.joint[1] * (self.motor_position - self.position)

    def brake(self, engaged: bool) -> None:
        """The brakes add their torque to the motor-side Coulomb friction, so they hold without drift."""
        self._nominal[1] = self.drive.Fcm + (self.drive.brake_torque if engaged else 0.0)
        self.friction[:] = self._nominal

    def push(self, torque: np.ndarray) -> None:
        """External torque (n,) on the links [Nm], until changed."""
        self._push[:] = torque
        self.pushed = bool(np.any(self._push))

    def step(self, motor_torque: np.ndarray) -> None:
        """Advance by one cycle under the motor torque (n,) [Nm], held."""
        self.motor_torque[:] = motor_torque
        middle, middle_velocity = self._middle
        predict(self.position, self.velocity, self.last_velocity, 0.5 * self.cycle_s, self._middle)
        mass, bias = self._mass, self._bias
        bodies.mass_matrix(self.chain, middle, mass)
        bodies.torques(self.chain, middle, middle_velocity, bias)
        drive_torque = self.motor_torque
        if self.effects or self.pushed:
            loads = self.loads
            loads.motor_torque[:] = 0.0
            loads.link_torque[:] = self._push
            self.friction[:] = self._nominal
            time_s = self.cycles * self.cycle_s
            for effect in self.effects:
                effect.load(time_s, self, loads)
            bias = bias - loads.link_torque
            drive_torque = self.motor_torque + loads.motor_torque
        self.descents += advance(
            self.state,
            self.modes,
            mass,
            bias,
            drive_torque,
            self.joint,
            self.friction,
            self.cycle_s,
            self.substeps,
            self.joint_torque,
            self.energy,
        )
        self.cycles += 1
