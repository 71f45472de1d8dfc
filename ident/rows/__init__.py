"""Signal processing between the session log and the regression."""

from __future__ import annotations

from ident.rows.delay import Delay, DelayData, estimate_delay
from ident.rows.filters import (
    ParallelFilter,
    SignalSettings,
    advice,
    differentiate,
    excitation_frequency,
    low_pass,
    optimal_cutoff,
)
from ident.rows.prepare import Passage, PreparedSession, TorqueChannel, prepare

__all__ = [
    "Delay",
    "DelayData",
    "ParallelFilter",
    "Passage",
    "PreparedSession",
    "SignalSettings",
    "TorqueChannel",
    "advice",
    "differentiate",
    "estimate_delay",
    "excitation_frequency",
    "low_pass",
    "optimal_cutoff",
    "prepare",
]
