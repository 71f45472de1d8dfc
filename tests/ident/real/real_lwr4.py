"""Three recordings of a real LWR4+ by FloBaRoID's authors (github kjyv/FloBaRoID, LGPL-3), as sessions.

Runs 1 and 2 repeat one trajectory, run 3 is another, twice as fast. The score is the usual one for these files:
the file's own q, qd, qdd, all of its 25 s, every ninth sample, ||e|| / ||tau|| over all joints.
"""

from __future__ import annotations

import dataclasses
import tempfile
from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest

from ident.dynamics.kinematics import Chain
from ident.estimation.identification import Identification, IdentificationSettings
from ident.estimation.identify import identify
from ident.estimation.mounting import Mounting, find_mounting
from ident.import_log import LogMapping, import_log
from lwr_driver.configuration import CONFIGS, find
from lwr_driver.session import Session, read_session

DATA = CONFIGS.parents[1] / "shared" / "data" / "lwr4_flobaroid"
EVERY = 9

needs_recordings = pytest.mark.skipif(
    not DATA.is_dir(), reason=f"recordings of a real LWR4+ (github kjyv/FloBaRoID) are not at {DATA}"
)


@lru_cache
def chain(urdf: str = "") -> Chain:
    """The project's LWR4+, or one of the data's own URDF files."""
    return Chain.from_urdf(DATA / urdf if urdf else find("lwr4plus.urdf"))


@lru_cache
def session(run: int, urdf: str = "") -> Session:
    """Run 1, 2 or 3, imported through the mapping file, with the joint names of the chain."""
    mapping = dataclasses.replace(LogMapping.load("lwr4_flobaroid"), joints=chain(urdf).joint_names)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"run_{run}.mcap"
        import_log(mapping, DATA / f"measurements_{run}.npz", path, urdf=chain(urdf).urdf)
        return read_session(path)


def settings(estimator: str) -> IdentificationSettings:
    """Everything as it comes, Model 1."""
    return IdentificationSettings(model=1, estimator=estimator, essential=None)


@lru_cache
def identified(runs: tuple[int, ...], estimator: str, urdf: str = "") -> Identification:
    return identify([session(run, urdf) for run in runs], chain(urdf), settings(estimator))


@lru_cache
def mounted(runs: tuple[int, ...], estimator: str = "physical") -> Mounting:
    return find_mounting([session(run) for run in runs], chain(), settings(estimator))


def errors(found: Identification, run: int) -> tuple[np.ndarray, np.ndarray]:
    """Residual and measured joint torque (n, 7) [Nm] of every ninth sample of a run."""
    with np.load(DATA / f"measurements_{run}.npz") as raw:
        q, qd, qdd, torque = (
            raw[name][::EVERY] for name in ("positions", "velocities", "accelerations", "torques")
        )
    return torque - found.model.torque(q, qd, qdd, side="joint"), torque


def relative_percent(found: Identification, run: int) -> float:
    error, torque = errors(found, run)
    return float(100.0 * np.linalg.norm(error) / np.linalg.norm(torque))


def joint_rms(found: Identification, run: int) -> np.ndarray:
    """(7,) [Nm]."""
    return np.sqrt(np.mean(errors(found, run)[0] ** 2, axis=0))


def repeatability() -> np.ndarray:
    """Rms of the difference between runs 1 and 2, (7,) [Nm]."""
    torques = []
    for run in (1, 2):
        with np.load(DATA / f"measurements_{run}.npz") as raw:
            torques.append(raw["torques"])
    return np.sqrt(np.mean((torques[0] - torques[1]) ** 2, axis=0))
