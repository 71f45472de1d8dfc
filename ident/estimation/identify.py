"""From session logs to a dynamic model with the uncertainty of each parameter."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any

import numpy as np

from fri.errors import DataError
from ident.dynamics.base_set import BaseSet, numeric_base
from ident.dynamics.kinematics import Chain
from ident.dynamics.known_arm import known_arm
from ident.dynamics.structure import Condition, Coulomb, Coupling, ModelStructure, Side
from ident.estimation.assumptions import check_assumptions, weak_parameters
from ident.estimation.channel_errors import beside_channel_errors
from ident.estimation.essential import find_essential
from ident.estimation.feasibility import NEAREST_REAL, feasibility
from ident.estimation.identification import EstimatorFactory, Identification, IdentificationSettings, Known
from ident.estimation.plausibility import payload_warnings, require_plausible
from ident.estimation.session_rows import apart_in_time, session_rows, with_delays
from ident.estimators import ESTIMATORS
from ident.estimators.covariance import CovarianceSettings
from ident.estimators.errors_in_variables import InstrumentalVariables
from ident.estimators.estimate import Estimate, Estimator
from ident.estimators.names import AUTO
from ident.estimators.physical import cad_prior
from ident.estimators.problem import Problem
from ident.rows.content import Recall
from ident.rows.observation import stack
from ident.rows.prepared import PreparedSession
from ident.rows.sessions import payload_name, recorded_couplings, require
from ident.rows.shared_rows import marks
from ident.rows.signal_choice import choose_signals
from ident.screening.doubts import doubted_joints, explaining, late_positions, settle
from ident.screening.screen import require_sound
from lwr_driver.session import Session, Sessions, as_sessions

if TYPE_CHECKING:
    pass

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Observed:
    """The rows of the sessions of an arm, for any number of estimators.

    settings : with the figures that the data chose. problem : the stacked regression. instruments : the rows of the
    commanded motion, empty where a session has none. sessions : with the chain's joints. recall : of them, see
    `prepare`. Others: see `Identification`.
    """

    settings: IdentificationSettings
    structure: ModelStructure
    base: BaseSet
    problem: Problem
    instruments: tuple[Problem, ...]
    prepared: tuple[PreparedSession, ...]
    payloads: tuple[str | None, ...]
    sessions: tuple[Session, ...]
    known: Known
    recall: Recall

    @cached_property
    def marks(self) -> tuple[str, ...]:
        """Marks of the rows of each session."""
        return tuple(marks(session) for session in self.sessions)

    @cached_property
    def full_rank(self) -> bool:
        """Whether the motion shows all parameters."""
        return bool(np.isfinite(self.problem.normalised_condition))

    @cached_property
    def instrumental(self) -> Estimate | None:
        """Estimate by the commanded motion as instruments; None without one or without full rank."""
        if not self.instruments or not self.full_rank:
            return None
        matrices = [group.matrix for one in self.instruments for group in one.groups]
        return InstrumentalVariables(lambda values: matrices, self.settings.covariance).fit(self.problem)

    def identified(self, settings: IdentificationSettings) -> Identification:
        """The estimate by `settings`, which differ from those of the rows in estimator and essential search alone."""
        problem, base = self.problem, self.base
        name = settings.estimator
        factory = estimator_factory(name) if isinstance(name, str) else name
        estimator = factory(base, problem, settings.covariance)
        if getattr(estimator, "needs_rank", True):
            problem.require_rank()
        # With instrumental variables, this is the WLS compared with them.
        estimate = plain = estimator.fit(problem)
        if name == "iv":
            if self.instrumental is None:
                raise DataError(
                    "estimator `iv` takes its instruments from the commanded motion, missing in a session: record "
                    "/joint_command and do not average periods, or choose `wls`"
                )
            estimate = self.instrumental
        doubted = doubted_joints(self.known.doubts) | _late_joints(self.prepared)
        assumptions = check_assumptions(
            problem,
            plain,
            instrumental=self.instrumental,
            period_rows=_common_period(self.prepared),
            doubted=doubted,
        )
        essential = None
        if settings.essential is not None and self.full_rank:
            essential = find_essential(problem, estimate, settings.essential, settings.covariance)
        told = estimate
        if settings.covariance.kind != "textbook":
            told = beside_channel_errors(problem, estimate)
            if essential is not None:
                reduced = problem.select(essential.columns)
                essential = replace(essential, estimate=beside_channel_errors(reduced, essential.estimate))
        warnings = [
            *settle(self.known.doubts),
            *(text for session in self.prepared for text in session.warnings),
        ]
        warnings += require_plausible(problem, estimate, self.structure.chain.joint_names)
        real = feasibility(base, estimate)
        if real is not None and not real.possible:
            warnings.append(f"{real}; {NEAREST_REAL}")
        warnings += payload_warnings(self.sessions, self.payloads, base, told, self.structure)
        warnings += [] if self.full_rank else _too_short(estimate, self.prepared)
        warnings += _excitation_warnings(problem, estimate, self.full_rank, doubted)
        return Identification(
            settings=settings,
            structure=self.structure,
            base=base,
            problem=problem,
            estimate=told,
            prepared=self.prepared,
            payloads=self.payloads,
            condition=problem.condition,
            condition_normalised=problem.normalised_condition,
            assumptions=assumptions,
            essential=essential,
            robot=settings.robot or self.sessions[0].metadata.get("robot", "") or "arm",
            warnings=tuple(warnings),
            known=self.known,
            marks=self.marks,
            feasibility=real,
        )


def identify(
    sessions: Sessions,
    chain: Chain,
    settings: IdentificationSettings | None = None,
    *,
    known: Known | None = None,
    recall: Recall | None = None,
) -> Identification:
    """Identify the arm `chain` from one or more sessions, stacked.

    sessions : a session, the path of a log, or several of either. The payload of each comes from its metadata
        (`none`: the bare arm). A session without motor or joint torques adds the rows of the other side only.
    settings : default `known_settings`, with the result of `lwr-run identify`; given ones are taken as they are.
    known : of these sessions, from an earlier identification with the same signal settings; they are not screened
        again.
    recall : as for `prepare`.

    Raises ConfigurationError for arguments of a wrong type, DataError for unusable sessions.
    """
    require(chain, Chain, "chain", "read one with `Chain.from_urdf`")
    if settings is None:
        sessions = as_sessions(sessions)
        settings = known_settings(sessions, chain)
    require(settings, IdentificationSettings, "settings", "make one with `IdentificationSettings(model=2)`")
    if settings.estimator == AUTO:
        from ident.estimation.automatic import choose

        return choose(sessions, chain, settings, known=known, recall=recall)
    rows = observed(sessions, chain, settings, known=known, recall=recall)
    return rows.identified(rows.settings)


def known_settings(
    sessions: Sessions,
    chain: Chain,
    settings: IdentificationSettings | None = None,
    *,
    model: int | None = None,
) -> IdentificationSettings:
    """The settings with what is known of arm and sessions, as of `lwr-run identify`.

    settings : default those of the command, with the estimator `auto`. model : as asked for; None: Model 1 of sessions
    without motor torques, else the settings'. Added are the stiffness of the arm's file, where the settings state none
    and the chain has its joints, and the coupled drives that the sessions' metadata name.
    """
    settings = settings or IdentificationSettings(estimator=AUTO)
    read = as_sessions(sessions)
    if model is not None:
        settings = replace(settings, model=model)
    elif all(session.motor is None for session in read):
        settings = replace(settings, model=1)
    if not settings.couplings:
        settings = replace(settings, couplings=tuple(map(Coupling.of, recorded_couplings(read))))
    arm = known_arm(chain)
    if arm is not None and settings.signals.stiffness_nm_rad is None:
        signals = replace(settings.signals, stiffness_nm_rad=tuple(arm.stiffness.tolist()))
        settings = replace(settings, signals=signals)
    return settings


def observed(
    sessions: Sessions,
    chain: Chain,
    settings: IdentificationSettings,
    *,
    known: Known | None = None,
    recall: Recall | None = None,
) -> Observed:
    """The rows of the sessions for any estimator; arguments and errors as for `identify`."""
    sessions = as_sessions(sessions)
    if not sessions:
        raise DataError("no session given; name at least one session file")
    chosen = [session.select(chain.joint_names) for session in sessions]
    _same_robot(chosen)
    needs_motor = settings.model in (2, 3)
    with_motor = [session.motor is not None for session in chosen]
    if needs_motor and not any(with_motor):
        names = ", ".join(session.path.name for session in chosen)
        raise DataError(
            f"Model {settings.model} needs motor torques, and {names} "
            f"ha{'s' if len(chosen) == 1 else 've'} no /motor_states; choose Model 1 (`--model 1`), or "
            "record with a motor torque source"
        )
    if settings.model == 3:
        chosen = [session for session, has in zip(chosen, with_motor, strict=True) if has]
    sensed = any(bool(session.joint.effort.shape[1]) for session in chosen)
    if not sensed and settings.model != 2:
        raise DataError(
            f"Model {settings.model} needs joint torques, and no session has them; choose Model 2 "
            "(`--model 2`), then of motor rows only"
        )
    payloads = [payload_name(session) for session in chosen]
    carried = tuple(dict.fromkeys(p for p in payloads if p is not None)) if settings.model != 3 else ()
    settings = replace(settings, signals=settings.signals.of_coupled(settings.couplings))
    structure = ModelStructure(
        chain,
        settings.model,
        carried,
        settings.without,
        settings.couplings,
        settings.coulomb or Coulomb(),
        () if sensed else ("motor",),
    )
    first, recall = known is None, recall or Recall()
    if known is None:
        found = require_sound(
            chosen, chain, settings.signals, settings.couplings, motor=needs_motor, recall=recall
        )
        known = Known(found)
    with explaining(known.doubts):
        mounted = payloads if settings.model != 3 else [None] * len(payloads)
        base = numeric_base(structure, _conditions(structure, chosen, mounted))
        laws = (settings.coulomb, settings.row_coulomb)
        signals = choose_signals(
            chosen, mounted, structure, base.columns, settings.signals, laws, recall=recall
        )
        known = replace(known, signal_reasons=known.signal_reasons or signals.reasons)
        rows_structure = replace(structure, coulomb=signals.row_coulomb)
        structure = replace(structure, coulomb=signals.coulomb)
        base = replace(base, structure=structure)
        settings = replace(
            settings, signals=signals.settings, coulomb=signals.coulomb, row_coulomb=signals.row_coulomb
        )
        make = partial(
            session_rows,
            structure=rows_structure,
            base=base,
            resonance_hz=settings.resonance_hz,
            motor=needs_motor,
            advise=not known.signal_reasons,
            recall=recall,
        )
        # One session after the other, so that memory holds the full-rate signals of one only.
        pairs = list(zip(chosen, mounted, strict=True))
        made = [make(session, payload, signals=settings.signals) for session, payload in pairs]
        late = late_positions(known.doubts)
        made = apart_in_time(with_delays(made, pairs, settings.signals, make, late_positions=late))
        for warning in (text for one in made for text in one.prepared.warnings) if first else ():
            # The result holds them; here they precede an error.
            logger.info("%s", warning)
        prepared, problems = [one.prepared for one in made], [one.problem for one in made]
        instruments = [one.instruments for one in made if one.instruments is not None]
        _every_joint_moves(prepared, chain)
        return Observed(
            settings=settings,
            structure=structure,
            base=base,
            problem=stack(problems),
            instruments=tuple(instruments) if len(instruments) == len(problems) else (),
            prepared=tuple(prepared),
            payloads=tuple(payloads),
            sessions=tuple(chosen),
            known=known,
            recall=recall,
        )


def estimator_factory(name: str, *, prior_std: float = 0.2, **options: Any) -> EstimatorFactory:
    """Factory of the estimator `name` with some of its options (`ident.estimators.ESTIMATORS`).

    prior_std : standard deviation of the URDF's inertials as a share of themselves.
    """
    kind = ESTIMATORS[name]

    def factory(base: BaseSet, problem: Problem, covariance: CovarianceSettings) -> Estimator:
        prior = {"prior": cad_prior(base, relative_std=prior_std)} if kind.body_prior else {}
        return kind.make(covariance=covariance, **prior, **options)

    return factory


def _common_period(prepared: Sequence[PreparedSession]) -> int | None:
    """Rows of a period, if all sessions share it and at least one has two periods."""
    lengths = {session.period_rows for session in prepared}
    length = lengths.pop() if len(lengths) == 1 else None
    averaged = any(session.settings.average_periods for session in prepared)
    return None if averaged or not any(session.periods > 1 for session in prepared) else length


def _same_robot(sessions: Sequence[Session]) -> None:
    for key in ("robot", "serial"):
        found = {session.metadata.get(key, "") for session in sessions} - {""}
        if len(found) > 1:
            listed = ", ".join(f"{s.path.name}: {s.metadata.get(key) or 'unnamed'}" for s in sessions)
            raise DataError(
                f"the sessions are of different robots by their `{key}` ({listed}); identify each robot by "
                "itself"
            )


def _every_joint_moves(prepared: Sequence[PreparedSession], chain: Chain) -> None:
    still = [name for name in chain.joint_names if not any(name in session.moving for session in prepared)]
    if still:
        raise DataError(
            f"joint{'s' if len(still) > 1 else ''} {', '.join(still)} never "
            f"move{'s' if len(still) == 1 else ''}; plan an excitation of every joint, or identify "
            "with a chain in which these joints are fixed"
        )


def _conditions(
    structure: ModelStructure, sessions: Sequence[Session], payloads: Sequence[str | None]
) -> tuple[Condition, ...]:
    found: dict[Condition, None] = {}
    for session, payload in zip(sessions, payloads, strict=True):
        joint, motor = bool(session.joint.effort.shape[1]), session.motor is not None
        sides: tuple[Side, ...] = tuple(
            side for side in structure.sides if (joint or side == "motor") and (motor or side == "joint")
        )
        if sides:
            found[Condition(payload, sides)] = None
    return tuple(found)


def _late_joints(prepared: Sequence[PreparedSession]) -> frozenset[str]:
    """Joints with a torque that is late by itself."""
    delays = [delay for session in prepared for delay in (session.joint_delay, session.delay)]
    return frozenset(joint for delay in delays if delay is not None for joint in delay.apart)


def _too_short(estimate: Estimate, prepared: Sequence[PreparedSession]) -> list[str]:
    """A warning where most parameters are less certain than their size, of motion without full rank: with it real arms
    have up to a half of such parameters, small ones."""
    sizes = np.abs(estimate.values)
    unsure = int(np.count_nonzero(estimate.std > sizes))
    if 2 * unsure <= len(sizes):
        return []
    seconds = sum(session.counts["rows"] * session.row_time_s for session in prepared)
    return [
        f"too little motion: {unsure} of {len(sizes)} parameters have a standard deviation beyond their size, from "
        f"{seconds:.2g} s of motion; the model holds for this motion at best: record half a minute or more, with every "
        "joint over much of its range"
    ]


def _excitation_warnings(
    problem: Problem, estimate: Estimate, full_rank: bool, doubted: frozenset[str]
) -> list[str]:
    if not full_rank:
        named = ", ".join(estimate.prior_only)
        return [
            f"the motion does not determine all parameters: it does not show {named}, known from the prior alone"
        ]
    weak = weak_parameters(problem, estimate, doubted)
    if not weak:
        return []
    other = ", or use an estimator with a prior" if estimate.prior_scale is None else ""
    return [
        f"the motion hardly shows {', '.join(map(str, weak[:8]))}, by standard deviations; excite these "
        f"parameters{other}"
    ]
