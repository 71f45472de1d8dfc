"""Torques of a joint whose link and motor do not stand at the same angle."""

from __future__ import annotations

import numpy as np

from ident.effects.effect import Column
from ident.effects.motion import Floats, Motion

__all__ = ["deflected"]


def deflected(
    motion: Motion, joint: int, twist: Floats, encoder_at_motor: bool, scale: float
) -> tuple[Column, ...]:
    """Column for a twist (N,) of the joint, motor less link, by a unit coefficient [rad].

    With the encoder at the motor the link stands at q - twist, and all torques change. With the encoder at
    the link the motor moves by the twist beside it: drive inertia and drive friction see its derivatives.
    scale : coefficient about which the columns are linearised.
    """
    if encoder_at_motor:
        shift = np.zeros_like(motion.q)
        shift[:, joint] = -scale * twist
        change = motion.displaced(shift) / scale
        return (Column(motor=change, joint=change),)
    first = np.gradient(twist, motion.dt)
    second = np.gradient(first, motion.dt)
    # The jump of Coulomb friction moves by a millisecond or so; a column of spikes would say nothing else.
    here, there = motion.motor_speed, motion.motor_speed.copy()
    there[:, joint] += scale * first
    friction = (motion.friction(there) - motion.friction(here))[:, joint]
    friction -= motion.motor_coulomb[joint] * (np.sign(there) - np.sign(here))[:, joint]
    friction /= scale
    return (Column(motor=motion.inertia[joint] * second + friction),)
