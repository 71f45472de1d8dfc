"""Real arms: held-out accuracy, repeatability floor, honesty of the standard deviations, and what the diagnosis finds.

Run `python -m benchmarks.real_data [--data FOLDER]`. The folder holds measurements_1.npz to _3.npz and the
URDF files that FloBaRoID published (github kjyv/FloBaRoID, data/KUKA/HW and model, LGPL-3): Model 1, joint
torque sensors, 25 s a run. Runs 1 and 2 repeat one trajectory, run 3 is another, twice as fast.

`lwr-run identify` as it comes on every arm stands first (`real_arms.py`).

The diagnosis follows, of every arm with recordings beside these (`real_cases.py`).

Each estimate is made with the settings as they come, from the training runs alone. The score is the one that
others use on these files: the file's own q, qd, qdd, all samples from the first to the last, every ninth,
||e|| / ||tau|| over all joints. Figures of other software with that score are printed beside ours.
"""

from __future__ import annotations

import argparse
import dataclasses
import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import sys
import tempfile
import time
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.real_arms import defaults
from benchmarks.real_cases import iiwa14, tx40, unseen
from ident.dynamics.kinematics import Chain
from ident.estimation.channel_errors import EXACT_CHANNELS
from ident.estimation.identification import Identification, IdentificationSettings
from ident.estimation.identify import identify
from ident.estimation.mounting import Mounting, find_mounting
from ident.estimators import Estimate
from ident.estimators.physical import cad_prior
from ident.import_log import LogMapping, import_log
from ident.model.dynamic_model import DynamicModel
from lwr_driver.configuration import CONFIGS, find
from lwr_driver.session import Session, read_session

FloatArray = NDArray[np.float64]
Runs = tuple[int, ...]

EVERY = 9
ESTIMATORS = ("ols", "wls", "huber", "map", "physical")
AUTOMATIC = "auto"
LEANING = "physical, leaning"
DECIDED = "stated, data decide"
SPLITS: tuple[tuple[Runs, int], ...] = (
    ((1, 2), 3), ((1,), 3), ((2,), 3), ((3,), 1), ((3,), 2), ((1,), 2), ((2,), 1), ((2, 3), 1), ((1, 3), 2),
)  # fmt: skip
# Relative error [%] of other software: FloBaRoID 0.9.8 (semidefinite program with CAD prior), and ordinary
# least squares of 64 base parameters as plain numpy and FIGAROH 1.0.2 do it.
OTHERS = {
    ((1, 2), 3): (6.03, 14.1),
    ((3,), 1): (3.48, 9.62),
    ((1,), 2): (2.81, 5.33),
    ((2, 3), 1): (2.87, 2.95),
}
PRIORS = ("kuka_lwr4_2016-04-11.urdf", "kuka_lwr4_gaz.urdf", "kuka_lwr4_identified.urdf")


class Recordings:
    """The three runs as sessions, with estimates kept once made."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.raw = {run: dict(np.load(folder / f"measurements_{run}.npz")) for run in (1, 2, 3)}
        self.identified = lru_cache(self._identified)
        self.mounted = lru_cache(self._mounted)
        self._session = lru_cache(self._imported)

    def chain(self, urdf: str = "") -> Chain:
        return Chain.from_urdf(self.folder / urdf if urdf else find("lwr4plus.urdf"))

    def _imported(self, run: int, urdf: str) -> Session:
        mapping = LogMapping.load("lwr4_flobaroid")
        mapping = dataclasses.replace(mapping, joints=self.chain(urdf).joint_names)
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / f"run_{run}.mcap"
            import_log(mapping, self.folder / f"measurements_{run}.npz", path, urdf=self.chain(urdf).urdf)
            return read_session(path)

    def sessions(self, runs: Runs, urdf: str = "") -> list[Session]:
        return [self._session(run, urdf) for run in runs]

    def _identified(self, runs: Runs, estimator: str, urdf: str = "") -> Identification:
        settings = IdentificationSettings(model=1, estimator=estimator, essential=None)
        return identify(self.sessions(runs, urdf), self.chain(urdf), settings)

    def _mounted(self, runs: Runs) -> Mounting:
        settings = IdentificationSettings(model=1, estimator="physical", essential=None)
        return find_mounting(self.sessions(runs), self.chain(), settings)

    def found(self, runs: Runs, estimator: str) -> Identification:
        return self.mounted(runs).identification if estimator == LEANING else self.identified(runs, estimator)

    def errors(self, found: Identification, run: int) -> tuple[FloatArray, FloatArray]:
        names = ("positions", "velocities", "accelerations", "torques")
        q, qd, qdd, torque = (self.raw[run][name][::EVERY] for name in names)
        return torque - found.model.torque(q, qd, qdd, side="joint"), torque

    def relative(self, found: Identification, run: int) -> float:
        error, torque = self.errors(found, run)
        return float(100.0 * np.linalg.norm(error) / np.linalg.norm(torque))

    def model_relative(self, model: DynamicModel, run: int) -> float:
        """Relative error [%] of a model with what the sensors add."""
        names = ("positions", "velocities", "accelerations", "torques", "times")
        q, qd, qdd, torque, times = (self.raw[run][name][::EVERY] for name in names)
        even = np.linspace(0.0, float(np.ptp(times)), len(q))
        error = torque - model.torque(q, qd, qdd, side="joint", time=even, measured=True)
        return float(100.0 * np.linalg.norm(error) / np.linalg.norm(torque))

    def joint_rms(self, found: Identification, run: int) -> FloatArray:
        return np.sqrt(np.mean(self.errors(found, run)[0] ** 2, axis=0))

    @property
    def floor(self) -> FloatArray:
        return np.sqrt(np.mean((self.raw[1]["torques"] - self.raw[2]["torques"]) ** 2, axis=0))


def label(train: Runs, test: int) -> str:
    return f"{{{', '.join(map(str, train))}}} -> {test}"


def held_out(data: Recordings) -> None:
    columns = (*ESTIMATORS, LEANING, AUTOMATIC)
    print("Relative error on a run that was not used [%]")
    print(
        f"{'train -> test':<14}"
        + "".join(f"{c:>{len(c) + 3}}" for c in columns)
        + "   FloBaRoID   OLS of others"
    )
    for train, test in SPLITS:
        values = [data.relative(data.found(train, c), test) for c in columns]
        cells = "".join(f"{v:>{len(c) + 3}.2f}" for v, c in zip(values, columns, strict=True))
        others = OTHERS.get((train, test))
        print(
            f"{label(train, test):<14}{cells}" + (f"{others[0]:>12.2f}{others[1]:>16.2f}" if others else "")
        )


def per_joint(data: Recordings) -> None:
    print("\nResidual per joint [Nm], rms; the floor is the difference between the two repeats")
    joints = data.chain().joint_names
    print(f"{'':<34}" + "".join(f"{j:>7}" for j in joints))

    def line(name: str, values: FloatArray) -> None:
        print(f"{name:<34}" + "".join(f"{v:>7.3f}" for v in values))

    for train, test in (((1, 2), 3), ((3,), 1)):
        line(f"torque of run {test}", np.sqrt(np.mean(data.raw[test]["torques"] ** 2, axis=0)))
        for estimator in ("wls", "physical", LEANING):
            line(f"{label(train, test)}  {estimator}", data.joint_rms(data.found(train, estimator), test))
    line("repeatability floor", data.floor)


def deviation(first: Estimate, second: Estimate, kind: str) -> FloatArray:
    pair = [e.covariance if kind == "stated" else e.covariances[kind] for e in (first, second)]
    return (first.values - second.values) / np.hypot(pair[0].std, pair[1].std)


def data_decide(found: Identification) -> NDArray[np.bool_]:
    """Parameters of which the prior says nothing, or whose deviation the data brought below half of its."""
    precision = cad_prior(found.base).prior("pullback").precision
    known = np.diag(precision) > 0
    std = np.full(len(known), np.inf)
    std[known] = np.sqrt(np.diag(np.linalg.inv(precision[np.ix_(known, known)])))
    return found.estimate.std < 0.5 * std


def honesty(data: Recordings) -> None:
    print("\nDifference of two estimates over its standard deviation: rms of z, share of |z| < 2")
    print("(1 and 0.95 are honest; runs 1 and 2 share motion and model error, the others share neither)")
    pairs: tuple[tuple[Runs, Runs], ...] = (((1,), (2,)), ((1,), (3,)), ((2,), (3,)), ((1, 2), (3,)))
    print(f"{'estimator, deviations':<34}" + "".join(f"{f'{a} : {b}':>20}" for a, b in pairs))
    cases = [("wls", "textbook"), ("wls", "hac"), ("wls", EXACT_CHANNELS)]
    cases += [("wls", "stated"), ("huber", "stated")]
    cases += [(e, k) for e in ("map", "physical") for k in ("stated", DECIDED, "jackknife")]
    cases.append((LEANING, "stated"))
    for estimator, kind in cases:
        cells = []
        for a, b in pairs:
            first, second = (data.found(runs, estimator) for runs in (a, b))
            z = deviation(first.estimate, second.estimate, "stated" if kind == DECIDED else kind)
            if kind == DECIDED:
                z = z[data_decide(first) & data_decide(second)]
            cells.append(f"{np.sqrt(np.mean(z**2)):.2f}  {100 * np.mean(np.abs(z) < 2):.0f} %")
        print(f"{f'{estimator}, {kind}':<34}" + "".join(f"{c:>20}" for c in cells))
    for estimator in ("wls", "map"):
        print(f"{estimator} states: {data.identified((1,), estimator).estimate.covariance.kind}")


def priors(data: Recordings) -> None:
    print("\nEstimator `physical` with other prior models: relative error [%] on {1, 2} -> 3 and 3 -> 1")
    for urdf in PRIORS:
        values = [
            data.relative(data.identified(runs, "physical", urdf), test)
            for runs, test in (((1, 2), 3), ((3,), 1))
        ]
        print(f"{urdf:<34}" + "".join(f"{v:>8.2f}" for v in values))


def tilts(data: Recordings) -> None:
    print("\nHow the base leans")
    for runs in ((1,), (2,), (3,), (1, 2)):
        print(f"runs {', '.join(map(str, runs)):<6} {data.mounted(runs)}")


def main(arguments: Sequence[str]) -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument(
        "--diagnosis-only", action="store_true", help="leave out the tables of the estimators"
    )
    parser.add_argument(
        "--defaults-only", action="store_true", help="only `lwr-run identify` as it comes, on every arm"
    )
    parser.add_argument(
        "--data", type=Path, default=CONFIGS.parents[1] / "shared" / "data" / "lwr4_flobaroid"
    )
    wanted = parser.parse_args(arguments)
    folder = wanted.data
    if not (folder / "measurements_1.npz").is_file():
        print(f"no recordings in {folder}: fetch them (see the head of this file) and name them with --data")
        return 2
    start = time.process_time()
    if not wanted.diagnosis_only:
        defaults(folder.parent)
    if wanted.defaults_only:
        print(f"\nCPU {time.process_time() - start:.1f} s")
        return 0
    data = Recordings(folder)
    if not wanted.diagnosis_only:
        for table in (held_out, per_joint, honesty, priors, tilts):
            table(data)
    for arm, test, found in unseen(folder.parent):
        if arm == folder.name:
            before, after = (
                data.model_relative(m, int(test)) for m in (found.base_model, found.extended_model)
            )
            print(f"  on the samples of the tables above: {before:.2f} % -> {after:.2f} %")
    for name, case in (("tx40", tx40), ("iiwa14", iiwa14)):
        if (folder.parent / name).is_dir():
            case(folder.parent / name)
        else:
            print(f"\nno recordings of the {name} in {folder.parent}")
    print(f"\nCPU {time.process_time() - start:.1f} s")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
