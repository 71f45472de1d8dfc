"""The rows of each session of an estimate, and the delays of the torques that the base model tells."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Literal

import numpy as np

from fri.errors import DataError
from ident.dynamics.base_set import BaseSet
from ident.dynamics.structure import ModelStructure
from ident.estimators.problem import Problem
from ident.rows.content import Recall
from ident.rows.delay import Delay, delays_from_model, fits_better, shared_delay
from ident.rows.filters import SignalSettings
from ident.rows.observation import commanded, observe, stack
from ident.rows.prepare import prepare
from ident.rows.prepared import PreparedSession
from ident.rows.signal_choice import for_delays
from ident.screening.screen import without_dead
from lwr_driver.session import Session

logger = logging.getLogger(__name__)

# Estimates of a delay by the base model, each at the one before, at most.
_DELAY_STEPS = 4
# Sessions whose delays are estimated together: each has columns of its own, which would grow with their square.
_TOGETHER = 4
# Change of a delay between two of them that is none, in standard deviations.
_SETTLED = 0.3
# Change of a delay that rows do not feel, as a share of the time between them: 0.08 ms for rows of 5 Hz.
_FELT = 1e-3


@dataclass(frozen=True)
class SessionRows:
    """The rows of one session: prepared, without its samples; stacked; and those of its commanded motion, if any."""

    prepared: PreparedSession
    problem: Problem
    instruments: Problem | None

    @property
    def side(self) -> Literal["joint", "motor"]:
        """Side whose delay the base model tells: that of the other torques follows from it."""
        return "joint" if self.prepared.mean_torque else "motor"

    @property
    def delay(self) -> Delay | None:
        """Delay of the torques of this side, None without a row of them."""
        if not any(group.side == self.side for group in self.problem.groups):
            return None
        return self.prepared.joint_delay if self.side == "joint" else self.prepared.delay

    def late(self, delay: Delay) -> SessionRows:
        """The same with the delay of this side as estimated, for rows at this delay."""
        own = {k for k, group in enumerate(self.problem.groups) if group.side == self.side}
        nuisances = tuple(
            replace(one, std=delay.std) if own & one.columns.keys() else one for one in self.problem.nuisances
        )
        known: dict[str, Any] = {"joint_delay" if self.side == "joint" else "delay": delay}
        return replace(
            self,
            prepared=replace(self.prepared, **known),
            problem=replace(self.problem, nuisances=nuisances),
        )

    def doubted(self) -> SessionRows:
        """The same with warnings of a delay that no channel has, and of joints with a delay of their own."""
        delay, said = self.delay, []
        if delay is None:
            return self
        if delay.early:
            said.append(
                f"{self.prepared.name}: the {self.side} torques fit the motion best {-1e3 * delay.estimate:.1f} ms "
                "early, as no channel can be: the positions are late, or the stamps are wrong. They are taken as "
                f"not late; correct the stamps, or state `{self.side}_delay_s`"
            )
        for joint in delay.apart:
            late, std = delay.by_joint[joint]
            said.append(
                f"{self.prepared.name}: {joint} {self.side} torque fits the motion best "
                f"{1e3 * late:.1f} ± {1e3 * std:.1g} ms late, against {1e3 * delay.estimate:.1f} ms of the other "
                "joints; check how this channel is recorded"
            )
        if delay.torn is not None and not said:
            ends = [
                f"{1e3 * late:.1f} ± {1e3 * std:.1g}"
                for late, std in map(delay.by_joint.__getitem__, delay.torn)
            ]
            said.append(
                f"{self.prepared.name}: the joints disagree on the delay of the {self.side} torques, {ends[0]} ms in "
                f"{delay.torn[0]} and {ends[1]} ms in {delay.torn[1]}; check how positions and torques of these joints "
                "are recorded"
            )
        return replace(self, prepared=replace(self.prepared, warnings=(*self.prepared.warnings, *said)))


def session_rows(
    session: Session,
    payload: str | None,
    *,
    signals: SignalSettings,
    structure: ModelStructure,
    base: BaseSet,
    resonance_hz: float | None,
    motor: bool,
    advise: bool,
    recall: Recall,
    instruments: bool = True,
) -> SessionRows:
    """The rows of one session with the payload mounted in it; arguments as for `prepare` and `observe`.

    instruments : False makes no rows of the commanded motion.
    """
    whole = prepare(
        session,
        signals,
        resonance_hz=resonance_hz,
        motor=motor,
        log=False,
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
    *,
    late_positions: bool = False,
) -> list[SessionRows]:
    """The rows with the delays that the base model tells: of joint torques, or of motor torques alone.

    late_positions : of a joint, known already; delays that follow are no news. of : session and payload of each.
        signals : of the estimate. make : `session_rows` with the rest of its arguments.
    """
    setting = {"joint": "joint_delay_s", "motor": "motor_delay_s"}

    def at(number: int, settings: SignalSettings, delay_s: float, **more: Any) -> SessionRows:
        stated: dict[str, Any] = {setting[made[number].side]: delay_s}
        return make(*of[number], signals=replace(settings, **stated), **more)

    def seen(number: int, settings: SignalSettings) -> Callable[[float], SessionRows]:
        """Rows of the side of the delay alone."""
        motor: dict[str, Any] = {} if made[number].side == "motor" else {"motor": False}
        return partial(at, number, settings, instruments=False, **motor)

    untold = [
        k
        for k, one in enumerate(made)
        if one.delay is not None and getattr(signals, setting[one.side]) == "estimate"
    ]
    found = list(made)
    for first in range(0, len(untold), _TOGETHER):
        some = untold[first : first + _TOGETHER]
        motor = any(made[k].side == "motor" for k in some)
        wide = for_delays([of[k][0] for k in some], signals, motor=motor)
        told = _told([seen(k, wide) for k in some])
        for k, delay in zip(some, told, strict=True):
            if delay is None:
                continue
            rows = (at(k, signals, delay.seconds) if delay.seconds else made[k]).late(delay)
            found[k] = rows if late_positions else rows.doubted()
            logger.info("%s: %s torques %s", rows.prepared.name, rows.side, rows.delay)
    return found


def apart_in_time(made: Sequence[SessionRows]) -> list[SessionRows]:
    """The rows of all sessions, with a warning of those whose torques are late by another time than in the others."""
    said: dict[int, list[str]] = {}
    for name in dict.fromkeys(name for one in made for name in one.prepared.delays):
        told = [k for k, one in enumerate(made) if name in one.prepared.delays]
        usual, apart = shared_delay([made[k].prepared.delays[name] for k in told])
        for k in (told[place] for place in apart):
            delay = made[k].prepared.delays[name]
            said.setdefault(k, []).append(
                f"{made[k].prepared.name}: the {name.split('_')[0]} torques come {1e3 * delay.seconds:.1f} ± "
                f"{1e3 * delay.std:.1g} ms after the positions, in the other session"
                f"{'s' * (len(told) > 2)} {1e3 * usual:.1f} ms, which the model keeps; check how this one was recorded"
            )
    return [
        replace(one, prepared=replace(one.prepared, warnings=(*one.prepared.warnings, *said[k])))
        if k in said
        else one
        for k, one in enumerate(made)
    ]


def _told(at: Sequence[Callable[[float], SessionRows]]) -> list[Delay | None]:
    """The delays of some sessions, each step from rows at the delays before; None where no row tells one.

    at : rows of each at a delay [s].
    """
    try:
        made = [one(0.0) for one in at]
    except DataError as error:
        logger.info("no rows for a delay from the base model: %s", error)
        return [None] * len(at)
    found, sides = list(made), {k: one.side for k, one in enumerate(made) if one.delay is not None}
    told: list[Delay | None] = [None] * len(made)
    for _ in range(_DELAY_STEPS):
        now = {k: one.delay.seconds for k, one in enumerate(found) if one.delay is not None}
        try:
            delays = delays_from_model(stack([one.problem for one in found]), sides, now)
        except DataError as error:
            logger.info("no delay from the base model: %s", error)
            return told
        moving = False
        for k, delay in delays.items():
            rest = delay.seconds - now[k]
            if abs(rest) > max(_SETTLED * delay.std, _FELT * found[k].prepared.row_time_s):
                moving, found[k], told[k] = True, at[k](delay.seconds), delay
            else:
                std = float(np.hypot(delay.std, rest))
                told[k] = replace(delay, seconds=now[k], std=std)
        if not moving:
            break
    if any(delay is not None and delay.seconds for delay in told):
        after, before = (stack([one.problem for one in rows]) for rows in (found, made))
        if not fits_better(after, before, sides):
            none = "with it no row fits better"
            told = [
                delay
                and replace(
                    delay, seconds=0.0, std=float(np.hypot(delay.std, delay.seconds)), how=none, sure=False
                )
                for delay in told
            ]
    early = {k: delay.estimate for k, delay in enumerate(told) if delay is not None and delay.early}
    if early:
        # What the model lacks of friction at reversals and of elastic joints looks early to one step from rows in time.
        moved = [at[k](early[k]) if k in early else one for k, one in enumerate(found)]
        after, before = (stack([one.problem for one in rows]) for rows in (moved, found))
        sure = fits_better(after, before, sides)
        told = [delay and replace(delay, sure=delay.sure and sure) for delay in told]
    return told
