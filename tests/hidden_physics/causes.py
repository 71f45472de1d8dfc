"""What can be hidden: every cause of the catalogue. What no catalogue has is in `outside`."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

import numpy as np

from tests.hidden_physics.hidden import (
    COULOMB,
    JOINT_NOISE,
    MOTOR_NOISE,
    Cause,
    Hidden,
    Random,
    Scene,
    either_sign,
    everywhere,
    fault,
    log_uniform,
    trait,
)
from tests.hidden_physics.motions import PERIOD_S, PERIODS
from tests.hidden_physics.robots import SESSIONS, Setting
from tests.hidden_physics.traits import JOINTS, every

__all__ = ["CAUSES"]

VISCOUS = (16.68, 19.09, 7.87, 11.63, 5.39, 3.64, 2.03)
FULL_SCALE = (176.0, 176.0, 100.0, 100.0, 100.0, 38.0, 38.0)
PLAY = (1.5e-4, 8e-4, 8e-4, 8e-4, 1.2e-3, 2e-3, 3e-3)
ZERO_DEG = (0.2, 0.2, 0.3, 0.3, 0.8, 1.0, 1.5)


# ---- friction ----


def _stribeck(random: Random, joint: int, scene: Scene) -> Callable[[float], Hidden]:
    speed, shape = log_uniform(random, 0.04, 0.25), random.uniform(0.8, 2.0)

    def sized(size: float) -> Hidden:
        rise = size * 7.0 * MOTOR_NOISE[joint - 1]
        setting = trait(joint, stribeck=rise / COULOMB[joint - 1], stribeck_speed=speed, stribeck_shape=shape)
        truth = {"amplitude": rise, "velocity": speed}
        return Hidden("stribeck", "motor", (joint,), size, everywhere(setting), truth)

    return sized


def _viscous(random: Random, joint: int, scene: Scene) -> Callable[[float], Hidden]:
    corner, falls = random.uniform(0.1, 0.5), random.random() < 0.8

    def sized(size: float) -> Hidden:
        change = min(0.7, size * 6.0 * MOTOR_NOISE[joint - 1] / VISCOUS[joint - 1])
        power = 1.0 - change if falls else 1.0 + change
        setting = trait(joint, viscous_power=power, viscous_corner=corner)
        return Hidden("viscous_nonlinear", "motor", (joint,), size, everywhere(setting))

    return sized


def _asymmetry(random: Random, joint: int, scene: Scene) -> Callable[[float], Hidden]:
    sign = either_sign(random)

    def sized(size: float) -> Hidden:
        coulomb = sign * min(0.4, size * 0.9 * MOTOR_NOISE[joint - 1] / COULOMB[joint - 1])
        viscous = sign * min(0.6, size * 1.8 * MOTOR_NOISE[joint - 1] / VISCOUS[joint - 1])
        setting = trait(joint, forward_coulomb=coulomb, forward_viscous=viscous)
        return Hidden("friction_asymmetry", "motor", (joint,), size, everywhere(setting))

    return sized


def _load(random: Random, joint: int, scene: Scene) -> Callable[[float], Hidden]:
    def sized(size: float) -> Hidden:
        share = size * 2.4 * MOTOR_NOISE[joint - 1] / scene.peaks[joint - 1]
        setting = trait(joint, load_share=share)
        return Hidden("friction_load", "motor", (joint,), size, everywhere(setting), {"factor": share})

    return sized


def _temperature(random: Random, joint: int, scene: Scene) -> Callable[[float], Hidden]:
    between = random.random() < 0.5
    warm = random.permutation((0.0, random.uniform(6.0, 14.0), random.uniform(12.0, 25.0)))

    def sized(size: float) -> Hidden:
        share = size * MOTOR_NOISE[joint - 1] / COULOMB[joint - 1]
        if between:
            settings = tuple(trait(joint, warmth=0.03 * share, start_warm=start) for start in warm)
            return Hidden(
                "friction_temperature",
                "motor",
                (joint,),
                size,
                settings,
                variant="between sessions",
                passing=True,
            )
        # A thin film that warms up within the session by 5 to 15 K.
        power = COULOMB[joint - 1] * 0.35
        setting = trait(joint, warmth=0.08 * share, film_capacity=power / 0.9, film_conductance=power / 12.0)
        return Hidden(
            "friction_temperature", "motor", (joint,), size, everywhere(setting), variant="within a session"
        )

    return sized


def _position(random: Random, joint: int, scene: Scene) -> Callable[[float], Hidden]:
    wave, count = random.random() < 0.7, float(random.integers(1, 4))
    phase, centre, width = (
        random.uniform(-math.pi, math.pi),
        random.uniform(-0.6, 0.6),
        random.uniform(0.15, 0.5),
    )

    def sized(size: float) -> Hidden:
        share = min(0.6, size * 1.4 * MOTOR_NOISE[joint - 1] / COULOMB[joint - 1])
        if wave:
            setting = trait(joint, wave=share, wave_count=count, wave_phase=phase)
        else:
            setting = trait(joint, bump=1.5 * share, bump_centre=centre, bump_width=width)
        variant = f"{count:.0f} waves" if wave else "bump"
        return Hidden("friction_position", "motor", (joint,), size, everywhere(setting), variant=variant)

    return sized


def _presliding(random: Random, joint: int, scene: Scene) -> Callable[[float], Hidden]:
    reach = log_uniform(random, 5e-3, 4e-2)

    def sized(size: float) -> Hidden:
        share = min(0.9, size * 3.0 * MOTOR_NOISE[joint - 1] / COULOMB[joint - 1])
        setting = trait(joint, long_share=share, long_reach=reach)
        return Hidden("presliding_hysteresis", "motor", (joint,), size, everywhere(setting))

    return sized


# ---- drive ----


def _gear_ripple(random: Random, joint: int, scene: Scene) -> Callable[[float], Hidden]:
    twice, phase = bool(random.random() < 0.5), random.uniform(-math.pi, math.pi)
    turns = 160.0 if joint == 5 else 100.0

    def sized(size: float) -> Hidden:
        amplitude = size * 1.5 * MOTOR_NOISE[joint - 1]
        name = "twice" if twice else "once"
        setting = trait(joint, **{f"ripple_{name}": amplitude, f"ripple_{name}_phase": phase})
        truth = {"cycles_per_turn": turns * (2.0 if twice else 1.0), "amplitude": amplitude}
        return Hidden("gear_ripple", "motor", (joint,), size, everywhere(setting), truth, variant=name)

    return sized


def _motor_gain(random: Random, joint: int, scene: Scene) -> Callable[[float], Hidden]:
    sign = either_sign(random)

    def sized(size: float) -> Hidden:
        error = sign * min(0.3, size * 0.025)
        setting = trait(joint, motor_gain=1.0 + error)
        return Hidden(
            "motor_torque_gain",
            "motor",
            (joint,),
            size,
            everywhere(setting),
            {"error": 1.0 / (1.0 + error) - 1.0},
        )

    return sized


def _backlash(random: Random, joint: int, scene: Scene) -> Callable[[float], Hidden]:
    softness = random.uniform(1e-3, 0.06)

    def sized(size: float) -> Hidden:
        play = size * PLAY[joint - 1]
        setting = trait(joint, play=play, play_softness=softness)
        return Hidden("backlash", "joint", (joint,), size, everywhere(setting), {"width": 2.0 * play})

    return sized


def _elasticity(random: Random, joint: int, scene: Scene) -> Callable[[float], Hidden]:
    hardening = random.uniform(0.0, 3e3)

    def sized(size: float) -> Hidden:
        setting = trait(joint, stiffness=1.0 / (1.0 + size), hardening=hardening)
        return Hidden("joint_elasticity", "joint", (joint,), size, everywhere(setting))

    return sized


# ---- links ----


def _cable(random: Random, joint: int, scene: Scene) -> Callable[[float], Hidden]:
    kind = str(random.choice(("hardening", "slack", "rubbing")))
    centre, slack = random.uniform(-0.5, 0.5), random.uniform(0.2, 0.8)

    def sized(size: float) -> Hidden:
        torque = size * 1.4 * JOINT_NOISE[joint - 1]
        if kind == "hardening":
            setting = trait(joint, cable=torque, cable_cubic=0.7 * torque, cable_centre=centre)
        elif kind == "slack":
            setting = trait(joint, cable=2.0 * torque, cable_centre=centre, cable_slack=slack)
        else:
            setting = trait(
                joint,
                cable=1.5 * torque,
                cable_cubic=0.3 * torque,
                cable_centre=centre,
                cable_rub=0.3 * torque,
                cable_reach=0.15,
            )
        return Hidden("cable_spring", "joint", (joint,), size, everywhere(setting), variant=kind)

    return sized


def _tilt(random: Random, joint: int, scene: Scene) -> Callable[[float], Hidden]:
    direction = random.uniform(-math.pi, math.pi)

    def sized(size: float) -> Hidden:
        angle = math.radians(0.18 * size)
        rx, ry = angle * math.cos(direction), angle * math.sin(direction)
        truth = {"tilt_x": rx, "tilt_y": ry}
        return Hidden("base_tilt", "joint", (), size, everywhere(Setting(tilt=(rx, ry))), truth)

    return sized


def _payload_error(random: Random, joint: int, scene: Scene) -> Callable[[float], Hidden]:
    mass, moment = random.uniform(-0.25, 0.25), random.normal(0.0, 0.02, 3)

    def sized(size: float) -> Hidden:
        load = {"mass": size * mass, "moment": [float(v) for v in size * moment]}
        return Hidden(
            "payload_error", "joint", (), size, everywhere(Setting(load=load)), {"mass": size * mass}
        )

    return sized


def _payload_change(random: Random, joint: int, scene: Scene) -> Callable[[float], Hidden]:
    kind = str(random.choice(("drop", "shift", "loose")))
    time_s, direction = scene.moment(random), random.normal(0.0, 1.0, 3)
    direction /= np.linalg.norm(direction)

    def sized(size: float) -> Hidden:
        load: dict[str, object]
        if kind == "drop":
            load = {"mass": -0.02 * size, "moment": [0.0, 0.0, -0.003 * size]}
        elif kind == "shift":
            load = {"moment": [float(v) for v in 0.004 * size * direction]}
        else:
            load = {"rattle": 0.0025 * size}
        loaded = Setting(load={**load, "from_s": time_s})
        after = Setting(load=load)
        truth = {"time": time_s - scene.begin_s}
        return Hidden("payload_change", "joint", (), size, (Setting(), loaded, after), truth, variant=kind)

    return sized


def _zero(random: Random, joint: int, scene: Scene) -> Callable[[float], Hidden]:
    sign = either_sign(random)

    def sized(size: float) -> Hidden:
        angle = sign * math.radians(ZERO_DEG[joint - 1] * size)
        setting = trait(joint, zero=angle)
        # The encoder shows the angle and its zero; a diagnosis states the true angle less the shown one.
        truth = {"offset": -angle}
        return Hidden("joint_zero_offset", "joint", (joint,), size, everywhere(setting), truth)

    return sized


def _eccentric(random: Random, joint: int, scene: Scene) -> Callable[[float], Hidden]:
    angle = random.uniform(0.0, 2.0 * math.pi)

    def sized(size: float) -> Hidden:
        off = math.radians(2.0 * ZERO_DEG[joint - 1] * size)
        setting = trait(joint, eccentric=off, eccentric_angle=angle)
        truth = {"cosine": off * math.sin(angle), "sine": off * math.cos(angle), "cycles_per_turn": 1.0}
        return Hidden("encoder_eccentricity", "joint", (joint,), size, everywhere(setting), truth)

    return sized


def _contact(random: Random, joint: int, scene: Scene) -> Callable[[float], Hidden]:
    direction = random.normal(0.0, 1.0, 3)
    direction /= np.linalg.norm(direction)
    link, length = int(random.integers(4, 8)), random.uniform(0.4, 1.5)
    drag = random.random() < 0.3
    train, test = int(random.integers(0, 2)), SESSIONS - 1
    times = {train: scene.moment(random), test: scene.moment(random)}

    def sized(size: float) -> Hidden:
        settings = [Setting() for _ in range(SESSIONS)]
        for session, time_s in times.items():
            episode = {
                "start_s": time_s,
                "length_s": length,
                "link": link,
                "force": [float(v) for v in (0.0 if drag else 5.0 * size) * direction],
                "stiffness": 8.0 * size if drag else 0.0,
            }
            settings[session] = Setting(contacts=(episode,))
        truth = {"time": times[train] - scene.begin_s + 0.5 * length}
        return Hidden(
            "contact",
            "joint",
            (),
            size,
            tuple(settings),
            truth,
            variant="drag" if drag else "push",
            passing=True,
        )

    return sized


# ---- sensors and timing ----


def _sensor_gain(random: Random, joint: int, scene: Scene) -> Callable[[float], Hidden]:
    sign = either_sign(random)

    def sized(size: float) -> Hidden:
        gain = 1.0 + sign * min(0.3, 4.0 * JOINT_NOISE[joint - 1] / scene.peaks[joint - 1] * size)
        return Hidden(
            "sensor_gain",
            "sensor",
            (joint,),
            size,
            everywhere(fault(joint, gain=gain)),
            {"error": gain - 1.0},
        )

    return sized


def _crosstalk(random: Random, joint: int, scene: Scene) -> Callable[[float], Hidden]:
    others = [other for other in range(1, JOINTS + 1) if other != joint and scene.peaks[other - 1] > 8.0]
    source, sign = int(random.choice(others)), either_sign(random)

    def sized(size: float) -> Hidden:
        share = sign * size * 1.8 * JOINT_NOISE[joint - 1] / scene.peaks[source - 1]
        setting = Setting(leak={joint: {source: share}})
        truth = {"source": float(source), "factor": share}
        return Hidden("sensor_crosstalk", "sensor", (joint,), size, everywhere(setting), truth)

    return sized


def _hysteresis(random: Random, joint: int, scene: Scene) -> Callable[[float], Hidden]:
    share = random.uniform(0.5, 1.0)

    def sized(size: float) -> Hidden:
        width = min(0.4 * scene.peaks[joint - 1], size * 1.2 * JOINT_NOISE[joint - 1])
        setting = fault(joint, play=width / share, play_share=share)
        return Hidden("sensor_hysteresis", "sensor", (joint,), size, everywhere(setting))

    return sized


def _saturation(random: Random, joint: int, scene: Scene) -> Callable[[float], Hidden]:
    # A limit that only the held-out motion reaches is hidden from everybody.
    reached = scene.reached[joint - 1]

    def sized(size: float) -> Hidden:
        clip = reached - min(0.7 * reached, 6.0 * JOINT_NOISE[joint - 1] * size)
        return Hidden(
            "sensor_saturation",
            "sensor",
            (joint,),
            size,
            everywhere(fault(joint, clip=clip)),
            {"limit": clip},
        )

    return sized


def _drift(random: Random, joint: int, scene: Scene) -> Callable[[float], Hidden]:
    kind, sign = str(random.choice(("drift", "creep", "between"))), either_sign(random)
    zeros = random.permutation((-1.0, 0.2, 1.0))
    time_constant = random.uniform(4.0, 12.0)

    def sized(size: float) -> Hidden:
        torque = sign * size * 0.8 * JOINT_NOISE[joint - 1]
        settings = everywhere(fault(joint, drift=2.0 * torque / (PERIODS * PERIOD_S)))
        if kind == "creep":
            settings = everywhere(fault(joint, creep=2.0 * torque, creep_time=time_constant))
        elif kind == "between":
            settings = tuple(fault(joint, zero=torque * float(zero)) for zero in zeros)
        passing = kind == "between"
        return Hidden(
            "sensor_offset_drift", "sensor", (joint,), size, settings, variant=kind, passing=passing
        )

    return sized


def _sensor_ripple(random: Random, joint: int, scene: Scene) -> Callable[[float], Hidden]:
    geared = random.random() < 0.4
    turns = 160.0 if joint == 5 else 100.0
    count = turns * float(random.integers(1, 3)) if geared else float(random.integers(2, 7))
    phase = random.uniform(-math.pi, math.pi)

    def sized(size: float) -> Hidden:
        amplitude = size * 1.5 * JOINT_NOISE[joint - 1]
        setting = fault(joint, ripple=amplitude, ripple_count=count, ripple_phase=phase)
        truth = {"cycles_per_turn": count, "amplitude": amplitude}
        return Hidden(
            "sensor_ripple",
            "sensor",
            (joint,),
            size,
            everywhere(setting),
            truth,
            variant="motor angle" if geared else "joint angle",
        )

    return sized


def _whole(late_s: float) -> float:
    """The lateness in whole samples of the chain, 1 to 40 ms: between two samples it reads a line, which has less
    noise, and that would not be the lateness's own trace.
    """
    return 1e-3 * min(40, max(1, round(1e3 * late_s)))


def _motor_late(random: Random, joint: int, scene: Scene) -> Callable[[float], Hidden]:
    def sized(size: float) -> Hidden:
        late = _whole(4e-3 * size)
        setting = Setting(faults={"motor_late": every([late] * JOINTS)})
        return Hidden("motor_torque_delay", "timing", (), size, everywhere(setting), {"delay": late})

    return sized


def _joint_late(random: Random, joint: int, scene: Scene) -> Callable[[float], Hidden]:
    def sized(size: float) -> Hidden:
        late = _whole(2.5e-3 * size)
        setting = Setting(faults={"late": every([late] * JOINTS)})
        return Hidden("joint_torque_delay", "timing", (), size, everywhere(setting), {"delay": late})

    return sized


def _held(random: Random, joint: int, scene: Scene) -> Callable[[float], Hidden]:
    what, every_s = str(random.choice(("packet", "torque"))), random.uniform(0.8, 3.0)

    def sized(size: float) -> Hidden:
        length_s = min(0.2, (0.008 if what == "packet" else 0.02) * size)
        held = {"every_s": every_s, "length_s": length_s, "what": what}
        settings = everywhere(Setting(held=held))
        return Hidden("lost_samples", "timing", (), size, settings, variant=what, passing=True)

    return sized


_ARM = (0,)

CAUSES: Mapping[str, Cause] = {
    cause.name: cause
    for cause in (
        Cause("stribeck", "motor", _stribeck),
        Cause("viscous_nonlinear", "motor", _viscous),
        Cause("friction_asymmetry", "motor", _asymmetry, absorbed=True),
        Cause("friction_load", "motor", _load),
        Cause("friction_temperature", "motor", _temperature),
        Cause("friction_position", "motor", _position),
        Cause("presliding_hysteresis", "motor", _presliding),
        Cause("gear_ripple", "motor", _gear_ripple),
        Cause("motor_torque_gain", "motor", _motor_gain, absorbed=True),
        Cause("backlash", "joint", _backlash, encoder="motor"),
        Cause("joint_elasticity", "joint", _elasticity, joints=(1, 2, 3, 4, 5), encoder="motor"),
        Cause("cable_spring", "joint", _cable),
        Cause("base_tilt", "joint", _tilt, _ARM),
        Cause("payload_error", "joint", _payload_error, _ARM, absorbed=True),
        Cause("payload_change", "joint", _payload_change, _ARM),
        Cause("joint_zero_offset", "joint", _zero, joints=(2, 3, 4, 5, 6, 7), absorbed=True),
        Cause("contact", "joint", _contact, _ARM),
        Cause("sensor_gain", "sensor", _sensor_gain, absorbed=True),
        Cause("sensor_crosstalk", "sensor", _crosstalk),
        Cause("sensor_hysteresis", "sensor", _hysteresis),
        Cause("sensor_saturation", "sensor", _saturation),
        Cause("sensor_offset_drift", "sensor", _drift),
        Cause("sensor_ripple", "sensor", _sensor_ripple),
        Cause("motor_torque_delay", "timing", _motor_late, _ARM, absorbed=True),
        Cause("joint_torque_delay", "timing", _joint_late, _ARM),
        Cause("lost_samples", "timing", _held, _ARM),
        Cause("encoder_eccentricity", "joint", _eccentric, joints=(2, 3, 4, 5, 6, 7), absorbed=True),
    )
}
"""Causes of the catalogue by name."""
