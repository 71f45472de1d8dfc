"""Tests of the assumptions behind the estimates and their standard deviations.

Equation (13) assumes residuals of zero mean, without serial correlation, of equal variance within a joint and
side, and independent of the regressor. With thousands of rows a test finds every departure, however small: the
gears of a healthy arm twist, so its residuals are correlated, and no p-value says whether that matters. So each
verdict is by consequence, beside the statistic:

* what leaves a torque unexplained (mean, lack of fit) counts in Nm, against the larger of two numbers: two hundredths
  of the joint's torque, the accuracy on data sheets of joint torque sensors, and the scatter of a row, the floor of
  this sensor;
* what bends the estimates (variance, outliers, noise in the regressor) is mended, by weights or by instruments, and
  counts if a parameter leaves its own 95 % interval and a computed torque moves by two hundredths of itself;
* correlation is allowed for by the robust covariance, if there are blocks enough to compute it from. With the
  textbook covariance it counts by the ratio of the two;
* the condition number counts where the standard deviation of a parameter moves a torque by more than the same Nm.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ident.dynamics.parameters import Floats
from ident.dynamics.tables import Tabular
from ident.estimators.estimate import Estimate, chi_square_tail, fisher_tail, normal_tail, student_tail
from ident.estimators.problem import Problem, condition_text
from lwr_driver.listing import Listing, Piece, text_of

HARMLESS = "harmless"
IN_WORDS = (
    "harmless: a departure beyond chance that the standard deviations allow for, or whose remedy moves no result that "
    "matters"
)
_LEVEL = 0.01
# A mean by rounding, over what matters.
_ROUNDING = 1e-6
# Share of a joint's torque that matters: the accuracy of joint torque sensors.
_MATTERS = 0.02
# Half width of a 95 % interval in standard deviations.
_HALF_WIDTH = 1.96
# Least degrees of freedom of a robust covariance. Its intervals are Student's; with fewer they are 1.3 times as wide.
_BLOCKS = 5.0
# Textbook standard deviations too small by this factor turn a 95 % interval into one of 92 %.
_TOO_SMALL = 1.12
# Relative variances of the rows that weights allow for.
_VARIANCES = (1.0 / 3.0, 3.0)
# Residuals beyond this many standard deviations count as outliers (Huber 1964).
_HUBER = 1.345


@dataclass(frozen=True)
class Check:
    """One assumption: whether it holds in its consequence (None: not testable), finding and consequence."""

    name: str
    holds: bool | None
    finding: str
    consequence: str
    statistic: float = float("nan")
    p_value: float = float("nan")

    @property
    def verdict(self) -> str:
        """`holds`, `harmless` (a departure beyond chance without consequence), `violated` or `not tested`."""
        if self.holds and self.p_value <= _LEVEL:
            return HARMLESS
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
        return text_of(self.pieces())

    def pieces(self) -> list[Piece]:
        """The same as a table, and the consequence of what does not hold."""
        rows = [(check.name, check.verdict, check.finding) for check in self.checks]
        harmless = any(check.verdict == HARMLESS for check in self.checks)
        return [
            Listing(("assumption", "verdict", "finding"), rows, 0),
            *((f"  {IN_WORDS}",) if harmless else ()),
            *(f"  {check.name}: {check.consequence}" for check in self.checks if not check.holds),
        ]

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
    doubted: Collection[str] = (),
) -> Assumptions:
    """Verdicts by consequence; p-values corrected for the number of joints and sides (Bonferroni).

    instrumental : estimate of the same problem by instrumental variables, for the test of exogeneity.
    period_rows : rows of one period of the excitation, for the test against the repeatability.
    doubted : as for `weak_parameters`.
    """
    series = _joined(problem, estimate)
    checks = [
        _mean(series),
        _serial_correlation(series, estimate),
        _equal_variance(series, problem, estimate),
        _normality(series, problem, estimate),
        _exogeneity(series, problem, estimate, instrumental),
        _condition(problem, estimate, doubted),
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
    unit: str


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
                row_class.unit,
            )
        )
    return found


def _worst(tests: Sequence[tuple[float, float]]) -> tuple[int, float, float]:
    """Class with the smallest p-value, its statistic, and the p-value corrected for the number of classes."""
    index = int(np.argmin([p_value for _, p_value in tests]))
    return index, tests[index][0], float(min(1.0, tests[index][1] * len(tests)))


def _matters(series: _Series, floor: float | None = None) -> float:
    """Torque that matters in the rows of a class [Nm]. floor : scatter of a row, by default of its residual."""
    torque = np.sqrt(np.mean((series.fitted + series.residual) ** 2))
    usual = 1.4826 * float(np.median(np.abs(series.residual - np.median(series.residual))))
    return max(_MATTERS * float(torque), usual if floor is None else floor)


def _mean(series: list[_Series]) -> Check:
    scores = [
        float(np.mean(s.residual) / (np.std(s.residual) / np.sqrt(max(s.n_eff, 2.0)) + 1e-300))
        for s in series
    ]
    k, score, p_value = _worst([(abs(score), 2.0 * normal_tail(abs(score))) for score in scores])
    limits = [_matters(s) for s in series]
    beyond = [abs(float(np.mean(s.residual))) / limit for s, limit in zip(series, limits, strict=True)]
    large = int(np.argmax(beyond))
    if beyond[large] > 1.0:
        k = large
    mean = float(np.mean(series[k].residual))
    shown = mean if abs(mean) > _ROUNDING * limits[k] else 0.0
    return Check(
        "zero mean",
        p_value > _LEVEL or beyond[large] <= 1.0,
        f"largest mean {shown:.3g} {series[k].unit} ({series[k].label}, "
        f"{limits[k]:.3g} {series[k].unit} matters), "
        f"{abs(scores[k]):.1f} standard errors",
        "an offset is missing from the model there",
        score,
        p_value,
    )


def _serial_correlation(series: list[_Series], estimate: Estimate) -> Check:
    """Ljung and Box (1978) over ten lags; Durbin and Watson (1950) for the eye."""
    tests, watson = [], []
    for _, e, _, times, records, *_ in series:
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
    k, statistic, p_value = _worst(tests)
    stated = estimate.covariance
    rows = f"effective rows {100 * min(share):.0f} to {100 * max(share):.0f} % of all"
    if stated.kind.startswith("textbook"):
        robust = estimate.covariances.get("hac")
        ratio = 1.0 / np.sqrt(min(share)) if robust is None else float(np.median(robust.std / stated.std))
        holds = p_value > _LEVEL or bool(ratio <= _TOO_SMALL)
        allowed = f"textbook standard deviations too small by a factor of {ratio:.2f}"
        mend = "state a robust covariance (`jackknife`)"
    else:
        freedom = stated.degrees_of_freedom
        holds = p_value > _LEVEL or freedom >= _BLOCKS
        blocks = "" if np.isinf(freedom) else f" from {freedom + 1:.0f} blocks"
        allowed = f"the standard deviations allow for it ({stated.kind}{blocks})"
        mend = (
            f"too few blocks for the standard deviations ({_BLOCKS:.0f} are enough); record a longer motion"
        )
    finding = (
        f"Ljung-Box p {p_value:.2g} ({series[k].label}, Durbin-Watson {watson[k]:.2f}); {rows}; {allowed}"
    )
    return Check("serially uncorrelated", holds, finding, mend, statistic, p_value)


def _equal_variance(series: list[_Series], problem: Problem, estimate: Estimate) -> Check:
    """Breusch and Pagan (1979, studentised) on torque size and time; n_eff in place of n."""
    tests, weights = [], []
    for _, e, fitted, times, _, n_eff, _ in series:
        square = e**2
        columns = [np.ones(len(e)), np.abs(fitted), times.astype(np.float64)]
        matrix = np.column_stack([c / (np.abs(c).max() + 1e-300) for c in columns])
        variance = matrix @ np.linalg.lstsq(matrix, square, rcond=None)[0]
        rest = square - variance
        spread = float(np.sum((square - square.mean()) ** 2)) + 1e-300
        statistic = float(n_eff) * max(0.0, 1.0 - float(rest @ rest) / spread)
        tests.append((statistic, chi_square_tail(statistic, 2)))
        weights.append(1.0 / np.clip(variance / (square.mean() + 1e-300), *_VARIANCES))
    k, statistic, p_value = _worst(tests)
    moved = _reweighted(problem, estimate, series, weights)
    return Check(
        "equal variance",
        p_value > _LEVEL or not moved.matters,
        f"Breusch-Pagan p {p_value:.2g} ({series[k].label}: against torque and time); weights for it move {moved}",
        "the error grows with torque or drifts in time (load-dependent friction, warm-up): look at that joint",
        statistic,
        p_value,
    )


def _normality(series: list[_Series], problem: Problem, estimate: Estimate) -> Check:
    """Jarque and Bera (1980) with the effective number of rows; consequence by Huber's weights."""
    tests, shapes, weights = [], [], []
    for _, e, *_, n_eff, _ in series:
        centred = (e - e.mean()) / (e.std() + 1e-300)
        skew, excess = float(np.mean(centred**3)), float(np.mean(centred**4) - 3.0)
        statistic = float(n_eff) / 6.0 * (skew**2 + excess**2 / 4.0)
        shapes.append(f"skewness {skew:.2f}, excess kurtosis {excess:.2f}")
        tests.append((statistic, chi_square_tail(statistic, 2)))
        usual = 1.4826 * float(np.median(np.abs(e))) + 1e-300
        weights.append(np.minimum(1.0, _HUBER * usual / np.maximum(np.abs(e), 1e-300)))
    k, statistic, p_value = _worst(tests)
    moved = _reweighted(problem, estimate, series, weights)
    return Check(
        "normality",
        p_value > _LEVEL or not moved.matters,
        f"Jarque-Bera p {p_value:.2g} ({series[k].label}: {shapes[k]}); lighter outliers move {moved}",
        "outliers or reversal spikes; compare with the robust estimator (`huber`)",
        statistic,
        p_value,
    )


class _Moved(NamedTuple):
    """Consequence of another estimate: the parameter and the computed torque that it moves most.

    deviations : of the parameter, in its standard deviations; with a prior only the torque is told. torque : rms in the
        rows of `label`; limit : what matters there [Nm].
    """

    name: str
    deviations: float
    label: str
    torque: float
    limit: float
    unit: str

    @classmethod
    def by(cls, problem: Problem, estimate: Estimate, series: Sequence[_Series], shift: Floats) -> _Moved:
        """Of a shift (p,) of the parameters."""
        own = np.abs(shift) / np.maximum(estimate.std, 1e-300)
        # With a prior, parameters that the rows hardly show stay where it has them; the step knows nothing of it.
        index = int(np.argmax(own)) if estimate.prior_scale is None else None
        torques = []
        for row_class in problem.classes:
            parts = np.concatenate([problem.groups[k].matrix @ shift for k in row_class.groups])
            torques.append(float(np.sqrt(np.mean(parts**2))))
        # The scatter of a row is no floor for what all rows share.
        limits = [_matters(s, 0.0) for s in series]
        k = int(
            np.argmax([torque / max(limit, 1e-300) for torque, limit in zip(torques, limits, strict=True)])
        )
        name, deviations = ("", np.inf) if index is None else (estimate.names[index], float(own[index]))
        return cls(name, deviations, series[k].label, torques[k], limits[k], series[k].unit)

    @property
    def matters(self) -> bool:
        """Whether a parameter leaves its 95 % interval and a torque moves by as much as matters."""
        return self.deviations > _HALF_WIDTH and self.torque > self.limit

    def __str__(self) -> str:
        parameter = f"{self.name} by {self.deviations:.2f} of its standard deviations, " if self.name else ""
        return f"{parameter}the torque of {self.label} by {self.torque:.2g} {self.unit} ({self.limit:.2g} matters)"


def _reweighted(
    problem: Problem, estimate: Estimate, series: Sequence[_Series], weights: Sequence[Floats]
) -> _Moved:
    """Consequence of relative weights of the rows of each class.

    The step (A^T W A)^-1 A^T W e from the estimate with the weights, less the one without them.
    """
    count = len(problem.names)
    matrices, rights = [np.zeros((count, count)) for _ in range(2)], [np.zeros(count) for _ in range(2)]
    for row_class, relative, weight in zip(problem.classes, weights, estimate.weights, strict=True):
        start = 0
        for index in row_class.groups:
            group, residual = problem.groups[index], estimate.residuals[index]
            part = relative[start : start + len(residual)]
            start += len(residual)
            for k, rows in enumerate((np.full(len(residual), weight), weight * part)):
                scaled = group.matrix * rows[:, None]
                matrices[k] += scaled.T @ group.matrix
                rights[k] += scaled.T @ residual
    before, after = (
        np.linalg.lstsq(matrix, right, rcond=None)[0] for matrix, right in zip(matrices, rights, strict=True)
    )
    return _Moved.by(problem, estimate, series, after - before)


def _exogeneity(
    series: Sequence[_Series], problem: Problem, estimate: Estimate, instrumental: Estimate | None
) -> Check:
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
    freedom = min(estimate.covariance.degrees_of_freedom, 1e6)
    index = int(np.argmax(scores))
    p_value = float(min(1.0, 2.0 * student_tail(scores[index], freedom) * len(scores)))
    moved = _Moved.by(problem, estimate, series, shift)
    return Check(
        "exogeneity",
        p_value > _LEVEL or not moved.matters,
        f"Durbin-Wu-Hausman p {p_value:.2g} ({estimate.names[index]}); instruments move {moved}",
        "noise in the positions or unmodelled physics correlates with the regressor: lower "
        "`cutoff_hz`, use instrumental variables, or extend the model",
        float(scores[index]),
        p_value,
    )


@dataclass(frozen=True)
class Weak:
    """A parameter that the motion hardly shows: the torque [Nm] of its standard deviation, and what matters there."""

    name: str
    place: str
    torque: float
    matters: float
    unit: str = "Nm"

    def __str__(self) -> str:
        return f"{self.name} ({self.torque:.2g} {self.unit} in {self.place}, {self.matters:.2g} {self.unit} matters)"


def weak_parameters(problem: Problem, estimate: Estimate, doubted: Collection[str] = ()) -> list[Weak]:
    """Parameters with a standard deviation that moves a torque by more than what matters, the worst first.

    With v the inflation of the variance by the other columns and n independent rows, std^2 mean(w^2) = v sigma^2 / n.
    A condition number shows v alone; more rows make up for it.

    doubted : joints with a wrong channel; what is most uncertain there is so by the fault, not by the motion.
    """
    found: dict[str, Weak] = {}
    for row_class, series in zip(problem.classes, _joined(problem, estimate), strict=True):
        matters = max(_matters(series), 1e-300)
        size = np.linalg.norm(row_class.factor.r[:, :-1], axis=0) / np.sqrt(max(row_class.factor.rows, 1))
        for k in np.flatnonzero(estimate.std * size > matters):
            weak = Weak(
                problem.names[k], row_class.label, float(estimate.std[k] * size[k]), matters, row_class.unit
            )
            if (
                weak.name not in found
                or weak.torque / matters > found[weak.name].torque / found[weak.name].matters
            ):
                found[weak.name] = weak
    wrong = {row_class.label for row_class in problem.classes if row_class.joint in doubted}
    return sorted(
        (weak for weak in found.values() if weak.place not in wrong),
        key=lambda weak: -weak.torque / weak.matters,
    )


def _condition(problem: Problem, estimate: Estimate, doubted: Collection[str]) -> Check:
    normalised, weak = problem.normalised_condition, weak_parameters(problem, estimate, doubted)
    finding = f"{condition_text(problem.condition)}, columns normalised {condition_text(normalised)}"
    if weak:
        finding += f"; too uncertain: {', '.join(one.name for one in weak[:8])}"
    return Check(
        "condition number",
        bool(np.isfinite(normalised)) and not weak,
        finding,
        "the motion hardly shows some parameters: see their RSD, or plan a better excitation",
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
    torques = {
        s.label: float(np.sqrt(np.mean((s.fitted + s.residual) ** 2))) for s in _joined(problem, estimate)
    }
    limits = {label: max(_MATTERS * torques[label], noise) for label, (_, noise, _) in found.items()}
    corrected = {label: min(1.0, p_value * len(found)) for label, (_, _, p_value) in found.items()}
    shares = {
        label: structured / max(limits[label], 1e-300) if corrected[label] <= _LEVEL else 0.0
        for label, (structured, _, _) in found.items()
    }
    label = max(found, key=lambda name: (shares[name], -corrected[name], found[name][0]))
    structured, noise, _ = found[label]
    unit = next(one.unit for one in problem.classes if one.label == label)
    return Check(
        "lack of fit",
        shares[label] <= 1.0,
        f"F test p {corrected[label]:.2g} ({label}: {structured:.3g} {unit} repeats every period, "
        f"{noise:.3g} {unit} does not; "
        f"{100 * structured / max(torques[label], 1e-300):.2g} % of the torque, {limits[label]:.3g} {unit} matters)",
        "unmodelled physics; more data will not reduce it, an extended model will",
        p_value=corrected[label],
    )
