"""An effect drawn from a seed, of a size that matters.

Cause, joint and shape come from the dictionary of effects. The size follows from the visibility rho: the prediction
error of a refitted base model with the effect, over the one without it, in the most affected torque::

    rho^2 = 1 + mean(((I - W W^+) x c)^2 / sigma^2)

with the columns x of the effect along the planned motion, its coefficients c, the base regressor W, and the noise
sigma of the emulated sensors in means of 24 ms. With a reference of the healthy arm the base parameters are known, and
W is left out.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from fri.errors import ConfigurationError
from ident.dynamics.base_set import numeric_base
from ident.dynamics.kinematics import Chain
from ident.dynamics.structure import ModelStructure, Side
from ident.effects import EFFECTS, ArmMotion, Effect, Setting, Shape
from ident.effects.load import PayloadError
from ident.model import DynamicModel
from ident.rows.binned import Motion, binned_regressor, bins
from lwr_driver.arm import Arm
from runner.experiment_file import Experiment
from runner.hiding.effect import HiddenEffect, emulated_arm
from runner.planning import Excitations
from sim_backend.configuration import EmulatorConfig
from sim_backend.plant import CYCLE_S
from sim_backend.robot import Payload, truth

Floats = NDArray[np.float64]

SIDES: tuple[Side, ...] = ("motor", "joint")
# Means of 24 ms, as of the visibility in the campaigns.
_STEP_S, _WIDTH = 4e-3, 6
# From a size every diagnosis has to see up to twice the error of the healthy arm.
RHO = (1.2, 2.0)
# Largest torque of an effect over the largest healthy one: beyond, the arm is broken at first sight.
_MOST = 0.5
# On the emulated flange it acts without the payload as well, and is then a cause of another name.
_OTHERWISE = (PayloadError.cause,)


def draw_effect(seed: int, experiment: Experiment, arm: Arm, motions: Excitations) -> HiddenEffect:
    """Cause, then joint and shape, each as likely as the others; then a size of rho 1.2 to 2.

    Left out are causes with a time of the session, for the emulator's clock runs through all sessions, and lost
    samples, which add no error. Raises ConfigurationError for an arm that takes no effect, and for motions that show
    none.
    """
    random = np.random.default_rng(seed)
    planned = PlannedRun(experiment, arm, motions, emulated_arm(experiment))
    causes = [e for e in EFFECTS.values() if e.depends_on != "time" and e.cause not in _OTHERWISE]
    for number in random.permutation(len(causes)):
        effect = causes[number]
        for joint, shape in _places(effect, planned.setting, random):
            sized = planned.sized(effect, joint, shape, random)
            if sized is not None:
                return _hidden(seed, effect, joint, shape, *sized)
    raise ConfigurationError(
        f"--hide {seed}: the motions of {experiment.name} show no effect within its physical range; plan an "
        "exciting motion with `lwr-run plan`"
    )


def _places(effect: Effect, setting: Setting, random: np.random.Generator) -> Iterator[tuple[int, Shape]]:
    """Joints (from 0) and shapes in random order; a channel can be emulated late, not early."""
    pairs = [
        (joint, shape)
        for joint in range(1 if effect.whole_arm else len(setting.gear_ratio))
        for shape in effect.shapes(setting, joint)
        if shape.get("delay", 1.0) > 0.0
    ]
    for number in random.permutation(len(pairs)):
        yield pairs[number]


def _hidden(
    seed: int, effect: Effect, joint: int, shape: Shape, coefficients: Floats, rho: float
) -> HiddenEffect:
    linear = {p.name: float(c) for p, c in zip(effect.linear, coefficients, strict=False)}
    used = {p.name for p in effect.used(shape.form)}
    return HiddenEffect(
        seed,
        effect.cause,
        () if effect.whole_arm else (joint + 1,),
        None if shape.form is None else str(shape.form.value),
        {name: value for name, value in {**linear, **shape}.items() if name in used},
        rho,
    )


@dataclass(frozen=True, eq=False)
class PlannedRun:
    """The sessions of the estimate on the healthy emulated arm, as planned."""

    experiment: Experiment
    arm: Arm
    excitations: Excitations
    config: EmulatorConfig

    @property
    def _loads(self) -> list[str | None]:
        """Payload of each session of the estimate."""
        fitted = [plan for plan in self.experiment.sessions if not plan.validation]
        return [None if plan.payload is None else plan.payload.name for plan in fitted]

    @cached_property
    def _model(self) -> DynamicModel:
        """The healthy arm by its true parameters, with the payloads as announced."""
        announced = self.experiment.payloads()
        names = tuple(dict.fromkeys(name for name in self._loads if name is not None))
        structure = ModelStructure(Chain.from_urdf(self.arm.urdf), 2, names)
        values = truth(self.config, payload="none")
        for link, name in enumerate(names, start=structure.chain.n + 1):
            load = announced[name]
            body = Payload.from_centre_of_mass(load.mass, load.com, load.inertia)
            values |= {f"{symbol}{link}": value for symbol, value in vars(body).items()}
        standard = np.array([values.get(name, 0.0) for name in structure.names])
        return DynamicModel(self.arm.name, structure, structure.names, standard)

    @cached_property
    def _motions(self) -> tuple[ArmMotion, ...]:
        model, drive = self._model, self._model.drive()
        time = np.arange(0.0, self.excitations.exciting.duration_s, _STEP_S)
        q, qd, qdd, _ = self.excitations.exciting.sample(time)
        found = []
        for number, payload in enumerate(self._loads):
            joint, motor = (
                model.linear_torque(q, qd, qdd, payload=payload, side=side) for side in ("joint", "motor")
            )
            found.append(
                ArmMotion(
                    chain=model.structure.chain,
                    bodies=model.inertial(payload),
                    session=number,
                    time=time,
                    duration_s=self.excitations.periods * float(time[-1]),
                    q=q,
                    qd=qd,
                    qdd=qdd,
                    motor_speed=qd,
                    motor_acceleration=qdd,
                    joint_torque=joint,
                    motor_torque=motor,
                    gear_ratio=self.arm.gear_ratio.astype(float),
                    inertia=drive["Ia"],
                    link_coulomb=drive["Fcl"],
                    motor_coulomb=drive["Fcm"],
                    friction=lambda v: drive["Fvm"] * v + drive["Fcm"] * np.sign(v),
                    loaded=payload is not None or not any(self._loads),
                )
            )
        return tuple(found)

    @cached_property
    def setting(self) -> Setting:
        """The sessions and the arm for the shapes of an effect."""
        q, torque = (np.concatenate([getattr(m, x) for m in self._motions]) for x in ("q", "joint_torque"))
        speed = np.concatenate([m.motor_speed for m in self._motions])
        return Setting(
            sessions=len(self._motions),
            durations_s=tuple(m.duration_s for m in self._motions),
            gear_ratio=self.arm.gear_ratio.astype(float),
            torque_range=np.abs(torque).max(axis=0),
            torque_turns=(torque.min(axis=0) < 0.0) & (torque.max(axis=0) > 0.0),
            speed_range=np.abs(speed).max(axis=0),
            position_range=np.stack([q.min(axis=0), q.max(axis=0)], axis=1),
            encoder=self.config.sensors.position_sensor,
            compared=self._compared,
        )

    @property
    def _compared(self) -> bool:
        return self.experiment.diagnosis.reference is not None

    @cached_property
    def _sigma(self) -> Floats:
        """Noise (2, n) [Nm] of motor and joint torque in the means, from their sensors at their own rates."""
        cycle = 1e-3 * self.config.fri.period_ms
        tick = max(cycle, CYCLE_S * self.config.krl_reals.tick_ms)
        sensors, row = self.config.sensors, _WIDTH * _STEP_S
        noise = np.array([sensors.motor_torque_noise, sensors.joint_torque_noise])
        return np.maximum(noise, 1e-6) * np.sqrt(np.array([[tick], [cycle]]) / row)

    @cached_property
    def _healthy(self) -> Floats:
        """Largest torque (2, n) [Nm] of the healthy arm, by side."""
        peaks = [
            [np.abs(m.motor_torque).max(axis=0), np.abs(m.joint_torque).max(axis=0)] for m in self._motions
        ]
        return np.asarray(np.max(peaks, axis=0))

    @cached_property
    def _basis(self) -> Floats:
        """Orthonormal columns (rows, b) of the weighted base regressor; none with a reference."""
        structure, parts = self._model.structure, []
        columns = numeric_base(structure).columns
        for motion, payload in zip(self._motions, self._loads, strict=True):
            state = Motion(motion.q, motion.qd, motion.qdd)
            sides = [binned_regressor(structure, columns, state, payload, s, _WIDTH) for s in SIDES]
            parts.append(np.stack(sides) / self._sigma[:, :, None, None])
        stacked = np.concatenate(parts, axis=2).reshape(-1, len(columns))
        return np.linalg.qr(stacked)[0]

    def _rows(self, effect: Effect, joint: int, shape: Shape) -> Floats:
        """Columns (k, 2, n, m) of an effect in means over all sessions, over the noise."""
        parts = []
        for motion in self._motions:
            wide = [one.wide(joint, motion.n) for one in effect.columns(motion, joint, shape)]
            parts.append([[_means(x, motion) for x in column] for column in wide])
        return np.concatenate(np.array(parts), axis=3) / self._sigma[:, :, None]

    def sized(
        self, effect: Effect, joint: int, shape: Shape, random: np.random.Generator
    ) -> tuple[Floats, float] | None:
        """Coefficients of an effect, drawn for its visibility, and rho; None outside the physical ranges.

        An effect without a free coefficient, such as a delay, has the rho of its shape.
        """
        columns = self._rows(effect, joint, shape)
        size = np.sqrt(np.mean(columns**2, axis=(1, 2, 3)))
        if not np.all(size > 0.0):
            return None
        used = effect.linear[: len(columns)]
        signs = [abs if p.low >= 0.0 else float for p in used]
        drawn = np.array([sign(x) for sign, x in zip(signs, random.normal(size=len(used)), strict=True)])
        fixed = any(p.name in effect.hidden for p in used)
        unit = np.ones(len(used)) if fixed else drawn / size
        seen = np.einsum("k,ksnm->snm", unit, columns)
        left = seen if self._compared else _beside(self._basis, seen)
        power = float(np.mean(left**2, axis=2).max())
        rho = float(random.uniform(*RHO))
        scale = 1.0 if fixed else np.sqrt((rho**2 - 1.0) / max(power, 1e-12))
        rho = float(np.sqrt(1.0 + scale**2 * power))
        peak = scale * np.abs(seen).max(axis=2) * self._sigma
        small = bool(np.all(peak <= _MOST * self._healthy))
        possible = effect.plausible(scale * unit, shape) and RHO[0] <= rho <= RHO[1] + 1e-9
        return (scale * unit, rho) if small and possible else None


def _beside(basis: Floats, rows: Floats) -> Floats:
    """Rows without their part in the span of the basis."""
    flat = rows.reshape(-1)
    return np.asarray((flat - basis @ (basis.T @ flat)).reshape(rows.shape))


def _means(torque: Floats | None, motion: ArmMotion) -> Floats:
    """Means (n, m) of a torque (N, n) [Nm]; zeros without one."""
    return bins(np.zeros_like(motion.q) if torque is None else torque, _WIDTH).T
