"""Text tables of motions side by side, in the manner of the paper's Table 1."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ident.excitation.assembly import Assembled
from ident.excitation.check import Check
from ident.excitation.motion import Array, ParametricMotion
from ident.excitation.plan import ExcitationPlan

__all__ = ["TableRow", "plan_report", "table", "table_row"]


@dataclass(frozen=True, eq=False)
class TableRow:
    """One motion's line: limits kept, condition number, mean and worst predicted deviation [%], mean torques
    [Nm].
    """

    label: str
    complies: bool
    duration_s: float
    condition: float
    rsd_mean: float
    rsd_worst: float
    torque: Array


def table_row(
    label: str, assembled: Assembled, motion: ParametricMotion, check: Check | None = None
) -> TableRow:
    """The figures of one motion; checked against every limit unless a check is given."""
    verdict = assembled.check(motion, continuous=False) if check is None else check
    view = assembled.view(motion)
    criteria = assembled.criteria
    return TableRow(
        label=label,
        complies=verdict.ok,
        duration_s=motion.duration,
        condition=float(np.exp(criteria.condition.evaluate(view, np.inf)[0])),
        rsd_mean=float(np.exp(criteria.rsd_mean.evaluate(view, np.inf)[0])),
        rsd_worst=float(np.exp(criteria.rsd_worst.evaluate(view, np.inf)[0])),
        torque=np.mean(np.abs(view.torque), axis=0),
    )


def table(rows: Sequence[TableRow], title: str = "") -> str:
    """Aligned text: trajectory, limits kept, duration, condition number, predicted deviations, mean |torque|
    by joint.
    """
    head = ["trajectory", "limits", "T [s]", "cond", "mean RSD %", "worst RSD %", "mean |torque| [Nm]"]
    body = [
        [
            row.label,
            "yes" if row.complies else "NO",
            f"{row.duration_s:.1f}",
            f"{row.condition:.2f}",
            f"{row.rsd_mean:.2f}",
            f"{row.rsd_worst:.2f}",
            "  ".join(f"{value:5.2f}" for value in row.torque),
        ]
        for row in rows
    ]
    widths = [max(len(line[k]) for line in [head, *body]) for k in range(len(head))]
    lines = [title] if title else []
    for index, line in enumerate([head, *body]):
        cells = [
            cell.ljust(widths[k]) if k in (0, 6) else cell.rjust(widths[k]) for k, cell in enumerate(line)
        ]
        lines.append("  ".join(cells).rstrip())
        if index == 0:
            lines.append("-" * len(lines[-1]))
    return "\n".join(lines)


def plan_report(plan: ExcitationPlan) -> str:
    """Summary of a plan for people: criteria, tightest margins, largest predicted deviations."""
    lines = [f"period {plan.period_s:g} s, {plan.periods} period(s)", "", "criteria"]
    width = max((len(name) for name in plan.objectives), default=0)
    lines += [f"  {name.ljust(width)}  {value:10.4f}" for name, value in plan.objectives.items()]
    lines += ["", "tightest margins"]
    lines += [f"  {margin}" for margin in plan.check.tightest()]
    worst = sorted(plan.rsd_percent.items(), key=lambda item: -item[1])[:8]
    if worst:
        lines += ["", "largest predicted relative deviations"]
        lines += [f"  {name:8s} {value:8.2f} %" for name, value in worst]
    return "\n".join(lines)
