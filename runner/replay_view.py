"""A session beside its simulation: the measured arm solid, the simulated one as a ghost, in a viser scene.

The simulation is that of `runner.replay`, once with the base model and once with the extended one. Position errors of
a good model are fractions of a degree, so the ghost shows them enlarged.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from fri.errors import ConfigurationError, DataError
from ident.dynamics.known_arm import known_arm
from ident.dynamics.structure import EncoderSide, TorqueSide
from ident.model.model_file import read_model
from ident.rows.sessions import payload_name
from lwr_driver.arm import Arm
from lwr_driver.session import Session
from runner.encoder import encoder_of
from runner.experiment_file import Payload
from runner.file_names import MODEL, SUMMARY
from runner.replay import Replay, Replayed, attached_experiment
from runner.report.folder import ResultFolder
from runner.report.plot import STYLES

Floats = NDArray[np.float64]
Simulated = Literal["base", "extended"]

LABELS: dict[Simulated, str] = {"base": "base model", "extended": "extended model"}
SPEEDS = (0.25, 0.5, 1.0, 2.0, 4.0)
_FRAMES_PER_S = 20.0
_TEXT_EVERY = 4
# The largest enlarged deviation of the ghost [rad].
_SEEN_RAD = 0.12
_LEVELS = 16
_UNKNOWN = "nothing tells where this arm has its encoders; they are simulated at the links"
# Means at the end of the simulated part, under the transient of its filters.
_END = 5


@dataclass(frozen=True, eq=False)
class MotionReplay:
    """A session with its simulation by one or two models.

    runs : by model. side : of the torque errors, `joint` where it is measured, else `motor`. notes : limits of the
    simulation, a sentence each. encoder : side of the elastic joints with the published positions.
    """

    session: str
    arm: Arm
    payload: Payload | None
    runs: Mapping[Simulated, Replayed]
    side: TorqueSide
    notes: tuple[str, ...] = ()
    encoder: EncoderSide = "link"

    @property
    def time(self) -> Floats:
        """(m,) from the start of the session [s]."""
        return self.runs["base"].time

    @property
    def measured(self) -> Floats:
        """(m, n) measured positions [rad]."""
        return self.runs["base"].measured

    def torque_error(self, model: Simulated) -> Floats:
        """(m, n) measured minus simulated torque [Nm]; NaN for a motor near standstill."""
        error = getattr(self.runs[model], self.side)
        assert error is not None
        return np.asarray(error, dtype=np.float64)

    def simulated(self, model: Simulated, enlarged: float = 1.0) -> Floats | None:
        """(m, n) simulated positions [rad], their deviations `enlarged` times; None without motor torques."""
        error = self.runs[model].position
        return None if error is None else self.measured - enlarged * error

    @cached_property
    def enlarged(self) -> float:
        """Factor 1, 2, 5, 10, ... at which the largest deviation is seen with the naked eye."""
        errors = [run.position for run in self.runs.values() if run.position is not None]
        largest = max((float(np.abs(error).max()) for error in errors), default=0.0)
        if largest <= 0.0 or largest >= _SEEN_RAD:
            return 1.0
        power = np.floor(np.log10(_SEEN_RAD / largest))
        return float(max(f for f in (1.0, 2.0, 5.0) if f * 10.0**power * largest <= _SEEN_RAD) * 10.0**power)

    @cached_property
    def scale(self) -> Floats:
        """(n,) largest torque error of each joint by the base model [Nm], full colour of its link."""
        found = np.nanmax(np.abs(self.torque_error("base")), axis=0, initial=0.0)
        return np.where(found > 0.0, found, 1.0)

    @cached_property
    def told_joint(self) -> int:
        """The joint, from 0, of the largest torque error by the base model, or of the largest gain by the other."""
        power = [self.rms(name)[1] ** 2 for name in self.runs]
        return int(np.argmax(power[0] - power[1] if len(power) > 1 else power[0]))

    def rms(self, model: Simulated) -> tuple[Floats | None, Floats]:
        """Deviation of the position [rad] or None, and torque error [Nm], (n,) each, root mean square over time."""
        position, torque = self.runs[model].position, self.torque_error(model)
        count = np.maximum(np.isfinite(torque).sum(axis=0), 1)
        rms_torque = np.sqrt(np.nansum(torque**2, axis=0) / count)
        return None if position is None else np.sqrt(np.mean(position**2, axis=0)), rms_torque

    def facts(self) -> dict[str, Any]:
        """Plain content for JSON."""
        return {
            "session": self.session,
            "begin_s": float(self.time[0]),
            "end_s": float(self.time[-1]),
            "side": self.side,
            "joints": self.arm.joint_names,
            "encoder": self.encoder,
            "rms": {
                model: {"position_rad": self.rms(model)[0], "torque_nm": self.rms(model)[1]}
                for model in self.runs
            },
            "notes": self.notes,
        }


def motion_replay(
    source: Path,
    *,
    session: str | None = None,
    model: Path | None = None,
    extended: Path | None = None,
    arm: str | None = None,
    longest_s: float = 20.0,
) -> MotionReplay:
    """Simulate a session of an experiment's folder, or a log, by its base and its extended model.

    source : folder of results, or a session log. session : of the folder; by default the held-out one. model,
    extended : model files; by default those beside the log. arm : arm file. longest_s : simulated at most.
    ConfigurationError without log, model or drawing of the arm; DataError for a session that cannot be simulated.
    """
    log, others = _session(source, session)
    folder = source if source.is_dir() else source.parent
    base = _present(model or folder / MODEL, f"{source}: no model beside the log", "--model FILE")
    beside = folder / "diagnosis/model_extended.yaml"
    if extended is not None:
        _present(extended, f"{source}: no extended model", "--extended FILE")
    elif model is None and beside.is_file():
        extended = beside
    models = {"base": read_model(base)}
    if extended is not None:
        models["extended"] = read_model(extended)
        if not models["extended"].effects and model is None:
            del models["extended"]
    known = known_arm(models["base"].structure.chain, arm)
    if known is None:
        raise ConfigurationError(
            f"{source}: no arm file has these joints; name one with --arm, to draw the arm"
        )
    place = encoder_of(log, folder, models.values())
    encoder: EncoderSide = place or "link"
    stiffness = np.asarray(known.stiffness, dtype=float)
    replay = Replay(stiffness, others, longest_s=longest_s, encoder=encoder)
    for one in models.values():
        if replay(one, [log]) is None:
            raise DataError(f"{log.path.name}: {'; '.join(replay.notes)}")
    runs = {name: _without_end(done) for name, (_, done) in zip(LABELS, replay.first, strict=False)}
    side: TorqueSide = "motor" if runs["base"].joint is None else "joint"
    if getattr(runs["base"], side) is None:
        raise DataError(f"{log.path.name}: neither joint nor motor torque is in the log and the model")
    notes = (*replay.notes, *([_UNKNOWN] if place is None else []))
    return MotionReplay(log.path.stem, known, _payload(log), runs, side, notes, encoder)


def _without_end(done: Replayed) -> Replayed:
    kept: dict[str, Any] = {}
    for name in ("position", "motor", "joint", "measured"):
        values = getattr(done, name)
        kept[name] = None if values is None else values[:-_END]
    return replace(done, **kept)


def _session(source: Path, name: str | None) -> tuple[Session, list[Session]]:
    """The session, and all of its experiment in their order."""
    from ident.import_log import read_recording

    if not source.exists():
        raise ConfigurationError(
            f"{source}: no such folder or log; name an experiment's folder or a .mcap file"
        )
    if source.is_file() and name is not None:
        raise ConfigurationError(f"--session {name}: {source} is a log; name the folder of its experiment")
    folder = source if source.is_dir() else source.parent
    if source.is_file():
        of_run = ResultFolder.load(folder).sessions if (folder / SUMMARY).is_file() else {}
        log = next((one for one in of_run.values() if one.path.name == source.name), None)
        if log is None:
            log, of_run = read_recording(source, status=False), {}
        return log, list(of_run.values()) or [log]
    results = ResultFolder.load(folder)
    known = results.sessions
    if name is None:
        held_out = [
            e["name"] for e in results.summary["sessions"] if e.get("validation") and e["name"] in known
        ]
        name = next(iter([*held_out, *reversed(known)]), None)
    if name not in known:
        there = ", ".join(known) or "none"
        raise ConfigurationError(f"{folder}: no readable log of session {name!r}; there are: {there}")
    return known[name], list(known.values())


def _present(path: Path, subject: str, option: str) -> Path:
    if not path.is_file():
        raise ConfigurationError(f"{subject} ({path} does not exist); name one with {option}")
    return path


def _payload(session: Session) -> Payload | None:
    experiment, name = attached_experiment(session), payload_name(session)
    plans = () if experiment is None else experiment.sessions
    return next((plan.payload for plan in plans if plan.payload and plan.payload.name == name), None)


def serve(shown: MotionReplay, port: int, tell: Callable[[str], None]) -> None:
    """Show the replay in a viser server with play, speed and time slider until Ctrl-C.

    tell : called with the address of the ready page. ConfigurationError for a port in use.
    """
    from runner.scene import start_server, stop_server

    server = start_server(port)
    try:
        page = _Page(server, shown)
        tell(f"http://127.0.0.1:{server.get_port()}")
        while True:
            page.step()
            time.sleep(1.0 / _FRAMES_PER_S)
    except KeyboardInterrupt:
        pass
    finally:
        stop_server(server)


class _Page:
    """The page of a replay; `step` brings it to the next moment."""

    def __init__(self, server: Any, shown: MotionReplay) -> None:
        from runner.scene import GHOST, ArmShape

        self.shown, gui, names = shown, server.gui, shown.arm.joint_names
        server.scene.add_grid("/ground", width=3.0, height=3.0, cell_size=0.1, section_size=0.5)
        self.measured = ArmShape(server.scene, shown.arm, "/measured", payload=shown.payload)
        look: dict[str, Any] = {"payload": shown.payload, "colour": GHOST, "opacity": 0.35, "base": False}
        self.ghost = ArmShape(server.scene, shown.arm, "/simulated", **look)
        gui.configure_theme(control_width="large", show_share_button=False)
        gui.add_markdown(f"## Replay of {shown.session}")
        begin, end = round(float(shown.time[0]), 2), round(float(shown.time[-1]), 2)
        driven = shown.runs["base"].position is not None
        with gui.add_folder("Replay"):
            self.play = gui.add_checkbox("play", True)
            self.at = gui.add_slider("time [s]", begin, end, 0.01, begin)
            self.speed = gui.add_dropdown("speed", [f"{speed:g}x" for speed in SPEEDS], initial_value="1x")
            self.model = gui.add_dropdown("simulated by", [LABELS[name] for name in shown.runs])
            self.visible = gui.add_checkbox("show the simulated arm", driven, disabled=not driven)
            self.enlarged = gui.add_number(
                "deviation enlarged", shown.enlarged, min=1.0, step=1.0, disabled=not driven
            )
        self.joint = gui.add_dropdown("joint of the plot", list(names), initial_value=names[shown.told_joint])
        colours = [STYLES["computed"].colour, STYLES["measured"].colour]
        lines = [
            {"label": LABELS[name], "stroke": colour, "width": 1.5}
            for name, colour in zip(shown.runs, colours, strict=False)
        ]
        point = {"label": "now", "stroke": "#000000", "points": {"show": True, "size": 9}}
        self.plot = gui.add_uplot(
            tuple(np.zeros(1) for _ in range(len(lines) + 2)),
            ({"label": "t"}, *lines, point),
            title=f"{shown.side} torque, measured minus simulated [Nm]",
            axes=({"label": "time [s]"}, {"size": 56}),
            scales={"x": {"time": False}},
            height=200,
        )
        self.now = gui.add_markdown("")
        gui.add_markdown(
            "Solid: measured. Green: simulated, its deviation enlarged. A link turns red with the torque error of its "
            "joint; full red is the largest one by the base model."
        )
        gui.add_markdown(_summary(shown))
        self.count, self.plotted = 0, -1

    def step(self) -> None:
        """The next moment, or the one of the slider."""
        shown = self.shown
        if self.play.value:
            begin, end = self.at.min, self.at.max
            later = self.at.value + float(self.speed.value.rstrip("x")) / _FRAMES_PER_S
            self.at.value = round(begin if later > end else later, 2)
        row = int(np.argmin(np.abs(shown.time - self.at.value)))
        model = next(name for name in shown.runs if LABELS[name] == self.model.value)
        self.measured.pose(shown.measured[row])
        simulated = shown.simulated(model, float(self.enlarged.value))
        self.ghost.root.visible = simulated is not None and self.visible.value
        if simulated is not None:
            self.ghost.pose(simulated[row])
        level = np.nan_to_num(np.abs(shown.torque_error(model)[row]) / shown.scale)
        for joint, share in enumerate(level):
            self.measured.paint(joint + 1, error_colour(float(share)))
        self.count += 1
        if self.count % _TEXT_EVERY == 1:
            self.now.content = _moment(shown, model, row)
            self._mark(row, model)

    def _mark(self, row: int, model: Simulated) -> None:
        shown, joint = self.shown, self.shown.arm.joint_names.index(self.joint.value)
        errors = [np.nan_to_num(shown.torque_error(name)[:, joint]) for name in shown.runs]
        if joint != self.plotted:
            # Without a range of its own the plot is blank: the point of the moment is NaN elsewhere.
            largest = 1.1 * max(float(np.abs(error).max()) for error in errors) or 1.0
            self.plot.scales = {"x": {"time": False}, "y": {"range": (-largest, largest)}}
            self.plotted = joint
        here = np.full(len(shown.time), np.nan)
        here[row] = np.nan_to_num(shown.torque_error(model)[row, joint])
        self.plot.data = (shown.time, *(np.ascontiguousarray(error) for error in errors), here)


def error_colour(share: float) -> tuple[int, int, int]:
    """Colour of a link by the share (0 to 1) of its largest torque error, in a few steps."""
    from runner.scene import ALARM, BODY

    step = round(min(share, 1.0) * _LEVELS) / _LEVELS
    red, green, blue = (round(a + step * (b - a)) for a, b in zip(BODY, ALARM, strict=True))
    return red, green, blue


def _moment(shown: MotionReplay, model: Simulated, row: int) -> str:
    """The deviations at a moment, as a table in Markdown."""
    lines = [f"**t = {shown.time[row]:.2f} s**, {LABELS[model]}", ""]
    lines += ["| measured minus simulated | position mrad | torque Nm |", "|:--|--:|--:|"]
    position, torque = shown.runs[model].position, shown.torque_error(model)[row]
    for joint, name in enumerate(shown.arm.joint_names):
        away = "–" if position is None else f"{1e3 * position[row, joint]:+.2f}"
        error = "at rest" if np.isnan(torque[joint]) else f"{torque[joint]:+.2f}"
        lines.append(f"| {name} | {away} | {error} |")
    return "\n".join(lines)


def _summary(shown: MotionReplay) -> str:
    """Root mean square errors of each joint by model, as a table in Markdown."""
    head = "| rms error |" + "".join(f" {LABELS[m]} mrad | Nm |" for m in shown.runs)
    lines = ["", head, "|:--|" + "--:|--:|" * len(shown.runs)]
    found = [shown.rms(model) for model in shown.runs]
    for joint, name in enumerate(shown.arm.joint_names):
        cells = "".join(
            f" {'–' if position is None else f'{1e3 * position[joint]:.3f}'} | {torque[joint]:.3f} |"
            for position, torque in found
        )
        lines.append(f"| {name} |{cells}")
    # A sentence each, as a paragraph.
    place = () if _UNKNOWN in shown.notes else (f"encoders simulated at the {shown.encoder}s",)
    return "\n".join(lines) + "".join(f"\n\n{note}" for note in (*place, *shown.notes))
