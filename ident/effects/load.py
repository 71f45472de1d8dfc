"""Causes at the flange and along the arm: a wrong payload, a changing payload, a push from outside."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from ident.dynamics import regressor
from ident.dynamics.kinematics import Chain
from ident.effects.effect import (
    Column,
    Discriminator,
    Effect,
    Form,
    FormName,
    Loads,
    Parameter,
    Parameters,
    Plant,
    Setting,
    Shape,
    Simulated,
    both_sides,
)
from ident.effects.motion import ArmMotion, Floats
from ident.effects.words import Triple, Values, quantity, quantity_text

# Places among the ten inertial parameters: mass and first moments, and the six of the inertia.
_MASS, _MOMENTS, _INERTIA = 9, (6, 7, 8), range(6)
# Friction coefficient of a loose part.
_FRICTION = 0.3
_AXES = ("moment_x", "moment_y", "moment_z")


def _body_torque(motion: ArmMotion, place: int) -> Floats:
    """Torque (N, n) of a unit of an inertial parameter in the last link's frame."""
    bodies = np.zeros_like(motion.bodies)
    bodies[-1, place] = 1.0
    return motion.torque_of(bodies)


class _Body(Simulated):
    """Mass and first moments on the last link of a simulated arm from a time on: gravity and inertia."""

    def __init__(self, effect: Effect, joint: int, values: Parameters, form: FormName) -> None:
        super().__init__(effect, joint, values, form)
        self.masses = np.array([self.values.get(name, 0.0) for name in ("mass", *_AXES)])
        self.since_s = self.values.get("time", -1.0)
        self.sliding = effect.form_of(form) is _Change.LOOSE
        self.speed: Any = None

    def load(self, time_s: float, plant: Plant, loads: Loads) -> None:
        import pinocchio as pin

        before, self.speed = self.speed, plant.velocity.copy()
        if time_s < self.since_s or before is None:
            return
        model = plant.model.copy()
        for link in range(1, model.njoints):
            model.inertias[link] = pin.Inertia.Zero()
        mass, *moments = self.masses * self.shares(plant) if self.sliding else self.masses
        model.inertias[model.njoints - 1] = pin.Inertia.FromDynamicParameters(
            np.array([mass if abs(mass) > 1e-9 else 1e-9, *moments, 0, 0, 0, 0, 0, 0], dtype=float)
        )
        acceleration = (self.speed - before) / plant.cycle_s
        loads.link_torque -= pin.rnea(model, model.createData(), plant.position, plant.velocity, acceleration)

    def shares(self, plant: Plant) -> Floats:
        """Factors (4,) of mass and first moments in the present pose of a sliding body."""
        import pinocchio as pin

        data = plant.model.createData()
        pin.forwardKinematics(plant.model, data, plant.position)
        down = np.array(plant.model.gravity.linear)
        lean = data.oMi[plant.model.nv].rotation.T @ down / np.linalg.norm(down)
        return np.append(1.0, slide(lean))


class _Payload(Effect):
    """A body on the last link, different from the model's."""

    side = "joint"
    whole_arm = True
    simulated = _Body

    def companions(self, motion: ArmMotion, joint: int, setting: Setting) -> tuple[Column, ...]:
        """The inertia of the body."""
        return tuple(both_sides(_body_torque(motion, place)) for place in _INERTIA)

    def sentence(self, values: Values, form: Form | None, names: Sequence[str]) -> list[str]:
        """Mass and first moments, as far as they are known."""
        found = [self.mass_text(values["mass"])] if "mass" in values else []
        if set(_AXES) <= set(values):
            axes = ", ".join(quantity_text(*values[axis]) for axis in _AXES)
            found.append(f"first moments (x, y, z of the last link's frame, z along its joint's axis) {axes}")
        return [", ".join(found)]

    @abstractmethod
    def mass_text(self, mass: Triple) -> str:
        """The mass in words."""


class PayloadError(_Payload):
    """Mass and first moments of the last link differ by a constant.

    The parameters of the last link, or of the identified payload, take all of it up: it shows only as a difference
    from a reference or from the announced mass.
    """

    cause = "payload_error"
    summary = "the payload is not the announced one"
    physics = "the payload on the flange is not the announced one"
    source = "Khalil, Gautier and Lemoine, ICRA 2007"
    parameters = (
        Parameter("mass", "kg", "mass above the announced one", low=-50.0, high=50.0),
        *(Parameter(name, "kg m", f"first moment in {name[-1]} of the last link") for name in _AXES),
    )
    depends_on = "position"
    confused_with = ("base_tilt", "joint_zero_offset", "sensor_gain")
    experiment = Discriminator.STATIC_POSES
    every_payload = True
    tell_apart = "weigh the payload, and hold static poses with it and without it"

    def columns(self, motion: ArmMotion, joint: int, shape: Shape) -> tuple[Column, ...]:
        """Torque of a unit mass and unit first moments in the last link, in all rows of loaded sessions."""
        share = float(motion.loaded)
        return tuple(both_sides(share * _body_torque(motion, place)) for place in (_MASS, *_MOMENTS))

    def mass_text(self, mass: Triple) -> str:
        """The mass against the announced one."""
        value, std, unit = mass
        return f"mass {quantity((abs(value), std, unit))} {'less' if value < 0.0 else 'more'} than announced"


class _Change(Form):
    JUMP = "jump", *_AXES, "mass", "time", "session"
    LOOSE = "loose", *_AXES, "time", "session"


# Largest distance of a lost part from the last link's frame [m]; a load of 7 kg slips by 0.2 m at most.
_ARM_M = 0.5
_SLIP_KG_M = 1.4


class PayloadChange(_Payload):
    """Mass and first moments of the last link jump at `time`, in the session number `session` from 1, and stay so in
    the sessions after it.

    A loose payload slides along the last link's axes under gravity. Nothing falls off, and the first moments, of half
    the way each, change their signs with the pose.
    """

    cause = "payload_change"
    summary = "the payload changes or comes loose during a session"
    physics = "the payload slips, loosens, or a part of it falls off during the motion"
    source = "Khalil, Gautier and Lemoine, ICRA 2007"
    parameters = (
        *(Parameter(name, "kg m", f"jump of the first moment in {name[-1]}") for name in _AXES),
        Parameter("mass", "kg", "jump of the mass", low=-50.0, high=50.0),
        Parameter("time", "s", "from the start of the session", shape=True),
        Parameter("session", "1", "number of the session", shape=True, fixed=True),
    )
    forms = _Change
    onsets = tuple(_Change)
    depends_on = "time"
    event = True
    confused_with = ("sensor_offset_drift", "contact", "payload_error")
    experiment = Discriminator.REPEATED_RUN
    tell_apart = "hold one static pose for a minute at the start, in the middle and at the end of the session"

    def shapes(self, setting: Setting, joint: int) -> Sequence[Shape]:
        """None: a time of each session is searched for."""
        return []

    def plausible(self, coefficients: Floats, shape: Shape) -> bool:
        """Whether the lost part, or the slip, is near the flange."""
        mass = float(coefficients[3]) if len(coefficients) > 3 else 0.0
        near = np.linalg.norm(coefficients[:3]) <= _ARM_M * abs(mass) + _SLIP_KG_M
        return super().plausible(coefficients, shape) and bool(near)

    def lasts(self, form: Form | None, motion: ArmMotion) -> bool:
        """With a payload."""
        return motion.loaded

    def columns(self, motion: ArmMotion, joint: int, shape: Shape) -> tuple[Column, ...]:
        """Torque of unit first moments and a unit mass in the last link after the time, in all loaded rows."""
        changed = round(shape["session"]) - 1
        after = np.full(len(motion.time), motion.session > changed and self.lasts(shape.form, motion))
        if motion.session == changed:
            after = motion.time >= shape["time"]
        torques = [_body_torque(motion, place) for place in _MOMENTS]
        if shape.form is _Change.LOOSE:
            place = slide(leaning(motion))
            torques = [place[:, k, None] * torque for k, torque in enumerate(torques)]
        else:
            torques.append(_body_torque(motion, _MASS))
        return tuple(both_sides(after[:, None] * torque) for torque in torques)

    def sentence(self, values: Values, form: Form | None, names: Sequence[str]) -> list[str]:
        """Size, and time of the change."""
        when = f"{quantity(values['time'])} of session {values['session'][0]:.0f}"
        told = f"it slides back and forth from {when}" if form is _Change.LOOSE else f"at {when}"
        return [*super().sentence(values, form, names), told]

    def mass_text(self, mass: Triple) -> str:
        """The jump of the mass."""
        return f"the mass changes by {quantity(mass)}"


def slide(lean: Floats) -> Floats:
    """Place of a loose body along an axis, -1 to 1, for the component of the direction of gravity along it.

    On a slope steeper than friction holds it lies at the lower end; on a smaller one it may be anywhere between.
    """
    return np.tanh(lean / _FRICTION)


def leaning(motion: ArmMotion) -> Floats:
    """Components (N, 3) of the direction of gravity along the axes of the last link."""
    chain = motion.chain
    turned = np.broadcast_to(
        chain.base_placement[:3, :3].T @ (chain.gravity / np.linalg.norm(chain.gravity)),
        (motion.q.shape[0], 3),
    )
    for joint in range(chain.n):
        # Into the joint's frame before it turns, then against its turn.
        fixed = turned @ chain.placement(joint)[:3, :3]
        angle = np.zeros(len(motion.q)) if chain.prismatic[joint] else motion.q[:, joint]
        c, s = np.cos(angle), np.sin(angle)
        turned = np.column_stack(
            [c * fixed[:, 0] + s * fixed[:, 1], c * fixed[:, 1] - s * fixed[:, 0], fixed[:, 2]]
        )
    return turned


# Uncertainty of the middle of a force, as a share of its duration: the true time curve is not a half sine.
_COURSE = 0.1


# Push beyond which it is a collision, and stops such an arm.
_STRONGEST_N = 400.0


class Contact(Effect):
    """A force [N] on a link, in axes of the base, half a sine of length `duration` around `time`."""

    cause = "contact"
    side = "joint"
    summary = "an outside force during an interval"
    physics = "something or somebody outside pushes the arm for a while"
    source = "Haddadin, De Luca and Albu-Schaeffer, IEEE Trans. Robotics 33 (2017)"
    parameters = (
        *(
            Parameter(
                f"force_{axis}",
                "N",
                f"largest force along {axis} of the base",
                low=-_STRONGEST_N,
                high=_STRONGEST_N,
            )
            for axis in "xyz"
        ),
        Parameter("time", "s", "middle of the contact, from the start of the session", shape=True),
        Parameter("duration", "s", "of the contact", shape=True, low=0.02),
        Parameter("session", "1", "number of the session", shape=True, fixed=True),
        Parameter("link", "1", "pushed link, at the origin of the frame after it", shape=True, fixed=True),
    )
    depends_on = "time"
    whole_arm = True
    event = True
    confused_with = ("cable_spring", "payload_change")
    experiment = Discriminator.REPEATED_RUN
    tell_apart = "repeat the motion: a contact is tied to the moment, a snagging cable to the posture"

    def shapes(self, setting: Setting, joint: int) -> Sequence[Shape]:
        """None: times and durations come from the residual's bursts."""
        return []

    def plausible(self, coefficients: Floats, shape: Shape) -> bool:
        """Whether the whole force is one that an arm withstands: along its links it hardly turns a joint."""
        return float(np.linalg.norm(coefficients)) <= _STRONGEST_N

    def law_std(self, parameters: Parameters, form: Form | None) -> Parameters:
        """Middle and duration, known to a part of the duration: a real push is no half sine."""
        return {"time": _COURSE * parameters["duration"], "duration": 2.0 * _COURSE * parameters["duration"]}

    def columns(self, motion: ArmMotion, joint: int, shape: Shape) -> tuple[Column, ...]:
        """Minus the Jacobian's transpose times the force over time, in all rows."""
        since = motion.time - shape["time"]
        inside = (np.abs(since) <= 0.5 * shape["duration"]) & (motion.session == round(shape["session"]) - 1)
        course = np.where(inside, np.cos(np.pi * since / shape["duration"]), 0.0)
        columns = []
        for axis in range(3):
            torque = np.zeros_like(motion.q)
            if inside.any():
                torque[inside] = -course[inside, None] * force_torque(
                    motion.chain, motion.q[inside], axis, round(shape["link"])
                )
            columns.append(both_sides(torque))
        return tuple(columns)

    def load(self, run: Simulated, time_s: float, plant: Plant, loads: Loads) -> None:
        """A torque on the links."""
        since, duration = time_s - run.values["time"], run.values["duration"]
        if abs(since) <= 0.5 * duration:
            course = np.cos(np.pi * since / duration)
            loads.link_torque += course * (
                _plant_jacobian(plant, int(run.values["link"])).T @ run.coefficients
            )

    def sentence(self, values: Values, form: Form | None, names: Sequence[str]) -> list[str]:
        """Force, link and time."""
        force = ", ".join(quantity_text(*values[f"force_{axis}"]) for axis in "xyz")
        when = f"for {quantity(values['duration'])} about {quantity(values['time'])}"
        place = f"on link {values['link'][0]:.0f}, {when} of session {values['session'][0]:.0f}"
        return [f"force (x, y, z) {force}", place]


def force_torque(chain: Chain, q: Floats, axis: int, link: int) -> Floats:
    """Torque (N, n) [Nm] of a unit force along a base axis at the end of `link` (from 1).

    The end of a link is the origin of the next frame, of the last link a point 0.1 m along its z axis. It is the
    gravity torque of a unit mass there, in a field of one unit along the axis, with its sign turned.
    """
    field = np.zeros(3)
    field[axis] = 1.0
    bodies = np.zeros((chain.n, 10))
    bodies[link - 1, _MASS] = 1.0
    bodies[link - 1, 6:9] = _end(chain, link)
    return -regressor.gravity_torque(replace(chain, gravity=field), q, bodies)


def _end(chain: Chain, link: int) -> Floats:
    """The end of a link in its own frame, (3,) [m]."""
    if link >= chain.n:
        return np.array([0.0, 0.0, 0.1])
    alpha, d, r = chain.alpha[link], chain.d[link], chain.r[link]
    return np.array([d, -np.sin(alpha) * r, np.cos(alpha) * r])


def _plant_jacobian(plant: Plant, link: int) -> Floats:
    """Jacobian (3, n) of the end of a link of a simulated arm, in axes of the base."""
    import pinocchio as pin

    model, data = plant.model, plant.model.createData()
    pin.computeJointJacobians(model, data, plant.position)
    pin.updateGlobalPlacements(model, data)
    place = data.oMi[link]
    point = np.array([0.0, 0.0, 0.1]) if link >= model.nv else model.jointPlacements[link + 1].translation
    full = pin.getJointJacobian(model, data, link, pin.ReferenceFrame.LOCAL_WORLD_ALIGNED)
    return np.asarray(full[:3] + np.cross(full[3:].T, place.rotation @ point).T)
