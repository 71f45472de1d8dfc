"""What a comparison of estimators found: the candidates with their errors, and the chosen one."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ident.dynamics.parameters import Floats
from ident.dynamics.tables import Tabular
from ident.estimation.mounting import Mounting
from ident.estimation.turning import Turning
from ident.estimators.prior import Disagreement
from lwr_driver.listing import Listing, Piece, text_of


@dataclass(frozen=True)
class Candidate:
    """An estimator with its error on held-back parts.

    estimator : "wls" or "physical". prior_scale : factor on the variance of the prior, None without one.
    tilt : whether the base leans. gains : joints with a gain of the torque sensor. held_back_percent : rms of the
    error over rms of the torque [%], over all joints of a side; for two sides the root mean square of both.
    by_joint_percent : the same by joint and side. excess, excess_std : difference of the squared error to the best
    candidate's, over the squared torque, and its standard error over the parts.
    """

    estimator: str
    prior_scale: float | None
    tilt: bool
    gains: tuple[str, ...]
    held_back_percent: float
    by_joint_percent: dict[str, float]
    excess: float = 0.0
    excess_std: float = 0.0

    @property
    def title(self) -> str:
        """The candidate in words."""
        loose = 1.0 if self.prior_scale is None else float(np.sqrt(self.prior_scale))
        text = self.estimator + ("" if loose == 1.0 else f", prior's deviations x {loose:.3g}")
        text += ", base leaning" if self.tilt else ""
        return text + (f", sensor gain of {', '.join(self.gains)}" if self.gains else "")


@dataclass(frozen=True)
class Choice(Tabular):
    """The chosen estimator, its competitors, and what the comparison shows of prior and sensors.

    candidates : in the order of preference. chosen : number of the winner. parts, block_s : of the held-back rows.
    excluded : candidates that the data do not permit, with the reason. disagreement : between the URDF's inertials
    and the data. contradiction : joints whose torques no bodies like the URDF's explain, as a sentence; empty without.
    advice : sentences for the report. mounting : the tilt of the base, if the winner has one.
    gains : error of the joint torque sensor's scale by joint, value and standard deviation, if the winner has some;
    gains_covariance : (k, k) of theirs.
    urdf_doubt : why the URDF's bodies are missing or look like placeholders, empty without doubt.
    used : the estimator taken instead of the winner; empty for the winner itself. turning : of the drives' friction,
    None where it turns at once.
    """

    candidates: tuple[Candidate, ...]
    chosen: int
    parts: int
    block_s: float
    excluded: tuple[str, ...] = ()
    disagreement: Disagreement | None = None
    contradiction: str = ""
    advice: tuple[str, ...] = ()
    mounting: Mounting | None = None
    gains: dict[str, tuple[float, float]] = field(default_factory=dict)
    gains_covariance: Floats = field(default_factory=lambda: np.zeros((0, 0)), repr=False)
    used: str = ""
    turning: Turning | None = None
    urdf_doubt: str = ""

    @property
    def winner(self) -> Candidate:
        """The chosen candidate."""
        return self.candidates[self.chosen]

    def records(self) -> list[dict[str, Any]]:
        """One row a candidate."""
        return [
            vars(c) | {"title": c.title, "chosen": k == self.chosen} for k, c in enumerate(self.candidates)
        ]

    def to_dict(self) -> dict[str, Any]:
        """Plain content for files."""
        return {
            "chosen": self.winner.title,
            "used": self.used or self.winner.title,
            "parts": self.parts,
            "block_s": self.block_s,
            "candidates": [
                {key: None if value != value else value for key, value in row.items()}
                for row in self.records()
            ],
            "excluded": list(self.excluded),
            "prior_disagreement": None if self.disagreement is None else self.disagreement.to_dict(),
            "contradiction": self.contradiction,
            "advice": list(self.advice),
            "urdf_doubt": self.urdf_doubt,
            "mounting": None if self.mounting is None else self.mounting.to_dict(),
            "sensor_gains": {joint: {"error": e, "std": s} for joint, (e, s) in self.gains.items()},
            "friction_turns": None if self.turning is None else self.turning.to_dict(),
        }

    def __repr__(self) -> str:
        return f"Choice of the estimator: {self.winner.title}"

    def __str__(self) -> str:
        return text_of(self.pieces())

    def pieces(self) -> list[Piece]:
        """The candidates as a table, and what to know of the choice."""
        instead = f"; this estimate is by {self.used}" if self.used else ""
        lines: list[Piece] = [f"estimator: {self.winner.title}{instead}"]
        if self.parts:
            lines = [
                f"estimator by held-back error: {self.winner.title}{instead}",
                f"  error on {self.parts} parts of the motion held back in turn, in blocks of "
                f"{self.block_s:.1f} s",
                Listing(
                    ("candidate", "error %", ""),
                    [
                        (c.title, f"{c.held_back_percent:.2f}", "chosen" if number == self.chosen else "")
                        for number, c in enumerate(self.candidates)
                    ],
                ),
            ]
        lines += [f"  not possible: {text}" for text in self.excluded]
        lines += [f"  {text}" for text in self.advice]
        if self.disagreement is not None:
            lines.append(f"  {self.disagreement}")
        if self.mounting is not None:
            lines.append(f"  {self.mounting}")
        if self.gains:
            listed = ", ".join(f"{j} {100 * e:+.1f} ± {100 * s:.1f} %" for j, (e, s) in self.gains.items())
            lines.append(
                f"  joint torque sensors read too much by: {listed}; the model states it as an effect, and "
                "`lwr-run diagnose` tells a gain from its look-alikes"
            )
        if self.turning is not None:
            lines.append(f"  {self.turning}")
        return lines
