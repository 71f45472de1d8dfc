"""Loops in step."""

from __future__ import annotations

from typing import Any

import pytest

from tests.lwr_driver.driver_twins import Twins


@pytest.fixture
def twins():
    made: list[Twins] = []

    def make(*arguments: Any, **options: Any) -> Twins:
        made.append(Twins(*arguments, **options))
        return made[-1]

    yield make
    for each in made:
        each.close()
