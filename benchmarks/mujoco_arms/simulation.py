"""One motion of an arm in MuJoCo: positions and torques as they are, before any sensor."""

from __future__ import annotations

import itertools
import xml.etree.ElementTree as ET
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from benchmarks.mujoco_arms.arms import Individual, Kind
from benchmarks.mujoco_arms.friction import DRIVE, ELEMENTS, make_loop

Floats = NDArray[np.float64]

STEP_S = 5e-4
RECORD_S = 1e-3
SETTLE_S = 1.0
"""At rest before the record, so that the springs are in balance."""

_COOLING_S = 900.0
_OF_THE_ARM = (
    *(
        "inertia",
        "coulomb",
        "viscous",
        "stiffness",
        "stribeck",
        "stribeck_speed",
        "curve",
        "asymmetry",
        "load",
    ),
    *("coulomb_kelvin", "viscous_kelvin", "heat", "presliding", "bearing"),
)


@dataclass(frozen=True)
class Payload:
    """What hangs at the flange: mass [kg], centre in the flange's frame [m], radii of gyration [m]."""

    mass: float = 0.0
    centre: tuple[float, float, float] = (0.0, 0.0, 0.0)
    gyration: tuple[float, float, float] = (0.05, 0.05, 0.05)


@dataclass(frozen=True)
class Body:
    """What the MuJoCo model is built of besides the arm.

    gravity : [m/s2] in the base frame. hoses : (joint, stiffness [Nm/rad], rest angle [rad]) each a tendon
    long_hose : stiffness [N/m] of a hose along the arm. base : stiffness of the stand [Nm/rad], 0 for rigid
    slosh : (mass [kg], frequency [Hz], damping ratio) of a fluid in the payload
    rattle : (mass [kg], play [m]) of a part that slides in the payload
    """

    payload: Payload = Payload()
    gravity: tuple[float, float, float] = (0.0, 0.0, -9.81)
    hoses: tuple[tuple[int, float, float], ...] = ()
    long_hose: float = 0.0
    base: float = 0.0
    slosh: tuple[float, float, float] | None = None
    rattle: tuple[float, float] | None = None


@dataclass(frozen=True)
class Plant:
    """An arm on one day, in one session: what `simulate` needs besides the motion.

    drive : array of `DRIVE`. kp, kd : of the controller. kelvin : of the drives at the beginning
    zero : added to the true angle by the encoder that the controller trusts [rad]
    change : (time [s], payload afterwards). push : (from [s], to [s], body, force and torque (6,))
    """

    kind: Kind
    drive: NDArray[Any]
    body: Body
    kp: Floats
    kd: Floats
    kelvin: Floats
    zero: Floats
    change: tuple[float, Payload] | None = None
    push: tuple[float, float, str, tuple[float, ...]] | None = None

    def with_drive(self, joint: int, **values: float) -> Plant:
        """The plant with other values of one drive; joint from 0."""
        drive = self.drive.copy()
        for name, value in values.items():
            drive[name][joint] = value
        return replace(self, drive=drive)


@dataclass(frozen=True)
class Truth:
    """What happened, every `RECORD_S` from the beginning of the motion, (m, n) each.

    motor : angle of the motors [rad]. link : angle of the joints [rad]. drive : torque of the motors [Nm]
    joint : torque through the gears [Nm]. command : commanded angle [rad]. kelvin : warmth of the drives
    """

    motor: Floats
    link: Floats
    drive: Floats
    joint: Floats
    command: Floats
    kelvin: Floats

    def __len__(self) -> int:
        return len(self.motor)


def drives(arm: Individual) -> NDArray[Any]:
    """Parameters of all drives of the healthy arm."""
    drive = np.zeros(arm.kind.size, dtype=DRIVE)
    for name in _OF_THE_ARM:
        drive[name] = getattr(arm, name)
    drive["damping"] = arm.kind.damping
    drive["speed"], drive["gear"], drive["cooling"] = arm.kind.speed, arm.kind.gear, _COOLING_S
    drive["place_cycles"] = 1.0
    drive["ripple_1"], drive["ripple_2"] = arm.ripple
    drive["phase_1"], drive["phase_2"] = arm.ripple_phase
    return drive


def build(kind: Kind, drive: NDArray[Any], body: Body) -> mujoco.MjModel:
    """The MuJoCo model: per joint a motor with its rotor, and a second hinge behind it where it is elastic."""
    spec = mujoco.MjSpec.from_string(_on_stand(kind, body.base <= 0.0))
    spec.compiler.fusestatic = False
    spec.option.timestep = STEP_S
    spec.option.gravity = body.gravity
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_EULER
    off = mujoco.mjtDisableBit
    spec.option.disableflags = off.mjDSBL_CONTACT | off.mjDSBL_EULERDAMP | off.mjDSBL_FRICTIONLOSS
    if body.rattle is None:
        spec.option.disableflags |= off.mjDSBL_CONSTRAINT
    hinges = {joint.name: joint for joint in spec.joints}
    for j, name in enumerate(kind.joints):
        hinge = hinges[name]
        hinge.armature = float(drive["inertia"][j])
        hinge.limited = mujoco.mjtLimited.mjLIMITED_FALSE
        hinge.damping = np.zeros_like(hinge.damping)
        hinge.frictionloss = 0.0
        if drive["stiffness"][j] > 0.0:
            spec.body(hinge.parent.name).add_joint(
                name=f"{name}_spring", type=mujoco.mjtJoint.mjJNT_HINGE, axis=hinge.axis, pos=hinge.pos
            )
    _payload(spec, kind, body)
    for name in ("stand_x", "stand_y") if body.base > 0.0 else ():
        rocking = spec.joint(name)
        rocking.stiffness = _first(rocking.stiffness, body.base)
        rocking.damping = _first(rocking.damping, 0.01 * body.base / 30.0)
    _hoses(spec, kind, body, drive)
    # Both gains stand in the controls: torque = kp (q_ref - q) + kd (qd_ref - qd), see `_tune`.
    for prefix in ("p", "d"):
        for name in kind.joints:
            spec.add_actuator(name=f"{prefix}_{name}", target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
    return spec.compile()


def _payload(spec: mujoco.MjSpec, kind: Kind, body: Body) -> None:
    flange = spec.body(kind.flange)
    mass = max(body.payload.mass, 1e-6)
    flange.add_body(
        name="payload",
        pos=body.payload.centre,
        ipos=(0.0, 0.0, 0.0),
        mass=mass,
        inertia=mass * np.square(body.payload.gyration),
        explicitinertial=True,
    )
    if body.slosh is not None:
        fluid, hertz, ratio = body.slosh
        stiffness = fluid * (2.0 * np.pi * hertz) ** 2
        part = flange.add_body(
            name="fluid",
            pos=body.payload.centre,
            ipos=(0.0, 0.0, 0.0),
            mass=fluid,
            inertia=[fluid * 1e-4] * 3,
            explicitinertial=True,
        )
        for axis, name in (((1, 0, 0), "fluid_x"), ((0, 1, 0), "fluid_y")):
            part.add_joint(
                name=name,
                type=mujoco.mjtJoint.mjJNT_SLIDE,
                axis=axis,
            )
            spring = part.joints[-1]
            spring.stiffness = _first(spring.stiffness, stiffness)
            spring.damping = _first(spring.damping, 2.0 * ratio * np.sqrt(stiffness * fluid))
    if body.rattle is not None:
        loose, play = body.rattle
        part = flange.add_body(
            name="loose",
            pos=body.payload.centre,
            ipos=(0.0, 0.0, 0.0),
            mass=loose,
            inertia=[loose * 1e-4] * 3,
            explicitinertial=True,
        )
        part.add_joint(
            name="loose_slide",
            type=mujoco.mjtJoint.mjJNT_SLIDE,
            axis=(0, 1, 0),
            range=(-play / 2, play / 2),
            limited=mujoco.mjtLimited.mjLIMITED_TRUE,
            solref_limit=(0.01, 0.6),
        )


def _on_stand(kind: Kind, stiff: bool) -> str:
    """The URDF, with a stand that rocks about two level axes under the first joint unless it is `stiff`."""
    if stiff:
        return kind.urdf
    root = ET.fromstring(kind.urdf)
    first = next(joint for joint in root.iter("joint") if joint.get("name") == kind.joints[0])
    parent = first.find("parent")
    assert parent is not None
    above = parent.get("link")
    for axis, name in (("1 0 0", "stand_x"), ("0 1 0", "stand_y")):
        root.append(
            ET.fromstring(
                f'<link name="{name}"><inertial><origin xyz="0 0 0.1"/><mass value="12"/>'
                '<inertia ixx="0.3" ixy="0" ixz="0" iyy="0.3" iyz="0" izz="0.3"/></inertial></link>'
            )
        )
        root.append(
            ET.fromstring(
                f'<joint name="{name}" type="continuous"><parent link="{above}"/><child link="{name}"/>'
                f'<origin xyz="0 0 0" rpy="0 0 0"/><axis xyz="{axis}"/></joint>'
            )
        )
        above = name
    parent.set("link", above)
    return ET.tostring(root, encoding="unicode")


def _hoses(spec: mujoco.MjSpec, kind: Kind, body: Body, drive: NDArray[Any]) -> None:
    for place, (j, stiffness, rest) in enumerate(body.hoses):
        tendon = spec.add_tendon(name=f"hose_{place}", springlength=[rest, rest])
        tendon.stiffness = _first(tendon.stiffness, stiffness)
        tendon.wrap_joint(kind.joints[j], 1.0)
        if drive["stiffness"][j] > 0.0:
            tendon.wrap_joint(f"{kind.joints[j]}_spring", 1.0)
    if body.long_hose > 0.0:
        # From a hook above the shoulder to the middle of the forearm.
        hook = spec.worldbody.add_site(name="hook", pos=(0.2, 0.3, 1.2))
        arm = spec.joint(kind.joints[kind.size // 2]).parent.add_site(name="clamp", pos=(0.05, 0.05, 0.1))
        tendon = spec.add_tendon(name="long_hose", springlength=[0.2, 0.2])
        tendon.stiffness = _first(tendon.stiffness, body.long_hose)
        tendon.wrap_site(hook.name)
        tendon.wrap_site(arm.name)


def _first(like: Any, value: float) -> Any:
    """`value` in the shape that this version of MuJoCo wants for stiffness and damping."""
    if np.ndim(like) == 0:
        return value
    values = np.zeros_like(like)
    values[0] = value
    return values


def _tune(model: mujoco.MjModel, kp: Floats, kd: Floats) -> None:
    n = len(kp)
    model.actuator_gaintype[:] = mujoco.mjtGain.mjGAIN_FIXED
    model.actuator_biastype[:] = mujoco.mjtBias.mjBIAS_AFFINE
    model.actuator_gainprm[:] = 0.0
    model.actuator_biasprm[:] = 0.0
    model.actuator_gainprm[:n, 0], model.actuator_biasprm[:n, 1] = kp, -kp
    model.actuator_gainprm[n:, 0], model.actuator_biasprm[n:, 2] = kd, -kd


_loop = cache(make_loop)


def simulate(plant: Plant, q: Floats, qd: Floats) -> Truth:
    """The motion with commands q, qd (m, n) every `RECORD_S` [rad, rad/s]; RuntimeError if it is unstable."""
    kind, n = plant.kind, plant.kind.size
    model = build(kind, plant.drive, plant.body)
    _tune(model, plant.kp, plant.kd)
    data = mujoco.MjData(model)
    motor = np.array([model.jnt_qposadr[model.joint(name).id] for name in kind.joints])
    spring = np.array(
        [
            model.jnt_qposadr[model.joint(f"{name}_spring").id] if plant.drive["stiffness"][j] > 0.0 else -1
            for j, name in enumerate(kind.joints)
        ]
    )
    every = round(RECORD_S / STEP_S)
    reference = _reference(q - plant.zero, qd, every)
    external = np.zeros(0)
    vector = np.zeros(0)
    if plant.push is not None:
        begin, end, name, wrench = plant.push
        times = np.arange(len(reference)) * STEP_S - SETTLE_S
        reference[:, -1] = np.clip(np.minimum(times - begin, end - times) / 0.1, 0.0, 1.0)
        external, vector = data.xfrc_applied[model.body(name).id], np.array(wrench)
    data.qpos[motor] = reference[0, :n]
    state = (
        np.zeros((n, ELEMENTS)),
        np.zeros((n, ELEMENTS)),
        np.zeros(n),
        plant.kelvin.copy(),
        np.zeros(n),
        np.zeros(n),
    )
    records = np.empty((len(reference) // every + 1, 5 * n))
    cuts = [0, len(reference)]
    if plant.change is not None:
        cuts.insert(1, every * round((plant.change[0] + SETTLE_S) / RECORD_S))
    for begin, end in itertools.pairwise(cuts):
        if begin:
            assert plant.change is not None
            _exchange(model, plant.change[1])
        out = records[begin // every :]
        _loop()(
            model._address,
            data._address,
            plant.drive,
            state,
            data.qpos,
            data.qvel,
            data.qacc,
            data.qfrc_applied,
            data.qfrc_actuator,
            data.ctrl,
            (motor, spring),
            external,
            vector,
            reference[begin:end],
            (out, every, STEP_S),
        )
    skip = round(SETTLE_S / RECORD_S)
    rows = records[skip : skip + len(q)]
    if not np.isfinite(rows).all() or data.warning[mujoco.mjtWarning.mjWARN_BADQACC].number:
        raise RuntimeError(f"{kind.name}: the simulation is unstable; lower the step")
    parts = [np.ascontiguousarray(rows[:, n * i : n * (i + 1)]) for i in range(5)]
    return Truth(parts[0], parts[1], parts[2], parts[3], q, parts[4])


def _reference(q: Floats, qd: Floats, every: int) -> Floats:
    """Commands of every step with the settling before, and a column for the push."""
    n = q.shape[1]
    rest = round(SETTLE_S / STEP_S)
    steps = np.arange(len(q) * every) / every
    rows = np.zeros((rest + len(steps), 2 * n + 1))
    grid = np.arange(len(q))
    for j in range(n):
        rows[rest:, j] = np.interp(steps, grid, q[:, j])
        rows[rest:, n + j] = np.interp(steps, grid, qd[:, j])
    rows[:rest, :n] = q[0]
    return rows


def _exchange(model: mujoco.MjModel, payload: Payload) -> None:
    """Another payload from here on."""
    body = model.body("payload").id
    mass = max(payload.mass, 1e-6)
    model.body_mass[body], model.body_ipos[body] = mass, np.zeros(3)
    model.body_pos[body] = payload.centre
    model.body_inertia[body] = mass * np.square(payload.gyration)
    mujoco.mj_setConst(model, mujoco.MjData(model))


def gravity_torque(plant: Plant, q: Floats) -> Floats:
    """Torque that holds the arm at rest at q (n,) [Nm], by MuJoCo's inverse dynamics."""
    model = build(plant.kind, plant.drive, plant.body)
    data = mujoco.MjData(model)
    data.qpos[[model.jnt_qposadr[model.joint(name).id] for name in plant.kind.joints]] = q
    mujoco.mj_forward(model, data)
    return np.array([data.qfrc_bias[model.jnt_dofadr[model.joint(name).id]] for name in plant.kind.joints])
