"""The hidden arm: a plant for the emulated cabinet, with joints of its own and what befalls it."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from sim_backend.plant import CYCLE_S
from sim_backend.robot import Drive, Payload, with_payload
from tests.hidden_physics.bristles import FILM_ROW, HOUSING_ROW, STATES, advance
from tests.hidden_physics.traits import TRAITS, trait_rows

__all__ = ["Contact", "HiddenArm", "Load"]

_SUBSTEPS = 4
# Steps in which the angle behind a reading is found; each gains the digits of the eccentricity.
_READINGS = 8


@dataclass(frozen=True)
class Contact:
    """Somebody or something touches the arm.

    start_s, length_s : since the cabinet was switched on. link : 1 to 7, touched at its frame's origin
    force : (3,) [N] in base axes, reached smoothly. stiffness : [N/m], of a thing that is dragged along from
    where it was caught; 0 for none
    """

    start_s: float
    length_s: float
    link: int
    force: tuple[float, float, float] = (0.0, 0.0, 0.0)
    stiffness: float = 0.0

    def at(self, time_s: float) -> float:
        """Share of the force, 0 outside the episode."""
        place = (time_s - self.start_s) / self.length_s
        return math.sin(math.pi * place) ** 2 if 0.0 < place < 1.0 else 0.0


@dataclass(frozen=True)
class Load:
    """What really hangs on the flange, against what is mounted by name.

    mass : more mass [kg]; moment : (3,) more first moments [kg m]
    from_s : since when the change is there, 0 for always. rattle : distance by which the centre of mass then
    slides along the flange's x axis, towards where gravity pulls it [m]
    """

    mass: float = 0.0
    moment: tuple[float, float, float] = (0.0, 0.0, 0.0)
    from_s: float = 0.0
    rattle: float = 0.0


class HiddenArm:
    """Plant of the emulated cabinet (`sim_backend.plant.Plant`).

    traits : see `traits`. tilt : (2,) rotations of the base about its x and y axes [rad]. contacts, load :
    see there. The public arrays are what the sensors see: the encoders' zeros are in the positions.
    """

    def __init__(
        self,
        model: pin.Model,
        drive: Drive,
        random: np.random.Generator,
        *,
        traits: Mapping[str, Mapping[Any, float]] | None = None,
        tilt: Sequence[float] = (0.0, 0.0),
        contacts: Sequence[Mapping[str, Any]] = (),
        load: Mapping[str, Any] | None = None,
    ) -> None:
        n = model.nv
        changes = {name: {int(joint): v for joint, v in row.items()} for name, row in (traits or {}).items()}
        self.traits = trait_rows(changes)
        self.bare = pin.Model(model)
        rx, ry = tilt
        turned = pin.utils.rotate("x", rx) @ pin.utils.rotate("y", ry)
        self.bare.gravity.linear = turned.T @ model.gravity.linear
        self.contacts = tuple(Contact(**contact) for contact in contacts)
        self.load = Load(**(load or {}))
        self._drive = np.array(
            [
                drive.Ia,
                drive.stiffness,
                drive.damping,
                drive.Fvm,
                drive.Fcm,
                drive.offm,
                drive.Fvl,
                drive.Fcl,
                drive.offl,
            ]
        )
        self._zero = self._row("zero")
        self._eccentric, self._eccentric_angle = self._row("eccentric"), self._row("eccentric_angle")
        self._rest = self._drive[1] * self._row("stiffness")
        self._start_warm = self._row("start_warm")
        self.position, self.velocity = np.zeros(n), np.zeros(n)
        self.motor_position, self.motor_velocity = np.zeros(n), np.zeros(n)
        self.joint_torque, self.motor_torque = np.zeros(n), np.zeros(n)
        self.inner = np.zeros((STATES, n))
        self.body = np.zeros((4, n))
        self._before = np.zeros(n)
        self._push = np.zeros(n)
        self._braked = False
        self._caught: dict[int, NDArray[np.float64]] = {}
        self.cycles = 0
        self._mounted: Payload | None = None
        self._changed = False
        self._use(None)
        self.reset(np.zeros(n))

    def _row(self, name: str) -> NDArray[np.float64]:
        return np.array(self.traits[TRAITS.index(name)])

    # -- what hangs on the flange ----------------------------------------------------------------------------

    def _use(self, payload: Payload | None, changed: bool = False, slide: float = 0.0) -> None:
        if payload is not None and changed:
            payload = _changed(payload, self.load, slide)
        self.model = with_payload(self.bare, payload)
        self._data = self.model.createData()

    def mount(self, payload: Payload | None) -> None:
        """Weld `payload` to the last link; the links come to rest."""
        self._mounted = payload
        self._changed = self.load != Load() and self.load.from_s <= self.time_s
        self._use(payload, self._changed)
        self.reset(np.array(self.position))

    def _follow_load(self) -> None:
        """The payload after its change, which may come at a time and may depend on gravity."""
        if self._mounted is None or self.load == Load() or self.time_s < self.load.from_s:
            return
        if self.load.rattle == 0.0:
            if not self._changed:
                self._changed = True
                self._use(self._mounted, True)
            return
        self._changed = True
        pin.forwardKinematics(self.bare, self._bare_data, self.body[2])
        down = self._bare_data.oMi[self.bare.nv].rotation[2, 0]
        slide = -self.load.rattle * math.tanh(4.0 * down)
        last = self.model.njoints - 1
        changed = _changed(self._mounted, self.load, slide)
        self.model.inertias[last] = self.bare.inertias[last] + changed.inertia()

    @property
    def time_s(self) -> float:
        """Time since the plant was made [s]."""
        return self.cycles * CYCLE_S

    # -- the cabinet's side ----------------------------------------------------------------------------------

    def reset(self, position: NDArray[np.float64]) -> None:
        """At rest where the encoders show `position`, springs loaded, bristles unloaded, joints as warm as at
        the beginning.
        """
        self._bare_data = self.bare.createData()
        q = np.asarray(position) - self._zero
        for _ in range(_READINGS):
            q = np.asarray(position) - self._misread(q)
        self.body[:] = 0.0
        self.body[2] = q
        needed = pin.computeGeneralizedGravity(self.model, self._data, q) + self._drive[8] - self._push
        self.body[0] = q + needed / self._rest
        self.inner[:] = 0.0
        self.inner[FILM_ROW] = self.inner[HOUSING_ROW] = self._start_warm
        self._before[:] = 0.0
        self.joint_torque[:] = needed
        self._show()

    def brake(self, engaged: bool) -> None:
        """Brakes hold the motors."""
        self._braked = engaged

    def push(self, torque: NDArray[np.float64]) -> None:
        """External torque (n,) on the links [Nm]."""
        self._push[:] = torque

    def step(self, motor_torque: NDArray[np.float64]) -> None:
        """Advance by a millisecond; `motor_torque` is what the cabinet takes for the torque [Nm]."""
        self.motor_torque[:] = motor_torque
        self._follow_load()
        speed, q = self.body[3], self.body[2]
        ahead = 1.5 * speed - 0.5 * self._before
        self._before[:] = speed
        middle = q + 0.5 * CYCLE_S * ahead
        mass = pin.crba(self.model, self._data, middle)
        bias = pin.nonLinearEffects(self.model, self._data, middle, ahead) - self._push
        for number, contact in enumerate(self.contacts):
            self._touch(number, contact, middle, bias)
        advance(
            self.body,
            self.inner,
            mass,
            bias,
            self.motor_torque,
            self._drive,
            self.traits,
            self.time_s,
            CYCLE_S,
            _SUBSTEPS,
            self._braked,
            self.joint_torque,
        )
        self.cycles += 1
        self._show()

    def _touch(
        self, number: int, contact: Contact, q: NDArray[np.float64], bias: NDArray[np.float64]
    ) -> None:
        share = contact.at(self.time_s)
        if share <= 0.0:
            self._caught.pop(number, None)
            return
        pin.computeJointJacobians(self.model, self._data, q)
        place = self._data.oMi[contact.link].translation
        caught = self._caught.setdefault(number, np.array(place))
        force = share * np.array(contact.force) + contact.stiffness * (caught - place)
        jacobian = pin.getJointJacobian(
            self.model, self._data, contact.link, pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
        )
        bias -= jacobian[:3].T @ force

    def _misread(self, angle: NDArray[np.float64]) -> NDArray[np.float64]:
        """What the encoders show beyond the angle (n,) [rad]: their zero, and a track that turns about a point beside
        its centre, so that the head sees it from another direction.
        """
        return self._zero + np.arcsin(self._eccentric * np.sin(angle + self._eccentric_angle))

    def _show(self) -> None:
        np.add(self.body[2], self._misread(self.body[2]), out=self.position)
        np.add(self.body[0], self._misread(self.body[0]), out=self.motor_position)
        self.motor_velocity[:] = self.body[1]
        self.velocity[:] = self.body[3]


def _changed(payload: Payload, load: Load, slide: float = 0.0) -> Payload:
    """`payload` with the mass and the first moments changed, its inertia about its centre of mass kept."""
    mass = payload.M + load.mass
    old = np.array([payload.MX, payload.MY, payload.MZ])
    new = old + np.array(load.moment) + mass * np.array([slide, 0.0, 0.0])
    old_centre, new_centre = old / payload.M, new / mass
    inertia = np.array(
        [
            [payload.XX, payload.XY, payload.XZ],
            [payload.XY, payload.YY, payload.YZ],
            [payload.XZ, payload.YZ, payload.ZZ],
        ]
    )
    before, after = pin.skew(old_centre), pin.skew(new_centre)
    about = (inertia + payload.M * before @ before) * (mass / payload.M)
    inertia = about - mass * after @ after
    return Payload(
        mass,
        *(float(value) for value in new),
        *(float(inertia[i, j]) for i, j in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))),
    )
