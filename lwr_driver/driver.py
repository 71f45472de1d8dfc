"""The driver: connection to the arm as a lifecycle, on top of a real-time process and a recorder process."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from fri.errors import LwrError
from lwr_driver.arm import Arm
from lwr_driver.motion import Motion

__all__ = ["Driver", "LinkSettings", "LinkState", "Measured", "Outcome", "Progress", "Waiting"]


@dataclass(frozen=True)
class LinkSettings:
    """How the arm is reached and how fast the answer must be.

    address, port : where this computer listens; only this address is bound
    controller : IP address of the controller; None takes the first that speaks, and then only that
    lock_step : the other side waits for each answer; nothing runs between commands (the emulator only)
    handshake : the KRL program that runs on the controller, a name of `fri.krl`
    realtime : `require` refuses to run without real-time rights, `allow` runs with a warning
    link_timeout_s : silence after which the link counts as lost [s]; at least ten cycles are always granted
    """

    address: str = "192.168.0.100"
    port: int = 49938
    controller: str | None = None
    lock_step: bool = False
    handshake: str = "fri_control"
    realtime: Literal["require", "allow"] = "require"
    priority: int = 80
    cpu: int | None = None
    link_timeout_s: float = 0.1
    tracking_limit_rad: float = 0.2
    longest_motion_s: float = 900.0


@dataclass(frozen=True)
class Waiting:
    """What a step of the driver waits for: what is awaited, what is seen, since when, and what to do."""

    awaited: str
    seen: str
    since_s: float
    advice: str


@dataclass(frozen=True)
class Progress:
    """How far a motion is: rows sent of rows planned, name of the phase, and the state of the link."""

    row: int
    rows: int
    time_s: float
    phase: str
    state: LinkState


@dataclass(frozen=True)
class LinkState:
    """Snapshot of the link. Arrays are (7,) float64 in kinematic order.

    state, quality : names of the FRI states (`MON`, `CMD`; `UNACCEPTABLE` to `PERFECT`), `OFF` before the first packet
    mode : what the loop answers: `mirror`, `hold`, `motion`, `stop`, `silent`
    sequence : unwrapped packet count; period_s : sample time of the controller [s]
    q, tau, q_command : measured position [rad], joint torque sensor [Nm], last position sent [rad]
    setpoint : the controller's own set point (command plus FRI offset) [rad]
    tracking_error : worst |q - q_command| of each joint since command mode began [rad]
    latency_s : reply latency quantiles of the loop {0.5, 0.99, 0.999, 1.0} [s]
    """

    state: str
    quality: str
    mode: str
    sequence: int
    period_s: float
    power: int
    error: int
    warning: int
    control: str
    safety_limits: float
    answer_rate: float
    controller_latency_s: float
    jitter_s: float
    miss_rate: float
    miss_counter: int
    temperature: NDArray[np.float64]
    q: NDArray[np.float64]
    tau: NDArray[np.float64]
    tau_external: NDArray[np.float64]
    q_command: NDArray[np.float64]
    setpoint: NDArray[np.float64]
    tracking_error: NDArray[np.float64]
    latency_s: dict[float, float]
    received: int
    answered: int
    lost: int
    repeated: int
    reordered: int
    malformed: int
    foreign: int
    late: int


@dataclass(frozen=True)
class Measured:
    """Means and standard deviations over some cycles at rest; arrays (7,) float64 [rad], [Nm]."""

    cycles: int
    q: NDArray[np.float64]
    q_std: NDArray[np.float64]
    tau: NDArray[np.float64]
    tau_std: NDArray[np.float64]
    tau_external: NDArray[np.float64]
    q_command: NDArray[np.float64]


@dataclass(frozen=True)
class Outcome:
    """How a motion ended.

    status : `success`, `abort` (someone asked to stop), `fail`
    reason : why, in words; empty on success
    last_rows : the last rows of the loop, dtype `lwr_driver.ring.ROW`
    error : what `check()` raises; None unless failed
    """

    status: Literal["success", "abort", "fail"]
    reason: str
    last_rows: NDArray[Any]
    rows_sent: int
    error: LwrError | None = None

    def check(self) -> Outcome:
        """This outcome, or its error raised with the last rows as `.rows`."""
        if self.error is not None:
            raise self.error
        return self


class Driver:
    """Connection to one arm. A context manager: leaving it always stops the arm and ends both processes.

    arm : limits that guard every cycle
    link : how the arm is reached
    notify : called with a Waiting about twice a second while a step waits
    """

    def __init__(
        self, arm: Arm, link: LinkSettings, *, notify: Callable[[Waiting], None] | None = None
    ) -> None:
        raise NotImplementedError

    def __enter__(self) -> Driver:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def connect(self, *, timeout_s: float = 60.0) -> LinkState:
        """Start loop and recorder, wait for the first packet."""
        raise NotImplementedError

    def wait_quality(self, quality: str = "OK", *, cycles: int = 100, timeout_s: float = 60.0) -> LinkState:
        """Wait until the controller has rated the link `quality` or better for `cycles` cycles on end."""
        raise NotImplementedError

    def enter_command(self, *, timeout_s: float = 120.0) -> LinkState:
        """Ask the KRL program to start commanding, wait for command mode with drives on and no error."""
        raise NotImplementedError

    def execute(self, motion: Motion, progress: Callable[[Progress], None] | None = None) -> Outcome:
        """Command a motion from its first row to its last, then hold the last row."""
        raise NotImplementedError

    def monitor(self, cycles: int) -> Measured:
        """Means over `cycles` cycles, in monitor mode or holding in command mode."""
        raise NotImplementedError

    def stop(self) -> LinkState:
        """Stop within the limits and wait until the commanded position rests; no effect out of command mode."""
        raise NotImplementedError

    def request_stop(self) -> None:
        """Ask for a jerk-limited stop and return at once; may be called from any thread or signal handler."""
        raise NotImplementedError

    def drop_link(self) -> None:
        """Stop answering at once and for good: the controller brakes by itself. From any thread or handler."""
        raise NotImplementedError

    def leave_command(self, *, timeout_s: float = 30.0) -> LinkState:
        """Ask the KRL program to stop commanding and wait for monitor mode."""
        raise NotImplementedError

    def state(self) -> LinkState:
        """Snapshot of the link at this moment; never waits."""
        raise NotImplementedError

    def record(
        self, path: Path, metadata: Mapping[str, str], attachments: Mapping[str, bytes] | None = None
    ) -> None:
        """Begin a session log at `path` with the next cycle."""
        raise NotImplementedError

    def end_record(self, status: Literal["success", "abort", "fail"], reason: str = "") -> None:
        """Write everything received so far, then the closing record."""
        raise NotImplementedError

    def close(self) -> None:
        """Stop, leave command mode if possible, end both processes. Safe to call at any time and twice."""
        raise NotImplementedError
