"""The result of an import, in numbers and in words."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from ident.import_log.periods import Periods


@dataclass(frozen=True)
class ImportReport:
    """Result of an import; prints itself.

    rows : samples written of each topic. rows_in_source : samples of the recording.
    period_s, shortest_s, longest_s : median, least and greatest time between samples of `/joint_states` [s].
    unwrapped : angles that wrapped, and where.
    left_out : rows without one of their values, by topic; they count as lost samples.
    holes : intervals longer than 1.75 periods. lost, old : samples that never came, and those that an estimate leaves
        out as repeated or older than their stamps; the counts of `identify`.
    repeated : samples equal to the one before in every value; they are kept.
    periods : of the excitation, marked in the session; None for a motion without.
    notes : decisions on the way that the user should know.
    """

    path: Path
    robot: str
    uid: str
    joints: tuple[str, ...]
    rows: Mapping[str, int]
    rows_in_source: int
    duration_s: float
    period_s: float
    shortest_s: float
    longest_s: float
    holes: int
    lost: int
    old: int
    repeated: int
    unwrapped: tuple[str, ...]
    left_out: tuple[str, ...]
    periods: Periods | None
    notes: tuple[str, ...]
    conversions: tuple[str, ...]
    digests: Mapping[str, str]

    def __str__(self) -> str:
        written = ", ".join(f"{topic} {count}" for topic, count in self.rows.items())
        jitter = "regular" if self.longest_s - self.shortest_s < 1e-6 else "kept as recorded"
        lost = f"  lost      {self.lost} samples"
        lost += f"; {self.holes} intervals are longer than 1.75 periods" if self.holes else ""
        old = f"  old       {self.old} samples repeated or older than their stamps, left out of estimates"
        share = 100.0 * self.repeated / self.rows["/joint_states"]
        percent = f"{share:.0f}" if share >= 10.0 else f"{share:.2g}"
        again = [
            f"  repeated  {self.repeated} samples ({percent} %) equal to the one before, kept as they are"
        ]
        lines = [
            f"{self.robot}: {len(self.joints)} joints, {self.duration_s:.3f} s",
            f"  rows      {written} (recording: {self.rows_in_source})",
            f"  period    median {self.period_s * 1e3:.4g} ms, {self.shortest_s * 1e3:.4g} to "
            f"{self.longest_s * 1e3:.4g} ms, {jitter}",
            *((lost,) if self.holes or self.lost else ()),
            *(again if self.repeated else ()),
            *((old,) if self.old else ()),
            *(f"  left out  {missing}" for missing in self.left_out),
            *(f"  unwrapped {turned}" for turned in self.unwrapped),
            *((f"  periods   {self.periods}",) if self.periods is not None else ()),
            *(f"  note      {note}" for note in self.notes),
            *(f"  {line}" for line in self.conversions),
            *(f"  read      {name}  sha256 {digest[:16]}" for name, digest in self.digests.items()),
            f"  written   {self.path}  uid {self.uid}",
        ]
        return "\n".join(lines)
