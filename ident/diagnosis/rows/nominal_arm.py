"""What is known of an arm before its sessions are looked at."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ident.dynamics.kinematics import Chain
from ident.dynamics.structure import Coupling, EncoderSide
from ident.effects import PRESLIDING, SENSOR_GAIN, entry_of
from ident.effects.motion import dahl
from ident.rows.content import content
from ident.rows.encoder_side import USUAL_TWIST_RAD
from ident.rows.filters import SignalSettings

Floats = NDArray[np.float64]

STATED_WITHIN = 2.0
"""Factor within which a stiffness of the arm's description is known."""
_ANY_WITHIN = 8.0
# The range of a fit behind encoders at the links over that factor: it is held to nothing else there.
_WIDER = 1.5

GAIN_STD = SENSOR_GAIN.usual_change
"""Usual standard deviation of a torque sensor's gain from day to day."""


@dataclass(frozen=True, eq=False)
class NominalArm:
    """Prior knowledge of the arm.

    compliance : (n,) twist of the joints per torque [rad/Nm], zero where unknown. gear_ratio : (n,), one where
    unknown. motor_delay_s, joint_delay_s : of the healthy channels.
    encoder : `link` or `motor`, the side of the elastic joints with the published positions; encoder_known : whether
    it comes from a healthy arm.
    presliding : (n,) distance after a reversal in which 63 % of the drive's Coulomb friction turn [rad], zero where
    unknown.
    far, far_share : (n,) longer distance [rad] for a share of that friction, and the share.
    gain_std : of the torque sensors' gains from day to day. stated : (n,) compliance of the arm's description
    [rad/Nm], `compliance` by default; within : factor within which it is known. compliance_std : (n,) standard error
    of that of a healthy arm.
    couplings : pairs of joints with coupled drives. healthy : entries of the healthy arm's own effects
    (`ident.effects`); their torque is part of the nominal one, so that a cause is a change against this arm.
    """

    chain: Chain
    compliance: Floats
    gear_ratio: Floats
    motor_delay_s: float = 0.0
    joint_delay_s: float = 0.0
    encoder: EncoderSide = "link"
    encoder_known: bool = False
    presliding: Floats | None = None
    far: Floats | None = None
    far_share: Floats | None = None
    gain_std: float = GAIN_STD
    couplings: tuple[Coupling, ...] = ()
    healthy: tuple[Mapping[str, Any], ...] = ()
    stated: Floats | None = None
    within: float = STATED_WITHIN
    compliance_std: Floats | None = None

    @property
    def anchor(self) -> Floats:
        """Compliance (n,) [rad/Nm] around which a fit stays."""
        return self.compliance if self.stated is None else self.stated

    @property
    def largest_compliance(self) -> Floats:
        """Largest compliance (n,) [rad/Nm] of a fit."""
        return (_WIDER if self.encoder == "link" else 1.0) * self.within * self.anchor

    def of_unknown_stiffness(self) -> NominalArm:
        """The arm for a fit of a stiffness that its description lacks, around the usual one of such gears; as it is
        where the URDF does not state the largest torques."""
        efforts = self.chain.efforts()
        if np.any(self.anchor > 0.0) or efforts is None:
            return self
        return replace(self, stated=USUAL_TWIST_RAD / efforts, within=_ANY_WITHIN)

    @property
    def delays(self) -> dict[str, float]:
        """Delays of the channels [s], as in the signal settings of a model."""
        return {"motor_delay_s": self.motor_delay_s, "joint_delay_s": self.joint_delay_s}

    def elastic(self, signals: SignalSettings) -> SignalSettings:
        """Signal settings with the stiffness of the joints and the side of the positions; none for rigid joints."""
        springs = None
        if np.any(self.compliance > 0.0):
            springs = tuple((1.0 / np.maximum(self.compliance, 1e-12)).tolist())
        return replace(signals, stiffness_nm_rad=springs, encoder=self.encoder)

    def acts_as(self, other: NominalArm) -> bool:
        """Whether the rows of a session are the same with another arm."""
        return content(self._acting) == content(other._acting)

    @property
    def _acting(self) -> NominalArm:
        """The arm without a longer distance over which no friction turns."""
        turns = self.far_share is not None and self.far_share.any()
        return self if turns else replace(self, far=None, far_share=None)

    @property
    def usual_length(self) -> float:
        """Presliding length [rad] of a drive of this arm where its own is unknown: the geometric mean of the others, 0
        without any."""
        known = np.zeros(0) if self.presliding is None else self.presliding[self.presliding > 0.0]
        return float(np.exp(np.mean(np.log(known)))) if len(known) else 0.0

    def turning(self, level: Floats, longer: Floats | float = 1.0) -> list[dict[str, Any]]:
        """Entries of a model for Coulomb friction (n,) [Nm] that turns over the arm's lengths, `longer` times the near
        ones (n,)."""
        if self.presliding is None:
            return []
        near = self.presliding * longer
        entries = []
        for joint in np.flatnonzero(self.presliding > 0.0).tolist():
            far = 0.0 if self.far_share is None else float(self.far_share[joint])
            parts = [(level[joint] * (1.0 - far), near[joint])]
            if far and self.far is not None:
                parts.append((level[joint] * far, self.far[joint]))
            entries += [
                entry_of(PRESLIDING, [joint + 1], {"amplitude": (amplitude, 0.0), "length": (length, 0.0)})
                for amplitude, length in parts
            ]
        return entries

    def slip(self, speed: Floats, dt: float) -> Floats:
        """Coulomb friction of the drives over its level for motor speeds (N, n) [rad/s]: Dahl's state, or the sum of
        two of them (Maxwell slip: asperities of several lengths side by side)."""
        found = np.sign(speed)
        if self.presliding is not None:
            for joint in np.flatnonzero(self.presliding > 0.0):
                along = np.cumsum(speed[:, joint]) * dt
                start = float(found[0, joint])
                found[:, joint] = dahl(along, float(self.presliding[joint]), start)
                if self.far is not None and self.far_share is not None and self.far_share[joint] != 0.0:
                    slow = dahl(along, float(self.far[joint]), start)
                    found[:, joint] += float(self.far_share[joint]) * (slow - found[:, joint])
        return found
