"""The arm and its cell as primitive shapes in a viser scene, for preview, live view and replay.

viser is part of the extra `view`; only these three import this module.
"""

from __future__ import annotations

import io
import logging
import socket
from contextlib import redirect_stdout
from html import escape
from importlib import resources
from typing import Any

import coal
import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from fri.errors import ConfigurationError
from lwr_driver.arm import Arm
from lwr_driver.arm.cell import Cell
from runner.experiment_file import Payload

Floats = NDArray[np.float64]
Colour = tuple[int, int, int]

BODY: Colour = (190, 196, 202)
JOINT: Colour = (0, 114, 178)
GHOST: Colour = (0, 158, 115)
ALARM: Colour = (213, 94, 0)
CARRIED: Colour = (86, 86, 86)
# The texts of viser's widgets are pale, and its panel leaves a third of a telephone's width empty.
_LEGIBLE = """
label, .mantine-Slider-markLabel, .mantine-Notification-description { color: #343a40 !important; }
.mantine-Button-root:not([data-disabled]) { background: #1864ab !important; }
@media (max-width: 36em) { [style*="width: 20em"] { width: 100% !important; } }
"""
_DENSITY = 2700.0  # of a payload without shape, drawn as an aluminium ball [kg/m³]


def start_server(port: int = 0, *, host: str = "127.0.0.1") -> Any:
    """A viser server for this computer only.

    port : 0 for any free one. ConfigurationError without the extra `view` and for a port in use.
    """
    try:
        import viser
    except ImportError as error:
        from runner.report.interactive import INSTALL

        raise ConfigurationError(f"3D view: {INSTALL}") from error
    # viser reports connections on its own loggers and on standard output.
    logging.getLogger("websockets").setLevel(logging.ERROR)
    # viser would silently take the next free port.
    port = _free_port(host, port)
    with redirect_stdout(io.StringIO()):
        server = viser.ViserServer(host=host, port=port, verbose=False)
    server.scene.set_up_direction("+z")
    server.scene.configure_default_lights(True, cast_shadow=False)
    # The light of viser's panorama costs a computer without a graphics card seconds before the first picture.
    server.scene.configure_environment_map(None)
    server.scene.add_light_hemisphere(
        "/sky", sky_color=(235, 240, 245), ground_color=(150, 145, 140), intensity=2.2
    )
    server.gui.add_html(_widgets())
    server.initial_camera.position = (1.45, -1.35, 1.05)
    server.initial_camera.look_at = (0.0, 0.0, 0.45)
    return server


def _widgets() -> str:
    """HTML to mend the look of viser's widgets and give them names; a script element would not run there."""
    return f"<style onload='{escape(_script(), quote=True)}'>{_LEGIBLE}</style>"


def named_page(page: str) -> str:
    """A page made by viser, its widgets with names."""
    head, end, tail = page.rpartition("</body>")
    return f"{head}<style>{_LEGIBLE}</style><script>{_script()}</script>{end}{tail}" if end else page


def _script() -> str:
    return resources.files("runner").joinpath("scene.js").read_text(encoding="utf-8")


def stop_server(server: Any) -> None:
    """End a server without its message on standard output."""
    with redirect_stdout(io.StringIO()):
        server.stop()


def line_colour(colour: Colour) -> Colour:
    """The colour as linear light, expected by viser for lines with individual colours."""
    red, green, blue = (round(255 * (value / 255) ** 2.2) for value in colour)
    return red, green, blue


def _free_port(host: str, port: int) -> int:
    """The port, or any free one for 0. ConfigurationError for a port in use."""
    with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((host, port))
        except OSError as error:
            raise ConfigurationError(
                f"port {port} of {host} is in use ({error.strerror}); choose another one"
            ) from error
        return int(probe.getsockname()[1])


class ArmShape:
    """The links of an arm under one node of the scene; `pose` moves them.

    scene : viser scene. name : node. colour : of the links; None takes the usual ones. opacity : 0 to 1.
    base : draw the part that no joint moves.
    """

    def __init__(
        self,
        scene: Any,
        arm: Arm,
        name: str,
        *,
        payload: Payload | None = None,
        colour: Colour | None = None,
        opacity: float | None = None,
        base: bool = True,
    ) -> None:
        self._model = pin.buildModelFromXML(arm.urdf)
        self._data = self._model.createData()
        shapes = pin.buildGeomFromUrdfString(self._model, arm.urdf, pin.GeometryType.VISUAL)
        self.root = scene.add_frame(name, show_axes=False)
        self._frames = []
        node = name
        for joint in range(1, self._model.njoints):
            placement = self._model.jointPlacements[joint]
            node = f"{node}/joint_{joint}"
            frame = scene.add_frame(
                node, show_axes=False, position=tuple(placement.translation), wxyz=_wxyz(placement.rotation)
            )
            self._frames.append((frame, placement.rotation.copy(), node))
        self._links: dict[int, list[Any]] = {}
        for index, shape in enumerate(shapes.geometryObjects):
            joint = int(shape.parentJoint)
            if joint == 0 and not base:
                continue
            parent = name if joint == 0 else self._frames[joint - 1][2]
            ball = isinstance(shape.geometry, coal.Sphere)
            shade = colour or (JOINT if ball else BODY)
            drawn = _add_shape(
                scene, f"{parent}/shape_{index}", shape.geometry, shape.placement, shade, opacity
            )
            self._links.setdefault(joint, []).append(drawn)
        if payload is not None:
            tip = self._frames[-1][2]
            geometry, placement = _payload_shape(payload)
            _add_shape(scene, f"{tip}/payload", geometry, placement, colour or CARRIED, opacity)

    def pose(self, q: Floats) -> None:
        """Put the arm into the posture q, (7,) [rad]."""
        for (frame, rotation, _), angle in zip(self._frames, q, strict=True):
            frame.wxyz = _wxyz(rotation @ _about_z(float(angle)))

    def paint(self, joint: int, colour: Colour) -> None:
        """Colour the link moved by a joint, counted from 1."""
        for drawn in self._links.get(joint, ()):
            if tuple(drawn.color) != colour:
                drawn.color = colour

    def tip(self, q: Floats) -> Floats:
        """Position (3,) of the last frame of the URDF, the flange, in the posture q, (7,) [rad]."""
        pin.framesForwardKinematics(self._model, self._data, np.asarray(q, dtype=np.float64))
        return np.array(self._data.oMf[self._model.nframes - 1].translation)


def add_cell(scene: Any, cell: Cell) -> None:
    """Ground and boxes of the cell."""
    height = 0.0 if cell.ground_z_m is None else cell.ground_z_m
    scene.add_grid(
        "/ground", width=3.0, height=3.0, cell_size=0.1, section_size=0.5, position=(0.0, 0.0, height - 0.001)
    )
    for box in cell.boxes:
        scene.add_box(
            f"/cell/{box.name}",
            color=(178, 178, 178),
            dimensions=box.size_m,
            position=box.centre_m,
            wxyz=_wxyz(pin.rpy.rpyToMatrix(np.radians(np.array(box.rpy_deg)))),
            opacity=0.6,
        )


def _payload_shape(payload: Payload) -> tuple[Any, pin.SE3]:
    shape = payload.shape
    if shape is None:
        radius = float((payload.mass / (_DENSITY * 4.0 / 3.0 * np.pi)) ** (1.0 / 3.0))
        return coal.Sphere(radius), pin.SE3(np.eye(3), np.asarray(payload.com, dtype=np.float64))
    turn = pin.rpy.rpyToMatrix(np.radians(np.array(shape.rpy_deg)))
    make = {"sphere": coal.Sphere, "cylinder": coal.Cylinder}.get(shape.shape)
    solid = coal.Box(np.array(shape.size_m)) if make is None else make(*shape.size_m)
    return solid, pin.SE3(turn, np.array(shape.centre_m))


def _add_shape(
    scene: Any, name: str, geometry: Any, placement: pin.SE3, colour: Colour, opacity: float | None
) -> Any:
    where = {"position": tuple(placement.translation), "wxyz": _wxyz(placement.rotation)}
    look = {"color": colour, "opacity": opacity}
    if isinstance(geometry, coal.Sphere):
        return scene.add_icosphere(name, radius=float(geometry.radius), **look, **where)
    if isinstance(geometry, coal.Cylinder):
        height = 2.0 * float(geometry.halfLength)
        return scene.add_cylinder(name, radius=float(geometry.radius), height=height, **look, **where)
    if isinstance(geometry, coal.Box):
        return scene.add_box(name, dimensions=tuple(2.0 * np.asarray(geometry.halfSide)), **look, **where)
    raise ConfigurationError(
        f"shape {type(geometry).__name__} of {name} cannot be drawn; use sphere, cylinder or box in the URDF"
    )


def _about_z(angle: float) -> Floats:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def _wxyz(rotation: Floats) -> tuple[float, float, float, float]:
    x, y, z, w = pin.Quaternion(np.asarray(rotation)).coeffs()
    return float(w), float(x), float(y), float(z)
