"""Velocities against the positions of their own joints: wrong columns, units and signs, late positions."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from ident.dynamics.parameters import Floats
from ident.rows.content import Recall
from ident.rows.data_quality import position_jumps
from ident.rows.filters import median_step
from ident.screening.doubts import LATE_S, MEND_TIME, MOVED, Doubt
from ident.screening.spikes import spikes
from lwr_driver.session import JointColumns, Session

# Difference of dq/dt and velocity beyond filters and jitter; beyond the second one is a wrong unit.
_SPEEDS, _UNIT = 0.15, 1.5
# Common difference of dq/dt and velocity of all joints: its least value, and the largest spread of the joints over it.
# Real velocities, filtered by their drives, differ by 0.8 % and less.
_COMMON, _SPREAD = 0.03, 0.25
# Blocks of the comparison: least samples, least time [s].
_BLOCK, _BLOCK_S = 5, 0.05
_CORRELATED = 0.9
# Least delay of positions against velocities worth a doubt, in its standard deviations.
_SURE = 5.0
# Velocities over rad/s in other units.
_SPEED_UNITS = {180.0 / np.pi: "deg/s for rad/s", 30.0 / np.pi: "revolutions per minute for rad/s"}


def check_speeds(session: Session, recall: Recall | None = None) -> Iterator[Doubt]:
    """Velocities against the differences of the positions."""
    joint, name = session.joint, session.path.name
    blocks = _speeds(joint, recall)
    if blocks is None:
        return
    inner, slope, change = blocks
    yield from _late(session, inner, slope, change)
    moved = np.flatnonzero(np.ptp(joint.position, axis=0) > MOVED).tolist()
    factors: dict[int, float] = {}
    for k in moved:
        speed, own = slope[:, k], inner[:, k]
        if own.any() and abs(_correlation(speed, own)) >= _CORRELATED:
            factors[k] = float(own @ speed / (speed @ speed))
        else:
            yield from _of_another(session, k, moved, inner, slope)
    wrong = {k: f for k, f in factors.items() if abs(f - 1.0) > _SPEEDS}
    if (doubt := _common_factor(session, factors, wrong)) is not None:
        yield doubt
        return
    for k, factor in wrong.items():
        seen = f"is {factor:.4g} times dq/dt of the position"
        kind = "reversed sign" if abs(factor + 1.0) < _SPEEDS else "wrong unit"
        looks = f"a {kind} of one of the two"
        mend = "check sign and unit of position and velocity of this joint"
        yield Doubt("velocity", (session.joint_names[k],), seen, looks, mend, False, name)


def _of_another(session: Session, k: int, moved: list[int], inner: Floats, slope: Floats) -> Iterator[Doubt]:
    """The velocity of joint `k`, unlike dq/dt: dead, or that of another of the joints that `moved`."""
    names, name = session.joint_names, session.path.name
    if not inner[:, k].any():
        mend = "repair the column, or import the log without velocities"
        seen = "reads 0 while the joint moves"
        yield Doubt("velocity", (names[k],), seen, "a dead channel", mend, False, name)
        return
    related = _correlation(slope[:, k], inner[:, k])
    others = [j for j in moved if j != k and abs(_correlation(slope[:, j], inner[:, k])) > 0.95]
    if others or abs(related) < 0.5:
        looks = f"the velocity of {names[others[0]]}" if others else "another joint or another time"
        seen = f"follows dq/dt of the position with a correlation of {related:.2f}"
        mend = "check the columns of position and velocity of this joint"
        yield Doubt("velocity", (names[k],), seen, looks, mend, bool(others), name)


def _common_factor(session: Session, factors: dict[int, float], wrong: dict[int, float]) -> Doubt | None:
    """One factor of velocity over dq/dt in all joints: another unit, or another pace of the stamps.

    factors : by joint. wrong : those beyond filters and jitter.
    """
    name = session.path.name
    common = float(np.median(list(factors.values()))) if factors else 1.0
    spread = max((abs(f / common - 1.0) for f in factors.values()), default=0.0)
    beside = abs(common - 1.0)
    shared = len(wrong) == len(factors) and spread < _SPEEDS
    if len(factors) < 2 or not (shared or (beside > _COMMON and spread < _SPREAD * beside)):
        return None
    seen = f"the velocities of all joints are {common:.4g} times dq/dt"
    known = [unit for value, unit in _SPEED_UNITS.items() if abs(common / value - 1.0) < _SPEEDS]
    if known:
        joints = tuple(session.joint_names[k] for k in wrong)
        mend = "state the factor of the velocities when importing; the fit does not use them"
        return Doubt("velocity", joints, seen, known[0], mend, False, name)
    looks = f"stamps that pass {common:.4g} times too fast, or velocities in another unit"
    mend = "state the unit of time, or the factor of the velocities, when importing"
    if not shared:
        looks = f"stamps that pass {common:.4g} times too fast, or a wrong scale of the velocities"
        mend = "check the rate of the recording; inertia is wrong by the square of the rate's error"
    return Doubt("time", (), seen, looks, mend, _by_unit(common), name)


def _speeds(joint: JointColumns, recall: Recall | None) -> tuple[Floats, Floats, Floats] | None:
    """Velocities, dq/dt and accelerations (m, J) by the velocities, means over blocks: the first two are exact there.
    None without velocities."""
    if not joint.velocity.shape[1] or len(joint) < 100:
        return None
    clock = joint.publish_time if np.ptp(joint.publish_time) > 0 else joint.log_time
    time = (clock - clock[0]) * 1e-9
    size = max(_BLOCK, int(np.ceil(_BLOCK_S / max(median_step(time), 1e-9))))
    places = np.arange(0, len(time) - 1, size)
    if len(places) < 20:
        return None
    sums = np.vstack([np.zeros(joint.velocity.shape[1]), np.cumsum(joint.velocity, axis=0)])
    # The trapezoidal mean of the velocity over a block is the difference of its positions.
    ends = places[1:]
    inner = (
        sums[ends + 1] - sums[places[:-1]] - 0.5 * (joint.velocity[ends] + joint.velocity[places[:-1]])
    ) / size
    slope = np.diff(joint.position[places], axis=0) / np.diff(time[places])[:, None]
    change = np.gradient(inner, 0.5 * (time[ends] + time[places[:-1]]), axis=0)
    # A jump or a wrong sample says nothing of the speed.
    behind = np.array([jump.behind for jump in position_jumps(joint)], dtype=np.int64)
    whole = np.diff(np.searchsorted(behind, places, side="right")) == 0
    wrong = np.count_nonzero(spikes(joint.position, recall)[places], axis=1)
    whole &= wrong[1:] + wrong[:-1] == 0
    return (inner[whole], slope[whole], change[whole]) if np.isfinite(inner).all() else None


def _late(session: Session, inner: Floats, slope: Floats, change: Floats) -> Iterator[Doubt]:
    """Positions late against their velocities v: dq/dt = v - L dv/dt. Late velocities, such as filtered ones, harm
    nothing: no row is made of them."""
    least, found = max(LATE_S, 1.5 * session.joint.period_s), dict[int, tuple[float, float]]()
    for k in map(int, np.flatnonzero(np.ptp(session.joint.position, axis=0) > MOVED)):
        columns, own = np.column_stack([inner[:, k], -change[:, k]]), slope[:, k]
        (factor, product), _, rank, _ = np.linalg.lstsq(columns, own, rcond=None)
        fit = columns @ np.array([factor, product])
        if rank < 2 or factor <= 0.0 or _correlation(fit, own) < _CORRELATED:
            continue
        variance = float(np.mean((own - fit) ** 2)) * np.linalg.inv(columns.T @ columns)[1, 1]
        late, std = float(product / factor), float(np.sqrt(variance) / factor)
        if late > max(least, _SURE * std):
            found[k] = late, std
    if found:
        k = max(found, key=lambda joint: found[joint][0])
        names = tuple(session.joint_names[joint] for joint in found)
        size = f"{1e3 * found[k][0]:.0f} ± {1e3 * found[k][1]:.1g} ms"
        seen = (
            f"comes {size} after its velocity"
            if len(found) == 1
            else f"come up to {size} after their velocities"
        )
        yield Doubt("position", names, seen, "late positions", MEND_TIME, False, session.path.name)


def _by_unit(factor: float) -> bool:
    return factor < 0.0 or abs(np.log(factor)) > np.log(_UNIT)


def _correlation(a: Floats, b: Floats) -> float:
    size = float(np.linalg.norm(a - a.mean()) * np.linalg.norm(b - b.mean()))
    return float((a - a.mean()) @ (b - b.mean())) / size if size > 0.0 else 0.0
