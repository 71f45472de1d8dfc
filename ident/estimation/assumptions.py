"""Tests of the assumptions behind the standard deviations.

Equation (13) assumes residuals of zero mean, without serial correlation, of equal variance within a joint and
side, and independent of the regressor. Every run tests each assumption; the verdicts name the valid standard
deviation and the cause to look for.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ident.dynamics.parameters import Floats
from ident.dynamics.tables import Tabular
from ident.estimators.estimate import Estimate, chi_square_tail, fisher_tail, normal_tail, student_tail
from ident.estimators.problem import Problem

_LEVEL = 0.01
_WIDE_CONDITION = 100.0


@dataclass(frozen=True)
class Check:
    """One assumption: whether it holds (None: not testable), finding and consequence."""

    name: str
    holds: bool | None
    finding: str
    consequence: str
    statistic: float = float("nan")
    p_value: float = float("nan")

    @property
    def verdict(self) -> str:
        """`holds`, `violated` or `not tested`."""
        return {True: "holds", False: "VIOLATED", None: "not tested"}[self.holds]


@dataclass(frozen=True)
class Assumptions(Tabular):
    """The verdicts of one run."""

    checks: tuple[Check, ...]

    def __getitem__(self, name: str) -> Check:
        return next(check for check in self.checks if check.name == name)

    def records(self) -> list[dict[str, Any]]:
        """One row for each assumption."""
        return [check.__dict__ | {"holds": check.verdict} for check in self.checks]

    def __repr__(self) -> str:
        return "Assumptions: " + ", ".join(f"{check.name} {check.verdict}" for check in self.checks)

    def summary(self) -> str:
        """Verdict table."""
        lines = ["assumption            verdict     finding"]
        for check in self.checks:
            lines.append(f"{check.name:<21} {check.verdict:<11} {check.finding}")
            if not check.holds:
                lines.append(f"{'':<34}{check.consequence}")
        return "\n".join(lines)

    def to_dict(self) -> dict[str, Any]:
        """Plain content for files: verdict, finding, statistic and p-value by assumption."""
        return {
            check.name: {
                "verdict": check.verdict,
                "finding": check.finding,
                "statistic": None if np.isnan(check.statistic) else check.statistic,
                "p_value": None if np.isnan(check.p_value) else check.p_value,
            }
            for check in self.checks
        }


def check_assumptions(
    problem: Problem,
    estimate: Estimate,
    *,
    instrumental: Estimate | None = None,
    period_rows: int | None = None,
) -> Assumptions:
    """Verdicts at the 1 % level, corrected for the number of joints and sides (Bonferroni).

    instrumental : estimate of the same problem by instrumental variables, for the test of exogeneity.
    period_rows : rows of one period of the excitation, for the test against the repeatability.
    """
    series = _joined(problem, estimate)
    checks = [
        _mean(series),
        _serial_correlation(series),
        _equal_variance(series),
        _normality(series),
        _exogeneity(estimate, instrumental),
        _condition(problem),
    ]
    if period_rows is not None:
        checks.append(_lack_of_fit(problem, estimate, period_rows))
    return Assumptions(tuple(checks))


class _Series(NamedTuple):
    """Rows of one joint and side, joined over records."""

    label: str
    residual: Floats
    fitted: Floats
    times: NDArray[np.int64]
    records: NDArray[np.int64]
    n_eff: float


def _joined(problem: Problem, estimate: Estimate) -> list[_Series]:
    found = []
    for row_class, fit in zip(problem.classes, estimate.classes, strict=True):
        members = [(problem.groups[index], estimate.residuals[index]) for index in row_class.groups]
        found.append(
            _Series(
                row_class.label,
                np.concatenate([e for _, e in members]),
                np.concatenate([group.target - e for group, e in members]),
                np.concatenate([group.time_index for group, _ in members]),
                np.concatenate([np.full(len(e), group.record) for group, e in members]),
                fit.n_eff,
            )
        )
    return found


def _worst(
    name: str, tests: Sequence[tuple[float, float]], finding: Callable[[int, float], str], consequence: str
) -> Check:
    """Check by the class with the smallest p-value, corrected for the number of classes.

    tests : statistic and p-value of each class. finding : text for a class and the corrected p-value.
    """
    index = int(np.argmin([p_value for _, p_value in tests]))
    p_value = float(min(1.0, tests[index][1] * len(tests)))
    return Check(name, p_value > _LEVEL, finding(index, p_value), consequence, tests[index][0], p_value)


def _mean(series: list[_Series]) -> Check:
    scores = [
        float(np.mean(s.residual) / (np.std(s.residual) / np.sqrt(max(s.n_eff, 2.0)) + 1e-300))
        for s in series
    ]
    return _worst(
        "zero mean",
        [(abs(score), 2.0 * normal_tail(abs(score))) for score in scores],
        lambda k, p: (
            f"largest mean {np.mean(series[k].residual):.3g} Nm ({series[k].label}), "
            f"{abs(scores[k]):.1f} standard errors"
        ),
        "an offset is missing from the model there",
    )


def _serial_correlation(series: list[_Series]) -> Check:
    """Ljung and Box (1978) over ten lags; Durbin and Watson (1950) for the eye."""
    tests, watson = [], []
    for _, e, _, times, records, _ in series:
        power = float(e @ e) + 1e-300
        joined = (np.diff(times) == 1) & (np.diff(records) == 0)
        watson.append(float(np.sum(np.diff(e)[joined] ** 2) / power))
        lags = min(10, max(1, len(e) // 5))
        total = 0.0
        for lag in range(1, lags + 1):
            near = (times[lag:] - times[:-lag] == lag) & (records[lag:] == records[:-lag])
            pairs = max(int(near.sum()), 1)
            rho = float(e[lag:][near] @ e[:-lag][near]) / power
            total += rho**2 / pairs
        statistic = len(e) * (len(e) + 2) * total
        tests.append((statistic, chi_square_tail(statistic, lags)))
    share = [s.n_eff / max(len(s.residual), 1) for s in series]
    return _worst(
        "serially uncorrelated",
        tests,
        lambda k, p: (
            f"Ljung-Box p {p:.2g} ({series[k].label}, Durbin-Watson {watson[k]:.2f}); effective "
            f"rows {100 * min(share):.0f} to {100 * max(share):.0f} % of all"
        ),
        "the textbook standard deviations are too small; the stated robust ones hold",
    )


def _equal_variance(series: list[_Series]) -> Check:
    """Breusch and Pagan (1979, studentised) on torque size and time; n_eff in place of n."""
    tests = []
    for _, e, fitted, times, _, n_eff in series:
        square = e**2
        columns = [np.ones(len(e)), np.abs(fitted), times.astype(np.float64)]
        matrix = np.column_stack([c / (np.abs(c).max() + 1e-300) for c in columns])
        rest = square - matrix @ np.linalg.lstsq(matrix, square, rcond=None)[0]
        spread = float(np.sum((square - square.mean()) ** 2)) + 1e-300
        statistic = float(n_eff) * max(0.0, 1.0 - float(rest @ rest) / spread)
        tests.append((statistic, chi_square_tail(statistic, 2)))
    return _worst(
        "equal variance",
        tests,
        lambda k, p: f"Breusch-Pagan p {p:.2g} ({series[k].label}: against torque and time)",
        "the error grows with torque or drifts in time (load-dependent friction, warm-up): look at that joint",
    )


def _normality(series: list[_Series]) -> Check:
    """Jarque and Bera (1980) with the effective number of rows."""
    tests, shapes = [], []
    for _, e, *_, n_eff in series:
        centred = (e - e.mean()) / (e.std() + 1e-300)
        skew, excess = float(np.mean(centred**3)), float(np.mean(centred**4) - 3.0)
        statistic = float(n_eff) / 6.0 * (skew**2 + excess**2 / 4.0)
        shapes.append(f"skewness {skew:.2f}, excess kurtosis {excess:.2f}")
        tests.append((statistic, chi_square_tail(statistic, 2)))
    return _worst(
        "normality",
        tests,
        lambda k, p: f"Jarque-Bera p {p:.2g} ({series[k].label}: {shapes[k]})",
        "outliers or reversal spikes; compare with the robust estimator (`huber`)",
    )


def _exogeneity(estimate: Estimate, instrumental: Estimate | None) -> Check:
    """Durbin, Wu and Hausman: difference between the estimates with noise-free instruments and without.

    Parameter by parameter, because the joint statistic needs more independent rows than parameters squared.
    The variance of a difference is at most the sum of both. Instruments as strong as here make it far smaller,
    so it is taken as V_IV - V_LS, and at least a hundredth of the sum.
    """
    if instrumental is None:
        return Check("exogeneity", None, "needs the commanded motion as instruments", "record /joint_command")
    shift = instrumental.values - estimate.values
    plain = np.diag(estimate.covariance.matrix)
    variance = np.maximum(
        np.diag(instrumental.covariance.matrix) - plain,
        0.01 * (np.diag(instrumental.covariance.matrix) + plain),
    )
    scores = np.abs(shift) / np.sqrt(np.maximum(variance, 1e-300))
    index = int(np.argmax(scores))
    freedom = min(estimate.covariance.degrees_of_freedom, 1e6)
    p_value = float(min(1.0, 2.0 * student_tail(scores[index], freedom) * len(scores)))
    return Check(
        "exogeneity",
        p_value > _LEVEL,
        f"Durbin-Wu-Hausman p {p_value:.2g}; instruments move {estimate.names[index]} by "
        f"{abs(shift[index]) / max(float(estimate.std[index]), 1e-300):.2f} of its standard deviations",
        "noise in the positions or unmodelled physics correlates with the regressor: lower "
        "`cutoff_hz`, use instrumental variables, or extend the model",
        float(scores[index]),
        p_value,
    )


def _condition(problem: Problem) -> Check:
    normalised = problem.normalised_condition
    return Check(
        "condition number",
        normalised < _WIDE_CONDITION,
        f"{problem.condition:.1f}, columns normalised {normalised:.1f} (limit {_WIDE_CONDITION:.0f})",
        "the motion hardly separates some parameters: see their RSD, or plan a better excitation",
        normalised,
    )


def repeatability(
    problem: Problem, estimate: Estimate, period_rows: int
) -> dict[str, tuple[float, float, float]]:
    """By class: residual repeating every period, the remaining residual [Nm], and p of the F test.

    The scatter of the residual between periods at equal phase is pure error; the part common to all periods is
    an error of the model, however small the stated standard deviations are.
    """
    result = {}
    for row_class, fit in zip(problem.classes, estimate.classes, strict=True):
        pure = structured = 0.0
        pure_freedom = phases = 0
        for index in row_class.groups:
            group, residual = problem.groups[index], estimate.residuals[index]
            phase = group.time_index % period_rows
            order = np.argsort(phase, kind="stable")
            values, starts, counts = np.unique(phase[order], return_index=True, return_counts=True)
            sums = np.add.reduceat(residual[order], starts)
            squares = np.add.reduceat(residual[order] ** 2, starts)
            pure += float(np.sum(squares - sums**2 / counts))
            structured += float(np.sum(sums**2 / counts))
            pure_freedom += int(np.sum(counts - 1))
            phases += len(values)
        if pure_freedom < 10:
            continue
        share = fit.n_eff / max(fit.rows, 1)
        noise = pure / pure_freedom
        repeated = structured / max(phases - fit.parameters, 1.0)
        ratio = repeated / max(noise, 1e-300)
        p_value = fisher_tail(
            ratio, max(share * (phases - fit.parameters), 1.0), max(share * pure_freedom, 1.0)
        )
        periods = (pure_freedom + phases) / max(phases, 1)
        model_error = np.sqrt(max(repeated - noise, 0.0) / periods)
        result[row_class.label] = (float(model_error), float(np.sqrt(noise)), p_value)
    return result


def _lack_of_fit(problem: Problem, estimate: Estimate, period_rows: int) -> Check:
    found = repeatability(problem, estimate, period_rows)
    if not found:
        return Check(
            "lack of fit", None, "needs two or more periods", "record more periods of the excitation"
        )
    label = min(found, key=lambda name: (found[name][2], -found[name][0]))
    structured, noise, p_value = found[label]
    p_value = min(1.0, p_value * len(found))
    return Check(
        "lack of fit",
        p_value > _LEVEL,
        f"F test p {p_value:.2g} ({label}: {structured:.3g} Nm repeats every period, {noise:.3g} Nm does "
        "not)",
        "unmodelled physics; more data will not reduce it, an extended model will",
        p_value=p_value,
    )
