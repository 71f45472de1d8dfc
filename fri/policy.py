"""Limits of the arm, and the thresholds of the controller for the link.

KUKA's documents fix four rules. The timing is rated over the last 100 packets. Command mode needs good timing
"for some time". Extrapolation bridges single dropouts. Limits and errors end command mode. They give no
thresholds: every number of ``KrcPolicy`` is an assumption of this project, plausible and configurable.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Annotated

import numpy as np

from fri.errors import ConfigurationError
from fri.packets import JOINT_NAMES, JOINTS
from fri.quantities import check, within
from fri.states import Quality

_Rate = Annotated[float, within(0.0, 1.0, "share")]
_Factor = Annotated[float, within(0.0, 1000.0, above=True)]
_Packets = Annotated[int, within(0, 100_000)]


@dataclass(frozen=True)
class KrcPolicy:
    """Thresholds of the controller's end; assumptions of this project, not numbers of KUKA.

    Attributes
    ----------
    window : int
        Packets in the rating of the answers (KUKA's own number: 100).
    minimum_packets : int
        Packets before any quality above UNACCEPTABLE is given.
    perfect_rate, ok_rate, bad_rate : float
        Least answer rate for PERFECT, OK and BAD.
    perfect_latency : float
        Largest mean latency for PERFECT, as a fraction of the sample time.
    start_quality : Quality
        Least quality for friStart ...
    start_dwell : int
        ... over so many packets in a row, counted anew after a change of the control mode.
    hold_quality : Quality
        Least quality for staying in command mode.
    bridged_cycles : int
        Consecutive missing answers bridged by linear extrapolation; one more ends command mode.
    drop_on_malformed : bool
        Whether a malformed datagram ends command mode (otherwise it is only a missing answer).
    drop_on_drives_off : bool
        Whether switching the drives off during command mode ends it. Entering it with the drives off is
        normal.
    mirror_tolerance : float
        Largest distance [rad] of the first command, and of any command with the drives off, from the mirror.
    mirror_speed : float
        Speed [rad/s] with which the first command may begin; the tolerance is at least its step in a cycle. KUKA's
        sample client begins a sine with 0.055 rad/s.
    soft_mirror_tolerance : float
        The same [rad] for the first command of joint impedance control: published clients begin at the measured
        position, where the spring sags.
    largest_stiffness, largest_damping : float
        Bounds of commanded joint stiffness [Nm/rad] and damping ratio.
    limit_tolerance : float
        Allowance on position and step limits for the rounding of float32 [rad].
    t1_velocity_factor : float
        Factor on the velocity limits in operating mode T1.
    acceleration_factor : float or None
        Factor on the acceleration limits for commands; None does not check acceleration.
    stop_acceleration_factor : float
        Deceleration of the arm after command mode, as a factor on the acceleration limits.
    stop_jerk_time_s : float
        Rise time of this deceleration [s].
    """

    window: Annotated[int, within(2, 100_000)] = 100
    minimum_packets: Annotated[int, within(1, 100_000)] = 100
    perfect_rate: _Rate = 0.99
    ok_rate: _Rate = 0.95
    bad_rate: _Rate = 0.80
    perfect_latency: _Factor = 0.5
    start_quality: Quality = Quality.OK
    start_dwell: _Packets = 100
    hold_quality: Quality = Quality.BAD
    bridged_cycles: _Packets = 3
    drop_on_malformed: bool = True
    drop_on_drives_off: bool = True
    mirror_tolerance: Annotated[float, within(0.0, 1.0, "rad", above=True)] = 1e-3
    mirror_speed: Annotated[float, within(0.0, 10.0, "rad/s", above=True)] = 0.1
    soft_mirror_tolerance: Annotated[float, within(0.0, 3.0, "rad", above=True)] = 0.1
    largest_stiffness: Annotated[float, within(0.0, 1e6, "Nm/rad", above=True)] = 5000.0
    largest_damping: Annotated[float, within(0.0, 10.0, above=True)] = 1.0
    limit_tolerance: Annotated[float, within(0.0, 1e-3, "rad", below=True)] = 1e-6
    t1_velocity_factor: _Factor = 0.25
    acceleration_factor: _Factor | None = None
    stop_acceleration_factor: _Factor = 1.0
    stop_jerk_time_s: Annotated[float, within(0.0, 10.0, "s", above=True)] = 0.02

    def __post_init__(self) -> None:
        check(self)
        _require(
            self.minimum_packets <= self.window,
            "minimum_packets",
            self.minimum_packets,
            f"within 1..window ({self.window})",
        )
        _require(
            self.bad_rate <= self.ok_rate <= self.perfect_rate,
            "bad_rate, ok_rate, perfect_rate",
            (self.bad_rate, self.ok_rate, self.perfect_rate),
            "ascending within 0..1",
        )


@dataclass(frozen=True)
class KrcLimits:
    """Limits of the arm, each (7,) in wire order.

    q_min, q_max : positions [rad]; v_max : speeds [rad/s]; a_max : accelerations [rad/s^2] of the stop, and of
    commands if the policy has an `acceleration_factor`.
    """

    q_min: np.ndarray
    q_max: np.ndarray
    v_max: np.ndarray
    a_max: np.ndarray

    def __post_init__(self) -> None:
        for field in fields(self):
            values = np.array(getattr(self, field.name), dtype=float)
            if values.shape != (JOINTS,) or not np.isfinite(values).all():
                raise ConfigurationError(f"{field.name} is {values}, must be {JOINTS} finite numbers")
            values.flags.writeable = False
            object.__setattr__(self, field.name, values)
        for joint, name in enumerate(JOINT_NAMES):
            if not self.q_min[joint] < self.q_max[joint]:
                raise ConfigurationError(
                    f"{name} q_min {self.q_min[joint]:.4f} rad is not below q_max {self.q_max[joint]:.4f} rad"
                )
            if not (self.v_max[joint] > 0.0 and self.a_max[joint] > 0.0):
                raise ConfigurationError(
                    f"{name} v_max {self.v_max[joint]} rad/s and a_max {self.a_max[joint]} rad/s^2 "
                    "must be positive"
                )


def _require(condition: bool, name: str, value: object, requirement: str) -> None:
    if not condition:
        raise ConfigurationError(f"controller policy `{name}` is {value}, must be {requirement}")
