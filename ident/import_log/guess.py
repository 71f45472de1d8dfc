"""A mapping guessed from the names in a recording, the URDF, and the numbers themselves; for a person to confirm.

Names give the quantities, the URDF the joints. Numbers decide units: dq/dt must be the velocity, positions of most
joints must keep the limits of the URDF, and the mean step of the times must lie between 0.1 ms and 0.1 s (1 s for a
slow motion).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar, cast

import numpy as np
from numpy.typing import NDArray

from fri.errors import ConfigurationError, DataError
from ident.dynamics.urdf import Urdf, read_urdf
from ident.import_log.channels import MOST_MISSING
from ident.import_log.clock import Clocks, in_rows
from ident.import_log.fields import Field, fields
from ident.import_log.mapping import LogMapping, Signal, Transmission, Unit
from ident.import_log.rates import Rates, compare
from ident.import_log.recording import Recording
from ident.import_log.rests import rests, without_gripper
from ident.import_log.turns import unwrapped
from ident.import_log.units import (
    ANGLES,
    RATES,
    beyond_limits,
    close,
    excess,
    in_degrees,
    rate_unit,
    same_in_all,
    unlike,
)
from ident.import_log.unnamed import unnamed_columns
from lwr_driver.configuration import yaml_text
from lwr_driver.listing import Listing, Piece, text_of

_LARGEST_CURRENT_A = 200.0


@dataclass(frozen=True)
class Known:
    """What the user knows beyond the names.

    joints : of the columns, in their order. base, tip : links of the URDF. rate_hz : of a recording without times.
    torque : whether a plain torque is that of the joint's sensor or of the motor, already at the joint.
    torque_constant : of the motors [Nm/A]; gear_ratio : motor turns for one of the joint; one or one a joint.
    """

    joints: tuple[str, ...] = ()
    base: str | None = None
    tip: str | None = None
    rate_hz: float | None = None
    torque: str = "joint"
    torque_constant: tuple[float, ...] = ()
    gear_ratio: tuple[float, ...] = ()


@dataclass(frozen=True)
class Guess:
    """A guessed mapping. rows : quantity, place, unit and reason of each signal; unused : other fields.

    A velocity among the unused ones is followed by the reason.
    """

    HEAD: ClassVar[str] = "# Guessed from the names in "

    source: Path
    mapping: LogMapping
    rows: tuple[tuple[str, str, str, str], ...]
    unused: tuple[str, ...]

    @property
    def text(self) -> str:
        """The mapping file."""
        head = f"{self.HEAD}{self.source.name}; check it. Keys: docs/import_mapping.md\n"
        return head + yaml_text(self.mapping.content())

    def pieces(self) -> list[Piece]:
        """The signals as a table, and the other fields."""
        return [
            f"{self.source.name}: {len(self.mapping.joints)} joint(s) of {self.mapping.robot}",
            Listing(("quantity", "from", "unit", "why"), self.rows),
            *([f"  not used: {', '.join(self.unused)}"] if self.unused else []),
        ]

    def __str__(self) -> str:
        return text_of(self.pieces())


def guess_mapping(source: str | Path, urdf: str | Path, known: Known | None = None) -> Guess:
    """The mapping of the recording `source` for the arm in the URDF.

    source : a text, NPZ or MATLAB file, or a folder of such files.

    Raises DataError if positions, torques or times cannot be told, with what was found and the remedy.
    """
    return _Guesser(Path(source), urdf, known or Known()).guess()


class _Guesser:
    def __init__(self, source: Path, urdf: str | Path, known: Known) -> None:
        if not source.exists():
            raise DataError(f"{source}: no such file or folder")
        self.source, self.urdf, self.known = source, urdf, known
        self.robot: Urdf = read_urdf(urdf)
        movable = [joint.name for joint in self.robot.joints if joint.movable]
        self.fields, self.numbers = _whole_rows(fields(Recording(source), movable))
        self.why: dict[str, str] = {}  # by the names of fields
        if len(self.fields) == 1 and not any(self.fields[0].labels) and self.fields[0].array is None:
            self.fields, self.why = unnamed_columns(self.fields[0], self.robot, known.joints, source)
        self.clocks = Clocks(source, self.fields, self.numbers, known.rate_hz)
        self.rows: list[tuple[str, str, str, str]] = []
        self.used: set[str] = set()
        self.reasons: dict[str, str] = {}

    def guess(self) -> Guess:
        whole, joints, why = self._positions()
        position = self._picked(whole, joints)
        self._require_finite(position)
        unit, reason = self._angle_unit(position, joints, self._best("velocity", joints))
        gripper = False
        if not self.known.joints and self.known.tip is None:
            arm = without_gripper(joints, position.values * ANGLES[unit], self.robot, self.known.base)
            if gripper := len(arm) < len(joints):
                if not set(joints) <= set(position.labels):
                    self._name_columns(len(joints))
                whole = replace(position, labels=joints)
                joints, why = arm, f"{why}, without the gripper at rest"
                position = self._picked(self._best("position", joints) or whole, joints)
        others = (self.known.joints or gripper) and position is not whole
        held = self._rests(whole, joints, unit) if others else {}
        velocity = self._finite(self._best("velocity", joints))
        angle, _ = unwrapped(position.values * ANGLES[unit])
        clock = self.clocks.of(angle, velocity, unit)
        self.rows.append(("time", clock.field.shown if clock.field else "", clock.unit, clock.why))
        if clock.field:
            self.used.add(clock.field.name)
        rates = None if velocity is None else compare(angle, velocity.values, clock.times)
        if velocity is not None and rates is not None:
            self._one_unit(position, velocity, joints, rates, unit)
        signals: dict[str, Any] = {"position": self._take("position", position, unit, reason)}
        if velocity is not None and rates is not None and velocity.name not in self.reasons:
            signals |= self._velocity(velocity, rates, joints)
        signals |= self._torques(joints)
        self.rows.append(("joints", _span(joints), "", why))
        gear = any(signal.before_gear for signal in signals.values())
        mapping = LogMapping(
            robot=self.robot.name,
            joints=joints,
            time=clock.base,
            urdf=str(Path(self.urdf).resolve()),
            held=held or None,
            base=self.known.base,
            tip=self.known.tip,
            transmission=Transmission(_each("gear_ratio", self.known.gear_ratio, joints)) if gear else None,
            **signals,
        )
        order = ("time", "position", "velocity", "joint_torque", "motor_torque", "joints", "held")
        self.rows.sort(key=lambda row: order.index(row[0]))
        return Guess(self.source, mapping, tuple(self.rows), self._unused())

    def _positions(self) -> tuple[Field, tuple[str, ...], str]:
        """The positions of all recorded joints, the joints of the model, and why it is these."""
        position = self._best("position")
        if position is None:
            raise self._unknown("position")
        joints, why = self._joints(position)
        count = position.values.shape[1]
        if self.known.joints and count > len(joints) and not set(joints) <= set(position.labels):
            self._name_columns(count)
            position = self._best("position") or position
        return position, joints, why

    def _require_finite(self, position: Field) -> None:
        bad = np.flatnonzero(~np.isfinite(position.values).all(axis=1))
        if len(bad):
            raise DataError(
                f"{self.source}: {position.shown} has missing values in {in_rows(len(bad))} of {len(position.values)}, "
                f"first in row {bad[0]}; at most {100.0 * MOST_MISSING:g} % may be: take other columns, or import "
                "a part with `lwr-run import --rows`, each with a mapping file"
            )

    def _velocity(self, velocity: Field, rates: Rates, joints: Sequence[str]) -> dict[str, Signal]:
        """The signal of the velocity, empty with the reason noted where it is no dq/dt."""
        found = rate_unit(rates)
        if found is None:
            odd = rates.unlike.tolist() if len(rates.unlike) < len(joints) else []
            which = f", at {', '.join(joints[k] for k in odd)}" if odd else ""
            self.reasons[velocity.name] = f"not dq/dt of the positions in any unit{which}"
            return {}
        unit, factor = found
        why = f"{factor:.2f} times dq/dt in this unit"
        if same_in_all(rates, factor):
            why += ", in all joints: a clock or a scale is off"
        return {"velocity": self._take("velocity", velocity, unit, why)}

    def _unused(self) -> tuple[str, ...]:
        return tuple(
            f"{one.shown} ({self.reasons[one.name]})" if one.name in self.reasons else one.shown
            for one in self.fields
            if one.name not in self.used
        )

    def _picked(self, position: Field, joints: Sequence[str]) -> Field:
        """The columns of these joints."""
        picked = position.of(joints)
        if picked is None:
            raise DataError(
                f"{self.source}: {position.shown} has {position.values.shape[1]} columns for the {len(joints)} joints "
                f"{', '.join(joints)}; name the joints of the columns with --joints"
            )
        return picked

    def _finite(self, velocity: Field | None) -> Field | None:
        """The velocity without missing values, or None with the reason noted."""
        if velocity is None:
            return None
        bad = np.flatnonzero(~np.isfinite(velocity.values).all(axis=1))
        if not len(bad):
            return velocity
        row = self.numbers[len(velocity.values)][bad[0]]
        self.reasons[velocity.name] = f"missing values in {in_rows(len(bad))}, first in row {row}"
        return None

    def _name_columns(self, count: int) -> None:
        """Call the columns of every field with `count` of them by the joints of the arm."""
        names = self.robot.arm(count=count, root=self.known.base)
        self.fields = [
            replace(one, labels=names) if one.values.shape[1] == count else one for one in self.fields
        ]

    def _rests(self, position: Field, joints: Sequence[str], unit: str) -> dict[str, float]:
        """Positions at rest of recorded joints outside the model, noted in the table."""
        prismatic = {joint.name for joint in self.robot.joints if joint.kind == "prismatic"}
        found = rests(
            self.source,
            position.labels,
            position.values * [1.0 if name in prismatic else ANGLES[unit] for name in position.labels],
            joints,
            self.robot,
            self.known.base,
            self.known.tip,
        )
        still = tuple(name for name in found.held if name not in found.moving)
        for names, why in ((still, "at rest"), (found.moving, "moves, held at its mean")):
            for own, measure in ((set(names) - prismatic, "rad"), (set(names) & prismatic, "m")):
                if own:
                    listed = _span([name for name in names if name in own])
                    self.rows.append(("held", listed, measure, f"{why}, no joint of the model"))
        return found.held

    def _take(
        self, quantity: str, field: Field, unit: str, why: str, constant: tuple[float, ...] = ()
    ) -> Signal:
        """The signal of a field, noted in the table."""
        self.used.add(field.name)
        self.rows.append((quantity, field.shown, unit, self.why.get(field.name, why)))
        return Signal(
            cast(Unit, unit), field.file, field.columns, field.array, torque_constant=constant or None
        )

    def _best(
        self, quantity: str, joints: Sequence[str] | None = None, *, motor: bool | None = None
    ) -> Field | None:
        """The preferred field of a quantity, with columns of these joints, of the motor or not."""
        fitting = [
            fit
            for one in self.fields
            if one.quantity == quantity and (motor is None or one.of_motor == motor)
            if (fit := one if joints is None else one.of(joints)) is not None
        ]
        return max(fitting, key=lambda one: (one.rank, one.values.shape[1]), default=None)

    def _unknown(self, quantity: str) -> DataError:
        listed = "; ".join(f"{one.shown} ({one.values.shape[1]})" for one in self.fields) or "nothing"
        counts = [one.values.shape[1] for one in self.fields if one.quantity == "position"]
        short = next(
            (
                one
                for one in self.fields
                if one.quantity == quantity and one.values.shape[1] < max(counts, default=0)
            ),
            None,
        )
        told = f"no {quantity} by its name"
        if short is not None:
            told = (
                f"{short.shown} are {short.values.shape[1]} columns of {quantity} for {max(counts)} joints; one is "
                "missing or empty"
            )
        return DataError(
            f"{self.source}: {told}. Found, with the number of columns: {listed}. Write a mapping "
            "file for `lwr-run import`; docs/import_mapping.md has its keys and an example"
        )

    def _joints(self, position: Field) -> tuple[tuple[str, ...], str]:
        """Names of the joints and the reason."""
        root = self.known.base
        if self.known.joints:
            self.robot.chain(root, self.known.tip, self.known.joints)
            return self.known.joints, "as given"
        if self.known.tip is not None:
            way = self.robot.chain(root, self.known.tip)
            return tuple(joint.name for joint in way if joint.driven), f"driven joints up to {self.known.tip}"
        if all(position.labels) and not any(label.isdigit() for label in position.labels):
            try:
                way = self.robot.chain(root, None, position.labels)
                named = tuple(joint.name for joint in way if joint.name in position.labels)
                return named, "named in the columns"
            except ConfigurationError:
                return self.robot.arm(names=position.labels, root=root), "the arm named in the columns"
        count = position.values.shape[1]
        return self.robot.arm(count=count, root=root), f"the arm of {count} joints in the URDF"

    def _angle_unit(
        self, position: Field, joints: Sequence[str], velocity: Field | None = None
    ) -> tuple[str, str]:
        """rad or deg, by the name, by the ratio of velocity to dq/dt, or by the limits of the URDF.

        The ratio tells the unit where the two differ. By the limits most joints decide: one beyond them may have a
        reversed sign or another zero. It is told, and the screening of the session judges it.
        """
        words = set(position.words)
        for unit in ("deg", "rad"):
            if words & {unit, f"{unit}ree", f"{unit}ian"}:
                return unit, "by its name"
        by_name = {joint.name: joint for joint in self.robot.joints}
        limits = np.array([by_name[name].limits or (-math.inf, math.inf) for name in joints])
        turning = np.array([by_name[name].kind == "revolute" for name in joints])
        known = "the limits of the URDF" if np.isfinite(limits).any() else "two turns"
        beyond = {unit: beyond_limits(position.values * size, limits) for unit, size in ANGLES.items()}
        unit, reason = "rad", f"{'most joints ' if beyond['rad'].any() else ''}within {known}"
        if velocity is not None and (ratio := self._ratio(position, velocity)) is not None:
            unit = "deg" if ratio < 1.0 else "rad"
            reason = f"{velocity.shown} are {ratio:.3g} times dq/dt"
        elif in_degrees(position.values[:, turning], limits[turning], beyond["rad"][turning]):
            unit, reason = "deg", f"beyond {known} in rad, within them in deg"
        out = beyond[unit]
        # Lengths in m beside angles in deg have no unit in common; a mapping's `scale` can tell them apart.
        if 2 * np.sum(out) >= len(out) or (unit == "deg" and not turning.all()):
            joint = int(np.argmax(excess(position.values, limits)))
            low, high = position.values[:, joint].min(), position.values[:, joint].max()
            raise DataError(
                f"{self.source}: {position.shown} runs from {low:.4g} to {high:.4g} at {joints[joint]}, outside the "
                f"limits {limits[joint, 0]:.4g} to {limits[joint, 1]:.4g} rad in rad and in deg. A motor's angle, or "
                "another zero or order of joints? Write a mapping file for `lwr-run import` (`transmission`, "
                "`offset_rad`, `joints`)"
            )
        if out.any():
            values = position.values * ANGLES[unit]
            listed = ", ".join(
                f"{joints[k]} ({values[:, k].min():.3g} to {values[:, k].max():.3g} rad, limits "
                f"{limits[k, 0]:.3g} to {limits[k, 1]:.3g})"
                for k in np.flatnonzero(out).tolist()
            )
            reason += f"; outside its limits: {listed}"
        return unit, reason

    def _ratio(self, position: Field, velocity: Field) -> float | None:
        """Velocity over dq/dt in the recorded numbers, where it tells the unit of the positions; else None."""
        if len(velocity.values) != len(position.values) or not np.isfinite(velocity.values).all():
            return None
        times = self.clocks.seconds(position, velocity)
        if times is None:
            return None
        rates = compare(position.values, velocity.values, times)
        # A reversed sign says nothing of the unit.
        ratios = replace(rates, product=np.abs(rates.product)).by_channel
        if 2 * np.isfinite(ratios).sum() <= len(ratios):
            return None
        ratio = float(np.nanmedian(ratios))
        degree = RATES["deg/s"]
        told = (1.0 / degree, degree, RATES["rpm"])
        return ratio if any(close(ratio, one) for one in told) else None

    def _one_unit(
        self, position: Field, velocity: Field, joints: Sequence[str], rates: Rates, unit: str
    ) -> None:
        """Raise DataError for a position in another unit than the others, by dq/dt against the velocities.

        A velocity in another unit than the others is left aside, and the reason noted.
        """
        factors = rates.by_channel
        known = np.flatnonzero(np.isfinite(factors))
        if len(known) < 3:
            return
        common = float(np.median(factors[known]))
        off = unlike(factors, common)
        # Of a joint without a clear velocity nothing is known.
        odd, fine = [k for k in known.tolist() if off[k]], [k for k in range(len(joints)) if not off[k]]
        if not odd or 2 * len(odd) >= len(known):
            return
        rest = position.of([joints[k] for k in fine]) if set(joints) <= set(position.labels) else None
        rest = rest or replace(position, values=position.values[:, fine])
        of_rest, _ = self._angle_unit(rest, [joints[k] for k in fine])
        degree = ANGLES["deg"]
        names = ", ".join(joints[k] for k in odd)
        # What the numbers of the odd joints are to be multiplied with, to be like the others.
        for other, size in (("deg", degree), ("rad", 1.0 / degree)):
            like = all(close(factors[k] / common, size) for k in odd)
            if like and other != of_rest:
                scale = ", ".join(f"{size if k in odd else 1.0:.6g}" for k in range(len(joints)))
                raise DataError(
                    f"{self.source}: {position.shown}: {names} in {other}, the other joints in {of_rest}, as dq/dt "
                    f"against {velocity.shown} shows. Write a mapping file for `lwr-run import` with `unit: {of_rest}` "
                    f"and `scale: [{scale}]` in `position`"
                )
        times = ", ".join(f"{factors[k] / common:.3g}" for k in odd)
        self.reasons[velocity.name] = (
            f"{times} times as large over dq/dt at {names} as at the others; `scale` in `velocity` mends it"
        )

    def _torques(self, joints: Sequence[str]) -> dict[str, Signal]:
        """Signals of the torques and currents."""
        plain = self._best("torque", joints, motor=False)
        motor = self._best("torque", joints, motor=True)
        current = self._best("current", joints)
        found: dict[str, Signal] = {}
        if plain is not None and (motor is None or self.known.torque == "joint"):
            key = f"{self.known.torque}_torque"
            why = (
                f"a torque; taken at the {'sensor of the joint' if self.known.torque == 'joint' else 'motor'}"
            )
            found[key] = self._take(key, plain, _torque_unit(plain), why)
        if motor is not None:
            found["motor_torque"] = self._take(
                "motor_torque", motor, _torque_unit(motor), "of the motor, by its name"
            )
        elif current is not None and self.known.torque_constant and "motor_torque" not in found:
            constant = _each("torque_constant", self.known.torque_constant, joints)
            large = bool(np.nanmax(np.abs(current.values)) > _LARGEST_CURRENT_A)
            unit = "mA" if large or "ma" in current.words else "A"
            found["motor_torque"] = self._take("motor_torque", current, unit, "a current", constant)
        if not found and current is not None:
            raise DataError(
                f"{self.source}: {current.shown} is a current; give --torque-constant [Nm/A of the motor] and "
                "--gear-ratio, one number or one for each joint"
            )
        if not found:
            raise self._unknown("torque")
        return found


def _whole_rows(found: list[Field]) -> tuple[list[Field], dict[int, NDArray[np.int64]]]:
    """The fields without the rows that miss a position or a time, and by the number of rows left their numbers.

    Rows stay where half of them would not.
    """
    told = [one for one in found if one.quantity in ("position", "time")] or found
    kept: dict[int, NDArray[np.int64]] = {}
    for count in {len(one.values) for one in found}:
        there = [np.isfinite(one.values) for one in told if len(one.values) == count]
        columns = [own[:, own.mean(axis=0) >= 1.0 - MOST_MISSING] for own in there]
        whole = np.logical_and.reduce([np.ones(count, dtype=bool), *(own.all(axis=1) for own in columns)])
        kept[count] = np.flatnonzero(whole) if whole.mean() >= 1.0 - MOST_MISSING else np.arange(count)
    left = [
        one
        if len(kept[len(one.values)]) == len(one.values)
        else replace(one, values=one.values[kept[len(one.values)]])
        for one in found
    ]
    return left, {len(numbers): numbers for numbers in kept.values()}


def _span(names: Sequence[str]) -> str:
    return names[0] if len(names) == 1 else f"{names[0]} ... {names[-1]}"


def _torque_unit(field: Field) -> str:
    return "mNm" if "mnm" in field.words else "Nm"


def _each(name: str, values: tuple[float, ...], joints: Sequence[str]) -> tuple[float, ...]:
    if len(values) not in (1, len(joints)):
        option = f"--{name.replace('_', '-')}"
        raise ConfigurationError(
            f"{option} has {len(values)} numbers for {len(joints)} joints; give one, or one for each"
        )
    return values * len(joints) if len(values) == 1 else values
