"""Sensors with resolution, offset and noise, and the two ways of the motor torques out of the controller.

The FRI packet has no motor torque. A KRL loop can write one per joint into `$FRI_TO_REA`, with a loop counter
beside it; the values hold between two ticks of the loop. Or the controller records a trace at 1 kHz on its own
clock, and the file is fetched after the motion.
"""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
from numba import njit

from sim_backend.configuration import KrlRealsConfig, SensorConfig, TraceConfig
from sim_backend.plant import CYCLE_S, Plant, Reading

_BLOCK = 1000


@njit(cache=True)
def _quantise(value: float, step: float) -> float:
    return value if step <= 0.0 else step * np.rint(value / step)


@njit(cache=True)
def read(position, motor_position, joint_torque, settings, noise, reading):  # type: ignore[no-untyped-def]
    """Rows of `reading`: position, motor position, joint torque."""
    for i in range(position.shape[0]):
        reading[0, i] = _quantise(position[i] + settings[1, i] * noise[0, i], settings[0, i])
        reading[1, i] = _quantise(motor_position[i], settings[2, i])
        torque = joint_torque[i] + settings[4, i] + settings[3, i] * noise[1, i]
        reading[2, i] = _quantise(torque, settings[5, i])


@njit(cache=True)
def read_motor(before, after, settings, noise, reading):  # type: ignore[no-untyped-def]
    """Row 3 of `reading`: motor torque at the instant between the milliseconds of `before` and `after`."""
    for i in range(before.shape[0]):
        torque = 0.5 * (before[i] + after[i]) + settings[6, i] * noise[2, i]
        reading[3, i] = _quantise(torque, settings[7, i])


class Sensors:
    """Reads a plant once per millisecond, in two steps.

    Position and joint torque come first: the controller needs them for the motor torque of the next millisecond.
    The motor torque at this instant is midway between the torques held before and after it. `reading` holds the
    last values; its arrays keep their identity.
    """

    def __init__(self, config: SensorConfig, joints: int, random: np.random.SeedSequence) -> None:
        self.link_side = config.position_sensor == "link"
        self._streams = [np.random.default_rng(stream) for stream in random.spawn(3)]
        self.settings = np.array(
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
        self.rows = np.zeros((4, joints))
        self._noise = np.zeros((_BLOCK, 3, joints))
        self._next = _BLOCK
        self._row = self._noise[0]
        self.reading = Reading(*self.rows)

    def read(self, plant: Plant) -> Reading:
        """Position, motor position and joint torque at this instant; the motor torque is still the last."""
        self._row = self.noise(1)[0]
        self._next += 1
        position = plant.position if self.link_side else plant.motor_position
        read(position, plant.motor_position, plant.joint_torque, self.settings, self._row, self.rows)
        return self.reading

    def noise(self, most: int) -> np.ndarray:
        """Noise of the next readings, one row each, up to `most` rows (m, 3, n); `skip` takes them."""
        if self._next == _BLOCK:
            for row, stream in enumerate(self._streams):
                self._noise[:, row] = stream.standard_normal(self._noise.shape[::2])
            self._next = 0
        return self._noise[self._next : self._next + most]

    def skip(self, count: int) -> None:
        """Readings taken elsewhere, with the noise of `noise`."""
        self._next += count
        self._row = self._noise[self._next - 1]

    def read_motor(self, before: np.ndarray, after: np.ndarray) -> None:
        """Motor torque at this instant, from the torques (n,) of the milliseconds before and after it."""
        read_motor(before, after, self.settings, self._row, self.rows)


def trace_columns(joint_names: tuple[str, ...]) -> tuple[str, ...]:
    """Header of a trace file: time [s], motor torques referred to the joint [Nm], positions [rad]."""
    return ("time_s", *(f"tau_m_{name}" for name in joint_names), *(f"q_{name}" for name in joint_names))


class _Delay:
    """Last values of a vector, to be read some milliseconds late."""

    def __init__(self, milliseconds: int, size: int) -> None:
        self.rows = np.zeros((milliseconds + 1, size))
        self._next = 0

    def put(self, values: np.ndarray) -> np.ndarray:
        """Take in `values` (size,), return those of `milliseconds` ago; do not keep them."""
        rows = self.rows
        if len(rows) == 1:
            return values
        rows[self._next] = values
        self._next = (self._next + 1) % len(rows)
        # The row to be overwritten next is the oldest.
        return rows[self._next]


class KrlReals:
    """The KRL loop for the motor torques; `millisecond` runs at 1 kHz."""

    def __init__(self, config: KrlRealsConfig, joints: int) -> None:
        self.config = config
        self._indices = np.array(config.reals) - 1
        self._counter = config.counter_int - 1
        self._delay = _Delay(config.delay_ms, joints)
        self._count = 0
        self._elapsed = 0

    def millisecond(self, motor_torque: np.ndarray, to_real: np.ndarray, to_int: np.ndarray) -> None:
        """One millisecond: `motor_torque` (7,) as measured; the KRL variables (16,) are written at a tick."""
        late = self.late(motor_torque)
        self._elapsed += 1
        if self._elapsed < self.config.tick_ms:
            return
        self._elapsed = 0
        self._count = (self._count + 1) & 0x7FFFFFFF
        to_real[self._indices] = late
        to_int[self._counter] = self._count

    @property
    def idle_ms(self) -> int:
        """Milliseconds to come before the next tick; `skip` passes over some of them."""
        return self.config.tick_ms - self._elapsed - 1

    def skip(self, milliseconds: int) -> None:
        """Milliseconds without a tick; without a delay only."""
        self._elapsed += milliseconds

    def late(self, motor_torque: np.ndarray) -> np.ndarray:
        """Take in `motor_torque` (7,), return the one of `delay_ms` ago; do not keep it."""
        return self._delay.put(motor_torque)


class ControllerTrace:
    """The controller's recording at 1 kHz: time on its own clock, motor torque and position of each joint."""

    def __init__(self, config: TraceConfig, joint_names: tuple[str, ...]) -> None:
        self.config = config
        self.columns = trace_columns(joint_names)
        self.recording = False
        self._joints = len(joint_names)
        self._delay = _Delay(config.delay_ms, self._joints)
        self._longest = int(config.longest_s / CYCLE_S)
        self._blocks: list[np.ndarray] = []
        self._block = np.empty((0, 0))
        self._filled = 0
        self._writer: int | None = None

    def start(self) -> None:
        """Begin anew."""
        self._blocks = []
        self._new_block()
        self.recording = True

    def _new_block(self) -> None:
        self._block = np.empty((60_000, 1 + 2 * self._joints))
        self._blocks.append(self._block)
        self._filled = 0
        if (len(self._blocks) - 1) * len(self._block) > self._longest:
            del self._blocks[0]

    def millisecond(self, time_s: float, motor_torque: np.ndarray, position: np.ndarray) -> None:
        """One sample, if recording."""
        if not self.recording and not self.config.delay_ms:
            return
        late = self._delay.put(motor_torque)
        if not self.recording:
            return
        if self._filled == len(self._block):
            self._new_block()
        row = self._block[self._filled]
        row[0] = self.config.clock_offset + time_s * (1.0 + self.config.clock_rate_error)
        row[1 : 1 + self._joints] = late
        row[1 + self._joints :] = position
        self._filled += 1

    def samples(self) -> np.ndarray:
        """The recorded samples, (n, 15), with the columns of `columns`."""
        if not self._blocks:
            return np.empty((0, len(self.columns)))
        return np.concatenate([*self._blocks[:-1], self._block[: self._filled]])[-self._longest :]

    def save(self, path: Path) -> int:
        """End the recording and write it as CSV in a process of its own; returns the number of samples.

        The file appears under its name when it is complete, see `saving`.
        """
        rows = self.samples()
        self.recording = False
        self._blocks = []
        path.parent.mkdir(parents=True, exist_ok=True)
        partial = path.with_name(path.name + ".part")
        partial.touch()
        self._writer = os.fork()
        if self._writer == 0:
            # The controller's cycle must not wait for a disk.
            status = 1
            try:
                header = ",".join(self.columns)
                formats = ["%.6f"] + ["%.6g"] * self._joints + ["%.9f"] * self._joints
                np.savetxt(partial, rows, fmt=formats, delimiter=",", header=header, comments="")
                os.replace(partial, path)
                status = 0
            finally:
                os._exit(status)
        return len(rows)

    def saving(self) -> bool:
        """Whether a file is still being written. Raises OSError once after a failure."""
        if self._writer is None:
            return False
        done, status = os.waitpid(self._writer, os.WNOHANG)
        if done == 0:
            return True
        self._writer = None
        if status != 0:
            raise OSError("the trace file could not be written")
        return False
