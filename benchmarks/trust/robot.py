"""Faults of the robot and of the people around it, on the emulated arm with its physics."""

from __future__ import annotations

import re
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.trust.gathered import gather
from benchmarks.trust.lab import HOME, Lab
from benchmarks.trust.table import Ledger
from fri.errors import LwrError, RefusedError
from lwr_driver.motion import move_to
from lwr_driver.session import read_session, session_metadata

__all__ = ["campaign"]

_RUNS = 20

# Command of the pendant, its arguments, and what the reason must say; None where the motion goes on.
_FAULTS: dict[str, tuple[str, dict[str, Any], str | None]] = {
    "emergency stop": ("emergency_stop", {}, "drives are off|left command mode"),
    "drives off, brakes closed": ("drives", {"on": False}, "drives are off|left command mode"),
    "mode changed to T1": ("mode", {"name": "T1"}, "left command mode|drives are off"),
    "quality drops": ("degrade_quality", {"cycles": 60}, "quality UNACCEPTABLE"),
    "drive error": ("drive_fault", {"joint": 3}, "drives"),
    "drive warning (temperature)": ("drive_fault", {"joint": 3, "error": False}, None),
    "program cancelled": ("stop_program", {}, "no packet|in lock step"),
    "arm held by force": (
        "push",
        {"torque": [0.0, 600.0, 0.0, 0.0, 0.0, 0.0, 0.0]},
        "contact: A2 .* Nm exceeds",
    ),
    "controller restarts": ("restart", {"silent_cycles": 60}, "started again|left command|drives|lost"),
}
_LINES = {
    "wrong payload, by lwr-run": [
        "runner/experiment/test_experiment.py::test_a_payload_that_is_not_there_is_noticed_before_anything_moves"
    ],
    "payload lost in motion, by lwr-run": [
        "runner/experiment/test_payload_and_torque.py::test_payload_that_is_lost_in_motion_fails_the_session"
    ],
}


def _strike(lab: Lab, what: str, random: np.random.Generator, folder: Path) -> list[str]:
    command, arguments, named = _FAULTS[what]
    path = folder / "robot.mcap"
    path.unlink(missing_ok=True)
    driver, pendant = lab.driver, lab.emulator.pendant
    driver.record(path, session_metadata(robot="LWR4+"))
    driver.enter_command()
    motion = lab.motion()
    after = int(random.integers(1, len(motion) - 60))
    pendant.schedule(command, after_cycles=after, **arguments)
    outcome = driver.execute(motion)
    recorded = driver.end_record(outcome.status, outcome.reason)
    bad = lab.violations()
    if named is None:
        if outcome.status != "success":
            bad.append(f"a warning ended the motion: {outcome.reason}")
    elif outcome.status != "fail" or not re.search(named, outcome.reason):
        bad.append(f"{outcome.status}: {outcome.reason!r} does not name the cause")
    if outcome.status == "fail" and "lock step" not in outcome.reason:
        before = driver.state().q_command
        driver.monitor(60)
        if np.abs(driver.state().q_command - before).max() > 0.05:
            bad.append("the arm was commanded to move after the end")
    session = read_session(path)
    if session.end is None or session.end["exit_status"] != outcome.status:
        bad.append(f"log ends with {session.end}")
    if (
        len(session.joint) != recorded.samples
        or int((session.end or {}).get("missed", -1)) != session.joint.lost
    ):
        bad.append(f"log: {len(session.joint)} samples, {recorded}")
    if what == "arm held by force":
        lab.renew()
    return bad


def _moved_by_hand(lab: Lab, random: np.random.Generator) -> list[str]:
    """Somebody moves the arm between motions: an old motion is refused, a new one begins where it is."""
    driver, pendant = lab.driver, lab.emulator.pendant
    driver.enter_command()
    old = lab.motion()
    driver.leave_command()
    pendant.drives(on=False)
    pendant.displace(random.uniform(-0.2, 0.2, 7).tolist())
    driver.monitor(50)
    pendant.drives(on=True)
    driver.wait_quality(cycles=50)
    driver.enter_command()
    bad = []
    try:
        driver.execute(old)
        bad.append("the old motion was executed from elsewhere")
    except RefusedError as error:
        if "begin" not in str(error) and "start" not in str(error):
            bad.append(f"refused without the reason: {error}")
    outcome = driver.execute(lab.motion())
    if outcome.status != "success":
        bad.append(f"the new motion: {outcome.reason}")
    return bad + lab.violations()


def _rejected(lab: Lab, random: np.random.Generator) -> list[str]:
    """The controller rejects commands: in T1 its speed limit is a quarter, which no packet tells."""
    driver, pendant = lab.driver, lab.emulator.pendant
    pendant.mode("T1")
    driver.monitor(50)
    pendant.drives(on=True)
    driver.wait_quality(cycles=50)
    driver.enter_command()
    state = driver.state()
    goal = state.q_command + np.where(state.q_command < HOME, 1.0, -1.0) * random.uniform(0.5, 0.9)
    goal = np.clip(goal, lab.arm.limits.q_low + 0.1, lab.arm.limits.q_high - 0.1)
    outcome = driver.execute(move_to(lab.arm, state.q_command, goal, state.period_s, speed_scale=0.8))
    bad = lab.violations()
    if outcome.status != "fail" or "left command mode" not in outcome.reason:
        bad.append(f"{outcome.status}: {outcome.reason!r}")
    kinds = [event["kind"] for event in lab.emulator.status()["events"]]
    if "VELOCITY" not in kinds:
        bad.append(f"the controller did not reject: {kinds}")
    return bad


def _unexpected_start(random: np.random.Generator) -> list[str]:
    """The arm stands anywhere as the connection begins, even near a limit; a way home is found."""
    with Lab(settings={"robot.start_position": random.uniform(-1.6, 1.6, 7).tolist()}) as lab:
        driver = lab.driver
        driver.wait_quality(cycles=50)
        driver.enter_command()
        state = driver.state()
        try:
            home = move_to(lab.arm, state.q_command, HOME, 0.005)
            outcome = driver.execute(home)
        except LwrError as error:
            return [f"no way home: {error}"]
        bad = lab.violations()
        return bad if outcome.status == "success" else [*bad, outcome.reason]


def campaign(ledger: Ledger, options: Any) -> None:
    """A line for each fault; what only a whole experiment shows is gathered from its tests."""
    runs = options.runs or _RUNS
    with tempfile.TemporaryDirectory() as name, Lab() as lab:

        def work(what: str, one: Any, count: int) -> None:
            line = ledger.line("robot", what)
            for number in range(count):
                if ledger.has("robot", f"{what} {number}"):
                    continue
                lab.ready()
                try:
                    bad = one(np.random.default_rng([options.seed, number, len(what)]))
                except LwrError as error:
                    bad = [f"{type(error).__name__}: {error}"]
                    lab.renew()
                line.count(bad, f"run {number}")
                ledger.finish("robot", f"{what} {number}")

        for what in _FAULTS:
            work(what, lambda random, w=what: _strike(lab, w, random, Path(name)), runs)
        work("arm moved by a person", lambda random: _moved_by_hand(lab, random), runs)
        work("command rejected", lambda random: _rejected(lab, random), runs)
        work("unexpected start position", _unexpected_start, max(1, runs // 4))
    gather(ledger, "robot", _LINES)
