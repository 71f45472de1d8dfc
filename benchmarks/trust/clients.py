"""Other people's FRI clients on the emulator: their styles, the published handshakes and none, 1 to 100 ms."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

from benchmarks.trust import compiled
from benchmarks.trust.gathered import gather
from benchmarks.trust.table import Ledger
from runner.laboratory import free_port
from sim_backend.process import EmulatorProcess

__all__ = ["campaign"]

_PERIODS_MS = (1, 2, 5, 10, 20, 50, 100)
_PROGRAMS = {"stanford": "stanford", "ros": "ros_control", "none": "auto_start"}
# Styles of a client, with the handshakes of the clients that have it.
_STYLES = {
    "superpose": ("stanford", "ros", "none"),
    "absolute": ("stanford", "ros", "none"),
    "sample": ("none",),
    "impedance": ("stanford",),
}
_KRC = "fri/test_krc.py"
_LINES = {
    "packets as published clients send them": [
        f"{_KRC}::test_clients_that_know_only_the_bytes",
        f"{_KRC}::test_any_first_count_of_the_client_is_accepted_and_reflected",
        f"{_KRC}::test_superposing_client_does_not_integrate",
        "fri/test_krc_drops.py::test_first_command_away_from_the_mirror",
        "fri/test_states.py::test_flag_sets_are_those_that_clients_send",
        "fri/test_krl.py::test_stanford_values_on_the_wire",
    ],
}


def campaign(ledger: Ledger, options: Any) -> None:
    """A client in C in each style, with each handshake, at each period; it must move the arm undisturbed."""
    with tempfile.TemporaryDirectory() as name:
        program = compiled.client(Path(name))
        if program is None:
            ledger.line("clients", "no C compiler here: not measured")
        for style, handshakes in _STYLES.items() if program is not None else ():
            for handshake in handshakes:
                krl = _PROGRAMS[handshake]
                line = ledger.line("clients", f"C client, {style}, {krl}")
                for period_ms in _PERIODS_MS:
                    piece = f"{style} {handshake} {period_ms}"
                    if not ledger.has("clients", piece):
                        assert program is not None
                        line.count(_one(program, style, handshake, krl, period_ms), f"{period_ms} ms")
                        ledger.finish("clients", piece)
                line.figures["periods"] = f"{_PERIODS_MS[0]} to {_PERIODS_MS[-1]} ms"
    gather(ledger, "clients", _LINES)


def _one(program: Path, style: str, handshake: str, krl: str, period_ms: int) -> list[str]:
    packets = 900 + max(300, 2000 // period_ms)
    port = free_port("127.0.0.1")
    settings = {"fri.program": krl}
    with EmulatorProcess(fri_port=port, period_ms=period_ms, settings=settings) as emulator:
        pc = compiled.start(program, port, style=style, handshake=handshake, packets=packets)
        output, _ = pc.communicate(timeout=120)
        received, commanded = (int(word) for word in output.split())
        status = emulator.status()
    bad = [] if received == packets else [f"{received} of {packets} packets"]
    if commanded < 300:
        bad.append(f"commanded {commanded} cycles only: {status['events'][-3:]}")
    drops = [event for event in status["events"] if event["kind"] not in ("OPENED", "STARTED", "MISSES")]
    if drops:
        bad.append(f"the controller objected: {drops[0]}")
    return bad
