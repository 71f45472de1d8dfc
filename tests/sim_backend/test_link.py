"""The emulator over UDP: lock step, real time, faults, the pendant."""

import numpy as np
import pytest

from fri.errors import RobotError
from fri.packets import MSR
from fri.states import State
from runner.laboratory import free_port
from tests.sim_backend.pc import Pc, emulator, gentle


def session(seed, cycles=1500, settings=None, period_ms=2, restart=True):
    """(packets received, status at the end) of a run with the gentle motion."""
    port = free_port("127.0.0.1")
    with (
        Pc(port, gentle, restart) as pc,
        emulator(port, seed=seed, period_ms=period_ms, settings=settings or {}) as pendant,
    ):
        pc.run(cycles)
        return pc, pendant.status()


def test_lock_step_repeats_bit_for_bit_from_the_seed():
    first, status = session(7)
    second, _ = session(7)
    other, _ = session(8)
    assert first.measured == second.measured
    assert first.measured != other.measured
    assert status["state"] == "CMD"
    assert status["session"]["missed"] == 0
    assert status["monitor"]["violations"] == 0
    assert status["monitor"]["commands"] > 1000


def test_packets_carry_a_consistent_picture_of_the_arm():
    pc, status = session(1)
    rows = np.frombuffer(b"".join(pc.measured), MSR)
    assert np.array_equal(np.diff(rows["send_seq"].astype(int)), np.ones(len(rows) - 1))
    last = rows[-1]
    assert last["power"] == 0x7F
    assert np.abs(last["msr_jnt_pos"] - last["cmd_jnt_pos"] - last["cmd_jnt_pos_fri_offset"]).max() < 0.01
    assert np.abs(last["msr_jnt_trq"] - last["gravity"]).max() < 6.0
    eigenvalues = np.linalg.eigvalsh(last["mass_matrix"].astype(float))
    assert eigenvalues[0] > 0.0
    counter = rows["krl_int"][:, 0].astype(int)
    fresh = np.flatnonzero(np.diff(counter)) + 1
    assert set(np.diff(fresh)) == {6}, "a 12 ms tick at 2 ms cycles"
    assert (np.diff(counter)[fresh - 1] == 1).all()
    held = np.flatnonzero(np.diff(counter) == 0)
    assert np.array_equal(rows["krl_real"][held], rows["krl_real"][held + 1])
    assert status["position"] == pytest.approx(last["msr_jnt_pos"], abs=0.01)


FAULTS = {
    "loss": {"kind": "loss", "probability": 0.02},
    "burst": {"kind": "burst", "probability": 0.004, "length": 6},
    "delay": {"kind": "delay", "probability": 0.02, "length": 2},
    "jitter": {"kind": "jitter", "probability": 0.05, "length": 2},
    "duplicate": {"kind": "duplicate", "probability": 0.1},
    "reorder": {"kind": "reorder", "probability": 0.02},
    "truncate": {"kind": "truncate", "probability": 0.01},
    "corrupt": {"kind": "corrupt", "probability": 0.005, "bits": 4, "direction": "to_krc"},
    "foreign": {"kind": "foreign", "probability": 0.1},
}


@pytest.mark.parametrize("name", FAULTS)
def test_wire_faults_repeat_with_the_seed(name):
    settings = {"faults": [FAULTS[name]]}
    first, status = session(3, 700, settings)
    second, _ = session(3, 700, settings)
    assert status["faults_struck"] > 0
    assert first.measured == second.measured
    assert first.states == second.states


def test_corrupted_measurements_never_stop_the_link():
    settings = {"faults": [{"kind": "corrupt", "direction": "to_pc", "probability": 0.05, "bits": 2}]}
    pc, status = session(5, 600, settings)
    assert len(pc.measured) == 600
    assert status["faults_struck"] > 10


def test_a_long_burst_drops_command_mode_and_the_arm_stands():
    settings = {
        "schedule": [
            {
                "command": "inject",
                "when": "moving",
                "after_cycles": 200,
                "arguments": {"kind": "burst", "length": 30, "cycles": 31},
            }
        ]
    }
    pc, status = session(2, 1200, settings, restart=False)
    assert status["session"]["drops"] == 1
    assert status["state"] == "MON"
    assert not status["moving"]
    drop = pc.states.index(State.MON, pc.states.index(State.CMD))
    rows = np.frombuffer(b"".join(pc.measured[drop + 150 :]), MSR)
    assert np.ptp(rows["msr_jnt_pos"], axis=0).max() < 1e-3


@pytest.mark.parametrize(
    ("command", "arguments", "power"),
    [
        ("emergency_stop", {}, 0),
        ("drives_off", {}, 0),
        ("mode", {"name": "T1"}, 0),
        ("drive_fault", {"joint": 3}, 0),
        ("degrade_quality", {"cycles": 300}, 0x7F),
    ],
)
def test_every_interruption_ends_command_mode_and_the_arm(command, arguments, power):
    entry = {"command": command, "when": "moving", "after_cycles": 150, "arguments": arguments}
    pc, status = session(4, 900, {"schedule": [entry]}, restart=False)
    assert State.CMD in pc.states
    assert status["state"] == "MON"
    assert status["power"] == power
    assert status["session"]["drops"] == 1
    assert status["monitor"]["violations"] == 0
    last = np.frombuffer(b"".join(pc.measured[-100:]), MSR)["msr_jnt_pos"]
    assert np.ptp(last, axis=0).max() < 1e-4


def test_silence_shows_as_a_gap_and_a_restart_as_new_counters():
    port = free_port("127.0.0.1")
    with Pc(port) as pc, emulator(port) as pendant:
        pc.run(300)
        pendant.silence(50)
        pc.run(200)
        assert pc.end.lost == 50
        pendant.restart(silent_cycles=100)
        pc.run(300)
        assert pc.end.restarts == 1
        status = pendant.status()
        assert status["session"]["packets"] < 310
        assert status["power"] == 0x7F


def test_virtual_time_stands_still_while_the_pc_does_not_read():
    port = free_port("127.0.0.1")
    with Pc(port) as pc, emulator(port) as pendant:
        pc.run(100)
        before = pendant.status()["time_s"]
        assert pendant.status()["time_s"] == before
        pc.run(100)
        assert pendant.status()["time_s"] == pytest.approx(before + 0.2, abs=1e-6)


def test_operator_at_the_pendant():
    port = free_port("127.0.0.1")
    with Pc(port) as pc, emulator(port) as pendant:
        pc.run(200)
        empty = np.array(pendant.status()["joint_torque"])
        pendant.mount("paper_load")
        pendant.set_load(3.34, (0.0, -0.0659, 0.1437))
        pc.run(500)
        status = pendant.status()
        assert status["payload"] == "paper_load"
        assert status["load"]["mass"] == 3.34
        assert abs(status["joint_torque"][1] - empty[1]) > 5.0
        pendant.unmount()
        pendant.mount(mass=1.0, com=(0.0, 0.0, 0.1))
        assert pendant.status()["payload"] == "custom"
        with pytest.raises(RobotError, match="piano"):
            pendant.mount("piano")
        with pytest.raises(RobotError, match="drives are on"):
            pendant.displace([0.1] * 7)
        with pytest.raises(RobotError, match="known"):
            pendant.request("dance")
        with pytest.raises(RobotError, match="missing a required argument"):
            pendant.request("mode", nam="T1")
        pendant.emergency_stop()
        with pytest.raises(RobotError, match="emergency stop"):
            pendant.drives(True)
        pendant.release_emergency_stop()
        pc.run(50)
        before = np.array(pendant.status()["position"])
        pendant.displace([0.05] * 7)
        pc.run(200)
        assert np.array(pendant.status()["position"]) - before == pytest.approx(np.full(7, 0.05), abs=2e-3)
        pendant.drives(True)
        pc.run(400)
        status = pendant.status()
        assert status["power"] == 0x7F
        assert np.array(status["position"]) - before == pytest.approx(np.full(7, 0.05), abs=6e-3)


def test_trace_file_over_the_pendant_agrees_with_the_packets(tmp_path):
    port = free_port("127.0.0.1")
    with Pc(port, gentle) as pc, emulator(port) as pendant:
        pc.run(250)
        pendant.start_trace()
        begin = len(pc.measured)
        pc.run(600)
        assert pendant.save_trace(tmp_path / "trace.csv") == pytest.approx(1200, abs=2)
        with pytest.raises(RobotError, match="no trace"):
            pendant.save_trace(tmp_path / "again.csv")
    table = np.loadtxt(tmp_path / "trace.csv", delimiter=",", skiprows=1)
    position = np.frombuffer(b"".join(pc.measured[begin:]), MSR)["msr_jnt_pos"]
    # A packet every 2 ms carries what the second of its two samples says.
    assert np.allclose(table[1::2, 8:][:590], position[1:591], atol=3e-7)


def test_program_can_be_stopped_and_started_with_another_period():
    port = free_port("127.0.0.1")
    with Pc(port) as pc, emulator(port) as pendant:
        pc.run(100)
        pendant.stop_program()
        assert pendant.status()["state"] == "OFF"
        assert pc.run(10, silence_s=0.05) <= 1
        pendant.start_program(period_ms=5)
        assert pc.run(300) == 300
        assert pc.end.sample_time_s == pytest.approx(0.005)
        with pytest.raises(RobotError, match="unknown"):
            pendant.start_program("tetris")


def test_real_time_keeps_its_period_and_answers_arrive_in_it():
    port = free_port("127.0.0.1")
    with Pc(port) as pc, emulator(port, lock_step=False, period_ms=10) as pendant:
        assert pc.run(60, silence_s=2.0) == 60
        status = pendant.status()
    assert status["period_ms"] == 10
    assert status["received"] >= 59
    assert pc.end.lost == 0


class Stuck:
    """A plant from outside: rigid, frictionless, immovable."""

    def __init__(self, model, drive, random, offset=0.0):
        for name in (
            "position",
            "velocity",
            "motor_position",
            "motor_velocity",
            "joint_torque",
            "motor_torque",
        ):
            setattr(self, name, np.zeros(7))
        self.offset = offset

    def reset(self, position):
        self.position[:] = position
        self.motor_position[:] = position

    def step(self, motor_torque):
        self.motor_torque[:] = motor_torque
        self.joint_torque[:] = self.offset

    def mount(self, payload):
        pass

    def brake(self, engaged):
        pass

    def push(self, torque):
        pass


def test_other_physics_can_take_the_place_of_the_arm():
    port = free_port("127.0.0.1")
    plant = {"type": "tests.sim_backend.test_link:Stuck", "options": {"offset": 4.0}}
    with Pc(port) as pc, emulator(port, settings={"robot.plant": plant}) as pendant:
        pc.run(100)
        assert pendant.status()["joint_torque"] == pytest.approx([4.0] * 7, abs=2.0)


def test_a_pc_that_stops_answering_in_command_mode_is_dropped():
    port = free_port("127.0.0.1")
    with Pc(port, gentle) as pc, emulator(port, settings={"fri.patience_s": 0.02}) as pendant:
        pc.run(500)
        assert pendant.status()["state"] == "CMD"
        states = (pendant.status()["state"] for _ in range(50_000))
        assert "MON" in states
        status = pendant.status()
        assert status["events"][-1]["kind"] == "MISSES"
        # In monitor mode it waits for the PC, however long that takes.
        assert pendant.status()["cycle"] == status["cycle"]


@pytest.mark.parametrize(
    ("name", "power"), [("cold_start", 0), ("poor_link", 0x7F), ("late_motor_torque", 0x7F)]
)
def test_shipped_scenarios_run(name, power):
    port = free_port("127.0.0.1")
    with Pc(port, gentle) as pc, emulator(port, config=f"emulator/{name}.yaml") as pendant:
        assert pc.run(900) == 900
        status = pendant.status()
        assert (status["power"], status["state"]) == (power, "CMD")
        assert status["monitor"]["violations"] == 0


def test_a_first_packet_that_a_closed_port_refused_soon_comes_again(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sim_backend.service._RESEND_HEARD_S", 3600.0)
    port = free_port("127.0.0.1")
    with emulator(port) as pendant:
        # Answered only after the refusal was read.
        pendant.status()
        with Pc(port) as pc:
            assert pc.run(1, silence_s=20.0) == 1
