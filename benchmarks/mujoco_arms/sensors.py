"""What the arm's electronics make of a motion: encoders, torque channels, and clocks."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.signal import butter, lfilter, lfiltic

from benchmarks.mujoco_arms.arms import Individual
from benchmarks.mujoco_arms.simulation import RECORD_S, Truth

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Torque:
    """A torque channel, values per joint. gain, zero [Nm], noise [Nm], quantum [Nm]; delay, low-pass of it all.

    leak : (n, n) torque of other joints that leaks in. play : half width of its hysteresis [Nm]
    limit : where it clips [Nm]. ripple, cycles, phase : error periodic in the joint angle [Nm]
    drift : [Nm/s]. hum [Nm] at hum_hz, as sampled. inertia : error per acceleration [Nm s2/rad]
    bend : gain lost per torque [1/Nm]. steps : change of the zero in the middle [Nm]. jitter : of its clock [s]
    """

    gain: Floats
    zero: Floats
    noise: Floats
    quantum: Floats
    delay: float
    cutoff: float
    leak: Floats
    play: Floats
    limit: Floats
    ripple: Floats
    cycles: Floats
    phase: Floats
    drift: Floats
    hum: Floats
    inertia: Floats
    bend: Floats
    steps: Floats
    jitter: float = 0.0
    hum_hz: float = 1.0


@dataclass(frozen=True)
class Encoder:
    """Position channel: quantum and noise [rad]; zero, and errors with one and two cycles a turn [rad]."""

    quantum: float
    noise: float
    zero: Floats
    once: Floats
    twice: Floats
    phase: Floats


@dataclass(frozen=True)
class Loss:
    """Samples held (the value before again) or dropped: share of the time, length [s]; empty shares: none."""

    what: str = "none"
    share: float = 0.0
    length: float = 0.02


@dataclass(frozen=True)
class Sensing:
    """All channels of an arm on one day."""

    encoder: Encoder
    motor: Torque
    joint: Torque
    loss: Loss = Loss()


@dataclass(frozen=True)
class Label:
    """What the log says of a session: payload and its announced mass [kg]."""

    payload: str = "none"
    mass: float | None = None


def torque_channel(arm: Individual, side: str, random: np.random.Generator) -> Torque:
    """A healthy channel on a day: gains and zeros within a per cent, delays of milliseconds."""
    n, effort = arm.kind.size, arm.kind.effort
    motor = side == "motor"
    none = np.zeros(n)
    return Torque(
        gain=random.uniform(0.99, 1.01, n),
        zero=random.uniform(-0.004, 0.004, n) * effort,
        noise=(0.003 if motor else 0.0008) * effort * random.uniform(0.7, 1.3, n),
        quantum=effort / (2048.0 if motor else 16384.0),
        delay=random.uniform(0.001, 0.004) if motor else random.uniform(0.0, 0.001),
        cutoff=200.0 if motor else 300.0,
        leak=np.zeros((n, n)),
        play=none,
        limit=np.full(n, np.inf),
        ripple=none,
        cycles=np.ones(n),
        phase=none,
        drift=none,
        hum=none,
        inertia=none,
        bend=none,
        steps=none,
    )


def sense(
    arm: Individual, sensing: Sensing, truth: Truth, random: np.random.Generator
) -> tuple[Floats, Floats, Floats, Floats, Floats]:
    """Times of the samples, positions, joint torques, times of the motor torques, motor torques."""
    encoder = sensing.encoder
    grid = np.arange(len(truth)) * RECORD_S
    times = np.arange(0.0, grid[-1], 1.0 / arm.rate)
    shaft = truth.link if arm.encoder == "link" else truth.motor
    angle = shaft + encoder.zero
    angle = angle + encoder.once * np.sin(shaft + encoder.phase) + encoder.twice * np.sin(2.0 * shaft)
    q = _at(times, grid, angle) + random.normal(0.0, encoder.noise, (len(times), arm.kind.size))
    q = np.round(q / encoder.quantum) * encoder.quantum
    joint = _torque(sensing.joint, truth.joint, truth, grid, times, random)
    late = times[:: arm.motor_divider]
    motor = _torque(sensing.motor, truth.drive, truth, grid, late, random)
    return times, q, joint, late, motor


def _torque(
    channel: Torque, torque: Floats, truth: Truth, grid: Floats, times: Floats, random: np.random.Generator
) -> Floats:
    value = torque * (1.0 - channel.bend * np.abs(torque)) + torque @ channel.leak.T
    if channel.inertia.any():
        speed = np.gradient(truth.link, RECORD_S, axis=0)
        value = value + channel.inertia * np.gradient(speed, RECORD_S, axis=0)
    for j in np.flatnonzero(channel.play):
        value[:, j] = _play(value[:, j], channel.play[j])
    value = channel.gain * value + channel.zero + channel.drift * grid[:, None]
    value += channel.steps * (grid[:, None] > 0.5 * grid[-1])
    value += channel.ripple * np.sin(channel.cycles * truth.link + channel.phase)
    value += channel.hum * np.sin(2.0 * np.pi * channel.hum_hz * grid[:, None])
    b, a = butter(1, channel.cutoff, fs=1.0 / RECORD_S)
    for j in range(value.shape[1]):
        value[:, j] = lfilter(b, a, value[:, j], zi=lfiltic(b, a, value[:1, j], value[:1, j]))[0]
    # The filter's own delay counts as part of the channel's.
    own = 1.0 / (2.0 * np.pi * channel.cutoff)
    when = times - channel.delay + own + random.normal(0.0, 1.0, len(times)) * channel.jitter
    value = _at(when, grid, value) + random.normal(0.0, 1.0, (len(times), value.shape[1])) * channel.noise
    value = np.clip(value, -channel.limit, channel.limit)
    return np.asarray(np.round(value / channel.quantum) * channel.quantum)


def _at(times: Floats, grid: Floats, values: Floats) -> Floats:
    return np.column_stack([np.interp(times, grid, column) for column in values.T])


def _play(value: Floats, half: float) -> Floats:
    """Backlash operator: the output follows when the input has crossed the play."""
    out = np.empty_like(value)
    y = value[0]
    for k, x in enumerate(value):
        y = min(max(y, x - half), x + half)
        out[k] = y
    return out


def lose(
    loss: Loss,
    times: Floats,
    late: Floats,
    q: Floats,
    joint: Floats,
    motor: Floats,
    rate: float,
    random: np.random.Generator,
) -> tuple[NDArray[np.bool_], Floats, Floats, Floats]:
    """`dropped`: rows are missing. `held`: the torques stay for a while."""
    keep = np.ones(len(times), dtype=bool)
    length = max(loss.length, 1.0 / rate)
    count = max(1, round(loss.share * times[-1] / length))
    begins = random.uniform(0.5, times[-1] - 0.5, count)
    if loss.what == "dropped":
        for begin in begins:
            keep[(times >= begin) & (times < begin + length)] = False
        return keep, q, joint, motor
    for clock, values in ((times, joint), (late, motor)):
        for begin in begins:
            rows = np.flatnonzero((clock >= begin) & (clock < begin + length))
            if len(rows) and rows[0]:
                values[rows] = values[rows[0] - 1]
    return keep, q, joint, motor
