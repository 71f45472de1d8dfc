"""The extended model: the claims and terms that it holds, decided by held-out rows."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ident.diagnosis.causes.probes import Remainder
from ident.diagnosis.gain.held_out import HeldOut, held_out, interval, worse_rows
from ident.diagnosis.gain.products import Rows
from ident.diagnosis.healthy.bench import DiagnosisBench
from ident.diagnosis.outcome.result import Finding, Nameless
from ident.diagnosis.verdict.task import Baseline
from ident.effects import NAMELESS, entry_of

_UNNAMED = {effect.cause for effect in NAMELESS.values()}


@dataclass(frozen=True, eq=False)
class Member:
    """A claim or a remainder of the extended model: its columns and gain."""

    rows: tuple[Rows, ...]
    gain: float
    finding: Finding | None = None
    remainder: Remainder | None = None


def extension(
    bench: DiagnosisBench, baseline: Baseline, members: list[Member], nuisance: Sequence[Rows], seed: int
) -> tuple[list[Member], HeldOut]:
    """The members of the extension, and the held-out rows with them.

    A member acting on a row worse than the base model beyond chance goes, if the power of the error, over the base
    model's in each row, is less without it on average. A remainder has to lower the error of its own row beyond chance.
    The columns of the evidence are those of the result.
    """

    def with_members(chosen: Sequence[Member]) -> HeldOut:
        return held_out_with(bench, chosen, nuisance)

    while True:
        after = with_members(members)
        for member in sorted((m for m in members if m.remainder is not None), key=lambda m: m.gain):
            assert member.remainder is not None
            rest = [m for m in members if m is not member]
            key = (member.remainder.side, member.remainder.joint - 1)
            if interval(with_members(rest), after, [key], seed)[2] <= 0.0:
                members, after = rest, with_members(rest)
        worse = set(worse_rows(baseline.held.where(after), after.where(baseline.held), seed))
        if not worse or not members:
            return members, with_members(members)
        acting = [m for m in members if any(worse & set(rows) for rows in m.rows)] or members
        left = [[m for m in members if m is not out] for out in acting]
        errors = [power_left(baseline.held, with_members(rest)) for rest in left]
        best = int(np.argmin(errors))
        if errors[best] > power_left(baseline.held, after):
            return members, with_members(members)
        members = left[best]


def held_out_with(bench: DiagnosisBench, members: Sequence[Member], nuisance: Sequence[Rows]) -> HeldOut:
    """The held-out rows with the members; the columns of the evidence are theirs afterwards."""
    return held_out(bench.evidence, [*(rows for m in members for rows in m.rows), *nuisance])


def power_left(before: HeldOut, after: HeldOut) -> float:
    """Power of the error after over that before, mean of all rows of a side and joint."""
    was, now = before.where(after).rms(), after.where(before).rms()
    share = np.concatenate([(now[side] / np.maximum(was[side], 1e-12)) ** 2 for side in was])
    return float(np.nanmean(share))


def nameless_terms(
    bench: DiagnosisBench, members: Sequence[Member], nuisance: Sequence[Rows], after: HeldOut, seed: int
) -> tuple[Nameless, ...]:
    """The nameless terms of an extension, their functions scaled as in the common fit."""
    evidence, found = bench.evidence, []
    groups = iter(evidence.coefficients())
    scales = {id(member): np.concatenate([next(groups) for _ in member.rows]) for member in members}
    for member in members:
        remainder = member.remainder
        if remainder is None:
            continue
        others = [rows for m in members if m is not member for rows in m.rows]
        key = (remainder.side, remainder.joint - 1)
        without = held_out(evidence, [*others, *nuisance])
        before, rms, low, high = interval(without, after, [key], seed)
        entries = tuple(
            entry_of(
                NAMELESS[remainder.side],
                [remainder.joint],
                {
                    **{
                        f"value_{k + 1}": (c * v, abs(c) * s)
                        for k, (v, s) in enumerate(zip(term.values, term.std, strict=True))
                    },
                    "low": (term.low, 0.0),
                    "high": (term.high, 0.0),
                },
                term.form,
            )
            for c, term in zip(scales[id(member)], remainder.terms, strict=True)
        )
        found.append(
            Nameless(remainder.side, remainder.joint, remainder.depends_on, entries, before, rms, (low, high))
        )
    evidence.replace([*(rows for m in members for rows in m.rows), *nuisance])
    return tuple(found)


def title(entry: Mapping[str, Any]) -> str:
    """An entry of the extended model in short: the cause and its joints, of a term without a name its variable, too."""
    joints = ", ".join(map(str, entry["joints"]))
    if entry["cause"] in _UNNAMED:
        joints += f": {str(entry['form']).partition(' ')[0]}"
    return f"{entry['cause']}({joints})" if joints else str(entry["cause"])


def titles(entries: Iterable[Mapping[str, Any]]) -> tuple[str, ...]:
    """Those of entries, once each."""
    return tuple(dict.fromkeys(map(title, entries)))
