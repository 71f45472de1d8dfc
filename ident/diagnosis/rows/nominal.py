"""The nominal arm: rows of the base model at the full bandwidth of the channels, and its predictions.

Each side keeps its own sample times. Joint torque and its regressor are averaged over short bins. A slower motor
torque gives one row per sample, with the regressor at the same instant. Both operations are linear and act on torque
and regressor alike, so neither adds a bias. A row depends on the samples of its bin only, so standstill and reversals
spoil few rows.

The drive's own columns (Ia, Fvm, Fcm) belong to the motor, apart from the link by the twist of the joint. The twist
follows from the predicted torque, so no sensor's noise or error leaks from one side to the other.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter1d, minimum_filter1d
from scipy.sparse import csr_array

from ident.diagnosis.rows.broken_data import unseen
from ident.diagnosis.rows.nominal_arm import NominalArm
from ident.diagnosis.rows.parts import Piece, gather
from ident.diagnosis.rows.recording import TRAVEL_RAD, RecordStretch, SessionRecord, usual_step
from ident.diagnosis.settings import DiagnosisSettings
from ident.dynamics import regressor
from ident.dynamics.base_set import BaseSet, numeric_base
from ident.dynamics.structure import Condition, DriveMotion, ModelStructure, Side
from ident.effects import Column, effects_torque
from ident.effects.motion import ArmMotion, in_order
from ident.effects.nameless import KNOTS, knot_places
from ident.effects.springs import Springs
from ident.model.dynamic_model import DynamicModel
from ident.rows.binned import Motion, binned_regressor, bins
from ident.rows.filters import differentiate, low_pass, settling
from ident.rows.reversals import ringing
from lwr_driver.session.spool import Arena, column, spans, stored, stored_together

Floats = NDArray[np.float64]

# Least share of a low-passed row from samples of a moving joint.
_KNOWN = 0.8
# Samples of a block of a whole motion.
_BLOCK = 2**16
# Samples of a motion in work together, and least share in use for a slice of them.
_TOGETHER, _DENSE = 2**14, 0.6
# Samples without use between two parts of a motion.
_GAP = 1000
# Length of the windows used of a long session [s].
_WINDOW_S = 10.0
# Compliance [rad/Nm] of a joint taken as rigid.
_RIGID = 1e-6
# Damping over stiffness of the joints [s]: 4 % of the critical damping for a link ringing at 7 Hz.
_RELAXATION_S = 2e-3
# Least eigenvalue of a mass matrix over its largest.
_LEAST_MASS = 1e-3


def structure_of(arm: NominalArm, recordings: Sequence[SessionRecord]) -> tuple[ModelStructure, BaseSet]:
    """Columns for the sessions' payloads and sides."""
    payloads = tuple(dict.fromkeys(r.payload for r in recordings if r.payload is not None))
    motor = any(r.has_motor for r in recordings)
    left_out = unseen(recordings, arm.chain) if motor else ()
    structure = ModelStructure(arm.chain, 2 if motor else 1, payloads, left_out, arm.couplings)
    conditions = dict.fromkeys(Condition(r.payload, r.sides) for r in recordings)
    return structure, numeric_base(structure, tuple(conditions))


@dataclass(frozen=True, eq=False)
class SideRows:
    """Rows of one side, all sessions, in the order of time.

    matrix : (n, m, p) base regressor by joint; target : (m, n) [Nm]; valid : (m, n).
    session : (m,) number; time : (m,) [s]; test : (m,) held-out rows.
    """

    matrix: Floats
    target: Floats
    valid: NDArray[np.bool_]
    session: NDArray[np.int64]
    time: Floats
    test: NDArray[np.bool_]


@dataclass(eq=False)
class Nominal:
    """Rows and predictions of the nominal arm for recordings; `refine` repeats them with better predictions.

    motions : one for each stretch, with the predicted torques; default with the measured joint torque.
    """

    arm: NominalArm
    recordings: Sequence[SessionRecord]
    settings: DiagnosisSettings
    structure: ModelStructure
    base: BaseSet
    motions: list[ArmMotion] = field(default_factory=list)
    rows: dict[str, SideRows] = field(default_factory=dict, init=False)
    _operators: dict[tuple[str, int, float], tuple[csr_array, float]] = field(
        default_factory=dict, init=False, repr=False
    )
    _pieces: dict[tuple[object, ...], list[list[Piece]]] = field(default_factory=dict, init=False, repr=False)
    _made: dict[str, tuple[Sequence[ArmMotion], SideRows]] = field(
        default_factory=dict, init=False, repr=False
    )

    def __post_init__(self) -> None:
        self.motions = self.motions or in_order([self._motion(r, s, s.effort) for r, s in self.stretches])
        self._make_rows()

    @property
    def stretches(self) -> list[tuple[SessionRecord, RecordStretch]]:
        """Recording and stretch of each motion."""
        return [(r, s) for r in self.recordings for s in r.stretches]

    @property
    def held_out(self) -> bool:
        """Whether there are held-out recordings."""
        return any(r.test for r in self.recordings)

    @cached_property
    def sides(self) -> tuple[str, ...]:
        """Sides with rows."""
        return tuple(s for s in ("motor", "joint") if any(s in r.sides for r in self.recordings))

    @cached_property
    def moving(self) -> NDArray[np.bool_]:
        """Joints (n,) in motion in the fitted sessions; the torque of the others has no rows."""
        fitted = [s.q for r, s in self.stretches if not r.test]
        travel = np.max([np.ptp(q, axis=0) for q in fitted], axis=0) if fitted else np.zeros(self.arm.chain.n)
        return np.asarray(travel > TRAVEL_RAD)

    def refine(self, values: Floats) -> None:
        """Predict the torques with the base parameters (b,) and make the rows anew."""
        model = DynamicModel("arm", self.structure, self.base.names, values, None, self.base)
        drive = model.drive()
        bodies = {payload: model.inertial(payload) for payload in {r.payload for r in self.recordings}}
        motions = []
        for before, (recording, stretch) in zip(self.motions, self.stretches, strict=True):
            body = bodies[recording.payload]
            link = self._link_torque_in_blocks(before, body, drive)
            motions.append(self._motion(recording, stretch, link, body, drive))
        self.motions = in_order(motions)
        self._pieces.clear()
        self._make_rows()

    def _link_torque(
        self, q: Floats, qd: Floats, qdd: Floats, bodies: Floats, drive: Mapping[str, Floats]
    ) -> Floats:
        """Torque (N, n) [Nm] through the joints."""
        rigid = regressor.torque(self.arm.chain, q, qd, qdd, bodies)
        return rigid + drive["Fvl"] * qd + drive["Fcl"] * np.sign(qd) + drive["offl"]

    def _link_torque_in_blocks(
        self, motion: ArmMotion, bodies: Floats, drive: Mapping[str, Floats]
    ) -> Floats:
        """The same along a motion, in a file for a long one."""
        parts = (motion.part(some) for some in spans(len(motion.time), _BLOCK))
        return stored(self._link_torque(one.q, one.qd, one.qdd, bodies, drive) for one in parts)

    def _twist(
        self, torque: Floats, dt: float, cutoff: float
    ) -> Iterator[tuple[slice, Floats, Floats, Floats]]:
        """Twist of the joints and its derivatives (m, n) in blocks, from a torque (N, n)."""
        reach = int(np.ceil(settling(cutoff) / dt)) + 4
        for some in spans(len(torque), _BLOCK):
            low = max(some.start - reach, 0)
            twist = low_pass(torque[low : some.stop + reach], dt, cutoff) * self.arm.compliance
            first, second = differentiate(twist, dt)
            own = slice(some.start - low, some.stop - low)
            yield some, twist[own], first[own], second[own]

    def _hanging(
        self, motors: RecordStretch, q: Floats, qd: Floats, bodies: Floats, drive: Mapping[str, Floats]
    ) -> tuple[Floats, Floats, Floats, Springs]:
        """Position, speed and acceleration (N, n) of links on springs behind the motors; the springs."""
        stiffness = 1.0 / np.maximum(self.arm.compliance, _RIGID)
        dt, qdd = float(motors.time[1] - motors.time[0]), np.zeros_like(q)
        for _ in range(2):
            mass = _definite(regressor.mass_matrix(self.arm.chain, q, bodies))
            other = self._link_torque(q, qd, np.zeros_like(q), bodies, drive)
            springs = Springs(mass, other, motors.q, motors.qd, stiffness, _RELAXATION_S * stiffness, dt)
            q, qd, qdd = springs.links
        return q, qd, qdd, springs

    def _motion(
        self,
        recording: SessionRecord,
        stretch: RecordStretch,
        link_torque: Floats,
        bodies: Floats | None = None,
        drive: dict[str, Floats] | None = None,
    ) -> ArmMotion:
        n = self.arm.chain.n
        dt = float(stretch.time[1] - stretch.time[0])
        q, qd, qdd = stretch.q, stretch.qd, stretch.qdd
        speed, acceleration, springs, motor_q = qd, qdd, None, None
        if np.any(self.arm.compliance > 0.0):
            # A measured torque is noisy, and its second derivative more so; a predicted one is not.
            wanted = self.settings.deflection_hz if bodies is not None else 20.0
            wanted = 10.0 if self.arm.encoder == "motor" else wanted
            twisted = self._twist(link_torque, dt, min(wanted, 0.2 / dt))
            if self.arm.encoder == "link":
                speed, acceleration = stored_together(
                    (qd[some] + first, qdd[some] + second) for some, _, first, second in twisted
                )
            else:
                q, qd, qdd = stored_together(
                    (q[some] - twist, qd[some] - first, qdd[some] - second)
                    for some, twist, first, second in twisted
                )
                speed, acceleration, motor_q = stretch.qd, stretch.qdd, stretch.q
                if bodies is not None and drive is not None:
                    q, qd, qdd, springs = self._hanging(stretch, q, qd, bodies, drive)
                    link_torque = self._link_torque(q, qd, qdd, bodies, drive)
        values = drive or dict.fromkeys(("Ia", "Fvm", "Fcm", "offm", "Fcl"), np.zeros(n))
        slip = stored([self.arm.slip(speed, dt)])

        def driving(some: slice) -> Floats:
            friction = values["Fvm"] * speed[some] + values["Fcm"] * slip[some]
            return link_torque[some] + values["Ia"] * acceleration[some] + friction + values["offm"]

        return ArmMotion(
            chain=self.arm.chain,
            bodies=np.zeros((n, 10)) if bodies is None else bodies,
            session=recording.number,
            time=stretch.time,
            duration_s=recording.duration_s,
            q=q,
            qd=qd,
            qdd=qdd,
            motor_speed=speed,
            motor_acceleration=acceleration,
            joint_torque=link_torque,
            motor_torque=stored(driving(some) for some in spans(len(speed), _BLOCK)),
            gear_ratio=self.arm.gear_ratio,
            inertia=values["Ia"],
            link_coulomb=values["Fcl"],
            motor_coulomb=values["Fcm"],
            friction=lambda v: values["Fvm"] * v + values["Fcm"] * np.sign(v),
            motor_q=motor_q,
            slip=slip,
            springs=springs,
            loaded=recording.payload is not None or all(r.payload is None for r in self.recordings),
            begun_s=recording.begun_s,
        )

    @property
    def slow_motor_samples(self) -> bool:
        """Whether motor torques come with a clock of their own, slower than that of the positions."""
        return any(s.own_clock for _, s in self.stretches)

    @property
    def masses(self) -> dict[str, float | None]:
        """Announced mass [kg] of each payload."""
        return {r.payload: r.payload_mass for r in self.recordings if r.payload is not None}

    # ---- rows ----

    @property
    def bin_s(self) -> float:
        """Length of a bin [s]."""
        return max(self.settings.bin_s, self.settings.ringing_s if self.arm.encoder == "motor" else 0.0)

    def _sampling(self, side: str, stretch: RecordStretch) -> tuple[Floats, float, int]:
        """Stamps (N,) [s] and delay [s] of a side's torque, and the samples in a bin."""
        if side == "joint":
            dt = float(stretch.time[1] - stretch.time[0])
            return stretch.time, self.arm.joint_delay_s, max(1, round(self.bin_s / dt))
        width, stamp = 1, stretch.motor_time
        if len(stamp) > 1 and usual_step(stamp) < 0.6 * self.bin_s:
            width = max(1, round(self.bin_s / usual_step(stamp)))
        return stamp, self.arm.motor_delay_s, width

    def reduce(self, side: str, values: Sequence[Floats]) -> Floats:
        """Rows (m,) or (m, k) of signals on the grid of each motion, (N,) or (N, k)."""
        parts = []
        for number, ((recording, stretch), signal) in enumerate(zip(self.stretches, values, strict=True)):
            if _holds(recording, stretch, side):
                operator, dt = self._operator(side, number, recording, stretch)
                rows = operator @ signal.reshape(len(signal), -1)
                if self.band_hz[side] is not None:
                    rows = self._slow(side, rows, dt)[self._windows(recording, self._stamps(side, stretch))]
                parts.append(rows)
        whole = np.concatenate(parts)
        return whole[:, 0] if values[0].ndim == 1 else whole

    def columns(
        self, made: Callable[[ArmMotion], Sequence[Column]], sides: Sequence[str] | None = None
    ) -> dict[str, list[Floats]]:
        """Rows (m,) or (m, n) of columns by side, made from one part of the motions after the other.

        made : the columns of a part, of the same shape in each. sides : to look at, default all. A column without
        values on a side is left out there.
        """
        sides = tuple(side for side in self.sides if sides is None or side in sides)
        found: dict[str, dict[int, list[Floats]]] = {side: {} for side in sides}
        for number, pieces in enumerate(self._parts(sides)):
            rows: dict[tuple[str, int], Floats] = {}
            for piece in pieces:
                for k, one in enumerate(made(piece.motion)):
                    for side, own in piece.gathers.items():
                        values = one.motor if side == "motor" else one.joint
                        if values is None:
                            continue
                        if (side, k) not in rows:
                            rows[side, k] = self._no_rows(side, number, values.shape[1:])
                        own.add(values, rows[side, k])
            for (side, k), values in rows.items():
                found[side].setdefault(k, []).append(self._used(side, number, values))
        return {side: [np.concatenate(parts) for parts in of.values()] for side, of in found.items()}

    def functions(
        self,
        side: str,
        of: Callable[[ArmMotion], Floats],
        low: float,
        high: float,
        factors: Sequence[Callable[[ArmMotion], Floats]],
    ) -> list[Floats]:
        """Rows (m, 7) of the hat functions of a variable, see `ident.effects.nameless.hats`, times each of some
        factors.

        of, factors : variable and factors (N,) of a motion.
        """
        found: list[list[Floats]] = [[] for _ in factors]
        for number, pieces in enumerate(self._parts((side,))):
            if not _holds(*self.stretches[number], side):
                continue
            rows = [self._no_rows(side, number, (KNOTS,)) for _ in factors]
            for piece in pieces:
                place = knot_places(of(piece.motion), low, high)
                for factor, values in zip(factors, rows, strict=True):
                    piece.gathers[side].add_hats(place, np.ascontiguousarray(factor(piece.motion)), values)
            for one, values in zip(found, rows, strict=True):
                one.append(self._used(side, number, values))
        return [np.concatenate(one) for one in found]

    def _parts(self, sides: Sequence[str]) -> list[list[Piece]]:
        """The parts of each motion, made once."""
        key = (*sides, self.arm.motor_delay_s, self.arm.joint_delay_s)
        if key not in self._pieces:
            self._pieces[key] = [
                list(self._cut(sides, number, *pair)) for number, pair in enumerate(self.stretches)
            ]
        return self._pieces[key]

    def _no_rows(self, side: str, number: int, shape: tuple[int, ...]) -> Floats:
        """Zeros (m, ...) in the rows of a motion."""
        return np.zeros((self._operator(side, number, *self.stretches[number])[0].shape[0], *shape))

    def _used(self, side: str, number: int, values: Floats) -> Floats:
        """The rows in use of the rows (m, ...) of a motion, low-passed as the torques were."""
        if self.band_hz[side] is None:
            return values
        recording, stretch = self.stretches[number]
        dt = self._operator(side, number, recording, stretch)[1]
        chosen = self._windows(recording, self._stamps(side, stretch))
        wide = self._slow(side, values.reshape(len(values), -1), dt)[chosen]
        return wide.reshape(len(wide), *values.shape[1:])

    def _cut(
        self, sides: Sequence[str], number: int, recording: SessionRecord, stretch: RecordStretch
    ) -> Iterator[Piece]:
        """Parts of a motion that fit into the processor's cache, with the samples in use alone."""
        held = [side for side in sides if _holds(recording, stretch, side)]
        operators = {side: self._operator(side, number, recording, stretch)[0].tocsc() for side in held}
        used = np.zeros(len(stretch.time), dtype=bool)
        for operator in operators.values():
            used |= np.diff(operator.indptr) > 0
        places = np.flatnonzero(used)
        gaps = np.flatnonzero(np.diff(places) > _GAP) + 1
        runs = (run[some] for run in np.split(places, gaps) for some in spans(len(run), _TOGETHER))
        for here in runs:
            whole = slice(int(here[0]), int(here[-1]) + 1)
            picked = whole if len(here) > _DENSE * (whole.stop - whole.start) else here
            parts = {side: gather(operator[:, picked]) for side, operator in operators.items()}
            yield Piece(self.motions[number].part(picked), parts)

    def _operator(
        self, side: str, number: int, recording: SessionRecord, stretch: RecordStretch
    ) -> tuple[csr_array, float]:
        """Matrix (m, N) from the grid of a stretch to its rows, at the channel's delay, and the rows' distance [s].

        Without a low-pass across rows it makes the rows in use alone.
        """
        delay = self.arm.joint_delay_s if side == "joint" else self.arm.motor_delay_s
        key = (side, number, delay)
        if key not in self._operators:
            stamp, _, width = self._sampling(side, stretch)
            count = len(stamp) // width
            place = (stamp[: count * width] - delay - stretch.time[0]) / usual_step(stretch.time)
            nearest = np.rint(place)
            place = np.where(np.abs(place - nearest) < 1e-4, nearest, place)
            place = np.clip(place, 0.0, len(stretch.time) - 1.000001)
            low = place.astype(np.int64)
            share = place - low
            row = np.arange(len(low)) // width
            weights = np.concatenate([1.0 - share, share]) / width
            places = np.concatenate([row, row]), np.concatenate([low, low + 1])
            matrix = csr_array((weights, places), shape=(count, len(stretch.time)))
            if self.band_hz[side] is None:
                matrix = matrix[np.flatnonzero(self._windows(recording, self._stamps(side, stretch)))]
            self._operators[key] = matrix, width * usual_step(stamp) if len(stamp) > 1 else 0.0
        return self._operators[key]

    @cached_property
    def band_hz(self) -> dict[str, float | None]:
        """By side, the common cut-off of torques and columns where the torques were low-passed before, else None.
        Half of the remaining band leaves no effect of the earlier filter."""
        found: dict[str, float | None] = {}
        for side in self.sides:
            edges = [r.joint_band_hz if side == "joint" else r.motor_band_hz for r in self.recordings]
            least = min((edge for edge in edges if edge is not None), default=np.inf)
            found[side] = 0.5 * least if least < 0.5 / self.bin_s else None
        return found

    def _slow(self, side: str, rows: Floats, dt: float, *, smooth: bool = True) -> Floats:
        """Rows (m, ...) every `dt` seconds, low-passed if `smooth`, thinned and without spoiled ends where the
        torques were low-passed before."""
        cutoff = self.band_hz[side]
        if cutoff is None or cutoff >= 0.4 / dt:
            return rows
        rows = low_pass(rows, dt, cutoff) if smooth else rows
        step, edge = max(1, int(0.4 / (cutoff * dt))), int(0.5 / (cutoff * dt))
        return rows[edge : len(rows) - edge : step]

    def _stamps(self, side: str, stretch: RecordStretch) -> Floats:
        """Times (m,) [s] of all rows of a stretch."""
        stamp, _, width = self._sampling(side, stretch)
        return self._slow(side, bins(stamp[:, None], width)[:, 0], width * usual_step(stamp), smooth=False)

    def _windows(self, recording: SessionRecord, stamps: Floats) -> NDArray[np.bool_]:
        """Rows (m,) to use. Of a long session: the beginning, two periods at least, and windows spread evenly, so
        that drifts are seen and the rows stay within memory."""
        share = self.settings.most_s / len(self.recordings)
        since = stamps - recording.start_s
        if recording.duration_s <= share:
            return np.ones(len(stamps), dtype=bool)
        lead = 2.0 * recording.period_s if recording.repeats else 0.0
        lead = lead if lead < 0.8 * share else _WINDOW_S
        every = _WINDOW_S * (recording.duration_s - lead) / (share - lead)
        return np.asarray((since < lead) | (np.mod(since - lead, every) < _WINDOW_S))

    def _make_rows(self) -> None:
        self.rows = {side: self._side_rows(side) for side in self.sides}
        for side in self.sides if self.arm.healthy else ():
            of: Side = "motor" if side == "motor" else "joint"
            rows, torque = self.rows[side], self.healthy_torque(of)
            self.rows[side] = replace(rows, target=rows.target - torque)

    def healthy_torque(self, side: Side) -> Floats:
        """Torque (m, n) [Nm] of the healthy arm's own effects."""

        def made(motion: ArmMotion) -> tuple[Column, ...]:
            torque = effects_torque(self.arm.healthy, motion, side=side, measured=True)
            return (Column(motor=torque) if side == "motor" else Column(joint=torque),)

        return self.columns(made, [side])[side][0]

    def whole_friction(self, values: Floats) -> Floats:
        """Base parameters (p,) with the friction of each drive as a whole: the Coulomb and viscous friction nearest, in
        its rows, to that of the parameters with the healthy arm's own effects, for columns of the speed are hardly
        independent."""
        found = values.copy()
        if "motor" not in self.rows or not self.arm.healthy:
            return found
        rows, torque = self.rows["motor"], self.healthy_torque("motor")
        for joint in np.flatnonzero(self.moving).tolist():
            keep = rows.valid[:, joint]
            names = [f"{symbol}{joint + 1}" for symbol in ("Fcm", "Fvm", "offm")]
            places = [k for k, name in enumerate(self.base.names) if name in names]
            more = np.linalg.lstsq(rows.matrix[joint][keep][:, places], torque[keep, joint], rcond=None)[0]
            for k, value in zip(places, more, strict=True):
                found[k] += 0.0 if self.base.names[k].startswith("offm") else value
        return found

    def _side_rows(self, side: str) -> SideRows:
        """The rows of a side. Where the links move as before, what follows from their motion stays."""
        of, before = self._made.get(side, ((), None))
        same = [(a.q is b.q, a.qd is b.qd, a.qdd is b.qdd) for a, b in zip(of, self.motions, strict=False)]
        kept = before if np.all(same) else None
        if kept is None or side == "motor":
            kept = self._made_anew(side, kept)
        self._made[side] = self.motions, kept
        return kept

    def _made_anew(self, side: str, before: SideRows | None) -> SideRows:
        """The rows of a side, in place of those `before` where only the drives move otherwise."""
        columns = np.asarray(self.base.columns)
        places = np.arange(len(columns))
        if before is not None:
            places = np.flatnonzero([self.structure.of_drive(column) for column in columns])
        make_matrix = partial(self._used_matrix, columns[places], side)
        parts: list[tuple[Any, ...]] = []
        matrices: list[Callable[[], Floats]] = []
        for motion, (recording, stretch) in zip(self.motions, self.stretches, strict=True):
            if not _holds(recording, stretch, side):
                continue
            stamp, delay, width = self._sampling(side, stretch)
            at = stamp - delay
            if side == "motor":
                target, usable, speed = stretch.motor, stretch.motor_usable, motion.motor_speed
            else:
                target, usable, speed = stretch.effort, stretch.usable, motion.qd
            moves = self._moves(stretch, speed, at, drives=side == "motor")
            dt = width * usual_step(stamp)
            stamps = self._stamps(side, stretch)
            chosen = self._windows(recording, stamps)
            matrices.append(partial(make_matrix, motion, recording, stretch, chosen))
            torque = self._slow(side, bins(target, width), dt)
            if self.band_hz[side] is not None:
                # The columns pass through the same low-pass, so rounded reversals cancel; only longer rests are
                # unknown.
                valid = self._slow(side, bins((usable & moves).astype(float), width), dt) > _KNOWN
            else:
                moves = _whole(moves, width)
                if side == "joint":
                    # The positions' low-pass rounds the corner made by the link's Coulomb friction.
                    span = max(at[-1] - at[0], 1e-9)
                    moves = _guarded(moves, round(self.settings.guard_s * len(moves) / span))
                valid = _whole(usable, width) & moves
            session, test = (np.full(int(chosen.sum()), v) for v in (recording.number, recording.test))
            parts.append((torque[chosen], (valid & self.moving)[chosen], session, stamps[chosen], test))
        others = [np.concatenate(part) for part in zip(*parts, strict=True)]
        # One stretch in memory at a time.
        shape = (self.arm.chain.n, len(others[0]), len(self.base))
        matrix = Arena().room(shape) if before is None else before.matrix
        first, own = 0, slice(None) if before is None else places
        for (torque, *_), make in zip(parts, matrices, strict=True):
            matrix[:, first : first + len(torque), own] = make()
            first += len(torque)
        return SideRows(matrix, *others)

    def _used_matrix(
        self,
        columns: NDArray[np.int64],
        side: str,
        motion: ArmMotion,
        recording: SessionRecord,
        stretch: RecordStretch,
        chosen: NDArray[np.bool_],
    ) -> Floats:
        """(n, m, k) regressor of some columns in the `chosen` rows of one stretch and side."""
        stamp, delay, width = self._sampling(side, stretch)
        at = stamp - delay
        if self.band_hz[side] is None:
            # The rows in use alone.
            used = at[: len(at) // width * width].reshape(-1, width)[chosen].reshape(-1)
            return self._matrix(columns, side, motion, recording, stretch.time, used, width)
        wide = self._matrix(columns, side, motion, recording, stretch.time, at, width)
        return np.stack([self._slow(side, table, width * usual_step(stamp)) for table in wide])[:, chosen]

    def _moves(self, stretch: RecordStretch, speed: Floats, at: Floats, *, drives: bool) -> NDArray[np.bool_]:
        """Whether joints move in one direction for a while before and after times (m,), away from rest, (m, n).

        drives : whether it has to be a motion of the drives and not a ringing of their links.
        """
        dt = float(stretch.time[1] - stretch.time[0])
        least = self.settings.standstill_rad_s
        size = 2 * round(self.settings.reversal_s / dt) + 1
        # The low-pass of the positions spreads a start or a stop by half a period of its cut-off to either side.
        wide = 2 * round(0.5 / self.settings.signals.cutoff / dt) + 1
        found = np.empty((len(at), speed.shape[1]), dtype=bool)
        for joint in range(speed.shape[1]):
            # One joint of a long session at a time.
            own = column(speed, joint)
            steady = (minimum_filter1d(own, size) > 0.0) | (maximum_filter1d(own, size) < 0.0)
            rests = maximum_filter1d(np.abs(own), wide) <= least
            steady &= ~maximum_filter1d(rests, 2 * wide - 1)
            if drives:
                steady &= ~ringing(own, dt)
            moves = np.abs(_at(stretch.time, own[:, None], at)) > least
            found[:, joint] = (moves & (_at(stretch.time, steady[:, None].astype(float), at) > 0.999))[:, 0]
        return found

    def _matrix(
        self,
        columns: NDArray[np.int64],
        side: str,
        motion: ArmMotion,
        recording: SessionRecord,
        grid: Floats,
        at: Floats,
        width: int,
    ) -> Floats:
        """(n, m, k) regressor of some columns of one stretch and side in rows, the drives at the motors' own motion."""
        exact = _on_grid(grid, at) if len(at) else None
        signals = (
            motion.q,
            motion.qd,
            motion.qdd,
            motion.motor_speed,
            motion.motor_acceleration,
            motion.direction,
        )
        q, qd, qdd, *drive = (x[exact] if exact is not None else _at(grid, x, at) for x in signals)
        chosen: Side = "motor" if side == "motor" else "joint"
        return binned_regressor(
            self.structure,
            columns,
            Motion(q, qd, qdd, DriveMotion(*drive) if side == "motor" else None),
            recording.payload,
            chosen,
            width,
        )


def _holds(recording: SessionRecord, stretch: RecordStretch, side: str) -> bool:
    return side in recording.sides and (side == "joint" or len(stretch.motor_time) > 1)


def _whole(flags: NDArray[np.bool_], width: int) -> NDArray[np.bool_]:
    """Whether all `width` samples of a bin are set, (m, n) of (N, n)."""
    count = len(flags) // width
    return np.asarray(flags[: count * width].reshape(count, width, *flags.shape[1:]).all(axis=1))


def _guarded(moves: NDArray[np.bool_], rows: int) -> NDArray[np.bool_]:
    """The same (m, n) without the neighbours of rows that are not set."""
    out = moves.copy()
    for k in range(1, rows + 1):
        out[k:] &= moves[:-k]
        out[:-k] &= moves[k:]
    return out


def _on_grid(grid: Floats, at: Floats) -> NDArray[np.int64] | None:
    """Indices of the grid at the times, if these all fall on it."""
    dt = float(grid[1] - grid[0])
    place = (at - grid[0]) / dt
    nearest = np.rint(place).astype(np.int64)
    inside = nearest.min() >= 0 and nearest.max() < len(grid)
    return nearest if inside and np.max(np.abs(place - nearest)) < 1e-4 else None


def _at(grid: Floats, values: Floats, at: Floats) -> Floats:
    """Values (N, k) of the grid at other times by linear interpolation; ends are held."""
    exact = _on_grid(grid, at) if len(at) else None
    if exact is not None:
        return values[exact]
    place = np.clip((at - grid[0]) / (grid[1] - grid[0]), 0.0, len(grid) - 1.000001)
    low = place.astype(np.int64)
    share = (place - low)[:, None]
    return (1.0 - share) * values[low] + share * values[low + 1]


def _definite(mass: Floats) -> Floats:
    """Mass matrices (N, n, n), made positive definite for the springs after a fit spoiled by a strong effect."""
    try:
        np.linalg.cholesky(mass)
    except np.linalg.LinAlgError:
        values, vectors = np.linalg.eigh(mass)
        least = _LEAST_MASS * np.abs(values).max(axis=1, keepdims=True)
        return np.asarray((vectors * np.maximum(values, least)[:, None, :]) @ vectors.transpose(0, 2, 1))
    return mass
