"""How many samples of a session's joint channel never came, and how many are older than their stamps."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ident.dynamics.parameters import Floats
from ident.rows.data_quality import stale
from ident.rows.filters import median_step
from ident.rows.prepare import clock_ns
from ident.rows.sample_clock import sample_clock
from ident.rows.timebase import missing_samples
from lwr_driver.session import JointColumns


@dataclass(frozen=True)
class SampleCount:
    """lost : samples of the source that are not in the recording. old : samples repeated or older than their stamps,
    which rows leave out."""

    lost: int
    old: int


def sample_count(joint: JointColumns) -> SampleCount:
    """The counts of an estimate (`prepare`), by the same clock."""
    times_ns = clock_ns(joint)
    stamps: Floats = np.asarray((times_ns - times_ns[:1]) * 1e-9, dtype=np.float64)
    if len(stamps) < 2:
        return SampleCount(0, 0)
    clock = sample_clock(stamps, joint.position)
    times = stamps if clock is None else clock.times
    old = stale(joint) if clock is None else clock.repeated
    return SampleCount(missing_samples(times, median_step(times)), int(np.count_nonzero(old)))
