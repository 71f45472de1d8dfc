"""Confidence in a finding: the probability of being right, a fitted function of a few grounds.

A logistic regression, its weights in `confidence.yaml` with signs that physics dictates: more gain never lowers the
confidence, more doubt never raises it. `python -m benchmarks.confidence` fits them again, to findings about simulated
arms of which the truth is known.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from functools import cache
from importlib import resources
from typing import Any

import numpy as np

from fri.errors import ConfigurationError
from lwr_driver.yaml_text import yaml_content

WEIGHTS = "confidence.yaml"
"""Of findings against a healthy arm."""
ALONE = "confidence_alone.yaml"
"""Of those without one: an earlier fit to findings against a healthy arm, borne out by recordings of real arms."""

OPEN = 0.7
"""Largest confidence in a claim that a test leaves open."""
HARDLY = 0.5
"""Least probability of a finding: more likely right than wrong."""


@dataclass(frozen=True)
class Grounds:
    """What speaks for a finding and against it.

    gain : natural logarithm of the fall of the cross-validated chi-square, over the least one of a claim.
    significance : -log10 of the p-value by blocks. rivals : logarithm of the odds against all rivals and chance.
    held_out : middle of the fall of the held-out chi-square, in half-widths of its 95 % interval; 0 if untested.
    untested : 1 where held-out rows cannot tell (a change between sessions, an event, too little excitation).
    felt : share of the held-out error of its rows that the claim takes away. one_block : 1 if one block shows all of
    it. worse : 1 if a row becomes worse beyond chance, see `held_out.worse_rows`. rest : unexplained gain in its rows
    over its own. replaceable : share of its gain explained by unnamed functions of the motion. habitual : 1 for a cause
    that healthy drives have. company : number of claims of more gain. held : 1 where a test leaves the claim open, such
    as held-out rows that do not show it plainly. alone : 1 without a healthy arm, with weights of its own.
    """

    gain: float
    significance: float
    rivals: float
    held_out: float
    untested: float
    felt: float
    one_block: float
    worse: float
    rest: float = 0.0
    replaceable: float = 0.0
    habitual: float = 0.0
    company: float = 0.0
    held: float = 0.0
    alone: float = 0.0

    def to_dict(self) -> dict[str, float]:
        """Plain content."""
        return {name: round(float(value), 4) for name, value in asdict(self).items()}


LIMITS: Mapping[str, tuple[float, float]] = {
    "gain": (0.0, 6.0),
    "significance": (3.0, 12.0),
    "rivals": (-1.0, 6.0),
    "held_out": (-1.0, 5.0),
    "untested": (0.0, 1.0),
    "felt": (0.0, 0.3),
    "one_block": (0.0, 1.0),
    "worse": (0.0, 1.0),
    "rest": (0.0, 1.0),
    "replaceable": (0.0, 1.0),
    "habitual": (0.0, 1.0),
    "company": (0.0, 3.0),
    "held": (0.0, 1.0),
}
"""Range of each ground; beyond it says no more than its end."""

SIGNS: Mapping[str, int] = {
    "gain": 1,
    "significance": 1,
    "rivals": 1,
    "held_out": 1,
    "untested": 0,
    "felt": 1,
    "one_block": -1,
    "worse": -1,
    "rest": -1,
    "replaceable": -1,
    "habitual": -1,
    "company": -1,
    "held": -1,
}
"""Sign of each weight, 0 where both are possible."""


START: Mapping[str, float] = {
    "gain": 2.0,
    "significance": 1.0,
    "rivals": 2.0,
    "held_out": 2.5,
    "untested": 1.5,
    "felt": 2.5,
    "one_block": -1.0,
    "worse": -1.0,
    "rest": -3.0,
    "replaceable": -1.5,
    "habitual": -1.0,
    "company": -0.5,
    "held": -1.0,
}
"""Weights before any finding, by judgement; a fit to few findings stays near them. Their intercept is -1.5."""


def scaled(grounds: Mapping[str, float]) -> np.ndarray[Any, np.dtype[np.float64]]:
    """The grounds (13,) from 0 to 1 over their ranges, in the order of `LIMITS`."""
    return np.array(
        [(min(max(grounds[name], low), high) - low) / (high - low) for name, (low, high) in LIMITS.items()]
    )


def believable(grounds: Mapping[str, float]) -> bool:
    """Whether a finding with these grounds is worth telling: one of the causes that it lists is more likely right than
    none."""
    listed = {**grounds, "rivals": LIMITS["rivals"][1]}
    return not grounds or probability(Grounds(**listed)) >= HARDLY


def probability(grounds: Grounds) -> float:
    """Probability of a finding with these grounds to be right."""
    intercept, weights = fitted(ALONE if grounds.alone else WEIGHTS)
    odds = intercept + float(weights @ scaled(asdict(grounds)))
    return min(1.0 / (1.0 + math.exp(-odds)), OPEN if grounds.held else 1.0)


@cache
def fitted(name: str = WEIGHTS) -> tuple[float, np.ndarray[Any, np.dtype[np.float64]]]:
    """Intercept and weights (13,), in the order of `LIMITS`, of a file of this folder."""
    text = (resources.files("ident.diagnosis.verdict") / name).read_text(encoding="utf-8")
    content = yaml_content(text)
    if set(content["weights"]) != set(LIMITS):
        raise ConfigurationError(f"{name} is of other grounds; run `python -m benchmarks.confidence`")
    return float(content["intercept"]), np.array([float(content["weights"][name]) for name in LIMITS])
