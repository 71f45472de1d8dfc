"""Many arms over many days: logs found by arm and day, a store of results, changes and their page."""

from runner.fleet.batch import Order, Progress, run_batch
from runner.fleet.days import ArmDay, find_days
from runner.fleet.store import ArmStore, FleetStore
from runner.fleet.trend import ArmTrend, FleetTrend, arm_trend, fleet_trend, usual_scatter

__all__ = [
    "ArmDay",
    "ArmStore",
    "ArmTrend",
    "FleetStore",
    "FleetTrend",
    "Order",
    "Progress",
    "arm_trend",
    "find_days",
    "fleet_trend",
    "run_batch",
    "usual_scatter",
]
