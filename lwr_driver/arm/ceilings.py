"""What the KUKA LWR4+ can stand, by joint. An arm file may only narrow it.

Position and torque: data sheet. Velocity: the URDF files of the arm's laboratories, below the 120 to 250 deg/s at which
the controller drops the session. Acceleration and jerk: no data sheet names any; stops, guards and the controller's
own limit of 1200 deg/s² were tried with these.
"""

from __future__ import annotations

MODEL = "KUKA LWR4+"
JOINT_NAMES = ("A1", "A2", "E1", "A3", "A4", "A5", "A6")
#: By key of the arm file, in kinematic order.
LWR4PLUS: dict[str, tuple[float, ...]] = {
    "position_deg": (170.0, 120.0, 170.0, 120.0, 170.0, 120.0, 170.0),
    "velocity_deg_s": (110.0, 110.0, 128.0, 128.0, 204.0, 184.0, 184.0),
    "acceleration_rad_s2": (8.0,) * 7,
    "jerk_rad_s3": (100.0,) * 7,
    "torque_nm": (176.0, 176.0, 100.0, 100.0, 100.0, 38.0, 38.0),
}
