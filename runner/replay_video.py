"""The replay of a session as a short video: for each model the measured arm and its ghost, and the torque error.

The shapes of the URDF are projected in parallel and painted from the back to the front; no screen and no browser takes
part. The suffix chooses the format: `.mp4` (H.264, by imageio-ffmpeg) or `.gif` (by Pillow).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import coal
import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from fri.errors import ConfigurationError
from lwr_driver.arm import Arm
from runner.replay_view import LABELS, MotionReplay, Simulated, error_colour
from runner.report.plot import STYLES

Floats = NDArray[np.float64]

FORMATS = (".mp4", ".gif")
_FRAMES_PER_S = {".mp4": 25, ".gif": 12}
_SIZE, _DPI = (9.6, 5.4), 100
_GIF_COLOURS = 64
_GHOST, _GHOST_OPACITY = (0, 158, 115), 0.42
_FROM = np.array([1.45, -1.35, 0.75])  # direction of the eye
_LIGHT = np.array([0.35, -0.6, 0.72])
_BEHIND = 0.08  # of the ghost, to show no stripes where both arms are in one place [m]
_ROUND = 20


def check_format(path: Path) -> None:
    """Refuse a suffix that is no format. ConfigurationError, also without imageio-ffmpeg for `.mp4`."""
    if path.suffix not in FORMATS:
        raise ConfigurationError(
            f"{path}: suffix {path.suffix or 'none'!r} is no format of a video; end the name in {' or '.join(FORMATS)}"
        )
    if path.suffix == ".mp4":
        _ffmpeg()


def write_video(
    shown: MotionReplay,
    path: Path,
    length_s: float = 10.0,
    tell: Callable[[float], None] = lambda share: None,
) -> None:
    """Write the whole replay as a video of `length_s`, whole or not at all. tell : called with the share done."""
    check_format(path)
    rate = _FRAMES_PER_S[path.suffix]
    draft = path.with_name(f"{path.stem}.part{path.suffix}")
    write = _write_mp4 if path.suffix == ".mp4" else _write_gif
    try:
        write(
            _told(frames(shown, max(2, round(length_s * rate)), length_s), length_s * rate, tell), draft, rate
        )
        draft.replace(path)
    finally:
        draft.unlink(missing_ok=True)


def frames(shown: MotionReplay, count: int, length_s: float) -> Iterator[NDArray[np.uint8]]:
    """The pictures (height, width, 3) of `count` even moments of the replay."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    stage = _Stage(shown, length_s)
    canvas = FigureCanvasAgg(stage.figure)
    for row in np.linspace(0, len(shown.time) - 1, count).astype(int):
        stage.show(int(row))
        canvas.draw()
        yield np.asarray(canvas.buffer_rgba())[..., :3].copy()


class _Stage:
    """The figure: a scene for each model, and the torque error of one joint below."""

    def __init__(self, shown: MotionReplay, length_s: float) -> None:
        from matplotlib.collections import PolyCollection
        from matplotlib.figure import Figure

        self.shown, self.body = shown, _Body(shown.arm)
        self.figure = Figure(figsize=_SIZE, dpi=_DPI)
        self.head = self.figure.text(0.02, 0.965, "", va="top", weight="bold", fontsize=13)
        span = float(shown.time[-1] - shown.time[0])
        self.pace = f"shown {span / length_s:.2g} times as fast" if abs(span / length_s - 1) > 0.02 else ""
        note = f"solid: measured\ngreen: simulated, deviation × {shown.enlarged:g}"
        if shown.runs["base"].position is None:
            note = "solid: measured\nno motor torques, no simulated position"
        self.figure.text(0.98, 0.965, note, va="top", ha="right", fontsize=9, color="#595959")
        self.places: dict[Simulated, tuple[Any, Any]] = {}
        extent = self._extent()
        width = 0.96 / len(shown.runs)
        for place, name in enumerate(shown.runs):
            axes = self.figure.add_axes((0.02 + place * width, 0.275, width, 0.565))
            axes.set_axis_off()
            axes.set_aspect("equal")
            axes.set_xlim(*extent[0])
            axes.set_ylim(*extent[1])
            faces = PolyCollection([], linewidths=0.3)
            axes.add_collection(faces)
            text = self.figure.text(
                0.02 + (place + 0.5) * width, 0.895, "", va="top", ha="center", fontsize=10.5
            )
            self.places[name] = faces, text
        joint = shown.told_joint
        axes = self.figure.add_axes((0.09, 0.1, 0.89, 0.15))
        colours = [STYLES["computed"].colour, STYLES["measured"].colour]
        for name, colour in zip(shown.runs, colours, strict=False):
            label, error = LABELS[name], shown.torque_error(name)[:, joint]
            axes.plot(shown.time, error, color=colour, linewidth=1.0, label=label)
        self.cursor = axes.axvline(shown.time[0], color="#000000", linewidth=1.2)
        axes.set_xlim(shown.time[0], shown.time[-1])
        axes.set_xlabel("time [s]", fontsize=9, labelpad=1)
        axes.set_ylabel("[Nm]", fontsize=9)
        axes.tick_params(labelsize=8)
        title = f"{shown.side} torque of {shown.arm.joint_names[joint]}, measured minus simulated"
        axes.set_title(title, fontsize=9, loc="left", pad=3)
        axes.legend(fontsize=8, frameon=False, ncols=2, loc="lower right", bbox_to_anchor=(1.0, 0.95))
        for edge in ("top", "right"):
            axes.spines[edge].set_visible(False)

    def show(self, row: int) -> None:
        """Bring the figure to a moment."""
        shown = self.shown
        now, end = shown.time[row], shown.time[-1]
        parts = [f"{shown.session}: t = {now:.2f} of {end:.2f} s", self.pace]
        self.head.set_text(", ".join(part for part in parts if part))
        self.cursor.set_xdata([now, now])
        for name, (faces, text) in self.places.items():
            torque = np.nan_to_num(np.abs(shown.torque_error(name)[row]))
            arms = [self.body.faces(shown.measured[row], torque / shown.scale)]
            ghost = shown.simulated(name, shown.enlarged)
            if ghost is not None:
                arms.append(self.body.faces(ghost[row]))
            shapes, colours, depth = (np.concatenate(part) for part in zip(*arms, strict=True))
            order = np.argsort(-depth)
            faces.set_verts(shapes[order])
            faces.set_facecolor(colours[order])
            faces.set_edgecolor(np.where(colours[order, 3:] < 1.0, 0.0, colours[order]))
            position, rms = shown.rms(name)
            errors = f"rms error: torque {np.sqrt(np.mean(rms**2)):.2f} Nm"
            if position is not None:
                errors += f", position {1e3 * np.sqrt(np.mean(position**2)):.2f} mrad"
            text.set_text(f"{LABELS[name]}\n{errors}")

    def _extent(self) -> tuple[tuple[float, float], tuple[float, float]]:
        """Room of the picture for the whole motion [m]."""
        rows = range(0, len(self.shown.time), max(1, len(self.shown.time) // 40))
        points = np.concatenate([self.body.faces(self.shown.measured[row])[0].reshape(-1, 2) for row in rows])
        low, high = points.min(axis=0) - 0.04, points.max(axis=0) + 0.04
        return (float(low[0]), float(high[0])), (float(low[1]), float(high[1]))


class _Body:
    """The visual shapes of an arm as polygons."""

    def __init__(self, arm: Arm) -> None:
        self.model = pin.buildModelFromXML(arm.urdf)
        self.shapes = pin.buildGeomFromUrdfString(self.model, arm.urdf, pin.GeometryType.VISUAL)
        self.data, self.placed = self.model.createData(), self.shapes.createData()
        self.meshes = [_mesh(shape.geometry, shape.name) for shape in self.shapes.geometryObjects]
        forward = -_FROM / np.linalg.norm(_FROM)
        right = np.cross(forward, [0.0, 0.0, 1.0])
        right /= np.linalg.norm(right)
        self.view = np.stack([right, np.cross(right, forward), forward])

    def faces(self, q: Floats, level: Floats | None = None) -> tuple[Floats, Floats, Floats]:
        """The visible faces (k, 4, 2) [m], their colours (k, 4) and distances from the eye (k,).

        level : (n,) shares of the largest torque error, for the colours; None: a ghost.
        """
        pin.updateGeometryPlacements(
            self.model, self.data, self.shapes, self.placed, np.asarray(q, dtype=float)
        )
        found, shades = [], []
        for shape, mesh, place in zip(self.shapes.geometryObjects, self.meshes, self.placed.oMg, strict=True):
            found.append(mesh @ place.rotation.T + place.translation)
            joint = int(shape.parentJoint)
            share = 0.0 if level is None or joint == 0 else float(level[joint - 1])
            colour = _GHOST if level is None else error_colour(share)
            shades.append(np.tile(np.array(colour) / 255.0, (len(mesh), 1)))
        corners, colours = np.concatenate(found), np.concatenate(shades)
        normal = np.cross(corners[:, 2] - corners[:, 0], corners[:, 3] - corners[:, 1])
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
        seen = normal @ self.view[2] < 0.0
        light = 0.6 + 0.4 * np.clip(normal[seen] @ _LIGHT / np.linalg.norm(_LIGHT), 0.0, 1.0)
        opacity = np.full((int(seen.sum()), 1), 1.0 if level is not None else _GHOST_OPACITY)
        flat = corners[seen] @ self.view.T
        depth = flat[..., 2].mean(axis=1) + (_BEHIND if level is None else 0.0)
        return flat[..., :2], np.hstack([colours[seen] * light[:, None], opacity]), depth


def _mesh(geometry: Any, name: str) -> Floats:
    """Faces (k, 4, 3) of a shape in its own frame [m], their corners counter-clockwise from outside."""
    if isinstance(geometry, coal.Sphere):
        up = np.linspace(-0.5 * np.pi, 0.5 * np.pi, _ROUND // 2 + 1)
        ring = [(float(geometry.radius * np.cos(a)), float(geometry.radius * np.sin(a))) for a in up]
    elif isinstance(geometry, coal.Cylinder):
        radius, half = float(geometry.radius), float(geometry.halfLength)
        ring = [(0.0, -half), (radius, -half), (radius, half), (0.0, half)]
    elif isinstance(geometry, coal.Box):
        x, y, z = np.asarray(geometry.halfSide)
        corners = np.array([[i, j, k] for i in (-x, x) for j in (-y, y) for k in (-z, z)])
        sides = ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))
        return np.asarray(corners[np.array(sides)])
    else:
        raise ConfigurationError(
            f"shape {type(geometry).__name__} of {name} cannot be drawn; use sphere, cylinder or box in the URDF"
        )
    angle = np.linspace(0.0, 2.0 * np.pi, _ROUND + 1)
    turned = np.array([[(r * np.cos(a), r * np.sin(a), z) for a in angle] for r, z in ring])
    below, above = turned[:-1], turned[1:]
    return np.stack([below[:, :-1], below[:, 1:], above[:, 1:], above[:, :-1]], axis=2).reshape(-1, 4, 3)


def _told(pictures: Iterator[Any], count: float, tell: Callable[[float], None]) -> Iterator[Any]:
    for number, picture in enumerate(pictures):
        tell(number / count)
        yield picture


def _write_mp4(pictures: Iterator[NDArray[np.uint8]], path: Path, rate: int) -> None:
    first = next(pictures)
    size = first.shape[1], first.shape[0]
    video = _ffmpeg().write_frames(str(path), size, fps=rate, codec="libx264", quality=7, macro_block_size=2)
    video.send(None)
    try:
        video.send(first)
        for picture in pictures:
            video.send(picture)
    finally:
        video.close()


def _write_gif(pictures: Iterator[NDArray[np.uint8]], path: Path, rate: int) -> None:
    from PIL import Image

    drawn = [Image.fromarray(picture).quantize(_GIF_COLOURS) for picture in pictures]
    drawn[0].save(path, save_all=True, append_images=drawn[1:], duration=round(1000 / rate), loop=0)


def _ffmpeg() -> Any:
    try:
        import imageio_ffmpeg
    except ImportError as error:
        raise ConfigurationError(
            "a video as .mp4 needs imageio-ffmpeg, part of the extra `view`: pip install "
            "'lwr-identification[view]'; or end the name in .gif"
        ) from error
    return imageio_ffmpeg
