"""The hidden sensor chain: from true torques and positions to readings."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from numba import njit

from sim_backend.plant import Plant, PlantEffect, Reading
from tests.hidden_physics.traits import JOINTS

__all__ = ["FAULTS", "SensorChain"]

_HEALTHY: dict[str, float] = {
    # joint torque sensor: scale; play [Nm], half the width, and share of the torque that passes through it;
    # clipping [Nm]; zero at the beginning [Nm], drift [Nm/s], creep towards [Nm] with time constant [s];
    # ripple [Nm], count per turn of the joint, phase [rad]; lateness [s]
    "gain": 1.0,
    "play": 0.0,
    "play_share": 1.0,
    "clip": math.inf,
    "zero": 0.0,
    "drift": 0.0,
    "creep": 0.0,
    "creep_time": 8.0,
    "ripple": 0.0,
    "ripple_count": 2.0,
    "ripple_phase": 0.0,
    "late": 0.0,
    # scale by the angle of the other joint (1 to 7), share and phase [rad]
    "other": 0.0,
    "other_scale": 0.0,
    "other_phase": 0.0,
    # motor torque: lateness [s], currents too small to be reported [Nm]
    "motor_late": 0.0,
    "motor_dead": 0.0,
}

FAULTS: tuple[str, ...] = tuple(_HEALTHY)
"""Names in the order of the rows that the kernel reads."""

_AT = {name: place for place, name in enumerate(FAULTS)}
GAIN, PLAY, PLAY_SHARE, CLIP, ZERO, DRIFT, CREEP, CREEP_TIME, RIPPLE, COUNT, PHASE, LATE = (
    _AT[name] for name in FAULTS[:12]
)
OTHER, OTHER_SCALE, OTHER_PHASE, MOTOR_LATE, MOTOR_DEAD = (_AT[name] for name in FAULTS[12:])

_MEMORY = 64


@njit(cache=True)
def _late(values: np.ndarray, rows: np.ndarray, place: int, late: np.ndarray) -> None:
    """Put `values` (n,) into the ring `rows` and take out those of `late` (n,) milliseconds ago, between rows
    by a line.
    """
    size = rows.shape[0]
    for i in range(values.shape[0]):
        rows[place, i] = values[i]
        whole = int(late[i])
        rest = late[i] - whole
        newer = rows[(place - whole) % size, i]
        values[i] = newer + rest * (rows[(place - whole - 1) % size, i] - newer)


@njit(cache=True)
def _chain(
    time_s: float,
    torque: np.ndarray,
    true: np.ndarray,
    angle: np.ndarray,
    f: np.ndarray,
    leak: np.ndarray,
    slack: np.ndarray,
    rows: np.ndarray,
    place: int,
) -> None:
    """The chain of the joint torque sensors, from the `true` torque (n,) to the reading `torque` (n,).

    What the reading holds beyond the truth is the electronics' noise, which comes after the strain gauges.
    """
    n = torque.shape[0]
    felt = np.empty(n)
    for i in range(n):
        felt[i] = true[i]
        for j in range(n):
            felt[i] += leak[i, j] * true[j]
    for i in range(n):
        value = f[GAIN, i] * felt[i]
        if f[OTHER_SCALE, i] != 0.0:
            value *= 1.0 + f[OTHER_SCALE, i] * math.sin(angle[int(f[OTHER, i]) - 1] + f[OTHER_PHASE, i])
        if f[PLAY, i] > 0.0:
            slack[i] = min(value + f[PLAY, i], max(value - f[PLAY, i], slack[i]))
            value += f[PLAY_SHARE, i] * (slack[i] - value)
        value += f[RIPPLE, i] * math.sin(f[COUNT, i] * angle[i] + f[PHASE, i])
        value += f[ZERO, i] + f[DRIFT, i] * time_s + torque[i] - true[i]
        if f[CREEP, i] != 0.0:
            value += f[CREEP, i] * (1.0 - math.exp(-time_s / f[CREEP_TIME, i]))
        torque[i] = min(f[CLIP, i], max(-f[CLIP, i], value))
    _late(torque, rows, place, f[LATE] * 1000.0)


class SensorChain(PlantEffect):
    """An effect on the readings alone.

    faults : values by fault and joint number. leak : "i": {"j": share}, of torque j that sensor i shows
    held : {"every_s": mean time between episodes, "length_s": their length, "what": "packet" or "torque"}:
    the readings do not change for a while
    """

    def __init__(
        self,
        faults: Mapping[str, Mapping[Any, float]] | None = None,
        leak: Mapping[Any, Mapping[Any, float]] | None = None,
        held: Mapping[str, Any] | None = None,
    ) -> None:
        self.faults = np.repeat(np.array(list(_HEALTHY.values()))[:, None], JOINTS, axis=1)
        for name, values in (faults or {}).items():
            if name not in _AT:
                raise KeyError(f"fault {name!r} does not exist")
            for joint, value in values.items():
                self.faults[_AT[name], int(joint) - 1] = value
        self.leak = np.zeros((JOINTS, JOINTS))
        for into, shares in (leak or {}).items():
            for source, share in shares.items():
                self.leak[int(into) - 1, int(source) - 1] = share
        late = self.faults[[LATE, MOTOR_LATE]].max() * 1000.0
        if late > _MEMORY - 2:
            raise ValueError(f"a reading is {late:.0f} ms late; {_MEMORY - 2} ms are remembered")
        self.held = dict(held or {})
        self._begun = False

    def start(self, joints: int, random: np.random.Generator) -> None:
        """See `sim_backend.plant.PlantEffect`."""
        self._random = random
        self._slack = np.zeros(joints)
        self._rows = np.zeros((2, _MEMORY, joints))
        self._place = 0
        self._kept: tuple[np.ndarray, np.ndarray] | None = None
        self._until = 0.0
        self._next = self._pause() if self.held else math.inf

    def _pause(self) -> float:
        return float(self._random.exponential(self.held["every_s"]))

    def sense(self, time_s: float, plant: Plant, reading: Reading) -> None:
        """The joint torque sensors, and readings that stand still."""
        torque = reading.joint_torque
        if not self._begun:
            self._begun = True
            self._slack[:] = plant.joint_torque
            self._rows[0] = torque
        self._place = (self._place + 1) % _MEMORY
        _chain(
            time_s,
            torque,
            plant.joint_torque,
            plant.position,
            self.faults,
            self.leak,
            self._slack,
            self._rows[0],
            self._place,
        )
        if not self.held:
            return
        if time_s >= self._until + self._next:
            self._kept = (np.array(reading.position), np.array(torque))
            self._until = time_s + self.held["length_s"]
            self._next = self._pause()
        if self._kept is not None and time_s < self._until:
            torque[:] = self._kept[1]
            if self.held.get("what", "packet") == "packet":
                reading.position[:] = self._kept[0]

    def sense_motor(self, time_s: float, plant: Plant, reading: Reading) -> None:
        """The motor currents on their way out."""
        torque = reading.motor_torque
        dead = self.faults[MOTOR_DEAD]
        if dead.any():
            torque[:] = np.where(np.abs(torque) < dead, 0.0, torque)
        _late(torque, self._rows[1], self._place, self.faults[MOTOR_LATE] * 1000.0)
