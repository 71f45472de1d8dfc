"""Preview of a planned motion in 3D, with limits and the tightest moment."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from html import escape
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fri.errors import ConfigurationError
from ident.excitation import ExcitationPlan
from lwr_driver.arm import Arm
from lwr_driver.arm.cell import Cell
from lwr_driver.arm.collision import Clearance, CollisionChecker
from lwr_driver.configuration import find, read_mapping
from lwr_driver.motion import Motion
from lwr_driver.references import Frozen
from runner.experiment import ExperimentProgress
from runner.experiment_file import Experiment, Payload
from runner.live import phase_at
from runner.planning import Excitations, checker, excitation_rows, session_motion
from runner.preflight import Preflight, check_motion_limits, check_path, check_torque
from runner.report.figure import inline_svg
from runner.report.markup import conditions_table
from runner.report.plot import STYLES, Line, Panel, Points
from runner.scene import ALARM, ArmShape, Colour, add_cell, line_colour, named_page, start_server, stop_server
from runner.stopping import check_stops

Floats = NDArray[np.float64]

# Of the motion shown, of the checks beside it too: ten rows a frame.
_PERIOD_S = 0.005
_FRAMES_PER_S = 20.0
_MOST_FRAMES = 1500
_CLEARANCES = 400
_POINTS = 300
_FREE: Colour = (0, 114, 178)
_NEAR: Colour = (230, 159, 0)


@dataclass(frozen=True, eq=False)
class Planned:
    """A planned motion with its checks.

    margin : least clearance allowed [m].
    """

    title: str
    arm: Arm
    cell: Cell
    payload: Payload | None
    motion: Motion
    preflight: Preflight
    margin: float

    @cached_property
    def _checker(self) -> CollisionChecker:
        return checker(self.arm, self.cell, self.payload)

    @cached_property
    def tightest(self) -> Clearance:
        """The moment of the smallest clearance."""
        return self._checker.check_path(self.motion.q, period_s=self.motion.period_s)

    @cached_property
    def rows(self) -> NDArray[np.int64]:
        """(k,) rows of the motion at even distances."""
        return _even_rows(self.motion, _CLEARANCES)

    @cached_property
    def time(self) -> Floats:
        """(k,) times of `rows` [s]."""
        return np.asarray(self.rows * self.motion.period_s, dtype=np.float64)

    @cached_property
    def distance(self) -> Floats:
        """(k,) clearances at `rows` [m]."""
        return np.array([self._checker.clearance(self.motion.q[row]).distance for row in self.rows])

    def facts(self) -> dict[str, Any]:
        """Plain content for JSON."""
        tight = self.tightest
        return {
            "title": self.title,
            "duration_s": self.motion.duration_s,
            "ok": self.preflight.ok,
            "conditions": self.preflight.items,
            "tightest": {
                "distance_m": tight.distance,
                "pair": tight.pair,
                "time_s": tight.time_s,
                "q": tight.q,
            },
            "must_be_kept_m": self.margin,
        }

    def at(self, row: int) -> str:
        """Clearance at a row of the motion, and the joint closest to its limit."""
        limits, q = self.arm.limits, self.motion.q[row]
        room = np.minimum(limits.q_high - q, q - limits.q_low)
        joint = int(np.argmin(room))
        distance = float(np.interp(row * self.motion.period_s, self.time, self.distance))
        return (
            f"clearance **{1000 * distance:.0f} mm**, {self.arm.joint_names[joint]} "
            f"**{np.degrees(room[joint]):.0f}°** from its limit"
        )


def planned_motion(file: str, *, session: str | None = None) -> Planned:
    """The motion of an experiment file, of the folder of an experiment with its plan, or of a plan file.

    session : of the experiment; by default the one with the heaviest payload. A plan alone is shown with the
    default arm and cell. ConfigurationError for any other file.
    """
    folder = Path(file)
    results = folder if folder.is_dir() else None
    if results is not None:
        frozen = Frozen(folder.resolve())
        path = frozen.root() if frozen.there else (folder / "experiment.yaml").resolve()
        beside = path.parent if frozen.there else ExperimentProgress.load(folder).origin
        experiment = Experiment.load(path, beside=beside)
    else:
        path = find(file)
        if read_mapping(path).get("kind") == "excitation plan":
            return _of_plan(path)
        experiment = Experiment.load(path)
    arm = Arm.load(experiment.arm, beside=experiment.folder)
    cell = Cell.load(experiment.cell, beside=experiment.folder)
    plans = {plan.name: plan for plan in experiment.sessions}
    if session is not None and session not in plans:
        raise ConfigurationError(f"session {session!r} is not in {path}; it has {', '.join(plans)}")
    heaviest = max(experiment.sessions, key=lambda one: 0.0 if one.payload is None else one.payload.mass)
    plan = plans[session] if session is not None else heaviest
    rows = Excitations.of(experiment, arm, cell, results).rows(plan, _PERIOD_S)
    home = experiment.home(len(arm.joint_names))
    motion, preflight = session_motion(experiment, arm, cell, plan, rows, home)
    margin = max(experiment.moves.clearance_m, cell.margin_m)
    title = f"{experiment.name}, session {plan.name}"
    return Planned(title, arm, cell, plan.payload, motion, preflight, margin)


def _of_plan(path: Path) -> Planned:
    arm, cell = Arm.load(), Cell.load()
    plan = ExcitationPlan.load(path)
    if plan.joint_names != arm.joint_names:
        raise ConfigurationError(
            f"{path}: joints {', '.join(plan.joint_names)} are not those of {arm.name}; preview an experiment "
            "file with that arm"
        )
    motion = excitation_rows(plan, 1)(_PERIOD_S)
    collision = checker(arm, cell, None)
    items = [
        *check_motion_limits(arm, motion),
        check_torque(arm, motion, None),
        check_path(collision, motion, cell.margin_m),
        *check_stops(arm, collision, motion, None, cell.margin_m),
    ]
    return Planned(f"plan {path.name}", arm, cell, None, motion, Preflight(tuple(items)), cell.margin_m)


def _even_rows(motion: Motion, count: int) -> NDArray[np.int64]:
    return np.unique(np.linspace(0, len(motion) - 1, count).astype(np.int64))


def build_scene(server: Any, planned: Planned) -> ArmShape:
    """Cell, path of the flange coloured by clearance, tightest moment, and the arm at the start."""
    scene = server.scene
    add_cell(scene, planned.cell)
    arm = ArmShape(scene, planned.arm, "/arm", payload=planned.payload)
    motion = planned.motion
    path = np.array([arm.tip(motion.q[row]) for row in planned.rows])
    near = np.minimum(planned.distance[1:], planned.distance[:-1])
    colours = np.array([line_colour(_colour(float(value), planned.margin)) for value in near], dtype=np.uint8)
    if len(path) > 1:
        segments = np.stack([path[:-1], path[1:]], axis=1).astype(np.float32)
        doubled = np.repeat(colours[:, None, :], 2, axis=1)
        scene.add_line_segments("/path", segments, doubled, thickness=2.5, thickness_units="screen")
    tight = planned.tightest
    ghost = ArmShape(scene, planned.arm, "/tightest/arm", payload=planned.payload, colour=ALARM, opacity=0.28)
    ghost.pose(tight.q)
    points = tight.points.astype(np.float32)[None]
    scene.add_line_segments("/tightest/gap", points, ALARM, thickness=5.0, thickness_units="screen")
    scene.add_label(
        "/tightest/label",
        f"tightest: {1000 * tight.distance:.0f} mm, {' to '.join(tight.pair)}, t = {tight.time_s:.2f} s",
        position=tuple(tight.points.mean(axis=0)),
    )
    arm.pose(motion.q[0])
    return arm


def preview_html(planned: Planned) -> str:
    """One self-contained page: the motion in 3D with a time slider, the limits, and the clearance over time."""
    server = start_server()
    try:
        arm = build_scene(server, planned)
        recording = server.get_scene_serializer()
        rows, step = _frames(planned.motion)
        for row in rows:
            arm.pose(planned.motion.q[row])
            recording.insert_sleep(step)
        # As the value of an attribute in single quotes.
        scene = named_page(recording.as_html()).replace("&", "&amp;").replace("'", "&#39;")
    finally:
        stop_server(server)
    style = resources.files("runner").joinpath("preview.css").read_text(encoding="utf-8")
    ok = planned.preflight.ok
    verdict = "every condition holds" if ok else "refused: not every condition holds"
    mark = "\N{CHECK MARK}" if ok else "\N{MULTIPLICATION X}"
    tight = planned.tightest
    joints = "".join(map(inline_svg, _joint_panels(planned)))
    conditions = conditions_table(map(vars, planned.preflight.items), "Conditions before the motion")
    return (
        "<!doctype html><html lang=en><head><meta charset=utf-8>"
        "<meta name=viewport content='width=device-width, initial-scale=1'>"
        f"<title>Preview of {escape(planned.title)}</title><link rel=icon href='data:,'>"
        f"<style>{style}</style></head><body><main>"
        "<section class=view><iframe title='The planned motion in 3D, with time slider' "
        f"srcdoc='{scene}'></iframe><p class=key><b><i class=free></i>path of the flange, free</b> "
        "<b><i class=near></i>near</b> <b><i class=alarm></i>tightest moment</b></p></section>"
        f"<section class=facts><h1>Preview of {escape(planned.title)}</h1>"
        f"<p class='verdict {'good' if ok else 'bad'}'>{mark} {verdict}</p>"
        f"<p>{planned.motion.duration_s:.1f} s. Tightest moment: <b>{1000 * tight.distance:.0f} mm</b>, "
        f"{escape(' to '.join(tight.pair))}, at t = {tight.time_s:.2f} s; "
        f"{1000 * planned.margin:.0f} mm must be kept.</p>{conditions}"
        f"<h2>Clearance</h2>{inline_svg(_clearance_panel(planned))}"
        f"<h2>Joints within their limits</h2><div class=joints>{joints}</div>"
        "</section></main></body></html>\n"
    )


def serve(planned: Planned, port: int, tell: Callable[[str], None]) -> None:
    """Show the motion in a viser server with play and time slider until Ctrl-C.

    tell : called with the address of the ready page. ConfigurationError for a port in use.
    """
    server = start_server(port)
    try:
        arm = build_scene(server, planned)
        duration, tight = planned.motion.duration_s, planned.tightest
        gui = server.gui
        gui.configure_theme(control_width="large", show_share_button=False)
        gui.add_markdown(f"## Preview of {planned.title}")
        with gui.add_folder("Motion"):
            play = gui.add_checkbox("play", True)
            at = gui.add_slider("time [s]", 0.0, round(duration, 2), 0.01, 0.0)
            now = gui.add_markdown("")
            show = gui.add_checkbox("show the tightest moment", True)
            go = gui.add_button("go to the tightest moment")
        gui.add_markdown(
            f"Tightest moment: **{1000 * tight.distance:.0f} mm**, {' to '.join(tight.pair)}, at t = "
            f"{tight.time_s:.2f} s; {1000 * planned.margin:.0f} mm must be kept."
        )
        gui.add_uplot(
            (planned.time, 1000.0 * planned.distance, np.full(len(planned.time), 1000.0 * planned.margin)),
            (
                {"label": "t"},
                {"label": "clearance", "stroke": STYLES["measured"].colour, "width": 2},
                {"label": "must be kept", "stroke": STYLES["computed"].colour, "dash": (4, 4)},
            ),
            title="clearance [mm] over time [s]",
            scales={"x": {"time": False, "range": (0.0, duration)}},
            height=200,
        )
        lines = [
            f"{'✓' if item.ok else '✗'} **{item.subject}**: {item.value}, limit {item.limit}"
            for item in planned.preflight.items
        ]
        gui.add_markdown("  \n".join(lines))
        tightest = server.scene.add_frame("/tightest", show_axes=False)

        @go.on_click  # type: ignore[untyped-decorator]
        def _(event: Any) -> None:
            play.value, at.value = False, round(tight.time_s, 2)

        tell(f"http://127.0.0.1:{server.get_port()}")
        while True:
            if play.value:
                at.value = round((at.value + 1.0 / _FRAMES_PER_S) % duration, 2)
            row = min(round(at.value / planned.motion.period_s), len(planned.motion) - 1)
            arm.pose(planned.motion.q[row])
            now.content = f"phase **{phase_at(planned.motion.phases, row)}**, {planned.at(row)}"
            tightest.visible = show.value
            time.sleep(1.0 / _FRAMES_PER_S)
    except KeyboardInterrupt:
        pass
    finally:
        stop_server(server)


def _frames(motion: Motion) -> tuple[list[int], float]:
    count = int(min(max(2, motion.duration_s * _FRAMES_PER_S), _MOST_FRAMES))
    rows = np.linspace(0, len(motion) - 1, count).astype(np.int64)
    return rows.tolist(), motion.duration_s / count


def _colour(distance: float, margin: float) -> Colour:
    if distance < margin:
        return ALARM
    return _NEAR if distance < 3.0 * margin else _FREE


def _clearance_panel(planned: Planned) -> Panel:
    span = np.array([0.0, planned.motion.duration_s])
    tight = planned.tightest
    return Panel(
        "smallest distance",
        "time [s]",
        "[mm]",
        (
            Line("limit", "must be kept", span, np.full(2, 1000.0 * planned.margin)),
            Line("measured", "clearance", planned.time, 1000.0 * planned.distance),
            Points("published", "tightest", np.array([tight.time_s]), np.array([1000.0 * tight.distance])),
        ),
        f"Smallest distance over time: {1000 * tight.distance:.0f} mm at {tight.time_s:.2f} s, limit "
        f"{1000 * planned.margin:.0f} mm.",
        f"tightest {1000 * tight.distance:.0f} mm at {tight.time_s:.2f} s (diamond)",
    )


def _joint_panels(planned: Planned) -> Sequence[Panel]:
    motion, limits = planned.motion, planned.arm.limits
    rows = _even_rows(motion, _POINTS)
    time_s, span = np.asarray(rows * motion.period_s, dtype=np.float64), np.array([0.0, motion.duration_s])
    panels = []
    for k, joint in enumerate(planned.arm.joint_names):
        q = np.degrees(motion.q[:, k])
        low, high = np.degrees(limits.q_low[k]), np.degrees(limits.q_high[k])
        room = min(high - q.max(), q.min() - low)
        panels.append(
            Panel(
                joint,
                "time [s]",
                "position [°]",
                (
                    Line("limit", "limit", span, np.full(2, low)),
                    Line("limit", "", span, np.full(2, high)),
                    Line("measured", "planned", time_s, q[rows]),
                ),
                f"Planned position of {joint}: {q.min():.0f} to {q.max():.0f} degrees, limits {low:.0f} to "
                f"{high:.0f}.",
                f"{room:.0f}° to the limit",
            )
        )
    return panels
