"""Base parameters from the modified-DH constants alone, by the rules of Khalil, Bennis and Gautier.

The rigid part works on the links' energies. From the last link to the first, parameters indistinguishable by the
motion of a joint are moved to the link before it:

* revolute joint j: a body symmetric about z_j without inertia about it (YY_j = XX_j, MZ_j, M_j) moves in the
  same way when fixed to link j-1. So YY_j, MZ_j and M_j are regrouped into link j-1, and XX_j - YY_j stays;
* prismatic joint j: link j turns with link j-1, so its six inertia entries are regrouped there.

Near the base, with r1 the first revolute joint and r2 the first revolute joint not parallel to it:

* prismatic, j < r1: the link does not turn, so its first moments have no effect;
* revolute, r1 <= j < r2: of the tensor only ZZ_j acts; MX_j and MY_j act unless their axis is fixed along gravity;
* prismatic, r1 < j < r2: the first moment along z_r1 has no effect (one of MX_j, MY_j, MZ_j is regrouped into
  the others); when z_j is parallel to z_r1, MX_j and MY_j are regrouped into link j-1.

One function of the motion remains for each rigid base parameter. Some are quadratic forms of the joint speeds
with constant coefficients plus a constant force (ZZ_r1 is qd_r1^2 / 2), like the functions of the drive
inertias and offsets. Written in this form they show the regrouped drive parameters (Ia_r1 into ZZ_r1, Ia_r2
into ZZ_r2 when z_r2 is perpendicular to z_r1, the prismatic ones). The stack of sessions, sides and payloads is
then a small matrix of constants; its independent columns are the base parameters. A payload is body n + 1,
welded to link n while mounted.

Reference: Gautier and Khalil, Direct calculation of minimum set of inertial parameters of serial robots, IEEE
Trans. Robotics and Automation 6(3), 1990; Khalil, Bennis and Gautier, The use of the generalized links to
determine the minimum inertial parameters of robots, J. Robotic Systems 7(2), 1990; Khalil and Dombre 2002,
section 9.4.2.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fri.errors import ConfigurationError
from ident.dynamics.base_set import BaseSet, base_set
from ident.dynamics.kinematics import Chain
from ident.dynamics.parameters import INERTIAL, PER_LINK, Floats, frame_change
from ident.dynamics.structure import Condition, ModelStructure, Side

_SAME = 1e-9
_YY, _ZZ, _MX, _MY, _MZ, _M = 3, 5, 6, 7, 8, 9


def closed_form_base(structure: ModelStructure, conditions: Sequence[Condition] | None = None) -> BaseSet:
    """Base parameters of the stack of `conditions` (default: the bare arm and every payload, all sides).

    Raises ConfigurationError for a chain without gravity, not covered by the rules.
    """
    stack = tuple(conditions) if conditions is not None else structure.conditions()
    if not stack:
        raise ConfigurationError(
            "no condition was given; at least one session's payload and sides are needed"
        )
    rigid = _Rigid(structure.chain)
    rows = [
        _coordinates(structure, rigid, condition.payload, side)
        for condition in stack
        for side in structure.condition_sides(condition)
    ]
    return base_set(structure, stack, np.concatenate(rows), tolerance=_SAME, zero=1e-12, method="closed form")


@dataclass(frozen=True, eq=False)
class _Axes:
    """Directions of the axes up to r2, independent of q, for the special rules near the base.

    r1 : first revolute joint (n if none). r2 : first revolute joint not parallel to it (n if none).
    r3 : first revolute joint after r2 not parallel to r2 (n if none).
    along : (n,) cosine between z_j and z_r1, for j <= r2. second : (n,) the same with z_r2, for r2 <= j < r3.
        axis : (n, 3) z_r1 in frame j, for r1 <= j < r2. frames : orientation of frame j in frame 0 at q = 0.
    """

    r1: int
    r2: int
    r3: int
    along: Floats
    second: Floats
    axis: Floats
    frames: tuple[Floats, ...]

    @classmethod
    def of(cls, chain: Chain) -> _Axes:
        n = chain.n
        r1 = next((j for j in range(n) if not chain.prismatic[j]), n)
        # Orientation of frame j in frame 0 with all joints at zero; before r2 it turns about z_r1 only.
        turn, frames = np.eye(3), []
        for j in range(n):
            turn = turn @ chain.placement(j)[:3, :3]
            frames.append(turn)
        z1 = frames[r1][:, 2] if r1 < n else np.zeros(3)
        along = np.array([float(frame[:, 2] @ z1) for frame in frames])
        r2 = next((j for j in range(r1 + 1, n) if not chain.prismatic[j] and abs(along[j]) < 1 - _SAME), n)
        z2 = frames[r2][:, 2] if r2 < n else np.zeros(3)
        second = np.array([float(frame[:, 2] @ z2) for frame in frames])
        r3 = next((j for j in range(r2 + 1, n) if not chain.prismatic[j] and abs(second[j]) < 1 - _SAME), n)
        return cls(r1, r2, r3, along, second, np.array([frame.T @ z1 for frame in frames]), tuple(frames))


class _Rigid:
    """The rigid base functions of a chain.

    regrouping : (f, 10 n), each function's coefficient on the standard inertial parameters.
    constants : for each function, None or its constant form.
    """

    def __init__(self, chain: Chain) -> None:
        if np.linalg.norm(chain.gravity) < _SAME:
            raise ConfigurationError(
                "the closed-form rules assume gravity, and the chain has none; use `numeric_base` instead"
            )
        self.chain = chain
        self.axes = _Axes.of(chain)
        n = chain.n
        # effective[j] : (10, 10 n), the parameters of link j after regrouping, on the standard ones.
        effective = np.zeros((n, 10, 10 * n))
        for j in range(n):
            effective[j, :, 10 * j : 10 * j + 10] = np.eye(10)
        self.kept: list[tuple[int, int]] = []
        rows = []
        for j in range(n - 1, -1, -1):
            stays = self._regroup(effective, j)
            self.kept += [(j, position) for position in stays]
            rows += [effective[j, position] for position in stays]
        self.regrouping = np.array(rows).reshape(-1, 10 * n)

    def _regroup(self, effective: Floats, j: int) -> list[int]:
        """Regroup the parameters of link j into link j-1; return the remaining parameters of link j."""
        chain, axes = self.chain, self.axes
        own, moved = effective[j], np.zeros((10, effective.shape[2]))
        stays = list(range(10))
        if chain.prismatic[j]:
            moved[:6] = own[:6]
            stays = [_MX, _MY, _MZ, _M]
            if j < axes.r1:
                stays = [_M]
            elif j < axes.r2:
                stays = self._first_moments(own, moved, j)
        else:
            symmetric = own[_YY].copy()
            moved[0] = moved[_YY] = symmetric
            moved[_MZ], moved[_M] = own[_MZ], own[_M]
            own[0] -= symmetric
            stays = [k for k in stays if k not in (_YY, _MZ, _M)]
            if j < axes.r2:
                stays = [_ZZ] if self._stands_still(j) else [_ZZ, _MX, _MY]
        if j > 0:
            effective[j - 1] += frame_change(chain.placement(j)) @ moved
        return stays

    def _first_moments(self, own: Floats, moved: Floats, j: int) -> list[int]:
        """Prismatic link between r1 and r2: the remaining first moments after regrouping (and the mass)."""
        a = np.where(np.abs(self.axes.axis[j]) < _SAME, 0.0, self.axes.axis[j])
        if abs(self.axes.along[j]) > 1 - _SAME:
            moved[_MX], moved[_MY] = own[_MX], own[_MY]
            return [_M]
        pivot = next(k for k in (2, 1, 0) if a[k] != 0.0)
        eliminated = own[_MX + pivot].copy()
        for k in range(3):
            own[_MX + k] -= a[k] / a[pivot] * eliminated
        return [*(_MX + k for k in range(3) if k != pivot), _M]

    def _stands_still(self, j: int) -> bool:
        """Whether the axis of revolute joint j < r2 is fixed in space and lies along gravity."""
        chain, axes = self.chain, self.axes
        gravity = axes.frames[axes.r1].T @ chain.gravity
        if np.hypot(gravity[0], gravity[1]) > _SAME * np.linalg.norm(chain.gravity):
            return False
        for k in range(j):
            if chain.prismatic[k] and abs(axes.along[k]) < 1 - _SAME:
                return False
        # The axes of the revolute joints before j must be the same line as axis j: no offset across z.
        offset = np.zeros(3)
        for k in range(j, axes.r1, -1):
            pose = chain.placement(k)
            offset = pose[:3, :3] @ offset + pose[:3, 3]
            z = self.axes.axis[k - 1]
            across = offset - z * float(z @ offset)
            if not chain.prismatic[k - 1] and np.linalg.norm(across) > _SAME:
                return False
        return True

    def constant_forms(self) -> list[tuple[int, Floats, Floats]]:
        """Identities (pivot, coefficients (f,) on the functions, constant form (n, n + 1)).

        A constant form stands for the energy qd' A qd / 2 and the constant forces b: [A, b]. The pivot is the
        function of the highest link in the relation.
        """
        chain, axes, n = self.chain, self.axes, self.chain.n
        relations = []

        def relate(j: int, coefficients: Floats, form: Floats) -> None:
            own = np.array([link == j for link, _ in self.kept])
            relations.append((int(np.argmax(np.abs(coefficients) * own)), coefficients, form))

        for j in range(n):
            form = np.zeros((n, n + 1))
            if not chain.prismatic[j] and j < axes.r3:
                # The link's speed about z_j: the joints parallel to r1, then those parallel to r2.
                turning = np.zeros(n)
                for k in range(axes.r1, j + 1):
                    if not chain.prismatic[k]:
                        turning[k] = axes.along[k] if k < axes.r2 else axes.second[k]
                if j >= axes.r2:
                    turning[: axes.r2] *= axes.along[axes.r2]
                form[:, :n] = np.outer(turning, turning)
                relate(j, self._function(j, _ZZ), form)
            elif chain.prismatic[j] and j < axes.r1:
                directions = np.zeros((n, 3))
                directions[: j + 1] = [frame[:, 2] for frame in axes.frames[: j + 1]]
                form[:, :n] = directions @ directions.T
                form[:, n] = -directions @ chain.gravity
                relate(j, self._function(j, _M), form)
            elif chain.prismatic[j] and axes.r1 < j < axes.r2:
                if abs(axes.along[j]) > 1 - _SAME:
                    relate(j, self._beyond(j, _M), self._axial(j))
                else:
                    across = np.array([-axes.axis[j][1], axes.axis[j][0]])
                    sine = float(np.hypot(*across))
                    both = np.where(chain.prismatic, 0.0, axes.along)
                    both[: axes.r1], both[j:] = 0.0, 0.0
                    form[j, :n] = form[:n, j] = sine * both
                    moments = across[0] * self._beyond(j, _MX) + across[1] * self._beyond(j, _MY)
                    relate(j, moments / sine, form)
        return relations

    def _function(self, j: int, position: int) -> Floats:
        """A parameter of link j on the base functions."""
        return self.regrouping[:, 10 * j + position]

    def _beyond(self, j: int, position: int) -> Floats:
        """The function of a parameter of link j minus that of the same, fixed to link j-1 at q_j = 0."""
        carried = frame_change(self.chain.placement(j))[:, position]
        return self._function(j, position) - self.regrouping[:, 10 * (j - 1) : 10 * j] @ carried

    def _axial(self, j: int) -> Floats:
        """Energy of a unit mass from its speed along z_r1 at link j minus that at link j-1, and its weight."""
        chain, axes, n = self.chain, self.axes, self.chain.n
        speed = np.array([axes.along[k] if chain.prismatic[k] and k <= j else 0.0 for k in range(n)])
        before = np.where(np.arange(n) < j, speed, 0.0)
        form = np.zeros((n, n + 1))
        form[:, :n] = np.outer(speed, speed) - np.outer(before, before)
        form[j, n] = -float(axes.frames[axes.r1][:, 2] @ chain.gravity) * axes.along[j]
        return form


def _coordinates(structure: ModelStructure, rigid: _Rigid, payload: str | None, side: Side) -> Floats:
    """(g, n_columns): every column of the rows of one condition and side on independent functions.

    Functions: the rigid base functions, constant quadratic forms (n, n), constant forces (n), and for each
    joint qd and sign(qd); then two for each coupling.
    """
    chain = structure.chain
    n, f, size = chain.n, len(rigid.kept), len(PER_LINK)
    forms = rigid.constant_forms()
    base, count = f, f + n * (n + 1) + 2 * n + 2 * len(structure.couplings)
    matrix = np.zeros((count, structure.n_columns))
    for column in range(structure.n_columns):
        source = structure.rigid_of(column, payload) if side != "difference" else None
        if source is not None:
            matrix[:f, column] = rigid.regrouping[:, 10 * source[0] + source[1]]
    _rewrite(matrix[:f], matrix[base : base + n * (n + 1)], forms)
    for column in range(structure.n_columns):
        link, position = divmod(column, size)
        if link >= structure.n_links:
            coupled, part = divmod(column - size * structure.n_links, 3)
            joints = [j for j in range(n) if structure.signal_of(column, side, j) is not None]
            if joints and part == 0:
                # Row a has qdd_b and row b has qdd_a: the energy qd_a qd_b.
                a, b = joints
                matrix[base + a * (n + 1) + b, column] = matrix[base + b * (n + 1) + a, column] = 1.0
            elif joints:
                matrix[base + n * (n + 1) + 2 * n + 2 * coupled + part - 1, column] = 1.0
        elif link < n and position >= len(INERTIAL):
            signal = structure.signal_of(column, side, link)
            if signal is not None:
                matrix[_signal_row(base, n, link, signal), column] = 1.0
    return matrix


def _signal_row(base: int, n: int, joint: int, signal: int) -> int:
    """Row of qdd (a quadratic form), 1 (a constant force), qd or sign(qd) of a joint."""
    if signal == 0:
        return base + joint * (n + 1) + joint
    if signal == 3:
        return base + joint * (n + 1) + n
    return base + n * (n + 1) + (signal - 1) * n + joint


def _rewrite(functions: Floats, constants: Floats, forms: list[tuple[int, Floats, Floats]]) -> None:
    """Replace functions with a constant form by it (in place).

    A relation is coefficients . functions = form. The function of its highest link is replaced by the form and
    the functions of lower links, so the relations are taken from the last link to the first.
    """
    for pivot, coefficients, form in reversed(forms):
        amount = functions[pivot] / coefficients[pivot]
        functions -= np.outer(coefficients, amount)
        functions[pivot] = 0.0
        constants += np.outer(form.ravel(), amount)
