"""Settings of the diagnosis."""

from __future__ import annotations

from dataclasses import dataclass, field

from fri.errors import ConfigurationError
from ident.dynamics.structure import Coulomb
from ident.rows.filters import SignalSettings

A_COEFFICIENT = 6.0
"""Least gain of a further coefficient of the same cause."""


@dataclass(frozen=True)
class DiagnosisSettings:
    """Settings of the rows and of the evidence for a claim.

    bin_s : averaging length of joint torque and regressor, and of a motor torque with a higher sampling rate.
        Slower channels give one row per sample.
    ringing_s : the same for positions of the motors: about one period of the links on their springs, invisible in
        motors held by friction.
    signals : from channels to filtered motion, as for `identify`; what is open is chosen from the data. law : of
        Coulomb friction in the resulting models, None for the one that predicts best. row_law : that of the rows that
        they are estimated from, None for the same.
    deflection_hz : low-pass on the torque for the joints' twist.
    standstill_rad_s : rows of a joint below this speed are left out, for their friction is unknown.
    reversal_s : rows this close to a reversal are left out: the motor may reverse later. So are those within half a
        period of the positions' cut-off beside rest: the filtered speed of a start or a stop is none of the joint.
    guard_s : joint rows this close to a joint's standstill are left out too.
    block_s : length of the blocks with independent errors, also for cross-validation.
    folds : number of parts of the motion in cross-validation.
    alpha : significance of a claim, each candidate by itself, from blocks. alpha_rare : for obvious causes in few
        blocks, with a significance limited by the number of blocks.
    least_gain : least fall of the cross-validated chi-square by a claim.
    least_inflation : least relative excess of the residual's power in the affected rows.
    rounds : largest number of effects.
    most_s : largest length of motion in use; evenly spread windows of longer sessions.
    delay_tolerance_s : largest delay of a channel as a property of the arm and not a finding.
    compliance_tolerance : the same of the joints' compliance, as a relative deviation.
    jobs : threads for the candidates, with the same results for any number; -1 for one a core.
    """

    bin_s: float = 0.02
    ringing_s: float = 0.1
    signals: SignalSettings = field(default_factory=SignalSettings)
    law: Coulomb | None = None
    row_law: Coulomb | None = None
    deflection_hz: float = 30.0
    standstill_rad_s: float = 0.01
    reversal_s: float = 0.015
    guard_s: float = 0.04
    block_s: float = 2.0
    folds: int = 5
    alpha: float = 1e-5
    alpha_rare: float = 1e-3
    least_gain: float = 30.0
    least_inflation: float = 0.005
    rounds: int = 8
    most_s: float = 240.0
    delay_tolerance_s: float = 1.0e-3
    compliance_tolerance: float = 0.3
    seed: int = 1
    jobs: int = 1

    def __post_init__(self) -> None:
        for name in ("bin_s", "deflection_hz", "block_s", "alpha", "least_gain", "most_s"):
            if not getattr(self, name) > 0.0:
                raise ConfigurationError(f"`{name}` is {getattr(self, name)}; it must be positive")
        if self.jobs == 0:
            raise ConfigurationError("`jobs` is 0; give a number of threads, or -1 for one a core")
        if self.folds < 2:
            raise ConfigurationError(f"`folds` is {self.folds}; cross-validation needs at least 2")

    def least_of_claim(self, factor: float, coefficients: int) -> float:
        """Least gain of a claim with so many coefficients and `factor` times the usual evidence."""
        return factor * (self.least_gain + A_COEFFICIENT * (coefficients - 1))
