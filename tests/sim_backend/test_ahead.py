"""Many cycles at once are the single cycles: the same rows and the same state of both ends, to the last bit."""

from __future__ import annotations

import contextlib
import socket
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from fri.states import State
from lwr_driver.contact import ContactSettings, ContactWatch, ExpectedArm
from lwr_driver.control import Control, Job, Mode, Result, Text, Word
from lwr_driver.loop import Loop, LoopSettings
from lwr_driver.motion import move_to
from lwr_driver.ring import ROW, Ring
from sim_backend import service as service_module
from sim_backend.configuration import load_configuration
from sim_backend.service import Service
from tests.lwr_driver.driver_rig import arm

AWAY = np.array([0.2, -0.1, 0.15, 0.2, -0.3, 0.1, 0.3])
OWN = "lwr_identification"
KRL = Path(__file__).parents[2] / "configs/krl/lwr_identification.src"
# Known by the wall clock only.
_BY_THE_CLOCK = (Word.HEARD_NS,)

Event = Callable[["Pair"], None]


class Pair:
    """Emulator and loop in one thread; `many` is the largest number of cycles at once, 0 for single ones."""

    def __init__(
        self, monkeypatch: pytest.MonkeyPatch, many: int, settings: dict[str, Any], friction: float
    ) -> None:
        self._monkeypatch, self._many = monkeypatch, many
        config = load_configuration("emulator/default.yaml", settings)
        program = Path(settings["fri.program"]).stem
        mine, self._theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self.ring, self.control = Ring.create(1024), Control.create(20_000)
        self.service = Service(config, ("127.0.0.1", 49938), seat=mine.detach())
        self.cabinet, self.operator = self.service.cabinet, self.service.operator
        expected = ExpectedArm.nominal(arm())
        if friction:
            seven = (friction,) * 7
            expected = ExpectedArm(expected.dynamics, seven, seven, (0.0,) * 7, expected.uncertainty)
        watch = ContactWatch(expected, ContactSettings(), arm().tau_max)
        loop_settings = LoopSettings(
            "127.0.0.1",
            49938,
            None,
            True,
            "stanford" if program == "stanford" else OWN,
            0.1,
            0.1,
            arm().joint_names,
        )
        seat = self.service._seat
        assert seat is not None
        self.loop = Loop(loop_settings, arm().limits, self.control, self.ring, watch, self.service._network)
        seat._loop, seat._control, seat._ring = self.loop, self.control, self.ring
        self.loop.begin()
        self.service._stepping = True
        self.rows: list[NDArray[Any]] = []
        self.blocks = 0

    def close(self) -> None:
        self.service.close()
        self._theirs.close()

    def until(
        self, done: Callable[[], bool], most: int = 20_000, event: tuple[int, Event] | None = None
    ) -> None:
        """Let cycles pass until `done`; the event strikes before the cycle of its number."""
        first = self.cabinet.cycle
        while not done():
            passed = self.cabinet.cycle - first
            assert passed < most
            many = self._many
            if event is not None:
                if passed == event[0]:
                    event[1](self)
                many = min(many, event[0] - passed) if passed < event[0] else many
            self._monkeypatch.setattr(service_module, "_MANY", many)
            self.service._lock_step()
            self.blocks += self.cabinet.cycle - first - passed > 1
            self.rows.append(self.ring.take())
            self.ring.release(len(self.rows[-1]))

    def job(self, job: Job, a: int = 0, b: int = 0, event: tuple[int, Event] | None = None) -> Result:
        self.control.post(job, a, b)
        self.until(lambda: self.control.done, event=event)
        return self.control.result

    def move(self, way: NDArray[np.float64], event: tuple[int, Event] | None = None) -> Result:
        period_s = self.cabinet.session.sample_time_s
        start = self.loop.remote.command["jnt_pos"].astype(np.float64)
        motion = move_to(arm(), start, start + way, period_s, speed_scale=0.4)
        third = len(motion) // 3
        self.control.put_motion(motion.q, [(0, 2), (third, 3), (third + 1, 4)])
        return self.job(Job.MOTION, len(motion), int(self.control.words[Word.STOP]), event)

    def state(self) -> dict[str, Any]:
        """All that later cycles, the log, or the pendant depend on."""
        cabinet, session, loop, plant = self.cabinet, self.cabinet.session, self.loop, self.cabinet.plant
        model, commander, watch = cabinet.model, self.loop._commander, self.loop._watch
        guard, track, monitor, remote = commander._guard, session._track, cabinet.monitor, self.loop.remote
        controller, sensors, reals = cabinet.controller, cabinet.sensors, cabinet.krl_reals
        assert watch is not None
        words = [int(word) for place, word in enumerate(self.control.words) if place not in _BY_THE_CLOCK]
        arrays = {
            "plant": [
                plant.state,
                plant.modes,
                plant.last_velocity,
                plant.joint_torque,
                plant.motor_torque,
                plant.energy,
            ],
            "controller": [
                controller.memory,
                controller.torque,
                cabinet.sensors.rows,
                cabinet.sensors._row,
            ],
            "model": [model.gravity, model.mass_matrix, model.jacobian, model.memory, model.external_torque],
            "sample": [getattr(cabinet.sample, name) for name in cabinet.sample.__slots__],
            "cabinet": [cabinet.last_setpoint, cabinet.currents],
            "monitor": [
                monitor._values,
                monitor._times,
                monitor.ratio,
                monitor.worst,
            ],
            "track": [
                track.target,
                track._previous,
                track._step,
                track._accepted,
            ],
            "wire": [
                session.command,
                session.from_real,
                session.to_real,
                session.to_int,
                remote.msr,
                remote.command,
            ],
            "guard": [guard._q, guard._v, guard._a, guard._bounds],
            "commander": [
                loop._commander.target,
                loop._commander._past,
                loop._commander.external,
                loop._commander.allowed,
            ],
            "watch": [watch._last, watch._step, watch._state, watch._open],
            "control": [self.control.tracking, self.control.last_rows(64), self.control.measured],
            "past": [setpoint for setpoint, _ in loop._setpoints.past],
        }
        status = self.operator.status()
        return {
            **{name: [np.asarray(one).tobytes() for one in many] for name, many in arrays.items()},
            "status": str(status),
            "words": words,
            "texts": [self.control.text(place) for place in Text],
            "counters": [loop.remote.counters(), session.counters(), int(self.control.latency.sum())],
            "places": [
                cabinet.cycle, cabinet.milliseconds, cabinet.model_age, cabinet._idle_cycles, cabinet._sequence,
                plant.cycles, plant.descents, sensors._next, reals._count, reals._elapsed,
                session._dwell, session._reflected, session._uptime_ms, session._statistics._slot, session.miss_counter,
                loop._sequence, loop._count, loop._job_cycles, loop.remote.timestamp_s, loop._stamps._stamp,
                loop._stamps._credible, loop.remote._tracker._timestamp, loop.mode, self.service._last_head,
            ],
        }  # fmt: skip


@dataclass
class Case:
    """A run; `event` strikes in the second motion. least : of blocks of several cycles"""

    event: Event | None = None
    settings: dict[str, Any] = field(default_factory=dict)
    ends: Result = Result.DONE
    least: int = 3
    friction: float = 0.0
    krl: str = ""


def _drive(pair: Pair, case: Case) -> Result:
    pair.until(lambda: pair.cabinet.session.state is State.MON)
    assert pair.job(Job.QUALITY, 50, 2) is Result.DONE
    assert pair.job(Job.START) is Result.DONE
    assert pair.move(AWAY) is Result.DONE
    assert pair.job(Job.CYCLES, 7) is Result.DONE
    result = pair.move(-AWAY, event=None if case.event is None else (211, case.event))
    pair.job(Job.CYCLES, 50)
    return result


def _abort(pair: Pair) -> None:
    pair.control.words[Word.STOP] += 1


def _spoil(distance: float, pair: Pair) -> None:
    pair.control.plan[pair.loop._commander.index + 150, 3] += distance


def _offset(pair: Pair) -> None:
    pair.cabinet.sensors.settings[4, 2] += 20.0


def _lose(direction: str, pair: Pair) -> None:
    pair.operator.inject(kind="loss", direction=direction, probability=0.1, cycles=90)


CASES = {
    "plain": Case(least=6),
    "two milliseconds": Case(settings={"fri.period_ms": 2}),
    "five milliseconds": Case(settings={"fri.period_ms": 5}, least=1),
    "published program": Case(settings={"fri.program": "stanford"}),
    "program without pauses": Case(settings={"krl.statement_ms": 0.0}),
    "motor-side sensors": Case(settings={"sensors.position_sensor": "motor"}),
    "friction in the watch": Case(friction=2.0),
    "abort": Case(_abort, ends=Result.ABORTED),
    "guard": Case(partial(_spoil, 0.01), ends=Result.GUARD),
    # Too small for the controller to object.
    "guard alone": Case(partial(_spoil, 2e-4), ends=Result.GUARD),
    "contact": Case(_offset, ends=Result.ROBOT),
    "push": Case(lambda pair: pair.operator.push([0.0, 40.0, 0.0, 0.0, 0.0, 0.0, 0.0]), ends=Result.ROBOT),
    "brakes": Case(lambda pair: pair.cabinet.plant.brake(True), ends=Result.ROBOT),
    "drive fault": Case(lambda pair: pair.operator.drive_fault(3), ends=Result.ROBOT),
    "emergency stop": Case(lambda pair: pair.operator.emergency_stop(), ends=Result.ROBOT),
    "bad link": Case(lambda pair: pair.operator.degrade_quality(60), ends=Result.NETWORK),
    "lost packets": Case(partial(_lose, "to_pc")),
    "lost answers": Case(partial(_lose, "to_krc")),
    "another payload": Case(lambda pair: pair.operator.mount("paper_load"), ends=Result.ROBOT),
    "scheduled": Case(
        lambda pair: pair.operator.schedule({"command": "drive_fault", "after_cycles": 60, "arguments": {"joint": 1}}),
        ends=Result.ROBOT,
    ),
    "load data by the program": Case(krl="$LOAD.M=1.5", ends=Result.DONE),
    "stop by the program": Case(krl="LWR_STATE=friStop()", ends=Result.ROBOT),
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_many_cycles_at_once_are_the_single_cycles(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    case = CASES[name]
    settings: dict[str, Any] = {"fri.program": OWN, "controller.settle_s": 0.05, **case.settings}
    if case.krl:
        settings["fri.program"] = str(_changed_program(tmp_path, case.krl))
    found = []
    for many in (0, 200):
        pair = Pair(monkeypatch, many, settings, case.friction)
        try:
            result = _drive(pair, case)
            assert result is case.ends, pair.control.text(Text.REASON)
            assert pair.blocks >= case.least if many else pair.blocks == 0
            found.append((np.concatenate(pair.rows, dtype=ROW), pair.state()))
        finally:
            pair.close()
    (rows, state), (many_rows, many_state) = found
    assert len(many_rows) == len(rows)
    different = np.flatnonzero(rows != many_rows)
    assert not len(different), f"row {different[0]} of {len(rows)}"
    assert rows.tobytes() == many_rows.tobytes()
    for part, values in state.items():
        assert many_state[part] == values, part


def _changed_program(folder: Path, statement: str) -> Path:
    """The laboratory's program, with one statement more after some passes in command mode."""
    asked = "        IF ($FRI_FRM_INT[16]==11) OR ($FRI_FRM_INT[16]==33) THEN\n"
    place = f"{asked}          LWR_STATE=friStop()\n          PTP"
    text = KRL.read_text()
    assert text.count(place) == 1
    more = f"        IF LWR_PASSES==77 THEN\n          {statement}\n        ENDIF\n"
    (folder / KRL.name).write_text(text.replace(place, more + place))
    (folder / KRL.with_suffix(".dat").name).write_text(KRL.with_suffix(".dat").read_text())
    return folder / KRL.name


@contextlib.contextmanager
def commanding(monkeypatch: pytest.MonkeyPatch) -> Iterator[Pair]:
    """A pair in command mode."""
    pair = Pair(monkeypatch, 200, {"fri.program": OWN, "controller.settle_s": 0.05}, 0.0)
    try:
        pair.until(lambda: pair.cabinet.session.state is State.MON)
        assert pair.job(Job.START) is Result.DONE
        yield pair
    finally:
        pair.close()


def test_nothing_is_offered_without_a_motion(monkeypatch: pytest.MonkeyPatch) -> None:
    with commanding(monkeypatch) as pair:
        assert pair.job(Job.CYCLES, 300) is Result.DONE
        assert pair.blocks == 0
        assert pair.loop.mode is Mode.HOLD
        assert not len(pair.loop.offer(10))


def test_a_packet_sent_twice_during_a_pause_is_no_restart(monkeypatch: pytest.MonkeyPatch) -> None:
    with commanding(monkeypatch) as pair:
        assert pair.job(Job.CYCLES, 10) is Result.DONE
        # As after a reminder of a loop that waits for its driver.
        send, sent = pair.service.end.send, list[bytes]()

        def thrice(datagram: bytes) -> None:
            for _ in range(1 if sent else 3):
                send(datagram)
            sent.append(datagram)

        monkeypatch.setattr(pair.service.end, "send", thrice)
        assert pair.move(AWAY) is Result.DONE
        assert pair.blocks > 0
        # A copy left over would be taken late, by the next cycle that goes by itself.
        assert pair.job(Job.CYCLES, 10) is Result.DONE
        remote = pair.loop.remote
        assert (remote.repeated, remote.reordered, remote.restarts, remote.lost) == (2, 0, 0, 0)
