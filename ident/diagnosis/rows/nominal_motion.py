"""Motion of the nominal arm in a recording: links and drives apart by the twist of the joints, and their torques.

The twist follows from the predicted torque, so no sensor's noise or error leaks from one side to the other.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from ident.diagnosis.rows.nominal_arm import NominalArm
from ident.diagnosis.rows.recording import RecordStretch, SessionRecord
from ident.dynamics import regressor
from ident.effects.motion import ArmMotion, Floats
from ident.effects.springs import Springs
from ident.rows.filters import differentiate, low_pass, settling
from lwr_driver.session.spool import spans, stored, stored_together

# Samples of a block of a whole motion.
_BLOCK = 2**16
# Compliance [rad/Nm] of a joint taken as rigid.
_RIGID = 1e-6
# Damping over stiffness of the joints [s]: 4 % of the critical damping for a link ringing at 7 Hz.
_RELAXATION_S = 2e-3
# Least eigenvalue of a mass matrix over its largest.
_LEAST_MASS = 1e-3


@dataclass(frozen=True, eq=False)
class Predictor:
    """Motions of an arm. deflection_hz : cut-off of the twist from a predicted torque. bare : no recording has a
    payload."""

    arm: NominalArm
    deflection_hz: float
    bare: bool

    def again(
        self,
        before: ArmMotion,
        recording: SessionRecord,
        stretch: RecordStretch,
        bodies: Floats,
        drive: Mapping[str, Floats],
    ) -> ArmMotion:
        """A motion with other bodies and drives; its links hang on the torque along the motion `before`."""
        parts = (before.part(some) for some in spans(len(before.time), _BLOCK))
        link = stored(self._link_torque(one.q, one.qd, one.qdd, bodies, drive) for one in parts)
        return self.motion(recording, stretch, link, bodies, drive)

    def motion(
        self,
        recording: SessionRecord,
        stretch: RecordStretch,
        link_torque: Floats,
        bodies: Floats | None = None,
        drive: Mapping[str, Floats] | None = None,
    ) -> ArmMotion:
        """The motion of a stretch with a torque (N, n) [Nm] through the joints; without bodies (n, 10) and drive the
        torque is the measured one."""
        n = self.arm.chain.n
        dt = float(stretch.time[1] - stretch.time[0])
        q, qd, qdd = stretch.q, stretch.qd, stretch.qdd
        speed, acceleration, springs, motor_q = qd, qdd, None, None
        if np.any(self.arm.compliance > 0.0):
            # A measured torque is noisy, and its second derivative more so; a predicted one is not.
            wanted = self.deflection_hz if bodies is not None else 20.0
            wanted = 10.0 if self.arm.encoder == "motor" else wanted
            twisted = self._twist(link_torque, dt, min(wanted, 0.2 / dt))
            if self.arm.encoder == "link":
                speed, acceleration = stored_together(
                    (qd[some] + first, qdd[some] + second) for some, _, first, second in twisted
                )
            else:
                q, qd, qdd = stored_together(
                    (q[some] - twist, qd[some] - first, qdd[some] - second)
                    for some, twist, first, second in twisted
                )
                speed, acceleration, motor_q = stretch.qd, stretch.qdd, stretch.q
                if bodies is not None and drive is not None:
                    q, qd, qdd, springs = self._hanging(stretch, q, qd, bodies, drive)
                    link_torque = self._link_torque(q, qd, qdd, bodies, drive)
        values = drive or dict.fromkeys(("Ia", "Fvm", "Fcm", "offm", "Fcl"), np.zeros(n))
        slip = stored([self.arm.slip(speed, dt)])

        def driving(some: slice) -> Floats:
            friction = values["Fvm"] * speed[some] + values["Fcm"] * slip[some]
            return link_torque[some] + values["Ia"] * acceleration[some] + friction + values["offm"]

        return ArmMotion(
            chain=self.arm.chain,
            bodies=np.zeros((n, 10)) if bodies is None else bodies,
            session=recording.number,
            time=stretch.time,
            duration_s=recording.duration_s,
            q=q,
            qd=qd,
            qdd=qdd,
            motor_speed=speed,
            motor_acceleration=acceleration,
            joint_torque=link_torque,
            motor_torque=stored(driving(some) for some in spans(len(speed), _BLOCK)),
            gear_ratio=self.arm.gear_ratio,
            inertia=values["Ia"],
            link_coulomb=values["Fcl"],
            motor_coulomb=values["Fcm"],
            friction=lambda v: values["Fvm"] * v + values["Fcm"] * np.sign(v),
            motor_q=motor_q,
            slip=slip,
            springs=springs,
            loaded=recording.payload is not None or self.bare,
            begun_s=recording.begun_s,
        )

    def _link_torque(
        self, q: Floats, qd: Floats, qdd: Floats, bodies: Floats, drive: Mapping[str, Floats]
    ) -> Floats:
        """Torque (N, n) [Nm] through the joints."""
        rigid = regressor.torque(self.arm.chain, q, qd, qdd, bodies)
        return rigid + drive["Fvl"] * qd + drive["Fcl"] * np.sign(qd) + drive["offl"]

    def _twist(
        self, torque: Floats, dt: float, cutoff: float
    ) -> Iterator[tuple[slice, Floats, Floats, Floats]]:
        """Twist of the joints and its derivatives (m, n) in blocks, from a torque (N, n)."""
        reach = int(np.ceil(settling(cutoff) / dt)) + 4
        for some in spans(len(torque), _BLOCK):
            low = max(some.start - reach, 0)
            twist = low_pass(torque[low : some.stop + reach], dt, cutoff) * self.arm.compliance
            first, second = differentiate(twist, dt)
            own = slice(some.start - low, some.stop - low)
            yield some, twist[own], first[own], second[own]

    def _hanging(
        self, motors: RecordStretch, q: Floats, qd: Floats, bodies: Floats, drive: Mapping[str, Floats]
    ) -> tuple[Floats, Floats, Floats, Springs]:
        """Position, speed and acceleration (N, n) of links on springs behind the motors; the springs."""
        stiffness = 1.0 / np.maximum(self.arm.compliance, _RIGID)
        dt, qdd = float(motors.time[1] - motors.time[0]), np.zeros_like(q)
        for _ in range(2):
            mass = _definite(regressor.mass_matrix(self.arm.chain, q, bodies))
            other = self._link_torque(q, qd, np.zeros_like(q), bodies, drive)
            springs = Springs(mass, other, motors.q, motors.qd, stiffness, _RELAXATION_S * stiffness, dt)
            q, qd, qdd = springs.links
        return q, qd, qdd, springs


def _definite(mass: Floats) -> Floats:
    """Mass matrices (N, n, n), made positive definite for the springs after a fit spoiled by a strong effect."""
    try:
        np.linalg.cholesky(mass)
    except np.linalg.LinAlgError:
        values, vectors = np.linalg.eigh(mass)
        least = _LEAST_MASS * np.abs(values).max(axis=1, keepdims=True)
        return np.asarray((vectors * np.maximum(values, least)[:, None, :]) @ vectors.transpose(0, 2, 1))
    return mass
