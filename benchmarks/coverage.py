"""Do the stated 95 % intervals hold the true parameters in 95 % of the cases, on the emulator's data?

Run `python -m benchmarks.coverage [--pairs 20] [--period-s 20] [--estimator wls]`. Each pair is a session of
the bare emulated arm and one with the payload: another random Fourier motion, fresh noise, the default
emulator with its elastic joints, quantised sensors and slow motor torques, recorded through controller, link
and log. Model 2 is identified with the settings as they come and held against the emulator's parameters.

What identification does not model (the motors move against the links by the joints' elasticity) is in the
data on purpose. It shows in the drives: their intervals are printed by kind of parameter.
"""

from __future__ import annotations

import argparse
import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import tempfile
from pathlib import Path

import numpy as np

from ident.dynamics.kinematics import Chain
from ident.dynamics.parameters import split_name
from ident.estimation.identify import Identification, IdentificationSettings, identify
from ident.estimators import ESTIMATORS
from lwr_driver.configuration import find
from runner.published import TABLE_2
from tests.ident.estimation.emulated_sessions import record_pair
from tests.ident.estimation_arm import true_base


def inside(found: Identification, kind: str | None) -> np.ndarray:
    """Which parameters have the truth in their 95 % interval."""
    low, high = found.estimate.interval(0.95, covariance=kind).T
    truth = true_base(found)
    return (low < truth) & (truth < high)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--pairs", type=int, default=20)
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--period-s", type=float, default=20.0)
    parser.add_argument("--periods", type=int, default=2)
    parser.add_argument("--cycle-ms", type=int, default=4)
    parser.add_argument("--estimator", choices=ESTIMATORS, default="wls")
    options = parser.parse_args()
    chain = Chain.from_urdf(find("lwr4plus.urdf"))
    settings = IdentificationSettings(estimator=options.estimator)
    shares: dict[str, list[np.ndarray]] = {"stated": [], "hac": [], "textbook": []}
    scores = []
    names: tuple[str, ...] = ()
    print("seed  stated     hac textbook  z rms essential  of Table 2 not essential")
    for seed in range(options.first_seed, options.first_seed + options.pairs):
        with tempfile.TemporaryDirectory() as folder:
            sessions = record_pair(
                Path(folder),
                seed,
                period_s=options.period_s,
                periods=options.periods,
                cycle_ms=options.cycle_ms,
            )
            found = identify(sessions, chain, settings)
        names = found.base.names
        for kind, rows in shares.items():
            known = kind == "stated" or kind in found.estimate.covariances
            rows.append(
                inside(found, None if kind == "stated" else kind) if known else np.full(len(names), np.nan)
            )
        z = (found.estimate.values - true_base(found)) / found.estimate.std
        scores.append(z)
        assert found.essential is not None
        lost = [entry.name for entry in TABLE_2 if entry.name not in found.essential.names]
        count = len(found.essential.names)
        cells = " ".join(f"{100 * np.mean(rows[-1]):7.1f}" for rows in shares.values())
        print(f"{seed:>4} {cells} {np.sqrt(np.mean(z**2)):7.2f} {count:>9}  {', '.join(lost)}", flush=True)
    print("\nCoverage of the 95 % intervals [%]")
    for kind, rows in shares.items():
        by_pair = 100.0 * np.mean(rows, axis=1)
        error = np.std(by_pair, ddof=1) / np.sqrt(len(by_pair)) if len(by_pair) > 1 else np.nan
        print(f"{kind:<9} {np.mean(by_pair):5.1f} ± {error:.1f}")
    print("\nBy kind of parameter: coverage [%], rms of (estimate - truth) / std")
    kinds: dict[str, list[int]] = {}
    for k, name in enumerate(names):
        kinds.setdefault(split_name(name)[0], []).append(k)
    stacked, deviations = np.array(shares["stated"]), np.array(scores)
    for kind, places in kinds.items():
        rms = np.sqrt(np.mean(deviations[:, places] ** 2))
        print(f"{kind:<4} {100 * np.mean(stacked[:, places]):6.1f} {rms:6.2f}")


if __name__ == "__main__":
    main()
