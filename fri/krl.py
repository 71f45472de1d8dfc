"""Emulated KRL programs and the PC's side of their handshakes (signatures; bodies follow)."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from fri.krc import KrcSession
from fri.states import Control


class KrlProgram(Protocol):
    """A KRL program as a state machine; `step` is one interpreter tick (12 ms)."""

    name: str
    finished: bool

    def step(self, session: KrcSession) -> None: ...


class Interpreter:
    """Runs one program at the interpreter's tick: call `advance(milliseconds)` once per FRI cycle."""

    def __init__(self, session: KrcSession, program: KrlProgram, tick_ms: int = 12) -> None: ...
    def advance(self, milliseconds: int) -> None: ...


class StanfordProgram:
    """FRIControl.src"""

    def __init__(self, sample_time_ms: int, abort_code: int = 30) -> None: ...


class RosProgram:
    """ros_control.src"""

    def __init__(self, sample_time_ms: int) -> None: ...


class Handshake(Protocol):
    """PC side of a KRL program. `cmd` is the record to be sent (``RemoteEnd.command``), `msr` the last measurement."""

    name: str

    def request_start(self, cmd: np.ndarray, control: Control) -> None: ...
    def request_stop(self, cmd: np.ndarray) -> None: ...
    def request_close(self, cmd: np.ndarray, msr: np.ndarray) -> bool:
        """False where the program knows no close."""

    def opened(self, msr: np.ndarray) -> bool: ...
    def started(self, msr: np.ndarray) -> bool: ...
    def stopped(self, msr: np.ndarray) -> bool: ...


class StanfordHandshake: ...


class RosHandshake: ...
