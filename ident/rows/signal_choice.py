"""Signal settings and friction law chosen from the data.

The positions' cut-off, the band of the rows, the time left out beside reversals and the law of Coulomb friction are
properties of a recording: its sampling, motion, noise, earlier filters and drives. Each is chosen with the base
model on rows at full band, in blocks of two seconds at most: the even ones are fitted, the odd ones predicted.

* The band of the rows covers the excitation, and gives a short recording rows enough. Half of the band left by an
  earlier filter is its upper limit.
* The positions' cut-off is the highest within half a per cent of the least held-back error: a lower one smears the
  jumps of the acceleration at reversals, a higher one lets noise into it.
* The time left out beside reversals is the one with the least held-back error far from them: a shorter one lets the
  turning of friction bend the parameters, a longer one wastes samples.
* The path left out after a reversal is the shortest after which Coulomb friction is one constant: presliding turns over
  a path.
* Slow motion is left out up to the least speed above which Coulomb friction rises no more towards rest: friction that
  falls with the speed (Stribeck) would bend the parameters.
* The positions are the motors' where the links, taken back by the twist of the joints, predict clearly better.
* The friction law of the model is the one with the least held-back error over all samples, reversals and standstill
  included. The rows of the estimation have it too if it predicts the samples far from reversals better than the sign:
  a law may follow the turning of friction and still bend the friction of a moving joint.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc

from fri.errors import DataError
from ident.dynamics.parameters import Floats, split_name
from ident.dynamics.structure import Coulomb, ModelStructure
from ident.rows.binned import BinnedRows, observe_bins
from ident.rows.class_rows import (
    BIN_S,
    LEAST,
    ByClass,
    ClassRows,
    Masks,
    Moments,
    away,
    blocks,
    error,
    even,
    fit,
    nested,
)
from ident.rows.content import Kept, Recall
from ident.rows.data_quality import all_losses, passed_band
from ident.rows.delay import DELAY_HZ
from ident.rows.encoder_side import at_motors
from ident.rows.filters import DECIMATE_HZ, NYQUIST_SHARE, SignalSettings, low_pass, median_step
from ident.rows.prepare import prepare
from ident.rows.reversals import TURNING_RAD
from lwr_driver.session import Session

logger = logging.getLogger(__name__)

_BLOCK_S, _LEAST_BLOCKS = 2.0, 8
# Longest part of all sessions together used for the choice [s].
_MOST_S = 120.0
# Rows of a joint in a short recording, at least.
_LEAST_ROWS = 40
_CUTOFFS = (2.5, 5.0, 12.5)
_TOLERANCE = 0.005
# Bins left out beside a reversal; the last ones are far from it.
_WINDOWS = (0, 1, 2, 3, 4, 5, 7, 10)
# Paths left out after a reversal [rad].
_PATHS = (2e-3, 5e-3, 1e-2, 2e-2, 5e-2)
# Path beyond which the friction of most drives has turned [rad].
_FAR_RAD = 2e-2
# Speeds up to which slow motion is left out [rad/s].
_SPEEDS = (0.0, 0.01, 0.02, 0.05, 0.1, 0.2, 0.3, 0.5, 0.7, 1.0)
_WIDTHS = (0.002, 0.005, 0.01, 0.02, 0.05, 0.1)
# Least fall of the held-back error for another law than the sign.
_WORTH = 0.005
# Chance below which friction beside reversals or in slow motion is another one.
_OTHER = 0.005
# Latest choices: the same recordings are estimated several times.
_MOST_CHOICES = 64
# Least share of samples amiss that explains that no rows are left.
_MANY = 0.1


@dataclass(frozen=True)
class SignalChoice:
    """Settings without an open figure, the friction law of the model and of the rows, and the reasons as sentences."""

    settings: SignalSettings
    coulomb: Coulomb
    row_coulomb: Coulomb
    reasons: tuple[str, ...] = ()


def choose_signals(
    sessions: Sequence[Session],
    payloads: Sequence[str | None],
    structure: ModelStructure,
    columns: NDArray[np.int64],
    settings: SignalSettings,
    laws: tuple[Coulomb | None, Coulomb | None] = (None, None),
    *,
    recall: Recall | None = None,
) -> SignalChoice:
    """The figures that `settings` leaves open, and the friction laws, for the sessions of one model.

    laws : of the model, None to choose, and of the rows, None for that of the model.
    payloads : mounted in each session. columns : base columns of the structure. recall : as for `prepare`.
    """
    coulomb, row_coulomb = laws
    if settings.encoder is None and all(session.encoder == "motor" for session in sessions):
        settings = replace(settings, encoder="motor")
    given = None not in (
        settings.cutoff_hz,
        settings.decimate_hz,
        settings.reversal_s,
        settings.turning_rad,
        settings.slow_rad_s,
    )
    if given and coulomb is not None:
        return SignalChoice(settings, coulomb, row_coulomb or coulomb)
    parts = [_excerpt(session, _MOST_S / len(sessions)) for session in sessions]
    made = _choices.of(
        partial(_chosen, recall=recall or Recall()),
        parts, tuple(payloads), structure, columns, settings, laws,
    )  # fmt: skip
    for reason in made.reasons:
        logger.info("%s", reason)
    return made


_choices = Kept[SignalChoice](_MOST_CHOICES)


def _chosen(
    parts: Sequence[Session],
    payloads: Sequence[str | None],
    structure: ModelStructure,
    columns: NDArray[np.int64],
    settings: SignalSettings,
    laws: tuple[Coulomb | None, Coulomb | None],
    *,
    recall: Recall,
) -> SignalChoice:
    """The choice for the parts of the sessions in use."""
    coulomb, row_coulomb = laws
    motor = structure.sides != ("joint",)
    rate = min(1.0 / session.joint.period_s for session in parts)
    reasons: list[str] = []
    found, band = _with_decimation(settings, parts, rate, motor, reasons, recall)
    delays = [_delay_s(session, found, motor, recall) for session in parts]
    block_s = min(_BLOCK_S, min(session.duration_s for session in parts) / _LEAST_BLOCKS)
    bench = _Bench(parts, payloads, structure, columns, motor, delays, band, block_s, recall)
    rows: ByClass | None = None
    if found.cutoff_hz is None:
        found, rows = bench.with_cutoff(found, rate, reasons)
    rows = bench.rows(found) if rows is None else rows
    if found.reversal_s is None:
        found = replace(found, reversal_s=_reversal_s(rows, band, found.standstill_rad_s, reasons))
    if band is not None:
        # Friction is spread over the rows around; nothing is told from them.
        found = replace(found, turning_rad=found.turning, slow_rad_s=found.slow)
    if found.turning_rad is None:
        found = replace(found, turning_rad=_turning_rad(rows, found, reasons))
    if found.slow_rad_s is None:
        found = replace(found, slow_rad_s=_slow_rad_s(rows, found, reasons))
    if found.encoder != "link":
        found, rows = bench.with_encoder(found, rows, reasons)
    law, row_law = (coulomb, row_coulomb or coulomb) if coulomb else bench.laws(rows, found, reasons)
    return SignalChoice(found, law, row_law, tuple(reasons))


def _delay_s(session: Session, settings: SignalSettings, motor: bool, recall: Recall) -> float:
    """Delay of the motor torques [s], before what is left out beside reversals is chosen.

    As far from reversals as may be chosen, for friction that turns over milliradians looks late by tens of
    milliseconds; nearer to them where that leaves too little. 0 where neither tells it.
    """
    if not motor or session.motor is None:
        return 0.0
    far = replace(
        settings,
        reversal_s=_WINDOWS[-1] * BIN_S if settings.reversal_s is None else settings.reversal_s,
        turning_rad=_FAR_RAD if settings.turning_rad is None else settings.turning_rad,
    )
    for beside in (far, settings):
        try:
            delay = prepare(session, beside, log=False, recall=recall).delay
        except DataError as error:
            logger.info("%s: no delay of the motor torques told yet: %s", session.path.name, error)
            continue
        if delay is not None and (delay.by_joint or delay.seconds):
            return delay.seconds
    return 0.0


def _excerpt(session: Session, longest_s: float) -> Session:
    """The session, or its first `longest_s` seconds from the excitation on."""
    if session.duration_s <= longest_s:
        return session
    spans = session.spans("period") or session.spans("excitation")
    times = session.joint.log_time
    latest = int(times[-1]) - round(longest_s * 1e9)
    start = int(np.clip(spans[0][0] if spans else times[0], times[0], latest))
    stop = start + round(longest_s * 1e9)

    motor = None if session.motor is None else session.motor.rows(start, stop)
    return replace(session, joint=session.joint.rows(start, stop), motor=motor)


def for_delays(sessions: Sequence[Session], settings: SignalSettings, *, motor: bool) -> SignalSettings:
    """Settings of rows that tell the delay of their torques: all cut-offs as many times higher as the band of the rows
    is below that of a delay, as far as the recordings carry it.

    A delay turns the phase, and more so the faster the motion, while friction that no row has right is slow. And the
    positions' low-pass smears the jump of the acceleration at a reversal over the time of a swing of its cut-off, far
    beyond what is left out there: at 5 Hz, torques look milliseconds early or late.
    """
    parts = [_excerpt(session, _MOST_S / len(sessions)) for session in sessions]
    limit = NYQUIST_SHARE * min(1.0 / session.joint.period_s for session in parts)
    band = _passed(parts, motor)
    widest = min(DELAY_HZ, limit / 1.5, np.inf if band is None else 0.5 * band)
    factor = max(widest / settings.decimate, 1.0)
    cutoff = max(min(factor * settings.cutoff, limit), settings.cutoff)
    return replace(settings, decimate_hz=factor * settings.decimate, cutoff_hz=cutoff)


def _passed(sessions: Sequence[Session], motor: bool) -> float | None:
    """Upper edge of an earlier low-pass on the torques [Hz], None without."""
    edges = [
        passed_band(channel.effort, channel.period_s)
        for session in sessions
        for channel in (session.joint, session.motor if motor else None)
        if channel is not None
    ]
    return min((edge for edge in edges if edge is not None), default=None)


def _with_decimation(
    settings: SignalSettings,
    sessions: Sequence[Session],
    rate: float,
    motor: bool,
    reasons: list[str],
    recall: Recall,
) -> tuple[SignalSettings, float | None]:
    """With the band of the rows; and the upper edge of an earlier low-pass on the torques [Hz], None without."""
    band = _passed(sessions, motor)
    if settings.decimate_hz is not None:
        return settings, band
    stated = settings.punctual
    rough = [prepare(session, stated, log=False, recall=recall) for session in sessions]
    excitation = max(session.excitation_hz for session in rough)
    shortest = min(session.duration_s for session in sessions)
    wanted = {
        "the band of the paper": DECIMATE_HZ,
        f"2.5 times the excitation of {excitation:.2g} Hz": 2.5 * excitation,
        f"a recording of {shortest:.1f} s": _LEAST_ROWS / (2.5 * shortest),
    }
    why = max(wanted, key=lambda name: wanted[name])
    limits = {f"the sampling rate of {rate:.0f} Hz": NYQUIST_SHARE * rate / 1.5}
    if band is not None:
        limits[f"an earlier low-pass at {band:.2g} Hz"] = 0.5 * band
    if settings.cutoff_hz is not None:
        limits[f"the position cut-off of {settings.cutoff_hz:g} Hz"] = settings.cutoff_hz / 1.5
    limit = min(limits, key=lambda name: limits[name])
    chosen = wanted[why] if wanted[why] <= limits[limit] else limits[limit]
    reason = why if wanted[why] <= limits[limit] else limit
    reasons.append(f"rows: low-pass {chosen:.3g} Hz, for {reason}")
    return replace(settings, decimate_hz=float(f"{chosen:.3g}")), band


@dataclass(frozen=True)
class _Bench:
    sessions: Sequence[Session]
    payloads: Sequence[str | None]
    structure: ModelStructure
    columns: NDArray[np.int64]
    motor: bool
    delays: Sequence[float]
    band: float | None
    block_s: float
    recall: Recall

    def rows(self, settings: SignalSettings) -> ByClass:
        """Rows by side and joint."""
        parts: dict[str, list[BinnedRows]] = {}
        for session, payload, delay in zip(self.sessions, self.payloads, self.delays, strict=True):
            wanted = replace(settings, motor_delay_s=delay, reversal_s=0.0)
            prepared = prepare(session, wanted, motor=self.motor, log=False, recall=self.recall)
            for rows in observe_bins(prepared, payload, self.structure, self.columns, BIN_S):
                parts.setdefault(rows.side, []).append(rows)
        found = {}
        for side, some in parts.items():
            block = blocks([rows.time for rows in some], self.block_s)
            ends = np.cumsum([0, *(len(rows.time) for rows in some)]).tolist()
            stretches = tuple(slice(first, last) for first, last in pairwise(ends))
            for j in range(self.structure.chain.n):
                measured = np.concatenate([rows.measured[:, j] for rows in some])
                if measured.any():
                    used = [rows.matrix[j].any(axis=0) for rows in some]
                    acting = np.flatnonzero(np.any(used, axis=0))
                    found[side, j] = ClassRows(
                        np.concatenate([self._smooth(rows.matrix[j][:, acting], rows) for rows in some]),
                        np.concatenate(
                            [self._smooth(rows.torque[:, j : j + 1], rows)[:, 0] for rows in some]
                        ),
                        np.concatenate([rows.speed[:, j] for rows in some]),
                        np.concatenate([self._shared(rows.speed, j, settings) for rows in some]),
                        measured,
                        block,
                        tuple(some),
                        stretches,
                        acting,
                        len(self.columns),
                    )
        if not found:
            raise DataError(self._nothing_left())
        return found

    def _nothing_left(self) -> str:
        """Why no rows are left, with what to do."""
        most = max(len(session.joint) for session in self.sessions)
        said = f"no interval of {1e3 * BIN_S:.0f} ms in sessions of up to {most} samples has all samples of a torque"
        worst = max(all_losses(self.sessions), key=lambda loss: loss.share)
        count = worst.samples + worst.lost
        if worst.share < _MANY:
            return f"{said}: they are too short; record longer ones"
        amount, kind, advice = max(
            (
                worst.repeated,
                "repeat the one before",
                "the recorder polls faster than the arm measures. Record at the arm's rate, or remove the rows that "
                "repeat others and import again",
            ),
            (
                worst.lost,
                "are lost by the counter",
                "record without losses, or import without the counter if it counts otherwise",
            ),
            (worst.stale, "are older than their stamps", "record with the stamps of the arm's own clock"),
            key=lambda one: one[0],
        )
        return f"{said}: {100.0 * amount / count:.0f} % of the {count} samples of {worst.session} {kind}; {advice}"

    def _shared(self, speed: Floats, joint: int, settings: SignalSettings) -> Floats:
        """Speeds (m, k) of the drives that a joint shares with others, of the joints' (m, n)."""
        pairs = settings.coupled_places(self.structure.chain.joint_names)
        both = [speed[:, a] + speed[:, b] for a, b in pairs if joint in (a, b)]
        return np.column_stack([speed[:, :0], *both])

    def _smooth(self, values: Floats, rows: BinnedRows) -> Floats:
        """Rows (m, k) with a low-pass common to torque and columns where an earlier one smoothed the torques."""
        if self.band is None or len(rows.time) < 2:
            return values
        dt = median_step(rows.time)
        if 0.5 * self.band * dt >= 0.4:
            return values
        return low_pass(values, dt, 0.5 * self.band)

    def with_cutoff(
        self, settings: SignalSettings, rate: float, reasons: list[str]
    ) -> tuple[SignalSettings, ByClass]:
        """With the highest cut-off of a held-back error near the least, and the rows of it."""
        ladder = sorted({min(factor * settings.decimate, NYQUIST_SHARE * rate) for factor in _CUTOFFS})
        still = settings.standstill_rad_s
        errors: list[float] = []
        kept: ByClass = {}
        for one in ladder:
            rows = self.rows(replace(settings, cutoff_hz=one))
            far = {key: own.known(_WINDOWS[-1] // 2, still, TURNING_RAD) for key, own in rows.items()}
            errors.append(error(rows, fit(rows, far), far))
            # The highest so far near the least so far: no lower one can be chosen any more.
            kept = rows if errors[-1] < min(errors) + _TOLERANCE else kept
        best = int(np.argmin(errors))
        limit = errors[best] + _TOLERANCE
        chosen = max(one for one, error in zip(ladder, errors, strict=True) if error < limit)
        listed = ", ".join(
            f"{100.0 * np.expm1(error - errors[best]):+.1f} % at {one:g} Hz"
            for one, error in zip(ladder, errors, strict=True)
        )
        reasons.append(f"positions: cut-off {chosen:g} Hz, held-back error of the base model {listed}")
        return replace(settings, cutoff_hz=chosen), kept

    def with_encoder(
        self, settings: SignalSettings, rows: ByClass, reasons: list[str]
    ) -> tuple[SignalSettings, ByClass]:
        """With the side of the joints that the positions come from, and the rows of it."""
        motors, efforts = settings.encoder == "motor", self.structure.chain.efforts()
        by = "the stated stiffness"
        if motors and settings.stiffness_nm_rad is not None:
            reasons.append(f"positions: of the motors, as stated; the links stand behind by {by}")
            return settings, rows
        found = at_motors(self.rows, rows, settings, efforts)
        if found is None:
            return replace(settings, encoder=settings.encoder or "link"), rows
        if settings.stiffness_nm_rad is None and efforts is not None:
            twist = float(np.max(efforts / np.array(found.settings.stiffness_nm_rad)))
            by = f"a twist of {1e3 * twist:.3g} mrad under the largest torque, for no `stiffness_nm_rad` is stated"
        told = f"held-back error {_less(found.fall)} than as those of the links (p = {found.chance:.1g})"
        reasons.append(
            f"positions: of the motors, {'as stated' if motors else told}; the links stand behind by {by}"
        )
        return found.settings, found.rows

    def laws(self, rows: ByClass, settings: SignalSettings, reasons: list[str]) -> tuple[Coulomb, Coulomb]:
        """The friction laws of the model and of the rows."""
        still = settings.standstill_rad_s
        used = away(rows, settings)
        far = {key: own.known(_WINDOWS[-1], still, TURNING_RAD) for key, own in rows.items()}
        everything = {key: own.measured for key, own in rows.items()}
        sign = fit(rows, used)
        plain = error(rows, sign, everything)
        errors: dict[tuple[Coulomb, bool], float] = {}
        for width in _WIDTHS:
            law = Coulomb("tanh", width)
            smooth = self._with_law(rows, law)
            own = fit(smooth, used)
            bends = error(smooth, own, far) > error(rows, sign, far)
            errors[law, bends] = error(smooth, sign if bends else own, everything)
        best, bends = min(errors, key=lambda key: errors[key])
        gain = plain - errors[best, bends]
        if gain < _WORTH:
            reasons.append("friction: sign of the speed, no smooth law predicts better")
            return Coulomb(), Coulomb()
        where = "in the model alone, the parameters come from the sign" if bends else "in the rows too"
        reasons.append(
            f"friction: tanh of the speed over {best.width:g} rad/s, held-back error over all samples "
            f"{_less(gain)} than with the sign; {where}"
        )
        return best, Coulomb() if bends else best

    def _with_law(self, rows: ByClass, law: Coulomb) -> ByClass:
        """The rows with their Coulomb columns anew."""
        names = [split_name(self.structure.names[c]) for c in self.columns]
        parts = {id(part): part for own in rows.values() for part in own.parts}
        turned_by = {key: part.turned(law) for key, part in parts.items()}
        found = {}
        for (side, j), own in rows.items():
            matrix = own.matrix.copy()
            turned = np.concatenate(
                [self._smooth(turned_by[id(part)][:, j : j + 1], part)[:, 0] for part in own.parts]
            )
            for place, column in enumerate(own.acting):
                symbol, link, _ = names[column]
                if symbol in ("Fcl", "Fcm") and link == j + 1:
                    matrix[:, place] = turned
            found[side, j] = replace(own, matrix=matrix)
        return found


def _reversal_s(rows: ByClass, band: float | None, standstill_rad_s: float, reasons: list[str]) -> float:
    """Time left out beside reversals [s]."""
    if band is not None and band * _WINDOWS[-1] * BIN_S < 2.0:
        reasons.append(
            f"reversals: nothing left out, an earlier low-pass at {band:.2g} Hz spread them; the same low-pass on "
            "torque and friction columns allows for it"
        )
        return 0.0
    masks = [
        {key: own.known(window, standstill_rad_s, TURNING_RAD * bool(window)) for key, own in rows.items()}
        for window in _WINDOWS
    ]
    fitted = nested(rows, [even(rows, mask) for mask in masks])
    errors = [error(rows, one.solved()[0], masks[-1]) for one in fitted]
    best = int(np.argmin(errors))
    chosen = _WINDOWS[best] * BIN_S
    reasons.append(
        f"reversals: {1e3 * chosen:.0f} ms left out on either side, held-back error far from reversals "
        f"{_less(errors[0] - errors[best])} than with all samples"
    )
    return chosen


def _less(fall: float) -> str:
    """A fall of the log of an error in words; a large one as a factor."""
    factor = float(np.exp(fall))
    return f"{factor:.3g} times smaller" if factor >= 2.0 else f"{100.0 * (1.0 - 1.0 / factor):.2g} % less"


def _turning_rad(rows: ByClass, settings: SignalSettings, reasons: list[str]) -> float:
    """Path left out after a reversal [rad]."""
    paths = [settings.turning, *(path for path in _PATHS if path > settings.turning)]
    farther = [away(rows, replace(settings, turning_rad=path)) for path in paths]
    place, chance = _first_alike(rows, farther, both=True)
    if place:
        reasons.append(
            f"turning: the first {1e3 * paths[place]:g} mrad after a reversal left out, where friction still turns "
            f"(p = {chance:.1g})"
        )
    return paths[place]


def _slow_rad_s(rows: ByClass, settings: SignalSettings, reasons: list[str]) -> float:
    """Speed up to which slow motion is left out [rad/s]."""
    used = away(rows, settings)
    faster = [{key: mask & rows[key].faster(speed) for key, mask in used.items()} for speed in _SPEEDS]
    place, chance = _first_alike(rows, faster, both=False)
    slow = _SPEEDS[place]
    reasons.append(
        f"slow motion: up to {slow:g} rad/s left out, its friction is larger (p = {chance:.1g})"
        if place
        else "slow motion: in the rows, its friction is no larger"
    )
    return slow


def _first_alike(rows: ByClass, masks: Sequence[Masks], *, both: bool) -> tuple[int, float]:
    """Number of the first of ever smaller masks whose Coulomb friction is one constant, and the chance of that in the
    mask before. A third of the rows of every joint and side stay. both : see `_chance`."""
    place = max(k for k, mask in enumerate(masks) if k == 0 or _many(mask, masks[0]))
    fitted = nested(rows, masks[: place + 1])
    while place > 0:
        chance = _chance(rows, fitted[place - 1], masks[place - 1], masks[place], both)
        if chance < _OTHER:
            return place, chance
        place -= 1
    return 0, 1.0


def _many(masks: Masks, whole: Masks) -> bool:
    """Whether the masks have a third of the rows of every joint and side."""
    return all(3 * masks[key].sum() >= some.sum() for key, some in whole.items())


def _chance(rows: ByClass, fitted: Moments, masks: Masks, far: Masks, both: bool) -> float:
    """Chance, if Coulomb friction is one constant, of as much another one in the masked rows that are not `far`.

    Each class has a column of the sign of its speed in those rows. The squares of the coefficients over their standard
    deviations, of the sums in blocks, add up to a chi-square.

    fitted : moments of the masked rows. both : False for more friction alone; less, as of viscous friction that
        saturates, counts against.
    """
    values, weights = fitted.solved()
    columns = {key: np.sign(own.speed) * (masks[key] & ~far[key]) for key, own in rows.items()}
    products = np.zeros((len(rows), len(values)))
    for product, (key, own) in zip(products, rows.items(), strict=True):
        product[own.acting] = own.matrix.T @ columns[key]
    shared = fitted.divided(weights, (weights[:, None] * products).T)
    squares = []
    for (key, own), others in zip(rows.items(), shared.T, strict=True):
        if np.count_nonzero(columns[key]) < LEAST:
            continue
        used = masks[key]
        free, rest = columns[key] - own.fitted(others), own.torque - own.fitted(values)
        sums = np.bincount(own.block[used], (free * rest)[used])
        more = float(np.sum(sums))
        square = more * more if both else more * abs(more)
        squares.append(square / max(float(sums @ sums), 1e-300))
    return float(chdtrc(len(squares), max(sum(squares), 0.0))) if squares else 1.0
