"""The link to the arm: its settings, its state, the outcome of a motion, and advice while a step waits."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from fri.errors import ConfigurationError, LwrError
from fri.handshake import find_handshake
from fri.states import ALL_DRIVES, Quality, State
from fri.states import Control as ControlMode
from lwr_driver.arm import JOINTS
from lwr_driver.control import BIN_NS, Control, Mode, Text, Word

_COUNTERS = (
    "received",
    "answered",
    "lost",
    "repeated",
    "reordered",
    "suspect",
    "malformed",
    "foreign",
    "restarts",
)
_SILENCE_S = 1.0  # after so long without a packet, silence is the cause of any trouble
_POSITION_PROGRAMS = ("lwr_identification", "stanford", "ros_control")
_QUANTILES = (0.5, 0.99, 0.999, 1.0)

Joints = NDArray[np.float64]


@dataclass(frozen=True)
class LinkSettings:
    """Settings of the connection to the arm.

    address, port : of this computer; only this address is bound, port 0 takes a free one
    controller : IP address of the controller; None accepts the first sender, and then only that one
    lock_step : the other side waits for each answer and nothing runs between commands (the emulator only)
    handshake : KRL program on the controller: `lwr_identification`, `stanford`, `ros_control`
    realtime : `require` refuses to run without real-time rights, `allow` runs with a warning; not needed in
        lock step
    priority : of SCHED_FIFO; cpu : processor of the loop, None chooses an isolated one or the last
    link_timeout_s : the link counts as lost after so much silence [s], ten cycles at least
    tracking_limit_rad : largest distance between command and arm in a motion [rad]
    longest_motion_s : memory for motions, at 1 ms; longer cycles allow for longer motions [s]
    lock_step_patience_s : in lock step the other side counts as gone after so much real time [s]
    """

    address: str = "192.168.0.100"
    port: int = 49938
    controller: str | None = None
    lock_step: bool = False
    handshake: str = "stanford"
    realtime: Literal["require", "allow"] = "require"
    priority: int = 80
    cpu: int | None = None
    link_timeout_s: float = 0.1
    tracking_limit_rad: float = 0.2
    longest_motion_s: float = 900.0
    lock_step_patience_s: float = 15.0

    def __post_init__(self) -> None:
        if find_handshake(self.handshake).name not in _POSITION_PROGRAMS:
            raise ConfigurationError(
                f"KRL program {self.handshake!r} runs the arm in impedance control; the driver commands "
                f"positions. Use one of {', '.join(_POSITION_PROGRAMS)}"
            )
        for name in ("link_timeout_s", "tracking_limit_rad", "longest_motion_s", "lock_step_patience_s"):
            if not getattr(self, name) > 0.0:
                raise ConfigurationError(f"{name} is {getattr(self, name)}; it must be above zero")
        if not 1 <= self.priority <= 99:
            raise ConfigurationError(f"priority {self.priority} is not within 1 to 99")


@dataclass(frozen=True)
class Waiting:
    """A waiting step of the driver: its aim, the present state, the time so far, and the remedy."""

    awaited: str
    seen: str
    since_s: float
    advice: str

    def __str__(self) -> str:
        return f"waited {self.since_s:.1f} s for {self.awaited}; seen: {self.seen}. {self.advice}"


@dataclass(frozen=True, eq=False)
class LinkState:
    """Snapshot of the link. Arrays are (7,) float64 in kinematic order.

    state, quality, control : names of the FRI values (`MON`, `CMD`; `UNACCEPTABLE` to `PERFECT`; `POSITION`);
        `OFF`, `UNACCEPTABLE`, `OTHER` before the first packet
    mode : kind of answer: `mirror`, `hold`, `motion`, `stop`, `silent`
    sequence : number of the last packet, unwrapped, -1 before the first; period_s : the controller's cycle
        [s]
    age_s : time since the last packet [s], infinite before the first
    q, tau, tau_external, q_command : measured position [rad], joint torque sensors [Nm], estimated external
        torque [Nm], position of the last answer [rad]
    setpoint : the controller's own set point, command plus FRI offset [rad]; motions begin there
    tracking_error : largest distance of q from the answer before, in this command mode [rad]
    latency_s : quantiles 0.5, 0.99, 0.999 and 1 of the time from packet to answer in the loop [s]
    left : why no motion may begin before `enter_command`: the last end of command mode, or a contact in it; empty
        if one may
    received to restarts : counters of the link; late : answers not yet seen by the controller at its next
        packet; overruns : rows lost to a slow recorder
    """

    state: str
    quality: str
    control: str
    mode: str
    sequence: int
    period_s: float
    age_s: float
    power: int
    error: int
    warning: int
    safety_limits: float
    answer_rate: float
    controller_latency_s: float
    jitter_s: float
    miss_rate: float
    miss_counter: int
    temperature: Joints
    q: Joints
    tau: Joints
    tau_external: Joints
    q_command: Joints
    setpoint: Joints
    tracking_error: Joints
    latency_s: dict[float, float]
    left: str
    received: int
    answered: int
    lost: int
    repeated: int
    reordered: int
    suspect: int
    malformed: int
    foreign: int
    late: int
    restarts: int
    overruns: int

    @property
    def summary(self) -> str:
        """State, quality, drives and errors in one line."""
        if self.sequence < 0:
            return f"no packet yet, {self.malformed} malformed, {self.foreign} from other addresses"
        silence = f", no packet for {self.age_s:.1f} s" if self.age_s > 1.0 else ""
        return (
            f"state {self.state}, quality {self.quality}, control {self.control}, power 0x{self.power:02x}, "
            f"error 0x{self.error:02x}, answer rate {self.answer_rate:.3f}{silence}"
        )


@dataclass(frozen=True)
class MotionProgress:
    """Progress of a motion: row sent of rows planned, time [s], name of the phase, state of the link."""

    row: int
    rows: int
    time_s: float
    phase: str
    state: LinkState


@dataclass(frozen=True, eq=False)
class Measured:
    """Means and standard deviations over some cycles; arrays (7,) float64 [rad], [Nm]."""

    cycles: int
    q: Joints
    q_std: Joints
    tau: Joints
    tau_std: Joints
    tau_external: Joints
    q_command: Joints


@dataclass(frozen=True, eq=False)
class Outcome:
    """End of a motion.

    status : `success`, `abort` (on request), `fail`
    reason : in words; empty on success
    last_rows : the last cycles, dtype `lwr_driver.ring.ROW`
    row : last row sent, -1 if none; rows : of the motion
    error : raised by `check`, with the last rows as `.rows`; None unless failed
    """

    status: Literal["success", "abort", "fail"]
    reason: str
    last_rows: NDArray[Any]
    row: int
    rows: int
    error: LwrError | None = None

    def check(self) -> Outcome:
        """This outcome; raises its error if it failed."""
        if self.error is not None:
            raise self.error
        return self


def snapshot(control: Control, now_ns: int, overruns: int) -> LinkState:
    """State of the link from the shared memory, at `now_ns` of CLOCK_MONOTONIC."""
    words = control.words
    rows = control.last_rows(1)
    seen = len(rows) == 1
    row = rows[0] if seen else np.zeros(1, dtype=rows.dtype)[0]
    msr, cmd = row["msr"], row["cmd"]

    def joints(values: Any) -> Joints:
        return np.array(values, dtype=np.float64).reshape(JOINTS)

    numbers: dict[str, Any] = {name: int(words[Word[name.upper()]]) for name in _COUNTERS}
    numbers |= {name: int(msr[name]) for name in ("power", "error", "warning", "miss_counter")}
    numbers |= {name: float(msr[name]) for name in ("safety_limits", "answer_rate", "miss_rate")}
    return LinkState(
        state=State(int(msr["state"])).name,
        quality=Quality(int(msr["quality"])).name,
        control=ControlMode(int(msr["control"])).name,
        mode=Mode(int(words[Word.MODE])).name.lower(),
        sequence=int(row["sequence"]) if seen else -1,
        period_s=round(float(msr["msr_sample_time"]) * 1e6) * 1e-6,
        age_s=(now_ns - int(words[Word.HEARD_NS])) * 1e-9 if seen else float("inf"),
        controller_latency_s=float(msr["latency"]),
        jitter_s=float(msr["jitter"]),
        temperature=joints(msr["temperature"]),
        q=joints(msr["msr_jnt_pos"]),
        tau=joints(msr["msr_jnt_trq"]),
        tau_external=joints(msr["est_ext_jnt_trq"]),
        q_command=joints(cmd["jnt_pos"]),
        setpoint=joints(msr["cmd_jnt_pos"] + msr["cmd_jnt_pos_fri_offset"]),
        tracking_error=control.tracking.copy(),
        latency_s=_latencies(control.latency.copy()),
        left=control.text(Text.LEFT),
        late=int(words[Word.UNREFLECTED]),
        overruns=overruns,
        **numbers,
    )


def _latencies(histogram: NDArray[np.int64]) -> dict[float, float]:
    """Upper edges of the bins with the quantiles [s]; empty before the first answer."""
    total = int(histogram.sum())
    if total == 0:
        return {}
    cumulated = np.cumsum(histogram)
    places = [int(np.searchsorted(cumulated, max(1.0, np.ceil(q * total)))) for q in _QUANTILES]
    return {q: (place + 1) * BIN_NS * 1e-9 for q, place in zip(_QUANTILES, places, strict=True)}


def advise_connect(state: LinkState) -> str:
    """Advice while no packet comes."""
    if state.malformed:
        return "The packets are not FRI 1.0: check which software runs on the controller"
    if state.foreign:
        return "Packets come from another address than the controller's: check `controller`"
    return (
        "At the pendant: select and start the KRL program (in T1 hold enabling switch and start key until "
        "friOpen is passed); check FRIHOST and FRISOCK on the controller, the cable, the address of this "
        "computer and its firewall"
    )


def advise_monitor(state: LinkState) -> str:
    """Advice while cycles are counted at rest."""
    if state.age_s > _SILENCE_S:
        return advise_connect(state)
    return "Nothing to do: packets come, the arm rests and is measured"


def advise_rest(state: LinkState) -> str:
    """Advice while the arm comes to rest."""
    if state.age_s > _SILENCE_S:
        return "No packet comes, so the controller brakes by itself; look at the pendant"
    return "The arm brakes within its jerk limit; if it does not, press the emergency stop"


def advise_quality(state: LinkState) -> str:
    """Advice while the controller rates the link as bad."""
    if state.age_s > _SILENCE_S:
        return advise_connect(state)
    if state.foreign:
        return "Another address sends too: set `controller` to the controller's, and find the other"
    if state.late > state.received // 100:
        return "Answers come too late: close other programs, see the real-time rights, or use a longer cycle"
    seen = ((state.lost, "lost"), (state.malformed, "malformed"), (state.miss_counter, "unanswered in time"))
    listed = ", ".join(f"{count} {word}" for count, word in seen if count)
    return (
        f"Nothing to do at the pendant{f' ({listed})' if listed else ''}; check cable and network card, and that "
        "only one client answers"
    )


def advise_command(state: LinkState) -> str:
    """Advice while command mode does not come."""
    if state.age_s > _SILENCE_S:
        return advise_connect(state)
    if state.state == "CMD" and (state.power != ALL_DRIVES or state.error):
        return "At the pendant: switch the drives on and acknowledge the messages"
    if state.quality in ("UNACCEPTABLE", "BAD"):
        return advise_quality(state)
    if state.control != "POSITION":
        return "The controller is not in position control: set $STIFFNESS.STRATEGY=10 in the KRL program"
    return "At the pendant: start the KRL program or let it go on, and acknowledge its messages"


def advise_load(state: LinkState) -> str:
    """Advice while load data are not accepted."""
    if state.age_s > _SILENCE_S:
        return advise_connect(state)
    return "The KRL program takes them in monitor mode, up to its LWR_LOAD_MAX: see its data list"


def advise_leave(state: LinkState) -> str:
    """Advice while command mode does not end."""
    return "The KRL program does not react: stop it at the pendant"


def silence_in_lock_step(state: LinkState, silence_s: float) -> str:
    """Message after `silence_s` without a packet in lock step [s]."""
    cause = f"{state.malformed} malformed packets came" if state.malformed else "the emulator is gone"
    return f"no packet for {silence_s:.1f} s in lock step; {cause}"
