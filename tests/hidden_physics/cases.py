"""Cases drawn from seeds, recorded into folders: what may be seen, and apart from it what is hidden."""

from __future__ import annotations

import hashlib
import json
import math
import os
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lwr_driver.session import read_session
from tests.hidden_physics.causes import CAUSES
from tests.hidden_physics.hidden import Cause, Hidden, Scene
from tests.hidden_physics.inflation import base_error
from tests.hidden_physics.motions import SCHEDULES, exciting_motion
from tests.hidden_physics.outside import OUTSIDE
from tests.hidden_physics.recording import Order, begin_s, record
from tests.hidden_physics.robots import SESSIONS, Day, Encoder, Setting, session_settings
from tests.hidden_physics.variants import VARIANTS

__all__ = ["KINDS", "Case", "Sessions", "Store", "draw"]

KINDS = ("single", "none", "pair", "triple", "outside")

_PAYLOAD, _PAYLOAD_KG = "paper_load", 3.34
_TWIN_DAYS = 3
_SIZES = (0.35, 4.0)
# Share of a session's samples below a torque that it reaches often enough to show a limit there.
_OFTEN = 0.98


@dataclass(frozen=True)
class Sessions:
    """What a diagnosis may see: logs to learn from and logs held out."""

    train: tuple[Path, ...]
    test: tuple[Path, ...]


@dataclass(frozen=True)
class Case:
    """One case; the hidden part stays with whoever judges.

    name : tells nothing. seed : of the draw; kind : of `KINDS`. schedule : of the motions; day : of the arm
    """

    name: str
    seed: int
    kind: str
    schedule: str
    day: Day
    hidden: tuple[Hidden, ...] = ()

    def settings(self) -> tuple[Setting, ...]:
        """Everything hidden, session by session."""
        whole = [Setting() for _ in range(SESSIONS)]
        for hidden in self.hidden:
            whole = [mine.joined(more) for mine, more in zip(whole, hidden.settings, strict=True)]
        return tuple(whole)

    def alone(self, index: int) -> Case:
        """The same case with only one of its hidden causes."""
        hidden = (self.hidden[index],)
        return Case(_name("alone", self.seed, index), self.seed, "single", self.schedule, self.day, hidden)

    def truth(self) -> dict[str, Any]:
        """What is hidden, for a judge's file."""
        return {
            "name": self.name,
            "seed": self.seed,
            "kind": self.kind,
            "schedule": self.schedule,
            "day": asdict(self.day),
            "hidden": [
                {
                    "cause": hidden.cause,
                    "side": hidden.side,
                    "joints": list(hidden.joints),
                    "size": hidden.size,
                    "variant": hidden.variant,
                    "passing": hidden.passing,
                    "parameters": dict(hidden.parameters),
                    "depends_on": list(hidden.depends_on),
                }
                for hidden in self.hidden
            ],
        }


def _name(*parts: object) -> str:
    """A name that tells nothing of what it was made from."""
    return hashlib.sha256(repr(parts).encode()).hexdigest()[:12]


class Store:
    """A folder of recorded sessions; what is there is not recorded again.

    folder : anywhere. Healthy twins are shared among the cases of a day. era : another one has other days, of the
    cases as of the reference.
    """

    def __init__(self, folder: Path, era: int = 0) -> None:
        self.folder = folder
        self.era = era

    def sessions(self, case: Case) -> Sessions:
        """The logs of a case, recorded now where they are missing."""
        return Sessions(self.train(case), (self._log(case, SESSIONS - 1),))

    def train(self, case: Case) -> tuple[Path, ...]:
        """Those of a case to learn from."""
        return tuple(self._log(case, number) for number in range(SESSIONS - 1))

    def _log(self, case: Case, number: int) -> Path:
        path = self.folder / case.name / f"session_{number + 1}.mcap"
        if not path.is_file():
            path.parent.mkdir(parents=True, exist_ok=True)
            # Processes that need the same day at once record it each.
            part = path.with_suffix(f".{os.getpid()}.part.mcap")
            part.unlink(missing_ok=True)
            record(order(case, number, case.settings()[number], part))
            part.replace(path)
        return path

    def error(self, case: Case) -> NDArray[np.float64]:
        """Held-out error of the base model (14,) [Nm], kept beside the logs of healthy twins."""
        kept = self.folder / case.name / "base_error.json"
        if kept.is_file():
            return np.array(json.loads(kept.read_text()))
        sessions = self.sessions(case)
        error = base_error(sessions.train, sessions.test)
        kept.write_text(json.dumps(error.tolist()))
        return error

    def scene(self, schedule: str, day: Day) -> Scene:
        """What the healthy twin shows."""
        sessions = self.sessions(twin(schedule, day))
        size = {path: np.abs(read_session(path).joint.effort) for path in (*sessions.train, *sessions.test)}
        peaks = np.max([values.max(axis=0) for values in size.values()], axis=0)
        often = {path: np.quantile(values, _OFTEN, axis=0) for path, values in size.items()}
        learnt, held = (
            np.max([often[p] for p in paths], axis=0) for paths in (sessions.train, sessions.test)
        )
        return Scene(tuple(peaks.tolist()), tuple(np.minimum(learnt, held).tolist()), _begin_s())


@cache
def _begin_s() -> float:
    return begin_s(Order(exciting_motion("A1"), Path("unused.mcap"), {}, ""))


def order(case: Case, number: int, setting: Setting, path: Path) -> Order:
    """Session `number` (from 0) of a case."""
    loaded = number > 0
    return Order(
        motion=exciting_motion(f"{case.schedule}{number + 1}"),
        path=path,
        settings=session_settings(case.day, setting),
        uid=_name("session", case.name, number),
        seed=case.day.seed(number),
        payload=_PAYLOAD if loaded else "none",
        payload_mass=_PAYLOAD_KG if loaded else None,
    )


def twin(schedule: str, day: Day) -> Case:
    """The healthy arm of a day."""
    return Case(_name("twin", schedule, day.number, day.encoder), 0, "none", schedule, day)


def draw(
    seed: int,
    kind: str,
    store: Store,
    *,
    causes: Sequence[str] | None = None,
    size: float | None = None,
    encoder: Encoder = "link",
) -> Case:
    """Case number `seed` of a kind.

    causes : names to choose from, all by default. size : of the hidden causes, drawn by default
    """
    random = np.random.default_rng((seed, KINDS.index(kind)))
    schedule = str(random.choice(SCHEDULES))
    if kind == "none":
        day = Day(10_000 + seed, encoder)
        return Case(twin(schedule, day).name, seed, kind, schedule, day)
    known = OUTSIDE if kind == "outside" else CAUSES | VARIANTS
    names = list((OUTSIDE if kind == "outside" else CAUSES) if causes is None else causes)
    count = {"pair": 2, "triple": 3}.get(kind, 1)
    chosen = _compatible(random, [known[name] for name in names], count)
    needed = {cause.encoder for cause in chosen} - {None}
    if needed:
        (encoder,) = needed  # type: ignore[assignment]
    day = Day(_TWIN_DAYS * store.era + int(random.integers(_TWIN_DAYS)), encoder)
    scene = store.scene(schedule, day)
    hidden, taken = [], set[int]()
    for cause in chosen:
        free = [joint for joint in cause.joints if joint not in taken]
        joint = int(random.choice(free))
        taken |= {joint} - {0}
        sized = cause.draw(random, joint, scene)
        drawn = math.exp(random.uniform(math.log(_SIZES[0]), math.log(_SIZES[1])))
        hidden.append(sized(drawn if size is None else size))
    name = _name("case", seed, kind, [h.cause for h in hidden], [h.size for h in hidden])
    return Case(name, seed, kind, schedule, day, tuple(hidden))


def _compatible(random: np.random.Generator, causes: Sequence[Cause], count: int) -> list[Cause]:
    """Different causes that can be in one arm at a time."""
    loads = {"payload_error", "payload_change"}
    while True:
        places = random.choice(len(causes), size=count, replace=False)
        chosen = [causes[int(place)] for place in places]
        if len({cause.encoder for cause in chosen} - {None}) > 1:
            continue
        if sum(cause.name in loads for cause in chosen) > 1:
            continue
        return chosen
