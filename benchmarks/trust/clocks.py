"""Counters and clocks that disagree: rows of a motion never pass faster than time, and the sender is told of.

The loop stands opposite the emulated controller as for the faults on the wire, in (virtual) real time with the clock of
the loop, or in lock step, where only the controller's time stamp is a clock. Held against the true time of each cycle:
the row of the motion that was sent in it. Healthy senders, in pauses, jitter and with a clock slightly off, must lose
nothing by it.
"""

from __future__ import annotations

import re
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.trust.stand import Stand, shared_ring, the_motion
from benchmarks.trust.table import Ledger, stamp
from fri.states import Quality
from lwr_driver.control import Job, Mode, Result, Text, Word
from lwr_driver.ring import Ring

__all__ = ["campaign"]

_PERIODS_MS = (1, 2, 5, 10)
_RUNS = 30
_START_LIMIT = 700
# A sender in a hurry is to show what the driver does; this one never minds missing answers.
_PATIENT = {"bridged_cycles": 10**6, "hold_quality": Quality.UNACCEPTABLE}
_TOLD = "ahead of"

Random = np.random.Generator


@dataclass(frozen=True)
class _Case:
    """A disagreement. strike : begins it and returns what ends it after some cycles

    ahead : rows would pass too fast, so it must be told; success : the motion must succeed
    """

    strike: Callable[[Stand, Random], Callable[[], None]]
    ahead: bool
    success: bool
    lock_step: bool = False


def _jump(stand: Stand, random: Random) -> Callable[[], None]:
    stand.session._sequence += int(random.integers(2, 13))
    return lambda: None


def _burst(stand: Stand, random: Random) -> Callable[[], None]:
    stand.pace = 0.01
    return lambda: setattr(stand, "pace", 1.0)


def _fast(stand: Stand, random: Random) -> Callable[[], None]:
    stand.pace = float(random.uniform(0.25, 0.8))
    return lambda: None


def _pause(stand: Stand, random: Random) -> Callable[[], None]:
    """This computer stands still for two cycles and finds the packets waiting."""
    stand.hurry = 2
    return lambda: None


def _off(stand: Stand, random: Random) -> Callable[[], None]:
    stand.pace = float(random.uniform(0.999, 1.001))
    return lambda: None


_CASES = {
    "counter jumps, no time": _Case(_jump, ahead=True, success=False),
    "counter jumps, lock step": _Case(_jump, ahead=True, success=True, lock_step=True),
    "burst of packets": _Case(_burst, ahead=True, success=False),
    "packets faster than the header": _Case(_fast, ahead=True, success=False),
    "pause, then all at once": _Case(_pause, ahead=False, success=True),
    "clocks 0.1 % apart": _Case(_off, ahead=False, success=True),
}


def _run(case: _Case, random: Random, ring: Ring, folder: Path) -> tuple[list[str], float]:
    """One run; what did not hold, and the largest lead of the rows over time [rows]."""
    period_ms = int(random.choice(_PERIODS_MS))
    seed = np.random.SeedSequence(int(random.integers(2**32)))
    with Stand(
        seed, ring, folder, period_ms=period_ms, lock_step=case.lock_step, policy=_PATIENT, uptime_s=100.0
    ) as stand:
        while not stand.loop.remote.received:
            stand.cycle()
        stand.cycles(20)
        stand.post(Job.START, limit=_START_LIMIT)
        if not stand.until_done(_START_LIMIT) or stand.loop.mode is not Mode.HOLD:
            return [f"no command mode: {stand.reason}"], 0.0
        motion = the_motion(period_ms, int(random.integers(12)))
        stand.start_motion(motion)
        stand.cycle()
        strike, end = int(random.integers(10, 60)), int(random.integers(3, 20))
        words, begun_ns, begun = stand.control.words, stand.clock.now_ns, stand.cycle_number
        lead, finish, cycles = 0.0, None, 0
        while not stand.done and cycles < 6 * len(motion):
            if cycles == strike:
                finish = case.strike(stand, random)
            if finish is not None and cycles == strike + end:
                finish()
            stand.cycle()
            cycles += 1
            true = stand.cycle_number - begun
            if not case.lock_step:
                true = (stand.clock.now_ns - begun_ns) / (period_ms * 1e6)
            lead = max(lead, int(words[Word.ROW]) - true)
        return _judge(case, stand, lead, len(motion)), lead


def _judge(case: _Case, stand: Stand, lead: float, rows: int) -> list[str]:
    # So early may a packet come, and so much may clocks differ, before it is held back, see `lwr_driver.pace`.
    most = 1.0 if case.lock_step else 0.8 + 0.5 / stand.period_ms + 0.002 * rows
    told = f"{stand.reason} {stand.control.text(Text.NOTE)} {stand.control.text(Text.LEFT)}"
    bad = []
    if not stand.done:
        bad.append("the motion has no end")
    if lead > most + 1e-6:
        bad.append(f"rows were {lead:.2f} ahead of time, at most {most:.2f}")
    if bool(re.search(_TOLD, told)) != case.ahead:
        bad.append(f"told: {told!r}")
    if case.success and stand.result is not Result.DONE:
        bad.append(f"ended with {stand.result.name}: {stand.reason}")
    return bad


def campaign(ledger: Ledger, options: Any) -> None:
    """A line for each kind of disagreement."""
    stamp()
    each = max(1, (options.runs or _RUNS) // len(_CASES))
    with shared_ring() as ring, tempfile.TemporaryDirectory() as name:
        for what, case in _CASES.items():
            line, leads = ledger.line("clocks", what), []
            if ledger.has("clocks", what):
                continue
            for number in range(each):
                random = np.random.default_rng([options.seed, number, len(what)])
                bad, lead = _run(case, random, ring, Path(name))
                line.count(bad, f"run {number}")
                leads.append(lead)
            line.figures = {"largest lead over time [rows]": round(max(leads), 2), **stamp()}
            ledger.finish("clocks", what)
