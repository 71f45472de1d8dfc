"""The signal settings that a model carries."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fri.errors import ConfigurationError
from ident.dynamics.structure import DriveMotion
from ident.effects import ELASTICITY, entry_of
from ident.estimation import IdentificationSettings, identify, signals_for, validate
from ident.estimation.validate import predictor
from ident.model.model_file import read_model, write_model
from ident.model.signals import signal_settings, signals_entry, taken_back
from ident.rows.delay import Delay
from ident.rows.filters import SignalSettings
from ident.rows.prepared import TorqueChannel


@pytest.fixture(scope="module")
def found(bench: Any) -> Any:
    sessions = [bench.session("one", seed=31), bench.session("two", seed=32, payload="load")]
    signals = SignalSettings(cutoff_hz=8.0, decimate_hz=1.5, standstill_rad_s=3e-3)
    return identify(sessions, bench.chain, IdentificationSettings(signals=signals, essential=None))


def test_a_model_knows_how_its_sessions_were_filtered_and_timed(found: Any, tmp_path: Path) -> None:
    write_model(found.model, tmp_path / "m.yaml")
    signals = signal_settings(read_model(tmp_path / "m.yaml"))
    assert signals is not None
    assert (signals.cutoff_hz, signals.decimate_hz, signals.standstill_rad_s) == (8.0, 1.5, 3e-3)
    delays = [session.delay for session in found.prepared]
    assert min(d.seconds for d in delays) <= signals.motor_delay_s <= max(d.seconds for d in delays)


def test_a_session_that_tells_no_delay_has_no_part_in_that_of_the_model(found: Any) -> None:
    one, other = found.prepared
    told = replace(one, joint_delay=Delay(0.01, 1e-4, "from the base model"))
    untold = replace(other, joint_delay=Delay(0.0, 0.0, "the joints disagree"))
    assert signals_entry(SignalSettings(), [told, untold])["joint_delay_s"] == pytest.approx(0.01)
    assert signals_entry(SignalSettings(), [untold, untold])["joint_delay_s"] == 0.0
    stated = replace(one, joint_delay=Delay(0.004, 0.0, "stated"))
    assert signals_entry(SignalSettings(), [stated, stated])["joint_delay_s"] == pytest.approx(0.004)


def test_validation_takes_the_settings_and_the_delay_of_the_model(found: Any, bench: Any) -> None:
    session = bench.session("third", seed=33)
    own = validate(found.model, session)
    assert own.scores[0].band_hz == 1.5
    given = validate(found.model, session, settings=signal_settings(found.model))
    assert own.to_dict() == given.to_dict()
    assert signals_for(found.model, estimate_delay=True).motor_delay_s == "estimate"
    estimated = validate(found.model, session, estimate_delay=True)
    assert estimated.scores[0].relative["joint"] == own.scores[0].relative["joint"]
    late = replace(signal_settings(found.model), motor_delay_s=0.004)
    assert (
        validate(found.model, session, settings=late).scores[0].relative["motor"]
        > 1.01 * own.scores[0].relative["motor"]
    )


def test_a_model_without_settings_has_the_defaults(found: Any) -> None:
    older = replace(found.model, provenance={"sessions": []})
    assert signal_settings(older) is None
    assert signals_for(older) == SignalSettings()


def test_settings_of_no_use_name_the_model(found: Any) -> None:
    wrong = replace(found.model, provenance={"signals": {"cutoff_hz": -1.0, "a_later_key": 5}})
    with pytest.raises(ConfigurationError, match=r"`provenance\.signals` cannot be used: `cutoff_hz` is -1"):
        signal_settings(wrong)


def test_the_twist_of_an_effect_is_taken_back_with_that_of_the_arm(found: Any) -> None:
    springs = SignalSettings(stiffness_nm_rad=(1e4,) * 7, encoder="motor")
    behind, ahead = (ELASTICITY.at_encoder(side).form.value for side in ("motor", "link"))
    softer = entry_of(ELASTICITY, [2], {"compliance": (1e-4, 1e-6)}, behind)
    beside = entry_of(ELASTICITY, [2], {"compliance": (1e-4, 1e-6)}, ahead)
    model = replace(found.model, effects=(softer, beside), provenance={"signals": signals_entry(springs)})
    assert taken_back(model) == (softer,)
    stiffness = signals_for(model).stiffness_nm_rad
    assert stiffness == pytest.approx((1e4, 5e3, *(1e4,) * 5))
    # Settings that are given hold as they are, and positions of the links need nothing taken back.
    assert signals_for(model, springs) is springs
    links = replace(springs, encoder="link")
    model = replace(model, provenance={"signals": signals_entry(links)})
    assert signals_for(model).stiffness_nm_rad == links.stiffness_nm_rad


def test_the_torque_of_a_channel_is_that_of_its_motors_and_links(found: Any) -> None:
    behind = ELASTICITY.at_encoder("motor").form.value
    softer = replace(found.model, effects=(entry_of(ELASTICITY, [2], {"compliance": (1e-3, 1e-6)}, behind),))
    rng = np.random.default_rng(4)
    q, qd, qdd, speed, acceleration = 0.1 * rng.normal(size=(5, 400, 7))
    times, flags = 1e-3 * np.arange(400), np.zeros((400, 7), dtype=bool)
    moved = DriveMotion(speed, acceleration)
    rigid = TorqueChannel("motor", times, q, qd, qdd, q, flags, flags)
    elastic = replace(rigid, drive=moved)
    links = replace(elastic, taken_back=True)
    own = partial(found.model.torque, q, qd, qdd, time=times, side="motor")
    np.testing.assert_array_equal(predictor(softer, None)(links, "motor"), own(drive=moved))
    np.testing.assert_array_equal(predictor(found.model, None)(rigid, "motor"), own())
    twisted = softer.torque(q, qd, qdd, time=times, side="motor", drive=moved)
    np.testing.assert_array_equal(predictor(softer, None)(elastic, "motor"), twisted)
    assert not np.allclose(twisted, own(drive=moved))
