"""An effect hidden in the emulated arm of an experiment, and its comparison with what the diagnosis says."""

from __future__ import annotations
