"""Redundancy of an arm's torques: one rigid model for all joints, sides and sessions.

The joints of an arm share their inertial parameters, motor and joint torque of a joint differ by its drive alone,
and gravity and acceleration act on the same masses. So the data hold more equations than a model needs, and a wrong
channel contradicts the others. `Redundancy` keeps the normal equations of each class of rows (side and joint) apart:

    G_c = W_c^T W_c,   B_c = W_c^T Y,   T_c = covariance of Y,

with the torques of all joints of the side, a one and the time in Y. A changed torque channel (gain, sign, zero, drift,
interchanged joints) is then a linear map of Y and needs no new rows. B_c and T_c are kept by part, half a session each,
because a channel may be wrong in one session or from some moment on. The fit reweights each class by its own residual,
so that a wrong channel does not bend the others: it stands out by its residual. The statistic of a class is rho, its
residual over its torque; the sum of log rho over the classes ranks explanations. Where the URDF states bodies, their
distance from it is weighted like a class, in the order of magnitude alone: without it bodies of a hundred times the
weight, some of them negative, take up the gain of a torque.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ident.dynamics.kinematics import Chain
from ident.dynamics.parameters import INERTIAL, LINK_FRICTION, Floats
from ident.dynamics.regressor import rigid_regressor, torque
from ident.dynamics.structure import Coupling
from ident.rows.content import Recall
from ident.rows.filters import ParallelFilter, SignalSettings, block_means, thinning
from ident.rows.prepare import prepare
from ident.rows.prepared import TorqueChannel
from ident.rows.sessions import payload_name
from ident.screening.nominal import nominal
from ident.screening.normal_equations import (
    BLOCK,
    ROUNDS,
    Blocks,
    Class,
    Fit,
    Normal,
    Part,
    Sums,
    factored,
    reweighted,
)
from lwr_driver.session import Session

_BODY = len(INERTIAL)
# Friction of the joint side; drive inertia, friction and offset of the motor side.
_JOINT, _MOTOR = 3, 4
# Relative standard deviation of bodies from the URDF's, for their order of magnitude alone.
_ORDER = 2.0
_MOST_ROWS = 800
_COVERED = 0.9
# A joint rests in a row beyond this share of rest; with a smaller share of moving rows its rows at rest count, too.
_RESTING, _HARDLY = 0.5, 0.1


_ARRAYS = ("time", "q", "qd", "qdd", "jerk", "sign", "turn", "coupled", "torque", "slope", "moving")


@dataclass(frozen=True)
class SampledRows:
    """Filtered motion and torque of one side of one session at the times of its rows.

    time : (K,) [s]; in `Redundancy` over the session's length, from 0 to 1. q, qd, qdd, jerk, sign, turn, torque,
    slope : (K, n); sign is the filtered sign(qd), and jerk, turn and slope are the time derivatives of qdd, sign and
    torque. moving : (K, n), bool; the friction of a joint at rest may be any up to its Coulomb torque. half : 0 or 1,
    of the session.
    """

    side: str
    record: int
    payload: str | None
    time: Floats
    q: Floats
    qd: Floats
    qdd: Floats
    jerk: Floats
    sign: Floats
    turn: Floats
    coupled: Floats
    torque: Floats
    slope: Floats
    moving: NDArray[np.bool_]
    half: int = 0

    @property
    def part(self) -> Part:
        """Session and half."""
        return self.record, self.half

    def moved(self, q: Floats, speed: Floats) -> SampledRows:
        """The rows with positions Q = q A + offset already in `q`, and speeds times the matrix `speed` (n, n)."""
        rates = {name: getattr(self, name) @ speed for name in ("qd", "qdd", "jerk")}
        rates |= {name: getattr(self, name) @ np.sign(speed) for name in ("sign", "turn")}
        return replace(self, q=q, **rates)

    def at_pace(self, factor: float) -> SampledRows:
        """The rows with the time divided by `factor`."""
        rates = {
            name: getattr(self, name) * factor**order
            for name, order in (("qd", 1), ("qdd", 2), ("jerk", 3), ("turn", 1), ("slope", 1))
        }
        return replace(self, **rates)

    def thinned(self, step: int) -> SampledRows:
        """Every `step`-th row."""
        return self._cut(slice(None, None, step))

    def halved(self, row: int) -> tuple[SampledRows, ...]:
        """The rows before `row` as the first half of the session, and those from it on as the second."""
        first, second = self._cut(slice(0, max(row, 0))), self._cut(slice(max(row, 0), None))
        return tuple(one for one in (first, replace(second, half=1)) if len(one.q))

    def _cut(self, at: slice) -> SampledRows:
        return replace(self, **{name: getattr(self, name)[at] for name in _ARRAYS})


def sampled(
    sessions: Sequence[Session],
    signals: SignalSettings,
    couplings: Sequence[tuple[int, int]] = (),
    recall: Recall | None = None,
) -> list[SampledRows]:
    """Rows of all sides of the sessions, without an estimated delay. Raises DataError like `prepare`."""
    found = []
    for record, session in enumerate(sessions):
        sensed = bool(session.joint.effort.shape[1])
        wanted = signals.punctual
        motor = session.motor is not None
        whole = prepare(session, wanted, motor=motor, log=False, blocks=True, recall=recall)
        # Blocks of one stretch, side by side.
        runs: list[dict[str, list[SampledRows]]] = []
        for passage in whole.passages:
            if not (runs and passage.continues):
                runs.append({})
            for channel in (passage.joint if sensed else None, passage.motor):
                if channel is not None:
                    rows = _rows(channel, passage.rows, record, payload_name(session), signals, couplings)
                    runs[-1].setdefault(channel.side, []).append(rows)
            passage.release()
        found += [_joined(parts) for run in runs for parts in run.values()]
    return [rows for rows in found if len(rows.q)]


def _joined(parts: Sequence[SampledRows]) -> SampledRows:
    """The rows of several blocks as one."""
    arrays: dict[str, Any] = {
        name: np.concatenate([getattr(part, name) for part in parts]) for name in _ARRAYS
    }
    return replace(parts[0], **arrays)


def _rows(
    channel: TorqueChannel,
    at: Floats,
    record: int,
    payload: str | None,
    signals: SignalSettings,
    couplings: Sequence[tuple[int, int]],
) -> SampledRows:
    factor = thinning(channel.period_s, signals.decimate)
    times, torque = block_means(channel.times, factor), block_means(channel.torque, factor)
    step = 0.04 / signals.decimate

    def low_pass(shift: float) -> ParallelFilter:
        return ParallelFilter(times, at + shift, signals.decimate, signals.attenuation_db)

    middle = low_pass(0.0)
    kept = middle.coverage() > _COVERED
    both = np.column_stack([channel.qd[:, a] + channel.qd[:, b] for a, b in couplings] or [channel.qd[:, :0]])
    motion = [channel.q, channel.qd, channel.qdd, np.sign(channel.qd), np.sign(both)]
    q, qd, qdd, sign, coupled = (middle.apply(block_means(values, factor))[kept] for values in motion)
    resting = (np.abs(channel.qd) < signals.standstill_rad_s).astype(np.float64)
    moving = middle.apply(block_means(resting, factor))[kept] < _RESTING
    changing = np.hstack([torque, *(block_means(values, factor) for values in motion[2:4])])
    rates = (low_pass(step).apply(changing) - low_pass(-step).apply(changing))[kept] / (2.0 * step)
    slope, jerk, turn = np.split(rates, 3, axis=1)
    smooth = middle.apply(torque)[kept]
    return SampledRows(
        channel.side, record, payload, at[kept], q, qd, qdd, jerk, sign, turn, coupled, smooth, slope, moving
    )


@dataclass(frozen=True)
class Gain:
    """Measured over computed torque of a class, from all other rows: value and standard deviation.

    left : share of the class's residual (rms) with this gain.
    """

    value: float
    std: float
    left: float


class Size(NamedTuple):
    """Size of an error beside all parameters, its standard deviation, and the share (rms) of the residual that is left
    in the rows with it."""

    value: float
    std: float
    left: float


@dataclass(frozen=True)
class Redundancy:
    """The rows of an arm and the classes in use.

    rows : all sides and sessions. silent : classes left out (dead sensors). couplings : pairs of joints.
    maps : (n + 2, n + 2) by side, [true torque, 1, time] = map @ [measured torque, 1, time]. own : the same by side and
    part, after them.
    """

    chain: Chain
    rows: tuple[SampledRows, ...]
    silent: frozenset[Class] = frozenset()
    couplings: tuple[tuple[int, int], ...] = ()
    maps: Mapping[str, Floats] = field(default_factory=dict)
    own: Mapping[tuple[str, Part], Floats] = field(default_factory=dict)

    @classmethod
    def of(
        cls,
        sessions: Sequence[Session],
        chain: Chain,
        signals: SignalSettings,
        couplings: Sequence[Coupling] = (),
        silent: frozenset[Class] = frozenset(),
        recall: Recall | None = None,
    ) -> Redundancy:
        """Rows of the sessions, at most about `_MOST_ROWS` a side. recall : as for `prepare`."""
        places = [tuple(chain.joint_names.index(name) for name in pair.joints) for pair in couplings]
        pairs = tuple((a, b) for a, b in places)
        rows = sampled(sessions, signals, pairs, recall)
        count = max((sum(len(r.q) for r in rows if r.side == side) for side in ("joint", "motor")), default=0)
        step = max(1, -(-count // _MOST_ROWS))
        return cls(chain, tuple(_halves(_timed(_moving([r.thinned(step) for r in rows])))), silent, pairs)

    @cached_property
    def sides(self) -> tuple[str, ...]:
        """Measured sides."""
        return tuple(sorted({rows.side for rows in self.rows}))

    @cached_property
    def payloads(self) -> tuple[str, ...]:
        """Names of the payloads."""
        return tuple(sorted({rows.payload for rows in self.rows if rows.payload is not None}))

    def place(self, symbol: str, joint: int) -> int:
        """Column of a drive parameter of a joint (from 0)."""
        first = _BODY * (self.chain.n + len(self.payloads))
        if symbol in LINK_FRICTION:
            return first + _JOINT * joint + LINK_FRICTION.index(symbol)
        first += _JOINT * self.chain.n if "joint" in self.sides else 0
        return first + _MOTOR * joint + ("Ia", "Fvm", "Fcm", "offm").index(symbol)

    @cached_property
    def width(self) -> int:
        """Number p of parameters."""
        joint, motor = "joint" in self.sides, "motor" in self.sides
        drives = self.chain.n * (_JOINT * joint + _MOTOR * motor)
        return _BODY * (self.chain.n + len(self.payloads)) + drives + motor * (1 + 3 * len(self.couplings))

    def matrix(self, rows: SampledRows) -> Floats:
        """Regressor (n, K, p) of one set of rows."""
        return self._columns([rows]).transpose(1, 2, 0)

    def _columns(self, together: Sequence[SampledRows]) -> Floats:
        """Columns (p, n, K) of the regressor of sets of rows of one side, one after the other."""
        n, side = self.chain.n, together[0].side
        q, qd, qdd, sign, coupled, slope = (
            np.concatenate([getattr(rows, name) for rows in together])
            for name in ("q", "qd", "qdd", "sign", "coupled", "slope")
        )
        out = np.zeros((self.width, n, len(q)))
        rigid_regressor(self.chain, q, qd, qdd, out=out[: _BODY * n])
        begin = 0
        for rows in together:
            here = slice(begin, begin := begin + len(rows.q))
            if rows.payload is not None:
                start = _BODY * (n + self.payloads.index(rows.payload))
                out[start : start + _BODY, :, here] = out[_BODY * (n - 1) : _BODY * n, :, here]
        first, each = _BODY * (n + len(self.payloads)), np.arange(n)
        if "joint" in self.sides:
            # Columns of joint j in the rows of joint j alone.
            at = first + _JOINT * each
            out[at, each], out[at + 1, each], out[at + 2, each] = qd.T, sign.T, 1.0
            first += _JOINT * n
        if side == "motor":
            at = first + _MOTOR * each
            out[at, each], out[at + 1, each], out[at + 2, each], out[at + 3, each] = qdd.T, qd.T, sign.T, 1.0
            last = first + _MOTOR * n
            # One delay for the channel: an error of its time moves the torque by its slope.
            out[last] = slope.T
            for k, (a, b) in enumerate(self.couplings):
                pair = last + 1 + 3 * k
                out[pair, a], out[pair, b] = qdd[:, b], qdd[:, a]
                out[pair + 1, [a, b]] = qd[:, a] + qd[:, b]
                out[pair + 2, [a, b]] = coupled[:, k]
        return out

    def normal(self) -> Normal:
        """Normal equations by class, the silent ones left out."""
        n = self.chain.n
        classes = [(side, j) for side in self.sides for j in range(n)]
        place = {key: k for k, key in enumerate(key for key in classes if key not in self.silent)}
        width, parts = self.width, tuple(sorted({rows.part for rows in self.rows}))
        blocks, used = [np.zeros((0, 0))] * len(place), [np.zeros(0, dtype=np.int64)] * len(place)
        mixed = np.zeros((len(place), len(parts), n + 2, width))
        scatter, square = np.zeros((2, len(place), len(parts), n + 2, n + 2))
        means = self._means()
        for side in self.sides:
            rows = sorted((one for one in self.rows if one.side == side), key=lambda one: one.part)
            joints = [j for j in range(n) if (side, j) in place]
            at = [place[side, j] for j in joints]
            columns = self._columns(rows)
            acting = np.asarray(columns.any(axis=2))
            moving = np.concatenate([one.moving for one in rows]).T[joints, :, None]
            seen = np.concatenate([_extended(one) for one in rows]) * moving
            for k, joint, weight in zip(at, joints, moving, strict=True):
                # A joint's torque has the bodies behind it and its own drive alone.
                used[k] = np.flatnonzero(acting[:, joint])
                part = columns[used[k], joint] * weight[:, 0]
                blocks[k] = part @ part.T
            begin = 0
            for one in rows:
                rest = slice(begin, begin := begin + len(one.q))
                o, some = parts.index(one.part), seen[:, rest]
                centred = some - means[side, one.record][joints, None] * moving[:, rest]
                own = columns[:, joints, rest].transpose(1, 2, 0)
                mixed[at, o] += _transposed(some) @ own
                scatter[at, o] += _transposed(centred) @ centred
                square[at, o] += _transposed(some) @ some
        prior = nominal(self.chain, width, _ORDER)
        return Normal(tuple(place), parts, Blocks.of(blocks, used), mixed, scatter, square, prior)

    def _means(self) -> dict[tuple[str, int], Floats]:
        """Means (n, n + 2) of torques, one and time of a side of a session, over the moving rows of each joint."""
        sums: dict[tuple[str, int], Floats] = {}
        for rows in self.rows:
            key = rows.side, rows.record
            sums[key] = sums.get(key, 0.0) + rows.moving.T.astype(np.float64) @ _extended(rows)
        # The sum of the ones is the number of rows.
        return {key: values / np.maximum(values[:, -2:-1], 1.0) for key, values in sums.items()}

    def enough(self, share: float) -> bool:
        """Whether there are `share` rows for each parameter."""
        return self._count >= share * self.width

    @property
    def _count(self) -> int:
        return sum(int(rows.moving.sum()) for rows in self.rows) - len(self.silent)

    def thinned(self, share: float) -> Redundancy:
        """As few of the rows as give about `share` for each parameter; all where they are no more."""
        step = max(1, int(self._count / (share * self.width)))
        return replace(self, rows=tuple(rows.thinned(step) for rows in self.rows))

    def map_of(self, side: str, part: Part | None = None) -> Floats:
        """(n + 2, n + 2), [true torque, 1, time] = map @ the same as measured; of a side, or of a part's."""
        whole = self.maps.get(side, np.eye(self.chain.n + 2))
        return whole if part is None or (side, part) not in self.own else self.own[side, part] @ whole

    def mapped(
        self, side: str, matrix: Floats, shift: Floats | float = 0.0, parts: Sequence[Part] = ()
    ) -> Redundancy:
        """The data with true torque = `matrix` (n, n) @ torque + shift on a side, or some of its parts.

        shift : (n, 2) [Nm], at the start of a session and from there to its end.
        """
        n = self.chain.n
        change = np.eye(n + 2)
        change[:n, :n], change[:n, n:] = matrix, shift
        if not parts:
            return replace(self, maps={**self.maps, side: change @ self.map_of(side)})
        unchanged = np.eye(n + 2)
        own = {(side, part): change @ self.own.get((side, part), unchanged) for part in parts}
        return replace(self, own={**self.own, **own})

    def true_torque(self, rows: SampledRows) -> Floats:
        """Torque (K, n) with the changes of the channel undone."""
        return np.asarray(_extended(rows) @ self.map_of(rows.side, rows.part)[: self.chain.n].T)

    def fit(self, normal: Normal | None = None, *, doubtful: bool = True, rounds: int = ROUNDS) -> Fit:
        """Weighted least squares, each class and the prior weighted by its own residual.

        The cost is the sum of log rho, and log(1 + d / N) / 2 for the squared distance d from the prior and N
        independent rows: d counts as it should while it is small, and hardly where the URDF is of another arm.

        normal : of rows with different `maps` only. doubtful : whether a torque may be in a wrong unit. rounds : of
        reweighting, at most.
        """
        normal = self.normal() if normal is None else normal
        chosen = self._maps(normal)
        mixed = np.einsum("konp,kon->kp", normal.mixed, chosen)
        scatter, square = (
            np.einsum("kon,konm,kom->k", chosen, part, chosen) for part in (normal.scatter, normal.square)
        )
        total = np.maximum(scatter, 1e-12 * np.maximum(square, 1e-12))
        common = np.full_like(total, np.max(total, initial=0.0) or 1.0)
        # A torque in a wrong unit is far too heavy or far too light in one of these starts, or the URDF is.
        starts = (total, 1.0 / normal.rows), (common, 1.0 / normal.rows), (total, 0.0)
        most = (3 if normal.prior.precision.any() else 2) if doubtful else 1
        sums = Sums(mixed, square, total)
        fits = [reweighted(normal, sums, *start, rounds) for start in starts[:most]]
        return min(fits, key=lambda fit: fit.cost)

    def _maps(self, normal: Normal) -> Floats:
        """Rows (m, o, n + 2) of the maps: true torque of each class in each part."""
        maps = {side: [self.map_of(side, part) for part in normal.parts] for side in self.sides}
        found = [[one[joint] for one in maps[side]] for side, joint in normal.classes]
        return np.array(found).reshape(-1, len(normal.parts), self.chain.n + 2)

    def gains(self, fit: Fit, normal: Normal) -> dict[Class, Gain]:
        """Gain of each class against its torque computed from the shared parameters.

        The computed torque of the class is an added column, so the gain comes from the other joints, the other side and
        other poses.
        """
        shared = self.shared(fit)
        computed = [self.matrix(rows) @ shared for rows in self.rows]
        columns = (
            [
                _only(values, key[1] if rows.side == key[0] else None)
                for rows, values in zip(self.rows, computed, strict=True)
            ]
            for key in normal.classes
        )
        sizes = self.along(fit, normal, columns)
        return {
            key: Gain(1.0 + size.value, size.std, size.left)
            for key, size in zip(normal.classes, sizes, strict=True)
        }

    def shared(self, fit: Fit) -> Floats:
        """Parameters (p,) of a fit common to several joints, zero for the others."""
        last = _BODY * (self.chain.n + len(self.payloads))
        return np.where(np.arange(len(fit.parameters)) < last, fit.parameters, 0.0)

    def along(self, fit: Fit, normal: Normal, errors: Iterable[Sequence[Floats]]) -> Iterator[Size]:
        """Size of each error beside all parameters, with its standard deviation by blocks of rows.

        errors : of each the columns (n, K) for all sets of rows, the change of the computed torques [Nm] by an error
            of size one. Their projection on the parameters is taken off. The deviation of a size includes the prior's.
        """
        solution = factored(normal.total(fit))
        table = []
        for rows in self.rows:
            matrix = self.matrix(rows)
            weight = self.weights(rows, fit)
            left = self.true_torque(rows).T - matrix @ fit.parameters
            table.append((matrix, weight, left))
        for columns in errors:
            shared = np.zeros_like(fit.parameters)
            for (matrix, weight, _), column in zip(table, columns, strict=True):
                for own, c, w in zip(matrix, column, weight, strict=True):
                    if w.any() and c.any():
                        shared += (w * c) @ own
            others = solution(shared)
            parts = [
                (column, column - matrix @ others, weight, left)
                for (matrix, weight, left), column in zip(table, columns, strict=True)
            ]
            # The prior is a row for each of its directions: the error adds `others` to its bodies.
            known = normal.prior.precision @ others * fit.nominal
            den = sum(float(np.sum(weight * rest**2)) for _, rest, weight, _ in parts)
            den = max(den + float(known @ others), 1e-300)
            along = sum(float(np.sum(weight * rest * left)) for _, rest, weight, left in parts)
            size = (along + float(known @ (fit.parameters - normal.prior.mean))) / den
            before = after = 0.0
            # Errors of the joints at a time may agree or cancel: by chance, not by law.
            together = apart = 0.0
            for column, rest, weight, left in parts:
                error = left - size * rest
                product = weight * rest * error
                blocks = np.add.reduceat(product, np.arange(0, product.shape[1], BLOCK), axis=1)
                together += float(np.sum(blocks.sum(axis=0) ** 2))
                apart += float(np.sum(blocks**2))
                acting = weight * (column != 0.0)
                before += float(np.sum(acting * left**2))
                after += float(np.sum(acting * error**2))
            left_over = float(np.sqrt(after / before)) if before > 0.0 else 1.0
            variance = max(together, apart) + float(known @ others) / normal.rows
            yield Size(size, float(np.sqrt(variance)) / den, left_over)

    def weights(self, rows: SampledRows, fit: Fit) -> Floats:
        """Weights (n, K) of the rows of all joints, none of a joint at rest."""
        classes = [fit.weight.get((rows.side, joint), 0.0) for joint in range(self.chain.n)]
        return np.asarray(np.array(classes)[:, None] * rows.moving.T)

    def rigid(self, rows: SampledRows, fit: Fit) -> Floats:
        """Torque (n, K) [Nm] of the bodies of a fit."""
        n = self.chain.n
        bodies = fit.parameters[: _BODY * n].reshape(n, _BODY).copy()
        if rows.payload is not None:
            start = _BODY * (n + self.payloads.index(rows.payload))
            bodies[-1] += fit.parameters[start : start + _BODY]
        return np.asarray(torque(self.chain, rows.q, rows.qd, rows.qdd, bodies).T)

    def deviation(self, fit: Fit, normal: Normal, directions: Floats) -> Floats:
        """Standard deviation (m,) of the combinations `directions` (m, p) of the parameters, by blocks of rows
        and the prior's."""
        spreads = np.column_stack([*map(factored(normal.total(fit)), directions)])
        variance = fit.nominal / normal.rows * np.sum(spreads * (normal.prior.precision @ spreads), axis=0)
        for rows in self.rows:
            measured = self.true_torque(rows).T
            for own, true, weight in zip(self.matrix(rows), measured, self.weights(rows, fit), strict=True):
                if weight.any():
                    error = true - own @ fit.parameters
                    product = (own @ spreads) * (weight * error)[:, None]
                    blocks = np.add.reduceat(product, np.arange(0, len(product), BLOCK), axis=0)
                    variance += np.sum(blocks**2, axis=0)
        return np.sqrt(variance)


def _halves(rows: Sequence[SampledRows]) -> Iterator[SampledRows]:
    """The rows by half of their session, by the number of rows of a side."""
    count, seen = Counter[tuple[str, int]](), Counter[tuple[str, int]]()
    for one in rows:
        count[one.side, one.record] += len(one.q)
    for one in rows:
        key = one.side, one.record
        yield from one.halved(count[key] // 2 - seen[key])
        seen[key] += len(one.q)


def _moving(rows: Sequence[SampledRows]) -> list[SampledRows]:
    """The rows, with those at rest of a joint that hardly moves."""
    count = sum(len(one.q) for one in rows)
    hardly = sum(one.moving.sum(axis=0) for one in rows) < _HARDLY * count
    return [replace(one, moving=one.moving | hardly) for one in rows]


def _timed(rows: Sequence[SampledRows]) -> list[SampledRows]:
    """The rows with their times from 0 to 1 of the session."""
    ends: dict[tuple[str, int], tuple[float, float]] = {}
    for one in rows:
        low, high = ends.get((one.side, one.record), (np.inf, -np.inf))
        ends[one.side, one.record] = min(low, float(one.time.min())), max(high, float(one.time.max()))
    return [
        replace(one, time=(one.time - low) / ((high - low) or 1.0))
        for one in rows
        for low, high in (ends[one.side, one.record],)
    ]


def _extended(rows: SampledRows) -> Floats:
    """The measured torques (K, n + 2), a one and the time."""
    return np.column_stack([rows.torque, np.ones(len(rows.torque)), rows.time])


def _transposed(matrices: Floats) -> Floats:
    """Each of the matrices (k, a, b) transposed."""
    return matrices.transpose(0, 2, 1)


def _only(values: Floats, joint: int | None) -> Floats:
    """The rows (n, K) of one joint, or of none; zero in the others."""
    out = np.zeros_like(values)
    if joint is not None:
        out[joint] = values[joint]
    return out
