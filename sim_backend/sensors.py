"""Sensors: resolution, offset and noise, each sensor with a random stream of its own."""

from __future__ import annotations

import numpy as np
from numba import njit

from sim_backend.configuration import SensorConfig
from sim_backend.plant import Plant, Reading

__all__ = ["Sensors"]

_BLOCK = 1000


@njit(cache=True)
def _quantise(value: float, step: float) -> float:
    return value if step <= 0.0 else step * np.rint(value / step)


@njit(cache=True)
def _read(
    position: np.ndarray,
    motor_position: np.ndarray,
    joint_torque: np.ndarray,
    settings: np.ndarray,
    noise: np.ndarray,
    reading: np.ndarray,
) -> None:
    """Rows of `reading`: position, motor position, joint torque."""
    for i in range(position.shape[0]):
        reading[0, i] = _quantise(position[i] + settings[1, i] * noise[0, i], settings[0, i])
        reading[1, i] = _quantise(motor_position[i], settings[2, i])
        torque = joint_torque[i] + settings[4, i] + settings[3, i] * noise[1, i]
        reading[2, i] = _quantise(torque, settings[5, i])


@njit(cache=True)
def _read_motor(
    before: np.ndarray, after: np.ndarray, settings: np.ndarray, noise: np.ndarray, reading: np.ndarray
) -> None:
    """Row 3 of `reading`: motor torque at the instant between the milliseconds of `before` and `after`."""
    for i in range(before.shape[0]):
        torque = 0.5 * (before[i] + after[i]) + settings[6, i] * noise[2, i]
        reading[3, i] = _quantise(torque, settings[7, i])


class Sensors:
    """Reads a plant once per millisecond, in two steps.

    The controller needs position and joint torque to decide the motor torque of the next millisecond; only
    with that is the motor torque at this instant known, midway between the torques held before and after it.
    `reading` holds the last values; its arrays keep their identity.
    """

    def __init__(self, config: SensorConfig, joints: int, random: np.random.SeedSequence) -> None:
        self._link_side = config.position_sensor == "link"
        self._streams = [np.random.default_rng(stream) for stream in random.spawn(3)]
        self._settings = np.array(
            [
                config.position_resolution,
                config.position_noise,
                config.motor_position_resolution,
                config.joint_torque_noise,
                config.joint_torque_offset,
                config.joint_torque_resolution,
                config.motor_torque_noise,
                config.motor_torque_resolution,
            ]
        )
        self._rows = np.zeros((4, joints))
        self._noise = np.zeros((_BLOCK, 3, joints))
        self._next = _BLOCK
        self._row = self._noise[0]
        self.reading = Reading(*self._rows)

    def read(self, plant: Plant) -> Reading:
        """Position, motor position and joint torque at this instant; the motor torque is still the last
        one.
        """
        if self._next == _BLOCK:
            for row, stream in enumerate(self._streams):
                self._noise[:, row] = stream.standard_normal(self._noise.shape[::2])
            self._next = 0
        self._row = self._noise[self._next]
        self._next += 1
        position = plant.position if self._link_side else plant.motor_position
        _read(position, plant.motor_position, plant.joint_torque, self._settings, self._row, self._rows)
        return self.reading

    def read_motor(self, before: np.ndarray, after: np.ndarray) -> None:
        """Motor torque at this instant, from the torques (n,) held in the milliseconds before and after
        it.
        """
        _read_motor(before, after, self._settings, self._row, self._rows)
