"""The linear structure of the torque models 1, 2 and 3: columns, rows and the stacked observation matrix.

**Models.** With tau_l the joint torque and tau the motor torque (both after the gear)::

    tau_l = rigid(q, qd, qdd) + Fvl qd + Fcl sign(qd) + offl            joint rows
    tau   = Ia qdd + tau_l + Fvm qd + Fcm sign(qd) + offm               motor rows
    tau - tau_l = Ia qdd + Fvm qd + Fcm sign(qd) + offm                 difference rows

Model 1 has joint rows, Model 2 motor and joint rows, Model 3 difference rows. Other sides can be chosen for an
arm without one of the channels.

**Columns.** The 17 standard parameters of each link in the order of `parameters.PER_LINK`, link after link;
then 17 for each payload, a body of its own (link n + 1, n + 2, ...) in the frame of the last link. Its columns
equal those of link n in sessions with the payload and are zero in the others. Three for each coupling follow.

**Rows.** Session after session in the order given; in a session side after side (motor before joint); in a
side joint after joint; in a joint sample after sample. So `W.reshape` never mixes, and the rows of one joint
and side, with their common error variance, are one contiguous slice (`row_blocks`).

Reference: equations (1) to (8) of Kolyubin, Shiriaev and Jubien, Refining Dynamics Identification for Co-Bots:
Case Study on KUKA LWR4+, 2017; Jubien, Gautier and Janot, Dynamic identification of the Kuka LWR robot using
motor torques and joint torque sensors data, 2014.
"""

from __future__ import annotations

import difflib
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fri.errors import ConfigurationError
from ident.dynamics.kinematics import Chain
from ident.dynamics.parameters import (
    DRIVE,
    INERTIAL,
    LINK_FRICTION,
    PER_LINK,
    Floats,
    parameter_names,
    split_name,
    unit,
)
from ident.dynamics.regressor import check_states, fill_rigid

Side = Literal["motor", "joint", "difference"]
"""Rows of a model: motor torques, joint torques, or their difference."""
TorqueSide = Literal["motor", "joint"]
"""The side of the gear that a measured torque is of."""
EncoderSide = Literal["link", "motor"]
"""The side of an elastic joint that its positions are of."""
MODEL_SIDES: dict[int, tuple[Side, ...]] = {1: ("joint",), 2: ("motor", "joint"), 3: ("difference",)}

_JOINT_TERMS = frozenset(LINK_FRICTION)
_MOTOR_TERMS = frozenset({"Ia", "Fvm", "Fcm", "offm"})
# The signal multiplied by each drive parameter, in the order of the atoms after the rigid ones.
_SIGNALS = ("qdd", "qd", "sign", "one")
_SIGNAL_OF = {"Ia": 0, "Fvl": 1, "Fvm": 1, "Fcl": 2, "Fcm": 2, "offl": 3, "offm": 3}


@dataclass(frozen=True)
class Coulomb:
    """The model's function for sign(qd).

    kind : "sign" (0 at exactly 0), "deadband" (0 up to `width`), "tanh" (tanh(qd / width)).
    width : [rad/s or m/s], positive for the last two.
    """

    kind: Literal["sign", "deadband", "tanh"] = "sign"
    width: float = 0.0

    def __post_init__(self) -> None:
        if self.kind not in ("sign", "deadband", "tanh"):
            raise ConfigurationError(f"Coulomb kind {self.kind!r} is not one of sign, deadband, tanh")
        if self.kind != "sign" and not self.width > 0.0:
            raise ConfigurationError(f"Coulomb {self.kind}: width {self.width} must be positive")

    def __call__(self, speed: Floats) -> Floats:
        """The sign function of `speed`, elementwise."""
        if self.kind == "tanh":
            return np.tanh(speed / self.width)
        if self.kind == "deadband":
            return np.where(np.abs(speed) <= self.width, 0.0, np.sign(speed))
        return np.sign(speed)


@dataclass(frozen=True)
class Coupling:
    """Two joints whose drives are coupled, as in the wrist of the Staubli TX40 (motor side).

    With b the second joint it adds the parameters `Iamb` (row a: qdd_b, row b: qdd_a), `fvmb` (rows a and b:
    qd_a + qd_b) and `fcmb` (rows a and b: sign(qd_a + qd_b)); b is written as the joint's number from 1.
    """

    joints: tuple[str, str]

    @classmethod
    def of(cls, text: str) -> Coupling:
        """The coupling written as `A5:A6`. Raises ConfigurationError for anything else."""
        first, _, second = text.partition(":")
        if not first or not second or first == second:
            raise ConfigurationError(f"coupling {text!r} does not name two joints, such as A5:A6")
        return cls((first, second))


@dataclass(frozen=True, eq=False)
class DriveMotion:
    """Motion of the motors where it differs from the links', as behind elastic joints.

    speed, acceleration : (N, n). slip : (N, n) Coulomb friction of the drives over its level; None: the structure's
    function of the speed.
    """

    speed: Floats
    acceleration: Floats
    slip: Floats | None = None

    def at(self, samples: slice | NDArray[np.bool_] | NDArray[np.int64]) -> DriveMotion:
        """The same at some of the samples."""
        slip = None if self.slip is None else self.slip[samples]
        return DriveMotion(self.speed[samples], self.acceleration[samples], slip)


@dataclass(frozen=True)
class Condition:
    """Payload mounted in a session (None: the bare arm) and its measured sides (None: all of the structure)."""

    payload: str | None = None
    sides: tuple[Side, ...] | None = None


_Plan = tuple[dict[int, tuple[int, int]], list[tuple[int, int, int, int, bool]]]
"""Sources (link, inertial position) of rigid columns; and column, side, joint, atom of the other entries, and whether
they belong to the link."""


@dataclass(frozen=True, eq=False)
class ModelStructure:
    """Columns and rows of a linear torque model for a chain.

    chain : the arm. model : 1, 2 or 3.
    payloads : names of the identified payloads (link n + 1 is the first). A session has one of them or none.
    without : parameters left out of the model: a symbol for all links ("Fvl") or a name for one ("offm3").
    couplings : coupled joints. coulomb : the function for sign(qd).
    sides : other sides than the model's, for an arm without a channel, e.g. ("motor",).

    Raises ConfigurationError for unknown models, names, joints.
    """

    chain: Chain
    model: int = 2
    payloads: tuple[str, ...] = ()
    without: tuple[str, ...] = ()
    couplings: tuple[Coupling, ...] = ()
    coulomb: Coulomb = field(default_factory=Coulomb)
    sides: tuple[Side, ...] = ()

    def __post_init__(self) -> None:
        if self.model not in MODEL_SIDES:
            raise ConfigurationError(f"model {self.model!r} does not exist; choose 1, 2 or 3")
        if not self.sides:
            object.__setattr__(self, "sides", MODEL_SIDES[self.model])
        order = ("motor", "joint", "difference")
        unknown = [side for side in self.sides if side not in order]
        if unknown or len(set(self.sides)) != len(self.sides):
            raise ConfigurationError(f"sides {self.sides!r} are not a choice of {', '.join(order)}")
        object.__setattr__(self, "sides", tuple(sorted(self.sides, key=order.index)))
        if len(set(self.payloads)) != len(self.payloads):
            raise ConfigurationError(f"payload names {', '.join(self.payloads)} repeat; each must be unique")
        for coupling in self.couplings:
            for joint in coupling.joints:
                self._joint(joint)
        _ = self.active

    def _joint(self, name: str) -> int:
        if name not in self.chain.joint_names:
            raise ConfigurationError(
                f"`couplings` names joint {name!r}, not one of {', '.join(self.chain.joint_names)}"
            )
        return self.chain.joint_names.index(name)

    @property
    def n_links(self) -> int:
        """Number of bodies: the links of the arm and the payloads."""
        return self.chain.n + len(self.payloads)

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of all columns: 17 a link and payload, three a coupling."""
        coupled = []
        for coupling in self.couplings:
            number = self._joint(coupling.joints[1]) + 1
            coupled += [f"Iam{number}", f"fvm{number}", f"fcm{number}"]
        return parameter_names(self.n_links) + tuple(coupled)

    @cached_property
    def units(self) -> tuple[str, ...]:
        """SI units of all columns."""
        kinds = [*self.chain.prismatic, *([False] * len(self.payloads))]
        return tuple(unit(name, prismatic=bool(kinds[split_name(name)[1] - 1])) for name in self.names)

    @property
    def n_columns(self) -> int:
        """Number of all columns, those left out included (their columns are zero)."""
        return len(self.names)

    @cached_property
    def active(self) -> NDArray[np.bool_]:
        """(n_columns,) whether each parameter is in the model, not left out by `without`."""
        mask = np.ones(self.n_columns, dtype=bool)
        symbols = [split_name(name)[0] for name in self.names]
        for item in self.without:
            hits = [k for k, name in enumerate(self.names) if item in (name, symbols[k])]
            if not hits:
                known = sorted({*self.names, *symbols})
                near = difflib.get_close_matches(item, known, n=1)
                advice = f"did you mean {near[0]!r}?" if near else f"symbols: {', '.join(PER_LINK)}"
                raise ConfigurationError(f"`without` names {item!r}, not a parameter of this model; {advice}")
            mask[hits] = False
        mask.setflags(write=False)
        return mask

    def index(self, name: str) -> int:
        """Column of the parameter `name`. Raises ConfigurationError for an unknown name."""
        if name not in self.names:
            near = difflib.get_close_matches(name, self.names, n=1)
            advice = f"; did you mean {near[0]!r}?" if near else ""
            raise ConfigurationError(f"the model has no parameter {name!r}{advice}")
        return self.names.index(name)

    def payload_link(self, payload: str | None) -> int | None:
        """Position of the payload among the bodies, counted from 0 (n for the first), or None for None."""
        if payload is None:
            return None
        if payload not in self.payloads:
            known = ", ".join(self.payloads) or "none"
            raise ConfigurationError(f"payload {payload!r} is not in this model (payloads: {known})")
        return self.chain.n + self.payloads.index(payload)

    def conditions(self) -> tuple[Condition, ...]:
        """The bare arm, then each payload mounted, all sides."""
        return (Condition(), *(Condition(payload) for payload in self.payloads))

    def condition_sides(self, condition: Condition) -> tuple[Side, ...]:
        """Sides of a condition in row order. Raises ConfigurationError for a side missing in the structure."""
        if condition.sides is None:
            return self.sides
        foreign = [side for side in condition.sides if side not in self.sides]
        if foreign or not condition.sides:
            raise ConfigurationError(f"sides {condition.sides!r} are not a choice of {', '.join(self.sides)}")
        return tuple(side for side in self.sides if side in condition.sides)

    # ---- atoms: the distinct signals of all columns ----

    @cached_property
    def n_signals(self) -> int:
        """Number of non-rigid atoms: qdd, qd, sign(qd), 1 and three for each coupling."""
        return len(_SIGNALS) + 3 * len(self.couplings)

    def signals(self, qd: Floats, qdd: Floats, out: Floats, slip: Floats | None = None) -> None:
        """Write the non-rigid atoms, from qd and qdd (N, n), to `out` (n_signals, n, N).

        slip : (N, n) in place of sign(qd).
        """
        turned = self.coulomb(qd) if slip is None else slip
        out[0], out[1], out[2], out[3] = qdd.T, qd.T, turned.T, 1.0
        out[4:] = 0.0
        for number, coupling in enumerate(self.couplings):
            a, b = (self._joint(name) for name in coupling.joints)
            first = len(_SIGNALS) + 3 * number
            both = qd[:, a] + qd[:, b]
            out[first, a], out[first, b] = qdd[:, b], qdd[:, a]
            out[first + 1, a] = out[first + 1, b] = both
            out[first + 2, a] = out[first + 2, b] = self.coulomb(both)

    def signal_of(self, column: int, side: Side, joint: int) -> int | None:
        """The non-rigid atom of `column` in the rows of `side` and `joint`; None for zero."""
        if not self.active[column]:
            return None
        link, position = divmod(column, len(PER_LINK))
        if link >= self.n_links:
            coupled, part = divmod(column - len(PER_LINK) * self.n_links, 3)
            involved = {self._joint(name) for name in self.couplings[coupled].joints}
            return len(_SIGNALS) + 3 * coupled + part if side != "joint" and joint in involved else None
        symbol = PER_LINK[position]
        if link != joint or symbol in INERTIAL:
            return None
        present = {
            "motor": symbol in DRIVE,
            "joint": symbol in _JOINT_TERMS,
            "difference": symbol in _MOTOR_TERMS,
        }
        return _SIGNAL_OF[symbol] if present[side] else None

    def rigid_of(self, column: int, payload: str | None) -> tuple[int, int] | None:
        """(link, inertial position) of the arm's rigid column in `column`; None for zero."""
        link, position = divmod(column, len(PER_LINK))
        if not self.active[column] or link >= self.n_links or position >= len(INERTIAL):
            return None
        if link < self.chain.n:
            return link, position
        return (self.chain.n - 1, position) if self.payload_link(payload) == link else None

    def of_drive(self, column: int) -> bool:
        """Whether a column follows the motion of the motors where it is not that of the links."""
        link, place = divmod(int(column), len(PER_LINK))
        return link >= self.n_links or PER_LINK[place] not in (*INERTIAL, *_JOINT_TERMS)

    # ---- the stacked matrix ----

    @cached_property
    def _plans(self) -> dict[tuple[bytes, str | None, tuple[Side, ...]], _Plan]:
        return {}

    def _plan(self, wanted: bytes, payload: str | None, sides: tuple[Side, ...]) -> _Plan:
        """Where the entries of a matrix of the columns `wanted` (int64) come from, found once."""
        key = wanted, payload, sides
        if key not in self._plans:
            columns = np.frombuffer(wanted, dtype=np.int64).tolist()
            rigid = {c: self.rigid_of(column, payload) for c, column in enumerate(columns)}
            entries = []
            for c, column in enumerate(columns):
                link, place = divmod(column, len(PER_LINK))
                if link < self.n_links and place < len(INERTIAL):
                    continue
                of_link = not self.of_drive(column)
                for s, side in enumerate(sides):
                    for joint in range(self.chain.n):
                        atom = self.signal_of(column, side, joint)
                        if atom is not None:
                            entries.append((c, s, joint, atom, of_link))
            self._plans[key] = {c: source for c, source in rigid.items() if source is not None}, entries
        return self._plans[key]

    def regressor(
        self,
        q: ArrayLike,
        qd: ArrayLike,
        qdd: ArrayLike,
        *,
        payload: str | None = None,
        sides: Sequence[Side] | None = None,
        columns: ArrayLike | None = None,
        drive: DriveMotion | None = None,
        out: Floats | None = None,
    ) -> Floats:
        """Observation matrix of one session: (sides x n x N, C) float64, Fortran-ordered.

        q, qd, qdd : (N, n). payload : the mounted payload. sides : default all of the structure.
        columns : (C,) indices of columns (default all n_columns), e.g. those of a base set.
        drive : motion of the motors, for the columns of the drives; default that of the links.
        out : (C, sides, n, N) to write into: zeros, or those of an earlier result for the same payload, sides and
            columns.
        Row order: side, joint, sample (see the module).
        """
        position, speed, acceleration = check_states(self.chain, q, qd, qdd)
        chosen = self.condition_sides(Condition(payload, tuple(sides) if sides is not None else None))
        wanted = np.arange(self.n_columns) if columns is None else np.asarray(columns, dtype=np.int64)
        if wanted.ndim != 1 or np.any((wanted < 0) | (wanted >= self.n_columns)):
            raise ConfigurationError(f"columns must be a list of indices below {self.n_columns}")
        n, samples = self.chain.n, len(position)
        shape = (len(wanted), len(chosen), n, samples)
        if out is None:
            out = np.zeros(shape)
        elif out.shape != shape:
            raise ConfigurationError(f"`out` has shape {out.shape}; expected {shape}")
        sources, entries = self._plan(wanted.tobytes(), payload, chosen)
        # Difference rows have no rigid part and are never preceded by other sides (side order).
        rigid_sides = [s for s, side in enumerate(chosen) if side != "difference"]
        if rigid_sides and sources:
            first = np.full((n, len(INERTIAL)), -1, dtype=np.int64)
            for c, source in sources.items():
                if first[source] < 0:
                    first[source] = c
            fill_rigid(self.chain, position, speed, acceleration, first, out)
            for c, source in sources.items():
                if first[source] != c:
                    out[c, 0] = out[first[source], 0]
                for s in rigid_sides[1:]:
                    out[c, s] = out[c, 0]
        signals = np.empty((self.n_signals, n, samples))
        self.signals(speed, acceleration, signals)
        moved = signals
        if drive is not None:
            moved = np.empty_like(signals)
            self.signals(drive.speed, drive.acceleration, moved, drive.slip)
        for c, side_number, joint, atom, of_link in entries:
            out[c, side_number, joint] = (signals if of_link else moved)[atom, joint]
        return out.reshape(len(wanted), -1).T
