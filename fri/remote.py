"""The PC's end of the link (signatures; bodies follow)."""

from __future__ import annotations

import numpy as np


class RemoteEnd:
    """PC end of an FRI link.

    Attributes kept up to date by ``receive`` (plain ints/floats/bools, read them freely):
    ``sequence`` (int, unwrapped), ``state``, ``quality``, ``power``, ``error``, ``control``, ``sample_time_s``,
    ``timestamp_s``, ``commanding`` (state CMD and power != 0), ``controller`` ((ip, port) | None),
    ``msr`` (MSR record, shape (), reused by the next receive: copy what you keep),
    ``command`` (CMD record, shape (): exactly what the last answer sent), views ``krl_real``, ``krl_int`` of it,
    ``send_seq``; counters ``received answered lost repeated reordered malformed foreign restarts port_changes
    unreflected send_errors``; ``events`` deque of LinkEvent(sequence, kind, text).
    """

    def __init__(self, address: str, port: int = 49938, controller: str | None = None, first_sequence: int = 0) -> None: ...

    def receive(self, timeout_s: float) -> np.ndarray | None:
        """Next valid, new measurement (record of shape ()) or None after `timeout_s`; repeated and late ones are counted only."""

    def answer(self, jnt_pos: np.ndarray | None = None, add_jnt_trq: np.ndarray | None = None) -> bool:
        """Answer the packet last received, once. Outside commanding, or with None, the mirror is sent; True if `jnt_pos` was used."""

    def pending(self) -> bool:
        """Whether a further datagram waits already (the one in hand is then stale)."""

    def set_krl_bool(self, index: int, value: bool) -> None: ...
    def set_impedance(self, stiffness: np.ndarray, damping: np.ndarray) -> None: ...
    def counters(self) -> dict[str, int]: ...
    def close(self) -> None: ...
    def __enter__(self) -> RemoteEnd: ...
    def __exit__(self, *exc: object) -> None: ...
