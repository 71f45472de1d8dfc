"""The diagnosis of sessions and experiments: gains, files, plots, look-alikes, discriminating experiments."""

from __future__ import annotations

from runner.diagnosis.study import Study, arm_data, asked, chain_of, study

__all__ = ["Study", "arm_data", "asked", "chain_of", "study"]
