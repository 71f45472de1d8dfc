"""The PC's side of the published KRL programs: asking for command mode and seeing that it was granted.

The objects have no state. They write requests into the command that goes out next (``RemoteEnd.command``) and
read the last measurement (``RemoteEnd.msr``). A request is made in every cycle until its effect is seen
(``started``, ``stopped``); the variables stay in the command after that.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Protocol

import numpy as np

from fri.errors import ConfigurationError
from fri.states import STRATEGY_BY_CONTROL, Control, State

__all__ = [
    "HANDSHAKES",
    "Handshake",
    "IdentificationHandshake",
    "RcprgHandshake",
    "RosHandshake",
    "StanfordHandshake",
    "find_handshake",
]


class Handshake(Protocol):
    """PC side of a KRL program. `cmd` and `msr` are records of shape (), dtypes `CMD` and `MSR`."""

    name: str
    can_close: bool

    def request_start(self, cmd: np.ndarray, msr: np.ndarray, control: Control) -> None:
        """Ask for command mode in `control`."""

    def request_stop(self, cmd: np.ndarray, msr: np.ndarray) -> None:
        """Ask for monitor mode; also acknowledges a fallback, after which a start may be asked for anew."""

    def request_close(self, cmd: np.ndarray, msr: np.ndarray) -> None:
        """Ask for the end of the program; where `can_close` is False this only asks for monitor mode."""

    def opened(self, msr: np.ndarray) -> bool:
        """Whether the program runs and takes requests."""

    def started(self, msr: np.ndarray) -> bool:
        """Whether a start was granted and command mode is on."""

    def stopped(self, msr: np.ndarray) -> bool:
        """Whether a stop was granted and monitor mode is on."""

    def fallen(self, msr: np.ndarray) -> bool:
        """Whether the program believes itself in command mode while FRI has fallen back to monitor mode.

        It takes no start then before a stop.
        """


class StanfordHandshake:
    """Stanford's FRIControl: ``$FRI_FRM_INT[15..16]``, ``$FRI_TO_INT[15..16]``."""

    name = "stanford"
    can_close = True

    def request_start(self, cmd: np.ndarray, msr: np.ndarray, control: Control) -> None:
        """Strategy in [15], 10 in [16]."""
        cmd["krl_int"][14] = STRATEGY_BY_CONTROL[control]
        cmd["krl_int"][15] = 10

    def request_stop(self, cmd: np.ndarray, msr: np.ndarray) -> None:
        """20 in [16]."""
        cmd["krl_int"][15] = 20

    def request_close(self, cmd: np.ndarray, msr: np.ndarray) -> None:
        """The program's abort code in [16]."""
        cmd["krl_int"][15] = msr["krl_int"][14]

    def opened(self, msr: np.ndarray) -> bool:
        """10 or 20 in [16]."""
        return bool(msr["krl_int"][15] in (10, 20))

    def started(self, msr: np.ndarray) -> bool:
        """20 in [16], state CMD."""
        return bool(msr["krl_int"][15] == 20 and msr["state"] == State.CMD)

    def stopped(self, msr: np.ndarray) -> bool:
        """10 in [16], state MON."""
        return bool(msr["krl_int"][15] == 10 and msr["state"] == State.MON)

    def fallen(self, msr: np.ndarray) -> bool:
        """20 in [16], state MON."""
        return bool(msr["krl_int"][15] == 20 and msr["state"] == State.MON)


class RosHandshake:
    """CentroEPiaggio's ros_control: ``$FRI_FRM_INT[1..2]``, ``$FRI_TO_INT[2]``."""

    name = "ros_control"
    can_close = False

    def request_start(self, cmd: np.ndarray, msr: np.ndarray, control: Control) -> None:
        """Strategy in [1], 1 in [2]."""
        cmd["krl_int"][0] = STRATEGY_BY_CONTROL[control]
        cmd["krl_int"][1] = 1

    def request_stop(self, cmd: np.ndarray, msr: np.ndarray) -> None:
        """0 in [2]."""
        cmd["krl_int"][1] = 0

    def request_close(self, cmd: np.ndarray, msr: np.ndarray) -> None:
        """The program has no close: as ``request_stop``."""
        self.request_stop(cmd, msr)

    def opened(self, msr: np.ndarray) -> bool:
        """The program marks nothing but its state: 10, 1 or 0 in [2]."""
        return bool(msr["state"] != State.OFF and msr["krl_int"][1] in (0, 1, 10))

    def started(self, msr: np.ndarray) -> bool:
        """1 in [2], state CMD."""
        return bool(msr["krl_int"][1] == 1 and msr["state"] == State.CMD)

    def stopped(self, msr: np.ndarray) -> bool:
        """0 or 10 in [2], state MON."""
        return bool(msr["krl_int"][1] in (0, 10) and msr["state"] == State.MON)

    def fallen(self, msr: np.ndarray) -> bool:
        """1 in [2], state MON."""
        return bool(msr["krl_int"][1] == 1 and msr["state"] == State.MON)


class RcprgHandshake:
    """RCPRG's fri_start: ``$FRI_FRM_BOOL[1]`` with ``$FRI_FRM_INT[1]``, ``$FRI_TO_BOOL[1]``.

    The published program carries a request out again and again while the bit is set, even after a fallback,
    so the bit is taken back as soon as the program acknowledges. The control mode is the program's own.
    """

    name = "rcprg"
    can_close = False

    def request_start(self, cmd: np.ndarray, msr: np.ndarray, control: Control) -> None:
        """1 in [1], request bit set until acknowledged."""
        self._request(cmd, msr, 1, State.CMD)

    def request_stop(self, cmd: np.ndarray, msr: np.ndarray) -> None:
        """2 in [1], request bit set until acknowledged."""
        self._request(cmd, msr, 2, State.MON)

    def request_close(self, cmd: np.ndarray, msr: np.ndarray) -> None:
        """The program has no close: as ``request_stop``."""
        self.request_stop(cmd, msr)

    def opened(self, msr: np.ndarray) -> bool:
        """The program takes requests as soon as packets come."""
        return bool(msr["state"] != State.OFF)

    def started(self, msr: np.ndarray) -> bool:
        """State CMD, and the program is through with the request."""
        return bool(msr["state"] == State.CMD and not msr["krl_bool"] & 1)

    def stopped(self, msr: np.ndarray) -> bool:
        """State MON, and the program is through with the request."""
        return bool(msr["state"] == State.MON and not msr["krl_bool"] & 1)

    def fallen(self, msr: np.ndarray) -> bool:
        """Never: the published program takes a start at any time."""
        return False

    @staticmethod
    def _request(cmd: np.ndarray, msr: np.ndarray, request: int, wanted: State) -> None:
        busy = bool(msr["krl_bool"] & 1)
        if busy or msr["state"] == wanted:
            cmd["krl_bool"] &= 0xFFFE
            return
        cmd["krl_int"][0] = request
        cmd["krl_bool"] |= 1


class IdentificationHandshake:
    """The program of this project, configs/krl/lwr_identification.src.

    ``$FRI_FRM_INT[16]`` asks for 11 monitor mode, 22 command mode, 33 the end: a packet has no check sum, and no
    single damaged bit makes one of these another or nothing. ``$FRI_TO_INT[16]`` tells the phase: 1 monitor
    mode, 2 and 3 on the way to command mode, 4 command mode, 5 ended, 6 command mode was lost and the PC must
    ask for monitor mode before anything else. ``[14]`` numbers the load data in ``$FRI_FRM_REA[1..7]``
    (``[13]``: the number again, negative; ``$FRI_FRM_REA[8]``: their sum) and tells which are in force.
    """

    name = "lwr_identification"
    can_close = True

    def request_start(self, cmd: np.ndarray, msr: np.ndarray, control: Control) -> None:
        """22 in [16]; the program knows position control only."""
        cmd["krl_int"][15] = 22

    def request_stop(self, cmd: np.ndarray, msr: np.ndarray) -> None:
        """11 in [16]."""
        cmd["krl_int"][15] = 11

    def request_close(self, cmd: np.ndarray, msr: np.ndarray) -> None:
        """33 in [16], taken in monitor mode."""
        cmd["krl_int"][15] = 33

    def opened(self, msr: np.ndarray) -> bool:
        """Any phase but the end."""
        return bool(1 <= msr["krl_int"][15] <= 4)

    def started(self, msr: np.ndarray) -> bool:
        """4 in [16], state CMD."""
        return bool(msr["krl_int"][15] == 4 and msr["state"] == State.CMD)

    def stopped(self, msr: np.ndarray) -> bool:
        """1 in [16], state MON."""
        return bool(msr["krl_int"][15] == 1 and msr["state"] == State.MON)

    def fallen(self, msr: np.ndarray) -> bool:
        """6 in [16], or still 4 in it, and state MON."""
        return bool(msr["krl_int"][15] in (4, 6) and msr["state"] == State.MON)

    def request_load(self, cmd: np.ndarray, msr: np.ndarray, load: np.ndarray) -> None:
        """Put load data in force: mass [kg], centre of mass in the flange frame [mm] (3), inertia about it
        JX JY JZ [kg m2]; (7,) float. Repeat until `load_taken`.
        """
        wanted = np.asarray(load, dtype=np.float32)
        if int(cmd["krl_int"][13]) == 0 or not np.array_equal(cmd["krl_real"][:7], wanted):
            number = max(int(cmd["krl_int"][13]), int(msr["krl_int"][13])) + 1
            cmd["krl_real"][:7], cmd["krl_real"][7] = wanted, wanted.sum()
            cmd["krl_int"][12:14] = (-number, number)

    def load_taken(self, cmd: np.ndarray, msr: np.ndarray) -> bool:
        """Whether the load data last asked for are in force."""
        return bool(cmd["krl_int"][13] != 0 and cmd["krl_int"][13] == msr["krl_int"][13])

    def load(self, msr: np.ndarray) -> np.ndarray:
        """Mass [kg] and centre of mass in the flange frame [mm] that the controller compensates, (4,)."""
        return np.array(msr["krl_real"][7:11], dtype=np.float64)


#: The handshakes by the name of the KRL program.
HANDSHAKES: Mapping[str, Handshake] = MappingProxyType(
    {
        handshake.name: handshake
        for handshake in (
            IdentificationHandshake(),
            StanfordHandshake(),
            RosHandshake(),
            RcprgHandshake(),
        )
    }
)


def find_handshake(name: str) -> Handshake:
    """Handshake of the KRL program `name`, or ConfigurationError."""
    try:
        return HANDSHAKES[name]
    except KeyError:
        raise ConfigurationError(
            f"KRL program {name!r} is not known; known are {', '.join(sorted(HANDSHAKES))}"
        ) from None
