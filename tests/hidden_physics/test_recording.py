"""From a case to its logs: the short way and the long way, and nothing of the truth in them."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from lwr_driver.session import read_session
from tests.hidden_physics.motions import exciting_motion
from tests.hidden_physics.recording import Order, begin_s, record, record_by_processes
from tests.hidden_physics.robots import Day, Setting, session_settings

WITH_MUCH = Setting(
    traits={"stribeck": {2: 0.2}, "cable": {6: 0.3}, "stiffness": {4: 0.5}},
    faults={"play": {3: 0.3}, "motor_late": dict.fromkeys(range(1, 8), 3e-3)},
    leak={2: {4: 0.02}},
    tilt=(0.01, -0.004),
    contacts=({"start_s": 2.0, "length_s": 0.5, "link": 6, "force": [10.0, 0.0, 5.0]},),
    load={"mass": -0.2, "from_s": 4.0},
)


@pytest.fixture(scope="module")
def order(tmp_path_factory: pytest.TempPathFactory) -> Order:
    return Order(
        motion=exciting_motion("A2", periods=1),
        path=tmp_path_factory.mktemp("hidden") / "short.mcap",
        settings=session_settings(Day(3), WITH_MUCH),
        uid="7",
        seed=11,
    )


@pytest.fixture(scope="module")
def log(order: Order) -> Path:
    return record(order)


@pytest.mark.slow
def test_processes_over_udp_give_the_same_file(order: Order, log: Path) -> None:
    other = dataclasses.replace(order, path=log.with_name("processes.mcap"))
    record_by_processes(other)
    assert other.path.read_bytes() == log.read_bytes()


def test_the_log_is_whole_and_the_arm_followed(log: Path, order: Order) -> None:
    session = read_session(log)
    assert not session.missing
    assert session.motor is not None
    assert session.command is not None
    assert [phase.name for phase in session.phases] == ["settle", "period 1", "brake"]
    np.testing.assert_allclose(session.command.position, order.motion.q[: len(session.command)], atol=1e-6)
    assert np.abs(session.joint.position - session.command.position).max() < 0.05


def test_the_motion_begins_when_the_cases_say(order: Order) -> None:
    assert begin_s(order) == begin_s(dataclasses.replace(order, settings={}, payload="none"))


def test_nothing_in_a_log_tells_what_is_hidden(log: Path) -> None:
    session = read_session(log)
    texts = [*session.metadata.values(), *(session.end or {}).values(), *session.attachments]
    content = b"".join(session.attachments.values()) + " ".join(texts).encode()
    for word in (b"hidden", b"stribeck", b"traits", b"faults", b"motor_late", b"contacts"):
        assert word not in content
