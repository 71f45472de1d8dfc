"""The PC's side of the KRL programs: requests for command mode and their acknowledgements.

The objects have no state. They write requests into the next command (``RemoteEnd.command``) and read the last
measurement (``RemoteEnd.msr``). A request is repeated in every cycle until its effect is seen (``started``,
``stopped``); afterwards its variables stay in the command.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import ClassVar, Protocol

import numpy as np

from fri.errors import ConfigurationError
from fri.states import STRATEGY_BY_CONTROL, Control, State


class Handshake(Protocol):
    """PC side of a KRL program. `cmd` and `msr` are records of shape (), dtypes `CMD` and `MSR`."""

    name: str
    can_close: bool

    def request_start(self, cmd: np.ndarray, msr: np.ndarray, control: Control) -> None:
        """Ask for command mode in `control`."""

    def request_stop(self, cmd: np.ndarray, msr: np.ndarray) -> None:
        """Ask for monitor mode; after a fallback this must come before a new start."""

    def request_close(self, cmd: np.ndarray, msr: np.ndarray) -> None:
        """Ask for the end of the program; if `can_close` is False, for monitor mode only."""

    def opened(self, msr: np.ndarray) -> bool:
        """Whether the program runs and takes requests."""

    def started(self, msr: np.ndarray) -> bool:
        """Whether a start was granted and command mode is on."""

    def stopped(self, msr: np.ndarray) -> bool:
        """Whether a stop was granted and monitor mode is on."""

    def fallen(self, msr: np.ndarray) -> bool:
        """Whether FRI has fallen back to monitor mode while the program still reports command mode.

        The program then needs a stop before a start.
        """


class _StatusHandshake:
    """A program with its status in one integer: `status` is the index in ``krl_int``, from 0."""

    name: str
    can_close = True
    status: ClassVar[int]
    open_values: ClassVar[tuple[int, ...]]
    started_value: ClassVar[int]
    stopped_values: ClassVar[tuple[int, ...]]
    fallen_values: ClassVar[tuple[int, ...]]

    def opened(self, msr: np.ndarray) -> bool:
        """Packets come and the status is one of `open_values`."""
        return bool(msr["krl_int"][self.status] in self.open_values)

    def started(self, msr: np.ndarray) -> bool:
        """Status `started_value`, state CMD."""
        return bool(msr["krl_int"][self.status] == self.started_value and msr["state"] == State.CMD)

    def stopped(self, msr: np.ndarray) -> bool:
        """Status among `stopped_values`, state MON."""
        return bool(msr["krl_int"][self.status] in self.stopped_values and msr["state"] == State.MON)

    def fallen(self, msr: np.ndarray) -> bool:
        """Status among `fallen_values`, state MON."""
        return bool(msr["krl_int"][self.status] in self.fallen_values and msr["state"] == State.MON)


class StanfordHandshake(_StatusHandshake):
    """Stanford's FRIControl: ``$FRI_FRM_INT[15..16]``, status in ``$FRI_TO_INT[16]``."""

    name = "stanford"
    status = 15
    open_values = (10, 20)
    started_value = 20
    stopped_values = (10,)
    fallen_values = (20,)

    def request_start(self, cmd: np.ndarray, msr: np.ndarray, control: Control) -> None:
        """Strategy in [15], 10 in [16]."""
        cmd["krl_int"][14] = STRATEGY_BY_CONTROL[control]
        cmd["krl_int"][15] = 10

    def request_stop(self, cmd: np.ndarray, msr: np.ndarray) -> None:
        """20 in [16]."""
        cmd["krl_int"][15] = 20

    def request_close(self, cmd: np.ndarray, msr: np.ndarray) -> None:
        """The program's abort code, from ``$FRI_TO_INT[15]``, in [16]."""
        cmd["krl_int"][15] = msr["krl_int"][14]


class RosHandshake(_StatusHandshake):
    """CentroEPiaggio's ros_control: ``$FRI_FRM_INT[1..2]``, status in ``$FRI_TO_INT[2]``; it has no close."""

    name = "ros_control"
    can_close = False
    status = 1
    open_values = (0, 1, 10)
    started_value = 1
    stopped_values = (0, 10)
    fallen_values = (1,)

    def request_start(self, cmd: np.ndarray, msr: np.ndarray, control: Control) -> None:
        """Strategy in [1], 1 in [2]."""
        cmd["krl_int"][0] = STRATEGY_BY_CONTROL[control]
        cmd["krl_int"][1] = 1

    def request_stop(self, cmd: np.ndarray, msr: np.ndarray) -> None:
        """0 in [2]."""
        cmd["krl_int"][1] = 0

    request_close = request_stop

    def opened(self, msr: np.ndarray) -> bool:
        """State MON or CMD: the status is 0 before the program too."""
        return bool(msr["state"] != State.OFF and super().opened(msr))


class RcprgHandshake:
    """RCPRG's fri_start: ``$FRI_FRM_BOOL[1]`` with ``$FRI_FRM_INT[1]``, ``$FRI_TO_BOOL[1]``; it has no close.

    The published program repeats a request while the bit is set, even after a fallback. The bit is therefore
    taken back with the acknowledgement. The control mode is the program's own.
    """

    name = "rcprg"
    can_close = False

    def request_start(self, cmd: np.ndarray, msr: np.ndarray, control: Control) -> None:
        """1 in [1], request bit set until acknowledged."""
        self._request(cmd, msr, 1, State.CMD)

    def request_stop(self, cmd: np.ndarray, msr: np.ndarray) -> None:
        """2 in [1], request bit set until acknowledged."""
        self._request(cmd, msr, 2, State.MON)

    request_close = request_stop

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


class IdentificationHandshake(_StatusHandshake):
    """The program of this project, configs/krl/lwr_identification.src.

    ``$FRI_FRM_INT[16]`` asks for 11 monitor mode, 22 command mode, 33 the end. A packet has no check sum, so the
    requests differ in two bits at least. ``$FRI_TO_INT[16]`` is the phase: 1 monitor mode, 2 and 3 on the way to
    command mode, 4 command mode, 5 ended, 6 command mode lost; after 6 the PC must ask for monitor mode.
    ``[14]`` numbers the load data in ``$FRI_FRM_REA[1..7]``, with the negative number in ``[13]`` and the sum in
    ``$FRI_FRM_REA[8]``; ``$FRI_TO_INT[14]`` is the number of the load data in force.
    """

    name = "lwr_identification"
    status = 15
    open_values = (1, 2, 3, 4)
    started_value = 4
    stopped_values = (1,)
    fallen_values = (4, 6)

    def request_start(self, cmd: np.ndarray, msr: np.ndarray, control: Control) -> None:
        """22 in [16]; the program knows position control only."""
        cmd["krl_int"][15] = 22

    def request_stop(self, cmd: np.ndarray, msr: np.ndarray) -> None:
        """11 in [16]."""
        cmd["krl_int"][15] = 11

    def request_close(self, cmd: np.ndarray, msr: np.ndarray) -> None:
        """33 in [16], taken in monitor mode."""
        cmd["krl_int"][15] = 33

    def request_load(self, cmd: np.ndarray, msr: np.ndarray, load: np.ndarray) -> None:
        """Put load data in force: mass [kg], centre of mass in the flange frame [mm] (3), inertia about it
        JX JY JZ [kg m2]; (7,) float. Repeat until `load_taken`.
        """
        wanted = np.asarray(load, dtype=np.float32)
        # The same load data again are no news to the program, though others were entered at the pendant since.
        replaced = self.load_taken(cmd, msr) and not same_load(self.load(msr), wanted)
        if int(cmd["krl_int"][13]) == 0 or replaced or not np.array_equal(cmd["krl_real"][:7], wanted):
            number = max(int(cmd["krl_int"][13]), int(msr["krl_int"][13])) + 1
            cmd["krl_real"][:7], cmd["krl_real"][7] = wanted, wanted.sum()
            cmd["krl_int"][12:14] = (-number, number)

    def load_taken(self, cmd: np.ndarray, msr: np.ndarray) -> bool:
        """Whether the load data of the last request are in force."""
        return bool(cmd["krl_int"][13] != 0 and cmd["krl_int"][13] == msr["krl_int"][13])

    def load(self, msr: np.ndarray) -> np.ndarray:
        """Load data in force: mass [kg] and centre of mass in the flange frame [mm], (4,)."""
        return np.array(msr["krl_real"][7:11], dtype=np.float64)


def same_load(one: np.ndarray, other: np.ndarray) -> bool:
    """Whether mass [kg] and centre of mass [mm] of load data (4,) agree within 1 g and 0.1 mm, as they travel in
    float32; false for NaN. Without a mass there is no centre."""
    mass, centre = abs(float(one[0] - other[0])), float(np.abs(one[1:4] - other[1:4]).max())
    return mass <= 1e-3 and (centre <= 0.1 or not (one[0] or other[0]))


#: The handshakes by the name of the KRL program.
HANDSHAKES: Mapping[str, Handshake] = MappingProxyType(
    {h.name: h for h in (IdentificationHandshake(), StanfordHandshake(), RosHandshake(), RcprgHandshake())}
)


def find_handshake(name: str) -> Handshake:
    """Handshake of the KRL program `name`, or ConfigurationError."""
    try:
        return HANDSHAKES[name]
    except KeyError:
        raise ConfigurationError(
            f"KRL program {name!r} is not known; known are {', '.join(sorted(HANDSHAKES))}"
        ) from None
