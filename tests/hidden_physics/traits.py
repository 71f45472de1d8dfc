"""What can be changed in a joint: each trait one number per joint, with the value it has in a healthy arm."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np
from numpy.typing import NDArray

__all__ = ["JOINTS", "TRAITS", "Traits", "trait_rows"]

JOINTS = 7

Traits = Mapping[str, Mapping[int, float]]
"""Values by trait and joint number (1 to 7); what is not named is healthy."""

_HEALTHY: dict[str, float] = {
    # elastic joint: scales of stiffness and damping; lost motion, half its width [rad], and the stiffness
    # that is left inside it; relative hardening [1/rad^2]
    "stiffness": 1.0,
    "damping": 1.0,
    "play": 0.0,
    "play_softness": 0.03,
    "hardening": 0.0,
    # bristles: reach [rad], ratio of the reaches of neighbours, a second family with a long reach [rad] and
    # its share of the Coulomb torque
    "presliding": 1e-4,
    "spread": 2.0,
    "long_reach": 1e-2,
    "long_share": 0.0,
    # level of friction: scales; rise at rest over Coulomb torque, its speed [rad/s] and shape; exponent and
    # corner speed [rad/s] of the viscous law; excess forwards of Coulomb and viscous torque; torque per
    # transmitted torque
    "coulomb": 1.0,
    "viscous": 1.0,
    "stribeck": 0.0,
    "stribeck_speed": 0.05,
    "stribeck_shape": 1.0,
    "viscous_power": 1.0,
    "viscous_corner": 0.3,
    "forward_coulomb": 0.0,
    "forward_viscous": 0.0,
    "load_share": 0.0,
    # friction by joint angle: wave (share, count per turn, phase [rad]) and bump (share, centre, width [rad])
    "wave": 0.0,
    "wave_count": 1.0,
    "wave_phase": 0.0,
    "bump": 0.0,
    "bump_centre": 0.0,
    "bump_width": 0.3,
    # warmth: loss of friction per kelvin [1/K]; film and housing, capacity [J/K] and conductance [W/K]; the
    # temperature of both over the surroundings as the session begins [K]
    "warmth": 0.0,
    "film_capacity": 30.0,
    "film_conductance": 1.0,
    "housing_capacity": 900.0,
    "housing_conductance": 0.6,
    "start_warm": 0.0,
    # drive: true torque over reported torque; ripple once and twice per turn of the wave generator [Nm],
    # phases [rad], turns of the wave generator per joint turn
    "motor_gain": 1.0,
    "ripple_once": 0.0,
    "ripple_twice": 0.0,
    "ripple_once_phase": 0.0,
    "ripple_twice_phase": 0.0,
    "gear": 100.0,
    # another phase of the ripples in backward motion [rad] and their age [s]; fall of the torque constant with the
    # reported torque squared [1/Nm^2]; share of the Coulomb torque that creeps, and the speed at which it is whole
    # [rad/s]
    "ripple_back": 0.0,
    "ripple_late": 0.0,
    "gain_falls": 0.0,
    "creep": 0.0,
    "creep_speed": 0.02,
    # hose: stiffness beyond the slack [Nm/rad], cubic part [Nm/rad^3], centre and half the slack [rad];
    # rubbing torque [Nm] and its reach [rad]
    "cable": 0.0,
    "cable_cubic": 0.0,
    "cable_centre": 0.0,
    "cable_slack": 0.0,
    "cable_rub": 0.0,
    "cable_reach": 0.1,
    # hose on to another joint (1 to 7): stiffness [Nm/rad], and length per angle of that joint over that of this one
    "hose": 0.0,
    "hose_other": 1.0,
    "hose_ratio": 0.0,
    # encoder zero [rad]; its disc off the axis, over the radius of its track, and the angle of that [rad]
    "zero": 0.0,
    "eccentric": 0.0,
    "eccentric_angle": 0.0,
    # what no catalogue lists. The other joint (1 to 7): its angle modulates our friction (share, phase), its
    # speed drags us [Nm s/rad]; drag by our own speed of a while ago [Nm s/rad], how long a while [s];
    # friction that grows with acceleration [s^2/rad]; a shaking foundation [Nm], [Hz]
    "other": 0.0,
    "other_friction": 0.0,
    "other_phase": 0.0,
    "other_drag": 0.0,
    "memory": 0.0,
    "memory_time": 0.5,
    "inertial_friction": 0.0,
    "shake": 0.0,
    "shake_hz": 1.7,
}

TRAITS: tuple[str, ...] = tuple(_HEALTHY)
"""Names in the order of the rows that the kernel reads."""


def trait_rows(changes: Traits) -> NDArray[np.float64]:
    """All traits of all joints, (traits, 7), healthy but for `changes`.

    Raises KeyError for a trait or a joint that does not exist.
    """
    rows = np.repeat(np.array(list(_HEALTHY.values()))[:, None], JOINTS, axis=1)
    rows[TRAITS.index("gear"), 4] = 160.0
    for name, values in changes.items():
        if name not in _HEALTHY:
            raise KeyError(f"trait {name!r} does not exist")
        for joint, value in values.items():
            if not 1 <= int(joint) <= JOINTS:
                raise KeyError(f"joint {joint} does not exist")
            rows[TRAITS.index(name), int(joint) - 1] = value
    return rows


def merged(*parts: Traits) -> dict[str, dict[int, float]]:
    """Several sets of changes as one; later ones replace earlier ones."""
    whole: dict[str, dict[int, float]] = {}
    for part in parts:
        for name, values in part.items():
            whole.setdefault(name, {}).update({int(joint): float(value) for joint, value in values.items()})
    return whole


def every(values: Iterable[float]) -> dict[int, float]:
    """Seven values as a mapping by joint number."""
    return {joint: float(value) for joint, value in enumerate(values, start=1)}
