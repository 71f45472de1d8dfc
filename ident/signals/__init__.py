"""Signal processing between the session log and the regression."""

from __future__ import annotations

from ident.signals.delay import Delay, DelayData, estimate_delay
from ident.signals.filters import ParallelFilter, differentiate, low_pass
from ident.signals.prepare import Passage, PreparedSession, TorqueChannel, prepare
from ident.signals.settings import SignalSettings
from ident.signals.spectrum import advice, excitation_frequency, optimal_cutoff

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
