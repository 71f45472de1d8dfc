"""What several tests of the diagnosis compare with."""

from __future__ import annotations

import pickle
from collections.abc import Callable
from pathlib import Path

import pytest

from ident.diagnosis import Reference, commission
from ident.dynamics.kinematics import Chain
from tests.ident.diagnosis.changes import Make, pair


@pytest.fixture(scope="session")
def reference(
    made_once: Callable[[str, Callable[[Path], None]], Path], make: Make, chain: Chain
) -> Reference:
    """Two days tell that the gains of these sensors do not change from day to day."""

    def fill(folder: Path) -> None:
        found = commission([pair(make, seed=11), pair(make, seed=21)], chain)
        (folder / "reference.pickle").write_bytes(pickle.dumps(found))

    found: Reference = pickle.loads((made_once("three_joints", fill) / "reference.pickle").read_bytes())
    return found
