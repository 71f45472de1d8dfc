"""The diagnosis of sessions and experiments: gains, files, plots, look-alikes, discriminating experiments."""

from __future__ import annotations

from runner.diagnosis.study import Study, arm_data, asked, chain_of, study
from runner.estimation import known_arm

__all__ = ["Study", "arm_data", "asked", "chain_of", "known_arm", "study"]
