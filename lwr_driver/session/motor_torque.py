"""Motor torques from KRL variables: samples published by a KRL program in `$FRI_TO_REA[]`.

FRI has no motor torque of its own. A KRL program on the controller can write one value per joint into the
REAL variables and count its passes in an INT variable. The variables hold their values over many FRI cycles;
a value is fresh only in the cycle of a change of the counter. The result is one sample for each fresh value,
with the time of its first cycle and the unwrapped counter as its number. The age of the value on arrival is
up to the KRL loop and unknown here.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from fri.errors import ConfigurationError
from fri.quantities import check, entries, within
from lwr_driver.session.session import JointColumns

_Slot = Annotated[int, within(1, 16, note="KRL variables are numbered from 1")]
_Scale = Annotated[float, within(-1e6, 1e6, "Nm")]
_Sign = Annotated[int, within(-1, 1)]
_LONGEST_STEP = 1000
_FOLLOWS = 0.9
_CLEARLY = 4.0
_LOADED = 0.8
_GAIN = 3.0
_SMOOTHING_S = 0.1
_CREEP = 0.01  # below this speed [rad/s] the sign of the friction is uncertain


@dataclass(frozen=True)
class KrlMotorTorque:
    """Places of the motor torques in the KRL variables.

    reals : number n of `$FRI_TO_REA[n]` for each joint in kinematic order, 1 to 16
    scale : torque referred to the joint side per unit of the variable, for each joint [Nm/unit]: gear ratio
        times torque constant for a current in ampere
    sign : +1 or -1 for each joint
    counter_int : number n of `$FRI_TO_INT[n]`, rising by one with each fresh set of values
    counter_modulus : the counter runs from 0 to this minus one
    """

    reals: Annotated[tuple[_Slot, ...], entries(1, 16)] = (1, 2, 3, 4, 5, 6, 7)
    scale: tuple[_Scale, ...] = (1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0)
    sign: tuple[_Sign, ...] = (1, 1, 1, 1, 1, 1, 1)
    counter_int: _Slot = 1
    counter_modulus: Annotated[int, within(2, 2**32)] = 2**31

    def __post_init__(self) -> None:
        check(self)
        if not self.reals or len(set(self.reals)) != len(self.reals):
            raise ConfigurationError(f"`reals` {self.reals} must name a different variable for each joint")
        if not (len(self.reals) == len(self.scale) == len(self.sign)):
            raise ConfigurationError(
                f"`reals`, `scale` and `sign` have {len(self.reals)}, {len(self.scale)} and {len(self.sign)} "
                "entries; each needs one for each joint"
            )
        if any(sign not in (1, -1) for sign in self.sign):
            raise ConfigurationError(f"`sign` {self.sign} must be 1 or -1 for each joint")
        if any(not np.isfinite(scale) or scale == 0.0 for scale in self.scale):
            raise ConfigurationError(f"`scale` {self.scale} must be finite and not zero for each joint")


@dataclass(frozen=True)
class FreshTorques:
    """Fresh samples: times [ns] (n,), numbers (n,), effort (n, J) [Nm]."""

    log_time: NDArray[np.int64]
    publish_time: NDArray[np.int64]
    sequence: NDArray[np.int64]
    effort: NDArray[np.float64]


class KrlTorqueDecoder:
    """Extracts fresh values from the held KRL variables; the result does not depend on the batches.

    fresh : samples so far; lost : values overwritten between two cycles
    restarts : jumps of the counter (a new start of the KRL program)
    torn : cycles with new values without a new counter (a KRL program writing the counter first)
    rejected : fresh samples with a value that is not finite; they are dropped, and missing in the numbers
    """

    def __init__(self, config: KrlMotorTorque) -> None:
        self.config = config
        self.fresh = 0
        self.lost = 0
        self.restarts = 0
        self.torn = 0
        self.rejected = 0
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

        The values of the very first cycle are not taken: their age is unknown.
        """
        modulus = self.config.counter_modulus
        counter = krl_int[:, self.config.counter_int - 1].astype(np.int64)
        values = np.ascontiguousarray(krl_real[:, self._columns])
        before = counter[:1] if self._counter is None else self._counter
        steps = np.diff(counter, prepend=before)
        # Comparison by bits: NaN equals itself.
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
        if len(counter):
            self._counter, self._values = int(counter[-1]), values[-1:].copy()
        effort = values[rows].astype(np.float64) * self._factor
        finite = np.isfinite(effort).all(axis=1)
        rows, numbered = rows[finite], np.array(numbers, dtype=np.int64)[finite]
        self.rejected += int((~finite).sum())
        self.fresh += len(rows)
        return FreshTorques(log_time[rows], publish_time[rows], numbered, effort[finite])


@dataclass(frozen=True)
class TorqueMatch:
    """Comparison of the motor torque of a joint with the joint torque sensors.

    The motor of a joint carries its sensor's torque, inertia and friction (equation 2 of the model),

        tau = gain tau_l + Ia qdd + Fv qd + Fc sign(qd) + off.

    The equation is fitted with the sensor and the motion of every joint.

    correlation : multiple correlation of the fit with the joint's own sensor and motion; gain : its gain
    load : partial correlation of the sensor alone, beside inertia and friction
    follows, follows_correlation : the joint with the best explanation by sensor and motion
    """

    joint: str
    correlation: float
    gain: float
    load: float
    follows: str
    follows_correlation: float

    @property
    def swapped(self) -> bool:
        """Whether another joint explains it far better: it leaves at most a quarter of the variance."""
        own, other = 1.0 - self.correlation**2, 1.0 - self.follows_correlation**2
        return self.follows != self.joint and self.follows_correlation >= _FOLLOWS and own > _CLEARLY * other

    @property
    def suspect(self) -> bool:
        """Whether order, sign or scale look wrong; friction and inertia leave the gain of a load near one."""
        return self.swapped or (self.load >= _LOADED and not 1.0 / _GAIN < self.gain < _GAIN)

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

    Without recorded positions, friction and inertia are left out.
    """
    sensors, motions = _at_times(joint, motor)
    torques = motor.effort - motor.effort.mean(axis=0)
    total = np.maximum((torques**2).sum(axis=0), 1e-300)
    explained = np.empty((len(joint.names), len(motor.names)))
    gains, loads = np.zeros(len(motor.names)), np.zeros(len(motor.names))
    for candidate in range(len(joint.names)):
        basis = motions[candidate]
        rest = torques - basis @ (basis.T @ torques)
        own = sensors[:, candidate] - basis @ (basis.T @ sensors[:, candidate])
        power = max(float(own @ own), 1e-300)
        slope = (own @ rest) / power
        left = np.maximum((rest**2).sum(axis=0) - slope**2 * power, 0.0)
        explained[candidate] = np.sqrt(1.0 - np.minimum(left / total, 1.0))
        name = joint.names[candidate]
        if name in motor.names:
            place = motor.names.index(name)
            gains[place] = slope[place]
            before = max(float((rest[:, place] ** 2).sum()), 1e-300)
            loads[place] = np.sqrt(max(0.0, 1.0 - float(left[place]) / before))
    matches = []
    for place, name in enumerate(motor.names):
        best = int(np.argmax(explained[:, place]))
        mine = float(explained[joint.names.index(name), place]) if name in joint.names else 0.0
        gain, load = float(gains[place]), float(loads[place])
        follows = joint.names[best], float(explained[best, place])
        matches.append(TorqueMatch(name, mine, gain, load, *follows))
    return tuple(matches)


def _at_times(
    joint: JointColumns, motor: JointColumns
) -> tuple[NDArray[np.float64], list[NDArray[np.float64]]]:
    """At the times of the motor torques: sensors (n, J) without their means, and an orthonormal basis of
    constant, velocity, its sign, and acceleration for each joint.
    """
    # Not at the top: the recorder imports this module and must stay light.
    from scipy.signal import savgol_filter

    def there(column: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.interp(motor.log_time, joint.log_time, column)

    sensors = np.stack([there(column) for column in joint.effort.T], axis=1)
    constant = np.ones((len(motor), 1))
    columns = [[constant[:, 0]] for _ in joint.names]
    width = 2 * round(0.5 * _SMOOTHING_S / joint.period_s) + 1 if len(joint) > 1 else 0
    if joint.position.shape[1] and 5 <= width < len(joint):
        velocity, acceleration = (
            savgol_filter(joint.position, width, 3, deriv=order, delta=joint.period_s, axis=0)
            for order in (1, 2)
        )
        for place, column in enumerate(columns):
            qd = there(velocity[:, place])
            column += [qd, np.tanh(qd / _CREEP), there(acceleration[:, place])]
    bases = []
    for column in columns:
        table = np.stack(column, axis=1)
        table /= np.maximum(np.linalg.norm(table, axis=0), 1e-300)
        left, values, _ = np.linalg.svd(table, full_matrices=False)
        bases.append(left[:, values > 1e-6 * values[0]])
    return sensors - sensors.mean(axis=0), bases
