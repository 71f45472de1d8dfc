"""Do the stated 95 % intervals hold the true parameters and delays, on the emulator's data?

Run `python -m benchmarks.coverage [--pairs 40] [--first-seed 0] [--estimator wls]`. Each pair is a session of the bare
emulated arm and one with the payload: another random Fourier motion, fresh noise, elastic joints, quantised sensors and
slow motor torques, recorded through controller, link and log at the FRI cycle of 1 ms. Every second pair has joints
whose friction turns within 0.1 mrad after a reversal (the arm of `tests/hidden_physics`), every second pair of both
kinds a motor channel late by 5 ms. Model 2 is identified with the settings as they come and the stiffness of the arm's
description (10 kNm/rad for all joints; the emulated ones have 6 to 15), and held against the emulator's parameters.

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
from pathlib import Path
from typing import Any

import numpy as np

from ident.dynamics.kinematics import Chain
from ident.dynamics.parameters import split_name
from ident.estimation.identify import Identification, IdentificationSettings, identify
from ident.estimators import ESTIMATORS
from ident.rows.filters import SignalSettings
from lwr_driver.arm import Arm
from tests.ident.estimation.emulated_sessions import record_pair
from tests.ident.estimation_arm import true_base

LATE_S = 0.005
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


def pair(seed: int, cycle_ms: int, wanted: IdentificationSettings, period_s: float = 20.0) -> Identification:
    """One pair of sessions, recorded and identified."""
    arm = Arm.load()
    settings, _, _ = scenario(seed)
    with tempfile.TemporaryDirectory() as folder:
        sessions = record_pair(
            Path(folder), seed, period_s=period_s, periods=2, cycle_ms=cycle_ms, settings=settings
        )
        return identify(sessions, Chain.from_urdf(arm.urdf), wanted)


def settings_of(estimator: str) -> IdentificationSettings:
    """The settings as they come, with the stiffness of the arm's description."""
    signals = SignalSettings(stiffness_nm_rad=tuple(Arm.load().stiffness.tolist()))
    return IdentificationSettings(estimator=estimator, essential=None, signals=signals)


def delays(found: Identification, late_s: float) -> list[bool]:
    """Whether the interval of each session's delay holds the true one."""
    intervals = [session.delay.interval for session in found.prepared if session.delay is not None]
    return [low - 1e-9 <= late_s <= high + 1e-9 for low, high in intervals]


def table(scores: dict[str, list[tuple[bool, float]]]) -> str:
    """Coverage of the 95 % intervals and rms of (estimate - truth) / std by kind."""
    lines = ["kind             parameters   coverage %   rms z"]
    for name, rows in scores.items():
        inside, z = zip(*rows, strict=True)
        lines.append(
            f"{name:<16} {len(rows):>10} {100.0 * np.mean(inside):>12.1f} {np.sqrt(np.mean(np.square(z))):>7.2f}"
        )
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--pairs", type=int, default=40)
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--period-s", type=float, default=20.0)
    parser.add_argument("--cycle-ms", type=int, default=1)
    parser.add_argument("--estimator", choices=ESTIMATORS, default="wls")
    options = parser.parse_args(arguments)
    scores: dict[str, list[tuple[bool, float]]] = {}
    inertias: list[float] = []
    held: list[bool] = []
    print("seed  friction  channel  inside %  rms z   Ia error %   delays [ms]", flush=True)
    for seed in range(options.first_seed, options.first_seed + options.pairs):
        _, turns, late = scenario(seed)
        found = pair(seed, options.cycle_ms, settings_of(options.estimator), options.period_s)
        truth, estimate = true_base(found), found.estimate
        low, high = estimate.interval(0.95).T
        inside, z = (low < truth) & (truth < high), (estimate.values - truth) / estimate.std
        for k, name in enumerate(found.base.names):
            label = kind(name, found.structure.chain.n)
            scores.setdefault(label, []).append((bool(inside[k]), float(z[k])))
        drives = [k for k, name in enumerate(found.base.names) if split_name(name)[0] == "Ia"]
        errors = np.abs(estimate.values[drives] / truth[drives] - 1.0)
        inertias += errors.tolist()
        held += delays(found, LATE_S if late else 0.0)
        shown = ", ".join(
            f"{1e3 * s.delay.seconds:.2f} ± {1e3 * s.delay.std:.2f}"
            for s in found.prepared
            if s.delay is not None
        )
        row = (
            f"{100.0 * np.mean(inside):>9.1f} {np.sqrt(np.mean(z**2)):>6.2f} {100.0 * np.mean(errors):>12.2f}"
        )
        scene = f"{'turning ' if turns else 'sign    '}  {'late  ' if late else 'timely'}"
        print(f"{seed:>4}  {scene} {row}   {shown}", flush=True)
    scores["all"] = [row for rows in scores.values() for row in rows]
    print("\n" + table(scores))
    print(f"\nmean |error| of Ia {100.0 * np.mean(inertias):.2f} %")
    print(f"delay within its interval in {100.0 * np.mean(held):.0f} % of {len(held)} sessions")


if __name__ == "__main__":
    main()
