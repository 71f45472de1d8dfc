"""Cross-validation over sessions: each is predicted by a model that was identified from all the others."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from fri.errors import DataError
from ident.identify import IdentificationSettings, identify
from ident.kinematics import Chain
from ident.validation import SessionScore, validate

if TYPE_CHECKING:
    from lwr_driver.session import Session

__all__ = ["CrossValidation", "cross_validate"]


@dataclass(frozen=True)
class CrossValidation:
    """One score a session, and the sessions that could not be left out with the reason."""

    scores: tuple[SessionScore, ...]
    skipped: tuple[str, ...]

    @property
    def rms(self) -> dict[str, float]:
        """Root mean square over the folds of each joint and side [Nm], by `joint side`."""
        table: dict[str, list[float]] = {}
        for fold in self.scores:
            for score in fold.scores:
                table.setdefault(f"{score.joint} {score.side}", []).append(score.rms)
        return {key: float(np.sqrt(np.mean(np.square(values)))) for key, values in table.items()}

    def to_dict(self) -> dict[str, Any]:
        """Plain content for JSON."""
        return {
            "folds": [score.to_dict() for score in self.scores],
            "skipped": list(self.skipped),
            "rms": self.rms,
        }

    def __str__(self) -> str:
        lines = ["Cross-validation: each session by the model of the others"]
        lines += ["", *("\n".join([str(score), ""]) for score in self.scores)]
        lines.append("RMS over the folds [Nm]")
        lines += [f"  {key:<14}{value:>8.3f}" for key, value in self.rms.items()]
        return "\n".join([*lines, *self.skipped])


def cross_validate(
    sessions: Sequence[Session], chain: Chain, settings: IdentificationSettings | None = None
) -> CrossValidation:
    """Leave out one session at a time.

    A session whose payload no other session carries cannot be predicted by the others; it is skipped and
    named. Raises DataError when no fold is left.
    """
    settings = settings or IdentificationSettings()
    if len(sessions) < 2:
        raise DataError(f"{len(sessions)} session cannot be cross-validated; give two at least")
    scores, skipped = [], []
    for number, session in enumerate(sessions):
        others = [other for k, other in enumerate(sessions) if k != number]
        payload = session.metadata.get("payload", "none")
        if payload not in ("", "none") and all(o.metadata.get("payload", "none") != payload for o in others):
            skipped.append(f"{session.path.name}: payload {payload!r} is in no other session; not left out")
            continue
        try:
            found = identify(others, chain, settings)
        except DataError as error:
            skipped.append(f"{session.path.name}: the others do not identify a model: {error}")
            continue
        fold = validate(found.model, [session], settings=settings.signals)
        scores += list(fold.scores)
    if not scores:
        raise DataError("no session can be predicted by the others: " + "; ".join(skipped))
    return CrossValidation(tuple(scores), tuple(skipped))
