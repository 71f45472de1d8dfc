"""The diagnosis as a person gets it: measured gains, plots, one screen of text, files, and what would decide."""

from __future__ import annotations

from runner.diagnosis.sources import arm_data, chain_of, known_arm
from runner.diagnosis.study import Study, study

__all__ = ["Study", "arm_data", "chain_of", "known_arm", "study"]
