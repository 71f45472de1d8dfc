"""The campaign lies beside the packages, in benchmarks/."""

from __future__ import annotations

import pytest


@pytest.fixture(scope="module")
def ring():
    from benchmarks.trust.stand import shared_ring

    with shared_ring() as ring:
        yield ring
