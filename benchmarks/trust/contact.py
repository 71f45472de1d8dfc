"""Hands on the arm: pushes and a spring against the emulated arm in motion, and healthy runs without an alarm."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
from numpy.typing import NDArray

from benchmarks.trust.stand import TimedTurnaround, shared_ring
from benchmarks.trust.table import Ledger, Line, stamp
from fri.controller_end import ControllerEnd
from fri.in_process import Network
from fri.states import State
from lwr_driver.arm import Arm
from lwr_driver.contact import ContactSettings, ContactWatch, ExpectedArm
from lwr_driver.control import Control, Job, Mode, Text
from lwr_driver.loop import Loop, LoopSettings
from lwr_driver.motion import Motion
from lwr_driver.ring import Ring
from runner.experiment_file import Experiment, Payload
from runner.planning import Excitations
from runner.preflight import load_data
from sim_backend.cabinet import Cabinet
from sim_backend.configuration import LoadData, load_configuration
from tests.lwr_driver.driver_rig import Clock

__all__ = ["LEAST_NM", "PROMISED", "Bench", "Run", "campaign", "healthy", "push"]

Floats = NDArray[np.float64]

LEAST_NM = (30.0, 30.0, 16.0, 16.0, 16.0, 8.0, 8.0)
"""The smallest push on each joint [Nm]; others are 1.5 and 3 times as large."""

PROMISED = 20
"""Longest time from the beginning of a push to the decision, on every joint, at 1 and 5 ms [ms]."""

_PUSHES, _HEALTHY = 60, 40
_SPRINGS = 14
_SPRING = 2000.0  # of an obstacle [Nm/rad]
_FACTORS = (1.0, 1.5, 3.0)
_STILL_RAD = 1e-9


@dataclass
class Run:
    """What came of a run: times since the beginning of the push [ms], torques [Nm].

    decided, rest : a stop was decided, the set point rested. peak, left : largest external torque of the push or the
    obstacle, and at the end. share : largest joint torque over its limit. bad : what was wrong
    """

    decided: int | None = None
    rest: int | None = None
    peak: float = 0.0
    left: float = 0.0
    share: float = 0.0
    reason: str = ""
    bad: list[str] = field(default_factory=list)


@cache
def _experiment() -> tuple[Experiment, Arm]:
    experiment = Experiment.load()
    return experiment, Arm.load(experiment.arm)


@cache
def motion(period_ms: int, validation: bool = False) -> Motion:
    """One period of the default experiment's exciting motion, or its validation motion."""
    from lwr_driver.arm.cell import Cell

    experiment, arm = _experiment()
    excitations = Excitations.of(experiment, arm, Cell.load(experiment.cell), Path("."))
    session = next(plan for plan in experiment.sessions if plan.validation == validation)
    return excitations.rows(session, period_ms * 1e-3)


class Bench:
    """The loop with its watch, and the emulated cabinet with its arm, in one thread. A context manager.

    ahead : answers leave before they are processed, as with real-time rights
    hand : external torque (7,) [Nm] of each millisecond, from its number and the cabinet; None for none
    forces : the present one
    """

    def __init__(
        self,
        seed: int,
        period_ms: int,
        start: Floats,
        ring: Ring,
        payload: Payload | None,
        *,
        ahead: bool = False,
    ) -> None:
        _, arm = _experiment()
        self.arm, self.period_ms, self.ring = arm, period_ms, ring
        self.hand: Callable[[int, Cabinet], Floats] | None = None
        self.forces = np.zeros(7)
        self.clock = Clock()
        self._patches = contextlib.ExitStack()
        for name in ("monotonic", "monotonic_ns"):
            self._patches.enter_context(patch(f"fri.remote.{name}", getattr(self.clock, name)))
        self._patches.enter_context(patch("lwr_driver.loop.time", self.clock))
        settings = {
            "seed": seed,
            "robot.payload": "none" if payload is None else payload.name,
            "robot.start_position": start.tolist(),
            "fri.period_ms": period_ms,
        }
        self.cabinet = Cabinet(load_configuration("emulator/default.yaml", settings))
        self.control = Control.create(60_000)
        ring.start_writing()
        watch = ContactWatch(ExpectedArm.nominal(arm), ContactSettings(), arm.tau_max)
        self.watch = watch
        if payload is not None:
            self.cabinet.model.set_load(LoadData(payload.mass, payload.com, payload.inertia))
        if seed % 2 == 0:
            # Otherwise its weight is known from the controller's load data.
            mass, com, inertia = load_data(arm, payload)
            watch.carry(mass, np.array(com), np.array(inertia))
        order = LoopSettings("127.0.0.1", 0, None, not ahead, "stanford", 0.1, 0.2, arm.joint_names)
        # Compiled answers need a socket.
        network = None if ahead else Network()
        self.loop = Loop(order, arm.limits, self.control, ring, watch, network)
        self.loop.turnaround = TimedTurnaround(self.loop, self.control, self.clock) if ahead else None
        self.end = ControllerEnd(self.loop.remote.address, network=network)
        self.cabinet.start_program()
        self._millisecond = self.cabinet._millisecond
        self.cabinet._millisecond = self._one_millisecond  # type: ignore[method-assign]

    def __enter__(self) -> Bench:
        return self

    def __exit__(self, *_: object) -> None:
        self.end.close()
        self.loop.remote.close()
        self.ring.release(len(self.ring.take()))
        self.control.close()
        self._patches.close()

    def _one_millisecond(self, setpoint: Floats) -> None:
        if self.hand is not None:
            self.forces = self.hand(self.cabinet.milliseconds, self.cabinet)
            self.cabinet.plant.push(self.forces)
        self._millisecond(setpoint)

    def cycle(self) -> None:
        """One cycle of the controller."""
        cabinet, loop = self.cabinet, self.loop
        self.clock.now_ns += self.period_ms * 1_000_000
        if cabinet.session.state is not State.OFF:
            self.end.send(cabinet.packet())
            loop.cycle(0.0)
            while (answer := self.end.receive(0.0)) is not None:
                cabinet.arrived(answer)
                cabinet.receive(answer, 1e-4)
        cabinet.close()
        if self.ring.free < 64:
            self.ring.release(len(self.ring.take()))

    def until_done(self, most: int) -> bool:
        """Cycles until the request is done; False after `most`."""
        for _ in range(most):
            self.cycle()
            if self.control.done:
                return True
        return False

    def begin(self, q: Floats) -> None:
        """Up to command mode and the first row."""
        self.control.post(Job.START)
        if not self.until_done(20_000):
            raise RuntimeError("no command mode")
        # As float32, it is the value commanded last.
        self.control.put_motion(np.vstack([self.loop.remote.command["jnt_pos"].astype(float), q[1:]]), [])
        self.control.post(Job.MOTION, len(q))
        self.cycle()

    def judge(self, run: Run, until_ms: int, since_ms: int, joint: int) -> None:
        """Cycles up to the end of the motion and until `until_ms`; what happens goes into `run`."""
        cabinet, loop, last = self.cabinet, self.loop, self.cabinet.last_setpoint.copy()
        while cabinet.milliseconds < until_ms and not (run.decided is None and self.control.done):
            now = cabinet.milliseconds
            self.cycle()
            if run.decided is None and loop.mode is Mode.STOP:
                run.decided = now - since_ms
            if np.abs(cabinet.last_setpoint - last).max() > _STILL_RAD:
                run.rest = now - since_ms
            last = cabinet.last_setpoint.copy()
            run.left = abs(float(self.forces[joint]))
            run.peak = max(run.peak, run.left)
            run.share = max(run.share, float((np.abs(cabinet.plant.joint_torque) / self.arm.tau_max).max()))
        run.reason = self.control.text(Text.REASON)
        if cabinet.monitor.violations.sum():
            run.bad.append(f"outside the limits: {cabinet.monitor.first_violation}")


def push(
    joint: int,
    torque: float,
    period_ms: int,
    seed: int,
    ring: Ring,
    *,
    ahead: bool = False,
    spring: bool = False,
) -> Run:
    """A push on a joint from 0 at a random moment of the loaded motion, for 50 ms to 1 s; or a spring in its way.

    torque : [Nm], the sign is of no meaning with a spring
    """
    experiment, _ = _experiment()
    random = np.random.default_rng([seed, joint, period_ms])
    q = motion(period_ms).q
    with Bench(seed, period_ms, q[0], ring, experiment.heaviest, ahead=ahead) as bench:
        bench.begin(q)
        begun = bench.cabinet.milliseconds
        since = begun + int(random.integers(1000, 18_000))
        if spring:
            # Where the joint moves: an obstacle that it runs into.
            speed = np.abs(np.gradient(q[:, joint]))
            fast = np.flatnonzero(speed[: 18_000 // period_ms] > 0.5 * speed.max()) * period_ms
            since = begun + int(random.choice(fast[fast > 1000]))
        length = int(random.integers(50, 1000))
        there: list[tuple[float, float]] = []

        def hand(millisecond: int, cabinet: Cabinet) -> Floats:
            forces = np.zeros(7)
            if millisecond < since:
                return forces
            if spring:
                plant = cabinet.plant
                there[:] = there or [(float(plant.position[joint]), float(np.sign(plant.velocity[joint])))]
                place, way = there[0]
                forces[joint] = -way * _SPRING * max(0.0, way * (float(plant.position[joint]) - place))
            elif millisecond < since + length:
                forces[joint] = torque
            return forces

        bench.hand = hand
        while bench.cabinet.milliseconds + period_ms <= since - 1:
            bench.cycle()
        run = Run()
        if bench.loop.mode is not Mode.MOTION:
            run.bad.append(f"stopped before the push: {bench.control.text(Text.REASON)}")
            return run
        bench.judge(run, since + 3000, since, joint)
        if run.decided is None:
            run.bad.append(f"missed: {run.reason}")
        elif not spring and run.decided > PROMISED:
            run.bad.append(f"decided after {run.decided} ms")
        if "contact: " not in run.reason:
            run.bad.append(f"reason: {run.reason!r}")
        if run.decided is not None and not bench.control.done:
            run.bad.append("no end within 3 s")
        bench.control.post(Job.MOTION, len(q))
        bench.until_done(5)
        if "before `enter_command`" not in bench.control.text(Text.REASON):
            run.bad.append("another motion was not refused")
        return run


def healthy(period_ms: int, seed: int, ring: Ring, *, loaded: bool = True) -> Run:
    """The default experiment's motions without any push; external torque as the share of its limit in `peak`."""
    experiment, _ = _experiment()
    run = Run()
    for validation in (False, True):
        q = motion(period_ms, validation).q
        payload = experiment.heaviest if loaded else None
        with Bench(seed, period_ms, q[0], ring, payload) as bench:
            bench.begin(q)
            while not bench.control.done:
                bench.cycle()
                run.peak = max(run.peak, float((np.abs(bench.watch.external) / bench.watch.allowed).max()))
                torque = np.abs(bench.cabinet.plant.joint_torque) / bench.arm.tau_max
                run.share = max(run.share, float(torque.max()))
            reason = bench.control.text(Text.REASON)
            if reason:
                run.bad.append(f"{'validation' if validation else 'exciting'} motion: {reason}")
    return run


def _most(found: list[Run], name: str) -> Any:
    values = [getattr(run, name) for run in found if getattr(run, name) is not None]
    return max(values, default=None)


def _figures(line: Line, found: dict[int, list[Run]]) -> None:
    line.figures = {}
    for period_ms, runs in sorted(found.items()):
        line.figures[f"at {period_ms} ms, decided after [ms]"] = _most(runs, "decided")
        line.figures[f"at rest after [ms] ({period_ms} ms)"] = _most(runs, "rest")
    every = [run for runs in found.values() for run in runs]
    line.figures["largest torque of the contact [Nm]"] = round(_most(every, "peak"), 1)
    line.figures["largest joint torque over its limit"] = round(_most(every, "share"), 2)
    line.figures |= stamp()


def _pieces(options: Any) -> Iterator[tuple[str, list[tuple[Any, ...]]]]:
    """Lines and their runs: joint, size, period, answered ahead, spring."""
    _, arm = _experiment()
    pushes = options.runs or _PUSHES
    plan = [
        (k % 7, _FACTORS[k // 14 % 3] * (-1) ** (k // 7), (1, 5)[k // 7 % 2], k % 2 == 1, False, k)
        for k in range(pushes)
    ]
    for joint, name in enumerate(arm.joint_names):
        yield f"pushes on {name}, {LEAST_NM[joint]:g} Nm and more", [one for one in plan if one[0] == joint]
    springs = min(options.runs or _SPRINGS, _SPRINGS)
    yield (
        "obstacle, a spring of 2000 Nm/rad",
        [(k % 7, 0.0, (1, 5)[k // 7 % 2], k % 2 == 1, True, 1000 + k) for k in range(springs)],
    )


def campaign(ledger: Ledger, options: Any) -> None:
    """Lines of the pushes by joint, of an obstacle, and of healthy runs."""
    stamp()
    with shared_ring() as ring:
        for what, plan in _pieces(options):
            if not plan or ledger.has("contact", what):
                continue
            line, found = ledger.line("contact", what), dict[int, list[Run]]()
            for joint, factor, period_ms, ahead, spring, number in plan:
                seed = options.seed * 10_000 + number
                run = push(joint, factor * LEAST_NM[joint], period_ms, seed, ring, ahead=ahead, spring=spring)
                line.count(run.bad, f"seed {seed}")
                found.setdefault(period_ms, []).append(run)
            _figures(line, found)
            if plan[0][4]:
                every = [run for runs in found.values() for run in runs]
                line.figures["torque of the contact at the end [Nm]"] = round(_most(every, "left"), 1)
            ledger.finish("contact", what)
            options.say(str(line))
        runs = options.runs or _HEALTHY
        slow = 3 * runs // 4
        for period_ms, count in ((1, runs - slow), (5, slow)):
            what = f"healthy, loaded, {period_ms} ms"
            if ledger.has("contact", what):
                continue
            for number in range(count):
                piece = f"{what}, {number}"
                if ledger.has("contact", piece):
                    continue
                seed = options.seed * 10_000 + 2000 + number
                run, line = healthy(period_ms, seed, ring), ledger.line("contact", what)
                line.count(run.bad, f"seed {seed}")
                for name, value in (("external", run.peak), ("joint", run.share)):
                    figure = f"{name} torque over its limit, at most"
                    line.figures[figure] = max(round(value, 2), line.figures.get(figure, 0.0))
                line.figures |= stamp()
                ledger.finish("contact", piece)
            ledger.finish("contact", what)
            options.say(str(ledger.line("contact", what)))
