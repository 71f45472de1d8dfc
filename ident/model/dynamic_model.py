"""The identified dynamic model: structure, parameter values with covariance, effects and provenance."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fri.errors import ConfigurationError
from ident.dynamics import regressor
from ident.dynamics.base_set import BaseSet
from ident.dynamics.parameters import INERTIAL, PER_LINK, Floats
from ident.dynamics.structure import Condition, DriveMotion, ModelStructure, Side
from ident.dynamics.tables import Tabular
from ident.effects import check_entry, effects_torque, find_effect
from ident.effects.motion import ArmMotion

Projection = Callable[["DynamicModel", Floats], Floats]
"""From a model and its nearest standard parameters (n_columns,) to consistent ones with the same torque."""

_LINK = len(PER_LINK)
_BODY = len(INERTIAL)


@dataclass(frozen=True, eq=False)
class DynamicModel(Tabular):
    """Parameter values of a model structure, the content of `model.yaml`.

    robot : name of the arm.
    structure : chain, model number, columns.
    names : (p,) names of the parameters with a value, base names (`ZZ2R`) or standard ones; the others are 0.
    values : (p,). covariance : (p, p) or None.
    base : the base set of base parameters, None for standard parameters.
    provenance : origin of the values (sessions, estimator, date, software), plain content for YAML.
    effects : entries of further effects (`ident.effects`): cause, side, joints, parameters. They are part of
        `torque`, not of the regressor.

    Raises ConfigurationError for unknown or repeated names and for wrong shapes.
    """

    robot: str
    structure: ModelStructure
    names: tuple[str, ...]
    values: Floats
    covariance: Floats | None = None
    base: BaseSet | None = None
    provenance: Mapping[str, Any] = field(default_factory=dict)
    effects: tuple[Mapping[str, Any], ...] = ()

    def __post_init__(self) -> None:
        count = len(self.names)
        if len(set(self.names)) != count:
            repeated = next(name for name in self.names if self.names.count(name) > 1)
            raise ConfigurationError(f"parameter {repeated!r} appears twice; give each parameter once")
        values = np.array(self.values, dtype=np.float64)
        if values.shape != (count,) or not np.all(np.isfinite(values)):
            raise ConfigurationError(
                f"{count} parameter names need as many finite values, found {values.shape}"
            )
        values.setflags(write=False)
        object.__setattr__(self, "values", values)
        if self.covariance is not None:
            covariance = np.array(self.covariance, dtype=np.float64)
            if covariance.shape != (count, count) or not np.all(np.isfinite(covariance)):
                raise ConfigurationError(
                    f"the covariance of {count} parameters must be finite and {count} x {count}, "
                    f"found {covariance.shape}"
                )
            covariance.setflags(write=False)
            object.__setattr__(self, "covariance", covariance)
        if self.base is not None and self.base.structure is not self.structure:
            raise ConfigurationError("the base set belongs to another structure than the model")
        _ = self.positions
        for entry in self.effects:
            check_entry(entry, self.structure.chain.n)

    def records(self) -> list[dict[str, Any]]:
        """One row for each parameter: name, unit, value, and std with a covariance."""
        std = self.std
        return [
            {"name": name, "unit": unit, "value": float(self.values[k])}
            | ({} if std is None else {"std": float(std[k])})
            for k, (name, unit) in enumerate(zip(self.names, self.units, strict=True))
        ]

    def __repr__(self) -> str:
        known = "with" if self.covariance is not None else "without"
        lines = [
            f"Dynamic model of {self.robot}: Model {self.structure.model}, {len(self.names)} {self.kind} "
            f"parameters {known} covariance",
            f"  {self.structure.chain.n} joints {' '.join(self.structure.chain.joint_names)}; torque of "
            f"{' and '.join(self.structure.sides)} side",
        ]
        if self.structure.payloads:
            lines.append(f"  payloads: {', '.join(self.structure.payloads)}")
        if self.effects:
            lines.append(f"  effects: {', '.join(str(entry['cause']) for entry in self.effects)}")
        sessions = self.provenance.get("sessions", ())
        if isinstance(sessions, (list, tuple)) and sessions:
            lines.append(f"  identified by {self.provenance.get('estimator')}, sessions: {len(sessions)}")
        return "\n".join(lines)

    @cached_property
    def positions(self) -> NDArray[np.int64]:
        """(p,) positions of the parameters: rows of the base set, or standard columns."""
        find = self.structure.index if self.base is None else self.base.index
        found = np.array([find(name) for name in self.names], dtype=np.int64)
        if len(set(found.tolist())) != len(found):
            repeated = next(name for k, name in enumerate(self.names) if found[k] in found[:k])
            raise ConfigurationError(f"parameter {repeated!r} appears twice under two names; give it once")
        found.setflags(write=False)
        return found

    @property
    def kind(self) -> Literal["base", "standard"]:
        """Kind of the parameters."""
        return "standard" if self.base is None else "base"

    @property
    def std(self) -> Floats | None:
        """(p,) standard deviations, or None without a covariance."""
        return None if self.covariance is None else np.sqrt(np.diag(self.covariance))

    @property
    def units(self) -> tuple[str, ...]:
        """SI units of the parameters."""
        table = self.structure.units if self.base is None else self.base.units
        return tuple(table[position] for position in self.positions)

    @property
    def columns(self) -> NDArray[np.int64]:
        """(p,) columns of the structure's regressor multiplied by the values."""
        return self.positions if self.base is None else self.base.columns[self.positions]

    def value(self, name: str) -> float:
        """Value of a parameter, 0 without one in the model. Raises ConfigurationError for unknown names."""
        find = self.structure.index if self.base is None else self.base.index
        hits = np.flatnonzero(self.positions == find(name))
        return float(self.values[hits[0]]) if len(hits) else 0.0

    @cached_property
    def standard(self) -> Floats:
        """(n_columns,) standard parameters with this model's torque, for base parameters of smallest norm.

        Torque, mass matrix and gravity depend on the base parameters only, so these suffice for simulation. See
        `standard_parameters` for others.
        """
        return self.standard_parameters()

    def standard_parameters(
        self, prior: ArrayLike | None = None, *, project: Projection | None = None
    ) -> Floats:
        """Standard parameters (n_columns,) with this model's torque.

        prior : (n_columns,) desired parameters (CAD); the nearest with the right torque are returned. Without
            it those of smallest norm.
        project : turns them into physically consistent ones, e.g. by a convex program over the unobservable
            directions (the null space of `base.matrix`).
        """
        if self.base is None:
            vector = np.zeros(self.structure.n_columns)
            vector[self.positions] = self.values
        else:
            full = np.zeros(len(self.base))
            full[self.positions] = self.values
            vector = self.base.expand(full, prior)
        return vector if project is None else project(self, vector)

    def inertial(self, payload: str | None = None, *, standard: Floats | None = None) -> Floats:
        """(n, 10) inertial parameters of the arm's links, the payload (if mounted) added to the last link.

        standard : (n_columns,) standard parameters to take instead of `self.standard`.
        """
        vector = self.standard if standard is None else standard
        n = self.structure.chain.n
        bodies = vector[: _LINK * n].reshape(n, _LINK)[:, :_BODY].copy()
        link = self.structure.payload_link(payload)
        if link is not None:
            bodies[-1] += vector[_LINK * link : _LINK * link + _BODY]
        return bodies

    def loaded(self, payload: str | None) -> bool:
        """Whether effects of the payload act with this one mounted; always in a model without payloads."""
        return payload is not None or not self.structure.payloads

    @property
    def remembers(self) -> bool:
        """Whether its torque may follow from the motion more than seconds ago."""
        return any(find_effect(str(entry["cause"])).remembers for entry in self.effects)

    def drive(self) -> dict[str, Floats]:
        """Drive parameters by symbol (`Ia`, `Fvl`, ..., `offm`), each (n,)."""
        n = self.structure.chain.n
        table = self.standard[: _LINK * n].reshape(n, _LINK)[:, _BODY:]
        return {symbol: table[:, k].copy() for k, symbol in enumerate(PER_LINK[_BODY:])}

    def torque(
        self,
        q: ArrayLike,
        qd: ArrayLike,
        qdd: ArrayLike,
        *,
        payload: str | None = None,
        side: Side | None = None,
        time: ArrayLike | None = None,
        measured: bool = False,
        drive: DriveMotion | None = None,
    ) -> Floats:
        """Inverse dynamics (N, n) [Nm, N] of one side (default the structure's first), equations (1) to (4),
        with the model's effects.

        q, qd, qdd : (N, n). payload : the payload mounted, one of the structure's. time : (N,) [s], evenly
        spaced, for effects with a memory; default 1 ms steps. measured : add the errors of the sensors.
        drive : motion of the motors behind elastic joints; default that of the links.
        """
        position, speed, acceleration = regressor.check_states(self.structure.chain, q, qd, qdd)
        chosen = self.structure.sides[0] if side is None else side
        linear_torque = partial(
            self.linear_torque, position, speed, acceleration, payload=payload, drive=drive
        )
        torque: Floats = linear_torque(side=chosen)
        if self.effects:
            linear: dict[str, Floats] = {chosen: torque}
            for of in set(self.structure.sides) - {chosen, "difference"}:
                linear[of] = linear_torque(side=of)
            stamps: Floats = np.arange(len(position), dtype=np.float64) * 1e-3
            if time is not None:
                stamps = np.asarray(time, dtype=np.float64)
            moved = drive or DriveMotion(speed, acceleration)
            motion = self._motion(position, speed, acceleration, moved, linear, payload, stamps)
            torque = torque + effects_torque(self.effects, motion, side=chosen, measured=measured)
        return torque

    def _motion(
        self,
        q: Floats,
        qd: Floats,
        qdd: Floats,
        moved: DriveMotion,
        linear: Mapping[str, Floats],
        payload: str | None,
        time: Floats,
    ) -> ArmMotion:
        """The motion as the effects see it.

        moved : of the motors. linear : torque (N, n) of the linear model by side.
        """
        chain, drive = self.structure.chain, self.drive()
        bodies = self.inertial(payload)
        joint = linear.get("joint")
        if joint is None:
            joint = regressor.torque(chain, q, qd, qdd, bodies)
        stamps = time - time[0] if len(time) else time

        def friction(speed: Floats) -> Floats:
            return drive["Fvm"] * speed + drive["Fcm"] * np.sign(speed)

        return ArmMotion(
            chain=chain,
            bodies=bodies,
            session=1,
            time=stamps,
            duration_s=float(stamps[-1]) if len(stamps) else 0.0,
            q=q,
            qd=qd,
            qdd=qdd,
            motor_speed=moved.speed,
            motor_acceleration=moved.acceleration,
            joint_torque=joint,
            motor_torque=linear.get("motor", joint),
            gear_ratio=np.ones(chain.n),
            inertia=drive["Ia"],
            link_coulomb=drive["Fcl"],
            motor_coulomb=drive["Fcm"],
            friction=friction,
            slip=self.structure.coulomb(moved.speed) if moved.slip is None else moved.slip,
            loaded=self.loaded(payload),
        )

    def linear_torque(
        self,
        q: ArrayLike,
        qd: ArrayLike,
        qdd: ArrayLike,
        *,
        payload: str | None = None,
        side: Side | None = None,
        drive: DriveMotion | None = None,
    ) -> Floats:
        """Inverse dynamics (N, n) of the linear model, without its effects; arguments as in `torque`."""
        chosen = self.structure.sides[0] if side is None else side
        chosen = self.structure.condition_sides(Condition(payload, (chosen,)))[0]
        position, speed, acceleration = regressor.check_states(self.structure.chain, q, qd, qdd)
        of_links, of_drives = self._signal_weights[chosen]
        signals = np.empty((self.structure.n_signals, self.structure.chain.n, len(position)))
        self.structure.signals(speed, acceleration, signals)
        if drive is None:
            torque = np.einsum("jk,kjs->sj", of_links + of_drives, signals)
        else:
            torque = np.einsum("jk,kjs->sj", of_links, signals)
            self.structure.signals(drive.speed, drive.acceleration, signals, drive.slip)
            torque += np.einsum("jk,kjs->sj", of_drives, signals)
        if chosen != "difference":
            torque += regressor.torque(
                self.structure.chain, position, speed, acceleration, self.inertial(payload)
            )
        return torque

    @cached_property
    def _signal_weights(self) -> dict[Side, Floats]:
        """For each side, (2, n, n_signals) factors of qdd, qd, sign(qd), 1 and the couplings' signals, those of the
        links' motion and those of the motors'."""
        table: dict[Side, Floats] = {}
        for side in self.structure.sides:
            weights = np.zeros((2, self.structure.chain.n, self.structure.n_signals))
            for column in np.flatnonzero(self.standard):
                for joint in range(self.structure.chain.n):
                    signal = self.structure.signal_of(int(column), side, joint)
                    if signal is not None:
                        of_drive = int(self.structure.of_drive(int(column)))
                        weights[of_drive, joint, signal] += self.standard[column]
            table[side] = weights
        return table

    def gravity(self, q: ArrayLike, *, payload: str | None = None) -> Floats:
        """Gravity torque (N, n) of the links and the payload; offsets are not included."""
        return regressor.gravity_torque(self.structure.chain, q, self.inertial(payload))

    def mass_matrix(self, q: ArrayLike, *, payload: str | None = None, drives: bool = False) -> Floats:
        """Mass matrix (N, n, n) of links and payload; `drives` adds the drive inertias (motor side)."""
        matrix = regressor.mass_matrix(self.structure.chain, q, self.inertial(payload))
        if drives:
            matrix += np.diag(self.drive()["Ia"])
            for k, coupling in enumerate(self.structure.couplings):
                a, b = (self.structure.chain.joint_names.index(name) for name in coupling.joints)
                value = self.standard[_LINK * self.structure.n_links + 3 * k]
                matrix[:, a, b] += value
                matrix[:, b, a] += value
        return matrix

    def regressor(
        self,
        q: ArrayLike,
        qd: ArrayLike,
        qdd: ArrayLike,
        *,
        payload: str | None = None,
        sides: Sequence[Side] | None = None,
    ) -> Floats:
        """Observation matrix (sides x n x N, p) of the parameters with a value."""
        return self.structure.regressor(q, qd, qdd, payload=payload, sides=sides, columns=self.columns)

    def torque_std(
        self,
        q: ArrayLike,
        qd: ArrayLike,
        qdd: ArrayLike,
        *,
        payload: str | None = None,
        side: Side | None = None,
    ) -> Floats:
        """Standard deviation (N, n) of the predicted torque from the covariance of the parameters.

        Raises ConfigurationError when the model has no covariance.
        """
        if self.covariance is None:
            raise ConfigurationError(f"the model of {self.robot} has no covariance, so no torque uncertainty")
        chosen = self.structure.sides[0] if side is None else side
        matrix = self.regressor(q, qd, qdd, payload=payload, sides=(chosen,))
        variance = np.einsum("ij,ij->i", matrix @ self.covariance, matrix)
        return np.sqrt(np.maximum(variance, 0.0)).reshape(self.structure.chain.n, -1).T
