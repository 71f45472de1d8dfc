"""Choice of the estimator by what it predicts: the torque of parts of the training motion held back.

Candidates are weighted least squares, and physically consistent bodies with the inertials of the URDF as prior: as
stated, and with looser standard deviations. Each is scored with the base upright and leaning, without and with gains
for the joint torque sensors.

**Choice.** The squared error over the squared torque counts, over all joints and parts (`ident.estimation.parts`);
motor and joint side count alike. Every freedom has to pay by a percent and by two standard errors of the difference:
ten times the variance of the prior, gains of sensors that are beyond two standard deviations, a leaning base, least
squares in place of the prior. Of those that pay the one with the largest fall is taken first, and a looser prior that
does not pay beside it is taken back: bodies free of the prior mimic a sensor's gain on the motion of the training,
and on no other. A tilt beyond chance (p < 0.001 for an upright base) has to pay at all.

Normal equations of each part are made once, so a linear candidate costs a solution a part, a physical one a conic
program.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from fri.errors import DataError
from ident.dynamics.parameters import Floats
from ident.estimation.choice import Candidate, Choice
from ident.estimation.identification import Identification
from ident.estimation.mounting import tilt_columns
from ident.estimation.parts import beside, held_back_parts
from ident.estimators.covariance import CovarianceSettings, effective_rows
from ident.estimators.estimate import Estimate, chi_square_tail
from ident.estimators.least_squares import WeightedLeastSquares
from ident.estimators.physical import BodyPrior, PhysicallyConsistent, cad_prior, lacking_bodies
from ident.estimators.prior import Disagreement, MaximumAPosteriori, Prior
from ident.estimators.problem import Problem
from ident.rows.content import Recall
from ident.rows.filters import half_width
from lwr_driver.session import Sessions, as_sessions

LOOSEST = 100.0
"""Largest factor on the variance of the prior."""
_LOOSER = 10.0
_TILT_STD_RAD = float(np.deg2rad(2.0))
_GAIN_STD = 0.05
# Standard errors by which a freedom has to pay, and standard deviations that a sensor's gain has to exceed.
_SURE = 2.0
# Largest probability of an upright base behind so large a tilt, for a tilt beyond chance.
_UPRIGHT = 1e-3
# Errors this close to one another count as equal, and so much of a joint's torque as nothing.
_ALIKE = 0.01
# Error of bodies like the URDF's over that of any parameters in a joint, and least share of those joints' excess in
# the squared error of all, for a contradiction. The arms of `benchmarks.real_data`, with light wrists among them, stay
# below one or the other.
_FAR_WORSE, _MOSTLY = 3.0, 0.5
# Squared error over the squared torque of a candidate that predicts no better than a torque of zero.
_NOTHING = 1.0
PLAIN = CovarianceSettings(kind="textbook")
"""Of a fit whose covariance is not asked for."""

Kind = tuple[str, float | None, bool, tuple[int, ...]]
"""Estimator, factor on the variance of the prior, leaning base, sensors with a gain."""


def compared(
    found: Identification,
    sessions: Sessions,
    *,
    tilt: bool | None = None,
    used: str = "",
    recall: Recall | None = None,
) -> Choice:
    """The candidates' errors on held-back parts of the sessions of an identification, and the best of them.

    tilt : as for `choose`. used : the estimator of the identification, if it stays whatever is found. recall : see
    `prepare`.
    """
    chain, model = found.structure.chain, found.settings.model
    leaning = model != 3 and bool(np.any(chain.gravity)) and tilt is not False
    lean = tilt_columns(found, as_sessions(sessions), recall) if leaning else None
    lacking = lacking_bodies(chain) if model != 3 else ""
    bodies = cad_prior(found.base) if model != 3 and not lacking else None
    tilted = (False,) if not leaning else (False, True) if tilt is None else (True,)
    comparison = EstimatorComparison.of(found, lean, bodies, lacking)
    doubt = (chain.urdf is not None and lacking) or comparison.placeholder
    return replace(comparison.choice(tilted), used=used, urdf_doubt=doubt)


@dataclass(frozen=True)
class EstimatorComparison:
    """Normal equations of the held-back parts: the parameters, two of the tilt, one gain a joint, the torque.

    bodies : the prior of the URDF, None without one; lacking : why there is none.
    placeholder : why its masses look like no arm's.
    further : columns (m, 2 + joints) of the tilt and the gains of `joints` for each group. total : (classes, q, q) of
    all rows. held : (parts, classes, q, q) of the rows of a part. near : the same with the rows beside them, missing in
    the training. sound : whether no channel is in doubt; a wrong one looks like gains of the others' sensors.
    weights : of the candidates so far.
    """

    problem: Problem
    further: tuple[Floats, ...]
    bodies: BodyPrior | None
    joints: tuple[str, ...]
    total: Floats
    held: Floats
    near: Floats
    block_s: float
    full_rank: bool
    unseen: tuple[str, ...]
    sound: bool
    lacking: str
    placeholder: str
    weights: dict[Kind, Floats] = field(default_factory=dict)

    @classmethod
    def of(
        cls, found: Identification, lean: Sequence[Floats] | None, bodies: BodyPrior | None, lacking: str
    ) -> EstimatorComparison:
        """Of an identification. lean : columns (m, 2) of the tilt by group of rows. bodies, lacking : as above."""
        problem, values = found.problem, found.estimate.values
        filters = found.settings.signals
        reach = half_width(filters.decimate, filters.attenuation_db) / problem.sample_time_s
        shares = [fit.rows / max(fit.n_eff, 1.0) for fit in found.estimate.classes]
        block = int(np.ceil(max(reach, float(np.median(shares)))))
        parts = held_back_parts(problem, found.payloads, block)
        count = 1 + max(int(part.max(initial=-1)) for part in parts)
        joints = list(dict.fromkeys(group.joint for group in problem.groups if group.side == "joint"))
        offset = np.array([name.startswith("off") for name in problem.names])
        rigid = np.where(offset, 0.0, values)
        p, further = len(problem.names), list[Floats]()
        q = p + 2 + len(joints) + 1
        held = np.zeros((count, len(problem.classes), q, q))
        near, total = np.zeros_like(held), np.zeros((len(problem.classes), q, q))
        for number, (group, part) in enumerate(zip(problem.groups, parts, strict=True)):
            matrix = np.zeros((len(group.target), q))
            matrix[:, :p] = group.matrix
            if lean is not None:
                matrix[:, p : p + 2] = lean[number]
            if group.side == "joint":
                matrix[:, p + 2 + joints.index(group.joint)] = group.matrix @ rigid
            matrix[:, -1] = group.target
            further.append(matrix[:, p:-1].copy())
            row_class = problem.class_of_group[number]
            total[row_class] += matrix.T @ matrix
            for k in range(count):
                mine = part == k
                around = beside(group.time_index, mine, (block + 1) // 2)
                held[k, row_class] += matrix[mine].T @ matrix[mine]
                near[k, row_class] += matrix[around].T @ matrix[around]
        return cls(
            problem,
            tuple(further),
            bodies,
            tuple(joints),
            total,
            held,
            near,
            block * problem.sample_time_s,
            bool(np.isfinite(found.condition_normalised)),
            found.estimate.prior_only,
            not found.known.doubts,
            lacking,
            "" if bodies is None else found.structure.chain.placeholder_masses(),
        )

    def choice(self, tilted: Sequence[bool]) -> Choice:
        """All candidates, and the preferred one."""
        bodies = self.bodies is not None
        unseen = ", ".join(self.unseen[:8]) + (
            f" and {len(self.unseen) - 8} more" if len(self.unseen) > 8 else ""
        )
        excluded: tuple[str, ...] = (f"physical: {self.lacking}",) if self.lacking else ()
        excluded += () if self.full_rank else (f"wls, because the motion does not show {unseen}",)
        advice = list[str]()
        if self.placeholder:
            advice.append(
                f"{self.placeholder}: a placeholder, so its inertials are no knowledge of this arm; give a URDF with "
                "the manufacturer's inertials, or choose `--estimator wls`"
            )
        unknown = Candidate(
            "physical" if bodies else "wls", 1.0 if bodies else None, tilted[0], (), math.nan, {}
        )
        uncompared = Choice((unknown,), 0, 0, self.block_s, excluded, self._disagreement())
        if len(self.held) < 2:
            text = f"not compared: the motion is too short for parts of {self.block_s:.1f} s to be held back"
            return replace(uncompared, advice=(text, *advice))
        found: dict[Kind, Floats] = {}
        best = list[Kind]()
        for tilt in tilted if bodies else ():
            stated: Kind = ("physical", 1.0, tilt, ())
            try:
                best.append(self._freed(stated, found))
            except DataError as error:
                excluded = (*excluded, f"physical: {error}")
                best += [stated] if stated in found else []
        if self.full_rank:
            best += [self._freed(("wls", None, tilt, ()), found) for tilt in tilted]
        if not best:
            raise DataError(f"no estimator can be compared on these data: {'; '.join(excluded)}")
        chosen = self._preferred(best, found)
        if self._share(found[chosen]).sum() >= _NOTHING:
            text = f"not compared: the motion is too short to predict parts of {self.block_s:.1f} s from the others"
            return replace(uncompared, excluded=excluded, advice=(text, *advice))
        kinds = sorted(found, key=lambda kind: (math.inf if kind[1] is None else kind[1], kind[2:]))
        squares = np.array([found[kind] for kind in kinds])
        share = np.array([self._share(square) for square in squares])
        excess, std = _paired(share - share[np.argmin(share.sum(axis=1))])
        labels = [c.label for c in self.problem.classes]
        torque = self.held[:, :, -1, -1].sum(axis=0)
        joint = 100.0 * np.sqrt(squares.sum(axis=1) / np.maximum(torque, 1e-300))
        whole = 100.0 * np.sqrt(share.sum(axis=1))
        candidates = tuple(
            Candidate(
                *kind[:3],
                tuple(self.joints[g] for g in kind[3]),
                float(whole[k]),
                dict(zip(labels, joint[k].tolist(), strict=True)),
                float(excess[k]),
                float(std[k]),
            )
            for k, kind in enumerate(kinds)
        )
        place = kinds.index(chosen)
        contradiction = self._contradiction(candidates, squares)
        advice += [*_lower_by_chance(candidates, place), *self._worse_joints(candidates, squares, place)]
        values, spread = self._gains(chosen)
        readings = zip(chosen[3], values, np.sqrt(np.diag(spread)), strict=True)
        return Choice(
            candidates, place, len(self.held), self.block_s, excluded, self._disagreement(), contradiction,
            tuple(advice),
            gains={self.joints[g]: (float(value), float(std)) for g, value, std in readings},
            gains_covariance=spread,
        )  # fmt: skip

    def _freed(self, kind: Kind, found: dict[Kind, Floats]) -> Kind:
        """The candidate with the freedoms that pay, the one with the largest fall first. found : errors of all tried,
        which it adds to."""

        def pays(before: Kind, after: Kind) -> bool:
            for one in (before, after):
                if one not in found:
                    found[one] = self._errors(one)
            return self._pays(found[before], found[after], _SURE)

        found[kind] = self._errors(kind)
        while paying := [wider for wider in self._wider(kind) if pays(kind, wider)]:
            kind = min(paying, key=lambda one: self._share(found[one]).sum())
            while (tighter := _tighter(kind)) and not pays(tighter, kind):
                kind = tighter
        return kind

    def _wider(self, kind: Kind) -> Iterator[Kind]:
        """The candidates with one freedom more: a looser prior, gains of the sensors."""
        estimator, scale, tilt, gains = kind
        if scale is not None and scale < LOOSEST:
            yield estimator, _LOOSER * scale, tilt, gains
        if self.sound and not gains and (beyond_chance := self._gains_of(kind)):
            yield estimator, scale, tilt, beyond_chance

    def _preferred(self, best: Sequence[Kind], found: Mapping[Kind, Floats]) -> Kind:
        """The first of the candidates, or a later one that pays: prior before least squares, upright before leaning. A
        leaning one has to pay against its own estimator upright, too."""

        def pays(before: Kind, after: Kind) -> bool:
            real = after[2] > before[2] and self._leans(after)
            return self._pays(found[before], found[after], 0.0 if real else _SURE)

        upright = {kind[0]: kind for kind in best if not kind[2]}
        chosen, *others = best
        for kind in others:
            own = upright.get(kind[0], chosen) if kind[2] else chosen
            if pays(chosen, kind) and pays(own, kind):
                chosen = kind
        return chosen

    def _pays(self, before: Floats, after: Floats, sure: float) -> bool:
        """Whether squared errors (parts, classes) fall by a percent and by `sure` standard errors."""
        worst, least = self._share(before).sum(), self._share(after).sum()
        if worst >= _NOTHING:
            return bool(least < _NOTHING)
        gain, std = _paired((self._share(before) - self._share(after))[None])
        alike = (1.0 - (1.0 - _ALIKE) ** 2) * worst
        return bool(gain[0] > max(sure * std[0], alike))

    def _share(self, squares: Floats) -> Floats:
        """Squared error of each part (parts,) over the squared torque of a side, mean of the sides."""
        sides = [c.side for c in self.problem.classes]
        torque = self.held[:, :, -1, -1].sum(axis=0)
        total = np.array([sum(t for t, s in zip(torque, sides, strict=True) if s == side) for side in sides])
        part: Floats = (squares / np.maximum(total, 1e-300)).sum(axis=1) / len(set(sides))
        return part

    def _errors(self, kind: Kind) -> Floats:
        """Squared error (parts, classes) [Nm^2] of a candidate on each part, estimated without it."""
        used, weights, prior = self._estimation(kind)
        return self._scores(used, weights, prior, kind[1] if kind[0] == "physical" else None)

    def _estimation(self, kind: Kind) -> tuple[NDArray[np.int64], Floats, Prior]:
        """A candidate's columns, weights (classes,) and prior."""
        used = np.append(np.arange(len(self.problem.names)), len(self.problem.names) + self._further(kind))
        return used, self._weights(kind), self._prior(kind)

    def _further(self, kind: Kind) -> NDArray[np.int64]:
        """A candidate's columns of `further`."""
        return np.array([*range(2 * kind[2]), *(2 + gain for gain in kind[3])], dtype=np.int64)

    def _weights(self, kind: Kind) -> Floats:
        """Weights (classes,) of a candidate: a joint that a gain explains weighs more than without it."""
        if kind not in self.weights:
            further = self._further(kind)
            columns = [matrix[:, further] for matrix in self.further]
            problem = self.problem.with_columns([f"further_{k}" for k in further], columns, "")
            physical = kind[0] == "physical"
            if physical or kind[3]:
                fit = MaximumAPosteriori(self._prior(kind), 1.0, PLAIN).fit(problem)
            else:
                fit = WeightedLeastSquares(PLAIN).fit(problem)
            self.weights[kind] = _tempered(problem, fit) if physical else fit.weights
        return self.weights[kind]

    def _solved(self, kind: Kind) -> tuple[Floats, Floats]:
        """Values (k,) and covariance (k, k) of a candidate from all rows."""
        used, weights, prior = self._estimation(kind)
        inner = np.ix_(*[np.append(used, self.total.shape[-1] - 1)] * 2)
        normal = np.einsum("c,cij->ij", weights, self.total)[inner]
        covariance = np.linalg.pinv(normal[:-1, :-1] + prior.precision, hermitian=True)
        return _solution(normal, prior), covariance

    def _leans(self, kind: Kind) -> bool:
        """Whether the tilt of a candidate is beyond chance."""
        values, covariance = self._solved(kind)
        place = slice(len(self.problem.names), len(self.problem.names) + 2)
        tilt = values[place]
        square = float(tilt @ np.linalg.solve(covariance[place, place], tilt))
        return chi_square_tail(square, 2) < _UPRIGHT

    def _gains(self, kind: Kind) -> tuple[Floats, Floats]:
        """Errors (k,) of the sensors' scale of a candidate from all rows, and their covariance (k, k)."""
        values, covariance = self._solved(kind)
        own = slice(len(values) - len(kind[3]), None)
        return values[own], covariance[own, own]

    def _gains_of(self, kind: Kind) -> tuple[int, ...]:
        """Sensors with an error of scale beyond chance, beside all others and beside the middle one's; none with a
        single sensor. An error common to most sensors is one of the bodies."""
        count = len(self.joints)
        if count < 2:
            return ()
        values, covariance = self._gains((*kind[:3], tuple(range(count))))
        middle = np.zeros(count)
        np.add.at(middle, np.argsort(values)[[(count - 1) // 2, count // 2]], 0.5)
        beyond = [
            np.abs(some @ values) > _SURE * np.sqrt(np.diag(some @ covariance @ some.T))
            for some in (np.eye(count), np.eye(count) - middle)
        ]
        return tuple(np.flatnonzero(np.all(beyond, axis=0)).tolist())

    def _scores(
        self, used: NDArray[np.int64], weights: Floats, prior: Prior, physical: float | None = None
    ) -> Floats:
        """Squared errors (parts, classes) with some of the columns; the conic program's with its scale `physical`."""
        found = np.empty(self.held.shape[:2])
        columns = np.append(used, self.total.shape[-1] - 1)
        inner, vector = np.ix_(columns, columns), np.zeros(self.total.shape[-1])
        for part, (held, near) in enumerate(zip(self.held, self.near, strict=True)):
            normal = np.einsum("c,cij->ij", weights, self.total - near)[inner]
            values = _solution(normal, prior)
            if physical is not None:
                values = self._consistent(normal, values, physical)
            vector[columns] = np.append(-values, 1.0)
            found[part] = np.maximum(held @ vector @ vector, 0.0)
        return found

    def _consistent(self, normal: Floats, values: Floats, scale: float) -> Floats:
        """`values` with consistent bodies in place of the free parameters, the tilt kept."""
        assert self.bodies is not None
        p = len(self.problem.names)
        shift = np.zeros((len(normal), p + 1))
        shift[:p, :p] = np.eye(p)
        shift[p:-1, -1], shift[-1, -1] = -values[p:], 1.0
        power, vectors = np.linalg.eigh(shift.T @ normal @ shift)
        root = np.sqrt(np.maximum(power, 0.0))[:, None] * vectors.T
        weak = np.diag(self._completed.precision - self._stated.precision) / scale
        open_ = np.diag(np.sqrt(np.maximum(weak, 0.0)))[weak > 0.0]
        matrix = np.vstack([root[:, :p], open_])
        target = np.append(root[:, p], np.zeros(len(open_)))
        standard = self._physical.solve(scale, matrix @ self.bodies.projection, target)
        return np.concatenate([self.bodies.projection @ standard, values[p:]])

    @cached_property
    def _physical(self) -> PhysicallyConsistent:
        assert self.bodies is not None
        return PhysicallyConsistent(self.bodies)

    @cached_property
    def _stated(self) -> Prior:
        """The URDF's prior of the parameters."""
        assert self.bodies is not None
        return self.bodies.prior("pullback")

    @cached_property
    def _completed(self) -> Prior:
        """The same, with a weak prior of what the rows leave open."""
        return self._stated.completed(self.problem)

    def _prior(self, kind: Kind) -> Prior:
        """The URDF's prior of a candidate's parameters, none for least squares, and that of its tilt and gains."""
        _, scale, tilt, gains = kind
        p = len(self.problem.names)
        size = p + 2 * tilt + len(gains)
        mean, precision = np.zeros(size), np.zeros((size, size))
        precision[range(p + 2 * tilt, size), range(p + 2 * tilt, size)] = _GAIN_STD**-2
        if scale is not None:
            precision[range(p, p + 2 * tilt), range(p, p + 2 * tilt)] = _TILT_STD_RAD**-2
            mean[:p], precision[:p, :p] = self._completed.mean, self._completed.precision / scale
        return Prior(mean, precision)

    def _disagreement(self) -> Disagreement | None:
        if self.bodies is None:
            return None
        return Disagreement.between(self._stated, self.problem, self._weights(("physical", 1.0, False, ())))

    def _contradiction(self, candidates: Sequence[Candidate], squares: Floats) -> str:
        """Joints that bodies within the stated deviations of the URDF's predict far worse than any parameters do, where
        this is most of the error; empty if there are none. squares : (candidates, parts, classes).

        Each joint's torque may agree with itself and contradict the others: a gain or a zero is then in the parameters
        of least squares, and no bodies have them.
        """
        plain = {(c.estimator, c.prior_scale): k for k, c in enumerate(candidates) if not (c.tilt or c.gains)}
        stated, free = plain.get(("physical", 1.0)), plain.get(("wls", None))
        if stated is None or free is None:
            return ""
        more = squares[stated] - squares[free]
        excess, std = _paired(more.T)
        far = squares[stated].sum(axis=0) > _FAR_WORSE**2 * squares[free].sum(axis=0)
        far &= excess > _SURE * std
        if self._share(more * far).sum() <= _MOSTLY * self._share(squares[stated]).sum():
            return ""
        listed = ", ".join(
            f"{c.label} {candidates[stated].by_joint_percent[c.label]:.1f} against "
            f"{candidates[free].by_joint_percent[c.label]:.1f} %"
            for c, one in zip(self.problem.classes, far, strict=True)
            if one
        )
        return (
            f"no bodies like the URDF's explain the torques that least squares explains: error of the held-back data "
            f"{listed}; check sign, gain and zero of positions and torques from there outward, and the URDF's masses"
        )

    def _worse_joints(self, candidates: Sequence[Candidate], squares: Floats, chosen: int) -> Iterator[str]:
        """Joints that the winner predicts worse than least squares, beyond two standard errors."""
        mine = candidates[chosen]
        for k, other in enumerate(candidates):
            if other.estimator != "wls" or (other.tilt, other.gains) != (mine.tilt, ()) or k == chosen:
                continue
            excess, std = _paired((squares[chosen] - squares[k]).T)
            worse = [
                c.label
                for c, e, s in zip(self.problem.classes, excess, std, strict=True)
                if e > _SURE * s
                and mine.by_joint_percent[c.label] > other.by_joint_percent[c.label] + 100.0 * _ALIKE
            ]
            if worse:
                listed = ", ".join(
                    f"{label} {mine.by_joint_percent[label]:.1f} against {other.by_joint_percent[label]:.1f} %"
                    for label in worse
                )
                yield f"least squares predicts single joints better than the chosen estimator: {listed}"


def _lower_by_chance(candidates: Sequence[Candidate], chosen: int) -> Iterator[str]:
    """A candidate of clearly less error than the chosen one, and why it is not that."""
    mine, least = candidates[chosen], min(candidates, key=lambda one: one.held_back_percent)
    if least.held_back_percent < (1.0 - _ALIKE) * mine.held_back_percent:
        yield (
            f"the lower error of {least.title} is no proof: it is not beyond two standard errors over the parts, and "
            "then bodies near the URDF's go before least squares, an upright base before a leaning one"
        )


def _tighter(kind: Kind) -> Kind | None:
    """The same with the next smaller variance of the prior, None for the stated one."""
    estimator, scale, tilt, gains = kind
    return None if scale is None or scale <= 1.0 else (estimator, scale / _LOOSER, tilt, gains)


def _paired(difference: Floats) -> tuple[Floats, Floats]:
    """Sum over the parts (k, parts) and its standard error, (k,) each."""
    count = difference.shape[1]
    spread = difference - difference.mean(axis=1, keepdims=True)
    return difference.sum(axis=1), np.sqrt(count / (count - 1.0) * np.sum(spread**2, axis=1))


def _solution(normal: Floats, prior: Prior) -> Floats:
    """Solution of the normal equations (q + 1, q + 1) with the prior; of least norm where they leave it open."""
    left = normal[:-1, :-1] + prior.precision
    right = normal[:-1, -1] + prior.precision @ prior.mean
    scale = np.sqrt(np.diag(left))
    scale = np.where(scale > 0.0, scale, 1.0)
    solution: Floats = np.linalg.lstsq(left / np.outer(scale, scale), right / scale, rcond=1e-12)[0] / scale
    return solution


def _tempered(problem: Problem, fit: Estimate) -> Floats:
    """Weights (classes,) with the effective number of rows, as the estimators with a prior use them."""
    count = np.array([max(c.factor.rows, 1) for c in problem.classes])
    return np.asarray(fit.weights * np.minimum(effective_rows(problem, fit.residuals) / count, 1.0))
