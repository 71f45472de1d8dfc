"""Torque errors of a model in held-out sessions with all samples, as `validate` measures them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ident.diagnosis.gain.held_out import FELT_WORSE, drawn_sums
from ident.diagnosis.gain.products import Floats
from ident.estimation.identification import Known
from ident.estimation.scores import SessionScore
from ident.estimation.validate import validate
from ident.model import DynamicModel
from lwr_driver.session import Session


class TorqueErrors(NamedTuple):
    """Errors with all samples, as `validate` measures them: relative ones by session and side, and the rms [Nm] by
    session, side and joint. moving : the rms of samples in motion. scores : of the sessions that have one."""

    sides: Floats
    joints: Floats
    moving: Floats
    scores: tuple[SessionScore, ...] = ()

    @classmethod
    def of(cls, model: DynamicModel, sessions: Sequence[Session]) -> TorqueErrors:
        """Of a model in sessions."""
        scores = validate(model, sessions, allow_seen=True, keep_going=True, known=Known()).scores
        return cls(
            np.array([error for score in scores for error in score.relative.values()]),
            np.array([one.rms for score in scores for one in score.scores]),
            np.array([one.moving_rms for score in scores for one in score.scores]),
            scores,
        )

    def left_of(self, base: TorqueErrors) -> float:
        """Mean square of the joints' errors over those of the base model, each by its own measure: chance in a large
        one is more than the whole of a small one. Infinite where a side's error is felt to be larger or one is missing,
        one where the base model has none.

        At a reversal and at rest any model is wrong by up to twice the friction, and those samples are most of the
        mean square. So where no joint's error is felt to be larger, one is the most if that in motion falls by more, or
        if the rise is within its interval.
        """
        if not np.isfinite(base.joints).any():
            return 1.0
        if self.joints.shape != base.joints.shape or np.any(self.sides > (1.0 + FELT_WORSE) * base.sides):
            return np.inf
        left, moving = _mean_square(self.joints, base.joints), _mean_square(self.moving, base.moving)
        felt = bool(np.any(self.joints > (1.0 + FELT_WORSE) * base.joints))
        if left <= 1.0 or felt:
            return left
        return 1.0 if left <= 2.0 - moving or self._by_chance(base) else left

    def _by_chance(self, base: TorqueErrors) -> bool:
        """Whether blocks drawn with replacement leave less than the base model once in forty."""
        rng, shares = np.random.default_rng(1), list[Floats]()
        for own, theirs in zip(self.scores, base.scores, strict=True):
            a, b = _table(own), _table(theirs)
            if a.shape == b.shape and a.size:
                left, before = np.split(drawn_sums(np.hstack([a, b]), rng), 2, axis=1)
                shares.append(left / np.maximum(before, 1e-24))
        if not shares:
            return False
        return float(np.quantile(np.concatenate(shares, axis=1).mean(axis=1), 0.025)) <= 1.0

    def rms(self) -> dict[str, Floats]:
        """Rms (n,) [Nm] of each joint by side, pooled over the sessions by their number of samples; a side without a
        score is missing, a joint without a sample NaN."""
        power: dict[str, dict[str, Floats]] = {}
        for one in (one for score in self.scores for one in score.scores):
            joints = power.setdefault(one.side, {})
            own = [one.samples * one.rms**2, one.samples] if one.samples else [0.0, 0.0]
            joints[one.joint] = joints.get(one.joint, np.zeros(2)) + own
        return {
            side: np.array([np.sqrt(a / b) if b else np.nan for a, b in joints.values()])
            for side, joints in power.items()
        }


def _table(score: SessionScore) -> Floats:
    """Sums of squares (B, k) in blocks of the joints of all sides with an error."""
    count = min((len(values) for values in score.squares.values()), default=0)
    wide = np.hstack([np.zeros((count, 0)), *(values[:count] for values in score.squares.values())])
    return wide[:, wide.sum(axis=0) > 0.0]


def _mean_square(errors: Floats, base: Floats) -> float:
    """Mean of the squares of errors over those of the base model."""
    squares = (errors / np.maximum(base, 1e-12)) ** 2
    known = squares[np.isfinite(squares)]
    return float(np.mean(known)) if known.size else 1.0


def errors_of_both(
    base: DynamicModel, extended: DynamicModel, sessions: Sequence[Session]
) -> tuple[TorqueErrors, TorqueErrors]:
    """Errors of base and extended model in sessions, measured once where both are one."""
    errors = TorqueErrors.of(base, sessions)
    return errors, errors if extended is base else TorqueErrors.of(extended, sessions)
