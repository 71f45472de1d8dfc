"""The message definitions of the session log, `ros2msg`, each complete in itself."""

from __future__ import annotations

from dataclasses import dataclass

__all__ = [
    "CONTROLLER_MODEL",
    "FRI_STATUS",
    "JOINT_STATE",
    "STRING",
    "TF_MESSAGE",
    "TOPICS",
    "Schema",
]


@dataclass(frozen=True)
class Schema:
    """Name and text of a message definition."""

    name: str
    text: str


_RULE = "=" * 80

_TIME = f"""{_RULE}
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
"""

_HEADER = f"""{_RULE}
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
{_TIME}"""

JOINT_STATE = Schema(
    "sensor_msgs/msg/JointState",
    f"""std_msgs/Header header
string[] name
float64[] position
float64[] velocity
float64[] effort
{_HEADER}""",
)

STRING = Schema("std_msgs/msg/String", "string data\n")

TF_MESSAGE = Schema(
    "tf2_msgs/msg/TFMessage",
    f"""geometry_msgs/TransformStamped[] transforms
{_RULE}
MSG: geometry_msgs/TransformStamped
std_msgs/Header header
string child_frame_id
geometry_msgs/Transform transform
{_RULE}
MSG: geometry_msgs/Transform
geometry_msgs/Vector3 translation
geometry_msgs/Quaternion rotation
{_RULE}
MSG: geometry_msgs/Vector3
float64 x
float64 y
float64 z
{_RULE}
MSG: geometry_msgs/Quaternion
float64 x
float64 y
float64 z
float64 w
{_HEADER}""",
)

FRI_STATUS = Schema(
    "lwr_msgs/msg/FriStatus",
    f"""# State and statistics of the controller's FRI session, as received in one cycle.
std_msgs/Header header
uint16 state          # 0 OFF, 1 MON, 2 CMD
uint16 quality        # 0 UNACCEPTABLE, 1 BAD, 2 OK, 3 PERFECT
uint32 sequence       # packet count of the controller, unwrapped
float64 sample_time   # [s]
float32 answer_rate   # answered packets, 0 to 1
float32 latency       # [s]
float32 jitter        # [s]
float32 miss_rate     # missing answers, 0 to 1
uint32 miss_counter
uint16 power          # bit i: drive of joint i is on
uint16 control        # control mode
uint16 error          # bit i: error of drive i
uint16 warning        # bit i: warning of drive i
float32[7] temperature
{_HEADER}""",
)

CONTROLLER_MODEL = Schema(
    "lwr_msgs/msg/ControllerModel",
    f"""# The controller's own model at the measured position.
std_msgs/Header header
float32[49] mass_matrix             # row-major 7 x 7 [kg m2]
float32[7] gravity                  # joint torques [Nm]
float32[42] jacobian                # row-major 6 x 7, rows X Y Z RZ RY RX
float32[7] estimated_external_torque  # [Nm]
{_HEADER}""",
)

TOPICS: dict[str, Schema] = {
    "/joint_states": JOINT_STATE,
    "/motor_states": JOINT_STATE,
    "/joint_command": JOINT_STATE,
    "/experiment/phase": STRING,
    "/fri/status": FRI_STATUS,
    "/fri/controller_model": CONTROLLER_MODEL,
    "/robot_description": STRING,
    "/tf": TF_MESSAGE,
}
"""The topics of the session log and their message definitions."""
