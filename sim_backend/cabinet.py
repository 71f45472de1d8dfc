"""The control cabinet: arm, sensors, position controller, FRI session and KRL program, without any socket.

Deterministic: its behaviour follows from the configuration, the seed, the datagrams and the operator's actions,
each at its cycle. One FRI cycle is `packet`, any number of `receive`, and `close`, the simulation of the cycle's
milliseconds. The packet carries the sensor values at one instant, the end of the last millisecond.
"""

from __future__ import annotations

import importlib
import logging
from typing import Any

import numpy as np

from fri.errors import ConfigurationError, LwrError, RobotError
from fri.krc import KrcLimits, KrcSession, Sample
from fri.krl import Interpreter, KrlProgram
from fri.packets import CMD_OFFSETS, CMD_SIZE
from fri.states import ALL_DRIVES, CommandFlag, Control, State
from lwr_driver.arm import Arm
from sim_backend.configuration import EmulatorConfig, LoadData, Plugin
from sim_backend.controller import ControllerModel, PositionController
from sim_backend.journal import Journal
from sim_backend.monitor import CommandMonitor
from sim_backend.plant import CYCLE_S, ElasticArm, Plant, PlantEffect
from sim_backend.program import PUBLISHED, krl_program
from sim_backend.robot import chain, robot_file, robot_model, true_arm
from sim_backend.sensors import ControllerTrace, KrlReals, Sensors

log = logging.getLogger(__name__)

FLANGE_MM = (0.0, 0.0, 78.0)
"""Origin of the flange frame in the frame of link 7, which is parallel to it [mm]."""

_JNT_POS = CMD_OFFSETS["jnt_pos"]
_STILL_MS = 100
_CARTESIAN = "Cartesian impedance control (strategy 20) is not simulated; use strategy 10 or 30"
# Control modes in which a spring, or nothing, holds the arm.
_SOFT = (Control.JNT_IMP, Control.OTHER)


def _load(plugin: Plugin, *arguments: Any, **named: Any) -> Any:
    module, _, name = plugin.type.partition(":")
    try:
        cls = getattr(importlib.import_module(module), name)
    except (ImportError, AttributeError) as error:
        raise ConfigurationError(f"{plugin.type!r} cannot be imported: {error}") from error
    return cls(*arguments, **named, **plugin.options)


class Cabinet:
    """See the module. `milliseconds` and `cycle` count since the start and never go back.

    under_way : whether the packet of this cycle is made; an action then shows in the next packet
    """

    def __init__(self, config: EmulatorConfig) -> None:
        self.config = config
        # One stream each: switching one off leaves the noise of the others unchanged.
        plant_seed, sensor_seed, self.wire_seed = np.random.SeedSequence(config.seed).spawn(3)
        self.arm = Arm.load(str(config.beside(config.limits)))
        self.file = robot_file(config)
        self.plant = self._make_plant(plant_seed)
        self.joints = self.plant.position.size
        self.sensors = Sensors(config.sensors, self.joints, sensor_seed)
        self.reading = self.sensors.reading
        believed = chain(config.beside(config.controller.urdf))
        cutoff_hz = config.controller.external_cutoff_hz
        self.model = ControllerModel(believed, config.controller.load, cutoff_hz)
        self.model.set_gravitation(config.controller.gravity)
        self.controller = PositionController(config.controller)
        self.krl_reals = KrlReals(config.krl_reals, self.joints)
        self.currents: np.ndarray | None = np.zeros(self.joints) if config.krl.currents else None
        # Currents of the milliseconds since the KRL program ran.
        self._measured: list[np.ndarray] = []
        self.journal = Journal()
        self.mode: str = config.fri.mode
        self._springs = np.array([[1000.0], [0.7]]) * np.ones((2, self.joints))
        self._law = Control.POSITION
        self.trace = ControllerTrace(config.trace, self.arm.joint_names)
        self.program_name: str = config.fri.program
        self.period_ms = config.fri.period_ms
        self.monitor = CommandMonitor(self.arm, self.period_ms * CYCLE_S)
        self.sample = Sample()
        self.sample.temperature[:] = config.sensors.temperature
        self.milliseconds = 0
        self.cycle = 0
        self.packets = 0
        self.received = 0
        self.powered = True
        self.error_bits = 0
        self.warning_bits = 0
        self.moving = False
        self.under_way = False
        self._idle_cycles = 0
        self.last_setpoint = np.zeros(self.joints)
        self.model_age = 0
        self._commanding = False
        self._load_turn = (0.0, 0.0, 0.0)
        self._load_told: tuple[LoadData | None, tuple[float, ...], tuple[float, ...]] = None, (), ()
        self._zero = np.zeros(self.joints)
        self._begin(np.array(config.robot.start_position))
        self._compile(
            ControllerModel(chain(config.beside(config.controller.urdf)), config.controller.load, cutoff_hz)
        )

    def _make_plant(self, seed: np.random.SeedSequence) -> Plant:
        robot = self.config.robot
        model, drive = true_arm(self.config, self.file)
        payload = self.file.payload(robot.payload)
        own, others = seed.spawn(2)
        identified = robot_model(self.config)
        own_effects: tuple[PlantEffect, ...] = ()
        if identified is not None:
            from sim_backend.model_arm import model_effects

            own_effects = model_effects(identified)
        self.effects: tuple[PlantEffect, ...] = (*own_effects, *(_load(effect) for effect in robot.effects))
        if robot.plant is not None:
            plant = _load(robot.plant, model, drive, np.random.default_rng(own))
            if not isinstance(plant, Plant):
                raise ConfigurationError(
                    f"{robot.plant.type!r} lacks methods or arrays of sim_backend.plant.Plant"
                )
            # Such a plant has its own physics; the effects act on its sensors only.
            for effect, stream in zip(self.effects, others.spawn(len(self.effects)), strict=True):
                effect.start(model.nv, np.random.default_rng(stream))
        else:
            plant = ElasticArm(model, drive, substeps=robot.substeps, effects=self.effects, random=others)
        plant.mount(payload)
        self.payload_name = robot.payload
        return plant

    def _begin(self, position: np.ndarray) -> None:
        """At rest at `position`, under control, with a cold session."""
        self.plant.reset(position)
        self.last_setpoint[:] = position
        self.controller.reset(position, self.model.update_gravity(position), self.plant.motor_position)
        self.cold_start()
        for _ in range(round(self.config.controller.settle_s / CYCLE_S)):
            self._millisecond(position)

    def _compile(self, scratch: ControllerModel) -> None:
        """Compile on the first run of a computer, before the PC waits for an answer."""
        scratch.update_model(self.reading.position)
        scratch.flange(self.reading.position, np.empty(12))
        scratch.update_external(self.reading.position, self.reading.joint_torque, CYCLE_S)
        spring = PositionController(self.config.controller)
        spring.spring_cycle(self._zero, self._zero, self._zero, self._zero, self._zero)
        command = np.frombuffer(bytes(4 * self.joints), "<f4", self.joints)
        CommandMonitor(self.arm, CYCLE_S).take(command, 0)

    def cold_start(self) -> None:
        """A new session with its counters at zero, as after switching the cabinet on; no program runs."""
        fri = self.config.fri
        rows = (fri.position_min, fri.position_max, fri.velocity, fri.acceleration)
        limits = KrcLimits(*(np.array(row) for row in rows))
        self.session = KrcSession(
            limits,
            self.last_setpoint,
            self.config.policy,
            power=ALL_DRIVES if self.powered else 0,
            uptime_s=fri.uptime_s + self.milliseconds * CYCLE_S,
        )
        self.session.on_event = self.journal.event
        self.session.refused = {Control.CART_IMP: _CARTESIAN}
        self.session.t1 = self.mode == "T1"
        self.interpreter: Interpreter | None = None
        self.program: KrlProgram | None = None
        self._commanding = False
        self.monitor.period_s = self.session.sample_time_s

    def start_program(self, name: str | None = None, period_ms: int | None = None) -> None:
        """Select and start a KRL program; None keeps the last choice or the configured values.

        name : see `sim_backend.program.krl_program`
        """
        name = self.program_name if name is None else name
        period_ms = self.period_ms if period_ms is None else period_ms
        if not 1 <= period_ms <= 100:
            raise ConfigurationError(f"period {period_ms} ms is outside 1 to 100 ms")
        krl = self.config.krl
        program = krl_program(
            name,
            period_ms,
            self,
            beside=self.config.source.parent,
            statement_ms=krl.statement_ms,
            halt_s=krl.halt_s,
            **(krl.variables if name == self.config.fri.program else {}),
        )
        for remark in program.remarks:
            self.journal.warn(remark)
        self.stop_program()
        self.program_name, self.period_ms = name, period_ms
        self.program = program
        self.interpreter = Interpreter(self.session, self.program)
        self.journal.say(f"KRL program {name} started")

    def stop_program(self) -> None:
        """Cancel the KRL program: FRI closes."""
        self.session.fri_close()
        self.interpreter = None
        self.program = None

    @property
    def running(self) -> bool:
        """Whether a KRL program is at work."""
        return self.program is not None and not self.program.finished

    @property
    def load(self) -> tuple[float, ...]:
        """Load data as KRL has them: mass [kg], centre of mass in the flange frame [mm], A B C [deg], JX JY JZ
        [kg m2].
        """
        load = self.model.load
        if self._load_told[0] is load and self._load_told[1] is self._load_turn:
            return self._load_told[2]
        centre = (1000.0 * value - origin for value, origin in zip(load.com, FLANGE_MM, strict=True))
        turn = _turn(*self._load_turn)
        xx, xy, xz, yy, yz, zz = load.inertia
        moments = np.diag(turn.T @ np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]) @ turn).tolist()
        told = (load.mass, *centre, *self._load_turn, *moments)
        self._load_told = load, self._load_turn, told
        return told

    def set_load(self, load: tuple[float, ...]) -> None:
        """Load data from KRL, as `load` gives them; A B C turn the axes of the inertia against the flange."""
        mass, x, y, z, a, b, c, *moments = load
        right, up, out = FLANGE_MM
        centre = ((x + right) / 1000.0, (y + up) / 1000.0, (z + out) / 1000.0)
        turn = _turn(a, b, c)
        full = turn @ np.diag(moments) @ turn.T
        self._load_turn = (a, b, c)
        upper = full[np.triu_indices(3)].tolist()
        self.model.set_load(
            LoadData(mass, centre, (upper[0], upper[1], upper[2], upper[3], upper[4], upper[5]))
        )

    def enter_load(self, load: LoadData) -> None:
        """Load data from the pendant; the axes of the inertia are those of the flange."""
        self._load_turn = (0.0, 0.0, 0.0)
        self.model.set_load(load)

    @property
    def position(self) -> np.ndarray:
        """Measured joint positions (7,) [rad]."""
        return self.reading.position

    @property
    def joint_torque(self) -> np.ndarray:
        """Joint torque sensors (7,) [Nm]."""
        return self.reading.joint_torque

    @property
    def gravity(self) -> tuple[float, float, float]:
        """`$GRAVITATION` [m/s^2]."""
        return self.model.gravitation

    def set_gravity(self, gravity: tuple[float, float, float]) -> None:
        """Another `$GRAVITATION` [m/s^2]."""
        self.model.set_gravitation(gravity)

    def set_impedance(self, stiffness: np.ndarray, damping: np.ndarray) -> None:
        """Springs without a command: (7,) [Nm/rad], (7,) damping ratios, from `$STIFFNESS`."""
        self._springs[0], self._springs[1] = stiffness, damping

    def say(self, text: str) -> None:
        """A message of the KRL program."""
        self.journal.say(text)

    def power(self, on: bool) -> None:
        """Drives on: brakes open, the setpoint is at the position of the arm. Off: brakes closed.

        Raises RobotError when the drives are to come on while the setpoint still moves.
        """
        if on == self.powered:
            return
        session = self.session
        if on and session.ramping:
            raise RobotError("drives cannot come on while the controller is braking; wait until it stands")
        self.powered = on
        self.plant.brake(not on)
        if on:
            if session.state is not State.CMD:
                session.resync(self.reading.position)
            self.last_setpoint[:] = session.setpoint
            self.controller.reset(
                self.last_setpoint,
                self.model.update_gravity(self.last_setpoint),
                self.reading.motor_position,
            )
        self.report_drives()

    def report_drives(self) -> None:
        """Drive bits into the session."""
        self.session.set_drives(ALL_DRIVES if self.powered else 0, self.error_bits, self.warning_bits)

    def packet(self) -> bytes:
        """Begin a cycle: the measurement to send."""
        sample, model, reading = self.sample, self.model, self.reading
        position = reading.position
        sample.msr_jnt_pos[:] = position
        sample.msr_jnt_trq[:] = reading.joint_torque
        sample.est_ext_jnt_trq[:] = model.external_torque
        sample.gravity[:] = model.gravity
        if self.model_age <= 0:
            self.model_age = self.config.controller.model_period_ms
            model.update_model(position)
            sample.mass_matrix[:] = model.mass_matrix
            sample.jacobian[:] = model.jacobian
            model.flange(self.last_setpoint, sample.cmd_cart_pos)
        model.flange(position, sample.msr_cart_pos)
        session = self.session
        commanding = session.state == State.CMD and session.power != 0
        if commanding and not self._commanding:
            self.monitor.period_s = session.sample_time_s
            self.monitor.rest(self.last_setpoint, self.cycle - 1)
        self._commanding = commanding
        self.under_way = True
        self.packets += 1
        datagram = session.packet(sample)
        self._sequence = datagram[:2]
        return datagram

    def arrived(self, datagram: bytes) -> None:
        """Count and judge a command from the network, before any fault on the wire; it has no effect yet."""
        self.received += 1
        if self._commanding and len(datagram) == CMD_SIZE and datagram[2:4] == self._sequence:
            self.monitor.take(np.frombuffer(datagram, "<f4", self.joints, _JNT_POS), self.cycle)

    def receive(self, datagram: bytes, age_s: float) -> None:
        """Hand a command to the session, `age_s` [s] after its packet."""
        self.session.receive(datagram, age_s)

    def close(self) -> None:
        """End the cycle: judge the answers, simulate its milliseconds, let the KRL program run."""
        self.under_way = False
        setpoint = self.session.close_cycle()
        positions = setpoint.positions
        for row in positions:
            self._millisecond(row)
        last = positions[-1]
        still = bool((last == self.last_setpoint).all())
        self.last_setpoint[:] = last
        self._idle_cycles = self._idle_cycles + 1 if still else 0
        self.moving = self._idle_cycles * len(positions) < _STILL_MS
        self.model_age -= len(positions)
        period_s = len(positions) * CYCLE_S
        self.model.update_external(self.reading.position, self.reading.joint_torque, period_s)
        self._choose_law()
        self._run_program(len(positions))
        self.cycle += 1

    def _run_program(self, milliseconds: int) -> None:
        """Let the KRL program run; an error stops it, as on the controller.

        Each statement reads the motor currents of its own millisecond. Read at the end of the cycle, all would be at
        one phase of the ripple that the setpoints between two commands leave in them.
        """
        measured, self._measured = self._measured, []
        self.journal.time_s = self.milliseconds * CYCLE_S
        if self.interpreter is None:
            return
        running = self.running
        try:
            for number in range(milliseconds):
                if measured:
                    self.currents = measured[number - milliseconds]
                self.interpreter.millisecond()
            self.interpreter.drive()
        except LwrError as error:
            self.journal.warn(f"KRL program stopped: {error}")
            self.stop_program()
            return
        if running and not self.running:
            self.journal.say("KRL program ended")

    def _choose_law(self) -> None:
        """Law of the coming cycle by the control mode, and the spring by the last command.

        Coming back from a spring, the setpoint goes to the arm, and not the arm to the setpoint.
        """
        session, controller = self.session, self.controller
        wanted = session.control if session.control in _SOFT else Control.POSITION
        if wanted is not self._law and not session.ramping:
            if self._law in _SOFT and session.state is not State.CMD:
                session.resync(self.reading.position)
                self.last_setpoint[:] = session.setpoint
            position = self.last_setpoint
            controller.reset(position, self.model.update_gravity(position), self.reading.motor_position)
            self._law = wanted
            self.journal.say(f"control of the arm: {session.control.name}")
        if self._law is Control.OTHER:
            controller.set_free()
        elif self._law is Control.JNT_IMP:
            (stiffness, damping), torque = self._springs, self._zero
            if session.state is State.CMD and session.answered:
                command, flags = session.command, int(session.command["cmd_flags"])
                stiffness = command["jnt_stiffness"] if flags & CommandFlag.JNTSTIFF else stiffness
                damping = command["jnt_damping"] if flags & CommandFlag.JNTDAMP else damping
                torque = command["add_jnt_trq"] if flags & CommandFlag.JNTTRQ else torque
            elif session.state is State.CMD:
                return
            controller.set_spring(stiffness, damping, torque, self.model.mass_matrix)

    def _millisecond(self, setpoint: np.ndarray) -> None:
        plant, reading = self.plant, self.reading
        time_s = self.milliseconds * CYCLE_S
        self.sensors.read(plant)
        for effect in self.effects:
            effect.sense(time_s, plant, reading)
        soft = self._law in _SOFT
        gravity = self.model.update_gravity(reading.position if soft else setpoint)
        torque, controller = self._zero, self.controller
        if self.powered and soft:
            torque = controller.spring_cycle(
                setpoint, gravity, reading.position, reading.motor_position, reading.joint_torque
            )
        elif self.powered:
            torque = controller.cycle(setpoint, gravity, reading.motor_position, reading.joint_torque)
        self.sensors.read_motor(plant.motor_torque, torque)
        for effect in self.effects:
            effect.sense_motor(time_s, plant, reading)
        plant.step(torque)
        self.milliseconds += 1
        self.publish(reading.motor_torque)
        self.trace.millisecond(time_s, reading.motor_torque, reading.position)

    def publish(self, motor_torque: np.ndarray) -> None:
        """The measured motor torque of a millisecond, to the KRL program or to the loop that stands for one."""
        if self.program_name not in PUBLISHED:
            if self.currents is not None:
                self._measured.append(self.krl_reals.late(motor_torque).copy())
        elif self.config.krl_reals.enabled:
            self.krl_reals.millisecond(motor_torque, self.session.to_real, self.session.to_int)

    def idle_cycles(self, period_ms: int) -> int:
        """Cycles to come in which no statement of KRL is due and no variable is published."""
        idle = 10**6 if self.interpreter is None else self.interpreter.idle_cycles(period_ms)
        if self._publishing:
            idle = min(idle, self.krl_reals.idle_ms // period_ms)
        return idle

    def skip_cycles(self, count: int, period_ms: int) -> None:
        """Pass over idle cycles."""
        if self.interpreter is not None:
            self.interpreter.skip(count * period_ms)
        if self._publishing:
            self.krl_reals.skip(count * period_ms)

    @property
    def _publishing(self) -> bool:
        return self.program_name in PUBLISHED and self.config.krl_reals.enabled

    @property
    def ordinary(self) -> bool:
        """Whether the arm is driven in position control and nothing else goes on, see `sim_backend.ahead`."""
        plant, trace, interpreter = self.plant, self.config.trace, self.interpreter
        return (
            type(plant) is ElasticArm
            and not (self.effects or plant.effects or plant.pushed)
            and self.powered
            and self._commanding
            and not self.under_way
            and self._law is Control.POSITION
            and not (self.trace.recording or trace.delay_ms or self.config.krl_reals.delay_ms)
            and (interpreter is None or not interpreter.moving)
        )

    def pass_cycles(self, count: int, milliseconds: int) -> None:
        """Count `count` cycles worked out elsewhere, and let the KRL program run at the end of the last of them."""
        self.milliseconds += count * milliseconds
        self.cycle += count - 1
        self._run_program(milliseconds)
        self.cycle += 1

    def settle(self, ends: np.ndarray, sequence: bytes) -> None:
        """Note the cycles passed so. ends : setpoints at their ends, (m, 7) [rad]; sequence : of the last packet."""
        count = len(ends)
        self.packets += count
        self.received += count
        self._sequence = sequence
        still = (ends == np.concatenate([self.last_setpoint[np.newaxis], ends[:-1]])).all(axis=1)
        moved = np.flatnonzero(~still)
        self._idle_cycles = self._idle_cycles + count if not len(moved) else count - 1 - int(moved[-1])
        self.last_setpoint[:] = ends[-1]
        self.moving = self._idle_cycles * self.session.sample_time_ms < _STILL_MS


def _turn(a: float, b: float, c: float) -> np.ndarray:
    """Rotation matrix of the angles A B C of KRL [deg]: about z, then the new y, then the new x."""
    (sa, sb, sc), (ca, cb, cc) = np.sin(np.radians([a, b, c])), np.cos(np.radians([a, b, c]))
    return np.array(
        [
            [ca * cb, ca * sb * sc - sa * cc, ca * sb * cc + sa * sc],
            [sa * cb, sa * sb * sc + ca * cc, sa * sb * cc - ca * sc],
            [-sb, cb * sc, cb * cc],
        ]
    )
