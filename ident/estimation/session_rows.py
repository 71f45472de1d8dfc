"""The rows of each session of an estimate, and the delay of motor torques that have no joint torques beside them."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

from fri.errors import DataError
from ident.dynamics.base_set import BaseSet
from ident.dynamics.structure import ModelStructure
from ident.estimators.problem import Problem
from ident.rows.content import Recall
from ident.rows.delay import SHIFT_S, Delay, delay_alone
from ident.rows.filters import SignalSettings
from ident.rows.observation import commanded, observe, stack
from ident.rows.prepare import prepare
from ident.rows.prepared import PreparedSession
from ident.screening.screen import without_dead
from lwr_driver.session import Session

logger = logging.getLogger(__name__)

# Estimates of a delay by the base model, each at the one before, at most.
_DELAY_STEPS = 4
# Change of a delay between two of them that is none, in standard deviations.
_SETTLED = 0.3


@dataclass(frozen=True)
class SessionRows:
    """The rows of one session: prepared, without its samples; stacked; and those of its commanded motion, if any."""

    prepared: PreparedSession
    problem: Problem
    instruments: Problem | None

    @property
    def delay_s(self) -> float:
        """Delay of the motor torques in use [s]."""
        return 0.0 if self.prepared.delay is None else self.prepared.delay.seconds

    @property
    def alone(self) -> bool:
        """Whether the motor torques have no joint torques beside them that tell their delay."""
        return (
            self.prepared.delay is not None and not self.prepared.mean_torque and bool(self.problem.nuisances)
        )

    def late(self, delay: Delay) -> SessionRows:
        """The same with the delay of its motor torques as estimated."""
        nuisances = tuple(replace(one, std=delay.std) for one in self.problem.nuisances)
        problem = replace(self.problem, nuisances=nuisances)
        return replace(self, prepared=replace(self.prepared, delay=delay), problem=problem)


def session_rows(
    session: Session,
    payload: str | None,
    *,
    signals: SignalSettings,
    structure: ModelStructure,
    base: BaseSet,
    resonance_hz: float | None,
    motor: bool,
    log: bool,
    advise: bool,
    recall: Recall,
    delay_s: float | None = None,
    instruments: bool = True,
) -> SessionRows:
    """The rows of one session with the payload mounted in it.

    delay_s : of its motor torques, None for that of `signals`. instruments : False leaves the commanded motion aside.
    Others: as for `prepare` and `observe`.
    """
    used = signals if delay_s is None else replace(signals, motor_delay_s=delay_s)
    whole = prepare(
        session,
        used,
        resonance_hz=resonance_hz,
        motor=motor,
        log=log,
        advise=advise,
        blocks=True,
        recall=recall,
    )
    seen = observe([whole], [payload], structure, columns=base.columns, names=base.names, units=base.units)
    problem = without_dead(seen, session)
    motion = commanded(session, whole) if instruments and not signals.average_periods else None
    bare = replace(whole.without_samples(), settings=signals)
    del whole
    if motion is None:
        return SessionRows(bare, problem, None)
    seen = observe([motion], [payload], structure, columns=base.columns)
    return SessionRows(bare, problem, without_dead(seen, session))


def with_delays(
    made: list[SessionRows],
    of: Sequence[tuple[Session, str | None]],
    signals: SignalSettings,
    make: Callable[..., SessionRows],
) -> list[SessionRows]:
    """The rows with the delay of motor torques that have no joint torques beside them.

    It comes from the base model, so from rows at the delay found so far.

    of : session and payload of each. signals : of the estimate. make : `session_rows` with the rest of its arguments.
    """
    if signals.motor_delay_s != "estimate" or not any(one.alone for one in made):
        return made
    found, late = list(made), [k for k, one in enumerate(made) if one.alone]
    delays: list[Delay] = []
    for _ in range(_DELAY_STEPS):
        now = [found[k].delay_s for k in late]
        shifted = []
        for shift in (SHIFT_S, -SHIFT_S):
            moved = [one.problem for one in found]
            for k, delay_s in zip(late, now, strict=True):
                moved[k] = make(*of[k], log=False, delay_s=delay_s + shift, instruments=False).problem
            shifted.append(stack(moved))
        try:
            whole = stack([one.problem for one in found])
            delays = delay_alone(whole, late, (shifted[0], shifted[1]), now)
        except DataError as error:
            logger.info("no delay of the motor torques by themselves: %s", error)
            return found
        for k, delay in zip(late, delays, strict=True):
            rows = (
                found[k]
                if delay.seconds == found[k].delay_s
                else make(*of[k], log=False, delay_s=delay.seconds)
            )
            found[k] = rows.late(delay)
        if all(
            abs(delay.seconds - before) < _SETTLED * delay.std
            for delay, before in zip(delays, now, strict=True)
        ):
            break
    for delay in delays:
        logger.info("motor channel %s", delay)
    return found
