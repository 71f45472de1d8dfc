"""Logs of a simulated fleet: each arm a little different, its friction other each day, and what happens to some."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import date, timedelta
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ident.model.dynamic_model import DynamicModel
from lwr_driver.session import SessionWriter, session_metadata

Floats = NDArray[np.float64]
START = date(2026, 3, 1)
PERIOD_S = 12.0
# Standard deviation of friction between arms and from day to day, as shares of it.
_MADE, _DAILY = 0.05, 0.03


@dataclass(frozen=True)
class Event:
    """What happens to an arm on a day (from 0) and stays.

    kind : `wear` (friction of a joint grows by `size` a day, as a share), `sensor` (another joint torque sensor: its
    zero moves by `size` Nm), `payload` (a load is mounted).
    """

    arm: int
    kind: str
    day: int
    joint: int = 1
    size: float = 0.0


@dataclass(frozen=True)
class Fleet:
    """A simulated fleet, recorded into `folder`/arm/day with `rate_hz` samples a second."""

    truth: DynamicModel
    folder: Path
    events: tuple[Event, ...] = ()
    seed: int = 1
    rate_hz: float = 200.0

    def record(self, arm: int, day: int) -> list[Path]:
        """Write the logs of an arm's day: without a payload, and with one after such an event."""
        model = self.model(arm, day)
        carried = any(e.kind == "payload" and e.arm == arm and day >= e.day for e in self.events)
        payloads = ["none", "load"] if carried else ["none"]
        place = self.folder / f"arm_{arm:02d}" / (START + timedelta(days=day)).isoformat()
        place.mkdir(parents=True, exist_ok=True)
        return [
            self._log(place / f"{payload}.mcap", model, payload, (self.seed, arm, day, number))
            for number, payload in enumerate(payloads)
        ]

    def model(self, arm: int, day: int) -> DynamicModel:
        """The arm on a day."""
        made = np.random.default_rng((self.seed, arm))
        daily = np.random.default_rng((self.seed, arm, day))
        values = dict(zip(self.truth.names, self.truth.values, strict=True))
        for name in values:
            if name.startswith("F"):
                values[name] *= 1.0 + _MADE * made.normal() + _DAILY * daily.normal()
        for event in self.events:
            if event.arm != arm or day < event.day:
                continue
            if event.kind == "wear":
                for name in (f"Fcm{event.joint}", f"Fvm{event.joint}"):
                    values[name] *= 1.0 + event.size * (day - event.day + 1)
            elif event.kind == "sensor":
                values[f"offl{event.joint}"] += event.size
        return replace(self.truth, values=np.array(list(values.values())))

    def _log(self, path: Path, model: DynamicModel, payload: str, seed: Sequence[int]) -> Path:
        random = np.random.default_rng(seed)
        chain = model.structure.chain
        time, q, qd, qdd = _motion(random, chain.n, self.rate_hz)
        mounted = None if payload == "none" else payload
        stamps = 1_700_000_000_000_000_000 + np.rint(time * 1e9).astype(np.int64)
        metadata = session_metadata(robot=model.robot, payload=payload, uid="-".join(map(str, seed)))
        with SessionWriter(
            path, chain.joint_names, metadata, robot_description=chain.urdf, start_ns=int(stamps[0])
        ) as writer:
            joint = model.torque(q, qd, qdd, payload=mounted, side="joint")
            motor = model.torque(q, qd, qdd, payload=mounted, side="motor")
            writer.write_joint_states(
                stamps, q, joint + 0.05 * random.normal(size=q.shape), publish_time=stamps
            )
            writer.write_motor_states(stamps, motor + 0.2 * random.normal(size=q.shape), publish_time=stamps)
        return path


def _motion(random: np.random.Generator, n: int, rate_hz: float) -> tuple[Floats, Floats, Floats, Floats]:
    """Times (N,), and q, qd, qdd (N, n) of a random Fourier series."""
    time = np.arange(round((PERIOD_S + 2.0) * rate_hz)) / rate_hz
    k = np.arange(1, 6)
    phase = 2 * np.pi / PERIOD_S * time[:, None, None] * k
    w = 2 * np.pi / PERIOD_S * k
    a, b = random.normal(size=(2, n, 5)) * 0.5
    sine, cosine = np.sin(phase), np.cos(phase)
    q = np.sum((a * sine - b * cosine) / w, axis=2)
    qd, qdd = np.sum(a * cosine + b * sine, axis=2), np.sum(w * (b * cosine - a * sine), axis=2)
    return time, q + random.uniform(-0.3, 0.3, n), qd, qdd
