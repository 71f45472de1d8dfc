"""The emulated operator: all actions at the cabinet, by hand over the pendant or by schedule.

The public methods of `Operator` are the commands (`COMMANDS`). The `schedule` of the configuration triggers them
by cycle or by state: a fault strikes in a chosen phase and repeats with the seed.
"""

from __future__ import annotations

import inspect
import logging
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np

from fri.errors import ConfigurationError, LwrError, RobotError
from fri.quantities import Name, check, within
from fri.states import EventKind, Quality, State
from lwr_driver.configuration import parse
from sim_backend.cabinet import Cabinet
from sim_backend.configuration import LoadData
from sim_backend.faults import FaultyWire, WireFault
from sim_backend.plant import CYCLE_S
from sim_backend.robot import Payload

log = logging.getLogger(__name__)

Moment = Literal["now", "start", "monitor", "command", "moving"]
_RECENT_EVENTS = 20
_SILENCE_CYCLES = 2000


@dataclass(frozen=True)
class ScheduleEntry:
    """A command for later, once.

    when : `start` of the emulator, `now` (as it is scheduled), FRI state `monitor` or `command` entered, or
    the commanded position begins `moving` in command mode; `occurrence` : for the nth time
    after_cycles : delay in FRI cycles
    """

    command: Name
    when: Moment = "now"
    after_cycles: Annotated[int, within(0, 10**9)] = 0
    occurrence: Annotated[int, within(1, 10**6)] = 1
    arguments: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        check(self)
        if self.command not in COMMANDS:
            raise ConfigurationError(f"command {self.command!r} is unknown; known: {', '.join(COMMANDS)}")
        _check_arguments(self.command, self.arguments)


class _Pending:
    def __init__(self, entry: ScheduleEntry) -> None:
        self.entry = entry
        self.left = entry.occurrence
        self.due: int | None = None


class Operator:
    """Acts on a cabinet and its wire. `step` runs once per cycle."""

    def __init__(self, cabinet: Cabinet, wire: FaultyWire) -> None:
        self.cabinet = cabinet
        self.wire = wire
        self.ended = False
        self.estopped = False
        self._silent_until: int | None = None
        self._silent_since: int | None = None
        self._restart_at: int | None = None
        self._drives_after_restart = True
        self._ceiling_until: int | None = None
        self._pending: list[_Pending] = []
        self._seen_state = State.OFF
        self._seen_moving = False
        config = cabinet.config
        faults, schedule = (config.place.key(name) for name in ("faults", "schedule"))
        for number, content in enumerate(config.faults):
            wire.inject(parse(WireFault, content, faults.entry(number)), cabinet.cycle)
        for number, content in enumerate(config.schedule):
            self._add(parse(ScheduleEntry, content, schedule.entry(number)))
        if config.fri.autostart:
            cabinet.start_program()

    def _add(self, entry: ScheduleEntry) -> None:
        pending = _Pending(entry)
        if entry.when in ("now", "start"):
            pending.due = self.cabinet.cycle + entry.after_cycles
        self._pending.append(pending)

    @property
    def operating_mode(self) -> str:
        """T1, T2, AUT or EXT."""
        return self.cabinet.mode

    @property
    def idle(self) -> bool:
        """Whether `step` would do nothing, whatever the cycle."""
        waiting = self._silent_since, self._silent_until, self._restart_at, self._ceiling_until
        return not self._pending and all(until is None for until in waiting)

    @property
    def silent(self) -> bool:
        """Whether the controller sends nothing although a session is open."""
        return self._silent_since is not None and self.cabinet.cycle >= self._silent_since

    @property
    def busy(self) -> bool:
        """Whether time goes on without packets."""
        if self._silent_since is not None and self._silent_until is None:
            # Long enough for the controller to notice and for the arm to stand.
            return self.cabinet.cycle < self._silent_since + _SILENCE_CYCLES
        return self.cabinet.running or self._restart_at is not None or self._silent_since is not None

    def step(self) -> None:
        """Once per cycle, between `close` and the next `packet`."""
        cabinet = self.cabinet
        cycle = cabinet.cycle
        if self._silent_until is not None and cycle >= self._silent_until:
            self._silent_until = self._silent_since = None
        if self._restart_at is not None and cycle >= self._restart_at:
            self._restart_at = None
            cabinet.start_program()
            if self._drives_after_restart and not self.estopped:
                cabinet.power(True)
        if self._ceiling_until is not None and cycle >= self._ceiling_until:
            self._ceiling_until = None
            cabinet.session.quality_ceiling = Quality.PERFECT
        session = cabinet.session
        if cabinet.journal.detailed:
            cabinet.journal.watch(
                quality=session.quality.name,
                control=session.control.name,
                drives=f"{session.power:#04x}",
                missing_answers=session.miss_counter,
                payload=cabinet.payload_name,
                load_data=f"{cabinet.model.load.mass:g} kg",
            )
        if self._pending:
            self._run_schedule(cycle)

    def _run_schedule(self, cycle: int) -> None:
        state, moving = self.cabinet.session.state, self.cabinet.moving
        begun = set()
        if state is not self._seen_state:
            self._seen_state = state
            begun.add({State.MON: "monitor", State.CMD: "command"}.get(state, ""))
        moves = moving and state is State.CMD
        if moves and not self._seen_moving:
            begun.add("moving")
        self._seen_moving = moves
        for pending in list(self._pending):
            if pending.due is None and pending.entry.when in begun:
                pending.left -= 1
                if pending.left == 0:
                    pending.due = cycle + pending.entry.after_cycles
            if pending.due is not None and cycle >= pending.due:
                self._pending.remove(pending)
                try:
                    self.handle(pending.entry.command, pending.entry.arguments)
                except LwrError as error:
                    log.warning("scheduled `%s` was refused: %s", pending.entry.command, error)

    def handle(self, command: str, arguments: Mapping[str, Any]) -> Any:
        """Do `command` and return its result for the pendant; LwrError if it is refused."""
        if command not in COMMANDS:
            raise ConfigurationError(f"command {command!r} is unknown; known: {', '.join(COMMANDS)}")
        _check_arguments(command, arguments)
        if command not in ("status", "save_trace"):
            given = ", ".join(f"{key}={value}" for key, value in arguments.items())
            self.cabinet.journal.say(f"pendant: {command}({given})")
        return getattr(self, command)(**arguments)

    def status(self) -> dict[str, Any]:
        """Contents of the pendant.

        time_s, cycle : virtual clock since the start. state, quality, control : names. power, error, warning
        : drive bits. position, motor_position, joint_torque, motor_torque, setpoint : (7,). payload : mounted
        payload. load : load data of the controller. monitor : see `CommandMonitor.summary`. session : counters.
        events : last ones
        """
        cabinet = self.cabinet
        session, reading = cabinet.session, cabinet.reading
        return {
            "time_s": cabinet.milliseconds * CYCLE_S,
            "cycle": cabinet.cycle,
            "period_ms": cabinet.period_ms,
            "state": session.state.name,
            "quality": session.quality.name,
            "control": session.control.name,
            "power": session.power,
            "error": session.error,
            "warning": session.warning,
            "emergency_stop": self.estopped,
            "mode": self.operating_mode,
            "program": cabinet.program_name if cabinet.running else None,
            "silent": self.silent,
            "moving": cabinet.moving,
            "payload": cabinet.payload_name,
            "load": {
                "mass": cabinet.model.load.mass,
                "com": list(cabinet.model.load.com),
                "inertia": list(cabinet.model.load.inertia),
            },
            "position": reading.position.tolist(),
            "motor_position": reading.motor_position.tolist(),
            "joint_torque": reading.joint_torque.tolist(),
            "motor_torque": reading.motor_torque.tolist(),
            "setpoint": session.setpoint.tolist(),
            "packets": cabinet.packets,
            "received": cabinet.received,
            "session": session.counters(),
            "faults": {str(number): fault.kind for number, fault in self.wire.active.items()},
            "faults_struck": self.wire.struck,
            "scheduled": len(self._pending),
            "saving_trace": cabinet.trace.saving(),
            "monitor": cabinet.monitor.summary(),
            "events": [
                {"cycle": event.cycle, "kind": event.kind.name, "text": event.text}
                for event in list(session.events)[-_RECENT_EVENTS:]
            ],
        }

    def mount(
        self,
        payload: str | None = None,
        mass: float | None = None,
        com: tuple[float, ...] = (0.0, 0.0, 0.0),
        inertia: tuple[float, ...] = (0.0,) * 6,
    ) -> None:
        """Hang a payload on the flange, by name or by its properties."""
        if (payload is None) == (mass is None):
            raise ConfigurationError("mount needs either the name of a payload or its mass")
        if payload is not None:
            body = self.cabinet.file.payload(payload)
        else:
            load = _load(mass, com, inertia)
            body = Payload.from_centre_of_mass(load.mass, load.com, load.inertia)
        self.cabinet.plant.mount(body)
        self.cabinet.payload_name = payload or "custom"

    def unmount(self) -> None:
        """Take the payload off."""
        self.cabinet.plant.mount(None)
        self.cabinet.payload_name = "none"

    def set_load(
        self, mass: float, com: tuple[float, ...] = (0.0,) * 3, inertia: tuple[float, ...] = (0.0,) * 6
    ) -> None:
        """Load data of the controller."""
        self.cabinet.enter_load(_load(mass, com, inertia))

    def drives(self, on: bool) -> None:
        """Drives on or off; in YAML write `drives_on` or `drives_off`, for `on` is a truth value there."""
        if on:
            self.drives_on()
        else:
            self.drives_off()

    def drives_on(self) -> None:
        """Drives on; acknowledges drive errors, as on the real pendant."""
        if self.estopped:
            raise RobotError("drives stay off: the emergency stop is pressed; release it first")
        self.cabinet.error_bits = 0
        self.cabinet.power(True)
        self.cabinet.report_drives()

    def drives_off(self) -> None:
        """Drives off, brakes closed."""
        self.cabinet.power(False)

    def emergency_stop(self) -> None:
        """Emergency stop: command mode ends, brakes close."""
        self.estopped = True
        self.cabinet.session.drop(EventKind.EXTERNAL, "emergency stop")
        self.cabinet.power(False)

    def release_emergency_stop(self) -> None:
        """Release it; drives stay off."""
        self.estopped = False

    def mode(self, name: str) -> None:
        """Turn the mode switch."""
        if name not in ("T1", "T2", "AUT", "EXT"):
            raise ConfigurationError(f"mode {name!r} is unknown; known: T1, T2, AUT, EXT")
        if name == self.operating_mode:
            return
        self.cabinet.mode = name
        self.cabinet.session.drop(EventKind.EXTERNAL, f"operating mode changed to {name}")
        self.cabinet.power(False)
        self.cabinet.session.t1 = name == "T1"

    def gravity_compensation(self, active: bool = True) -> None:
        """Gravity compensation, so that a hand moves the arm, or position control again; not in command mode."""
        try:
            self.cabinet.session.set_strategy(101 if active else 10)
        except RuntimeError as error:
            raise RobotError(str(error)) from error

    def drive_fault(self, joint: int, error: bool = True) -> None:
        """Error or warning of a drive."""
        if not 0 <= joint < self.cabinet.joints:
            raise ConfigurationError(f"joint {joint} is outside 0 to {self.cabinet.joints - 1}")
        if error:
            self.cabinet.error_bits |= 1 << joint
            self.cabinet.report_drives()
            self.cabinet.power(False)
        else:
            self.cabinet.warning_bits |= 1 << joint
        self.cabinet.report_drives()

    def start_program(self, name: str | None = None, period_ms: float | None = None) -> None:
        """Start a KRL program."""
        if period_ms is not None and period_ms != int(period_ms):
            raise ConfigurationError(f"period {period_ms} ms is no whole number of milliseconds")
        self.cabinet.start_program(name, None if period_ms is None else int(period_ms))

    def stop_program(self) -> None:
        """Cancel the KRL program."""
        self.cabinet.stop_program()

    def restart(self, silent_cycles: int = 1000, drives_on: bool = True) -> None:
        """Cold start: drives off, silence, then a new session, program and (`drives_on`) the drives."""
        cabinet = self.cabinet
        cabinet.session.drop(EventKind.EXTERNAL, "controller restarted")
        cabinet.power(False)
        cabinet.stop_program()
        cabinet.cold_start()
        self.wire.restart()
        self._restart_at = cabinet.cycle + int(silent_cycles)
        self._drives_after_restart = drives_on

    def silence(self, cycles: int | None = None) -> None:
        """Send nothing for `cycles` cycles, None for ever (0 ends it)."""
        self._silent_since = self.cabinet.cycle + self.cabinet.under_way
        self._silent_until = None if cycles is None else self._silent_since + int(cycles)

    def degrade_quality(self, cycles: int) -> None:
        """Rate the link UNACCEPTABLE for a while."""
        self.cabinet.session.quality_ceiling = Quality.UNACCEPTABLE
        self._ceiling_until = self.cabinet.cycle + int(cycles)

    def inject(self, **settings: Any) -> int:
        """Begin a fault on the wire; returns its number."""
        return self.wire.inject(parse(WireFault, settings, "inject"), self.cabinet.cycle)

    def clear_faults(self) -> None:
        """End all faults on the wire."""
        self.wire.clear()

    def schedule(self, entry: dict[str, Any]) -> None:
        """Do a command later."""
        self._add(parse(ScheduleEntry, entry, "schedule"))

    def displace(self, offset: list[float]) -> None:
        """Move the arm by hand; the drives must be off."""
        cabinet = self.cabinet
        if cabinet.powered:
            raise RobotError("the arm cannot be moved by hand while the drives are on; switch them off")
        cabinet.plant.reset(cabinet.plant.position + self._joint_values("offset", offset))

    def push(self, torque: list[float]) -> None:
        """External torque on the links."""
        self.cabinet.plant.push(self._joint_values("torque", torque))

    def _joint_values(self, name: str, given: list[float]) -> np.ndarray:
        values = np.asarray(given, dtype=float)
        if values.shape != (self.cabinet.joints,) or not np.isfinite(values).all():
            raise ConfigurationError(f"{name} must be {self.cabinet.joints} finite numbers, found {given}")
        return values

    def start_trace(self) -> None:
        """Begin a controller trace."""
        self.cabinet.trace.start()

    def save_trace(self, path: str) -> int:
        """End the controller trace and write it; returns the number of samples."""
        if not self.cabinet.trace.recording:
            raise RobotError("no trace is being recorded; start one first")
        return self.cabinet.trace.save(Path(path))

    def reset_monitor(self) -> None:
        """Forget the extremes seen by the command monitor."""
        self.cabinet.monitor.reset()

    def shutdown(self) -> None:
        """End the emulator."""
        self.ended = True


def _check_arguments(command: str, arguments: Mapping[str, Any]) -> None:
    try:
        inspect.signature(getattr(Operator, command)).bind(None, **arguments)
    except TypeError as error:
        raise ConfigurationError(f"command `{command}`: {error}") from error


def _load(mass: Any, com: Any, inertia: Any) -> LoadData:
    return parse(LoadData, {"mass": mass, "com": list(com), "inertia": list(inertia)}, "load")


COMMANDS = tuple(
    name
    for name, method in vars(Operator).items()
    if inspect.isfunction(method) and not name.startswith("_") and name not in ("step", "handle")
)
