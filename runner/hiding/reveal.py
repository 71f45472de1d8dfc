"""The hidden effect beside the findings of the diagnosis."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from fri.errors import ConfigurationError, DataError
from ident.dynamics.parameters import printed_unit
from ident.effects import described, find_effect, summary_of
from ident.effects.words import joints_text, quantity_text, spoken
from lwr_driver.listing import Listing, Piece, text_of
from runner.hiding.effect import SEALED, HiddenEffect
from runner.report.diagnosis import DiagnosisFolder
from runner.report.folder import ResultFolder
from runner.terminal import write_json

REVEALED = "revealed.json"

Outcome = Literal[
    "right", "named, not first", "one of the alternatives", "wrong", "seen, not named", "not found"
]


@dataclass(frozen=True)
class Compared:
    """A parameter: the truth, and value and standard deviation found; None where the finding lacks it."""

    name: str
    unit: str
    truth: float | None
    found: float | None = None
    std: float | None = None

    @property
    def sigmas(self) -> float | None:
        """Error of the value found in standard deviations."""
        if self.truth is None or self.found is None or not self.std:
            return None
        return (self.found - self.truth) / self.std


@dataclass(frozen=True)
class Revelation:
    """A hidden effect and what the diagnosis said.

    joint_names : of the arm. outcome : see `reveal`. finding : number of the finding in question among `named`, from
    1, 0 for none. named : title and confidence of each finding and property, in the order of the diagnosis.
    """

    effect: HiddenEffect
    joint_names: tuple[str, ...]
    outcome: Outcome | None
    finding: int
    named: tuple[tuple[str, float], ...]
    parameters: tuple[Compared, ...]
    form: str | None = None

    @property
    def truth(self) -> str:
        """The effect in words."""
        effect = self.effect
        units = find_effect(effect.cause).units(effect.form)
        values = {name: (value, 0.0, units[name]) for name, value in effect.parameters.items()}
        size = described(effect.cause, values, effect.form, self.joint_names)
        return f"{_title(effect.cause, effect.joints, self.joint_names)}: {summary_of(effect.cause)}; {size}"

    @property
    def verdict(self) -> str:
        """The outcome as a sentence."""
        if self.outcome is None:
            return "the diagnosis is missing"
        about = "" if not self.finding else f", finding {self.finding}: {self.named[self.finding - 1][0]}"
        return {
            "right": f"RIGHT: cause and joint are named first{about}",
            "named, not first": f"NAMED, NOT FIRST: cause and joint are right{about}",
            "one of the alternatives": f"ONE OF THE ALTERNATIVES of a finding{about}",
            "wrong": f"WRONG: another cause or joint is named{about}",
            "seen, not named": "SEEN, NOT NAMED: an error of this joint is reported without a cause",
            "not found": "NOT FOUND: the diagnosis reports nothing",
        }[self.outcome]

    def pieces(self) -> list[Piece]:
        """Truth, findings and verdict, and the parameters as a table."""
        rho = f"error of the base model about {self.effect.rho:.2g} times the healthy one"
        lines: list[Piece] = [
            f"Hidden in the emulated arm, seed {self.effect.seed}",
            f"  truth    {self.truth} ({rho})",
        ]
        for number, (title, confidence) in enumerate(self.named, start=1):
            lines.append(f"  finding  {number}. {title}, confidence {confidence:.2f}")
        lines.append(f"  verdict  {self.verdict}")
        if self.finding and self.parameters:
            lines.append(Listing(("parameter", "truth", "found", "error / std"), self.rows()))
        return lines

    def __str__(self) -> str:
        return text_of(self.pieces())

    def rows(self) -> list[tuple[str, str, str, str]]:
        """Parameter, truth, value found, and its error in standard deviations, as text."""
        found = []
        for row in self.parameters:
            name = spoken(row.name) + ("" if row.unit in ("", "1") else f" [{printed_unit(row.unit)}]")
            truth = "-" if row.truth is None else f"{row.truth:.4g}"
            value = "-" if row.found is None else quantity_text(row.found, row.std or 0.0, "1")
            found.append((name, truth, value, "" if row.sigmas is None else f"{row.sigmas:+.1f}"))
        return found

    def save(self, folder: Path) -> None:
        """Write `revealed.json` into the folder of the run; its report then shows the effect."""
        write_json(folder / REVEALED, self.to_dict())

    def to_dict(self) -> dict[str, Any]:
        """Plain content."""
        return {
            "schema_version": 1,
            "effect": vars(self.effect),
            "truth": self.truth,
            "outcome": self.outcome,
            "verdict": self.verdict,
            "finding": self.finding or None,
            "named": [{"title": title, "confidence": confidence} for title, confidence in self.named],
            "parameters": [vars(row) | {"error_in_std": row.sigmas} for row in self.parameters],
        }


def hidden_run(folder: Path | None) -> Path:
    """The folder, or the latest of `experiments` with a hidden effect. ConfigurationError without one."""
    if folder is not None:
        if not folder.is_dir():
            raise ConfigurationError(
                f"{folder}: no such folder; name the folder of a run with a hidden effect, or none for the latest"
            )
        if not (folder / SEALED).is_file():
            raise ConfigurationError(
                f"{folder}: nothing was hidden in this run; `lwr-run experiment --hide SEED` hides an effect"
            )
        return folder
    found = sorted(Path("experiments").glob(f"*/{SEALED}"), key=lambda path: path.stat().st_mtime)
    if not found:
        raise ConfigurationError(
            "--reveal: no run in `experiments` has a hidden effect; name its folder, or hide an effect with "
            "`lwr-run experiment --hide SEED`"
        )
    return found[-1].parent


def reveal(folder: Path) -> Revelation:
    """Compare the effect hidden in the run of a folder with its diagnosis.

    Outcomes: `right` (the first finding has cause and joint), `named, not first`, `one of the alternatives`, `wrong`
    (only others are named), `seen, not named` (an error of the joint without a cause), `not found`; None without a
    diagnosis. Raises ConfigurationError for a folder without a hidden effect, DataError for a broken one.
    """
    effect = HiddenEffect.unseal(hidden_run(folder))
    assert effect is not None
    return _compared(effect, DiagnosisFolder.of(ResultFolder.load(folder)))


def revealed(folder: Path) -> Revelation | None:
    """The same of a run with `revealed.json`, else None."""
    return reveal(folder) if (folder / REVEALED).is_file() and (folder / SEALED).is_file() else None


def _compared(effect: HiddenEffect, diagnosis: DiagnosisFolder | None) -> Revelation:
    if diagnosis is None:
        return Revelation(effect, (), None, 0, (), _rows(effect, {}))
    content, names = diagnosis.content, diagnosis.joint_names
    try:
        # Schema version 2 lists what every drive has beside what is wrong with this one.
        found = [*content.get("findings", ()), *content.get("character", ())]
        named = [
            (_title(str(one["cause"]), one.get("joints", ()), names), float(one.get("confidence", 0.0)))
            for one in found
        ]
        outcome, number = _outcome(effect, found, content)
        mine = found[number - 1] if number and outcome in ("right", "named, not first") else {}
        return Revelation(effect, names, outcome, number, tuple(named), _rows(effect, mine), mine.get("form"))
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise DataError(f"{diagnosis.path}: no diagnosis: {error!r}; run `lwr-run diagnose` again") from error


def _outcome(
    effect: HiddenEffect, found: Sequence[Mapping[str, Any]], content: Mapping[str, Any]
) -> tuple[Outcome, int]:
    """Outcome, and number of the finding in question (from 1)."""

    def mine(one: Mapping[str, Any]) -> bool:
        return one["cause"] == effect.cause and tuple(one.get("joints", ())) == effect.joints

    for number, one in enumerate(found, start=1):
        if mine(one):
            return ("right" if number == 1 else "named, not first"), number
    for number, one in enumerate(found, start=1):
        if any(mine(other) for other in one.get("alternatives", ())):
            return "one of the alternatives", number
    if found:
        return "wrong", 1
    open_ends = [*content.get("nameless", ()), *content.get("unexplained", ())]
    near = [one for one in open_ends if not effect.joints or one.get("joint") in effect.joints]
    return ("seen, not named" if near else "not found"), 0


def _rows(effect: HiddenEffect, finding: Mapping[str, Any]) -> tuple[Compared, ...]:
    values = finding.get("parameters") or {}
    units = find_effect(effect.cause).units(effect.form)
    rows = []
    for name in (*effect.parameters, *(name for name in values if name not in effect.parameters)):
        one = values.get(name)
        truth = effect.parameters.get(name)
        unit = units.get(name, "")
        if one is None:
            rows.append(Compared(name, unit, truth))
        else:
            rows.append(Compared(name, unit, truth, float(one["value"]), float(one.get("std") or 0.0)))
    return tuple(rows)


def _title(cause: str, joints: Sequence[int], names: Sequence[str]) -> str:
    return f"{spoken(cause)}, {joints_text(joints, names)} [{cause}]"
