"""Torques of a joint whose link and motor do not stand at the same angle."""

from __future__ import annotations

import numpy as np

from ident.effects.effect import Column
from ident.effects.motion import Floats, Motion
from ident.effects.springs import Springs
from ident.rows.filters import differentiate, low_pass

__all__ = ["changed_springs", "deflected"]

_LINK_HZ, _MOTOR_HZ = 8.0, 30.0


def deflected(
    motion: Motion, joint: int, twist: Floats, encoder_at_motor: bool, scale: float
) -> tuple[Column, ...]:
    """Column for a twist (N,) of the joint, motor less link, by a unit coefficient [rad].

    With the encoder at the motor the link stands at q - twist, and all torques change. With the encoder at
    the link the motor moves by the twist beside it: drive inertia and drive friction see its derivatives.
    scale : coefficient about which the columns are linearised. The links are taken to follow at once.
    """
    dt = motion.dt
    # The torque's own acceleration part is noisy, and two more derivatives amplify it: with the link's inertia
    # behind them more than with the drive's friction.
    cutoff = min(_LINK_HZ if encoder_at_motor else _MOTOR_HZ, 0.2 / dt)
    twist = low_pass(twist[:, None], dt, cutoff)
    first, second = differentiate(twist, dt)
    if encoder_at_motor:
        shift = np.zeros_like(motion.q)
        shift[:, joint] = -scale * twist[:, 0]
        rate, thrust = np.zeros_like(shift), np.zeros_like(shift)
        rate[:, joint], thrust[:, joint] = -scale * first[:, 0], -scale * second[:, 0]
        change = motion.displaced(shift, rate, thrust) / scale
        return (Column(motor=change, joint=change),)
    first, second = first[:, 0], second[:, 0]
    # The jump of Coulomb friction moves by a millisecond or so; a column of spikes would say nothing else.
    here, there = motion.motor_speed, motion.motor_speed.copy()
    there[:, joint] += scale * first
    friction = (motion.friction(there) - motion.friction(here))[:, joint]
    friction -= motion.motor_coulomb[joint] * (np.sign(there) - np.sign(here))[:, joint]
    friction /= scale
    return (Column(motor=motion.inertia[joint] * second + friction),)


def changed_springs(springs: Springs, changed: Springs, size: float) -> tuple[Column, ...]:
    """Column of what a change of the springs behind the published motors does to all torques, over its `size`.

    The links follow as the springs let them, and ring; that is not proportional to the size, so the column belongs
    to one size, and its coefficient is that size where it suits the data.
    """
    change = (changed.torque - springs.torque) / size
    return (Column(motor=change, joint=change),)
