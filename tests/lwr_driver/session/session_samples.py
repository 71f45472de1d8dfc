"""Synthetic sessions and rows for the tests of the session log."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from mcap_ros2.writer import Writer as RosWriter
from numpy.typing import NDArray

from lwr_driver.ring import NO_PHASE, ROW
from lwr_driver.session import SessionWriter, session_metadata
from lwr_driver.session.messages import JOINT_STATE

JOINTS = ("A1", "A2", "E1", "A3", "A4", "A5", "A6")
EPOCH = 1_700_000_000 * 10**9
METADATA = session_metadata(robot="LWR4+", uid="0" * 32, utc_start="2023-11-14T22:13:20+00:00")

URDF = """<robot name="two"><link name="base"/><link name="one"/><link name="two"/><link name="tip"/>
<joint name="A1" type="revolute"><parent link="base"/><child link="one"/>
<origin xyz="0 0 0.3" rpy="0 0 0"/><axis xyz="0 0 1"/>
<limit lower="-3" upper="3" effort="10" velocity="2"/></joint>
<joint name="A2" type="revolute"><parent link="one"/><child link="two"/>
<origin xyz="0.1 0 0" rpy="1.5707963267948966 0 0.4"/><axis xyz="0 0 1"/>
<limit lower="-3" upper="3" effort="10" velocity="2"/></joint>
<joint name="flange" type="fixed"><parent link="two"/><child link="tip"/><origin xyz="0 0 0.078"/></joint>
</robot>"""


def signals(count: int, joints: int = len(JOINTS)) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Positions [rad] and torques [Nm], (count, joints), as float32 on the wire would give them."""
    rng = np.random.default_rng(3)
    angle = np.arange(count)[:, None] * 1e-3 * (1.0 + np.arange(joints))
    position = np.sin(angle).astype(np.float32).astype(np.float64)
    torque = (40.0 * np.cos(angle) + rng.normal(size=angle.shape)).astype(np.float32).astype(np.float64)
    return position, torque


def write_session(
    path: Path,
    count: int = 2000,
    *,
    metadata: dict[str, str] | None = None,
    start: int = EPOCH,
    **options: Any,
) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]:
    """A whole session at 1 kHz; returns log times, positions and torques."""
    position, torque = signals(count)
    log_time = start + np.arange(count) * 1_000_000
    sequence = 50 + np.arange(count)
    with SessionWriter(path, JOINTS, metadata or METADATA, start_ns=start, **options) as writer:
        clock = {"publish_time": sequence * 1_000_000, "sequence": sequence}
        writer.write_joint_states(log_time, position, torque, **clock)
        writer.write_joint_command(log_time, position + 0.5, **clock)
        motor = {"publish_time": sequence[::4] * 1_000_000, "sequence": np.arange(len(sequence[::4]))}
        writer.write_motor_states(log_time[::4], torque[::4] * 1.5, **motor)
        writer.write_phase(int(log_time[0]), "settle")
        writer.write_phase(int(log_time[count // 4]), "period 1")
        writer.write_phase(int(log_time[count // 2]), "period 2")
    return log_time, position, torque


def rows(count: int, first: int = 100) -> NDArray[Any]:
    """Rows of the FRI loop: 1 kHz, motor torques in the KRL reals every 12 cycles, three phases."""
    result = np.zeros(count, dtype=ROW)
    position, torque = signals(count)
    cycle = np.arange(count)
    result["sequence"] = first + cycle
    result["t_recv"] = 5 * 10**9 + cycle * 1_000_000 + (cycle % 7) * 3000
    result["t_send"] = result["t_recv"] + 60_000
    result["answered"] = cycle % 10 != 3
    result["phase"] = np.select([cycle < 30, cycle < 200, cycle < 700], [NO_PHASE, 2, 3], NO_PHASE)
    msr = result["msr"]
    msr["msr_sample_time"] = 0.001
    msr["cmd_sample_time"] = 0.001
    msr["msr_jnt_pos"], msr["msr_jnt_trq"] = position, torque
    msr["state"], msr["quality"], msr["power"] = 2, 3, 0x7F
    msr["answer_rate"] = 1.0
    msr["mass_matrix"] = np.eye(7) * 0.5
    msr["gravity"] = np.arange(7)
    msr["krl_int"][:, 0] = cycle // 12
    msr["krl_real"][:, :7] = torque[cycle // 12 * 12] * 2.0
    result["cmd"]["jnt_pos"] = position + 0.25
    return result


def ros_session(path, messages, *, topic="/joint_states", **options):
    """A log of another tool, written with `mcap_ros2`; messages are (log time, JointState dict)."""
    with open(path, "wb") as file:
        writer = RosWriter(file, **options)
        schema = writer.register_msgdef(JOINT_STATE.name, JOINT_STATE.text)
        for number, (log_time, message) in enumerate(messages):
            writer.write_message(topic, schema, message, log_time, log_time, number)
        writer.finish()


def joint_state(log_time, names, position, effort, velocity=(), frame=""):
    stamp = {"sec": log_time // 10**9, "nanosec": log_time % 10**9}
    header = {"stamp": stamp, "frame_id": frame}
    return {
        "header": header,
        "name": list(names),
        "position": list(position),
        "velocity": list(velocity),
        "effort": list(effort),
    }


def plain_messages(count, names=("a", "b", "c")):
    position, torque = signals(count, len(names))
    times = [EPOCH + 1_000_000 * row for row in range(count)]
    return (
        [(time, joint_state(time, names, position[row], torque[row])) for row, time in enumerate(times)],
        position,
        torque,
    )
