"""How the arm is reached, and what to do when it is not."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from fri.errors import ConfigurationError
from fri.handshake import find_handshake
from fri.states import ALL_DRIVES
from lwr_driver.state import LinkState

__all__ = [
    "LinkSettings",
    "advise_command",
    "advise_connect",
    "advise_leave",
    "advise_load",
    "advise_monitor",
    "advise_quality",
    "advise_rest",
    "silence_in_lock_step",
]

_SILENCE_S = 1.0  # without packets for so long, that is the trouble and nothing else
_POSITION_PROGRAMS = ("lwr_identification", "stanford", "ros_control")


@dataclass(frozen=True)
class LinkSettings:
    """How the arm is reached and how fast the answer must be.

    address, port : where this computer listens; only this address is bound. Port 0 takes a free one
    controller : IP address of the controller; None takes the first that speaks, and then only that
    lock_step : the other side waits for each answer and nothing runs between commands (the emulator only)
    handshake : KRL program on the controller: `lwr_identification`, `stanford`, `ros_control`
    realtime : `require` refuses to run without real-time rights, `allow` runs with a warning; in lock step
        they
        do not matter and are not asked for
    priority : of SCHED_FIFO; cpu : processor of the loop, None chooses an isolated one or the last
    link_timeout_s : silence after which the link counts as lost [s]; ten cycles are always granted
    tracking_limit_rad : distance between command and arm at which a motion is stopped [rad]
    longest_motion_s : memory for motions, at 1 ms; longer cycles allow for longer motions [s]
    lock_step_patience_s : real time without a packet after which the other side counts as gone in lock step
        [s]
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


def advise_connect(state: LinkState) -> str:
    """What to do while no packet comes."""
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
    """What to do while cycles are counted at rest."""
    if state.age_s > _SILENCE_S:
        return advise_connect(state)
    return "Nothing to do: packets come, the arm rests and is measured"


def advise_rest(state: LinkState) -> str:
    """What to do while the arm comes to rest."""
    if state.age_s > _SILENCE_S:
        return "No packet comes, so the controller brakes by itself; look at the pendant"
    return "The arm brakes within its jerk limit; if it does not, press the emergency stop"


def advise_quality(state: LinkState) -> str:
    """What to do while the controller rates the link as bad."""
    if state.age_s > _SILENCE_S:
        return advise_connect(state)
    if state.foreign:
        return "Another address sends too: set `controller` to the controller's, and find the other"
    if state.late > state.received // 100:
        return "Answers come too late: close other programs, see the real-time rights, or use a longer cycle"
    seen = ((state.lost, "lost"), (state.malformed, "malformed"), (state.miss_counter, "unanswered in time"))
    told = ", ".join(f"{count} {what}" for count, what in seen if count)
    return (
        f"Nothing to do at the pendant{f' ({told})' if told else ''}; check cable and network card, and that "
        "only one client answers"
    )


def advise_command(state: LinkState) -> str:
    """What to do while command mode does not come."""
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
    """What to do while load data are not taken."""
    if state.age_s > _SILENCE_S:
        return advise_connect(state)
    return "The KRL program takes them in monitor mode, up to its LWR_LOAD_MAX: see its data list"


def advise_leave(state: LinkState) -> str:
    """What to do while command mode does not end."""
    return "The KRL program does not react: stop it at the pendant"


def silence_in_lock_step(state: LinkState, silence_s: float) -> str:
    """What to say when nothing has come for so long [s] in lock step, where the other side waits for us."""
    cause = f"{state.malformed} malformed packets came" if state.malformed else "the emulator is gone"
    return f"no packet for {silence_s:.1f} s in lock step; {cause}"
