"""Identification, validation and cross-validation screen their sessions, once."""

from __future__ import annotations

from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest

from benchmarks.wrong_channels import constant, from_the_middle, scaled, shifted, swapped
from fri.errors import DataError
from ident.estimation import Identification, IdentificationSettings, cross_validate, identify, validate
from ident.estimation.identification import Known
from ident.estimators.names import AUTO
from ident.rows.filters import SignalSettings
from ident.screening.doubts import Doubt
from ident.screening.screen import screen
from lwr_driver.session import Session
from tests.ident.estimation_arm import Sensors, chain, session

SENSORS = Sensors(position=2e-5, joint=0.03, motor=0.1, motor_step_s=0.012)
PLAIN = IdentificationSettings(essential=None)


def recorded(name: str, motion_seed: int) -> Session:
    made = session(sensors=SENSORS, seed=motion_seed, motion_seed=motion_seed, metadata={"uid": name})
    return replace(made, path=Path(f"{name}.mcap"))


@pytest.fixture(scope="module")
def trio() -> list[Session]:
    return [recorded(name, seed) for name, seed in (("a", 5), ("b", 6), ("c", 7))]


@pytest.fixture(scope="module")
def found(trio: list[Session]) -> Identification:
    return identify(trio[:1], chain(), PLAIN)


@pytest.fixture
def screened(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Number of sessions of each screening."""
    seen: list[int] = []

    def counted(sessions: Any, *rest: Any, **options: Any) -> Any:
        seen.append(len(list(sessions)))
        return screen(sessions, *rest, **options)

    for place in ("ident.screening.screen", "ident.estimation.validate"):
        monkeypatch.setattr(import_module(place), "screen", counted)
    return seen


@pytest.mark.slow
@pytest.mark.parametrize("tilt", [False, True])
def test_a_chosen_estimator_screens_once_and_gives_no_advice_on_chosen_cut_offs(
    trio: list[Session], screened: list[int], tilt: bool
) -> None:
    from ident.estimation.automatic import choose

    gain = scaled("joint", "effort", 1.3, "A2")(trio[:1])
    auto = choose(gain, chain(), replace(PLAIN, estimator=AUTO), tilt=tilt)
    assert screened == [1]
    assert [warning for warning in auto.warnings if "A2 joint torque: is 1." in warning]
    assert auto.known.signal_reasons
    assert not [warning for warning in auto.warnings if "cut-off" in warning]
    assert any(reason in auto.summary() for reason in auto.known.signal_reasons)


def test_what_is_known_of_sessions_is_not_asked_again(trio: list[Session], screened: list[int]) -> None:
    known = Known((Doubt("log", (), "something seen before", "", "look"),), ("a reason",))
    again = identify(trio[:1], chain(), PLAIN, known=known)
    assert screened == []
    assert again.known == known
    assert again.warnings == ("log: something seen before; look",)


def test_a_wrong_torque_is_no_lack_of_motion(trio: list[Session]) -> None:
    drifted = from_the_middle("joint", "effort", shifted("joint", "effort", 100.0, "A2"))(trio[:1])
    found = identify(drifted, chain(), PLAIN)
    (doubt,) = found.known.doubts
    assert found.warnings == (str(doubt),)
    assert found.assumptions["condition number"].holds
    (weak,) = identify(drifted, chain(), PLAIN, known=Known()).warnings
    assert weak.startswith("the motion hardly shows Fvl2 ")


def test_worthless_sessions_are_not_validated(trio: list[Session], found: Identification) -> None:
    bad = swapped("motor", "effort", "E1", "A3")(trio[1:2])
    with pytest.raises(DataError, match=r"E1, A3 motor torque: .*interchanged"):
        validate(found.model, bad)
    dead = constant("motor", "effort", 0.0, "A6")(trio[2:])
    kept = validate(found.model, [trio[1], *dead], keep_going=True)
    assert [score.session for score in kept.scores] == ["b.mcap"]
    assert [(one.session, "dead sensor" in str(one.error)) for one in kept.unscored] == [("c.mcap", True)]


def test_doubts_are_warnings_of_a_validation(trio: list[Session], found: Identification) -> None:
    checked = validate(found.model, scaled("joint", "effort", 1.3, "A2")(trio[1:2]))
    warning, poor = checked.warnings
    assert "A2 joint torque: is 1." in warning
    assert "the joint torque is off by" in poor
    assert checked.to_dict()["warnings"] == [warning, poor]
    assert f"warning: {warning}" in str(checked)
    assert validate(found.model, trio[1:2]).warnings == ()
    unscreened = validate(found.model, scaled("joint", "effort", 1.3, "A2")(trio[1:2]), known=Known())
    assert unscreened.warnings == (poor,)


def test_a_repeated_log_harms_no_score(trio: list[Session], found: Identification) -> None:
    twice = validate(found.model, [trio[1], trio[1]])
    assert len(twice.scores) == 2
    assert any("given twice" in warning for warning in twice.warnings)


def test_a_channel_without_use_in_the_model_is_not_screened(trio: list[Session]) -> None:
    bad = constant("motor", "effort", 0.0, "A6")(trio[:2])
    with pytest.raises(DataError, match="dead sensor"):
        identify(bad[:1], chain(), PLAIN)
    alone = identify(bad[:1], chain(), replace(PLAIN, model=1))
    assert alone.warnings == ()
    assert validate(alone.model, bad[1:]).warnings == ()


def test_cross_validation_screens_all_sessions_once(trio: list[Session], screened: list[int]) -> None:
    signals = SignalSettings(cutoff_hz=10.0, decimate_hz=2.0, reversal_s=0.02)
    settings = replace(PLAIN, model=1, signals=signals)
    result = cross_validate(scaled("joint", "effort", 1.3, "A2")(trio[:2]), chain(), settings)
    assert screened == [2]
    assert len(result.scores) == 2
    (warning,) = result.warnings
    assert result.to_dict()["warnings"] == [warning]
    assert f"warning: {warning}" in str(result)
    with pytest.raises(DataError, match="interchanged"):
        cross_validate(swapped("joint", "effort", "E1", "A3")(trio[:2]), chain(), settings)


def test_given_cut_offs_are_judged_and_those_of_the_model_are_not(
    trio: list[Session], found: Identification, caplog: pytest.LogCaptureFixture
) -> None:
    low = SignalSettings(cutoff_hz=1.5, decimate_hz=1.0, reversal_s=0.02, motor_delay_s=0.0)
    for settings, said in ((low, True), (None, False)):
        caplog.clear()
        validate(found.model, trio[1:2], settings=settings)
        assert any("cut-off" in record.message for record in caplog.records) == said
