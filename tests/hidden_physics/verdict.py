"""A diagnosis against the truth.

Only the diagnosis's own file is read (`diagnosis.json`), as anybody could.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tests.hidden_physics.causes import CAUSES
from tests.hidden_physics.hidden import Hidden

__all__ = ["SURE", "Verdict", "error_rows", "judge"]

SURE = 0.8
"""Confidence below which a finding only says what it may be."""

_AFFECTED = 1.03
_JOINTLESS = frozenset(name for name, cause in CAUSES.items() if cause.joints == (0,))


@dataclass(frozen=True)
class Verdict:
    """What a diagnosis is worth.

    named : for each hidden cause whether a finding has its name and joint, or names it as a look-alike
    first : whether the first finding does that for one of them. outright : by its own name
    and joint. exact : all are named and nothing else
    sure_wrong : findings that are false and sure. false : findings that fit nothing hidden
    findings : all of them, in order. unexplained : number of entries
    flagged : for effects outside the catalogue: something is unexplained there and nothing is sure
    depends : share of the variables of such an effect that the diagnosis states
    deviations : by `cause.parameter`, error in standard deviations
    efficiency : error removed over error that the true model removes, in the rows of the diagnosis of the affected
    joints, without the reversals and the rest that no model predicts; NaN unknown
    """

    named: tuple[bool, ...]
    first: bool
    outright: bool
    exact: bool
    false: tuple[str, ...]
    sure_wrong: tuple[str, ...]
    findings: tuple[str, ...]
    unexplained: int
    flagged: bool
    depends: float
    deviations: Mapping[str, float]
    efficiency: float

    @property
    def silent(self) -> bool:
        """Whether it claims nothing."""
        return not self.findings

    def to_dict(self) -> dict[str, Any]:
        """Plain content."""
        content = asdict(self)
        content["silent"] = self.silent
        content["efficiency"] = None if np.isnan(self.efficiency) else self.efficiency
        content["depends"] = None if np.isnan(self.depends) else self.depends
        return content


def judge(
    diagnosis: Mapping[str, Any],
    hidden: Sequence[Hidden],
    twin: NDArray[np.float64] | None = None,
) -> Verdict:
    """Compare a diagnosis with what was hidden.

    twin : (14,) held-out errors of the base model on the healthy twin, from the twin's own diagnosis
    """
    findings = list(diagnosis["findings"])
    fits = np.array([[_fits(finding, cause) for cause in hidden] for finding in findings], dtype=bool)
    fits = fits.reshape(len(findings), len(hidden))
    false = [finding for finding, row in zip(findings, fits, strict=True) if not row.any()]
    named = tuple(bool(column.any()) for column in fits.T)
    outside = [cause for cause in hidden if not cause.listed]
    return Verdict(
        named=named,
        first=bool(len(findings) and fits[0].any()),
        outright=bool(findings) and any(_is(findings[0], cause) for cause in hidden),
        exact=bool(hidden) and all(named) and not false,
        false=tuple(_label(finding) for finding in false),
        sure_wrong=tuple(_label(finding) for finding in false if _sure(finding)),
        findings=tuple(_label(finding) for finding in findings),
        unexplained=len(_rests(diagnosis)),
        flagged=bool(outside) and _flagged(diagnosis, outside),
        depends=_depends(diagnosis, outside),
        deviations=_deviations(findings, hidden, fits),
        efficiency=float("nan") if twin is None else _efficiency(diagnosis, twin),
    )


def _rests(diagnosis: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    """What was told without a name: fitted terms, and remainders."""
    return [*diagnosis.get("nameless", ()), *diagnosis.get("unexplained", ())]


def _sure(finding: Mapping[str, Any]) -> bool:
    return float(finding.get("confidence", 1.0)) >= SURE


def _label(finding: Mapping[str, Any]) -> str:
    joints = ",".join(str(joint) for joint in finding.get("joints", ()))
    confidence = float(finding.get("confidence", float("nan")))
    return f"{finding['cause']}({joints}) {confidence:.2f}"


def _same_place(stated: Sequence[Any], cause: Hidden) -> bool:
    """Whether the joints are the right ones; where a cause has no joint, what is stated does not matter."""
    if cause.cause in _JOINTLESS:
        return True
    return {int(joint) for joint in stated} == set(cause.joints)


def _is(finding: Mapping[str, Any], cause: Hidden) -> bool:
    return bool(finding["cause"] == cause.cause and _same_place(finding["joints"], cause))


def _fits(finding: Mapping[str, Any], cause: Hidden) -> bool:
    if _is(finding, cause):
        return True
    if _sure(finding):
        return False
    for other in finding.get("alternatives", ()):
        joints = other.get("joints", finding["joints"])
        if other["cause"] == cause.cause and _same_place(joints, cause):
            return True
    return False


def _flagged(diagnosis: Mapping[str, Any], outside: Sequence[Hidden]) -> bool:
    if any(_sure(finding) for finding in diagnosis["findings"]):
        return False
    stated = {int(entry["joint"]) for entry in _rests(diagnosis)}
    return any(stated & set(cause.joints) for cause in outside)


def _depends(diagnosis: Mapping[str, Any], outside: Sequence[Hidden]) -> float:
    wanted = {name for cause in outside for name in cause.depends_on}
    if not wanted:
        return float("nan")
    stated = {str(name) for entry in _rests(diagnosis) for name in entry["depends_on"]}
    return len(wanted & stated) / len(wanted)


def _deviations(
    findings: Sequence[Mapping[str, Any]], hidden: Sequence[Hidden], fits: NDArray[np.bool_]
) -> dict[str, float]:
    """Errors of the stated parameters that the truth has under the same name, in standard deviations."""
    found = {}
    for finding, row in zip(findings, fits, strict=True):
        for cause in (hidden[int(place)] for place in np.flatnonzero(row)):
            if finding["cause"] != cause.cause:
                continue
            for name, stated in finding.get("parameters", {}).items():
                if name in cause.parameters and stated.get("std"):
                    error = float(stated["value"]) - cause.parameters[name]
                    found[f"{cause.cause}.{name}"] = error / float(stated["std"])
    return found


def error_rows(errors: Mapping[str, Any]) -> NDArray[np.float64]:
    """`motor` and `joint` of an entry of the diagnosis as one row (14,) [Nm]; what is missing is NaN."""
    empty = [float("nan")] * 7
    values = [*(errors.get("motor") or empty), *(errors.get("joint") or empty)]
    return np.array([float("nan") if value is None else float(value) for value in values])


def _efficiency(diagnosis: Mapping[str, Any], twin: NDArray[np.float64]) -> float:
    gain = diagnosis["gain"]
    base, extended = error_rows(gain["rows_base"]), error_rows(gain["rows_extended"])
    affected = base > _AFFECTED * twin
    if not affected.any():
        return float("nan")
    return float(np.sum((base - extended)[affected]) / np.sum((base - twin)[affected]))
