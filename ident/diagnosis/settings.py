"""Settings of the diagnosis."""

from __future__ import annotations

from dataclasses import dataclass

from fri.errors import ConfigurationError

__all__ = ["DiagnosisSettings"]


@dataclass(frozen=True)
class DiagnosisSettings:
    """How sessions become rows, and what it takes to make a claim.

    bin_s : length of the mean that joint torque and regressor pass alike; motor torque too where
    it is sampled
        faster. Slower channels give a row a sample.
    ringing_s : the same where the positions are the motors': about a period of the links' ringing on their
    springs, which motors held by friction do not show.
    cutoff_hz : zero-phase low-pass on the positions; lowered to a fifth of the sampling rate.
    deflection_hz : low-pass on the torque from which the joints' twist is computed.
    standstill_rad_s : below that speed the friction of a joint is unknown, and its row is left out.
    reversal_s : rows this close to a reversal are left out: the motor may not have turned yet.
    guard_s : joint rows this close to a joint's standstill are left out too.
    block_s : length of the blocks that errors are taken to be independent between, and that are held back.
    folds : number of parts of the motion that are held back in turn.
    alpha : significance of a claim, each candidate by itself, from blocks. alpha_rare : of one that is plain to see
    in what is held back, because a cause that acts in few blocks cannot be as significant.
    least_gain : fall of the held-back chi-square that a claim takes at least.
    weak : share of it and of `least_inflation` that a cause takes where nothing else is claimed, provided that the
    held-out sessions bear it out for sure.
    least_inflation : smallest relative excess of the residual's power in the affected rows that matters.
    rounds : largest number of effects.
    most_s : length of motion that is used; of longer sessions windows spread evenly.
    delay_tolerance_s : delays of a channel up to this are a property of the arm, and no finding.
    compliance_tolerance : relative deviation of the joints' compliance that is no finding.
    """

    bin_s: float = 0.02
    ringing_s: float = 0.1
    cutoff_hz: float = 25.0
    deflection_hz: float = 30.0
    standstill_rad_s: float = 0.01
    reversal_s: float = 0.015
    guard_s: float = 0.04
    block_s: float = 2.0
    folds: int = 5
    alpha: float = 1e-5
    alpha_rare: float = 1e-3
    least_gain: float = 30.0
    weak: float = 0.4
    least_inflation: float = 0.005
    rounds: int = 8
    most_s: float = 240.0
    delay_tolerance_s: float = 1.0e-3
    compliance_tolerance: float = 0.3
    seed: int = 1

    def __post_init__(self) -> None:
        for name in ("bin_s", "cutoff_hz", "deflection_hz", "block_s", "alpha", "least_gain", "most_s"):
            if not getattr(self, name) > 0.0:
                raise ConfigurationError(f"`{name}` is {getattr(self, name)}; it must be positive")
        if self.folds < 2:
            raise ConfigurationError(f"`folds` is {self.folds}; at least 2 are needed to hold one back")
