"""The controller's end of a session, without a socket (signatures; bodies follow)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from fri.states import ALL_DRIVES, Control, Quality, State


@dataclass(frozen=True)
class KrcPolicy:
    """What KUKA leaves silent; every number is ours."""


@dataclass(frozen=True)
class KrcLimits:
    """Limits that the controller enforces: q_min, q_max [rad], v_max [rad/s], a_max [rad/s^2], all (7,)."""

    q_min: np.ndarray
    q_max: np.ndarray
    v_max: np.ndarray
    a_max: np.ndarray


@dataclass(slots=True)
class Sample:
    """What the arm measures; filled by the emulator, read by ``KrcSession.packet``. Arrays are float, written in place.

    msr_jnt_pos (7,), msr_jnt_trq (7,), est_ext_jnt_trq (7,), est_ext_tcp_ft (6,), gravity (7,), mass_matrix (7,7),
    jacobian (6,7), msr_cart_pos (12,), cmd_cart_pos (12,), temperature (7,).
    """


class Event(NamedTuple):
    """Something that happened to the session: `cycle` (int), `kind` (EventKind), `text`."""

    cycle: int
    kind: object
    text: str


class Setpoint(NamedTuple):
    """What the arm follows during the cycle that begins: positions (n, 7), one row a millisecond (n = T / 1 ms)."""

    positions: np.ndarray
    state: State
    event: Event | None  # set in the cycle in which the session was dropped

    @property
    def position(self) -> np.ndarray:
        """Last row, (7,)."""


class KrcSession:
    """Session of the controller.

    Public attributes: ``state quality control power error warning t1 quality_ceiling send_seq sample_time_s cycle
    answered_this_cycle last_event events miss_counter``; KRL: ``to_real to_int from_real from_int`` (16,) arrays,
    ``to_bool from_bool`` int bit masks (``$FRI_TO_INT[n]`` is ``to_int[n-1]``).
    """

    def __init__(
        self,
        limits: KrcLimits,
        q: np.ndarray,
        policy: KrcPolicy | None = None,
        *,
        control: Control = Control.POSITION,
        power: int = ALL_DRIVES,
        uptime_s: float = 0.0,
    ) -> None: ...

    def fri_open(self, sample_time_ms: int) -> State: ...
    def fri_start(self, safety_limits: float = 1.0) -> State:
        """Request command mode; it is entered at a cycle boundary as soon as the timing is in sync."""

    def fri_stop(self) -> State: ...
    def fri_close(self) -> State: ...
    def set_strategy(self, strategy: int) -> None: ...
    def set_drives(self, power: int, error: int = 0, warning: int = 0) -> None: ...
    def drop(self, text: str) -> None:
        """Fall back to monitor for a reason outside the protocol (e-stop, mode change)."""

    def move_krl(self, q: np.ndarray) -> None:
        """KRL's own setpoint moves (also in CMD, where the offset takes up the difference)."""

    def resync(self, q: np.ndarray | None = None) -> None:
        """Set KRL's setpoint to `q`, or to the present total setpoint: the offset becomes zero."""

    def packet(self, sample: Sample) -> bytes:
        """Begin a cycle: the 916 bytes to send."""

    def receive(self, datagram: bytes, delay_s: float = 0.0) -> bool:
        """A datagram that arrived `delay_s` after the packet; True if it is this cycle's valid answer."""

    def close_cycle(self) -> Setpoint:
        """End the cycle: judge the answers and give the setpoints of the next T. Works in OFF too (hold or ramp)."""
