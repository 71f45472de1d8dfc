"""The nominal arm: rows of the base model at the full bandwidth of the channels, and its predictions.

Each side keeps its own sample times. Joint torque is averaged over short bins, the regressor with it; motor
torque that comes slower than that gives one row a sample, with the regressor at that very instant. Both are
linear operations on torque and regressor alike, so neither biases anything, and a row depends on a few
milliseconds only: standstill and reversals spoil few rows.

The drive's own columns (Ia, Fvm, Fcm) belong to the motor, which stands elsewhere than the link by the twist
of the joint; the twist is that of the torque which the model predicts, so no sensor's noise or error leaks
from one side to the other.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter1d, minimum_filter1d
from scipy.sparse import csr_array

from ident.diagnosis.recording import Recording, Stretch
from ident.diagnosis.settings import DiagnosisSettings
from ident.dynamics import regressor
from ident.dynamics.base_set import BaseSet, numeric_base
from ident.dynamics.kinematics import Chain
from ident.dynamics.parameters import split_name
from ident.dynamics.structure import Condition, Coupling, ModelStructure, Side
from ident.effects.motion import Motion, dahl
from ident.effects.springs import Springs
from ident.model.dynamic_model import DynamicModel
from ident.rows.filters import differentiate, low_pass

__all__ = ["TRAVEL_RAD", "Arm", "Nominal", "SideRows", "structure_of"]

Floats = NDArray[np.float64]

_CHUNK = 2000
# Share of a low-passed row that must rest on samples of a joint that moves.
_KNOWN = 0.8
# Length of the windows that are used of a long session [s].
_WINDOW_S = 10.0
# Compliance [rad/Nm] of a joint that is taken for rigid.
_RIGID = 1e-6
# Damping over stiffness of the joints [s]: of a link that rings at 7 Hz it takes 4 % of the critical damping.
_RELAXATION_S = 2e-3
# Least eigenvalue of a mass matrix over its largest.
_LEAST_MASS = 1e-3
# A joint that stays within this range says nothing about its friction, gears and cables.
TRAVEL_RAD = 0.1


@dataclass(frozen=True, eq=False)
class Arm:
    """What is known of the arm beforehand.

    compliance : (n,) twist of the joints per torque [rad/Nm], zero where unknown. gear_ratio : (n,), one where
    unknown. motor_delay_s, joint_delay_s : of the healthy channels.
    encoder : `link` or `motor`, the side of the elastic joints whose positions are published;
    encoder_known : whether a healthy arm told it.
    reach : (n,) distance after a reversal in which 63 % of the drive's Coulomb friction turn [rad], zero where
    unknown.
    far, far_share : (n,) the share of it that turns within a longer distance, and that distance [rad].
    couplings : pairs of joints whose drives are coupled.
    """

    chain: Chain
    compliance: Floats
    gear_ratio: Floats
    motor_delay_s: float = 0.0
    joint_delay_s: float = 0.0
    encoder: Literal["link", "motor"] = "link"
    encoder_known: bool = False
    reach: Floats | None = None
    far: Floats | None = None
    far_share: Floats | None = None
    couplings: tuple[Coupling, ...] = ()

    def slip(self, speed: Floats, dt: float) -> Floats:
        """Coulomb friction of the drives over its level for motor speeds (N, n) [rad/s]: Dahl's state, or the sum
        of two of them (Maxwell slip: asperities of several lengths side by side)."""
        found = np.sign(speed)
        if self.reach is not None:
            path = np.cumsum(speed, axis=0) * dt
            for joint in np.flatnonzero(self.reach > 0.0):
                along = np.ascontiguousarray(path[:, joint])
                start = float(found[0, joint])
                found[:, joint] = dahl(along, float(self.reach[joint]), start)
                if self.far is not None and self.far_share is not None and self.far_share[joint] != 0.0:
                    slow = dahl(along, float(self.far[joint]), start)
                    found[:, joint] += float(self.far_share[joint]) * (slow - found[:, joint])
        return found


def structure_of(arm: Arm, recordings: Sequence[Recording]) -> tuple[ModelStructure, BaseSet]:
    """Columns for the sessions' payloads and sides."""
    payloads = tuple(dict.fromkeys(r.payload for r in recordings if r.payload is not None))
    motor = any(r.has_motor for r in recordings)
    structure = ModelStructure(arm.chain, 2 if motor else 1, payloads, couplings=arm.couplings)
    conditions: dict[Condition, None] = {}
    for r in recordings:
        conditions[Condition(r.payload, r.sides)] = None
    return structure, numeric_base(structure, tuple(conditions))


@dataclass(frozen=True, eq=False)
class SideRows:
    """Rows of one side, all sessions, in the order of time.

    matrix : (n, m, p) base regressor by joint; target : (m, n) [Nm]; valid : (m, n).
    session : (m,) number; time : (m,) [s]; test : (m,) rows that are never fitted.
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

    motions : one for each stretch, with the predicted torques.
    """

    arm: Arm
    recordings: tuple[Recording, ...]
    settings: DiagnosisSettings
    structure: ModelStructure
    base: BaseSet
    motions: list[Motion] = field(default_factory=list)
    rows: dict[str, SideRows] = field(default_factory=dict)
    _operators: dict[tuple[str, int, float], tuple[csr_array, float]] = field(
        default_factory=dict, init=False, repr=False
    )

    @classmethod
    def of(
        cls,
        arm: Arm,
        recordings: Sequence[Recording],
        settings: DiagnosisSettings,
        structure: ModelStructure,
        base: BaseSet,
    ) -> Nominal:
        """Rows with the twist of the measured joint torque, to begin with."""
        nominal = cls(arm, tuple(recordings), settings, structure, base)
        nominal.motions = [
            nominal._motion(r, s, _measured(s)) for r in nominal.recordings for s in r.stretches
        ]
        nominal.make_rows()
        return nominal

    @property
    def stretches(self) -> list[tuple[Recording, Stretch]]:
        """Recording and stretch of each motion."""
        return [(r, s) for r in self.recordings for s in r.stretches]

    @property
    def held_out(self) -> bool:
        """Whether there are recordings that are never fitted."""
        return any(r.test for r in self.recordings)

    @cached_property
    def sides(self) -> tuple[str, ...]:
        """Sides that have rows."""
        return tuple(s for s in ("motor", "joint") if any(s in r.sides for r in self.recordings))

    @cached_property
    def moving(self) -> NDArray[np.bool_]:
        """Joints (n,) that travel in what is fitted; of the others the torque says nothing, and has no rows."""
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
            link = self._link_torque(before.q, before.qd, before.qdd, body, drive)
            motions.append(self._motion(recording, stretch, link, body, drive))
        self.motions = motions
        self.make_rows()

    def _link_torque(
        self, q: Floats, qd: Floats, qdd: Floats, bodies: Floats, drive: Mapping[str, Floats]
    ) -> Floats:
        """Torque (N, n) [Nm] through the joints."""
        rigid = regressor.torque(self.arm.chain, q, qd, qdd, bodies)
        return rigid + drive["Fvl"] * qd + drive["Fcl"] * np.sign(qd) + drive["offl"]

    def _hanging(
        self, stretch: Stretch, start: tuple[Floats, Floats], bodies: Floats, drive: Mapping[str, Floats]
    ) -> tuple[Floats, Floats, Floats, Springs]:
        """Position, speed and acceleration (N, n) of links that hang on springs behind the published motors, from a
        first guess of the former two; and the springs."""
        stiffness = 1.0 / np.maximum(self.arm.compliance, _RIGID)
        dt = float(stretch.time[1] - stretch.time[0])
        (q, qd), qdd = start, np.zeros_like(stretch.q)
        for _ in range(2):
            mass = _definite(regressor.mass_matrix(self.arm.chain, q, bodies))
            other = self._link_torque(q, qd, np.zeros_like(q), bodies, drive)
            springs = Springs(mass, other, stretch.q, stretch.qd, stiffness, _RELAXATION_S * stiffness, dt)
            q, qd, qdd = springs.links
        return q, qd, qdd, springs

    def _motion(
        self,
        recording: Recording,
        stretch: Stretch,
        link_torque: Floats,
        bodies: Floats | None = None,
        drive: dict[str, Floats] | None = None,
    ) -> Motion:
        n = self.arm.chain.n
        dt = float(stretch.time[1] - stretch.time[0])
        q, qd, qdd = stretch.q, stretch.qd, stretch.qdd
        speed, thrust = qd, qdd
        if np.any(self.arm.compliance > 0.0):
            # A measured torque is noisy, and its second derivative more so; a predicted one is not.
            wanted = self.settings.deflection_hz if bodies is not None else 20.0
            if self.arm.encoder == "motor":
                wanted = 10.0
            cutoff = min(wanted, 0.2 / dt)
            twist = low_pass(link_torque, dt, cutoff) * self.arm.compliance
            first, second = differentiate(twist, dt)
            if self.arm.encoder == "motor":
                q, qd, qdd = q - twist, qd - first, qdd - second
            else:
                speed, thrust = speed + first, thrust + second
        springs = None
        if (
            bodies is not None
            and drive is not None
            and self.arm.encoder == "motor"
            and np.any(self.arm.compliance)
        ):
            q, qd, qdd, springs = self._hanging(stretch, (q, qd), bodies, drive)
            link_torque = self._link_torque(q, qd, qdd, bodies, drive)
        zero = np.zeros(n)
        values = drive or dict.fromkeys(("Ia", "Fvm", "Fcm", "offm", "Fcl"), zero)

        def friction(v: Floats) -> Floats:
            return values["Fvm"] * v + values["Fcm"] * np.sign(v)

        slip = self.arm.slip(speed, dt)
        drag = values["Fvm"] * speed + values["Fcm"] * slip
        motor = link_torque + values["Ia"] * thrust + drag + values["offm"]
        return Motion(
            chain=self.arm.chain,
            bodies=np.zeros((n, 10)) if bodies is None else bodies,
            session=recording.number,
            time=stretch.time,
            duration_s=recording.duration_s,
            q=q,
            qd=qd,
            qdd=qdd,
            motor_speed=speed,
            motor_acceleration=thrust,
            joint_torque=link_torque,
            motor_torque=motor,
            gear_ratio=self.arm.gear_ratio,
            inertia=values["Ia"],
            link_coulomb=values["Fcl"],
            motor_coulomb=values["Fcm"],
            friction=friction,
            slip=slip,
            springs=springs,
            loaded=recording.payload is not None or all(r.payload is None for r in self.recordings),
        )

    # ---- rows ----

    @property
    def bin_s(self) -> float:
        """Length of a bin [s]."""
        settings = self.settings
        return max(settings.bin_s, settings.ringing_s) if self.arm.encoder == "motor" else settings.bin_s

    def _bin(self, stretch: Stretch) -> int:
        """Samples in a bin of the joint torque."""
        dt = float(stretch.time[1] - stretch.time[0])
        return max(1, round(self.bin_s / dt))

    def motor_bin(self, stretch: Stretch) -> int:
        """Samples in a bin of the motor torque."""
        if len(stretch.motor_time) < 2:
            return 1
        step = float(np.median(np.diff(stretch.motor_time)))
        return max(1, round(self.bin_s / step)) if step < 0.6 * self.bin_s else 1

    def reduce(self, side: str, values: Sequence[Floats]) -> Floats:
        """Rows (m,) or (m, k) of signals given on the grid of each motion, (N,) or (N, k)."""
        parts = []
        for number, ((recording, stretch), signal) in enumerate(zip(self.stretches, values, strict=True)):
            if not _holds(recording, stretch, side):
                continue
            operator, dt = self._operator(side, number, stretch)
            rows = self._slow(side, operator @ signal.reshape(len(signal), -1), dt)
            parts.append(rows[self._windows(recording, self._stamps(side, stretch))])
        whole = np.concatenate(parts)
        return whole[:, 0] if values[0].ndim == 1 else whole

    def _operator(self, side: str, number: int, stretch: Stretch) -> tuple[csr_array, float]:
        """Matrix (m, N) from the grid of a stretch to its rows, at the channel's delay, and the rows' distance [s]."""
        delay = self.arm.joint_delay_s if side == "joint" else self.arm.motor_delay_s
        key = (side, number, delay)
        if key not in self._operators:
            stamp = stretch.time if side == "joint" else stretch.motor_time
            width = self._bin(stretch) if side == "joint" else self.motor_bin(stretch)
            count = len(stamp) // width
            place = (stamp[: count * width] - delay - stretch.time[0]) / _step(stretch.time)
            nearest = np.rint(place)
            place = np.where(np.abs(place - nearest) < 1e-4, nearest, place)
            place = np.clip(place, 0.0, len(stretch.time) - 1.000001)
            low = place.astype(np.int64)
            share = place - low
            row = np.arange(len(low)) // width
            matrix = csr_array(
                (
                    np.concatenate([1.0 - share, share]) / width,
                    (np.concatenate([row, row]), np.concatenate([low, low + 1])),
                ),
                shape=(count, len(stretch.time)),
            )
            self._operators[key] = matrix, width * _step(stamp) if len(stamp) > 1 else 0.0
        return self._operators[key]

    @cached_property
    def band_hz(self) -> dict[str, float | None]:
        """By side, the cut-off that torques and columns both get where torques were low-passed before, else
        None: half of the band that is left, so that of the earlier filter nothing is felt."""
        found: dict[str, float | None] = {}
        for side in self.sides:
            edges = [r.joint_band_hz if side == "joint" else r.motor_band_hz for r in self.recordings]
            known = [edge for edge in edges if edge is not None]
            least = min(known, default=np.inf)
            found[side] = 0.5 * least if least < 0.5 / self.bin_s else None
        return found

    def _slow(self, side: str, rows: Floats, dt: float) -> Floats:
        """Rows (m, k) every `dt` seconds, low-passed and thinned where the torques were low-passed before."""
        cutoff = self.band_hz[side]
        if cutoff is None or cutoff >= 0.4 / dt:
            return rows
        return self._thin(side, low_pass(rows, dt, cutoff), dt)

    def _thin(self, side: str, rows: Floats, dt: float) -> Floats:
        """Every so many of the rows (m, ...), without the ends that the low-pass spoils."""
        cutoff = self.band_hz[side]
        if cutoff is None or cutoff >= 0.4 / dt:
            return rows
        step, edge = max(1, int(0.4 / (cutoff * dt))), int(0.5 / (cutoff * dt))
        return rows[edge : len(rows) - edge : step]

    def _stamps(self, side: str, stretch: Stretch) -> Floats:
        """Times (m,) of the rows of a stretch [s], all of them."""
        stamp = stretch.time if side == "joint" else stretch.motor_time
        width = self._bin(stretch) if side == "joint" else self.motor_bin(stretch)
        return self._thin(side, _binned(stamp[:, None], width)[:, 0], width * _step(stamp))

    def _windows(self, recording: Recording, stamps: Floats) -> NDArray[np.bool_]:
        """Rows (m,) to use: of long sessions the beginning, two periods at least, and windows spread evenly, so
        that what drifts is seen and rows stay within memory."""
        share = self.settings.most_s / len(self.recordings)
        since = stamps - recording.start_s
        if recording.duration_s <= share:
            return np.ones(len(stamps), dtype=bool)
        lead = 2.0 * recording.period_s if recording.repeats else 0.0
        lead = lead if lead < 0.8 * share else _WINDOW_S
        every = _WINDOW_S * (recording.duration_s - lead) / (share - lead)
        return np.asarray((since < lead) | (np.mod(since - lead, every) < _WINDOW_S))

    def make_rows(self) -> None:
        """Rows of all sides from the present motions."""
        self.rows = {side: self._side_rows(side) for side in self.sides}

    def _side_rows(self, side: str) -> SideRows:
        still = self.settings.standstill_rad_s
        matrices, targets, valid, session, time, test = [], [], [], [], [], []
        for motion, (recording, stretch) in zip(self.motions, self.stretches, strict=True):
            if not _holds(recording, stretch, side):
                continue
            if side == "motor":
                width = self.motor_bin(stretch)
                at = stretch.motor_time - self.arm.motor_delay_s
                target, usable, stamp = stretch.motor, stretch.motor_usable, stretch.motor_time
            else:
                width = self._bin(stretch)
                at = stretch.time - self.arm.joint_delay_s
                target, usable, stamp = stretch.effort, stretch.usable, stretch.time
            speed = motion.motor_speed if side == "motor" else motion.qd
            moves = (np.abs(_at(stretch.time, speed, at)) > still) & (
                _at(stretch.time, self._steady(speed, stretch), at) > 0.999
            )
            dt = width * _step(stamp)
            wide = self._matrix(side, motion, recording, stretch.time, at, width)
            matrices.append(np.stack([self._slow(side, table, dt) for table in wide]))
            targets.append(self._slow(side, _binned(target, width), dt))
            if self.band_hz[side] is not None:
                # The low-pass that rounds reversals is in the columns too; only longer rests are unknown.
                known = _binned((usable & moves).astype(float), width)
                valid.append(self._slow(side, known, dt) > _KNOWN)
            else:
                moves = _binned(moves.astype(float), width) > 1.0 - 1e-9
                if side == "joint":
                    # The positions' low-pass rounds the corner that the link's Coulomb friction makes.
                    span = max(at[-1] - at[0], 1e-9)
                    moves = _guarded(moves, round(self.settings.guard_s * len(moves) / span))
                valid.append((_binned(usable.astype(float), width) > 1.0 - 1e-9) & moves)
            stamps = self._stamps(side, stretch)
            chosen = self._windows(recording, stamps)
            stamps, valid[-1] = stamps[chosen], (valid[-1] & self.moving)[chosen]
            matrices[-1], targets[-1] = matrices[-1][:, chosen], targets[-1][chosen]
            time.append(stamps)
            session.append(np.full(len(stamps), recording.number))
            test.append(np.full(len(stamps), recording.test))
        return SideRows(
            np.concatenate(matrices, axis=1),
            np.concatenate(targets),
            np.concatenate(valid),
            np.concatenate(session),
            np.concatenate(time),
            np.concatenate(test),
        )

    def _steady(self, speed: Floats, stretch: Stretch) -> Floats:
        """1 where a joint keeps its direction for a while before and after, 0 elsewhere, (N, n)."""
        dt = float(stretch.time[1] - stretch.time[0])
        size = 2 * round(self.settings.reversal_s / dt) + 1
        same = (minimum_filter1d(speed, size, axis=0) > 0.0) | (maximum_filter1d(speed, size, axis=0) < 0.0)
        return same.astype(float)

    def _matrix(
        self, side: str, motion: Motion, recording: Recording, grid: Floats, at: Floats, width: int
    ) -> Floats:
        """(n, m, p) regressor of one stretch and side in rows."""
        n, columns = motion.n, self.base.columns
        chosen: Side = "motor" if side == "motor" else "joint"
        parts = []
        size = max(width, _CHUNK // width * width)
        count = len(at) // width * width
        exact = _on_grid(grid, at)
        drive = self._drive_columns() if side == "motor" else {}
        for first in range(0, count, size):
            some = at[first : min(first + size, count)]
            pick = None if exact is None else exact[first : first + len(some)]
            state = [
                x[pick] if pick is not None else _at(grid, x, some)
                for x in (
                    motion.q,
                    motion.qd,
                    motion.qdd,
                    motion.motor_speed,
                    motion.motor_acceleration,
                    motion.direction,
                )
            ]
            q, qd, qdd, speed, thrust, slip = state
            wide = self.structure.regressor(
                q, qd, qdd, payload=recording.payload, sides=(chosen,), columns=columns
            )
            table = wide.T.reshape(len(columns), n, len(some))
            if drive:
                table = table.copy()
                signals = {"Ia": thrust, "Fvm": speed, "Fcm": slip}
                for place, (symbol, joint) in drive.items():
                    table[place, joint] = signals[symbol][:, joint]
            parts.append(table.reshape(len(columns), n, -1, width).mean(axis=3).transpose(1, 2, 0))
        return np.concatenate(parts, axis=1)

    def _drive_columns(self) -> dict[int, tuple[str, int]]:
        """Places of the base columns that belong to the motor, with symbol and joint."""
        found = {}
        for place, column in enumerate(self.base.columns):
            symbol, link = split_name(self.structure.names[column])[:2]
            if symbol in ("Ia", "Fvm", "Fcm") and link <= self.arm.chain.n:
                found[place] = (symbol, link - 1)
        return found


def _holds(recording: Recording, stretch: Stretch, side: str) -> bool:
    """Whether a stretch has torques of a side."""
    return side in recording.sides and (side == "joint" or len(stretch.motor_time) > 1)


def _step(time: Floats) -> float:
    return float(np.median(np.diff(time)))


def _measured(stretch: Stretch) -> Floats:
    return stretch.effort


def _guarded(moves: NDArray[np.bool_], rows: int) -> NDArray[np.bool_]:
    """The same (m, n) without the rows next to those that are not set."""
    out = moves.copy()
    for k in range(1, rows + 1):
        out[k:] &= moves[:-k]
        out[:-k] &= moves[k:]
    return out


def _on_grid(grid: Floats, at: Floats) -> NDArray[np.int64] | None:
    """Indices of the grid at the times, where these all fall on it."""
    dt = float(grid[1] - grid[0])
    place = (at - grid[0]) / dt
    nearest = np.rint(place).astype(np.int64)
    inside = nearest.min() >= 0 and nearest.max() < len(grid)
    return nearest if inside and np.max(np.abs(place - nearest)) < 1e-4 else None


def _at(grid: Floats, values: Floats, at: Floats) -> Floats:
    """Values (N, k) of the grid at other times, linearly; ends are held."""
    exact = _on_grid(grid, at) if len(at) else None
    if exact is not None:
        return values[exact]
    place = np.clip((at - grid[0]) / (grid[1] - grid[0]), 0.0, len(grid) - 1.000001)
    low = place.astype(np.int64)
    share = (place - low)[:, None]
    return (1.0 - share) * values[low] + share * values[low + 1]


def _binned(values: Floats, width: int) -> Floats:
    """Means (m, k) over `width` samples of (N, k)."""
    if width == 1:
        return values
    count = len(values) // width
    return values[: count * width].reshape(count, width, -1).mean(axis=1)


def _definite(mass: Floats) -> Floats:
    """Mass matrices (N, n, n); where some are none of any arm, as a fit that a strong effect spoils may give them, all
    with their eigenvalues from a small one on, or no spring could carry them.
    """
    try:
        np.linalg.cholesky(mass)
    except np.linalg.LinAlgError:
        values, vectors = np.linalg.eigh(mass)
        least = _LEAST_MASS * np.abs(values).max(axis=1, keepdims=True)
        return np.asarray((vectors * np.maximum(values, least)[:, None, :]) @ vectors.transpose(0, 2, 1))
    return mass
