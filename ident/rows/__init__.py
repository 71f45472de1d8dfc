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
)
from ident.rows.observation import commanded, observe, stack
from ident.rows.prepare import prepare
from ident.rows.prepared import Passage, PreparedSession, TorqueChannel
from ident.rows.sessions import payload_name, require, stated_mass
from ident.rows.signal_choice import SignalChoice, choose_signals
from lwr_driver.session import Sessions, as_sessions

__all__ = [
    "Delay",
    "DelayData",
    "ParallelFilter",
    "Passage",
    "PreparedSession",
    "Sessions",
    "SignalChoice",
    "SignalSettings",
    "TorqueChannel",
    "advice",
    "as_sessions",
    "choose_signals",
    "commanded",
    "differentiate",
    "estimate_delay",
    "excitation_frequency",
    "low_pass",
    "observe",
    "payload_name",
    "prepare",
    "require",
    "stack",
    "stated_mass",
]
