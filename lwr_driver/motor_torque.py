"""Motor torques from KRL variables: the samples that a KRL program publishes in `$FRI_TO_REA[]`.

FRI has no motor torque of its own. A KRL program on the controller can write one value per joint into the
REAL variables and count its passes in an INT variable. The variables hold their values over many FRI cycles;
a value is fresh in the cycle in which the counter has changed, and only then. What comes out is one sample
for each fresh value, with the time of the cycle that brought it first and the counter, unwrapped, as its
number. The age of the value when it arrives is that of the KRL loop and cannot be seen here.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fri.errors import ConfigurationError
from lwr_driver.session.columns import JointColumns

__all__ = ["FreshTorques", "KrlMotorTorque", "KrlTorqueDecoder", "TorqueMatch", "match_torques"]

_SLOTS = 16
_LONGEST_STEP = 1000
_FOLLOWS = 0.9
_CLEARLY = 4.0
_LOADED = 0.8
_GAIN = 3.0


@dataclass(frozen=True)
class KrlMotorTorque:
    """Where the motor torques stand in the KRL variables.

    reals : number n of `$FRI_TO_REA[n]` for each joint in kinematic order, 1 to 16
    scale : torque referred to the joint side per unit of the variable, for each joint [Nm/unit]: gear ratio
    times
        torque constant where the variable is a current in ampere
    sign : +1 or -1 for each joint
    counter_int : number n of `$FRI_TO_INT[n]`, which rises by one with each fresh set of values
    counter_modulus : the counter runs from 0 to this minus one
    """

    reals: tuple[int, ...] = (1, 2, 3, 4, 5, 6, 7)
    scale: tuple[float, ...] = (1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0)
    sign: tuple[int, ...] = (1, 1, 1, 1, 1, 1, 1)
    counter_int: int = 1
    counter_modulus: int = 2**31

    def __post_init__(self) -> None:
        if not self.reals or len(set(self.reals)) != len(self.reals):
            raise ConfigurationError(f"`reals` {self.reals} must name a different variable for each joint")
        if not (len(self.reals) == len(self.scale) == len(self.sign)):
            raise ConfigurationError(
                f"`reals`, `scale` and `sign` have {len(self.reals)}, {len(self.scale)} and {len(self.sign)} "
                "entries; each needs one for each joint"
            )
        for name, slots in (("reals", self.reals), ("counter_int", (self.counter_int,))):
            for slot in slots:
                if not 1 <= slot <= _SLOTS:
                    raise ConfigurationError(f"`{name}` has {slot}; KRL variables are numbered 1 to {_SLOTS}")
        if any(sign not in (1, -1) for sign in self.sign):
            raise ConfigurationError(f"`sign` {self.sign} must be 1 or -1 for each joint")
        if any(not np.isfinite(scale) or scale == 0.0 for scale in self.scale):
            raise ConfigurationError(f"`scale` {self.scale} must be finite and not zero for each joint")
        if not 2 <= self.counter_modulus <= 2**32:
            raise ConfigurationError(f"`counter_modulus` {self.counter_modulus} is not within 2 to {2**32}")


@dataclass(frozen=True)
class FreshTorques:
    """Fresh samples: times [ns] (n,), numbers (n,), effort (n, J) [Nm]."""

    log_time: NDArray[np.int64]
    publish_time: NDArray[np.int64]
    sequence: NDArray[np.int64]
    effort: NDArray[np.float64]


class KrlTorqueDecoder:
    """Takes the hold out of the KRL variables, batch by batch; the result does not depend on the batches.

    fresh : samples so far; lost : values that came and went between two cycles; restarts : times the counter
    jumped (the KRL program was started anew); torn : cycles whose values changed without the counter, a KRL
    program that writes the counter first
    """

    def __init__(self, config: KrlMotorTorque) -> None:
        self.config = config
        self.fresh = 0
        self.lost = 0
        self.restarts = 0
        self.torn = 0
        self._columns = [slot - 1 for slot in config.reals]
        self._factor = np.array(config.scale) * np.array(config.sign)
        self._counter: int | None = None
        self._number: int | None = None
        self._values: NDArray[np.float32] | None = None

    def decode(
        self,
        log_time: NDArray[np.int64],
        publish_time: NDArray[np.int64],
        krl_real: NDArray[np.float32],
        krl_int: NDArray[np.int32],
    ) -> FreshTorques:
        """The fresh samples among n cycles; `krl_real`, `krl_int` : (n, 16) as received.

        The values of the very first cycle are not taken: when they became fresh is not known.
        """
        modulus = self.config.counter_modulus
        counter = krl_int[:, self.config.counter_int - 1].astype(np.int64)
        values = np.ascontiguousarray(krl_real[:, self._columns])
        if not len(counter):
            return self._pick(log_time, publish_time, values, np.zeros(0, dtype=np.int64), [])
        before = counter[0] if self._counter is None else self._counter
        steps = np.diff(counter, prepend=before)
        # Bits are compared, so that NaN equals itself.
        bits = values.view(np.uint32)
        held = bits[:1] if self._values is None else self._values.view(np.uint32)
        changed = (np.diff(bits.astype(np.int64), axis=0, prepend=held.astype(np.int64)) != 0).any(axis=1)
        self.torn += int((changed & (steps == 0)).sum())
        rows = np.flatnonzero(steps)
        numbers = []
        for row in rows.tolist():
            advance = int(steps[row]) % modulus
            if self._number is None:
                self._number = int(counter[row]) % modulus
            elif not 1 <= advance <= _LONGEST_STEP:
                self.restarts += 1
                self._number += 1
            else:
                self.lost += advance - 1
                self._number += advance
            numbers.append(self._number)
        self._counter = int(counter[-1])
        self._values = values[-1:].copy()
        self.fresh += len(rows)
        return self._pick(log_time, publish_time, values, rows, numbers)

    def _pick(
        self,
        log_time: NDArray[np.int64],
        publish_time: NDArray[np.int64],
        values: NDArray[np.float32],
        rows: NDArray[np.int64],
        numbers: list[int],
    ) -> FreshTorques:
        return FreshTorques(
            log_time[rows],
            publish_time[rows],
            np.array(numbers, dtype=np.int64),
            values[rows].astype(np.float64) * self._factor,
        )


@dataclass(frozen=True)
class TorqueMatch:
    """How the motor torque of a joint compares with the joint torque sensors.

    correlation : with the sensor of the same joint; gain : slope of the motor torque over that sensor
    follows, follows_correlation : the joint whose sensor it follows best
    """

    joint: str
    correlation: float
    gain: float
    follows: str
    follows_correlation: float

    @property
    def swapped(self) -> bool:
        """Whether another sensor explains it far better than its own: leaves a quarter of the variance."""
        own, other = 1.0 - self.correlation**2, 1.0 - self.follows_correlation**2
        return (
            self.follows != self.joint
            and abs(self.follows_correlation) >= _FOLLOWS
            and own > _CLEARLY * other
        )

    @property
    def suspect(self) -> bool:
        """Whether order, sign or scale look wrong; friction and inertia leave the gain of a load near one."""
        clear = abs(self.correlation) >= _LOADED
        return self.swapped or (clear and not 1.0 / _GAIN < self.gain < _GAIN)

    def __str__(self) -> str:
        if self.swapped:
            return (
                f"motor torque of {self.joint} follows the torque sensor of {self.follows} (correlation "
                f"{self.follows_correlation:.3f}) and not its own ({self.correlation:.3f})"
            )
        return (
            f"motor torque of {self.joint} is {self.gain:.3g} times its torque sensor "
            f"(correlation {self.correlation:.3f})"
        )


def match_torques(joint: JointColumns, motor: JointColumns) -> tuple[TorqueMatch, ...]:
    """Compare motor torques with the joint torque sensors, interpolated at the times of the motor torques.

    Motor torque is sensor torque plus friction and drive inertia, so a joint that carries a load correlates
    with itself.
    """
    sensor = np.stack(
        [np.interp(motor.log_time, joint.log_time, column) for column in joint.effort.T], axis=1
    )
    a, b = sensor - sensor.mean(axis=0), motor.effort - motor.effort.mean(axis=0)
    norm_a, norm_b = np.linalg.norm(a, axis=0), np.linalg.norm(b, axis=0)
    pairs = (b.T @ a) / np.maximum(norm_b[:, None] * norm_a[None, :], 1e-300)
    matches = []
    for row, name in enumerate(motor.names):
        best = int(np.argmax(np.abs(pairs[row])))
        gain = float(b[:, row] @ a[:, row] / max(float(norm_a[row] ** 2), 1e-300))
        matches.append(
            TorqueMatch(name, float(pairs[row, row]), gain, joint.names[best], float(pairs[row, best]))
        )
    return tuple(matches)
