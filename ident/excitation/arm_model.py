"""The arm as motion planning needs it: geometry as plain arrays, the present estimate of the dynamics, torques.

`ident.dynamics.kinematics.Chain` is the source of every number of `Mechanism`. The compiled sweeps over the samples
cannot read objects, hence the contiguous arrays; the flange is here for the workspace limits alone.

`ArmEstimate` holds parameter values, their uncertainty and the noise: for the torque limits, for the predicted
relative standard deviations and for the weights of the rows. Each new identification replaces it.

Torques follow equations (1) to (4). In the torque bounds Coulomb friction has its full magnitude at every instant
instead of sign(qd), so a bound holds on both sides of a standstill and is a smooth function of the motion. Parameter
uncertainty adds coverage * sqrt(y C y^T), with the regressor row y and the covariance C.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numba import njit

from fri.errors import ConfigurationError
from ident.dynamics import parameters
from ident.dynamics.kinematics import Chain
from ident.dynamics.parameters import DRIVE, INERTIAL, LINK_FRICTION
from ident.dynamics.urdf import read_urdf
from ident.excitation.motions import Array, Samples
from ident.excitation.sweep import forward
from ident.model import DynamicModel
from lwr_driver.configuration import read_mapping

BODY = INERTIAL
_NO_COLUMNS = np.zeros(0, dtype=np.int64)
# drive parameters: place of the signal among qdd, qd, sign(qd), 1; members of the joint row; columns of `drives`
DRIVE_SIGNAL = {"Ia": 0, "Fvl": 1, "Fvm": 1, "Fcl": 2, "Fcm": 2, "offl": 3, "offm": 3}
JOINT_SIDE = LINK_FRICTION
IA, FVL, FCL, OFFL, FVM, FCM, OFFM = range(7)


@dataclass(frozen=True, eq=False)
class Mechanism:
    """A serial arm of revolute joints about their frames' z axes, and the flange at its end.

    rotation (n, 3, 3), translation (n, 3): placement of joint frame i in frame i - 1 at q_i = 0 [m]
    gravity (3,): [m/s²] in frame 0; tip (3,): flange in the last frame [m]
    bodies (n, 10): nominal XX XY XZ YY YZ ZZ MX MY MZ M of each link about its frame's origin
    base (4, 4): frame 0 in the root link; links (n, 4, 4): each URDF link frame in its joint frame
    """

    rotation: Array
    translation: Array
    gravity: Array
    tip: Array
    bodies: Array
    base: Array
    links: Array
    joint_names: tuple[str, ...]
    chain: Chain

    def __repr__(self) -> str:
        return f"Mechanism({self.joints} joints: {', '.join(self.joint_names)})"

    @property
    def joints(self) -> int:
        """Number of joints."""
        return int(self.translation.shape[0])

    @property
    def dynamics(self) -> tuple[Array, Array, Array]:
        """Rotation, translation, gravity, as the sweeps take them."""
        return self.rotation, self.translation, self.gravity

    @property
    def geometry(self) -> tuple[Array, Array, Array]:
        """Rotation, translation, flange, as the distances take them."""
        return self.rotation, self.translation, self.tip

    @classmethod
    def from_urdf(cls, urdf: str, tip: str = "flange") -> Mechanism:
        """Read the arm from URDF text; ConfigurationError for anything but a serial chain of revolute joints.

        tip : link bounded by the workspace; in a URDF without `flange`, the origin of the last link
        """
        chain = Chain.from_urdf(urdf)
        for name, sliding in zip(chain.joint_names, chain.prismatic, strict=True):
            if sliding:
                raise ConfigurationError(
                    f"joint {name} is prismatic; exciting motions are for revolute joints"
                )
        tree = read_urdf(urdf)
        flange = np.eye(4)
        if tip == "flange" and not any(joint.child == tip for joint in tree.joints):
            tip = chain.link_names[-1]
        for joint in tree.chain(None, tip):
            flange = np.eye(4) if joint.movable else flange @ joint.origin
        links = np.array(chain.link_placements)
        placements = np.array([chain.placement(joint) for joint in range(chain.n)])
        return cls(
            rotation=np.ascontiguousarray(placements[:, :3, :3]),
            translation=np.ascontiguousarray(placements[:, :3, 3]),
            gravity=np.array(chain.gravity),
            tip=np.ascontiguousarray((links[-1] @ flange)[:3, 3]),
            bodies=chain.urdf_inertials(),
            base=np.array(chain.base_placement),
            links=links,
            joint_names=chain.joint_names,
            chain=chain,
        )


def tip_path(mechanism: Mechanism, q: Array) -> Array:
    """Flange position (n, 3) [m] at the postures q (n, joints).

    Axes of frame 0, origin of the first joint's frame: for the LWR4+ the shoulder, 0.31 m above the base plate, the
    base frame of the paper's Denavit-Hartenberg table.
    """
    out = np.empty((q.shape[0], 3))
    _tip(mechanism.geometry, np.ascontiguousarray(q), out)
    return out


@njit(cache=True, error_model="numpy")
def _tip(arm, q, out):  # type: ignore[no-untyped-def]
    rotation, translation, tip = arm
    m, n = q.shape
    for i in range(m):
        x, y, z = tip[0], tip[1], tip[2]
        for b in range(n - 1, -1, -1):
            c, s = np.cos(q[i, b]), np.sin(q[i, b])
            u, v, w = c * x - s * y, s * x + c * y, z
            r = rotation[b]
            x = r[0, 0] * u + r[0, 1] * v + r[0, 2] * w
            y = r[1, 0] * u + r[1, 1] * v + r[1, 2] * w
            z = r[2, 0] * u + r[2, 1] * v + r[2, 2] * w
            if b > 0:
                x += translation[b, 0]
                y += translation[b, 1]
                z += translation[b, 2]
        out[i, 0], out[i, 1], out[i, 2] = x, y, z


def split_name(name: str) -> tuple[str, int]:
    """Kind and link of a parameter name: `ZZ2R` is ("ZZ", 2). The `R` of a regrouped parameter is dropped."""
    kind, link, _ = parameters.split_name(name)
    if kind not in parameters.PER_LINK or link < 1:
        raise ConfigurationError(f"parameter name {name!r} is unknown; names look like ZZ2R, MY8 or Fvm3")
    return kind, link


@dataclass(frozen=True, eq=False)
class Noise:
    """Standard deviation of the torque rows, and the number of independent samples.

    motor, joint (n,): [Nm]
    samples: independent samples (after decimation) in one session of the planned motion
    """

    motor: Array
    joint: Array
    samples: float = 100.0

    def __post_init__(self) -> None:
        for name in ("motor", "joint"):
            values = np.array(getattr(self, name), dtype=np.float64)
            if values.ndim != 1 or not np.all(values > 0) or not np.all(np.isfinite(values)):
                raise ConfigurationError(
                    f"noise of the {name} rows is {values}; one positive number per joint is needed"
                )
            object.__setattr__(self, name, values)
        if not self.samples > 0:
            raise ConfigurationError(f"noise: {self.samples} samples; at least one is needed")

    @classmethod
    def published(cls) -> Noise:
        """Row noise consistent with the published deviations of Table 2: 5 Hz after decimation, 100 samples."""
        return cls(
            motor=np.array([1.05, 2.04, 0.78, 1.44, 0.83, 0.46, 0.25]),
            joint=np.array([0.28, 0.12, 0.06, 0.11, 0.11, 0.11, 0.36]),
        )


@dataclass(frozen=True, eq=False)
class ArmEstimate:
    """Present values of the standard parameters.

    bodies (n, 10): XX XY XZ YY YZ ZZ MX MY MZ M of each link in its own frame
    drives (n, 7): Ia Fvl Fcl offl Fvm Fcm offm of each joint
    payload (10,): the payload in the last frame, None if every session is unloaded
    covariance_names, covariance: uncertainty of (base) parameters by name, (p, p); empty and None if unknown
    noise: row noise for weights and predicted deviations
    """

    bodies: Array
    drives: Array
    payload: Array | None = None
    covariance_names: tuple[str, ...] = ()
    covariance: Array | None = None
    noise: Noise | None = None

    def __post_init__(self) -> None:
        n = self.bodies.shape[0]
        if self.bodies.shape != (n, 10) or self.drives.shape != (n, 7):
            raise ConfigurationError(
                f"estimate with bodies {self.bodies.shape} and drives {self.drives.shape}; "
                "expected (n, 10) and (n, 7)"
            )
        if self.covariance is not None:
            p = len(self.covariance_names)
            if self.covariance.shape != (p, p):
                raise ConfigurationError(f"covariance of shape {self.covariance.shape} for {p} parameters")

    def __repr__(self) -> str:
        load = "no payload" if self.payload is None else f"payload {self.payload[-1]:.3g} kg"
        known = "no covariance" if self.covariance is None else f"covariance of {len(self.covariance_names)}"
        return f"ArmEstimate({self.joints} joints, {load}, {known})"

    @property
    def joints(self) -> int:
        """Number of joints."""
        return int(self.bodies.shape[0])

    @property
    def loads(self) -> Array:
        """Body parameters of each load case, unloaded first, (1 or 2, n, 10)."""
        if self.payload is None:
            return self.bodies[None].copy()
        loaded = self.bodies.copy()
        loaded[-1] += self.payload
        return np.stack([self.bodies, loaded])

    def value(self, name: str) -> float:
        """Standard parameter by name; link n + 1 is the payload."""
        kind, link = split_name(name)
        bodies = self.bodies if self.payload is None else np.vstack([self.bodies, self.payload])
        table, kinds = (self.drives, DRIVE) if kind in DRIVE else (bodies, BODY)
        if link > len(table):
            raise ConfigurationError(
                f"parameter {name} does not exist in an arm of {self.joints} joints with this payload"
            )
        return float(table[link - 1, kinds.index(kind)])

    def with_relative_uncertainty(self, fraction: float) -> ArmEstimate:
        """The same values with independent standard deviations, each a fraction of its parameter."""
        if not 0.0 <= fraction < 1.0:
            raise ConfigurationError(f"relative uncertainty {fraction} is outside 0 to 1")
        links = self.joints + (self.payload is not None)
        names = [f"{kind}{link}" for link in range(1, links + 1) for kind in BODY]
        names += [f"{kind}{link}" for link in range(1, self.joints + 1) for kind in DRIVE]
        sigma = fraction * np.array([self.value(name) for name in names])
        keep = np.abs(sigma) > 0.0
        kept = tuple(name for name, use in zip(names, keep, strict=True) if use)
        if not kept:
            return replace(self, covariance_names=(), covariance=None)
        return replace(self, covariance_names=kept, covariance=np.diag(sigma[keep] ** 2))

    @classmethod
    def nominal(cls, mechanism: Mechanism, payload: Array | None = None) -> ArmEstimate:
        """The URDF's inertias, no friction, no drive inertia: the knowledge before the first experiment."""
        return cls(mechanism.bodies.copy(), np.zeros((mechanism.joints, 7)), payload)

    @classmethod
    def from_model(
        cls, model: DynamicModel, payload: str | None = None, noise: Noise | None = None
    ) -> ArmEstimate:
        """Values and covariance of an identified model, with one of its payloads mounted."""
        joints = model.structure.chain.n
        bodies = model.inertial(None)
        load = None if payload is None else model.inertial(payload)[-1] - bodies[-1]
        drives = np.column_stack([model.drive()[kind] for kind in DRIVE])
        names: tuple[str, ...] = ()
        covariance = None
        if model.covariance is not None:
            last = None if payload is None else model.structure.payload_link(payload)
            keep, renamed = [], []
            for index, name in enumerate(model.names):
                kind, link = split_name(name)
                if link <= joints or (last is not None and link == last + 1):
                    keep.append(index)
                    renamed.append(f"{kind}{min(link, joints + 1)}")
            names, covariance = tuple(renamed), model.covariance[np.ix_(keep, keep)]
        return cls(bodies, drives, load, names, covariance, noise)

    @classmethod
    def from_file(cls, path: Path, joints: int, payload: str | None = None) -> ArmEstimate:
        """Read `parameters` (name: value) and `payloads` from a YAML file such as `emulator/table2.yaml`."""
        content = read_mapping(path)
        values = content.get("parameters")
        if not isinstance(values, dict):
            raise ConfigurationError(
                f"{path}: key `parameters` is missing; it maps names such as ZZ2 to values"
            )
        bodies, drives = np.zeros((joints, 10)), np.zeros((joints, 7))
        for name, value in values.items():
            kind, link = split_name(str(name))
            if not 1 <= link <= joints:
                raise ConfigurationError(
                    f"{path}: parameter {name} belongs to link {link}, the arm has {joints}"
                )
            value = _number(value, f"{path}: parameter {name}")
            if kind in BODY:
                bodies[link - 1, BODY.index(kind)] = value
            else:
                drives[link - 1, DRIVE.index(kind)] = value
        load = None
        if payload is not None:
            payloads = content.get("payloads") or {}
            if payload not in payloads:
                known = ", ".join(payloads) or "none"
                raise ConfigurationError(f"{path}: payload {payload!r} is not in `payloads`; known: {known}")
            entries = payloads[payload]
            load = np.array([_number(entries.get(kind, 0.0), f"{path}: payload {payload}") for kind in BODY])
        return cls(bodies, drives, load)


def _number(value: object, where: str) -> float:
    """A finite number; `1e-05` (no dot), text for YAML, counts as a number."""
    try:
        number = float(value)  # type: ignore[arg-type]
    except (TypeError, ValueError):
        number = np.nan
    if isinstance(value, bool) or not np.isfinite(number):
        raise ConfigurationError(f"{where} is {value!r}, not a finite number")
    return number


class TorqueBounds(NamedTuple):
    """Largest possible magnitude of each torque over load cases and uncertainty; (n, joints) [Nm]."""

    joint: Array
    motor: Array


def rigid_torque(mechanism: Mechanism, samples: Samples, bodies: Array) -> Array:
    """M(q) qdd + C qd + G for k sets of body parameters (k, joints, 10); (k, n, joints) [Nm]."""
    q, qd, qdd = (np.ascontiguousarray(part, dtype=np.float64) for part in samples[:3])
    n, joints = q.shape
    tau = np.empty((bodies.shape[0], n, joints))
    first = np.zeros(joints + 1, dtype=np.int64)
    scratch = np.empty((joints, n, 4))
    forward(mechanism.dynamics, (q, qd, qdd), (first, _NO_COLUMNS), bodies, 1.0, scratch, tau)
    return tau


def torque_bounds(
    mechanism: Mechanism, samples: Samples, estimate: ArmEstimate, coverage: float = 3.0
) -> TorqueBounds:
    """Worst magnitude of joint and motor torque at each sample over load cases and uncertainty."""
    drives = estimate.drives
    rigid = rigid_torque(mechanism, samples, estimate.loads)
    joint = rigid + samples.qd * drives[:, FVL] + drives[:, OFFL]
    motor = joint + samples.qdd * drives[:, IA] + samples.qd * drives[:, FVM] + drives[:, OFFM]
    joint_bound = np.abs(joint) + np.abs(drives[:, FCL])
    motor_bound = np.abs(motor) + np.abs(drives[:, FCL]) + np.abs(drives[:, FCM])
    if estimate.covariance is not None and coverage > 0.0:
        for load in range(rigid.shape[0]):
            deviation = torque_deviation(mechanism, samples, estimate, loaded=load == 1)
            joint_bound[load] += coverage * deviation.joint
            motor_bound[load] += coverage * deviation.motor
    return TorqueBounds(joint_bound.max(axis=0), motor_bound.max(axis=0))


def torque_deviation(
    mechanism: Mechanism, samples: Samples, estimate: ArmEstimate, *, loaded: bool
) -> TorqueBounds:
    """Standard deviation of joint and motor torque from the estimate's covariance, (n, joints) [Nm]."""
    q, qd, qdd = (np.ascontiguousarray(part, dtype=np.float64) for part in samples[:3])
    n, joints = q.shape
    sigma = np.zeros((2, n, joints))
    if estimate.covariance is None:
        return TorqueBounds(*sigma)
    columns = np.tile(np.arange(10), joints).astype(np.int64)
    first = np.arange(0, 10 * joints + 1, 10).astype(np.int64)
    z = np.zeros((joints, n, 10 * joints + 4))
    tau = np.empty((1, n, joints))
    forward(mechanism.dynamics, (q, qd, qdd), (first, columns), np.zeros((1, joints, 10)), 1e-3, z, tau)
    for joint in range(joints):
        signals: list[Array] = []
        used: list[int] = []
        joint_side: list[bool] = []
        for index, name in enumerate(estimate.covariance_names):
            kind, link = split_name(name)
            if kind in BODY and joint < link <= joints + loaded:
                signals.append(z[joint, :, 10 * (min(link, joints) - 1) + BODY.index(kind)])
                joint_side.append(True)
            elif kind not in BODY and link == joint + 1:
                column = DRIVE_SIGNAL[kind]
                # Coulomb friction and offset count with a magnitude of one at every instant
                signals.append(np.ones(n) if column >= 2 else z[joint, :, 10 * joints + column])
                joint_side.append(kind in JOINT_SIDE)
            else:
                continue
            used.append(index)
        if used:
            rows, covariance = np.column_stack(signals), estimate.covariance[np.ix_(used, used)]
            own = np.array(joint_side)
            sigma[0, :, joint] = _deviation(rows[:, own], covariance[np.ix_(own, own)])
            sigma[1, :, joint] = _deviation(rows, covariance)
    return TorqueBounds(sigma[0], sigma[1])


def _deviation(rows: Array, covariance: Array) -> Array:
    """sqrt(y C y^T) of each row y."""
    variance = np.einsum("ij,ij->i", rows @ covariance, rows)
    return np.sqrt(np.maximum(variance, 0.0))
