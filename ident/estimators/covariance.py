"""Covariances valid for serially correlated residuals.

The textbook covariance of equation (14) assumes serially uncorrelated rows. Residuals of a real arm are
correlated: unmodelled physics repeats with the motion, so neighbouring rows have similar errors, and the
textbook standard deviation can be several times too small. Here the scores of all rows of one instant are
summed first, so correlation between joints and sides is covered too, and then

* `hac`: Bartlett-weighted autocovariances of the scores (Newey and West 1987), bandwidth after Andrews (1991)
  or stated, critical values after Kiefer and Vogelsang (2005). With a hundred parameters on a minute of
  motion it is still 10 to 20 % too small, because the fit removes residuals at the frequencies of the motion;
* `jackknife` (the default): blocks of time, twice the bandwidth long, are left out one after the other. It
  corrects that effect (Quenouille 1956; the CR3 estimator of MacKinnon and White 1985 for blocks). Standard
  deviations are the jackknife's; correlations are the HAC's, of full rank. For a periodic motion a block is a
  part of the period, left out of all periods together: unmodelled physics repeats with the motion, so the
  periods are not independent. A dozen blocks know a variance to 40 % only. With few blocks each variance is
  therefore moderated (Smyth 2004): shrunk towards its multiple of the variance under stationary residuals, by
  as much as the ratios of all parameters agree, with the degrees of freedom gained;
* `bootstrap`: blocks of time drawn with replacement (Kunsch 1989), the parameters solved again each time.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
from scipy.fft import next_fast_len
from scipy.special import digamma, polygamma

from fri.quantities import within
from ident.dynamics.parameters import Floats
from ident.estimators.estimate import Covariance
from ident.estimators.problem import Problem, RowGroup
from lwr_driver.session.spool import spans

_LONGEST = 4000
_CHUNK = 8192
# Samples transformed at a time, at most: 8 MB.
_AT_ONCE = 2**20
# Blocks enough for a variance of its own.
_MANY_BLOCKS = 60
# Longest lag of the stationary residuals [rows].
_LAGS = 10
# Degrees of freedom counted as known exactly.
_MOST_FREEDOM = 1e4
# Least blocks of a record: its parameters, such as those of its payload, are estimated without each of them.
_LEAST_BLOCKS = 4
# Least share of a parameter's information outside of a block, for an estimate without it.
_ELSEWHERE = 1e-4
# Least share of a parameter's variance by the rows; below, the prior alone knows it.
_SHOWN = 1e-9


@dataclass(frozen=True)
class CovarianceSettings:
    """The stated covariance of an estimate.

    kind : "jackknife" (blocks of time left out, default), "hac" (Newey-West) and "bootstrap" (blocks drawn)
        are robust to serial correlation; "textbook" is equation (14).
    bandwidth_s : largest lag [s] of the HAC weights, None chooses it from the scores.
    block_s : length of a block of the jackknife and the bootstrap [s], None takes twice the HAC bandwidth.
    """

    kind: Literal["jackknife", "hac", "bootstrap", "textbook"] = "jackknife"
    bandwidth_s: Annotated[float, within(0.0, 1e5, "s")] | None = None
    block_s: Annotated[float, within(0.0, 1e5, "s", above=True)] | None = None
    draws: Annotated[int, within(2, 1_000_000)] = 400
    seed: Annotated[int, within(0, 2**32 - 1)] = 20160


@dataclass(frozen=True)
class Scores:
    """Sum over all rows of one instant of row times weighted residual: one (T, p) array a record."""

    records: tuple[Floats, ...]

    @classmethod
    def of(
        cls, problem: Problem, coefficients: Sequence[Floats], matrices: Sequence[Floats] | None = None
    ) -> Scores:
        """Scores with a coefficient for each row (weight times residual); `matrices` replace the regressors."""
        spans: dict[int, tuple[int, int]] = {}
        for group in problem.groups:
            if len(group.time_index):
                first, last = int(group.time_index[0]), int(group.time_index[-1])
                low, high = spans.get(group.record, (first, last))
                spans[group.record] = (min(low, first), max(high, last))
        records = {
            record: np.zeros((high - low + 1, len(problem.names))) for record, (low, high) in spans.items()
        }
        for number, group in enumerate(problem.groups):
            if not len(group.time_index):
                continue
            matrix = group.matrix if matrices is None else matrices[number]
            target, offset = records[group.record], spans[group.record][0]
            contiguous = group.time_index[-1] - group.time_index[0] + 1 == len(group.time_index)
            for start in range(0, len(group.target), _CHUNK):
                part = slice(start, start + _CHUNK)
                product = matrix[part] * coefficients[number][part, None]
                where = group.time_index[part] - offset
                if contiguous:
                    target[where[0] : where[-1] + 1] += product
                else:
                    target[where] += product
        return cls(tuple(records[record] for record in sorted(records)))

    @property
    def samples(self) -> int:
        """Number of instants."""
        return sum(len(record) for record in self.records)

    def bartlett(self, length: int) -> Floats:
        """Sum over lags |l| < length of (1 - |l| / length) S_l, the sum of squares of all windows of `length`."""
        p = self.records[0].shape[1]
        total = np.zeros((p, p))
        for record in self.records:
            cumulative = np.vstack([np.zeros(p), np.cumsum(record, axis=0)])
            ends = np.arange(1, len(record) + length)
            windows = cumulative[np.minimum(ends, len(record))] - cumulative[np.maximum(ends - length, 0)]
            total += windows.T @ windows
        return total / length

    def thinned(self, factor: int) -> Scores:
        """Sums over `factor` neighbouring instants: the same long-run variance from fewer rows."""
        return Scores(tuple(_block_sums(record, factor) for record in self.records))

    def bandwidth(self, bread: Floats) -> float:
        """Andrews (1991) AR(1) plug-in for the Bartlett kernel, in samples, over the parameters' own scores."""
        numerator = denominator = 0.0
        directions = bread.T / np.maximum(np.sqrt(np.abs(np.diag(bread))), 1e-300)
        for record in self.records:
            influence = record @ directions
            now, before = influence[1:], influence[:-1]
            power = np.sum(before**2, axis=0)
            power = np.where(power > 0, power, 1.0)
            rho = np.clip(np.sum(now * before, axis=0) / power, -0.97, 0.97)
            sigma2 = np.mean((now - rho * before) ** 2, axis=0)
            scale = np.mean(influence**2, axis=0)
            keep = scale > 0
            relative = sigma2[keep] / scale[keep]
            r = rho[keep]
            numerator += float(np.sum(4 * r**2 * relative**2 / ((1 - r) ** 6 * (1 + r) ** 2)))
            denominator += float(np.sum(relative**2 / (1 - r) ** 4))
        alpha = numerator / denominator if denominator > 0 else 0.0
        return 1.1447 * (alpha * self.samples) ** (1.0 / 3.0)


def textbook(bread: Floats) -> Covariance:
    """(A^T R^-1 A)^-1 of equation (14): right only for serially uncorrelated residuals."""
    return Covariance(bread, "textbook, equation (14): assumes serially uncorrelated residuals")


def hac(
    scores: Scores, bread: Floats, sample_time_s: float, bandwidth_s: float | None = None
) -> tuple[Covariance, float]:
    """bread x long-run variance of the scores x bread^T, and the bandwidth used [s]."""
    factor = max(1, -(-max(len(record) for record in scores.records) // _LONGEST))
    thin = scores.thinned(factor) if factor > 1 else scores
    step = sample_time_s * factor
    samples = thin.samples
    if bandwidth_s is None:
        length = int(np.ceil(thin.bandwidth(bread))) + 1
        how = "automatic"
    else:
        length = round(bandwidth_s / step)
        how = "stated"
    length = int(np.clip(length, 1, max(1, samples // 4)))
    matrix = bread @ thin.bartlett(length) @ bread.T
    share = length / samples
    inflation = (1.96 + 2.9694 * share + 0.4160 * share**2 - 0.5324 * share**3) / 1.96
    kind = f"HAC (Bartlett, {how} bandwidth {length * step:.2f} s): robust to serial correlation"
    return Covariance(matrix, kind, inflation=inflation), length * step


def jackknife(
    problem: Problem,
    bread: Floats,
    coefficients: Sequence[Floats],
    row_weights: Sequence[Floats],
    block_s: float,
    *,
    matrices: Sequence[Floats] | None = None,
    correlation: Floats | None = None,
    consumed: Floats | None = None,
) -> Covariance:
    """Delete-a-block jackknife from one Newton step a block, exact for linear estimators.

    coefficients : weight times residual of each row. row_weights : factor of a row's a a^T in the inverse of
        `bread`. matrices : instruments in place of one factor a. correlation : (p, p) for the correlations.
    consumed : (classes,) parameters of each class; with them few blocks are moderated.
    """
    p = len(problem.names)
    information = np.linalg.inv(bread)
    normals: dict[tuple[int, int], Floats] = {}
    sums: dict[tuple[int, int], Floats] = {}
    cut = _Blocks.of(problem, block_s)
    for number, group in enumerate(problem.groups):
        left = group.matrix if matrices is None else matrices[number]
        for block, rows in cut.runs(group):
            key = (group.record, block)
            weighted = left[rows] * row_weights[number][rows, None]
            normals[key] = normals.get(key, np.zeros((p, p))) + weighted.T @ group.matrix[rows]
            sums[key] = sums.get(key, np.zeros(p)) + left[rows].T @ coefficients[number][rows]
    shifts, without, alone = [], np.zeros(p), np.zeros(p, dtype=bool)
    for key, normal in normals.items():
        rest = information - normal
        # Weak instruments can make a diagonal entry negative.
        scale = np.sqrt(np.maximum(np.abs(np.diag(rest)), 1e-12 * np.abs(np.diag(information))))
        scaled = rest / np.outer(scale, scale)
        solved = np.linalg.lstsq(scaled, np.column_stack([sums[key] / scale, np.eye(p)]), rcond=1e-10)[0]
        shifts.append(solved[:, 0] / scale)
        variances = np.diag(solved[:, 1:]) / scale**2
        alone |= (scale**2 < _ELSEWHERE * np.abs(np.diag(information))) | (
            variances > np.diag(bread) / _ELSEWHERE
        )
        without += variances - np.diag(bread)
    count = len(shifts)
    stacked = np.array(shifts)
    matrix = (count - 1) / count * (stacked.T @ stacked)
    if matrices is None:
        plain = np.einsum("ij,jk,ik->i", bread, sum(normals.values()), bread)
        shown = plain > _SHOWN * np.diag(bread)
        if shown.any():
            ratio = np.ones(p)
            ratio[shown] = _by_leverage((count - 1) / count * without[shown], plain[shown]) ** -0.5
            matrix = matrix * np.outer(ratio, ratio)
    freedom, how = max(1.0, count - 1.0), ""
    if consumed is not None and 2 < count < _MANY_BLOCKS:
        plain = np.einsum("ij,jk,ik->i", bread, _stationary(problem, coefficients, consumed, matrices), bread)
        variance, freedom = moderated(np.diag(matrix), np.maximum(plain, 1e-300), freedom)
        ratio = np.sqrt(variance / np.maximum(np.diag(matrix), 1e-300))
        matrix = matrix * np.outer(ratio, ratio)
        how = ", moderated"
    if correlation is not None:
        own, other = np.sqrt(np.diag(matrix)), np.sqrt(np.maximum(np.diag(correlation), 0.0))
        if alone.any():
            # Without its only block a parameter is anything: its deviation is the HAC's, widened as those of others.
            known = ~alone & (other > 0.0)
            widened = float(np.median(own[known] / other[known])) if known.any() else 1.0
            own = np.where(alone, max(widened, 1.0) * other, own)
        ratio = own / np.where(other > 0, other, 1.0)
        matrix = correlation * np.outer(ratio, ratio)
    kind = (
        f"block jackknife ({count} blocks of {cut.length * problem.sample_time_s:.2f} s{cut.note} left out{how}): "
        "robust to serial correlation"
    )
    return Covariance(matrix, kind, degrees_of_freedom=freedom)


def _by_leverage(expected: Floats, plain: Floats) -> Floats:
    """Excess (p,) of a jackknife's variances by the leverage of its blocks, over the median parameter's.

    expected, plain : (p,) of independent residuals, of the jackknife and of the estimate itself. The jackknife is too
    wide by `expected / plain`, little for a friction and much for a payload that few blocks show.
    The median stays as a margin for what no block shows.
    """
    excess = np.maximum(expected / plain, 1.0)
    return np.asarray(excess / np.median(excess))


def moderated(variance: Floats, plain: Floats, freedom: float) -> tuple[Floats, float]:
    """Variances (p,) shrunk towards a common multiple of `plain` (p,), and their degrees of freedom.

    variance : (p,) with `freedom` degrees of freedom each. The log ratios to `plain` scatter by the trigamma
    function of half the freedom; what they scatter beyond is the freedom of the prior (Smyth 2004, section 6.2).
    """
    half = 0.5 * freedom
    ratios = np.log(np.maximum(variance, 1e-300) / plain) - digamma(half) + np.log(half)
    centre = float(np.median(ratios))
    excess = float(np.var(ratios, ddof=1)) - float(polygamma(1, half))
    if excess <= polygamma(1, 0.5 * _MOST_FREEDOM):
        own = _MOST_FREEDOM
    else:
        from scipy.optimize import brentq  # on use: its import is slow

        own = 2.0 * float(brentq(lambda x: float(polygamma(1, x)) - excess, 1e-3, 0.5 * _MOST_FREEDOM))
    common = np.exp(centre + digamma(0.5 * own) - np.log(0.5 * own)) * plain
    return (own * common + freedom * variance) / (own + freedom), own + freedom


def _stationary(
    problem: Problem, coefficients: Sequence[Floats], consumed: Floats, matrices: Sequence[Floats] | None
) -> Floats:
    """Variance (p, p) of the scores if the residuals of each class are stationary, with short correlations."""
    p = len(problem.names)
    total = np.zeros((p, p))
    for row_class, used in zip(problem.classes, consumed, strict=True):
        series = []
        for index in row_class.groups:
            group = problem.groups[index]
            if not len(group.target):
                continue
            place = group.time_index - group.time_index[0]
            values, rows = np.zeros(place[-1] + 1), np.zeros((place[-1] + 1, p))
            values[place] = coefficients[index]
            rows[place] = group.matrix if matrices is None else matrices[index]
            series.append((values, rows, np.bincount(place, minlength=len(values)).astype(float)))
        covariance = np.zeros(_LAGS + 1)
        for lag in range(_LAGS + 1):
            longer = [(values, there) for values, _, there in series if len(values) > lag]
            pairs = sum(float(there[lag:] @ there[: len(there) - lag]) for _, there in longer)
            power = sum(float(values[lag:] @ values[: len(values) - lag]) for values, _ in longer)
            covariance[lag] = power / max(pairs, 1.0)
        count = row_class.factor.rows
        weak = np.flatnonzero(np.abs(covariance) < 2.0 / np.sqrt(max(count, 1)) * covariance[0])
        for lag in range(int(weak[0]) if len(weak) else len(covariance)):
            for rows in (rows for _, rows, _ in series if len(rows) > lag):
                product = covariance[lag] * (rows[lag:].T @ rows[: len(rows) - lag])
                product *= count / max(count - used, 1.0)
                total += product if lag == 0 else product + product.T
    return total


@dataclass(frozen=True)
class _Blocks:
    """Blocks of time of all records.

    length : of a block in samples. spans : (first sample, samples before a repetition, blocks) by record.
    """

    length: int
    spans: dict[int, tuple[int, int, int]]
    periodic: bool

    @classmethod
    def of(cls, problem: Problem, block_s: float) -> _Blocks:
        """At least eight blocks in all, at most eighty, and some of each record."""
        spans: dict[int, tuple[int, int]] = {}
        periodic = False
        for record in {group.record for group in problem.groups}:
            times = [g.time_index for g in problem.groups if g.record == record and len(g.time_index)]
            if not times:
                continue
            first = min(int(t[0]) for t in times)
            samples = max(int(t[-1]) for t in times) - first + 1
            period = problem.periods[record] if record < len(problem.periods) else None
            if period is not None and period < samples:
                first, samples, periodic = 0, period, True
            spans[record] = (first, samples)
        total = sum(samples for _, samples in spans.values())
        length = max(1, round(block_s / problem.sample_time_s))
        length = int(np.clip(length, -(-total // 80), max(1, total // 8)))
        counts = {
            record: (first, samples, min(samples, max(_LEAST_BLOCKS, round(samples / length))))
            for record, (first, samples) in spans.items()
        }
        return cls(length, counts, periodic)

    @property
    def note(self) -> str:
        """For the name of the covariance."""
        return " of the period" if self.periodic else ""

    def runs(self, group: RowGroup) -> list[tuple[int, slice]]:
        """Number of the block and rows of each run of neighbouring rows in one block."""
        if not len(group.time_index):
            return []
        first, samples, count = self.spans[group.record]
        block = (group.time_index - first) % samples * count // samples
        edges = np.concatenate([[0], np.flatnonzero(np.diff(block)) + 1, [len(block)]])
        return [(int(block[a]), slice(int(a), int(b))) for a, b in itertools.pairwise(edges)]


def bootstrap(problem: Problem, weights: Floats, block_s: float, draws: int, seed: int) -> Covariance:
    """Covariance of `draws` weighted least-squares solutions over blocks of time drawn with replacement."""
    cut = _Blocks.of(problem, block_s)
    p = len(problem.names)
    grams: dict[tuple[int, int], Floats] = {}
    for group, number in zip(problem.groups, problem.class_of_group, strict=True):
        for block, rows in cut.runs(group):
            augmented = np.column_stack([group.matrix[rows], group.target[rows]])
            key = (group.record, block)
            product = weights[number] * (augmented.T @ augmented)
            grams[key] = grams.get(key, np.zeros((p + 1, p + 1))) + product
    stack = np.array(list(grams.values()))
    random = np.random.default_rng(seed)
    flat = stack.reshape(len(stack), -1)
    scale = np.sqrt(np.diag(stack.sum(axis=0))[:p])
    solutions = []
    for _ in range(draws):
        counts = random.multinomial(len(stack), np.full(len(stack), 1.0 / len(stack)))
        total = (counts @ flat).reshape(p + 1, p + 1)
        normal = total[:p, :p] / np.outer(scale, scale)
        try:
            solutions.append(np.linalg.solve(normal, total[:p, p] / scale) / scale)
        except np.linalg.LinAlgError:
            continue
    matrix = np.atleast_2d(np.cov(np.array(solutions).T))
    return Covariance(
        matrix,
        f"block bootstrap ({len(stack)} blocks of {cut.length * problem.sample_time_s:.2f} s{cut.note}, "
        f"{draws} draws): robust to serial correlation",
        degrees_of_freedom=max(1.0, len(stack) - 1.0),
    )


def effective_rows(problem: Problem, residuals: Sequence[Floats]) -> Floats:
    """Number of independent rows of each class: n / (1 + 2 sum of autocorrelations) by Geyer's sequence."""
    correlations = list(_autocorrelations(problem.groups, residuals))
    result = []
    for row_class in problem.classes:
        own = [correlations[index] for index in row_class.groups]
        total = np.zeros(max(1, *map(len, own)))
        for correlation in own:
            total[: len(correlation)] += correlation
        count = sum(len(residuals[index]) for index in row_class.groups)
        result.append(count / correlation_time(total) if count else 0.0)
    return np.array(result)


def _autocorrelations(groups: Sequence[RowGroup], residuals: Sequence[Floats]) -> Iterator[Floats]:
    """Sums of products of a group's residuals (m,) with those later by 0, 1, ... time indices, a third of its span, 64
    at least; (lags,) of each group."""
    reach = [int(np.ptp(group.time_index)) + 1 if len(group.target) else 0 for group in groups]
    lags = [min(span, max(64, span // 3)) for span in reach]
    size = next_fast_len(max(1, *map(sum, zip(reach, lags, strict=True))), real=True)
    # As many groups at a time as take little memory.
    for some in spans(len(groups), max(1, _AT_ONCE // size)):
        series = np.zeros((len(groups[some]), size))
        for row, group, residual in zip(series, groups[some], residuals[some], strict=True):
            row[group.time_index - group.time_index[:1]] = residual
        found = np.fft.irfft(np.abs(np.fft.rfft(series)) ** 2, size)
        yield from (row[:count] for row, count in zip(found, lags[some], strict=True))


def correlation_time(autocovariance: Floats) -> float:
    """1 + 2 sum rho_l, summed over pairs of lags while the pair is positive; at least 1."""
    if autocovariance[0] <= 0:
        return 1.0
    rho = autocovariance / autocovariance[0]
    pairs = rho[: len(rho) // 2 * 2].reshape(-1, 2).sum(axis=1)
    negative = np.flatnonzero(pairs <= 0)
    end = negative[0] if len(negative) else len(pairs)
    return max(1.0, 2.0 * float(pairs[:end].sum()) - 1.0)


def _block_sums(values: Floats, factor: int) -> Floats:
    whole = -(-len(values) // factor) * factor
    padded = np.pad(values, ((0, whole - len(values)), (0, 0)))
    return padded.reshape(-1, factor, values.shape[1]).sum(axis=1)
