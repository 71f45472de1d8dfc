"""Do the stated 95 % intervals hold the true parameters and delays, on simulated arms?

Run `python -m benchmarks.coverage [--pairs 40] [--first-seed 0] [--estimator wls]`. Each pair is a session of the bare
emulated arm and one with the payload: another random Fourier motion, fresh noise, elastic joints, quantised sensors and
slow motor torques, recorded through controller, link and log at the FRI cycle of 1 ms. Every second pair has joints
whose friction turns within 0.1 mrad after a reversal (the arm of `tests/hidden_physics`), every second pair of both
kinds a motor channel late by 5 ms. Model 2 is identified with the settings as they come and the stiffness of the arm's
description (10 kNm/rad for all joints; the emulated ones have 6 to 15), and held against the emulator's parameters.

Then each pair is identified again with errors of its torque channels: gains within 1 %, and crosstalk of neighbouring
joints with a standard deviation of 1 %. Beside the stated deviations stand those without such errors in them.

`--arms mujoco` takes the healthy days of `benchmarks.mujoco_arms` instead, with gains, friction, hoses and clocks that
the model does not have. Friction and offsets have no true values there.

With slower FRI cycles the controller interpolates between two commands; the motor torque then has a ripple of that
period which grows with the acceleration. The KRL loop ticks every 12 ms: with a cycle of 5 ms its samples are at all
phases of the ripple, with 4 ms at one, where they see a drive inertia one per cent too large: `--cycle-ms 4` shows it.
"""

from __future__ import annotations

import argparse
import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.mujoco_arms.cases import draw
from benchmarks.mujoco_arms.recording import write
from benchmarks.mujoco_arms.simulation import Payload, simulate
from ident.dynamics.kinematics import Chain
from ident.dynamics.parameters import INERTIAL, Floats, split_name
from ident.estimation.channel_errors import EXACT_CHANNELS
from ident.estimation.identification import Identification, IdentificationSettings
from ident.estimation.identify import identify, known_settings
from ident.estimators import ESTIMATORS
from ident.rows.filters import SignalSettings
from lwr_driver.arm import Arm
from lwr_driver.session import Session, read_session
from tests.ident.estimation.emulated_sessions import record_pair
from tests.ident.estimation_arm import true_base

LATE_S = 0.005
# Errors of the torque channels: of a gain at most, and of crosstalk from a neighbour, one standard deviation.
GAIN, CROSSTALK = 0.01, 0.01
_SLOW_TURNING = {"robot.plant": {"type": "tests.hidden_physics.arm:HiddenArm", "options": {}}}
_INERTIAS, _MOMENTS = ("XX", "XY", "XZ", "YY", "YZ", "ZZ"), ("MX", "MY", "MZ")


def kind(name: str, joints: int) -> str:
    """Kind of a parameter for the table."""
    symbol, link, *_ = split_name(name)
    if link > joints:
        return "payload"
    return "inertias" if symbol in _INERTIAS else "first moments" if symbol in _MOMENTS else symbol


def scenario(seed: int) -> tuple[dict[str, Any], bool, bool]:
    """Settings of the emulated cabinet for a pair: whether friction turns slowly, whether the motor channel is late."""
    turns, late = bool(seed % 2), bool(seed // 2 % 2)
    settings: dict[str, Any] = dict(_SLOW_TURNING) if turns else {}
    return settings | ({"krl_reals.delay_ms": round(1e3 * LATE_S)} if late else {}), turns, late


def settings_of(estimator: str) -> IdentificationSettings:
    """The settings as they come, with the stiffness of the arm's description."""
    signals = SignalSettings(stiffness_nm_rad=tuple(Arm.load().stiffness.tolist()))
    return IdentificationSettings(estimator=estimator, essential=None, signals=signals)


def with_channel_errors(sessions: Sequence[Session], seed: int) -> list[Session]:
    """The sessions of one arm as its torque channels with wrong gains and crosstalk would have recorded them."""
    random = np.random.default_rng([seed, 77])
    found = list(sessions)
    for side in ("joint", "motor"):
        count = len(sessions[0].joint_names)
        matrix = np.diag(1.0 + random.uniform(-GAIN, GAIN, count))
        matrix += CROSSTALK * random.normal(size=(count, count)) * (np.eye(count, k=1) + np.eye(count, k=-1))
        for k, session in enumerate(found):
            channel = getattr(session, side)
            changed: dict[str, Any] = {side: replace(channel, effort=channel.effort @ matrix.T)}
            found[k] = replace(session, **changed)
    return found


def delays(found: Identification, late_s: float) -> list[bool]:
    """Whether the interval of each session's delay holds the true one."""
    intervals = [session.delay.interval for session in found.prepared if session.delay is not None]
    return [low - 1e-9 <= late_s <= high + 1e-9 for low, high in intervals]


def _of_load(chain: Chain, load: Payload) -> dict[str, float]:
    """Inertial parameters of a payload in the frame of the last link."""
    centre = np.array(load.centre)
    inertia = np.diag(np.square(load.gyration)) + centre @ centre * np.eye(3) - np.outer(centre, centre)
    bodies = np.zeros((chain.n, 10))
    bodies[-1] = load.mass * np.concatenate([inertia[np.triu_indices(3)], centre, [1.0]])
    return dict(zip(INERTIAL, chain.inertial_from_links(bodies)[-1].tolist(), strict=True))


def mujoco_arm(seed: int, estimator: str) -> tuple[str, Identification, Floats]:
    """Title, identification and true base parameters of a healthy day of a MuJoCo arm; 0 for what has no truth."""
    case = draw(seed, "healthy")
    with tempfile.TemporaryDirectory() as folder:
        sessions = [
            read_session(write(Path(folder) / f"{s.role}.mcap", s, simulate(s.plant, s.q, s.qd)))
            for s in case.healthy[:2]
        ]
        chain = Chain.from_urdf(case.arm.kind.urdf)
        wanted = IdentificationSettings(estimator=estimator, essential=None)
        found = identify(sessions, chain, known_settings(sessions, chain, wanted))
    plant = case.healthy[1].plant
    tables = [dict(zip(INERTIAL, row, strict=True)) for row in chain.urdf_inertials().tolist()]
    for table, inertia in zip(tables, plant.drive["inertia"].tolist(), strict=True):
        table["Ia"] = inertia
    tables.append(_of_load(chain, plant.body.payload))
    places = [split_name(name)[:2] for name in found.structure.names]
    truth = found.base.reduce(np.array([tables[link - 1].get(symbol, 0.0) for symbol, link in places]))
    return f"{case.arm.kind.name}, {case.arm.encoder}s' positions", found, np.asarray(truth)


@dataclass
class Tally:
    """Scores of identifications: by kind of parameter whether its interval holds the truth, and z.

    bare : z without errors of the channels in the deviations; widths : how much these widen the median interval.
    """

    scores: dict[str, list[tuple[bool, float]]] = field(default_factory=dict)
    bare: list[float] = field(default_factory=list)
    widths: list[float] = field(default_factory=list)

    def add(self, found: Identification, truth: Floats, *, friction: bool = True) -> str:
        """Score the parameters, with friction and offsets or without; share inside and rms z of these."""
        estimate = found.estimate
        low, high = estimate.interval(0.95).T
        inside, z = (low < truth) & (truth < high), (estimate.values - truth) / estimate.std
        without = estimate.covariances[EXACT_CHANNELS].std
        used = []
        for k, name in enumerate(found.base.names):
            label = kind(name, found.structure.chain.n)
            if friction or label in ("inertias", "first moments", "payload", "Ia"):
                used.append(k)
                self.scores.setdefault(label, []).append((bool(inside[k]), float(z[k])))
        self.bare += (z * estimate.std / without)[used].tolist()
        self.widths.append(float(np.median(estimate.std / without)))
        return f"{100.0 * np.mean(inside[used]):>9.1f} {np.sqrt(np.mean(z[used] ** 2)):>6.2f}"

    def __str__(self) -> str:
        rows = self.scores | {"all": [row for rows in self.scores.values() for row in rows]}
        lines = ["kind             parameters   95 % hold   within 2 std %   rms z"]
        for name, some in rows.items():
            inside, z = map(np.array, zip(*some, strict=True))
            near = 100.0 * np.mean(np.abs(z) < 2.0)
            lines.append(
                f"{name:<16} {len(some):>10} {100.0 * np.mean(inside):>11.1f} {near:>16.1f} "
                f"{np.sqrt(np.mean(z**2)):>7.2f}"
            )
        bare = np.array(self.bare)
        near = 100.0 * np.mean(np.abs(bare) < 2.0)
        lines.append(
            f"without errors of the channels in the deviations {near:.1f} % within 2 std, "
            f"rms z {np.sqrt(np.mean(bare**2)):.2f}; with them they are {np.median(self.widths):.2f} times as wide"
        )
        return "\n".join(lines)


def emulated(options: argparse.Namespace) -> None:
    """The emulator's arm, with its channels as they are and with errors."""
    chain, wanted = Chain.from_urdf(Arm.load().urdf), settings_of(options.estimator)
    exact, wrong = Tally(), Tally()
    inertias: list[float] = []
    held: list[bool] = []
    print(
        "seed  friction  channel  inside %  rms z   Ia error %   wrong channels: inside %, rms z   delays [ms]"
    )
    for seed in range(options.first_seed, options.first_seed + options.pairs):
        settings, turns, late = scenario(seed)
        with tempfile.TemporaryDirectory() as folder:
            sessions = record_pair(
                Path(folder),
                seed,
                period_s=options.period_s,
                periods=2,
                cycle_ms=options.cycle_ms,
                settings=settings,
            )
            found = identify(sessions, chain, wanted)
            other = identify(with_channel_errors(sessions, seed), chain, wanted)
        truth = true_base(found)
        row, further = exact.add(found, truth), wrong.add(other, true_base(other))
        drives = [k for k, name in enumerate(found.base.names) if split_name(name)[0] == "Ia"]
        errors = np.abs(found.estimate.values[drives] / truth[drives] - 1.0)
        inertias += errors.tolist()
        held += delays(found, LATE_S if late else 0.0)
        shown = ", ".join(
            f"{1e3 * s.delay.seconds:.2f} ± {1e3 * s.delay.std:.2f}"
            for s in found.prepared
            if s.delay is not None
        )
        scene = f"{'turning ' if turns else 'sign    '}  {'late  ' if late else 'timely'}"
        print(f"{seed:>4}  {scene} {row} {100.0 * np.mean(errors):>12.2f} {further}   {shown}", flush=True)
    print(f"\n{exact}\n\nmean |error| of Ia {100.0 * np.mean(inertias):.2f} %")
    print(f"delay within its interval in {100.0 * np.mean(held):.0f} % of {len(held)} sessions")
    print(f"\nwith errors of the torque channels\n{wrong}")


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--arms", choices=("emulator", "mujoco"), default="emulator")
    parser.add_argument("--pairs", type=int, default=40)
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--period-s", type=float, default=20.0)
    parser.add_argument("--cycle-ms", type=int, default=1)
    parser.add_argument("--estimator", choices=ESTIMATORS, default="wls")
    options = parser.parse_args(arguments)
    if options.arms == "emulator":
        emulated(options)
        return
    tally = Tally()
    for seed in range(options.first_seed, options.first_seed + options.pairs):
        title, found, truth = mujoco_arm(seed, options.estimator)
        print(f"{seed:>4}  {tally.add(found, truth, friction=False)}   {title}", flush=True)
    print(f"\n{tally}")


if __name__ == "__main__":
    main()
