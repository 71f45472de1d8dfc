"""From the fault to the safe reaction, in cycles of the controller."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.trust.stand import Stand, shared_ring, the_motion
from benchmarks.trust.table import Ledger
from fri.states import Control, EventKind, Quality, State
from lwr_driver.control import Job, Mode, Word
from lwr_driver.ring import Ring

__all__ = ["CAUSES", "campaign", "measure"]

_RUNS = 30


def _silent(stand: Stand) -> None:
    stand.silent = 10**6


def _deaf(stand: Stand) -> None:
    stand.inject(kind="loss", direction="to_krc", probability=1.0)


def _held(stand: Stand) -> None:
    stand.displacement = np.array([0.0, 0.25, 0.0, 0.0, 0.0, 0.0, 0.0])


def _stop(stand: Stand) -> None:
    stand.control.words[Word.STOP] += 1


def _drop(stand: Stand) -> None:
    stand.control.words[Word.DROP] = 1


CAUSES: dict[str, Callable[[Stand], None]] = {
    "emergency stop": lambda stand: stand.session.drop(EventKind.EXTERNAL, "emergency stop"),
    "drives off": lambda stand: stand.session.set_drives(0),
    "drive error": lambda stand: stand.session.set_drives(0x7F, error=4),
    "control mode": lambda stand: setattr(stand.session, "control", Control.JNT_IMP),
    "quality": lambda stand: setattr(stand.session, "quality_ceiling", Quality.UNACCEPTABLE),
    "arm does not follow": _held,
    "controller silent": _silent,
    "answers lost": _deaf,
    "Ctrl-C": _stop,
    "Ctrl-C twice": _drop,
}


def measure(cause: str, seed: int, ring: Ring, folder: Path) -> dict[str, Any]:
    """Cycles from the cause to: the last row of the motion sent, the result told, the arm at rest."""
    random = np.random.default_rng([seed, len(cause)])
    with Stand(
        np.random.SeedSequence(seed), ring, folder, period_ms=10, lock_step=False, ahead=seed % 2 == 0
    ) as stand:
        while not stand.loop.remote.received:
            stand.cycle()
        stand.post(Job.START, limit=900)
        stand.until_done(900)
        stand.start_motion(the_motion(10, seed % 12))
        stand.until_done(int(random.integers(8, 40)))
        CAUSES[cause](stand)
        begun = stand.cycle_number
        sent = told = still = 0
        for _ in range(200):
            before = stand.setpoint.copy()
            row = int(stand.control.words[Word.ROW])
            # A controller that no longer follows ignores further commands.
            follows = stand.session.state is State.CMD and stand.silent == 0
            stand.cycle()
            now = stand.cycle_number - begun
            if stand.loop.mode is Mode.MOTION and follows and int(stand.control.words[Word.ROW]) > row:
                sent = now
            if not told and stand.done:
                told = now
            if float(np.abs(stand.setpoint - before).max()) > 1e-9:
                still = now
        complaints = [] if told else ["no result"]
        if stand.monitor.violations.sum():
            complaints.append(f"outside the limits: {stand.monitor.first_violation}")
        return {"sent": sent, "told": told, "still": still, "reason": stand.reason, "bad": complaints}


def campaign(ledger: Ledger, options: Any) -> None:
    """A line for each cause."""
    with shared_ring() as ring, tempfile.TemporaryDirectory() as folder:
        for cause in CAUSES:
            if ledger.has("reaction", cause):
                continue
            found = []
            line = ledger.line("reaction", cause)
            for number in range(options.runs or _RUNS):
                result = measure(cause, options.seed * 1000 + number, ring, Path(folder))
                line.count(result["bad"], f"seed {options.seed * 1000 + number}")
                found.append(result)
            line.figures = {
                "last row after [cycles]": max(r["sent"] for r in found),
                "told after": max(r["told"] for r in found),
                "set point at rest after": max(r["still"] for r in found),
                "reason": found[0]["reason"][:60],
            }
            ledger.finish("reaction", cause)
