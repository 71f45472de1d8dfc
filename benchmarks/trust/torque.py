"""The motor torque channel: freshness, losses, late samples, wrong scale and order, trace alignment."""

from __future__ import annotations

from typing import Any

import numpy as np

from benchmarks.trust.gathered import gather
from benchmarks.trust.table import Ledger
from lwr_driver.session.motor_torque import KrlMotorTorque, KrlTorqueDecoder

__all__ = ["campaign"]

_RUNS = 500
_LINES = {
    "freshness and holds": ["lwr_driver/session/test_motor_torque.py"],
    "order, scale, payload, said by lwr-run": ["runner/experiment/test_payload_and_torque.py"],
    "trace of an unknown clock": ["lwr_driver/session/test_alignment.py"],
    "trace file": ["lwr_driver/session/test_trace.py"],
}


def _decode(random: np.random.Generator) -> list[str]:
    """A KRL loop of random pace over a link that loses packets: every fresh value once, losses counted."""
    cycles, hold = 4000, int(random.integers(1, 40))
    ticks = np.cumsum(random.random(cycles) < 1.0 / hold).astype(np.int64)
    values = np.zeros((cycles, 16), dtype=np.float32)
    values[:, :7] = ticks[:, None] + np.arange(7) * 0.01
    modulus = int(random.choice([8, 256, 2**16, 2**31]))
    counters = np.zeros((cycles, 16), dtype=np.int32)
    counters[:, 0] = (ticks + int(random.integers(modulus))) % modulus
    kept = np.flatnonzero(random.random(cycles) > random.choice([0.0, 0.01, 0.2]))
    decoder = KrlTorqueDecoder(KrlMotorTorque(counter_modulus=modulus))
    times = kept * 1_000_000
    fresh = []
    # In batches, as they come.
    for batch in np.array_split(np.arange(len(kept)), int(random.integers(1, 30))):
        rows = kept[batch]
        fresh.append(decoder.decode(times[batch], times[batch], values[rows], counters[rows]))
    effort = np.concatenate([part.effort for part in fresh])
    number = np.concatenate([part.sequence for part in fresh])
    seen = ticks[kept]
    expected = seen[1:][np.diff(seen) > 0]
    bad = []
    if not np.array_equal(np.rint(effort[:, 0]), expected):
        bad.append(f"{len(effort)} fresh samples, expected {len(expected)}")
    # A step of a whole turn of the counter or more cannot be seen.
    if len(expected) > 1 and np.diff(expected).max() < modulus:
        if not np.array_equal(np.diff(number), np.diff(expected)):
            bad.append("the numbers do not count the lost samples")
        if decoder.lost != int((np.diff(expected) - 1).sum()):
            bad.append(f"{decoder.lost} lost")
    return bad


def campaign(ledger: Ledger, options: Any) -> None:
    """Random channels, then the tests."""
    if not ledger.has("torque", "decoder"):
        line = ledger.line("torque", "random pace, losses, wraps")
        for number in range(options.runs or _RUNS):
            line.count(_decode(np.random.default_rng([options.seed, number])), f"run {number}")
        ledger.finish("torque", "decoder")
    gather(ledger, "torque", _LINES)
