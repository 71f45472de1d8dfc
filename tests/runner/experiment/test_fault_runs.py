"""Seeded faults in every phase of a session: a defined end, a complete log, no command outside limits.

What arrived at the emulator is judged there, as float32, by its command monitor.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fri.errors import NetworkError, RobotError
from lwr_driver.arm import Arm
from lwr_driver.driver import Driver, LinkSettings
from lwr_driver.motion import Motion, move_to
from lwr_driver.session import read_session, session_metadata
from runner.laboratory import free_port
from runner.planning import dwell
from sim_backend.process import EmulatorProcess

PERIOD_MS = 5
HOP = np.array([0.3, -0.2, 0.3, 0.4, -0.5, 0.2, 0.6])
PHASES = ("move_to_start", "settle", "excitation")

# What happens, and which ends are allowed: where the link is only poor, the motion may well succeed.
POOR = {"success", "fail"}
WIRE: dict[str, dict[str, Any]] = {
    "loss": {"kind": "loss", "probability": 0.2},
    "burst": {"kind": "burst", "probability": 0.05, "length": 6},
    "delay": {"kind": "delay", "probability": 0.2, "length": 3},
    "duplicate": {"kind": "duplicate", "probability": 0.5},
    "reorder": {"kind": "reorder", "probability": 0.3},
    "corrupt": {"kind": "corrupt", "probability": 0.2, "bits": 3},
}
CABINET: dict[str, dict[str, Any]] = {
    "emergency_stop": {},
    "drives": {"on": False},
    "degrade_quality": {"cycles": 50},
    "restart": {"silent_cycles": 60},
}
RUNS = list(itertools.product([*WIRE, *CABINET], PHASES, (1, 2)))


class Lab:
    """An emulator and a driver that one run after the other uses."""

    def __init__(self) -> None:
        self.arm = Arm.load()
        self.emulator = EmulatorProcess(
            lock_step=True, fri_port=free_port("127.0.0.1"), period_ms=PERIOD_MS, hosting=True
        )
        self.emulator.start()
        settings = LinkSettings("127.0.0.1", self.emulator.fri_port, lock_step=True, lock_step_patience_s=3.0)
        self.driver = Driver(self.arm, settings, host=self.emulator.host)
        self.driver.connect()

    def close(self) -> None:
        self.driver.close()
        self.emulator.stop()

    def ready(self) -> None:
        """Back to monitor mode with drives on and nothing wrong, as an operator would bring it there."""
        pendant = self.emulator.pendant
        pendant.clear_faults()
        self.driver.stop()
        self.driver.leave_command()
        pendant.release_emergency_stop()
        pendant.drives(on=True)
        pendant.reset_monitor()
        self.driver.wait_quality(cycles=50)

    def motion(self) -> Motion:
        """Away, rest, and back: three phases of a session."""
        state = self.driver.state()
        here = state.q_command
        there = here + (HOP if here[6] < 0.3 else -HOP)
        away = move_to(self.arm, here, there, state.period_s, speed_scale=0.5)
        back = move_to(self.arm, there, here, state.period_s, speed_scale=0.5, phase="excitation")
        return away.join(dwell(there, 0.5, state.period_s, "settle")).join(back)


@pytest.fixture(scope="module")
def lab() -> Iterator[Lab]:
    lab = Lab()
    yield lab
    lab.close()


@pytest.mark.parametrize(("fault", "phase", "seed"), RUNS)
def test_a_fault_ends_defined_and_inside_the_limits(
    lab: Lab, tmp_path: Path, fault: str, phase: str, seed: int
) -> None:
    lab.ready()
    driver, pendant = lab.driver, lab.emulator.pendant
    path = tmp_path / "run.mcap"
    driver.record(path, session_metadata(robot="LWR4+"))
    driver.enter_command()
    motion = lab.motion()
    starts = {name: row for row, name in motion.phases}
    after = starts[phase] + int(np.random.default_rng([seed, len(fault)]).integers(5, 60))
    if fault in WIRE:
        pendant.schedule("inject", when="moving", after_cycles=after, **WIRE[fault], cycles=80)
    else:
        pendant.schedule(fault, when="moving", after_cycles=after, **CABINET[fault])
    outcome = driver.execute(motion)
    recorded = driver.end_record(outcome.status, outcome.reason)

    if fault in WIRE:
        assert outcome.status in POOR
    else:
        assert outcome.status == "fail"
        assert isinstance(outcome.error, RobotError | NetworkError)
    assert (outcome.status == "success") == (outcome.reason == "")
    monitor = lab.emulator.status()["monitor"]
    assert monitor["commands"] > 0
    assert monitor["violations"] == 0, monitor["first_violation"]
    # No motion by itself after the end: the arm is commanded to stay.
    # A damaged packet must not be the one to compare with.
    pendant.clear_faults()
    driver.monitor(1)
    before = driver.state().q_command.copy()
    driver.monitor(60)
    assert np.abs(driver.state().q_command - before).max() < 0.05
    session = read_session(path)
    assert session.end is not None
    assert session.end["exit_status"] == outcome.status
    assert session.end["reason"] == outcome.reason
    assert len(session.joint) == recorded.samples
    assert int(session.end["missed"]) == session.joint.lost
