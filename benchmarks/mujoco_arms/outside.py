"""Faults that no catalogue has."""

from __future__ import annotations

from benchmarks.mujoco_arms.causes import Cause

OUTSIDE: dict[str, Cause] = {}
"""By name."""
