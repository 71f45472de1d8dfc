"""Ordinary cycles of a cabinet worked out beforehand, many at once.

In a motion in position control nearly every cycle is like the one before it: the answer comes, the setpoint goes on,
the KRL program writes its variables. `CabinetAhead` works such cycles out for answers known beforehand: setpoints and
packets as arrays, the milliseconds of the arm by compiled code with the very functions of `Cabinet`. Nothing changes
before `take`. The KRL program runs there, at its times, with all values as they are then; if it does more than write
the variables of the interface, the cycles end with it.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from fri.krc import KRL, CyclesAhead
from fri.packets import MSR, raw
from sim_backend import bodies
from sim_backend.cabinet import Cabinet
from sim_backend.controller import differences, externals, feedback, poses
from sim_backend.monitor import CommandMonitor
from sim_backend.plant import CYCLE_S, ElasticArm, predict
from sim_backend.sensors import read, read_motor
from sim_backend.stiction import advance

# Rows of the arm's state, (19, n): the plant's state, torques and last velocity, the controller's memory, the sensors,
# the controller's torque, the point in the middle of the cycle, and energy with the number of descents.
_STATE, _TORQUE, _MOTOR, _BEFORE, _MEMORY, _READING = slice(0, 4), 4, 5, 6, slice(7, 11), slice(11, 15)
_COMMAND, _MIDDLE, _ENERGY = 15, slice(16, 18), 18
_ROWS, _DESCENTS = 19, 3


@njit(cache=True)
def _millisecond(work, modes, now, arm, controller, table, settings, gravity, mass, bias):  # type: ignore[no-untyped-def]
    """A millisecond, as by `Cabinet`: sensors, controller, motion of the joints.

    work, modes : the state, see above. now : noise (3 rows), setpoint. arm, controller : chains of bodies
    table : gains of the controller (7 rows), settings of the sensors (8), inertia, stiffness and damping of the joints
    (3), friction (6). settings : the controller's four, cycle [s], substeps, whether the sensors are on the link side
    gravity, mass, bias : room for the bodies' torques and mass matrix
    """
    reading, middle, cycle = work[11:15], work[16:18], settings[4]
    position = work[2] if settings[6] > 0.0 else work[0]
    read(position, work[0], work[4], table[7:15], now[0:3], reading)
    for i in range(bias.shape[0]):
        bias[i] = 0.0
    bodies.torques(controller, now[3], bias, gravity)
    feedback(now[3], gravity, reading[1], reading[2], table[0:7], work[7:11], settings[0:4], work[15])
    read_motor(work[5], work[15], table[7:15], now[0:3], reading)
    for i in range(bias.shape[0]):
        work[5, i] = work[15, i]
    predict(work[2], work[3], work[6], 0.5 * cycle, middle)
    bodies.mass_matrix(arm, middle[0], mass)
    bodies.torques(arm, middle[0], middle[1], bias)
    joint, friction, substeps = table[15:18], table[18:24], int(settings[5])
    work[18, 3] += advance(
        work[0:4], modes, mass, bias, work[5], joint, friction, cycle, substeps, work[4], work[18]
    )


@njit(cache=True)
def _run(work, modes, drive, arm, controller, table, settings, gravities, past, past_modes):  # type: ignore[no-untyped-def]
    """Milliseconds in turn; `past`, `past_modes` keep the state after each, `gravities` its gravity torque."""
    n = work.shape[1]
    mass, bias = np.empty((n, n)), np.empty(n)
    for k in range(drive.shape[0]):
        _millisecond(work, modes, drive[k], arm, controller, table, settings, gravities[k], mass, bias)
        for row in range(work.shape[0]):
            for i in range(n):
                past[k, row, i] = work[row, i]
        for i in range(n):
            past_modes[k, 0, i], past_modes[k, 1, i] = modes[0, i], modes[1, i]


class ArmAhead:
    """The arm of a cabinet over the milliseconds to come: setpoints (k, n) [rad] -> `past`, `past_modes` of each."""

    def __init__(self, cabinet: Cabinet, setpoints: np.ndarray) -> None:
        plant, controller = cabinet.plant, cabinet.controller
        assert isinstance(plant, ElasticArm)
        self._cabinet, self._plant = cabinet, plant
        count, n = setpoints.shape
        self.gravity, self.past = np.empty((count, n)), np.empty((count, _ROWS, n))
        self.past_modes = np.empty((count, 2, n), dtype=np.int64)
        drive = np.concatenate([cabinet.sensors.noise(count), setpoints[:, np.newaxis]], axis=1)
        table = np.concatenate([controller.gains, cabinet.sensors.settings, plant.joint, plant.friction])
        link_side = float(cabinet.sensors.link_side)
        settings = np.array([*controller.settings, plant.cycle_s, plant.substeps, link_side])
        chains, kept = (plant.chain, cabinet.model.chain), (self.past, self.past_modes)
        _run(self._work(), plant.modes.copy(), drive, *chains, table, settings, self.gravity, *kept)

    def _work(self) -> np.ndarray:
        plant, work = self._plant, np.zeros((_ROWS, self._plant.position.size))
        work[_STATE], work[_TORQUE], work[_MOTOR] = plant.state, plant.joint_torque, plant.motor_torque
        work[_BEFORE], work[_MEMORY] = plant.last_velocity, self._cabinet.controller.memory
        work[_READING] = self._cabinet.sensors.rows
        work[_ENERGY, : plant.energy.size] = plant.energy
        return work

    @property
    def position(self) -> np.ndarray:
        """Measured positions of each millisecond, (k, n) [rad]."""
        return self.past[:, _READING.start]

    @property
    def joint_torque(self) -> np.ndarray:
        """Joint torque sensors, (k, n) [Nm]."""
        return self.past[:, _READING.start + 2]

    @property
    def motor_torque(self) -> np.ndarray:
        """Measured motor torques, (k, n) [Nm]."""
        return self.past[:, _READING.start + 3]

    def show(self, milliseconds: int) -> None:
        """Put what can be read of the arm behind so many milliseconds."""
        self._cabinet.sensors.rows[:] = self.past[milliseconds - 1, _READING]

    def place(self, milliseconds: int) -> None:
        """Put arm, sensors and controller behind so many milliseconds."""
        plant, cabinet, now = self._plant, self._cabinet, self.past[milliseconds - 1]
        plant.state[:], plant.modes[:] = now[_STATE], self.past_modes[milliseconds - 1]
        plant.joint_torque[:], plant.motor_torque[:] = now[_TORQUE], now[_MOTOR]
        plant.last_velocity[:] = now[_BEFORE]
        plant.energy[:] = now[_ENERGY, : plant.energy.size]
        plant.descents += int(now[_ENERGY, _DESCENTS])
        plant.cycles += milliseconds
        cabinet.controller.memory[:], cabinet.controller.torque[:] = now[_MEMORY], now[_COMMAND]
        cabinet.sensors.rows[:] = now[_READING]
        cabinet.sensors.skip(milliseconds)


class ModelAhead:
    """The controller's model over the cycles to come of `period_ms`, and what the packets, (n,) of `MSR`, say by it."""

    def __init__(
        self, cabinet: Cabinet, packets: np.ndarray, arm: ArmAhead, ends: np.ndarray, period_ms: int
    ) -> None:
        self._cabinet, self._packets, self._ends, self._period_ms = cabinet, packets, ends, period_ms
        last = slice(period_ms - 1, None, period_ms)
        self._gravity = arm.gravity[last]
        # A packet tells of the end of the cycle before it.
        self._position = _after(cabinet.reading.position, arm.position[last])
        self._torque = _after(cabinet.reading.joint_torque, arm.joint_torque[last])
        self._masses = np.empty((len(packets), *cabinet.model.mass_matrix.shape))
        # Renewals of mass matrix and Jacobian: number of the packet, both, and the pose of the setpoint.
        self._renewals: list[tuple[int, np.ndarray, np.ndarray, np.ndarray]] = []
        # The age of the model is this at the packet of this number.
        self._age = cabinet.model_age, 0
        self._measure()
        self._renew()
        self._estimate()

    def _measure(self) -> None:
        packets, model = self._packets, self._cabinet.model
        packets["msr_jnt_pos"], packets["msr_jnt_trq"] = self._position[:-1], self._torque[:-1]
        packets["gravity"] = _after(model.gravity, self._gravity[:-1])
        places = np.empty((len(packets), 12))
        poses(model.chain, self._position[:-1], places)
        packets["msr_cart_pos"] = places

    def _renew(self) -> None:
        """Mass matrix, Jacobian and pose of the setpoint, renewed as by `Cabinet.packet`."""
        cabinet, count = self._cabinet, len(self._packets)
        age, begin = self._age[0], 0
        now = cabinet.model.mass_matrix, cabinet.sample.jacobian, cabinet.sample.cmd_cart_pos
        setpoints = _after(cabinet.last_setpoint, self._ends)
        self._packets["mass_matrix"] = cabinet.sample.mass_matrix
        for number in range(count):
            if age <= 0:
                self._fill(begin, number, *now)
                age, begin, pose = cabinet.config.controller.model_period_ms, number, np.empty(12)
                mass_matrix, jacobian = cabinet.model.model_at(self._position[number])
                cabinet.model.flange(setpoints[number], pose)
                now = mass_matrix, jacobian, pose
                self._renewals.append((number, *now))
            age -= self._period_ms
        self._fill(begin, count, *now)

    def _fill(
        self, begin: int, end: int, mass_matrix: np.ndarray, jacobian: np.ndarray, pose: np.ndarray
    ) -> None:
        some = self._packets[begin:end]
        if self._renewals:
            some["mass_matrix"] = mass_matrix
        some["jacobian"], some["cmd_cart_pos"] = jacobian.reshape(-1, self._ends.shape[1]), pose
        self._masses[begin:end] = mass_matrix

    def _estimate(self) -> None:
        """External torque at the end of each cycle."""
        model, packets = self._cabinet.model, self._packets
        period_s, positions = self._period_ms * CYCLE_S, self._position[1:]
        keep = model.keep(period_s)
        self._memory = np.empty((len(packets), *model.memory.shape))
        differences(positions, period_s, keep, model.memory.copy(), self._memory)
        self._external, estimate = np.empty_like(positions), model.external_torque.copy()
        torques, masses = self._torque[1:], self._masses
        externals(model.chain, positions, torques, masses, self._memory, keep, estimate, self._external)
        packets["est_ext_jnt_trq"] = _after(model.external_torque, self._external[:-1])

    def place(self, done: int) -> None:
        """Put the model, and the sample of the last packet, behind so many cycles."""
        cabinet, model, sample = self._cabinet, self._cabinet.model, self._cabinet.sample
        model.gravity = self._gravity[done - 1]
        model.memory[:], model.external_torque[:] = self._memory[done - 1], self._external[done - 1]
        while self._renewals and self._renewals[0][0] < done:
            number, mass_matrix, jacobian, pose = self._renewals.pop(0)
            self._age = cabinet.config.controller.model_period_ms, number
            model.mass_matrix, model.jacobian[:] = mass_matrix, jacobian
            sample.mass_matrix[:], sample.jacobian[:], sample.cmd_cart_pos[:] = mass_matrix, jacobian, pose
        age, since = self._age
        cabinet.model_age = age - (done - since) * self._period_ms


class CabinetAhead:
    """Cycles to come of a cabinet for the answers `commands`, (n,) of `CMD`; see `of`.

    packets : (n,) of `MSR`; `take` fills their KRL variables in
    """

    def __init__(self, cabinet: Cabinet, session: CyclesAhead, commands: np.ndarray) -> None:
        self._cabinet, self._session, self._commands = cabinet, session, commands
        self.packets, self._period_ms = session.packets, session.positions.shape[1]
        self._ends = session.positions[:, -1]
        self._arm = ArmAhead(cabinet, session.positions.reshape(-1, cabinet.joints))
        self._model = ModelAhead(cabinet, self.packets, self._arm, self._ends, self._period_ms)
        self._done = 0

    @classmethod
    def of(cls, cabinet: Cabinet, commands: np.ndarray, age_s: float) -> CabinetAhead | None:
        """Of answers each `age_s` [s] after its packet; None if the first cycle to come is no ordinary one."""
        if not cabinet.ordinary:
            return None
        # The noise of the sensors comes in blocks.
        period_ms = cabinet.session.sample_time_ms
        most = len(cabinet.sensors.noise(len(commands) * period_ms)) // period_ms
        session = cabinet.session.ahead(commands[:most], age_s)
        return None if session is None else cls(cabinet, session, commands[: len(session.packets)])

    def take(self, most: int) -> int:
        """Let up to `most` of the cycles pass; returns how many have passed."""
        cabinet, period_ms = self._cabinet, self._period_ms
        bodies, interpreter, start = cabinet.model.model, cabinet.interpreter, cabinet.cycle
        going_on = True
        session, variables, starts = cabinet.session, [], []
        done = 0
        while done < most and going_on:
            starts.append(done)
            variables.append(session.variables)
            idle = min(cabinet.idle_cycles(period_ms), most - done - 1)
            done += idle + 1
            self._pass(idle, done)
            going_on = (
                self._session.going_on
                and cabinet.model.model is bodies
                and cabinet.interpreter is interpreter
                and not (interpreter is not None and interpreter.moving)
            )
        self._write(variables, np.diff([*starts, done]))
        self._session.finish()
        self._arm.place(done * period_ms)
        self._model.place(done)
        cabinet.settle(self._ends[:done], self.packets["send_seq"][done - 1].tobytes())
        cabinet.monitor.take_rows(self._commands["jnt_pos"][:done], start)
        return done

    def _pass(self, idle: int, done: int) -> None:
        """Let `idle` cycles pass and one more, number `done`, at whose end the KRL program runs."""
        cabinet, period_ms = self._cabinet, self._period_ms
        cabinet.skip_cycles(idle, period_ms)
        self._session.place(done)
        for torque in self._arm.motor_torque[(done - 1) * period_ms : done * period_ms - 1]:
            cabinet.publish(torque)
        self._arm.show(done * period_ms)
        cabinet.publish(cabinet.reading.motor_torque)
        cabinet.pass_cycles(idle + 1, period_ms)

    def _write(self, variables: list[bytes], lengths: np.ndarray) -> None:
        """Write the KRL variables into the packets: each of `variables` into so many of them."""
        values = np.frombuffer(b"".join(variables), np.uint8).reshape(len(variables), -1)
        content = raw(self.packets)[: lengths.sum()]
        content[:, KRL.start : KRL.start + values.shape[1]] = np.repeat(values, lengths, axis=0)


def prepare(cabinet: Cabinet) -> None:
    """Compile on the first run of a computer, before the PC waits for an answer; the cabinet stays as it is."""
    setpoints = cabinet.last_setpoint[np.newaxis].copy()
    ModelAhead(cabinet, np.zeros(1, MSR), ArmAhead(cabinet, setpoints), setpoints, 1)
    scratch = CommandMonitor(cabinet.arm, CYCLE_S)
    scratch.rest(setpoints[0], 0)
    scratch.take_rows(setpoints.astype(np.float32), 1)


def _after(first: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """(1 + m, ...) of `first` (...) and `rows` (m, ...)."""
    return np.concatenate([first[np.newaxis], rows])
