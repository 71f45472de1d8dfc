"""Whether all rows tell the same of a claim: the sides of its drive, and the joints that it acts on.

A cause of the catalogue gives its torque in all rows by one size. A torque of another kind that resembles it in the
rows with most information gives others another size, or acts on a side where the cause does not.
"""

from __future__ import annotations

import numpy as np

from ident.diagnosis.causes.candidates import Dictionary
from ident.diagnosis.causes.claims import Claim
from ident.diagnosis.causes.sufficiency import powers
from ident.diagnosis.gain.products import Floats, Key, Rows

# Least standard deviations from zero of the torque of a claim on the other side, and its range in sizes of the claim.
_SEEN, _SIZES = 3.0, (0.5, 2.0)
# Least share of a claim's power that other sizes in single joints differ by.
_UNEVEN = 0.05
# Least share of a claim's power in the rows of a joint and side to have a size of their own.
_SHOWN = 0.01
# Largest uncertainty of the size of a whole-arm cause in its main joint beside that in the others.
_KNOWN = 0.2


def on_both_sides(dictionary: Dictionary, claim: Claim) -> bool:
    """Whether the other side of the drive shows the torque of a claim of one side as well, beside the present columns
    with it: what motor and sensor measure alike is a torque of the arm, no error of the sensor and no friction."""
    trial = claim.trial
    if len({side for side, _ in trial.rows}) > 1 or len(dictionary.nominal.rows) < 2:
        return False
    torque = _torque(claim, dictionary.turned(trial.candidate, trial.shape))
    if not any(np.any(column) for column in torque.values()):
        return False
    score = dictionary.evidence.score(torque)
    if not np.isfinite(score.gain):
        return False
    size, std = float(score.coefficients[0]), float(np.sqrt(score.covariance[0, 0]))
    return size > _SEEN * std and _SIZES[0] < size < _SIZES[1]


def uneven(dictionary: Dictionary, claim: Claim) -> bool:
    """Whether single joints and sides contradict the size of a claim of several, beside the present columns with it:
    a size of their own in each, but for the one with most power, is not zero by chance and more than a trifle."""
    power = powers(claim.trial, dictionary)
    total = sum(power.values())
    shown = sorted((key for key in power if power[key] > _SHOWN * total), key=lambda key: power[key])
    if len(shown) < 2:
        return False
    own, torque = len(shown) - 1, _torque(claim, claim.trial.rows)
    columns = {key: np.zeros((len(torque[key]), own)) for key in shown[:-1]}
    for k, key in enumerate(shown[:-1]):
        columns[key][:, k] = torque[key][:, 0]
    score = dictionary.evidence.score(columns)
    if not np.isfinite(score.gain) or score.p_value >= dictionary.evidence.settings.alpha_rare:
        return False
    share = np.array([power[key] for key in shown]) / sum(power[key] for key in shown)
    sizes = np.append(score.coefficients, 0.0)
    return float(share @ (sizes - share @ sizes) ** 2) > _UNEVEN


def in_one_joint(dictionary: Dictionary, claim: Claim) -> bool:
    """Whether the rows of one joint alone tell the size of a cause of the whole arm, beside the present columns with
    it: a cause of that joint would look the same."""
    if not claim.trial.candidate.effect.whole_arm:
        return False
    power = powers(claim.trial, dictionary)
    _, main = max(power, key=lambda key: power[key])
    torque = {key: column for key, column in _torque(claim, claim.trial.rows).items() if key[1] == main}
    score = dictionary.evidence.score(torque)
    return not np.isfinite(score.gain) or float(score.covariance[0, 0]) > _KNOWN**2


def _torque(claim: Claim, rows: Rows) -> dict[Key, Floats]:
    """Torque (m, 1) [Nm] of a claim with such rows, by side and joint."""
    return {key: columns @ claim.score.coefficients[:, None] for key, columns in rows.items()}
