"""Loops with their controllers, one or several in step."""

from __future__ import annotations

from typing import Any

import pytest

from tests.lwr_driver.driver_rig import Rig
from tests.lwr_driver.driver_twins import Twins


@pytest.fixture
def rig():
    rigs: list[Rig] = []

    def make(period_ms: int = 1, **options: object) -> Rig:
        rigs.append(Rig(period_ms, **options))
        return rigs[-1]

    yield make
    for each in rigs:
        each.close()


@pytest.fixture
def twins():
    made: list[Twins] = []

    def make(*arguments: Any, **options: Any) -> Twins:
        made.append(Twins(*arguments, **options))
        return made[-1]

    yield make
    for each in made:
        each.close()
