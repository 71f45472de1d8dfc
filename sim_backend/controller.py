"""The controller's joint position control and its model of the arm.

Every millisecond, per joint, from the setpoint `q_d` and the controller's own gravity torque `g`::

    theta_d = q_d + g / K                                               (torsion under load)
    tau_m   = g + friction(theta_d') + Kp (theta_d - theta) + Kd (theta_d' - theta') + Kt (g - tau_j)

within the torque limits of the motors. This is the state feedback of motor position, motor velocity and joint
torque of Albu-Schaeffer, Ott and Hirzinger (2007). `Kt` reduces the apparent motor inertia by `1 + Kt`, so the
motor side damps the oscillation of the link on its elastic joint. Friction compensation follows the commanded
speed.

Joint impedance control is a spring and damper about the setpoint on top of the controller's own dynamic model::

    tau_d = K (q_d - q) - D q' + tau_add + g,   D = 2 zeta sqrt(K M),   M = diag of mass matrix + Ia / (1 + Kt)
    tau_m = tau_d + Kt (tau_d - tau_j) + friction(theta')

`K`, `zeta` and `tau_add` come with the command. Gravity compensation is the same without spring.
"""

from __future__ import annotations

import math

import numpy as np
import pinocchio as pin
from numba import njit

from fri.errors import ConfigurationError
from sim_backend import bodies
from sim_backend.configuration import ControllerConfig, LoadData
from sim_backend.plant import CYCLE_S
from sim_backend.robot import Payload, with_payload


@njit(cache=True)
def feedback(setpoint, gravity, motor_position, joint_torque, gains, memory, settings, out):  # type: ignore[no-untyped-def]
    """One cycle of the law above.

    gains : rows K, Kp, Kd, Kt, viscous, Coulomb, limit. memory : rows theta_d, theta, theta_d' and theta'
    filtered
    settings : cycle [s], filter constants of commanded and measured speed, Coulomb speed
    """
    cycle, keep_command, keep_speed, slow = settings[0], settings[1], settings[2], settings[3]
    for i in range(setpoint.shape[0]):
        wanted = setpoint[i] + gravity[i] / gains[0, i]
        memory[2, i] = keep_command * memory[2, i] + (1.0 - keep_command) * (wanted - memory[0, i]) / cycle
        memory[3, i] = (
            keep_speed * memory[3, i] + (1.0 - keep_speed) * (motor_position[i] - memory[1, i]) / cycle
        )
        memory[0, i] = wanted
        memory[1, i] = motor_position[i]
        speed = memory[2, i]
        torque = (
            gravity[i]
            + gains[4, i] * speed
            + gains[5, i] * min(1.0, max(-1.0, speed / slow))
            + gains[1, i] * (wanted - motor_position[i])
            + gains[2, i] * (speed - memory[3, i])
            + gains[3, i] * (gravity[i] - joint_torque[i])
        )
        out[i] = min(gains[6, i], max(-gains[6, i], torque))


@njit(cache=True)
def _impedance(  # type: ignore[no-untyped-def]
    setpoint, gravity, position, motor_position, joint_torque, spring, gains, memory, settings, out
):
    """One cycle of the spring law.

    spring : rows K [Nm/rad], D [Nm s/rad], tau_add [Nm]. gains, memory : as in `feedback`
    settings : cycle [s], filter constant of the measured speed, Coulomb speed, torque gain
    """
    cycle, keep, slow, feedback = settings[0], settings[1], settings[2], settings[3]
    for i in range(setpoint.shape[0]):
        memory[3, i] = keep * memory[3, i] + (1.0 - keep) * (motor_position[i] - memory[1, i]) / cycle
        memory[0, i] = setpoint[i] + gravity[i] / gains[0, i]
        memory[1, i] = motor_position[i]
        memory[2, i] = 0.0
        speed = memory[3, i]
        wanted = spring[0, i] * (setpoint[i] - position[i]) - spring[1, i] * speed + spring[2, i] + gravity[i]
        torque = (
            wanted
            + feedback * (wanted - joint_torque[i])
            + gains[4, i] * speed
            + gains[5, i] * min(1.0, max(-1.0, speed / slow))
        )
        out[i] = min(gains[6, i], max(-gains[6, i], torque))


@njit(cache=True)
def external(joint_torque, bias, mass, change, keep, estimate):  # type: ignore[no-untyped-def]
    """Low-pass of `joint_torque - mass @ change - bias` into `estimate`."""
    for i in range(estimate.shape[0]):
        modelled = bias[i]
        for j in range(estimate.shape[0]):
            modelled += mass[i, j] * change[j]
        estimate[i] = keep * estimate[i] + (1.0 - keep) * (joint_torque[i] - modelled)


@njit(cache=True)
def difference(position: np.ndarray, period: float, keep: float, memory: np.ndarray) -> None:
    """Filtered speed and its rate. memory : rows position before, speed, acceleration."""
    for i in range(position.shape[0]):
        speed = keep * memory[1, i] + (1.0 - keep) * (position[i] - memory[0, i]) / period
        memory[2, i] = (speed - memory[1, i]) / period
        memory[1, i] = speed
        memory[0, i] = position[i]


@njit(cache=True)
def differences(positions, period, keep, memory, memories):  # type: ignore[no-untyped-def]
    """`difference` for the positions (m, n) of successive cycles; `memories` (m, 3, n) keeps the memory after each."""
    for k in range(positions.shape[0]):
        difference(positions[k], period, keep, memory)
        memories[k] = memory


@njit(cache=True)
def externals(chain, positions, joint_torques, masses, memories, keep, estimate, estimates):  # type: ignore[no-untyped-def]
    """`external` for successive cycles; `estimates` (m, n) keeps the estimate after each."""
    bias = np.empty(estimate.shape[0])
    for k in range(joint_torques.shape[0]):
        bodies.torques(chain, positions[k], memories[k, 1], bias)
        external(joint_torques[k], bias, masses[k], memories[k, 2], keep, estimate)
        estimates[k] = estimate


@njit(cache=True)
def poses(chain, positions, out):  # type: ignore[no-untyped-def]
    """Poses of the flange (m, 12) at positions (m, n)."""
    for k in range(positions.shape[0]):
        bodies.pose(chain, positions[k], out[k])


def _keep(cutoff_hz: float, period_s: float = CYCLE_S) -> float:
    """Weight of the old value in a first-order low-pass, per cycle."""
    return math.exp(-2.0 * math.pi * cutoff_hz * period_s)


# Speed up to which the measured speed gives no sure direction for the friction compensation [rad/s].
_IMPEDANCE_SPEED = 0.05


class PositionController:
    """State feedback on the motors, for position or for a spring; arrays are (n,) float64."""

    def __init__(self, config: ControllerConfig) -> None:
        self.gains = np.array(
            [
                config.stiffness,
                config.position_gain,
                config.velocity_gain,
                config.torque_gain,
                config.viscous,
                config.coulomb,
                config.torque_limit,
            ]
        )
        self.settings = np.array(
            [CYCLE_S, _keep(config.command_cutoff_hz), _keep(config.velocity_cutoff_hz), config.coulomb_speed]
        )
        self._impedance = np.array(
            [
                CYCLE_S,
                _keep(config.velocity_cutoff_hz),
                _IMPEDANCE_SPEED,
                config.impedance_torque_gain,
            ]
        )
        self._inertia = np.array(config.motor_inertia) / (1.0 + config.impedance_torque_gain)
        self._free_damping = np.array(config.free_damping)
        self.memory = np.zeros((4, self.gains.shape[1]))
        self._spring = np.zeros((3, self.gains.shape[1]))
        self.torque = np.zeros(self.gains.shape[1])

    def reset(self, setpoint: np.ndarray, gravity: np.ndarray, motor_position: np.ndarray) -> None:
        """Begin from rest."""
        self.memory[0] = setpoint + gravity / self.gains[0]
        self.memory[1] = motor_position
        self.memory[2:] = 0.0
        self.torque[:] = 0.0

    def cycle(
        self, setpoint: np.ndarray, gravity: np.ndarray, motor_position: np.ndarray, joint_torque: np.ndarray
    ) -> np.ndarray:
        """Motor torque of the coming millisecond, referred to the joint [Nm]; the array is reused."""
        feedback(
            setpoint,
            gravity,
            motor_position,
            joint_torque,
            self.gains,
            self.memory,
            self.settings,
            self.torque,
        )
        return self.torque

    def set_spring(
        self, stiffness: np.ndarray, damping: np.ndarray, torque: np.ndarray, mass_matrix: np.ndarray
    ) -> None:
        """Spring of the coming cycles: stiffness [Nm/rad], damping ratio, additional torque [Nm], all (n,).

        mass_matrix : (n, n) [kg m^2]
        """
        self._spring[0] = stiffness
        self._spring[1] = 2.0 * damping * np.sqrt(stiffness * (np.diag(mass_matrix) + self._inertia))
        self._spring[2] = torque

    def set_free(self) -> None:
        """Gravity compensation: no spring, a little damping."""
        self._spring[:] = 0.0
        self._spring[1] = self._free_damping

    def spring_cycle(
        self,
        setpoint: np.ndarray,
        gravity: np.ndarray,
        position: np.ndarray,
        motor_position: np.ndarray,
        joint_torque: np.ndarray,
    ) -> np.ndarray:
        """As `cycle`, for the spring of `set_spring` or `set_free`; gravity : at `position`."""
        _impedance(
            setpoint,
            gravity,
            position,
            motor_position,
            joint_torque,
            self._spring,
            self.gains,
            self.memory,
            self._impedance,
            self.torque,
        )
        return self.torque


class ControllerModel:
    """Rigid-body model inside the controller: CAD-like arm and load data.

    `gravity` is renewed by every `update_gravity`; `mass_matrix` (n, n), `jacobian` (6, n) of the flange with
    rows X Y Z RZ RY RX in base axes at the flange, by every `update_model`; `flange` (12,) is the pose, 3x4
    row-major.
    """

    def __init__(
        self, model: pin.Model, load: LoadData, external_cutoff_hz: float, flange: str = "flange"
    ) -> None:
        self._bare = model
        self._frame = model.getFrameId(flange) if model.existFrame(flange) else model.nframes - 1
        n = model.nv
        self.gravity, self._rest = np.zeros(n), np.zeros(n)
        self.mass_matrix = np.zeros((n, n))
        self.jacobian = np.zeros((6, n))
        self.external_torque = np.zeros(n)
        self._cutoff_hz = external_cutoff_hz
        self.memory = np.zeros((3, n))
        self._begun = False
        self.gravitation: tuple[float, float, float] = (0.0, 0.0, 9.81)
        self.set_load(load)

    def set_gravitation(self, gravitation: tuple[float, float, float]) -> None:
        """`$GRAVITATION`: the acceleration that holds the base against gravity, in its axes [m/s^2]."""
        self.gravitation = gravitation
        self._bare.gravity.linear = -np.array(gravitation)
        self.set_load(self.load)

    def set_load(self, load: LoadData) -> None:
        """Use `load` from now on, independent of the mounted payload."""
        self.load = load
        body = Payload.from_centre_of_mass(load.mass, load.com, load.inertia) if load.mass > 0.0 else None
        self.model = with_payload(self._bare, body)
        self._data = self.model.createData()
        frame = self.model.frames[self._frame]
        if frame.parentJoint != self.model.njoints - 1:
            raise ConfigurationError(
                f"frame {frame.name!r} of the controller's model is not on the last link"
            )
        self.chain = bodies.chain_of(self.model, frame.placement)

    def update_gravity(self, position: np.ndarray) -> np.ndarray:
        """Gravity torque at `position` (n,) [Nm]; a new array."""
        self.gravity = np.empty(self.gravity.size)
        bodies.torques(self.chain, position, self._rest, self.gravity)
        return self.gravity

    def update_model(self, position: np.ndarray) -> None:
        """Mass matrix and Jacobian at `position`."""
        self.mass_matrix, self.jacobian[:] = self.model_at(position)

    def model_at(self, position: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The same without keeping them."""
        mass_matrix = pin.crba(self.model, self._data, position).copy(order="K")
        jacobian = pin.computeFrameJacobian(
            self.model, self._data, position, self._frame, pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
        )
        return mass_matrix, np.concatenate([jacobian[:3], jacobian[:2:-1]])

    def keep(self, period_s: float) -> float:
        """Weight of the old value in the filter of the external torque, per cycle."""
        return _keep(self._cutoff_hz, period_s)

    def update_external(self, position: np.ndarray, joint_torque: np.ndarray, period_s: float) -> None:
        """Estimated external torque: measured joint torque minus the model, low-pass filtered."""
        if not self._begun:
            self.memory[0] = position
            self._begun = True
        keep, memory = self.keep(period_s), self.memory
        difference(position, period_s, keep, memory)
        bias = np.empty(position.size)
        bodies.torques(self.chain, position, memory[1], bias)
        external(joint_torque, bias, self.mass_matrix, memory[2], keep, self.external_torque)

    def flange(self, position: np.ndarray, out: np.ndarray) -> None:
        """Pose of the flange in the base frame into `out` (12,), 3x4 row-major [R | p]."""
        bodies.pose(self.chain, position, out)
