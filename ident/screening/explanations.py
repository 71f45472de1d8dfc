"""Explanations of contradictory data: single changes of a channel that make the data of an arm agree.

Each is a common mistake of people and programs: the sign of a channel, its unit or gain, two
interchanged joints, a zero offset, the pace of time, the label of a payload, an arm on a wall. It is undone in the rows
of `Redundancy` and judged by the fall of the score, the sum over joints and sides of log(residual / torque). The best
one is taken, and the search goes on in the mended data, because two channels may be wrong.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np

from ident.dynamics.parameters import Floats
from ident.screening.nominal import nominal
from ident.screening.normal_equations import DEVIATIONS, Class, Fit, Normal, Part
from ident.screening.parts import GAIN, LEFT, PartError, part_errors, scopes
from ident.screening.positions import session_offsets
from ident.screening.redundancy import Gain, Redundancy

# Ratios of units often mixed up, with their names.
UNITS = {
    1000.0: "a unit 1000 times too small, such as mNm for Nm",
    0.001: "a unit 1000 times too large, such as kNm for Nm",
    180.0 / np.pi: "degrees for radians",
    np.pi / 180.0: "radians taken for degrees",
    60.0: "per minute for per second",
    1.0 / 60.0: "per second for per minute",
}
"""Factor of the recorded over the true value, and its usual cause."""
TORQUE_UNITS = {factor: name for factor, name in UNITS.items() if "unit" in name}
"""The same of torques, which are no angles."""
_NEAR = 0.1
AGREES = 0.1
"""Residual over torque of an arm whose channels agree; beyond it explanations are sought."""
DOUBT, CERTAIN = float(np.log(10.0)), float(np.log(100.0))
"""Fall of the score for a doubt: the product of all residuals falls to a tenth; for certainty, to a hundredth. Wrong
explanations of healthy recordings reach 1.6 (two joints of a real LWR4+ with torques of 0.3 Nm), true faults 5."""
# Units, signs and other joints' torques are tried in parts of the data beyond this residual over torque of a joint.
_CONTRADICTS = 0.3
_POSITION_GAINS = (0.5, 0.7, 0.85, 1.2, 1.4, 2.0)
_PACES = (0.25, 0.5, 2.0 / 3.0, 0.8, 1.25, 1.5, 2.0, 4.0)
# Least fall of the score for a measured factor in place of a plain one.
_FINER = 0.1
# Most corrections of a gain.
_ROUNDS = 8
# Relative standard deviation of bodies from the URDF's; logarithm of the odds for excluding a gain.
_STATED, _ODDS = 0.2, float(np.log(10.0))
_OFFSETS = (-np.pi, -0.5 * np.pi, 0.5 * np.pi)
# Rounds of fitting, and how many candidates go on after them, the last ones to be fitted to the end.
_SIEVE = (1, 32), (3, 8)
# Rows for each parameter, for motions.
_ENOUGH = 6.0


@dataclass(frozen=True)
class Explanation:
    """A change of a channel: its name, the mended rows, and the fall of the score.

    channel : as in `Doubt`. factor : recorded over true value, for a change of scale. gain : of a torque. parts,
    error : the parts of the data with it, and its size there. label : number of the session with another payload.
    alike : the same of other sessions, or gains of other joints, which explain the data as well.
    """

    channel: str
    joints: tuple[int, ...]
    looks_like: str
    mended: Redundancy
    drop: float = 0.0
    factor: float = 1.0
    gain: Gain | None = None
    label: str = ""
    error: PartError | None = None
    parts: tuple[Part, ...] = ()
    alike: tuple[Explanation, ...] = ()


def unit_of(factor: float, *, torque: bool = False) -> str:
    """The usual cause of a factor between recorded and true value, of a `torque` or of a position."""
    if factor < 0.0:
        rest = unit_of(-factor, torque=torque)
        return "a reversed sign" if abs(factor + 1.0) < 0.5 else f"a reversed sign and {rest}"
    for known, name in (TORQUE_UNITS if torque else UNITS).items():
        if abs(np.log(factor / known)) < _NEAR:
            return name
    return f"a gain of {factor:.3g}"


def explain(
    data: Redundancy, fit: Fit, normal: Normal, believed: Callable[[Explanation, int], bool]
) -> list[Explanation]:
    """Explanations, the strongest first, until the rows as mended by the last one contradict themselves no more.

    believed : of an explanation and the number of classes, whether it gains enough.
    """
    found: list[Explanation] = []
    for _ in range(data.chain.n):
        gains = data.gains(fit, normal)
        if not _contradicts(data, fit, normal, gains):
            break
        best = _best(data, fit, normal, gains, believed)
        # What is left of a mended channel is the coarseness of its mending.
        if best is None or any(one.channel == best.channel and one.joints == best.joints for one in found):
            break
        found.append(best)
        data = best.mended
        normal = data.normal()
        fit = data.fit(normal)
    return found


def _contradicts(data: Redundancy, fit: Fit, normal: Normal, gains: Mapping[Class, Gain]) -> bool:
    """Whether a joint disagrees with the others, a gain is wrong, or a part of the data has an error of its own."""
    return (
        max(fit.rho.values()) > AGREES
        or any(map(is_wrong, gains.values()))
        or bool(part_errors(data, fit, normal))
    )


def _best(
    data: Redundancy,
    fit: Fit,
    normal: Normal,
    gains: Mapping[Class, Gain],
    believed: Callable[[Explanation, int], bool],
) -> Explanation | None:
    before, tried = fit.score, []

    def scored(candidate: Explanation) -> tuple[Explanation, Fit]:
        # Torques are mapped; other changes make other rows.
        mapped = candidate.channel.endswith("torque")
        after = candidate.mended.fit(normal if mapped else None, doubtful=False)
        return replace(candidate, drop=before - after.score), after

    for candidate in _likely(_torques(data, gains), normal):
        one, after = scored(candidate)
        tried.append(one)
        if believed(one, len(normal.classes)) and max(after.rho.values()) < AGREES:
            break
    else:
        # Each asks for regressors of its own: of few rows first.
        few = data.thinned(_ENOUGH)
        tried += [scored(candidate)[0] for candidate in _likely(_motions(data), tries=_motions(few))]
    tried += [scored(candidate)[0] for candidate in _likely(_of_parts(data, fit, normal), normal)]
    tried = [one for one in tried if believed(one, len(normal.classes))]
    for _, best in sorted(enumerate(tried), key=_rank, reverse=True):
        if best.channel == "payload":
            # Of two sessions with one label the one carries more, or the other less.
            others = {
                one.label: one for one in reversed(tried) if one.channel == "payload" and _alike(one, best)
            }
            return replace(
                best, alike=tuple(one for label, one in sorted(others.items()) if label != best.label)
            )
        if best.gain is None or len(best.joints) > 1:
            return _refined(best, before, normal)
        settled = _measured_again(best, before, normal)
        if settled is not None:
            return _likeliest(settled, _rivals(data, best, gains), before, normal)
    return None


def _rivals(data: Redundancy, best: Explanation, gains: Mapping[Class, Gain]) -> Iterator[Explanation]:
    """Gains of the other joints on the side, whatever they leave of the joint's own residual; none of a sign."""
    for (side, joint), gain in gains.items() if best.factor > 0.0 else ():
        other = best.channel == f"{side} torque" and joint not in best.joints
        if other and _is_off(gain) and gain.value > 0.0:
            yield _gain_of(data, side, joint, gain)


def _likeliest(
    best: Explanation, rivals: Iterable[Explanation], before: float, normal: Normal
) -> Explanation:
    """The gain with bodies nearest to the URDF's, and the others not excluded by the bodies.

    A torque too large at one joint, and torques too small at all joints with the same bodies, fit alike.
    """
    others = [_measured_again(one, before, normal) for one in rivals]
    alike = [best, *(one for one in others if one is not None and one.drop > best.drop - _FINER)]
    if len(alike) == 1:
        return best
    data = best.mended
    stated = replace(normal, prior=nominal(data.chain, data.width, _STATED))
    odds = [-normal.rows * one.mended.fit(stated, doubtful=False).cost for one in alike]
    first, *rest = sorted(zip(odds, range(len(alike)), strict=True), reverse=True)
    return replace(alike[first[1]], alike=tuple(alike[k] for odd, k in rest if first[0] - odd < _ODDS))


def _alike(one: Explanation, best: Explanation) -> bool:
    return one.drop > best.drop - _FINER


def _rank(numbered: tuple[int, Explanation]) -> tuple[float, bool, int]:
    """Order of explanations: by their drop, a session before its half, all data before a part of them.

    Of equal parts the later one comes first: a channel was whole before it broke.
    """
    number, one = numbered
    drop = round(one.drop - _FINER * (len(one.parts) == 1), 2)
    return drop, not one.parts, number if one.parts else -number


def _torques(data: Redundancy, gains: Mapping[Class, Gain]) -> Iterator[Explanation]:
    yield from sorted(_torque_gains(data, gains), key=lambda one: -len(one.joints))
    for (side, joint), gain in gains.items():
        for factor in (-1.0, 1e3, 1e-3):
            if is_wrong(gain) and abs(gain.value / factor - 1.0) < _NEAR:
                # Measured above, with its deviation.
                continue
            scale = np.eye(data.chain.n)
            scale[joint, joint] = 1.0 / factor
            mended = data.mapped(side, scale)
            yield Explanation(f"{side} torque", (joint,), unit_of(factor, torque=True), mended, 0.0, factor)
    for side in data.sides:
        for a, b in _pairs(data):
            if (side, a) not in data.silent and (side, b) not in data.silent:
                mended = data.mapped(side, _exchange(data, a, b))
                yield Explanation(f"{side} torque", (a, b), "the two joints interchanged", mended)


def _of_parts(data: Redundancy, fit: Fit, normal: Normal) -> Iterator[Explanation]:
    """A torque with another gain, zero, unit or joint in a session or half of one, or with a drift."""
    eye = np.eye(data.chain.n)
    doubtful = set()
    for one in part_errors(data, fit, normal):
        side, joint = one.key
        doubtful.add((one.key, one.parts))
        if one.kind == "gain":
            yield _scaled_part(data, one.key, one.parts, one.value, one)
        else:
            looks, along = ("another zero", (1.0, 0.0)) if one.kind == "zero" else ("a drift", (0.0, 1.0))
            mended = data.mapped(side, eye, -one.value * np.outer(eye[joint], along), one.parts)
            yield Explanation(f"{side} torque", (joint,), looks, mended, error=one, parts=one.parts)
    for key in (key for key, rho in fit.rho.items() if rho > _CONTRADICTS):
        doubtful |= {(key, parts) for parts in scopes(normal.parts)}
    for offset in session_offsets(data, fit, normal):
        yield Explanation("position", (offset.joint,), offset.looks_like, offset.mended, parts=offset.parts)
    pairs = set()
    for (side, joint), parts in sorted(doubtful):
        yield from (_scaled_part(data, (side, joint), parts, factor) for factor in (-1.0, 1e3, 1e-3))
        others = (
            other for other in range(data.chain.n) if other != joint and (side, other) not in data.silent
        )
        pairs |= {(side, min(joint, other), max(joint, other), parts) for other in others}
    for side, a, b, parts in sorted(pairs):
        mended = data.mapped(side, _exchange(data, a, b), parts=parts)
        yield Explanation(f"{side} torque", (a, b), "the two joints interchanged", mended, parts=parts)


def _scaled_part(
    data: Redundancy, key: Class, parts: tuple[Part, ...], factor: float, error: PartError | None = None
) -> Explanation:
    scale = np.eye(data.chain.n)
    scale[key[1], key[1]] = 1.0 / factor
    mended = data.mapped(key[0], scale, parts=parts)
    return Explanation(
        f"{key[0]} torque",
        (key[1],),
        unit_of(factor, torque=True),
        mended,
        factor=factor,
        error=error,
        parts=parts,
    )


def _likely(
    candidates: Iterable[Explanation],
    normal: Normal | None = None,
    tries: Iterable[Explanation] | None = None,
) -> list[Explanation]:
    """The candidates with a measured size, and the others with the least residuals after a few rounds.

    normal : of torques, as for `Redundancy.fit`. tries : the candidates in other rows, to be tried in their place.
    """
    candidates = list(candidates)
    tries = candidates if tries is None else list(tries)
    sized = {number for number, one in enumerate(candidates) if one.gain is not None or one.error is not None}
    likely = [number for number in range(len(candidates)) if number not in sized]
    # The rows of a motion take longer to make than to fit, so these are tried once.
    for rounds, most in _SIEVE[-1:] if normal is None else _SIEVE:
        left = {
            number: tries[number].mended.fit(normal, doubtful=False, rounds=rounds).score for number in likely
        }
        likely = sorted(likely, key=lambda number: left[number])[:most]
    return [candidates[number] for number in sorted(sized.union(likely))]


def _motions(data: Redundancy) -> Iterator[Explanation]:
    yield from _mountings(data)
    yield from _positions(data)
    yield from (_paced(data, factor) for factor in _PACES)
    yield from _labels(data)


def _torque_gains(data: Redundancy, gains: Mapping[Class, Gain]) -> Iterator[Explanation]:
    for side in data.sides:
        own = {joint: gain for (where, joint), gain in gains.items() if where == side}
        wrong = {joint: gain for joint, gain in own.items() if is_wrong(gain)}
        yield from (_gain_of(data, side, joint, gain) for joint, gain in wrong.items())
        middle = float(np.median([gain.value for gain in wrong.values()])) if wrong else 1.0
        alike = [joint for joint, gain in wrong.items() if abs(gain.value / middle - 1.0) < 0.3]
        if len(alike) > max(1, len(own) // 2):
            scale = np.diag([1.0 / middle if joint in alike else 1.0 for joint in range(data.chain.n)])
            yield Explanation(
                f"{side} torque", tuple(alike), unit_of(middle, torque=True), data.mapped(side, scale), 0.0, middle,
                wrong[alike[0]],
            )  # fmt: skip


def _gain_of(data: Redundancy, side: str, joint: int, gain: Gain) -> Explanation:
    scale = np.eye(data.chain.n)
    scale[joint, joint] = 1.0 / gain.value
    small = abs(gain.value) < 3.0 * gain.std
    looks = "a torque in a unit far too large, or none" if small else unit_of(gain.value, torque=True)
    return Explanation(f"{side} torque", (joint,), looks, data.mapped(side, scale), 0.0, gain.value, gain)


def is_wrong(gain: Gain) -> bool:
    """Whether a gain is off by more than a calibration and its deviation, and mending it helps."""
    return _is_off(gain) and gain.left < LEFT


def _is_off(gain: Gain) -> bool:
    return abs(gain.value - 1.0) > max(GAIN, DEVIATIONS * gain.std) and gain.value != 0.0


def _pairs(data: Redundancy) -> list[tuple[int, int]]:
    n = data.chain.n
    return [(a, b) for a in range(n) for b in range(a + 1, n)]


def _exchange(data: Redundancy, a: int, b: int) -> Floats:
    order = np.arange(data.chain.n)
    order[[a, b]] = b, a
    return np.eye(data.chain.n)[order]


def moved(data: Redundancy, matrix: Floats, offset: Floats | float = 0.0) -> Redundancy:
    """True positions = measured ones times `matrix` (n, n), plus `offset` (n,)."""
    rows = tuple(part.moved(part.q @ matrix + offset, matrix) for part in data.rows)
    return replace(data, rows=rows)


def _positions(data: Redundancy) -> Iterator[Explanation]:
    n = data.chain.n
    for a, b in _pairs(data):
        if data.chain.prismatic[a] == data.chain.prismatic[b]:
            mended = moved(data, _exchange(data, a, b))
            yield Explanation("position", (a, b), "the two joints interchanged", mended)
    for joint in range(n):
        factors = (-1.0, *_POSITION_GAINS, *((180.0 / np.pi, np.pi / 180.0, 0.5 / np.pi, 2.0 * np.pi)))
        for factor in factors:
            yield _position_gain(data, (joint,), factor)
        for angle in () if data.chain.prismatic[joint] else _OFFSETS:
            offset = np.zeros(n)
            offset[joint] = -angle
            looks = f"a zero offset of {np.degrees(angle):.0f} deg"
            yield Explanation("position", (joint,), looks, moved(data, np.eye(n), offset))
    for factor in (-1.0, 180.0 / np.pi, np.pi / 180.0):
        yield _position_gain(data, tuple(range(n)), factor)


def _mountings(data: Redundancy) -> Iterator[Explanation]:
    """Gravity along any axis of the base: an arm on a wall or under a ceiling."""
    size = float(np.linalg.norm(data.chain.gravity))
    for axis in np.vstack([np.eye(3), -np.eye(3)]) if size else ():
        along = data.chain.base_placement[:3, :3].T @ axis
        if along @ data.chain.gravity > 0.9 * size:
            continue
        looks = (
            f"gravity along {axis.astype(int).tolist()} in the axes of the URDF's root: a wall or a ceiling"
        )
        yield Explanation(
            "mounting", (), looks, replace(data, chain=replace(data.chain, gravity=size * along))
        )


def _position_gain(data: Redundancy, joints: tuple[int, ...], factor: float) -> Explanation:
    scale = np.diag([1.0 / factor if joint in joints else 1.0 for joint in range(data.chain.n)])
    return Explanation("position", joints, unit_of(factor), moved(data, scale), 0.0, factor)


def _paced(data: Redundancy, factor: float) -> Explanation:
    """Recorded time over true time is `factor`."""
    rows = tuple(part.at_pace(factor) for part in data.rows)
    looks = (
        f"time that passes about {factor:.2g} times {'as fast' if factor < 1 else 'too fast'} in the stamps"
    )
    return Explanation("time", (), looks, replace(data, rows=rows), 0.0, factor)


def _labels(data: Redundancy) -> Iterator[Explanation]:
    records = sorted({part.record for part in data.rows})
    labels = {part.record: part.payload for part in data.rows}
    if len(records) < 2:
        return
    for record in records:
        named = sorted({label for label in labels.values() if label is not None})
        for label in (label for label in (None, *named, "another payload") if label != labels[record]):
            rows = tuple(replace(p, payload=label) if p.record == record else p for p in data.rows)
            looks = (
                "no payload" if label is None else f"payload {label!r}" if label in labels.values() else label
            )
            yield Explanation("payload", (), looks, replace(data, rows=rows), label=str(record))


def _measured_again(candidate: Explanation, before: float, normal: Normal) -> Explanation | None:
    """The gain of a torque, measured again in the mended data while it helps.

    The wrong channel had bent the bodies behind the first measurement. None where the gain does not settle: the bodies
    then fit the torque the better, the smaller it is.
    """
    moved = 1.0
    for _ in range(_ROUNDS):
        better = _corrected(candidate, before, normal)
        moved = better.factor / candidate.factor
        if better.drop <= candidate.drop:
            break
        candidate = better
    return candidate if abs(moved - 1.0) < GAIN else None


def _corrected(candidate: Explanation, before: float, normal: Normal) -> Explanation:
    (joint,), data = candidate.joints, candidate.mended
    side = candidate.channel.removesuffix(" torque")
    fit = data.fit(normal, doubtful=False)
    more = data.gains(fit, normal)[side, joint].value
    assert candidate.gain is not None
    scale = np.eye(data.chain.n)
    scale[joint, joint] = 1.0 / more if more > 0.0 else 1.0
    mended = data.mapped(side, scale)
    drop = before - mended.fit(normal, doubtful=False).score
    factor = candidate.factor * more
    gain = replace(candidate.gain, value=factor, std=candidate.gain.std * more)
    named = candidate.looks_like == unit_of(candidate.factor, torque=True)
    looks_like = unit_of(factor, torque=True) if named else candidate.looks_like
    return replace(candidate, factor=factor, gain=gain, looks_like=looks_like, mended=mended, drop=drop)


def _refined(candidate: Explanation, before: float, normal: Normal) -> Explanation:
    """The gain of a position or the pace of time by steps around the coarse value, each half the last."""
    if abs(candidate.factor) == 1.0 or candidate.channel not in ("position", "time"):
        return candidate
    best, step = candidate, 0.2
    for _ in range(8):
        for relative in (np.exp(step), np.exp(-step)):
            # Undone on the mended rows, so the search is relative to them.
            data = best.mended
            position = best.channel == "position"
            trial = _position_gain(data, best.joints, relative) if position else _paced(data, relative)
            drop = before - trial.mended.fit(doubtful=False).score
            if drop > best.drop + _FINER:
                factor = best.factor * relative
                looks = unit_of(factor) if position else _paced(data, factor).looks_like
                best = replace(trial, drop=drop, factor=factor, looks_like=looks)
                break
        else:
            step *= 0.5
    return best
