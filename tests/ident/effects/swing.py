"""An arm in motion, without a recording."""

from __future__ import annotations

import numpy as np

from ident.dynamics.kinematics import Chain
from ident.dynamics.regressor import torque
from ident.effects import ArmMotion

VISCOUS, COULOMB = 2.0, 1.5


def swing(
    chain: Chain,
    bodies: np.ndarray,
    w: np.ndarray,
    phase: np.ndarray,
    step_s: float,
    *,
    inertia: float,
    session: int,
) -> ArmMotion:
    """All joints swing for 4 s, with drives of viscous and Coulomb friction."""
    time = np.arange(0.0, 4.0, step_s)
    q = 0.6 * np.sin(w * time[:, None] + phase)
    qd = 0.6 * w * np.cos(w * time[:, None] + phase)
    qdd = -0.6 * w**2 * np.sin(w * time[:, None] + phase)
    joint = torque(chain, q, qd, qdd, bodies)

    def friction(speed: np.ndarray) -> np.ndarray:
        return VISCOUS * speed + COULOMB * np.sign(speed)

    return ArmMotion(
        chain=chain,
        bodies=bodies,
        session=session,
        time=time,
        duration_s=4.0,
        q=q,
        qd=qd,
        qdd=qdd,
        motor_speed=qd,
        motor_acceleration=qdd,
        joint_torque=joint,
        motor_torque=joint + friction(qd),
        gear_ratio=np.full(chain.n, 100.0),
        inertia=np.full(chain.n, inertia),
        link_coulomb=np.zeros(chain.n),
        motor_coulomb=np.full(chain.n, COULOMB),
        friction=friction,
    )
