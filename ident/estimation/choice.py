"""Choice of the estimator by what it predicts: the torque of parts of the training motion held back.

Candidates are weighted least squares, and physically consistent bodies with the inertials of the URDF as prior: as
stated, and with looser standard deviations. Each is scored with the base upright and leaning.

**Choice.** The squared error over the squared torque counts, over all joints and parts (`ident.estimation.parts`);
motor and joint side count alike. Among the candidates within one standard error of the best (Breiman et al. 1984), or
within one percent of it, the one with the most prior knowledge wins: prior as stated before looser ones before least
squares, upright before leaning. Deviations of the prior are loosened as long as the error falls.

Normal equations of each part are made once, so a linear candidate costs a solution a part, a physical one a conic
program.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fri.errors import DataError
from ident.dynamics.kinematics import Chain
from ident.dynamics.parameters import Floats
from ident.dynamics.tables import Tabular
from ident.estimation.identify import (
    Identification,
    IdentificationSettings,
    Known,
    estimator_factory,
    identify,
)
from ident.estimation.mounting import Mounting, find_mounting, tilt_columns, with_tilt
from ident.estimation.parts import beside, held_back_parts
from ident.estimators.covariance import CovarianceSettings, effective_rows
from ident.estimators.estimate import Estimate
from ident.estimators.least_squares import WeightedLeastSquares
from ident.estimators.physical import BodyPrior, PhysicallyConsistent, cad_prior
from ident.estimators.prior import Disagreement, MaximumAPosteriori, Prior
from ident.estimators.problem import Problem
from ident.rows.filters import half_width
from lwr_driver.session import Sessions, as_sessions

_SCALES = (1.0, 10.0, 100.0)
_TILT_STD_RAD = float(np.deg2rad(2.0))
_GAIN_STD = 0.05
# Errors this close to one another count as equal, and so much of a joint's torque as nothing.
_ALIKE = 0.01
_PLAIN = CovarianceSettings(kind="textbook")

Kind = tuple[str, float | None, bool]
"""Estimator, factor on the variance of the prior, leaning base."""


@dataclass(frozen=True)
class Candidate:
    """An estimator with its error on held-back parts.

    estimator : "wls" or "physical". prior_scale : factor on the variance of the prior, None without one.
    tilt : whether the base leans. held_back_percent : rms of the error over rms of the torque [%], over all joints of
    a side; for two sides the root mean square of both.
    by_joint_percent : the same by joint and side. excess, excess_std : difference of the squared error to the best
    candidate's, over the squared torque, and its standard error over the parts.
    """

    estimator: str
    prior_scale: float | None
    tilt: bool
    held_back_percent: float
    by_joint_percent: dict[str, float]
    excess: float = 0.0
    excess_std: float = 0.0

    @property
    def title(self) -> str:
        """The candidate in words."""
        loose = 1.0 if self.prior_scale is None else float(np.sqrt(self.prior_scale))
        text = self.estimator + ("" if loose == 1.0 else f", prior's deviations x {loose:.3g}")
        return text + (", base leaning" if self.tilt else "")


@dataclass(frozen=True)
class Choice(Tabular):
    """The chosen estimator, its competitors, and what the comparison shows of prior and sensors.

    candidates : in the order of preference. chosen : number of the winner. parts, block_s : of the held-back rows.
    excluded : candidates that the data do not permit, with the reason. disagreement : between the URDF's inertials
    and the data. advice : sentences for the report. mounting : the tilt of the base, if the winner has one.
    used : the estimator taken instead of the winner; empty for the winner itself.
    """

    candidates: tuple[Candidate, ...]
    chosen: int
    parts: int
    block_s: float
    excluded: tuple[str, ...] = ()
    disagreement: Disagreement | None = None
    advice: tuple[str, ...] = ()
    mounting: Mounting | None = None
    used: str = ""

    @property
    def winner(self) -> Candidate:
        """The chosen candidate."""
        return self.candidates[self.chosen]

    def records(self) -> list[dict[str, Any]]:
        """One row a candidate."""
        return [
            vars(c) | {"title": c.title, "chosen": k == self.chosen} for k, c in enumerate(self.candidates)
        ]

    def to_dict(self) -> dict[str, Any]:
        """Plain content for files."""
        return {
            "chosen": self.winner.title,
            "used": self.used or self.winner.title,
            "parts": self.parts,
            "block_s": self.block_s,
            "candidates": [
                {key: None if value != value else value for key, value in row.items()}
                for row in self.records()
            ],
            "excluded": list(self.excluded),
            "prior_disagreement": None if self.disagreement is None else self.disagreement.to_dict(),
            "advice": list(self.advice),
            "mounting": None if self.mounting is None else self.mounting.to_dict(),
        }

    def __repr__(self) -> str:
        return f"Choice of the estimator: {self.winner.title}"

    def __str__(self) -> str:
        instead = f"; this estimate is by {self.used}" if self.used else ""
        lines = [f"estimator: {self.winner.title}{instead}"]
        if self.parts:
            lines = [
                f"estimator by held-back error: {self.winner.title}{instead}",
                f"  error [% of torque] on {self.parts} parts of the motion held back in turn, in blocks of "
                f"{self.block_s:.1f} s",
            ]
            width = max(len(c.title) for c in self.candidates)
            for number, c in enumerate(self.candidates):
                mark = "  <- chosen" if number == self.chosen else ""
                lines.append(f"  {c.title:<{width}}{c.held_back_percent:>8.2f}{mark}")
        lines += [f"  not possible: {text}" for text in self.excluded]
        lines += [f"  {text}" for text in self.advice]
        if self.disagreement is not None:
            lines.append(f"  {self.disagreement}")
        if self.mounting is not None:
            lines.append(f"  {self.mounting}")
        return "\n".join(lines)


def choose(
    sessions: Sessions,
    chain: Chain,
    settings: IdentificationSettings | None = None,
    *,
    tilt: bool | None = None,
    known: Known | None = None,
) -> Identification:
    """The arm identified by the candidate with the least held-back error; arguments as for `identify`.

    tilt : True scores the leaning base only, False the upright one, None both.

    The result's `choice` says what was compared. Raises the errors of `identify`.
    """
    settings = settings or IdentificationSettings()
    sessions = as_sessions(sessions)
    prior = chain.urdf is not None and settings.model != 3
    plain = replace(settings, estimator="map" if prior else "wls", essential=None)
    first = identify(sessions, chain, plain, known=known)
    choice = compared(first, sessions, tilt=tilt)
    winner = choice.winner
    options: dict[str, Any] = {"prior_strength": winner.prior_scale} if winner.estimator == "physical" else {}
    settled = replace(first.settings, estimator=settings.estimator, essential=settings.essential)
    final = replace(settled, estimator=estimator_factory(winner.estimator, **options))
    if winner.tilt:
        mounting = find_mounting(sessions, chain, final, known=first.known)
        found, choice = mounting.identification, replace(choice, mounting=mounting)
    else:
        found = identify(sessions, chain, final, known=first.known)
    return replace(found, settings=settled, choice=choice)


def compared(
    found: Identification, sessions: Sessions, *, tilt: bool | None = None, used: str = ""
) -> Choice:
    """The candidates' errors on held-back parts of the sessions of an identification, and the best of them.

    tilt : as for `choose`. used : the estimator of the identification, if it stays whatever is found.
    """
    chain, model = found.structure.chain, found.settings.model
    leaning = model != 3 and bool(np.any(chain.gravity)) and tilt is not False
    lean = tilt_columns(found, as_sessions(sessions)) if leaning else None
    bodies = cad_prior(found.base) if chain.urdf is not None and model != 3 else None
    tilted = (False,) if not leaning else (False, True) if tilt is None else (True,)
    return replace(_Comparison.of(found, lean, bodies).choice(tilted), used=used)


@dataclass(frozen=True)
class _Comparison:
    """Normal equations of the held-back parts: the parameters, two of the tilt, one gain a joint, the torque.

    total : (classes, q, q) of all rows. held : (parts, classes, q, q) of the rows of a part. near : the same with the
    rows beside them, missing in the training.
    """

    problem: Problem
    leaning: Problem | None
    bodies: BodyPrior | None
    gains: NDArray[np.int64]
    total: Floats
    held: Floats
    near: Floats
    block_s: float
    full_rank: bool
    unseen: tuple[str, ...]

    @classmethod
    def of(
        cls, found: Identification, lean: Sequence[Floats] | None, bodies: BodyPrior | None
    ) -> _Comparison:
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
        extra = 2 + len(joints)
        q = len(problem.names) + extra + 1
        held = np.zeros((count, len(problem.classes), q, q))
        near, total = np.zeros_like(held), np.zeros((len(problem.classes), q, q))
        for number, (group, part) in enumerate(zip(problem.groups, parts, strict=True)):
            matrix = np.zeros((len(group.target), q))
            matrix[:, : len(values)] = group.matrix
            if lean is not None:
                matrix[:, len(values) : len(values) + 2] = lean[number]
            if group.side == "joint":
                matrix[:, len(values) + 2 + joints.index(group.joint)] = group.matrix @ rigid
            matrix[:, -1] = group.target
            row_class = problem.class_of_group[number]
            total[row_class] += matrix.T @ matrix
            for k in range(count):
                mine = part == k
                around = beside(group.time_index, mine, (block + 1) // 2)
                held[k, row_class] += matrix[mine].T @ matrix[mine]
                near[k, row_class] += matrix[around].T @ matrix[around]
        return cls(
            problem,
            None if lean is None else with_tilt(problem, lean),
            bodies,
            np.arange(len(values) + 2, len(values) + extra),
            total,
            held,
            near,
            block * problem.sample_time_s,
            bool(np.isfinite(found.condition_normalised)),
            found.estimate.prior_only,
        )

    def choice(self, tilted: Sequence[bool]) -> Choice:
        """All candidates, and the preferred one within a standard error of the best."""
        bodies = self.bodies is not None
        unseen = ", ".join(self.unseen[:8]) + (
            f" and {len(self.unseen) - 8} more" if len(self.unseen) > 8 else ""
        )
        excluded = () if self.full_rank else (f"wls, because the motion does not show {unseen}",)
        advice = list(self._placeholder())
        if len(self.held) < 2:
            unknown = Candidate(
                "physical" if bodies else "wls", 1.0 if bodies else None, tilted[0], math.nan, {}
            )
            text = f"not compared: the motion is too short for parts of {self.block_s:.1f} s to be held back"
            return Choice((unknown,), 0, 0, self.block_s, excluded, self._disagreement(), (text, *advice))
        found: dict[Kind, Floats] = {}
        for tilt in tilted if bodies else ():
            for scale in _SCALES:
                try:
                    found["physical", scale, tilt] = self._errors("physical", scale, tilt)
                except DataError as error:
                    excluded = (*excluded, f"physical: {error}")
                    break
                before = found.get(("physical", 0.1 * scale, tilt))
                if (
                    before is not None
                    and self._share(before).sum() < self._share(found["physical", scale, tilt]).sum()
                ):
                    break
        if self.full_rank:
            found |= {("wls", None, tilt): self._errors("wls", None, tilt) for tilt in tilted}
        kinds = sorted(found, key=lambda kind: (math.inf if kind[1] is None else kind[1], kind[2]))
        squares = np.array([found[kind] for kind in kinds])
        share = np.array([self._share(square) for square in squares])
        best = int(np.argmin(share.sum(axis=1)))
        excess, std = _paired(share - share[best])
        alike = ((1.0 + _ALIKE) ** 2 - 1.0) * share[best].sum()
        chosen = next(k for k in range(len(kinds)) if excess[k] <= max(std[k], alike))
        labels = [c.label for c in self.problem.classes]
        torque = self.held[:, :, -1, -1].sum(axis=0)
        joint = 100.0 * np.sqrt(squares.sum(axis=1) / np.maximum(torque, 1e-300))
        whole = 100.0 * np.sqrt(share.sum(axis=1))
        candidates = tuple(
            Candidate(
                *kind,
                float(whole[k]),
                dict(zip(labels, joint[k].tolist(), strict=True)),
                float(excess[k]),
                float(std[k]),
            )
            for k, kind in enumerate(kinds)
        )
        advice += self._worse_joints(candidates, squares, chosen)
        advice += self._gain_advice(kinds[chosen])
        return Choice(
            candidates, chosen, len(self.held), self.block_s, excluded, self._disagreement(), tuple(advice)
        )

    def _share(self, squares: Floats) -> Floats:
        """Squared error of each part (parts,) over the squared torque of a side, mean of the sides."""
        sides = [c.side for c in self.problem.classes]
        torque = self.held[:, :, -1, -1].sum(axis=0)
        total = np.array([sum(t for t, s in zip(torque, sides, strict=True) if s == side) for side in sides])
        part: Floats = (squares / np.maximum(total, 1e-300)).sum(axis=1) / len(set(sides))
        return part

    def _errors(self, estimator: str, scale: float | None, tilt: bool) -> Floats:
        """Squared error (parts, classes) [Nm^2] of a candidate on each part, estimated without it."""
        p = len(self.problem.names)
        used = np.arange(p + 2 * tilt)
        problem = self.leaning if tilt and self.leaning is not None else self.problem
        if estimator == "wls":
            free = Prior(np.zeros(len(used)), np.zeros((len(used),) * 2))
            weights = WeightedLeastSquares(_PLAIN).fit(problem).weights
            return self._scores(used, weights, free)
        prior = self._prior(2 * tilt, _TILT_STD_RAD, problem)
        scale = 1.0 if scale is None else scale
        fit = MaximumAPosteriori(prior, scale, _PLAIN).fit(problem)
        return self._scores(used, _tempered(problem, fit), _scaled(prior, scale), scale)

    def _scores(
        self, used: NDArray[np.int64], weights: Floats, prior: Prior, physical: float | None = None
    ) -> Floats:
        """Squared errors (parts, classes) with some of the columns; the conic program's with its scale `physical`."""
        found = np.empty(self.held.shape[:2])
        columns = np.append(used, self.total.shape[-1] - 1)
        inner = np.ix_(columns, columns)
        for part, (held, near) in enumerate(zip(self.held, self.near, strict=True)):
            normal = np.einsum("c,cij->ij", weights, self.total - near)[inner]
            values = _solution(normal, prior)
            if physical is not None:
                values = self._consistent(normal, values, physical)
            vector = np.append(-values, 1.0)
            found[part] = [max(float(vector @ square[inner] @ vector), 0.0) for square in held]
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
        weak = (
            np.diag(self._prior(0, 1.0, self.problem).precision - self.bodies.prior("pullback").precision)
            / scale
        )
        matrix = np.vstack([root[:, :p], np.diag(np.sqrt(np.maximum(weak, 0.0)))])
        target = np.append(root[:, p], np.zeros(p))
        standard = PhysicallyConsistent(self.bodies).solve(scale, matrix @ self.bodies.projection, target)
        return np.concatenate([self.bodies.projection @ standard, values[p:]])

    def _prior(self, extra: int, std: float, problem: Problem) -> Prior:
        """The URDF's prior of the parameters, and `extra` columns of mean zero and standard deviation `std`."""
        assert self.bodies is not None
        arm = self.bodies.prior("pullback").completed(self.problem)
        p = len(arm.mean)
        precision = np.zeros((p + extra, p + extra))
        precision[:p, :p] = arm.precision
        precision[range(p, p + extra), range(p, p + extra)] = std**-2
        return Prior(np.append(arm.mean, np.zeros(extra)), precision)

    def _placeholder(self) -> Iterator[str]:
        if self.bodies is None:
            return
        masses = self.bodies.inertial[: len(self.bodies.inertial), 9]
        if len(masses) > 1 and float(np.ptp(masses)) < 1e-6 * float(masses.max()):
            yield (
                f"the URDF gives every link the same mass ({masses[0]:.3g} kg): a placeholder, so its inertials are no "
                "knowledge of this arm; give a URDF with the manufacturer's inertials, or choose `--estimator wls`"
            )

    def _disagreement(self) -> Disagreement | None:
        if self.bodies is None:
            return None
        prior = self.bodies.prior("pullback")
        fit = MaximumAPosteriori(prior, 1.0, _PLAIN).fit(self.problem)
        return Disagreement.between(prior, self.problem, _tempered(self.problem, fit))

    def _worse_joints(self, candidates: Sequence[Candidate], squares: Floats, chosen: int) -> Iterator[str]:
        """Joints that the winner predicts worse than least squares, beyond two standard errors."""
        mine = candidates[chosen]
        for k, other in enumerate(candidates):
            if other.estimator != "wls" or other.tilt != mine.tilt or k == chosen:
                continue
            excess, std = _paired((squares[chosen] - squares[k]).T)
            worse = [
                c.label
                for c, e, s in zip(self.problem.classes, excess, std, strict=True)
                if e > 2.0 * s
                and mine.by_joint_percent[c.label] > other.by_joint_percent[c.label] + 100.0 * _ALIKE
            ]
            if worse:
                listed = ", ".join(
                    f"{label} {mine.by_joint_percent[label]:.1f} against {other.by_joint_percent[label]:.1f} %"
                    for label in worse
                )
                yield f"least squares predicts single joints better than the chosen estimator: {listed}"

    def _gain_advice(self, kind: Kind) -> Iterator[str]:
        """Whether a gain of each joint torque sensor would help the prediction, by more than two standard errors."""
        estimator, scale, tilt = kind
        if self.bodies is None or estimator != "physical" or not len(self.gains):
            return
        scale = 1.0 if scale is None else scale
        p = len(self.problem.names)
        used = np.arange(p + 2 * tilt)
        problem = self.leaning if tilt and self.leaning is not None else self.problem
        plain = self._prior(2 * tilt, _TILT_STD_RAD, problem)
        weights = _tempered(problem, MaximumAPosteriori(plain, scale, _PLAIN).fit(problem))
        size = len(used) + len(self.gains)
        precision = np.diag(np.full(size, _GAIN_STD**-2))
        precision[: len(used), : len(used)] = plain.precision / scale
        wide = Prior(np.append(plain.mean, np.zeros(len(self.gains))), precision)
        columns = np.append(used, self.gains)
        before = self._share(self._scores(used, weights, _scaled(plain, scale)))
        after = self._share(self._scores(columns, weights, wide))
        excess, std = _paired((before - after)[None])
        if excess[0] <= 2.0 * std[0]:
            return
        inner = np.ix_(
            np.append(columns, self.total.shape[-1] - 1), np.append(columns, self.total.shape[-1] - 1)
        )
        normal = np.einsum("c,cij->ij", weights, self.total)[inner]
        gains = _solution(normal, wide)[-len(self.gains) :]
        spread = np.sqrt(np.diag(np.linalg.inv(normal[:-1, :-1] + wide.precision))[-len(self.gains) :])
        joints = list(dict.fromkeys(group.joint for group in self.problem.groups if group.side == "joint"))
        worst = int(np.argmax(np.abs(gains) / spread))
        yield (
            f"with a gain for each joint torque sensor the held-back error would fall from "
            f"{100 * np.sqrt(before.sum()):.2f} to {100 * np.sqrt(after.sum()):.2f} % "
            f"({joints[worst]} reads {100 * gains[worst]:+.1f} ± {100 * spread[worst]:.1f} %); `lwr-run diagnose` "
            "decides between a gain and its look-alikes, and writes a model with it"
        )


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


def _scaled(prior: Prior, scale: float) -> Prior:
    return replace(prior, precision=prior.precision / scale)


def _tempered(problem: Problem, fit: Estimate) -> Floats:
    """Weights (classes,) with the effective number of rows, as the estimators with a prior use them."""
    count = np.array([max(c.factor.rows, 1) for c in problem.classes])
    return np.asarray(fit.weights * np.minimum(effective_rows(problem, fit.residuals) / count, 1.0))
