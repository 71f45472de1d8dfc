"""Results kept by content: equal data give the kept result, any difference a new one."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ident.dynamics.kinematics import Chain
from ident.dynamics.structure import ModelStructure
from ident.estimation.identification import IdentificationSettings
from ident.estimation.identify import identify
from ident.rows import signal_choice
from ident.rows.content import Kept, Recall, content
from ident.rows.filtered_motion import WideMotion
from ident.rows.filters import SignalSettings
from ident.rows.prepare import prepare
from ident.rows.signal_choice import choose_signals
from lwr_driver.session import Session
from tests.ident.estimation_arm import Sensors, chain, session

screening = import_module("ident.screening.screen")
SHORT = SignalSettings(cutoff_hz=10.0, decimate_hz=2.0, reversal_s=0.05)


@dataclass(frozen=True)
class Pair:
    first: Any
    second: Any


THINGS = [
    None, True, 1, 1.0, "1", b"1", 0.5, np.float64(0.5), (), [1, 2], [2, 1], ((1,), 2), (1, (2,)), {"a": 1},
    {"a": 2}, {"b": 1}, frozenset({1, 2}), Path("a"), "a", Pair(1, 2), Pair(2, 1), np.arange(3), np.arange(4),
    np.arange(3.0), np.arange(3.0)[:, None], np.array([0.0, 1.0, 2.0 + 1e-15]), np.array(1.0), np.zeros((0, 2)),
]  # fmt: skip


def test_things_of_equal_content_have_one_digest_and_others_another() -> None:
    digests = [content(thing) for thing in THINGS]
    assert len(set(digests)) == len(THINGS)
    copies = [thing.copy() if isinstance(thing, np.ndarray) else thing for thing in THINGS]
    assert [content(thing) for thing in copies] == digests
    assert content(1, 2) != content((1, 2))


@pytest.mark.parametrize("thing", [object(), lambda: None, np.array([object()]), int])
def test_what_has_no_plain_content_is_refused(thing: Any) -> None:
    with pytest.raises(TypeError, match="no plain content"):
        content(thing)


def test_an_array_changed_in_place_is_another() -> None:
    values = np.zeros(10)
    before = content(values)
    values[3] = 1.0
    assert content(values) != before


def test_the_latest_results_are_kept() -> None:
    asked: list[int] = []

    def double(value: int) -> int:
        asked.append(value)
        return 2 * value

    kept = Kept[int](2)
    assert [kept.of(double, value) for value in (1, 2, 1, 3, 1, 2)] == [2, 4, 2, 6, 2, 4]
    assert asked == [1, 2, 3, 2]


def test_the_same_arrays_and_equal_figures_give_the_recalled_result() -> None:
    recall, values = Recall(), np.arange(3.0)
    first = recall.of(partial(np.multiply, values, 2.0), values, 2.0)
    assert first.tolist() == [0.0, 2.0, 4.0]
    assert recall.of(partial(np.multiply, values, 5.0), values, 2.0) is first
    others: list[tuple[Any, ...]] = [
        (np.multiply, values.copy(), 2.0), (np.multiply, values, 3.0), (np.add, values, 2.0)
    ]  # fmt: skip
    for make, *things in others:
        assert recall.of(partial(make, *things), *things) is not first
    assert Recall().of(partial(np.multiply, values, 2.0), values, 2.0) is not first


def test_the_latest_results_of_a_function_are_recalled() -> None:
    recall, values = Recall(), [np.full(2, 1.0), np.full(2, 2.0), np.full(2, 3.0)]

    def found(make: Any, number: int) -> Any:
        return recall.of(partial(make, values[number]), values[number], most=2)

    first, second, other = found(np.negative, 0), found(np.negative, 1), found(np.positive, 2)
    assert found(np.negative, 0) is first
    found(np.negative, 2)
    assert found(np.negative, 0) is first
    assert found(np.negative, 1) is not second
    assert found(np.positive, 2) is other


@pytest.fixture(scope="module")
def recorded() -> Session:
    return session(sensors=Sensors(joint=0.05, motor=0.1))


def changes(one: Session) -> list[Session]:
    """The same recording with a little of it changed, one thing at a time."""
    moved = one.joint.position.copy()
    moved[100, 0] += 1e-9
    return [
        replace(one, joint=replace(one.joint, position=moved)),
        replace(one, path=Path("other.mcap")),
        replace(one, metadata={**one.metadata, "payload": "other"}),
        replace(one, phases=one.phases[:-1]),
        replace(one, motor=None),
    ]


def test_equal_recordings_are_screened_once_and_changed_ones_anew(
    recorded: Session, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls: list[int] = []
    monkeypatch.setattr(screening, "_screened", Kept(8))
    monkeypatch.setattr(screening, "_doubts", lambda *rest, **options: (calls.append(1), ())[1])
    arm = chain()
    copy = replace(recorded, joint=replace(recorded.joint, effort=recorded.joint.effort.copy()))
    for one in (recorded, copy):
        screening.screen([one], arm)
    assert len(calls) == 1
    for number, one in enumerate(changes(recorded), start=2):
        screening.screen([one], arm)
        assert len(calls) == number
    screening.screen([recorded], arm, SHORT)
    screening.screen([recorded], replace(arm, gravity=np.array([0.1, 0.0, -9.8])))
    assert len(calls) == 8


def test_the_choice_of_equal_recordings_is_made_once_and_of_changed_ones_anew(
    recorded: Session, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls: list[int] = []
    arm: Chain = chain()

    def chosen(*rest: Any, **options: Any) -> signal_choice.SignalChoice:
        calls.append(1)
        return signal_choice.SignalChoice(
            SHORT, ModelStructure(arm, 2).coulomb, ModelStructure(arm, 2).coulomb
        )

    monkeypatch.setattr(signal_choice, "_choices", Kept(16))
    monkeypatch.setattr(signal_choice, "_chosen", chosen)

    def ask(one: Session, payload: str | None = None, model: int = 2, columns: int = 20) -> None:
        structure = ModelStructure(arm, model)
        choose_signals([one], [payload], structure, np.arange(columns), SignalSettings())

    ask(recorded)
    ask(recorded)
    assert len(calls) == 1
    for number, one in enumerate(changes(recorded), start=2):
        ask(one)
        assert len(calls) == number
    ask(recorded, payload="load")
    ask(recorded, model=1)
    ask(recorded, columns=21)
    assert len(calls) == 9


def counted(monkeypatch: pytest.MonkeyPatch, where: Any, name: str) -> list[dict[str, Any]]:
    """The keyword arguments of the calls of a function of a module or class."""
    calls: list[dict[str, Any]] = []
    plain = getattr(where, name)

    def call(*rest: Any, **options: Any) -> Any:
        calls.append(options)
        return plain(*rest, **options)

    monkeypatch.setattr(where, name, call)
    return calls


def test_the_motion_of_elastic_joints_is_filtered_once_for_all_windows_beside_reversals(
    recorded: Session, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls, recall = counted(monkeypatch, WideMotion, "of"), Recall()
    elastic = replace(SHORT, motor_delay_s=0.0, stiffness_nm_rad=(1e4,) * len(recorded.joint_names))
    for settings in (elastic, replace(elastic, reversal_s=0.2), replace(elastic, encoder="link")):
        prepare(recorded, settings, log=False, recall=recall)
    assert len(calls) == 1
    stiffer = replace(elastic, stiffness_nm_rad=(2e4,) * len(recorded.joint_names))
    for number, settings in enumerate((replace(elastic, encoder="motor"), stiffer), start=2):
        prepare(recorded, settings, log=False, recall=recall)
        assert len(calls) == number


def test_outliers_found_by_the_screening_are_those_of_the_rows(
    recorded: Session, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(screening, "_screened", Kept(8))
    calls, recall = counted(monkeypatch, import_module("ident.rows.prepare"), "flag_outliers"), Recall()
    screening.screen([recorded], chain(), recall=recall)
    prepare(recorded, SHORT, log=False, recall=recall)
    assert len(calls) == 3


def test_the_delay_of_joint_torques_is_told_without_the_motor_torques(
    recorded: Session, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls = counted(monkeypatch, import_module("ident.estimation.session_rows"), "prepare")
    identify([recorded], chain(), IdentificationSettings(signals=SHORT, essential=None))
    assert [call["motor"] for call in calls[:2]] == [True, False]


@pytest.mark.parametrize(("least_bytes", "times"), [(4 * 2**20, 1), (0, 2)])
def test_arrays_of_a_long_session_are_not_recalled(
    recorded: Session, monkeypatch: pytest.MonkeyPatch, least_bytes: int, times: int
) -> None:
    monkeypatch.setattr(import_module("ident.rows.filtered_motion"), "LEAST_BYTES", least_bytes)
    calls, recall = counted(monkeypatch, import_module("ident.rows.prepare"), "_sound"), Recall()
    for reversal_s in (0.05, 0.2):
        prepare(recorded, replace(SHORT, reversal_s=reversal_s), log=False, recall=recall)
    assert len(calls) == times
