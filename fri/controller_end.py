"""UDP socket of the controller's end (signatures; bodies follow)."""

from __future__ import annotations

from collections.abc import Callable

from fri.krc import KrcSession, Sample, Setpoint


class ControllerEnd:
    """UDP client of the controller: sends first, collects the answers of one PC.

    Low level, for an emulator that injects faults itself: ``send``, ``receive``. High level: ``lock_step``, ``real_time``.
    """

    def __init__(self, remote: tuple[str, int], local: tuple[str, int] = ("127.0.0.1", 0)) -> None: ...
    def send(self, datagram: bytes) -> None: ...
    def receive(self, timeout_s: float) -> bytes | None:
        """Next datagram of the PC, or None after `timeout_s` (0: what is there already)."""

    def lock_step(
        self,
        session: KrcSession,
        sample: Sample,
        *,
        patience_s: float = 10.0,
        idle: Callable[[], bool] | None = None,
    ) -> Setpoint | None:
        """One cycle: send, wait for the answer (MON: for ever; CMD: patience_s, then a miss), close the cycle.

        The very first packet is sent again every 0.2 s until anything was answered. `idle` is called every 50 ms of waiting; True gives up (None).
        """

    def real_time(self, session: KrcSession, sample: Sample, deadline: float) -> Setpoint:
        """One cycle in real time: send now, collect answers until `deadline` (time.monotonic), close the cycle."""

    def close(self) -> None: ...
