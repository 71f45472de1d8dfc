"""Changes of an arm over its days, and arms unlike the others."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ident.monitoring import Change, Series, Unlike, changes, day_scatter, unlike
from ident.monitoring.changes import LEAST_DAYS
from runner.fleet.days import UNDATED, as_day, dated, day_of
from runner.fleet.store import ArmStore, FleetStore

_ERROR = "error of "
"""Before joint and side, the name of a residual over the days."""

_Known = Mapping[str, tuple[Series, str]]
"""Each quantity over the days, with its unit, by name."""

# Probability of any change of an arm without one.
LEVEL = 0.001
# A change below this share of a quantity [%] is of no use to anyone, however significant.
_LEAST_PERCENT = 1.0


@dataclass(frozen=True)
class Named:
    """A change with unit and kind of its quantity: `parameter`, or `error` for the residual of a joint's torque."""

    change: Change
    unit: str
    kind: str

    @property
    def day(self) -> str:
        """First day with another value."""
        return as_day(self.change.time)

    @property
    def interval(self) -> str:
        """The day, with the days in question if there are several."""
        first, last = as_day(self.change.earliest), as_day(self.change.latest)
        return self.day if first == last else f"{self.day} ({first} to {last})"

    def __str__(self) -> str:
        one = self.change
        size = f" ({one.percent:+.1f} %)" if np.isfinite(one.percent) else ""
        course = "since" if one.course == "step" else "drifts since"
        return f"{one.name} {course} {self.interval}: {one.before:.4g} to {one.after:.4g} {self.unit}{size}"

    def to_dict(self) -> dict[str, Any]:
        """Plain content for JSON."""
        one = self.change
        return {
            "name": one.name,
            "kind": self.kind,
            "unit": self.unit,
            "course": one.course,
            "day": self.day,
            "earliest": as_day(one.earliest),
            "latest": as_day(one.latest),
            "before": one.before,
            "before_std": one.before_std,
            "after": one.after,
            "after_std": one.after_std,
            "percent": one.percent if np.isfinite(one.percent) else None,
            "p": one.p,
        }


@dataclass(frozen=True, eq=False)
class ArmTrend:
    """An arm over its days.

    days : keys in order. series : by name; units : by name. changes : by day. findings : rows of the store, by day.
    payloads : first day of each payload. failed : days without an estimate, with the reason.
    """

    arm: str
    days: tuple[str, ...]
    series: Mapping[str, Series]
    units: Mapping[str, str]
    changes: tuple[Named, ...]
    findings: tuple[Mapping[str, Any], ...]
    payloads: Mapping[str, str]
    failed: tuple[tuple[str, str], ...]

    @property
    def count(self) -> int:
        """Number of days with a date."""
        return len({key.partition("_")[0] for key in self.days if dated(key)})

    @property
    def doubt(self) -> str:
        """Why no change can be told, empty where one can: too few days, those without a date apart."""
        count = self.count
        if count >= LEAST_DAYS:
            return ""
        days = "no day with a date" if not count else "1 day" if count == 1 else f"{count} days"
        return f"{days}, too few to tell a change; {LEAST_DAYS} are needed"

    @property
    def undated(self) -> bool:
        """Whether there are logs without a date."""
        return not all(map(dated, self.days))

    @property
    def first_days(self) -> set[str]:
        """Keys of the first days after each change, the latest in question."""
        found = set()
        for one in self.changes:
            later = [key for key in self.days if day_of(key) >= one.change.latest]
            found |= {later[0]} if later else set()
        return found

    @property
    def first_findings(self) -> dict[tuple[str, str], Mapping[str, Any]]:
        """The first day's row of each cause and joints."""
        found: dict[tuple[str, str], Mapping[str, Any]] = {}
        for row in self.findings:
            found.setdefault((row["cause"], row["joints"]), row)
        return found

    @property
    def new_payloads(self) -> dict[str, str]:
        """First day of each payload that came after the first day."""
        return {name: day for name, day in self.payloads.items() if day != self.days[0]}

    def to_dict(self) -> dict[str, Any]:
        """Plain content for JSON."""
        return {
            "arm": self.arm,
            "days": list(self.days),
            "changes": [one.to_dict() for one in self.changes],
            "new_payloads": self.new_payloads,
            "findings": [
                {
                    "cause": cause,
                    "joints": joints,
                    "first_day": row["key"],
                    "confidence": row["confidence"],
                    "statement": row["statement"],
                }
                for (cause, joints), row in self.first_findings.items()
            ],
            "failed": [{"day": day, "reason": reason} for day, reason in self.failed],
        }

    def __str__(self) -> str:
        known = [key for key in self.days if dated(key)]
        lines = [f"{self.arm}: {len(known)} days, {known[0]} to {known[-1]}" if len(known) > 1 else self.arm]
        lines += [f"  {one}" for one in self.changes]
        lines += [f"  payload {name} since {day}" for name, day in self.new_payloads.items()]
        lines += [
            f"  {row['key']}: {row['statement']} (confidence {row['confidence']:.2f})"
            for row in self.first_findings.values()
        ]
        lines += [f"  {day}: no estimate: {reason}" for day, reason in self.failed]
        if self.doubt and not self.changes:
            lines.append(f"  {self.doubt}")
        elif len(lines) == 1:
            lines.append("  no change beyond its scatter from day to day")
        return "\n".join(lines)


@dataclass(frozen=True, eq=False)
class FleetTrend:
    """All arms, and the quantities in which an arm is unlike the others."""

    arms: tuple[ArmTrend, ...]
    strange: tuple[Unlike, ...]

    def to_dict(self) -> dict[str, Any]:
        """Plain content for JSON."""
        return {
            "arms": [arm.to_dict() for arm in self.arms],
            "unlike": [one.__dict__ for one in self.strange],
        }

    def __str__(self) -> str:
        calm = [
            arm for arm in self.arms if not (arm.changes or arm.findings or arm.new_payloads or arm.failed)
        ]
        lines = [str(arm) for arm in self.arms if arm not in calm]
        sure, short = ([arm for arm in calm if bool(arm.doubt) == few] for few in (False, True))
        for some, what in ((sure, "without a change"), (short, "with too few days to tell a change")):
            if some:
                names = ", ".join(arm.arm for arm in some)
                lines.append(f"{len(some)} of {len(self.arms)} arms {what}: {names}")
        for one in self.strange:
            lines.append(
                f"{one.arm} is unlike the others: {one.name} {one.value:.4g}, the others {one.median:.4g} +- "
                f"{one.spread:.2g}"
            )
        return "\n".join(lines)


def arm_trend(store: ArmStore, usual: Mapping[str, float] | None = None) -> ArmTrend:
    """Changes of an arm's parameters and residuals. usual : day-to-day scatter of such arms, by quantity."""
    return _judged(store, _read(store), usual or {})


def _judged(store: ArmStore, known: _Known, usual: Mapping[str, float]) -> ArmTrend:
    series = {name: replace(one, usual=usual.get(name)) for name, (one, _) in known.items()}
    units = {name: unit for name, (_, unit) in known.items()}
    level = LEVEL / max(len(series), 1)
    found = [
        Named(change, units[name], "error" if name.startswith(_ERROR) else "parameter")
        for name, one in series.items()
        for change in changes(_dated(one), level)
        if not abs(change.percent) < _LEAST_PERCENT
    ]
    sessions = store.read("sessions")
    payloads: dict[str, str] = {}
    for row in sessions:
        if row["status"] == "taken":
            payloads.setdefault(row["payload"] or "none", row["key"])
    failed = {row["key"]: row["note"] for row in sessions if row["status"] == "failed"}
    return ArmTrend(
        store.name,
        store.days(),
        series,
        units,
        tuple(sorted(found, key=lambda one: (one.change.time, one.change.p))),
        tuple(store.read("findings")),
        payloads,
        tuple(failed.items()),
    )


def usual_scatter(store: FleetStore) -> dict[str, float]:
    """Day-to-day scatter of each quantity, the median of the arms; of three arms or more."""
    return _usual(map(_read, store.arms()))


def _usual(arms: Iterable[_Known]) -> dict[str, float]:
    scatters: dict[str, list[float]] = {}
    for known in arms:
        for name, (series, _) in known.items():
            if len(series.values) > 2:
                scatters.setdefault(name, []).append(day_scatter(series))
    return {name: float(np.median(values)) for name, values in scatters.items() if len(values) > 2}


def fleet_trend(store: FleetStore) -> FleetTrend:
    """All arms; the scatter from day to day of each quantity is judged with that of all arms."""
    known = {arm: _read(arm) for arm in store.arms()}
    usual = _usual(known.values())
    arms = tuple(_judged(arm, one, usual) for arm, one in known.items())
    return FleetTrend(arms, unlike(_latest(arms)))


def _latest(arms: Sequence[ArmTrend]) -> dict[str, dict[str, tuple[float, float]]]:
    """Mean of each parameter before its first change, with its standard deviation, by arm."""
    found: dict[str, dict[str, tuple[float, float]]] = {}
    for arm in arms:
        first = {}
        for one in reversed(arm.changes):
            first[one.change.name] = one.change.earliest
        for name, series in arm.series.items():
            used = series.time < first.get(name, np.inf)
            if name.startswith(_ERROR) or not used.any():
                continue
            values, count = series.values[used], int(used.sum())
            std = np.hypot(day_scatter(series), float(np.mean(series.std[used]))) / np.sqrt(count)
            found.setdefault(name, {})[arm.arm] = float(np.median(values)), float(std)
    return found


def _read(store: ArmStore) -> _Known:
    """Each parameter and residual over the days, with its unit."""
    units: dict[str, str] = {}
    columns: dict[str, dict[str, tuple[float, float]]] = {}
    for row in store.read("parameters"):
        units[row["name"]] = row["unit"]
        columns.setdefault(row["name"], {})[row["key"]] = row["value"], row["std"]
    for row in store.read("errors"):
        name = f"{_ERROR}{row['joint']} {row['side']}"
        units[name] = "Nm"
        columns.setdefault(name, {})[row["key"]] = row["rms"], 0.0
    return {name: (_series(name, values), units[name]) for name, values in columns.items()}


def _dated(series: Series) -> Series:
    """The course without the day of undated logs, whose place in it nobody knows."""
    known = series.time != UNDATED.toordinal()
    return replace(series, time=series.time[known], values=series.values[known], std=series.std[known])


def _series(name: str, values: Mapping[str, tuple[float, float]]) -> Series:
    keys = sorted(values, key=day_of)
    time = np.array([day_of(key) for key in keys])
    numbers = np.array([values[key] for key in keys])
    return Series(name, time, numbers[:, 0], np.where(np.isfinite(numbers[:, 1]), numbers[:, 1], 0.0))
