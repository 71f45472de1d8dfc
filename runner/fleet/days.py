"""Session logs by arm and day, from their names and the head of each file."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from datetime import UTC, date, datetime
from pathlib import Path

from fri.errors import DataError, LwrError
from lwr_driver.session.scan import Scan

_ISO_DAY = re.compile(r"(?<!\d)(\d{4}-\d{2}-\d{2})(?!\d)")
_UNSAFE = re.compile(r"[^\w.+-]+")


UNDATED = date(1970, 1, 1)
"""Day of the logs of a clock without a date, all of them together: it counts from zero."""


@dataclass(frozen=True)
class Log:
    """A log on disk. uid : its identity, the same in a copy."""

    path: Path
    uid: str


@dataclass(frozen=True)
class ArmDay:
    """The logs of an arm on a day that are not in the store yet.

    part : 1, or more for logs that came after others of the day had been taken.
    """

    arm: str
    day: date
    logs: tuple[Log, ...]
    part: int = 1

    @property
    def key(self) -> str:
        """The day, with the part from the second on; the name of its files in the store."""
        day = "undated" if self.day == UNDATED else self.day.isoformat()
        return day + (f"_{self.part}" if self.part > 1 else "")


def day_of(key: str) -> float:
    """Days since year 1, of a day's key; later parts of a day follow within it. That of `UNDATED` without a date."""
    match = re.fullmatch(r"(undated|\d{4}-\d{2}-\d{2})(?:_(\d+))?", key)
    if match is None:
        raise ValueError(f"{key!r} is no day")
    day = UNDATED if match[1] == "undated" else date.fromisoformat(match[1])
    return day.toordinal() + 0.01 * (int(match[2] or 1) - 1)


def as_day(time: float) -> str:
    """The day of `day_of` as text."""
    day = date.fromordinal(int(time + 1e-6))
    return "undated" if day == UNDATED else day.isoformat()


def dated(key: str) -> bool:
    """Whether a day's key tells a date."""
    return as_day(day_of(key)) != "undated"


@dataclass(frozen=True)
class Found:
    """Days to work on; `unreadable` : path and reason; `repeated` : logs that are copies of others."""

    days: tuple[ArmDay, ...]
    unreadable: tuple[tuple[Path, str], ...] = ()
    repeated: tuple[Path, ...] = ()
    known: int = 0


def find_days(places: Iterable[Path], known: Collection[str] = ()) -> Found:
    """Logs under the folders and files of `places`, by arm and day, without those with a `known` uid.

    The arm is robot and serial number of the log; without a number, the first folder from the given one on
    without a date in its name. The day is a date such as 2026-03-12 in the path from the given folder on, the deepest
    one; else the log's own, or `UNDATED`.
    DataError where there is no log at all.
    """
    groups: dict[tuple[str, date], list[Log]] = {}
    unreadable: list[tuple[Path, str]] = []
    repeated: list[Path] = []
    seen, skipped = set(known), 0
    logs = [(path, root) for root in places for path in _logs(root)]
    for path, root in logs:
        try:
            log, arm, day = _head(path, root)
        except (LwrError, OSError, ValueError) as error:
            unreadable.append((path, str(error)))
            continue
        if log.uid in seen:
            if log.uid in known:
                skipped += 1
            else:
                repeated.append(path)
            continue
        seen.add(log.uid)
        groups.setdefault((arm, day), []).append(log)
    if not logs:
        raise DataError("no .mcap log in the given folders; name folders or files that hold session logs")
    days = tuple(ArmDay(arm, day, tuple(files)) for (arm, day), files in sorted(groups.items()))
    return Found(days, tuple(unreadable), tuple(repeated), skipped)


def _logs(root: Path) -> list[Path]:
    return [root] if root.is_file() else sorted(root.rglob("*.mcap"))


def _head(path: Path, root: Path) -> tuple[Log, str, date]:
    scan = Scan(path)
    first = next(scan.blocks(), None)
    if first is None:
        raise DataError(f"{path}: holds no message")
    metadata = next((values for name, values in scan.metadata if name == "session"), {})
    robot, serial = metadata.get("robot", "") or "arm", metadata.get("serial", "")
    inner = path.relative_to(root).parts[:-1] if path != root else ()
    outer = path.resolve().parents if root.is_file() else (root.resolve(), *root.resolve().parents)
    folders = (part for part in (*inner, *(folder.name for folder in outer)) if not _ISO_DAY.search(part))
    own = serial or next(folders, "")
    arm = _UNSAFE.sub("_", f"{robot} {own}".strip())
    dated = (
        (root.resolve().name, *path.relative_to(root).parts) if path != root else path.resolve().parts[-3:]
    )
    begun = int(first.log_time[0])
    # Two recordings by one experiment file may have one uid.
    uid = f"{metadata['uid']}-{begun}" if metadata.get("uid") else _hash(path)
    return Log(path, uid), arm, _day(dated, metadata, begun)


def _day(dated: Sequence[str], metadata: dict[str, str], first_ns: int) -> date:
    for part in reversed(dated):
        for text in reversed(_ISO_DAY.findall(part)):
            try:
                return date.fromisoformat(text)
            except ValueError:
                continue
    try:
        own = datetime.fromisoformat(metadata.get("utc_start", "")).date()
    except ValueError:
        own = datetime.fromtimestamp(1e-9 * first_ns, UTC).date()
    return UNDATED if own.year == UNDATED.year else own


def _hash(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
