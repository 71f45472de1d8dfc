"""Joint impedance and gravity compensation of the emulated arm, and Cartesian impedance refused."""

from __future__ import annotations

import numpy as np
import pytest

from fri.krc import EventKind
from fri.states import Control, State
from tests.sim_backend.cabinet_client import Client


def torque(joint: int, value: float) -> np.ndarray:
    found = np.zeros(7)
    found[joint] = value
    return found


@pytest.mark.parametrize(("joint", "push"), [(0, 40.0), (3, 25.0), (5, 15.0)])
def test_a_commanded_spring_yields_by_torque_over_stiffness_and_comes_back(joint: int, push: float) -> None:
    client = Client(30)
    client.until_command()
    rest = client.cycles(400)[-1]
    client.cabinet.plant.push(torque(joint, push))
    pushed = client.cycles(600)
    yielded = (pushed[-1] - rest)[joint]
    # What is left of the friction after the torque feedback, about 4 Nm of 15, holds against both ways.
    assert abs(yielded - push / 500.0) < 4.0 / 500.0
    assert np.abs(np.diff(pushed[-50:, joint])).max() < 1e-5
    assert pushed[:, joint].max() - rest[joint] < 1.25 * push / 500.0
    client.cabinet.plant.push(np.zeros(7))
    assert abs(client.cycles(600)[-1, joint] - rest[joint]) < 8.0 / 500.0


def test_a_stiffer_spring_yields_less_and_an_additional_torque_moves_it() -> None:
    client = Client(30)
    client.until_command()
    rest = client.cycles(300)[-1, 3]
    client.command["jnt_stiffness"] = 2000.0
    client.cabinet.plant.push(torque(3, 30.0))
    stiff = client.cycles(500)[-1, 3] - rest
    client.cabinet.plant.push(np.zeros(7))
    client.cycles(400)
    client.command["jnt_stiffness"] = 300.0
    client.command["add_jnt_trq"] = torque(3, 30.0)
    moved = client.cycles(600)[-1, 3] - rest
    assert abs(stiff - 0.015) < 0.003
    assert 0.08 < moved < 0.12


def test_the_spring_follows_the_commanded_position() -> None:
    client = Client(30)
    client.until_command()
    rest = client.cycles(300)[-1]
    for step in range(200):
        client.shift = np.full(7, 0.1 * (step + 1) / 200)
        client.cycles(1)
    moved = client.cycles(500)[-1] - rest
    assert np.abs(moved - 0.1).max() < 0.02


def test_stiffness_out_of_range_ends_command_mode_with_the_joint() -> None:
    client = Client(30)
    client.until_command()
    client.cycles(50)
    client.command["jnt_stiffness"][4] = -20.0
    client.cycles(2)
    drop = client.cabinet.session.last_event
    assert drop is not None
    assert drop.kind is EventKind.IMPEDANCE
    assert "A4 commanded stiffness -20 Nm/rad is outside 0 to 5000 Nm/rad" in drop.text


def test_going_back_to_position_control_does_not_pull_the_arm() -> None:
    client = Client(30)
    client.until_command()
    client.cabinet.plant.push(torque(0, 60.0))
    client.cycles(500)
    cabinet = client.cabinet
    cabinet.stop_program()
    before = client.cycles(100)[-1]
    cabinet.session.set_strategy(10)
    cabinet.plant.push(np.zeros(7))
    after = client.cycles(300)
    assert cabinet.session.control is Control.POSITION
    assert np.abs(after - before).max() < 0.01


def test_gravity_compensation_lets_a_hand_move_the_arm_and_holds_it_otherwise() -> None:
    client = Client(10)
    client.cycles(200)
    cabinet = client.cabinet
    cabinet.stop_program()
    cabinet.session.set_strategy(101)
    still = client.cycles(400)
    assert np.abs(still[-1] - still[0]).max() < 0.02
    cabinet.plant.push(torque(0, 8.0))
    moved = client.cycles(200)[-1] - still[-1]
    assert moved[0] > 0.1
    cabinet.plant.push(np.zeros(7))
    client.cycles(600)
    assert np.abs(np.diff(client.cycles(50), axis=0)).max() < 1e-4


def test_cartesian_impedance_is_refused_with_the_reason(caplog: pytest.LogCaptureFixture) -> None:
    client = Client(20)
    with caplog.at_level("INFO"):
        client.cycles(600)
    session = client.cabinet.session
    assert session.state is State.MON
    assert session.last_event is not None
    assert session.last_event.kind is EventKind.REFUSED
    told = [record for record in caplog.records if "Cartesian impedance control" in record.message]
    assert [record.levelname for record in told] == ["WARNING"]


def test_a_client_that_begins_at_the_measured_position_is_taken_in_impedance_control() -> None:
    client = Client(30, **{"controller.load": {"mass": 1.0, "com": [0.0, 0.0, 0.1]}})
    client.until_command()
    client.origin = client.cabinet.reading.position.copy()
    assert np.abs(client.origin - client.cabinet.session.setpoint).max() > 1e-3
    client.cycles(100)
    assert client.cabinet.session.state is State.CMD
