"""Forward simulation of the model under a position controller along the commanded motion.

The arm of the model (rigid links, drive inertia, friction) follows the command under a diagonal position
controller independent of the model. Its torque and motion are compared with the measured ones. Unlike the
computed-torque test this needs no measured acceleration, and errors of the model act back on the motion.

The controller gives joint j the stiffness w^2 m_j, with m_j the joint's largest own inertia along the command,
and critical damping. A step takes the equations of motion linearised at its start, 0.6 of the way to its end
(linearly implicit theta method): stable for any slope of the friction at rest, with little numerical damping.
sign(qd) is smoothed to tanh(qd / width).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from fri.errors import DataError
from ident.dynamics import regressor
from ident.dynamics.parameters import PER_LINK, Floats, joint_unit
from ident.dynamics.structure import Side
from ident.dynamics.tables import Tabular, rows_of
from ident.estimation.validate import mounted, prepared_session
from ident.model.dynamic_model import DynamicModel
from ident.rows.filters import SignalSettings, resampled
from ident.rows.prepared import PreparedSession
from lwr_driver.listing import Listing, Piece, text_of
from lwr_driver.session import Session

# Of the position controller: above the frequencies of the motion, which it must follow, and far below those of a step.
_BANDWIDTH_HZ = 20.0
_WIDTH_RAD_S = 5e-3
_IMPLICIT = 0.6
_LOST_RAD = 1.0
_NEAR_RAD = 0.1
_ADVICE = (
    "the parameters belong to no real arm: drop those with a large RSD, or estimate with physical consistency"
)


@dataclass(frozen=True, eq=False)
class ForwardSimulation(Tabular):
    """Simulated motion and torque beside the measured ones; prints itself.

    times (N,) [s]; q, qd (N, n); torque (N, n) of `side`. measured_q, measured_torque (N, n). prismatic : by joint.
    """

    session: str
    joint_names: tuple[str, ...]
    side: str
    reference: str
    times: Floats
    q: Floats
    qd: Floats
    torque: Floats
    measured_q: Floats
    measured_torque: Floats
    prismatic: tuple[bool, ...]

    @property
    def torque_rms(self) -> Floats:
        """RMS (n,) of measured minus simulated torque [Nm]."""
        return np.sqrt(np.mean((self.measured_torque - self.torque) ** 2, axis=0))

    @property
    def position_rms(self) -> Floats:
        """RMS (n,) of measured minus simulated position [rad]."""
        return np.sqrt(np.mean((self.measured_q - self.q) ** 2, axis=0))

    @property
    def relative(self) -> float:
        """Norm of the torque error over that of the torque, all joints."""
        return float(
            np.linalg.norm(self.measured_torque - self.torque) / np.linalg.norm(self.measured_torque)
        )

    def to_dict(self) -> dict[str, Any]:
        """Plain content for JSON."""
        return {
            "session": self.session,
            "side": self.side,
            "reference": self.reference,
            "relative": self.relative,
            "torque_rms": dict(zip(self.joint_names, self.torque_rms.tolist(), strict=True)),
            "position_rms": dict(zip(self.joint_names, self.position_rms.tolist(), strict=True)),
        }

    def records(self) -> list[dict[str, Any]]:
        """One row for each joint."""
        torque, position = self.torque_rms.tolist(), self.position_rms.tolist()
        return rows_of(joint=self.joint_names, torque_rms=torque, position_rms=position)

    def __repr__(self) -> str:
        return (
            f"Forward simulation of {self.session}, {self.side} torque, along the {self.reference} motion: "
            f"simulated torque error {100 * self.relative:.2f} %, {len(self.times)} samples"
        )

    def pieces(self) -> list[Piece]:
        """Title and table by joint."""
        rows = [
            (
                joint,
                f"{torque:.3f} {joint_unit('Nm', prismatic=slides)}",
                f"{1e3 * position:.3f} {joint_unit('mrad', prismatic=slides)}",
            )
            for joint, torque, position, slides in zip(
                self.joint_names, self.torque_rms, self.position_rms, self.prismatic, strict=True
            )
        ]
        return [
            f"Forward simulation of {self.session}, {self.side} torque, along the {self.reference} motion: "
            f"simulated torque error {100 * self.relative:.2f} %",
            Listing(("joint", "torque rms", "position rms"), rows),
        ]

    def __str__(self) -> str:
        return text_of(self.pieces())


def simulate_session(
    model: DynamicModel,
    session: Session,
    *,
    settings: SignalSettings | None = None,
    step_s: float = 1e-3,
) -> ForwardSimulation:
    """Simulate the longest uninterrupted stretch of a session.

    The reference is the commanded motion if the arm followed it to 0.1 rad, else the measured one. Motor torque is
    simulated if the model has it, else joint torque. Raises DataError without a positive definite mass matrix.
    """
    prepared = prepared_session(model, session, settings)
    side: Side = "motor" if "motor" in model.structure.sides and prepared.has_motor else "joint"
    if side not in model.structure.sides:
        raise DataError(f"{prepared.name}: the model describes only differences of torques; it cannot move")
    passage = max(prepared.passages, key=lambda p: len(p.rows))
    channel = passage.motor if side == "motor" else passage.joint
    if channel is None:
        raise DataError(f"{prepared.name}: no {side} torque in the longest stretch of the session")
    first, last = float(passage.rows[0]), float(passage.rows[-1])
    times = np.arange(first, last, step_s)
    joint = passage.joint
    measured = resampled(joint.times, joint.q, times)
    command = _command(session, prepared, times)
    # The command in a log may belong to another cycle: another clock, a plan made later.
    if command is None or np.abs(command - measured).max() > _NEAR_RAD:
        reference, target = "measured", measured
    else:
        reference, target = "commanded", command
    payload = mounted(model, session)
    q, qd, torque = simulate(model, times, target, payload=payload, side=side, start=measured[0])
    settle = times > first + 3.0 / _BANDWIDTH_HZ
    return ForwardSimulation(
        session=prepared.name,
        joint_names=prepared.joint_names,
        side=side,
        reference=reference,
        times=times[settle],
        q=q[settle],
        qd=qd[settle],
        torque=torque[settle],
        measured_q=measured[settle],
        measured_torque=resampled(channel.times, channel.torque, times)[settle],
        prismatic=tuple(model.structure.chain.prismatic.tolist()),
    )


def simulate(
    model: DynamicModel,
    times: Floats,
    target: Floats,
    *,
    payload: str | None = None,
    side: Side = "motor",
    start: Floats | None = None,
) -> tuple[Floats, Floats, Floats]:
    """Position, velocity and torque (N, n) of the model under position control along `target` (N, n) at `times`.

    The torque drives the links alone for the joint side, links and drives for the motor side.
    Raises DataError, naming the time, when the mass matrix is not positive definite.
    """
    chain, n = model.structure.chain, model.structure.chain.n
    bodies, still = model.inertial(payload), np.zeros((1, n))
    motor = side == "motor"
    friction = _Friction.of(model, motor)
    inertia = model.mass_matrix(target[:: max(1, len(target) // 200)], payload=payload, drives=motor)
    smallest = np.linalg.eigvalsh(inertia)[:, 0]
    if smallest.min() <= 0.0:
        worst = times[:: max(1, len(target) // 200)][int(np.argmin(smallest))]
        raise DataError(
            f"the model's mass matrix is not positive definite at t = {worst:.3f} s (smallest eigenvalue "
            f"{smallest.min():.3g} kg m^2); {_ADVICE}"
        )
    own = np.einsum("nii->ni", inertia).max(axis=0)
    added = inertia[0] - model.mass_matrix(target[:1], payload=payload)[0]
    frequency = 2.0 * math.pi * _BANDWIDTH_HZ
    stiffness, damping = frequency**2 * own, 2.0 * frequency * own
    rate = np.gradient(target, times, axis=0)
    acceleration = np.gradient(rate, times, axis=0)
    q = np.array(target[0] if start is None else start, dtype=np.float64)
    qd = rate[0].copy()
    positions, speeds, torques = np.empty((3, len(times), n))
    steps = np.diff(times, append=2 * times[-1] - times[-2])
    for k, dt in enumerate(steps):
        resisting, slope = friction(qd)
        torque = stiffness * (target[k] - q) + damping * (rate[k] - qd)
        positions[k], speeds[k], torques[k] = q, qd, torque
        mass = regressor.mass_matrix(chain, q[None], bodies)[0] + added
        load = regressor.torque(chain, q[None], qd[None], still, bodies)[0] + resisting
        ahead = _IMPLICIT * dt
        system = mass + ahead * slope + np.diag(ahead * damping + ahead**2 * stiffness)
        change = stiffness * (rate[k] - qd) + damping * acceleration[k]
        push = dt * (torque - load + ahead * change)
        step = np.linalg.solve(system, push)
        q = q + dt * (qd + _IMPLICIT * step)
        qd = qd + step
        if not np.max(np.abs(q - target[k])) < _LOST_RAD:
            raise DataError(f"the simulated arm left the commanded motion at t = {times[k]:.3f} s; {_ADVICE}")
    return positions, speeds, torques


@dataclass(frozen=True, eq=False)
class _Friction:
    """Friction along directions of the joint velocity: one a joint, and the sum of two for coupled drives.

    directions (m, n); viscous, coulomb (m,); offset (n,). width : of the Coulomb function [rad/s].
    """

    directions: Floats
    viscous: Floats
    coulomb: Floats
    offset: Floats
    width: float = _WIDTH_RAD_S

    @classmethod
    def of(cls, model: DynamicModel, motor: bool) -> _Friction:
        structure, drive = model.structure, model.drive()
        n = structure.chain.n
        directions = [np.eye(n)]
        viscous = [drive["Fvl"] + (drive["Fvm"] if motor else 0.0)]
        coulomb = [drive["Fcl"] + (drive["Fcm"] if motor else 0.0)]
        if motor:
            for number, coupling in enumerate(structure.couplings):
                first = len(PER_LINK) * structure.n_links + 3 * number
                joints = [structure.chain.joint_names.index(name) for name in coupling.joints]
                directions.append(np.eye(n)[joints].sum(axis=0, keepdims=True))
                viscous.append(model.standard[first + 1 : first + 2])
                coulomb.append(model.standard[first + 2 : first + 3])
        offset = drive["offl"] + (drive["offm"] if motor else 0.0)
        # A jump of the torque cannot be integrated, so a narrow function stands for it.
        width = structure.coulomb.width if structure.coulomb.kind == "tanh" else _WIDTH_RAD_S
        return cls(np.vstack(directions), np.concatenate(viscous), np.concatenate(coulomb), offset, width)

    def __call__(self, qd: Floats) -> tuple[Floats, Floats]:
        """Torque (n,) against the motion and its derivative (n, n) by the velocity."""
        speed = self.directions @ qd
        smooth = np.tanh(speed / self.width)
        steep = self.viscous + self.coulomb * (1.0 - smooth**2) / self.width
        torque = self.directions.T @ (self.viscous * speed + self.coulomb * smooth) + self.offset
        return torque, (self.directions.T * steep) @ self.directions


def _command(session: Session, prepared: PreparedSession, times: Floats) -> Floats | None:
    """The commanded position at `times`, or None."""
    command = session.command
    if command is None or not len(command):
        return None
    command = command.select(prepared.joint_names)
    reference = session.joint
    own = bool(np.ptp(reference.publish_time) > 0 and np.ptp(command.publish_time) > 0)
    origin = int((reference.publish_time if own else reference.log_time)[0])
    clock = np.asarray(
        ((command.publish_time if own else command.log_time) - origin) * 1e-9, dtype=np.float64
    )
    if clock[0] > times[0] or clock[-1] < times[-1]:
        return None
    return resampled(clock, command.position, times)
