"""A simulated arm with exactly equations (1) to (4), and sessions of it with imperfect sensors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from pathlib import Path

import numpy as np
import yaml
from scipy.signal import lfilter

from ident.dynamics.kinematics import Chain
from ident.dynamics.parameters import DRIVE, INERTIAL
from ident.dynamics.regressor import torque
from lwr_driver.session import JointColumns, Phase, Session

Array = np.ndarray
States = tuple[Array, Array, Array]

CONFIGS = Path(__file__).resolve().parents[2] / "configs"


@lru_cache
def chain() -> Chain:
    return Chain.from_urdf((CONFIGS / "lwr4plus.urdf").read_text())


@lru_cache
def truth() -> dict[str, float]:
    """All 17 x 7 standard parameters of the arm."""
    content = yaml.safe_load((CONFIGS / "emulator" / "table2.yaml").read_text())
    return {name: float(value) for name, value in content["parameters"].items()}


@lru_cache
def payload() -> dict[str, float]:
    content = yaml.safe_load((CONFIGS / "emulator" / "table2.yaml").read_text())
    return {name: float(value) for name, value in next(iter(content["payloads"].values())).items()}


def inertial(loaded: bool) -> np.ndarray:
    """(7, 10) inertial parameters; the payload is part of link 7 (its frame is frame 7)."""
    table = np.array([[truth()[f"{symbol}{link}"] for symbol in INERTIAL] for link in range(1, 8)])
    if loaded:
        table[6] += [payload()[symbol] for symbol in INERTIAL]
    return table


def drive(symbol: str) -> np.ndarray:
    assert symbol in DRIVE
    return np.array([truth()[f"{symbol}{link}"] for link in range(1, 8)])


def fourier(time: np.ndarray, period_s: float, seed: int, harmonics: int = 5, scale: float = 1.0) -> States:
    """Position, velocity and acceleration (n, 7) of a random Fourier motion."""
    random = np.random.default_rng(seed)
    q = np.tile(random.uniform(-0.5, 0.5, 7), (len(time), 1))
    qd, qdd = np.zeros_like(q), np.zeros_like(q)
    for k in range(1, harmonics + 1):
        w = 2 * np.pi * k / period_s
        a, b = random.normal(size=(2, 7)) * scale * 0.7 / np.sqrt(harmonics)
        s, c = np.sin(w * time)[:, None], np.cos(w * time)[:, None]
        q += a * s + b * c
        qd += w * (a * c - b * s)
        qdd -= w * w * (a * s + b * c)
    return q, qd, qdd


@dataclass(frozen=True)
class Sensors:
    """Noise (std), delay and rates of the channels."""

    position: float = 0.0
    joint: float = 0.0
    motor: float = 0.0
    correlation_s: float = 0.0
    motor_step_s: float = 0.0
    motor_delay_s: float = 0.0
    joint_delay_s: float = 0.0
    lost: tuple[int, ...] = ()
    joint_outliers: tuple[tuple[int, int, float], ...] = ()
    position_outliers: tuple[tuple[int, int, float], ...] = ()


def correlated(random: np.random.Generator, shape: tuple[int, int], dt: float, tau: float) -> np.ndarray:
    """Unit-variance noise: white, or an AR(1) process of correlation time tau [s]."""
    white = random.normal(size=shape)
    if tau <= 0:
        return white
    rho = float(np.exp(-dt / tau))
    start = random.normal(size=(1, shape[1]))
    return lfilter([np.sqrt(1 - rho**2)], [1, -rho], white, axis=0, zi=rho * start)[0]


def torques(q: Array, qd: Array, qdd: Array, loaded: bool) -> tuple[np.ndarray, np.ndarray]:
    """Joint and motor torques (n, 7) of equations (1) to (4)."""
    joint = torque(chain(), q, qd, qdd, inertial(loaded))
    joint = joint + drive("Fvl") * qd + drive("Fcl") * np.sign(qd) + drive("offl")
    motor = drive("Ia") * qdd + joint + drive("Fvm") * qd + drive("Fcm") * np.sign(qd) + drive("offm")
    return joint, motor


def session(
    *,
    loaded: bool = False,
    seed: int = 1,
    rate_hz: float = 250.0,
    period_s: float = 10.0,
    periods: int = 2,
    run_in_s: float = 3.0,
    sensors: Sensors | None = None,
    motor: bool = True,
    motion_seed: int = 5,
    phases: bool = True,
    still: tuple[int, ...] = (),
    command: bool = False,
    metadata: dict[str, str] | None = None,
) -> Session:
    """A session of several periods with a run-in and a run-out."""
    sensors = sensors or Sensors()
    random = np.random.default_rng(seed)
    dt = 1.0 / rate_hz
    count = round((periods * period_s + 2 * run_in_s) * rate_hz) + 1
    time = np.arange(count) * dt

    def motion(at: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        states = fourier(at - run_in_s, period_s, motion_seed)
        for joint in still:
            states[0][:, joint], states[1][:, joint], states[2][:, joint] = 0.1, 0.0, 0.0
        return states

    q = motion(time)[0]
    joint_torque, _ = torques(*motion(time - sensors.joint_delay_s), loaded)
    position = q + sensors.position * random.normal(size=q.shape)
    joint_torque = joint_torque + sensors.joint * correlated(random, q.shape, dt, sensors.correlation_s)
    for row, column, value in sensors.joint_outliers:
        joint_torque[row, column] += value
    for row, column, value in sensors.position_outliers:
        position[row, column] += value
    keep = np.setdiff1d(np.arange(count), np.array(sensors.lost, dtype=int))
    names = chain().joint_names
    joint = _columns("/joint_states", names, time[keep], keep, position[keep], joint_torque[keep])
    motor_columns = None
    if motor:
        step = sensors.motor_step_s or dt
        when = np.arange(0.0, time[-1], step)
        effort = torques(*motion(when), loaded)[1]
        effort = effort + sensors.motor * correlated(random, effort.shape, step, sensors.correlation_s)
        stamps = when + sensors.motor_delay_s
        motor_columns = _columns("/motor_states", names, stamps, np.arange(len(when)), effort[:, :0], effort)
    marks: tuple[Phase, ...] = ()
    if phases:
        begin = [(0.0, "excitation")]
        begin += [(run_in_s + k * period_s, f"period {k + 1}") for k in range(periods)]
        begin += [(run_in_s + periods * period_s, "brake")]
        marks = tuple(Phase(_ns(at), name) for at, name in begin)
    content = {"payload": "payload" if loaded else "none", "robot": "test arm"} | (metadata or {})
    sent = None
    if command:
        sent = _columns("/joint_command", names, time, np.arange(count), q, q[:, :0])
    name = "loaded" if loaded else "unloaded"
    return Session(
        Path(f"{name}.mcap"), content, {"exit_status": "success"}, names, joint, motor_columns, sent, marks
    )


def _ns(time_s: float) -> int:
    return 1_700_000_000_000_000_000 + round(time_s * 1e9)


def _columns(
    topic: str, names: Sequence[str], time: Array, sequence: Array, position: Array, effort: Array
) -> JointColumns:
    publish = np.rint(time * 1e9).astype(np.int64)
    return JointColumns(
        topic=topic,
        names=tuple(names),
        log_time=publish + _ns(0.0),
        publish_time=publish,
        sequence=sequence.astype(np.int64) + 1,
        position=position,
        velocity=np.zeros((len(time), 0)),
        effort=effort,
    )


def true_base(identification: object) -> Array:
    """True base parameters of an identification of this arm."""
    base = identification.base  # type: ignore[attr-defined]
    values = []
    for name in base.structure.names:
        link = int(name[-1])
        values.append(truth()[name] if link < 8 else payload().get(name[:-1], 0.0))
    return np.asarray(base.reduce(np.array(values)))


STIFFNESS = (1e4,) * 7


at_125_hz = partial(session, rate_hz=125.0)
"""A session of half as many samples, where their number does not matter."""


def at_the_motors(one: Session) -> Session:
    """The session with the positions that encoders at the motors of joints of this stiffness read."""
    position = one.joint.position + one.joint.effort / np.array(STIFFNESS)
    return replace(one, joint=replace(one.joint, position=position))
