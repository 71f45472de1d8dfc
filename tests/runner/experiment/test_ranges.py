"""Every number and text of the files has a range, declared beside its key, and a part of the crafted files."""

from __future__ import annotations

import dataclasses
import typing
from collections.abc import Iterator
from typing import Any

import msgspec
import pytest

from benchmarks.trust.files import CASES, UNCHANGED, judge
from fri.quantities import metas
from ident.excitation.plan import FourierKeys, PlanFile, PointKeys, SplineKeys
from ident.excitation.problem import PlanProblem
from ident.import_log import LogMapping
from lwr_driver.arm.cell import Cell
from lwr_driver.arm.description import ArmFile
from runner.estimation import IdentifySettings
from runner.experiment_file import Experiment
from sim_backend.configuration import EmulatorConfig
from sim_backend.faults import WireFault
from sim_backend.operator import ScheduleEntry

FILES = (
    Experiment, ArmFile, Cell, EmulatorConfig, WireFault, ScheduleEntry,
    PlanProblem, PlanFile, FourierKeys, SplineKeys, PointKeys, LogMapping, IdentifySettings,
)  # fmt: skip


def without_range(hint: Any, key: str) -> Iterator[str]:
    """Keys of numbers without two ends, and of texts without a length."""
    hint, ranges = metas(hint)
    if hint in (int, float):
        ends = [
            (m.ge is not None or m.gt is not None) and (m.le is not None or m.lt is not None) for m in ranges
        ]
        if not any(ends):
            yield key
    elif hint is str:
        if not any(m.max_length for m in ranges):
            yield key
    elif dataclasses.is_dataclass(hint):
        yield from keys_without_range(hint, f"{key}.")
    elif typing.get_origin(hint) not in (typing.Literal, dict):
        for part in typing.get_args(hint):
            yield from without_range(part, key)


def keys_without_range(cls: Any, prefix: str = "") -> list[str]:
    hints = typing.get_type_hints(cls, include_extras=True)
    fields = [field.name for field in dataclasses.fields(cls) if field.init]
    return [key for name in fields for key in without_range(hints[name], prefix + name)]


@pytest.mark.parametrize("cls", FILES)
def test_every_number_has_a_range_and_every_text_a_length(cls: type) -> None:
    # `base`, `model`, or names of their own length.
    assert set(keys_without_range(cls)) <= {"parameters"}


def test_a_schema_is_made_from_the_same_declarations() -> None:
    schema = msgspec.json.schema(Cell)
    edge = schema["$defs"]["Box"]["properties"]["size_m"]["prefixItems"][0]
    assert (edge["minimum"], edge["maximum"], edge["unit"]) == (0.001, 20.0, "m")


@pytest.mark.parametrize("case", [case for case in UNCHANGED if case[0] == "experiment"])
def test_the_files_without_a_change_pass(case: tuple[str, str, None]) -> None:
    assert judge(*case)[0] == []


@pytest.mark.parametrize("number", range(5, len(CASES), 40))
def test_crafted_files_end_in_an_error_with_advice(number: int) -> None:
    bad, _ = judge(*CASES[number])
    assert bad == [], CASES[number]
