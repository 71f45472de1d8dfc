"""KRL programs on the emulated controller: by name, by file, without a request; what fails is told."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np
import pytest

from fri.errors import ConfigurationError
from fri.handshake import IdentificationHandshake
from fri.states import State
from sim_backend.cabinet import Cabinet
from sim_backend.configuration import load_configuration
from sim_backend.program import krl_program, program_names
from sim_backend.robot import Payload, robot_file, truth
from tests.sim_backend.cabinet_client import QUIET, Client


def cabinet(**settings: object) -> Cabinet:
    made = Cabinet(load_configuration("emulator/default.yaml", {**QUIET, **settings}))
    made.start_program()
    return made


def write(folder: Path, body: str, name: str = "mine", data: str = "") -> Path:
    path = folder / f"{name}.src"
    path.write_text(f"DEF {name}( )\n{body}\nEND\n", encoding="utf-8")
    if data:
        (folder / f"{name.upper()}.DAT").write_bytes(f"DEFDAT {name}\n{data}\nENDDAT\n".encode("cp1252"))
    return path


def test_every_program_of_the_repository_runs_without_a_remark() -> None:
    assert "auto_start" in program_names()
    for name in program_names():
        assert krl_program(name, 5).remarks == ()


def test_a_program_of_the_laboratory_is_run_by_its_file(tmp_path: Path) -> None:
    (tmp_path / "helper.src").write_text("GLOBAL DEF helper(n:IN)\nINT n\n$FRI_TO_INT[3]=n+1\nEND\n")
    data = 'EXT helper(INT :IN)\nDECL INT LWR_CYCLE=4 ; für uns\nDECL CHAR HOST[8]\nHOST[]="a;b"'
    body = "DECL FRISTATE r\nr=friOpen(LWR_CYCLE)\nhelper(41)\nLOOP\nWAIT SEC 0.012\nENDLOOP"
    path = write(tmp_path, body, data=data)
    machine = cabinet(**{"fri.program": str(path), "fri.period_ms": 8})
    for _ in range(20):
        if machine.session.state is not State.OFF:
            machine.packet()
        machine.close()
    assert machine.session.state is State.MON
    assert machine.session.sample_time_ms == 8
    assert machine.session.to_int[2] == 42


def test_an_unknown_program_is_named_with_the_known_ones_and_a_wrong_one_with_its_line(
    tmp_path: Path,
) -> None:
    with pytest.raises(ConfigurationError, match=r"'kuka' is unknown; known: auto_start, .*or give the path"):
        krl_program("kuka")
    with pytest.raises(ConfigurationError, match=r"no\.src' not found"):
        krl_program("no.src")
    with pytest.raises(ConfigurationError, match="mine, line 3: there is no function KICK"):
        krl_program(str(write(tmp_path, "INT n\nkick()")))


def test_a_program_that_fails_is_stopped_and_told(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    body = "DECL FRISTATE r\nr=friOpen(5)\nWAIT SEC 0.1\n$FRI_TO_REA[1]=$CURR_ACT[7]"
    machine = cabinet(**{"fri.program": str(write(tmp_path, body)), "krl.currents": False})
    with caplog.at_level(logging.WARNING):
        for _ in range(100):
            if machine.session.state is not State.OFF:
                machine.packet()
            machine.close()
    assert machine.session.state is State.OFF
    assert not machine.running
    assert "line 5: $CURR_ACT[7] does not exist on this controller" in caplog.text


def test_auto_start_gives_command_mode_again_to_the_next_client_and_ends_with_minus_one() -> None:
    client = Client(10)
    client.until_command()
    assert client.cabinet.session.to_int[0] in (1, 2)
    client.cabinet.session.drop(client.cabinet.session.events[-1].kind, "test")
    client.origin = None
    client.cycles(5)
    client.until_command()
    assert client.cabinet.session.counters()["starts"] == 2
    ending = Client(10, **{"krl.variables": {"LWR_STRATEGY": 10, "LWR_SECONDS": 0.5}})
    ending.until_command()
    for _ in range(400):
        ending.cycles(1)
        if ending.cabinet.session.to_int[0] == -1:
            break
    assert ending.cabinet.session.to_int[0] == -1
    ending.cycles(300)
    assert ending.cabinet.session.state is State.OFF


class Own:
    """The program of this project in a cabinet, with a client that asks for load data."""

    def __init__(self, **settings: object) -> None:
        self.client = Client(10, **{"fri.program": "lwr_identification", "krl.variables": {}, **settings})
        self.cabinet = self.client.cabinet
        self.handshake = IdentificationHandshake()
        self.client.cycles(60)

    def ask(self, load: list[float]) -> bool:
        msr = np.zeros((), [("krl_int", "<i4", 16), ("krl_real", "<f4", 16)])
        session = self.cabinet.session
        msr["krl_int"], msr["krl_real"] = session.to_int, session.to_real
        self.handshake.request_load(self.client.command, msr, np.array(load))
        self.client.cycles(30)
        msr["krl_int"], msr["krl_real"] = session.to_int, session.to_real
        return self.handshake.load_taken(self.client.command, msr)


@pytest.mark.parametrize(
    "load",
    [
        [3.0, 0.0, -66.0, 600.0, 0.01, 0.02, 0.03],
        [3.0, 300.0, 300.0, 300.0, 0.01, 0.02, 0.03],
        [3.0, 0.0, 0.0, 66.0, 0.01, 0.02, 0.05],
        [3.0, 0.0, 0.0, 66.0, -0.01, 0.02, 0.02],
        [3.0, 0.0, 0.0, 66.0, 5.0, 5.0, 5.0],
        [3.0, float("nan"), 0.0, 66.0, 0.01, 0.02, 0.03],
    ],
    ids=["far", "far in space", "triangle", "negative", "heavy to turn", "no number"],
)
def test_the_program_takes_no_load_that_no_body_has(load: list[float]) -> None:
    own = Own()
    assert own.ask([1.0, 0.0, 0.0, 50.0, 0.01, 0.01, 0.01])
    before = own.cabinet.load
    assert not own.ask(load)
    assert own.cabinet.load == before


def test_the_orientation_of_the_load_before_does_not_turn_the_new_inertia() -> None:
    own = Own()
    own.cabinet.set_load((1.0, 0.0, 0.0, 50.0, 90.0, 0.0, 0.0, 0.01, 0.02, 0.025))
    assert own.cabinet.model.load.inertia[0] == pytest.approx(0.02)
    assert own.cabinet.load[4:] == pytest.approx((90.0, 0.0, 0.0, 0.01, 0.02, 0.025))
    assert own.ask([2.0, 0.0, 0.0, 60.0, 0.01, 0.02, 0.025])
    xx, xy, xz, yy, yz, zz = own.cabinet.model.load.inertia
    assert (xx, yy, zz) == pytest.approx((0.01, 0.02, 0.025))
    assert (xy, xz, yz) == pytest.approx((0.0, 0.0, 0.0))
    assert own.cabinet.load[4:7] == (0.0, 0.0, 0.0)


def test_without_motor_currents_the_program_runs_and_the_counter_stands() -> None:
    own = Own(**{"krl.currents": False, "krl.variables": {"LWR_CURRENTS": False}})
    assert own.cabinet.running
    assert own.cabinet.session.to_int[0] == 0
    assert own.cabinet.session.to_int[15] == 1
    own.client.cycles(300)
    assert own.cabinet.session.to_real[11] == pytest.approx(12.0, abs=0.2)


@pytest.mark.parametrize("period_ms", [1, 2, 5, 12, 30])
def test_a_statement_reads_the_motor_currents_of_its_own_millisecond(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, period_ms: int
) -> None:
    body = f"""DECL FRISTATE r
INT n
r=friOpen({period_ms})
LOOP
n=n+1
$FRI_TO_REA[n]=$CURR_ACT[1]
WAIT SEC 0.012
ENDLOOP"""
    noise = {"sensors.motor_torque_noise": [1.0] * 7, "sensors.motor_torque_resolution": [0.0] * 7}
    settings = {"krl.statement_ms": 0.0, **noise}
    machine = cabinet(**settings, **{"fri.program": str(write(tmp_path, body))})
    told: list[float] = []
    publish = machine.publish

    def listen(motor_torque: np.ndarray) -> None:
        told.append(motor_torque[0])
        publish(motor_torque)

    monkeypatch.setattr(machine, "publish", listen)
    while len(told) < 120:
        if machine.session.state is not State.OFF:
            machine.packet()
        machine.close()
    assert len(set(told)) == len(told)
    assert machine.session.to_real[:10].tolist() == np.float32(told[:120:12]).tolist()


def test_the_mounting_is_put_in_force_by_the_program() -> None:
    ceiling = {"robot.gravity": [0.0, 0.0, 9.81], "krl.variables": {"LWR_MOUNTING": True, "LWR_GZ": -9.81}}
    own = Own(**ceiling)
    assert own.cabinet.gravity == pytest.approx((0.0, 0.0, -9.81))
    own.client.cycles(200)
    joint, believed = own.cabinet.plant.joint_torque, own.cabinet.model.gravity
    assert np.abs(joint - believed).max() < 8.0
    assert believed[1] * truth_of_the_floor()[1] < 0.0


def truth_of_the_floor() -> np.ndarray:
    floor = cabinet()
    return floor.model.update_gravity(floor.reading.position)


def test_the_nudge_moves_one_axis_by_a_hundredth_of_a_degree() -> None:
    still, nudged = Own(), Own(**{"krl.variables": {"LWR_NUDGE": 0.01}})
    moved = np.degrees(nudged.cabinet.session.setpoint - still.cabinet.session.setpoint)
    assert abs(moved[6]) == pytest.approx(0.01, abs=1e-3)
    assert np.abs(moved[:6]).max() < 1e-3
    too_far = Own(**{"krl.variables": {"LWR_NUDGE": 5.0}})
    assert np.array_equal(too_far.cabinet.session.setpoint, still.cabinet.session.setpoint)


def test_any_payload_by_name_and_its_truth() -> None:
    settings = {
        "robot.payloads": {
            "brass": {"mass": 2.0, "com": [0.0, 0.01, 0.12], "inertia": [0.01, 0, 0, 0.02, 0, 0.02]}
        },
        "robot.payload": "brass",
    }
    config = load_configuration("emulator/default.yaml", settings)
    values = truth(config)
    assert values["M8"] == 2.0
    assert values["MZ8"] == pytest.approx(0.24)
    assert values["XX8"] == pytest.approx(0.01 + 2.0 * (0.01**2 + 0.12**2))
    assert sorted(robot_file(config).payloads) == ["brass", "paper_load"]
    body = Payload.from_centre_of_mass(1.5, (0.0, 0.0, 0.1))
    assert truth(config, body, link=9)["MZ9"] == pytest.approx(0.15)
    with pytest.raises(ConfigurationError, match="`none`"):
        load_configuration("emulator/default.yaml", {"robot.payloads": {"none": {"mass": 1.0}}})
