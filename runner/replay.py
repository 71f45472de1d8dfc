"""Replay of a session in simulation: the arm of a model along the measured positions, measured minus simulated.

The arm is the emulator's plant with the links, drives and effects of the model. No controller of a real arm enters:

- *Torques*: the simulated arm is led along the measured positions by a stiff spring and damper at its motors (20 Hz);
  the torques that it needs are compared with the measured ones. Near standstill a motor torque may be anything within
  the friction, so it is left out there.
- *Position*: the simulated motors get the measured motor torques, and a soft spring and damper (3 Hz) about the
  measured positions, because an arm under given torques alone drifts away. A torque error `e` of the model at low
  frequencies moves the joint by `e / (J w^2)`, with its inertia `J` and the angular frequency `w` of the spring.

Spring and damper are made from the inertia of the first model and are those of each further one, so two models differ
by their physics alone. The sensors are without noise. The replay runs in this process, faster than the session.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pinocchio as pin
import yaml
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.ndimage import maximum_filter1d

from fri.errors import ConfigurationError, DataError
from ident.diagnosis import SimulationError
from ident.dynamics.structure import EncoderSide
from ident.model import DynamicModel
from ident.model.signals import positions_of_motors
from ident.rows.filters import low_pass, median_step
from ident.rows.sessions import payload_name
from lwr_driver.configuration import parse
from lwr_driver.session import Session
from runner.experiment_file import Experiment
from sim_backend.model_arm import ModelEffect, arm_of, is_possible, links_of, model_effects
from sim_backend.plant import CYCLE_S, ElasticArm, PlantEffect, Reading
from sim_backend.robot import Drive

Floats = NDArray[np.float64]

METHOD = {
    "torques": "simulated arm led along the measured positions; motor torques without standstill",
    "position": "simulated arm under the measured motor torques, held by a 3 Hz spring about the measured positions",
}
"""The simulation behind each error, in words."""

_BIN = 20
_BEGIN = 500
# Shortest simulated part of one of many sessions.
_SHORTEST_S = 10.0
# Cycles from one look for an unstable arm to the next.
_CHECKED = 100
_POSES = 100
_PATH_HZ, _TWIST_HZ = 20.0, 12.0
# Measured positions in use before and after a simulated part.
_AROUND_NS = 5_000_000_000
_LED_HZ, _HELD_HZ = 20.0, 3.0
# Speed below which a drive may stick [rad/s], and time around it [s]: positions then tell nothing of the friction.
_SLOW, _AROUND_S = 0.01, 0.05
# Joints of unknown stiffness, and rigid ones, ring at this frequency, with this damping ratio.
_STIFF_HZ, _DAMPING = 40.0, 0.03
# Drives of a model without motor side: inertia over that of the links.
_ROTOR = 0.3


@dataclass(frozen=True, eq=False)
class Replayed:
    """Measured minus simulated, in means over 20 ms: position (m, n) [rad], motor and joint torque [Nm].

    position, motor : None without motor torques in the log or in the model; motor : NaN near standstill. inertia : (n,)
    of the spring and damper [kg m^2]. exact : whether the model itself was simulated, or the nearest physically
    possible one. stiff : whether the stiffness of the joints is unknown. duration_s : of the compared part. measured :
    (m, n) positions [rad]. begin_s : of the compared part, from the start of the session.
    """

    position: Floats | None
    motor: Floats | None
    joint: Floats | None
    inertia: Floats
    exact: bool
    stiff: bool
    duration_s: float
    measured: Floats
    begin_s: float

    @property
    def time(self) -> Floats:
        """(m,) middle of the means, from the start of the session [s]."""
        return np.asarray(
            self.begin_s + (np.arange(len(self.measured)) + 0.5) * _BIN * CYCLE_S, dtype=np.float64
        )


class Replay:
    """Replays sessions; call it with a model and sessions.

    stiffness : (n,) of the joints [Nm/rad], as of `replay`. sessions : all of the diagnosis, for their numbers.
    longest_s : longest simulated part of a session, extended for an effect at a later moment. together_s : of all of
    them: of many sessions shorter parts are simulated, of very many only some, evenly chosen. encoder : side of the
    elastic joints with the published positions, None: as the model takes them. first : by call, the first replayed
    session and its replay.
    """

    def __init__(
        self,
        stiffness: Floats | None,
        sessions: Sequence[Session] = (),
        *,
        longest_s: float = 60.0,
        together_s: float = 180.0,
        encoder: EncoderSide | None = None,
    ) -> None:
        self.stiffness = stiffness
        self.longest_s, self.together_s = longest_s, together_s
        self.encoder = encoder
        self._failed: dict[str, dict[str, None]] = {}
        self._undriven: dict[str, None] = {}
        self._stood_in: dict[str, None] = {}
        self._stiff: dict[str, None] = {}
        self._shortened = ""
        self._order = sorted(session.start for session in sessions)
        self._inertia: dict[int, Floats] = {}
        self.first: list[tuple[str, Replayed]] = []

    def __call__(self, model: DynamicModel, sessions: Sequence[Session]) -> SimulationError | None:
        """Error over all sessions; None if none can be simulated."""
        n = model.structure.chain.n
        squares, count = np.zeros((3, n)), np.zeros((3, n))
        done: Replayed | None = None
        chosen, longest_s = self._parts(sessions)
        for session in chosen:
            name = session.path.name
            number = self._order.index(session.start) if session.start in self._order else None
            try:
                done = replay(
                    model,
                    session,
                    longest_s,
                    stiffness=self.stiffness,
                    encoder=self.encoder or ("motor" if positions_of_motors(model) else "link"),
                    number=number,
                    inertia=self._inertia.get(session.start),
                )
            except (DataError, ConfigurationError) as error:
                self._failed.setdefault(str(error), {})[name] = None
                continue
            self._inertia.setdefault(session.start, done.inertia)
            if not np.any(count):
                self.first.append((name, done))
            for flag, names in (
                (done.position is None, self._undriven),
                (not done.exact, self._stood_in),
                (done.stiff, self._stiff),
            ):
                if flag:
                    names[name] = None
            for k, part in enumerate((done.position, done.motor, done.joint)):
                if part is not None:
                    squares[k] += np.nansum(part**2, axis=0)
                    count[k] += np.isfinite(part).sum(axis=0)
        if not np.any(count):
            return None
        rms = [
            np.sqrt(s / np.where(c > 0.0, c, np.nan)) if c.any() else None
            for s, c in zip(squares, count, strict=True)
        ]
        return SimulationError(position=rms[0], motor=rms[1], joint=rms[2], method=METHOD)

    def _parts(self, sessions: Sequence[Session]) -> tuple[list[Session], float]:
        """The sessions to simulate, and the longest part of each [s]."""
        longest_s = min(self.longest_s, max(self.together_s / max(len(sessions), 1), _SHORTEST_S))
        most = max(int(self.together_s / longest_s), 1)
        chosen = list(sessions)
        if len(sessions) > most:
            chosen = [sessions[k] for k in np.linspace(0, len(sessions) - 1, most).round().astype(int)]
        if longest_s < self.longest_s:
            number = (
                f"{len(chosen)} of {len(sessions)} sessions"
                if len(chosen) < len(sessions)
                else "each session"
            )
            self._shortened = f"replay of at most the first {longest_s:.0f} s of {number}, for time"
        return chosen, longest_s

    @property
    def notes(self) -> tuple[str, ...]:
        """Sessions left out and reasons, and other limits of the replay, a sentence each."""
        found = [self._shortened] if self._shortened else []
        found += [f"no simulation of {', '.join(names)}: {reason}" for reason, names in self._failed.items()]
        if self._undriven:
            found.append(
                f"replay of {', '.join(self._undriven)}: no motor torques in the log or in the model, so there is no "
                "simulated position, only joint torques along the measured positions"
            )
        if self._stiff:
            found.append(
                f"replay of {', '.join(self._stiff)}: the stiffness of the joints is unknown; the simulated ones ring "
                f"at {_STIFF_HZ:g} Hz. Name the description of the arm with --arm"
            )
        if self._stood_in:
            found.append(
                f"replay of {', '.join(self._stood_in)}: no real bodies have the parameters of the simulated model, so "
                "the nearest real ones were simulated; a more exciting motion would improve the estimate"
            )
        return tuple(found)


def replay(
    model: DynamicModel,
    session: Session,
    longest_s: float,
    *,
    stiffness: Floats | None = None,
    encoder: EncoderSide = "link",
    number: int | None = None,
    inertia: Floats | None = None,
) -> Replayed:
    """Simulate a session from the beginning of its excitation.

    stiffness : (n,) of the joints [Nm/rad], infinite for a stiff one, None: all stiff. encoder : side with the
    published positions. number : of the session in the diagnosis, from 0. inertia : (n,) of spring and damper
    [kg m^2]; None: of this model.
    Raises DataError for a model of no possible arm, and for a session without positions.
    """
    chosen = session.select(model.structure.chain.joint_names)
    if not len(chosen.joint):
        raise DataError("the session holds no positions")
    joint = chosen.joint
    spans = chosen.spans("period") or ((chosen.start, int(joint.log_time[-1])),)
    start, stop = max(int(spans[0][0]), int(joint.log_time[0])), int(spans[-1][1])
    latest = max((float(e["parameters"]["time"]["value"]) for e in _events(model, number)), default=0.0)
    stop = min(stop, int(joint.log_time[-1]), start + int(max(longest_s, latest + longest_s / 2.0) * 1e9))
    grid = np.arange(start, stop, int(CYCLE_S * 1e9))
    if len(grid) < _BEGIN + 2 * _BIN:
        raise DataError(
            f"positions of less than {(_BEGIN + 2 * _BIN) * CYCLE_S:g} s; record a longer session"
        )
    bench = _Bench(model, chosen, stiffness, encoder, number, (start - chosen.start) * 1e-9, inertia)
    path = _smooth(joint.log_time, joint.position, grid)
    led = bench.led(path)
    _, motor, link = bench.run(led, _LED_HZ)
    used, times = slice(_BEGIN, None), grid[_BEGIN:]
    position_error = motor_error = joint_error = None
    if chosen.motor is not None and chosen.motor.effort.shape[1] and "motor" in model.structure.sides:
        driven = _resampled(chosen.motor.log_time, chosen.motor.effort, grid)
        motor_error = _binned(np.where(_sticking(path), np.nan, driven - motor)[used])
        position, _, _ = bench.run(led, _HELD_HZ, driven)
        position_error = _binned((_resampled(joint.log_time, joint.position, grid) - position)[used])
    if joint.effort.shape[1] and "joint" in model.structure.sides:
        joint_error = _binned(_resampled(joint.log_time, joint.effort, times) - link[used])
    errors = position_error, motor_error, joint_error
    measured = _binned(_resampled(joint.log_time, joint.position, times))
    begin_s = (int(times[0]) - chosen.start) * 1e-9
    return Replayed(
        *errors, bench.inertia, bench.exact, stiffness is None, len(times) * CYCLE_S, measured, begin_s
    )


@dataclass(frozen=True)
class _Led:
    """Motion of the motors and the torque for it.

    start, start_rate : (n,) of the links [rad, rad/s]. rigid : (N, n) torque of links and rotors [Nm].
    target, target_rate : (N, n) of the motors [rad, rad/s]. way : (N, n) sign of the rate, less near standstill.
    """

    start: Floats
    start_rate: Floats
    rigid: Floats
    target: Floats
    target_rate: Floats
    way: Floats


class _Bench:
    """A simulated arm led by springs and dampers at its motors, made for one session."""

    def __init__(
        self,
        model: DynamicModel,
        session: Session,
        stiffness: Floats | None,
        encoder: EncoderSide,
        number: int | None,
        begin_s: float,
        inertia: Floats | None,
    ) -> None:
        n = model.structure.chain.n
        if stiffness is not None and len(stiffness) != n:
            raise DataError(f"the description of the arm has {len(stiffness)} joints, the model {n}")
        if model.structure.couplings:
            raise DataError("coupled drives are not simulated")
        payload = payload_name(session)
        known = payload if payload in model.structure.payloads else None
        self.at_motor = encoder == "motor"
        self.number, self.begin_s, self.model = number, begin_s, model
        poses = session.joint.position[:: max(1, len(session.joint) // _POSES)]
        self.exact = is_possible(model, poses)
        zero = np.zeros(n)
        missing = Drive(np.ones(n), zero, zero, zero, zero, zero, zero, np.ones(n), zero)
        self.links, drive = arm_of(
            model,
            links_of(model.structure.chain),
            known,
            stiffness=np.ones(n),
            damping=zero,
            poses=poses,
            motors=missing,
        )
        data = self.links.createData()
        masses = np.array([np.diag(pin.crba(self.links, data, pose)) for pose in poses])
        mass = np.asarray(masses.mean(axis=0))
        if "motor" not in model.structure.sides:
            drive = replace(drive, Ia=_ROTOR * mass)
        hard = masses.max(axis=0) * (2.0 * np.pi * _STIFF_HZ) ** 2
        hard = hard if stiffness is None else np.where(np.isfinite(stiffness), stiffness, hard)
        self.drive = replace(drive, stiffness=hard, damping=2.0 * _DAMPING * np.sqrt(hard * mass))
        self.inertia = mass + drive.Ia if inertia is None else inertia

    def led(self, path: Floats) -> _Led:
        """What leads the arm along `path` (N, n), of the links."""
        rate = np.gradient(path, CYCLE_S, axis=0)
        rigid, target = self._rigid(path, rate)
        # In the middle of each cycle.
        target_rate = np.diff(target, axis=0, append=2.0 * target[-1:] - target[-2:-1]) / CYCLE_S
        return _Led(path[0], rate[0], rigid, target, target_rate, np.clip(target_rate / _SLOW, -1.0, 1.0))

    def run(self, led: _Led, hertz: float, torque: Floats | None = None) -> tuple[Floats, Floats, Floats]:
        """Noiseless position, motor and joint torque (N, n) along a path, as published and reported.

        hertz : of spring and damper. torque : (N, n) of the motors, as measured; None: that of the model on the path.
        """
        effects = model_effects(self.model, session=self.number, begin_s=self.begin_s)
        pull, damper = self.inertia * (2.0 * np.pi * hertz) ** 2, _Damper(4.0 * np.pi * hertz * self.inertia)
        plant = ElasticArm(self.links, self.drive, effects=[*effects, damper])
        plant.reset(led.start)
        plant.velocity[:] = plant.motor_velocity[:] = led.start_rate
        answering = [effect for effect in effects if torque is None or not _late(effect)]
        count, n = led.target.shape
        reading, out, own = Reading(*np.zeros((4, n))), np.zeros((3, count, n)), np.zeros(n)
        drag = damper.drag * led.target_rate
        for k in range(count):
            time_s = k * CYCLE_S
            published = plant.motor_position if self.at_motor else plant.position
            reading.position[:], reading.motor_position[:] = published, plant.motor_position
            reading.joint_torque[:], reading.motor_torque[:] = plant.joint_torque, own
            for effect in effects:
                effect.sense(time_s, plant, reading)
            for effect in answering:
                effect.sense_motor(time_s, plant, reading)
            out[0, k], out[1, k], out[2, k] = reading.position, reading.motor_torque, reading.joint_torque
            away = led.target[k] - plant.motor_position - (reading.position - published)
            if torque is None:
                given = led.rigid[k] + damper.resistance(plant, led.target_rate[k], led.way[k])
            else:
                # The arm gets the torques as they were before the errors of their measurement.
                given = torque[k] - (reading.motor_torque - own)
            before = plant.motor_velocity.copy()
            applied = given + pull * away + drag[k]
            plant.step(applied)
            own = applied - 0.5 * damper.drag * (before + plant.motor_velocity)
            # What is not finite stays so.
            if (k % _CHECKED == 0 or k == count - 1) and not np.all(np.isfinite(plant.position)):
                raise DataError("the simulated arm became unstable; the parameters are physically impossible")
        return out[0], out[1], out[2]

    def _rigid(self, path: Floats, rate: Floats) -> tuple[Floats, Floats]:
        """Torque (N, n) of links and rotors along a path without friction, and positions (N, n) of the motors."""
        data, acceleration = self.links.createData(), np.gradient(rate, CYCLE_S, axis=0)
        links = np.array(
            [pin.rnea(self.links, data, *row).copy() for row in zip(path, rate, acceleration, strict=True)]
        )
        twist = low_pass(links / self.drive.stiffness, CYCLE_S, _TWIST_HZ)
        return links + self.drive.Ia * acceleration, path if self.at_motor else path + twist


class _Damper(PlantEffect):
    """Dampers between the motors and their targets; the part at the motors' speed is integrated with the friction.

    drag : (n,) [Nm s/rad].
    """

    def __init__(self, drag: Floats) -> None:
        self.drag = drag

    def load(self, time_s: float, plant: Any, loads: Any) -> None:
        """Adds the drag to the friction of the drives."""
        loads.Fvm += self.drag

    def resistance(self, plant: ElasticArm, rate: Floats, way: Floats) -> Floats:
        """Torque (n,) against friction and effects, with those of the last cycle.

        rate : (n,) speed of the motors [rad/s]. way : (n,) its sign, less near standstill.
        """
        loads = plant.loads
        viscous = plant.drive.Fvm + loads.Fvl if plant.cycles == 0 else loads.Fvm - self.drag + loads.Fvl
        coulomb, offset = loads.Fcm + loads.Fcl, loads.offm + loads.offl
        return np.asarray(viscous * rate + coulomb * way + offset - loads.motor_torque - loads.link_torque)


def _sticking(path: Floats) -> NDArray[np.bool_]:
    """Samples (N, n) with a drive near standstill."""
    slow = np.abs(np.gradient(path, CYCLE_S, axis=0)) < _SLOW
    near: NDArray[np.bool_] = maximum_filter1d(slow, 2 * round(_AROUND_S / CYCLE_S) + 1, axis=0)
    return near


def _late(effect: ModelEffect) -> bool:
    return effect.part.effect.channel is not None


def _events(model: DynamicModel, number: int | None) -> list[dict[str, Any]]:
    """Entries of effects at a moment of this session."""
    found = []
    for entry in model.effects:
        parameters = entry["parameters"]
        if "time" in parameters and "session" in parameters:
            own = round(float(parameters["session"]["value"])) - 1
            if own == number:
                found.append(dict(entry))
    return found


def attached_experiment(session: Session) -> Experiment | None:
    """The experiment of a session, from the file in its log; None without a readable one."""
    text = session.attachments.get("experiment.yaml")
    try:
        return None if text is None else parse(Experiment, yaml.safe_load(text), "experiment.yaml")
    except (ConfigurationError, yaml.YAMLError) as error:
        logging.getLogger(__name__).info("%s: %s", session.path.name, error)
        return None


def _smooth(times: NDArray[np.int64], position: Floats, grid: NDArray[np.int64]) -> Floats:
    """Measured positions as a smooth path (N, n)."""
    first, last = np.searchsorted(times, grid[[0, -1]] + np.array([-_AROUND_NS, _AROUND_NS]))
    times, position = times[first:last], position[first:last]
    here = (times - times[0]) * 1e-9
    step = median_step(here)
    even = np.arange(0.0, here[-1], step)
    values = np.column_stack([np.interp(even, here, column) for column in position.T])
    values = low_pass(values, step, min(_PATH_HZ, 0.2 / step))
    return np.asarray(CubicSpline(even, values)((grid - times[0]) * 1e-9))


def _resampled(times: NDArray[np.int64], values: Floats, wanted: NDArray[np.int64]) -> Floats:
    base = int(wanted[0])
    at, here = (wanted - base) * 1e-9, (times - base) * 1e-9
    return np.column_stack([np.interp(at, here, column) for column in values.T])


def _binned(values: Floats) -> Floats:
    count = len(values) // _BIN * _BIN
    return values[:count].reshape(-1, _BIN, values.shape[1]).mean(axis=1)
