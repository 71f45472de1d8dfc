"""The nominal arm: rows of the base model at the full bandwidth of the channels, and its predictions.

Each side keeps its own sample times. Joint torque and its regressor are averaged over short bins. A slower motor
torque gives one row per sample, with the regressor at the same instant. Both operations are linear and act on torque
and regressor alike, so neither adds a bias. A row depends on the samples of its bin only, so standstill and reversals
spoil few rows.

The drive's own columns (Ia, Fvm, Fcm) belong to the motor, apart from the link by the twist of the joint. The twist
follows from the predicted torque, so no sensor's noise or error leaks from one side to the other.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ident.diagnosis.rows.broken_data import unseen
from ident.diagnosis.rows.nominal_arm import NominalArm
from ident.diagnosis.rows.nominal_motion import Predictor
from ident.diagnosis.rows.parts import Piece, gather
from ident.diagnosis.rows.recording import TRAVEL_RAD, RecordStretch, SessionRecord
from ident.diagnosis.rows.row_grid import RowGrid
from ident.diagnosis.rows.side_rows import RowMaker, SideRows
from ident.diagnosis.settings import DiagnosisSettings
from ident.dynamics.base_set import BaseSet, numeric_base
from ident.dynamics.structure import Condition, ModelStructure, Side
from ident.effects import Column, effects_torque
from ident.effects.motion import ArmMotion, Floats, in_order
from ident.effects.nameless import KNOTS, knot_places
from ident.model.dynamic_model import DynamicModel
from lwr_driver.session.spool import spans

# Samples of a motion in work together, and least share in use for a slice of them.
_TOGETHER, _DENSE = 2**14, 0.6
# Samples without use between two parts of a motion.
_GAP = 1000


def structure_of(arm: NominalArm, recordings: Sequence[SessionRecord]) -> tuple[ModelStructure, BaseSet]:
    """Columns for the sessions' payloads and sides."""
    payloads = tuple(dict.fromkeys(r.payload for r in recordings if r.payload is not None))
    motor = any(r.has_motor for r in recordings)
    left_out = unseen(recordings, arm.chain) if motor else ()
    structure = ModelStructure(arm.chain, 2 if motor else 1, payloads, left_out, arm.couplings)
    conditions = dict.fromkeys(Condition(r.payload, r.sides) for r in recordings)
    return structure, numeric_base(structure, tuple(conditions))


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
    _pieces: dict[tuple[str, ...], list[list[Piece]]] = field(default_factory=dict, init=False, repr=False)
    _made: dict[str, tuple[Sequence[ArmMotion], SideRows]] = field(
        default_factory=dict, init=False, repr=False
    )

    def __post_init__(self) -> None:
        predictor = self._predictor
        self.motions = self.motions or in_order([predictor.motion(r, s, s.effort) for r, s in self.stretches])
        self._make_rows()

    @cached_property
    def grid(self) -> RowGrid:
        """The rows of the recordings."""
        delays = {"joint": self.arm.joint_delay_s, "motor": self.arm.motor_delay_s}
        return RowGrid(self.recordings, self.bin_s, self.settings.most_s, delays)

    @property
    def stretches(self) -> list[tuple[SessionRecord, RecordStretch]]:
        """Recording and stretch of each motion."""
        return self.grid.stretches

    @property
    def sides(self) -> tuple[str, ...]:
        """Sides with rows."""
        return self.grid.sides

    @property
    def bin_s(self) -> float:
        """Length of a bin [s]."""
        return max(self.settings.bin_s, self.settings.ringing_s if self.arm.encoder == "motor" else 0.0)

    @property
    def _predictor(self) -> Predictor:
        bare = all(r.payload is None for r in self.recordings)
        return Predictor(self.arm, self.settings.deflection_hz, bare)

    @property
    def held_out(self) -> bool:
        """Whether there are held-out recordings."""
        return any(r.test for r in self.recordings)

    @cached_property
    def moving(self) -> NDArray[np.bool_]:
        """Joints (n,) in motion in the fitted sessions; the torque of the others has no rows."""
        fitted = [s.q for r, s in self.stretches if not r.test]
        travel = np.max([np.ptp(q, axis=0) for q in fitted], axis=0) if fitted else np.zeros(self.arm.chain.n)
        return np.asarray(travel > TRAVEL_RAD)

    def refine(self, values: Floats) -> None:
        """Predict the torques with the base parameters (b,) and make the rows anew."""
        model = DynamicModel("arm", self.structure, self.base.names, values, None, self.base)
        predictor, drive = self._predictor, model.drive()
        bodies = {payload: model.inertial(payload) for payload in {r.payload for r in self.recordings}}
        self.motions = in_order(
            [
                predictor.again(before, recording, stretch, bodies[recording.payload], drive)
                for before, (recording, stretch) in zip(self.motions, self.stretches, strict=True)
            ]
        )
        self._pieces.clear()
        self._make_rows()

    @property
    def slow_motor_samples(self) -> bool:
        """Whether motor torques come with a clock of their own, slower than that of the positions."""
        return any(s.own_clock for _, s in self.stretches)

    @property
    def masses(self) -> dict[str, float | None]:
        """Announced mass [kg] of each payload."""
        return {r.payload: r.payload_mass for r in self.recordings if r.payload is not None}

    # ---- rows ----

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
                            rows[side, k] = self.grid.no_rows(side, number, values.shape[1:])
                        own.add(values, rows[side, k])
            for (side, k), values in rows.items():
                found[side].setdefault(k, []).append(self.grid.used(side, number, values))
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
            if not self.grid.holds(side, number):
                continue
            rows = [self.grid.no_rows(side, number, (KNOTS,)) for _ in factors]
            for piece in pieces:
                place = knot_places(of(piece.motion), low, high)
                for factor, values in zip(factors, rows, strict=True):
                    piece.gathers[side].add_hats(place, np.ascontiguousarray(factor(piece.motion)), values)
            for one, values in zip(found, rows, strict=True):
                one.append(self.grid.used(side, number, values))
        return [np.concatenate(one) for one in found]

    def _parts(self, sides: Sequence[str]) -> list[list[Piece]]:
        """The parts of each motion, made once."""
        key = tuple(sides)
        if key not in self._pieces:
            self._pieces[key] = [list(self._cut(sides, number)) for number in range(len(self.stretches))]
        return self._pieces[key]

    def _cut(self, sides: Sequence[str], number: int) -> Iterator[Piece]:
        """Parts of a motion that fit into the processor's cache, with the samples in use alone."""
        held = [side for side in sides if self.grid.holds(side, number)]
        operators = {side: self.grid.operator(side, number).tocsc() for side in held}
        used = np.zeros(len(self.motions[number].time), dtype=bool)
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
            maker = RowMaker(self.grid, self.settings, self.structure, self.base, self.moving)
            kept = maker.make(side, self.motions, kept)
        self._made[side] = self.motions, kept
        return kept
