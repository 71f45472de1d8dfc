"""The campaign lies beside the packages, in benchmarks/."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
if str(ROOT) not in sys.path:
    sys.path.insert(0, str(ROOT))


@pytest.fixture(scope="module")
def ring():
    from benchmarks.trust.stand import shared_ring

    with shared_ring() as ring:
        yield ring
