"""Drawing a case from kind and seed, and writing its sessions and its truth."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.mujoco_arms.arms import KINDS, Individual, individual
from benchmarks.mujoco_arms.causes import CAUSES, Cause, Parameter, Variant
from benchmarks.mujoco_arms.days import Setup, day, payload
from benchmarks.mujoco_arms.outside import OUTSIDE
from benchmarks.mujoco_arms.recording import logged, write
from benchmarks.mujoco_arms.simulation import Truth, simulate
from benchmarks.mujoco_arms.strength import Record, Rows, Yardstick, found_strength, inflation, ten

Floats = NDArray[np.float64]

KINDS_OF_CASES = ("single", "pair", "healthy", "wear", "outside")
_MIX = ("single", "single", "healthy", "single", "outside", "single", "pair", "single", "wear", "single")
_RHO = (1.03, 3.0)
_AFFECTED = 1.03
_WITHOUT_SENSORS = 0.35
_BITS = (18.0, 24.0)
"""Of the encoders, a turn: 24 to 0.4 microradians a step."""
ALL = {**CAUSES, **OUTSIDE}


@dataclass(frozen=True)
class Hidden:
    """A fault in a case: its strength, and what of it is to be found."""

    cause: Cause
    variant: Variant
    target: float
    strength: float = 0.0
    rho: float = 1.0
    rho_reference: float = 1.0

    def joints(self) -> tuple[int, ...]:
        """Joints from 1; none for the whole arm."""
        return () if self.cause.where == "arm" else (self.variant.joint + 1,)


@dataclass(frozen=True)
class Case:
    """A case: an arm, two healthy days, and the day to be diagnosed."""

    seed: int
    kind: str
    arm: Individual
    reference: tuple[tuple[Setup, ...], ...]
    healthy: tuple[Setup, ...]
    hidden: tuple[Hidden, ...]

    @property
    def name(self) -> str:
        """Of its folder."""
        return f"{self.kind}_{self.seed}"


def kind_of(seed: int) -> str:
    """The kind that a seed stands for where none is asked for."""
    return _MIX[seed % len(_MIX)]


def draw(seed: int, kind: str, cause: str | None = None, arm: str | None = None) -> Case:
    """The case of a kind and a seed; `cause`, `arm`: instead of the drawn ones. Strengths are still open."""
    random = np.random.default_rng([seed, KINDS_OF_CASES.index(kind)])
    name = str(random.choice(sorted(KINDS)))
    body = individual(KINDS[arm or name](), random)
    chosen = _causes(seed, kind, cause, random)
    encoder = next((c.encoder for c in chosen if c.encoder), None)
    blind = body.kind.name == "UR5" and random.random() < _WITHOUT_SENSORS
    sensed = any(c.side == "sensor" or c.name == "joint_torque_delay" for c in chosen)
    bits = np.random.default_rng([seed, KINDS_OF_CASES.index(kind), 1]).uniform(*_BITS)
    body = replace(
        body,
        encoder=encoder or body.encoder,
        has_sensors=sensed or not blind,
        resolution=float(2.0 * np.pi / 2.0**bits),
    )
    loads = payload(body.kind, random), payload(body.kind, random)
    base = seed * 10 + KINDS_OF_CASES.index(kind)
    reference = tuple(tuple(day(body, (base, number), loads)) for number in (1, 2))
    hidden = tuple(_hidden(one, body, random) for one in chosen)
    return Case(seed, kind, body, reference, tuple(day(body, (base, 3), loads)), hidden)


def _causes(seed: int, kind: str, asked: str | None, random: np.random.Generator) -> list[Cause]:
    """What is hidden; singles and what is outside the catalogue take turns with the seed."""
    if asked is not None:
        return [ALL[asked]]
    if kind == "healthy":
        return []
    if kind == "wear":
        return [CAUSES["wear"]]
    names = sorted(OUTSIDE) if kind == "outside" else sorted(name for name in CAUSES if name != "wear")
    if kind == "pair":
        return [ALL[str(name)] for name in random.choice(names, 2, replace=False)]
    return [ALL[names[(seed // len(_MIX) if kind == "outside" else seed) % len(names)]]]


def _hidden(cause: Cause, arm: Individual, random: np.random.Generator) -> Hidden:
    n = arm.kind.size
    joint = int(random.choice(cause.joints(arm.kind)))
    other = int(random.choice([j for j in range(n) if j != joint]))
    variant = Variant(
        joint=joint,
        other=other,
        sign=float(random.choice([-1.0, 1.0])),
        choice=int(random.integers(2)),
        angle=float(random.uniform(0.0, 2.0 * np.pi)),
        share=float(random.random()),
        peaks=np.zeros(n),
    )
    return Hidden(cause, variant, float(np.exp(random.uniform(*np.log(_RHO)))))


@dataclass(frozen=True)
class Visibility:
    """rho of the base model, of the reference days' model, and the base model's ratios of all rows (2 n,)."""

    rho: float
    rho_reference: float
    ratios: Floats


class Bench:
    """Runs the sessions of a case's day; the healthy ones once."""

    def __init__(self, case: Case) -> None:
        self.case = case
        delay = case.healthy[0].sensing.motor.delay
        self.yardstick = Yardstick(case.arm.kind.urdf, delay, case.arm.has_sensors)

    @cached_property
    def healthy(self) -> list[Truth]:
        """Motions of the healthy twin."""
        return [simulate(s.plant, s.q, s.qd) for s in self.case.healthy]

    def truths(self, setups: Sequence[Setup]) -> list[Truth]:
        """Motions of the sessions; those whose plant is the twin's are the twin's."""
        return [
            self.healthy[k] if s.plant is twin.plant else simulate(s.plant, s.q, s.qd)
            for k, (s, twin) in enumerate(zip(setups, self.case.healthy, strict=True))
        ]

    @cached_property
    def reference(self) -> list[list[Truth]]:
        """Motions of the reference days."""
        return [[simulate(s.plant, s.q, s.qd) for s in day] for day in self.case.reference]

    def _rows(self, setups: Sequence[Setup], truths: Sequence[Truth]) -> list[Rows]:
        return [self.yardstick.rows(record(s, truth)) for s, truth in zip(setups, truths, strict=True)]

    def _known(self, healthy: Sequence[Setup], rows: Sequence[Rows]) -> list[Rows]:
        """With the payloads of the healthy sessions known."""
        loads = [setup.plant.body.payload for setup in healthy]
        return [
            self.yardstick.known(one, ten(load.mass, load.centre, load.gyration))
            for one, load in zip(rows, loads, strict=True)
        ]

    @cached_property
    def _twin(self) -> tuple[Floats, Floats, Floats]:
        """Held-out errors of the twin's base model; model of the reference days, and its errors on the twin."""
        rows = self._rows(self.case.healthy, self.healthy)
        own = self.yardstick.errors(self.yardstick.model(rows[:2]), rows[2:])
        earlier = [
            one
            for setups, truths in zip(self.case.reference, self.reference, strict=True)
            for one in self._known(setups, self._rows(setups, truths))
        ]
        model = self.yardstick.model(earlier)
        return own, model, self.yardstick.errors(model, self._known(self.case.healthy, rows))

    def visible(self, setups: Sequence[Setup]) -> Visibility:
        """How visible the faults in these sessions are."""
        own, model, before = self._twin
        rows = self._rows(setups, self.truths(setups))
        error = self.yardstick.errors(self.yardstick.model(rows[:2]), rows[2:])
        after = self.yardstick.errors(model, self._known(self.case.healthy, rows))
        return Visibility(inflation(error, own), inflation(after, before), _ratios(error, own))

    def peaks(self) -> Floats:
        """Largest healthy joint torques [Nm], (n,)."""
        return np.asarray(np.max([np.abs(truth.joint).max(axis=0) for truth in self.healthy], axis=0))


def _ratios(error: Floats, healthy: Floats) -> Floats:
    """Of errors (2 n,); 1 where a row is not measured."""
    return np.asarray(np.divide(error, healthy, out=np.ones_like(error), where=healthy > 0.0))


def record(setup: Setup, truth: Truth) -> Record:
    """The channels of a session as they are logged, without lost samples' gaps."""
    times, q, joint, late, motor = logged(setup, truth)[1:]
    return Record(times, q, joint, late, motor, setup.label.payload != "none")


def changed(case: Case, hidden: Sequence[Hidden]) -> tuple[tuple[Setup, ...], list[dict[str, Parameter]]]:
    """The sessions of the day with these faults, and the parameters of each."""
    setups, parameters = list(case.healthy), []
    for one in hidden:
        stated: dict[str, Parameter] = {}
        for index, setup in enumerate(setups):
            setups[index], found = one.cause.change(setup, one.variant, one.strength)
            stated |= found
        parameters.append(stated)
    return tuple(setups), parameters


def sized(case: Case, bench: Bench, random: np.random.Generator) -> Case:
    """The case with strengths that reach their rho; wear has a drawn strength."""
    out = []
    for one in case.hidden:
        one = replace(one, variant=replace(one.variant, peaks=bench.peaks()))
        low, high = one.cause.strengths
        seen: dict[float, Visibility] = {}

        def rho(p: float, one: Hidden = one, seen: dict[float, Visibility] = seen) -> float:
            seen[p] = bench.visible(changed(case, [replace(one, strength=p)])[0])
            return max(seen[p].rho, seen[p].rho_reference) if one.cause.absorbed else seen[p].rho

        if one.cause.name == "wear":
            strength = float(random.uniform(low, high))
            rho(strength)
        else:
            strength, _ = found_strength(rho, one.target, low, high)
        at = seen[strength]
        out.append(replace(one, strength=strength, rho=at.rho, rho_reference=at.rho_reference))
    return replace(case, hidden=tuple(out))


def make(case: Case, folder: Path) -> dict[str, Any]:
    """Write the sessions and `truth.json`; returns the truth. What is there already is kept.

    The healthy twin's sessions go to `twin`: the same day without the fault.
    """
    path = folder / "truth.json"
    if path.is_file():
        return dict(json.loads(path.read_text(encoding="utf-8")))
    bench = Bench(case)
    for number, (setups, truths) in enumerate(zip(case.reference, bench.reference, strict=True), 1):
        for index, (setup, truth) in enumerate(zip(setups, truths, strict=True), 1):
            write(folder / f"reference_day_{number}" / f"session_{index}.mcap", setup, truth)
    case = sized(case, bench, np.random.default_rng([case.seed, 7]))
    setups, parameters = changed(case, case.hidden)
    for setup, truth in zip(setups, bench.truths(setups), strict=True):
        write(folder / f"{setup.role}.mcap", setup, truth)
    if case.hidden:
        for setup, truth in zip(case.healthy, bench.healthy, strict=True):
            write(folder / "twin" / f"{setup.role}.mcap", setup, truth)
    content = _truth(case, parameters, bench.visible(setups) if case.hidden else None)
    path.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
    return content


def _truth(
    case: Case,
    parameters: Sequence[dict[str, Parameter]],
    seen: Visibility | None,
) -> dict[str, Any]:
    n = case.arm.kind.size
    ratios = None if seen is None else seen.ratios
    affected = [] if ratios is None else sorted({int(j) % n + 1 for j in np.flatnonzero(ratios > _AFFECTED)})
    return {
        "kind": case.kind,
        "seed": case.seed,
        "arm": case.arm.kind.name,
        "encoder": case.arm.encoder,
        "resolution": case.arm.resolution,
        "rate": case.arm.rate,
        "motor_rate": case.arm.rate / case.arm.motor_divider,
        "gear_ratio": [float(ratio) for ratio in case.arm.kind.gear],
        "sensors": case.arm.has_sensors,
        "traits": case.arm.traits(),
        "hidden": [
            {
                "cause": one.cause.name,
                "side": one.cause.side,
                "joints": list(one.joints()),
                "listed": one.cause.listed,
                "absorbed": one.cause.absorbed,
                "also": list(one.cause.also),
                "strength": one.strength,
                "target": one.target,
                "rho": one.rho,
                "rho_reference": one.rho_reference,
                "parameters": {
                    name: {"value": value, "unit": unit} for name, (value, unit) in stated.items()
                },
            }
            for one, stated in zip(case.hidden, parameters, strict=True)
        ],
        "rho": 1.0 if seen is None else seen.rho,
        "rho_reference": 1.0 if seen is None else seen.rho_reference,
        "affected": affected,
        "ratios": None if ratios is None else [float(x) for x in ratios],
        "sessions": [
            {
                "role": s.role,
                "payload": s.label.payload,
                "mass": s.label.mass,
                "seconds": s.seconds,
            }
            for s in case.healthy
        ],
    }
