"""Without a healthy arm a diagnosis tells positions of the motors as `identify` does."""

from __future__ import annotations

import numpy as np
import pytest

from ident.diagnosis import Diagnosis, DiagnosisSettings, diagnose
from ident.model.signals import positions_of_motors
from ident.rows.filters import SignalSettings
from lwr_driver.session import Session
from tests.ident import estimation_arm as arm


def recorded(seed: int) -> Session:
    sensors = arm.Sensors(position=1e-6, joint=0.02)
    return arm.session(sensors=sensors, motor=False, seed=seed, motion_seed=seed)


def error(found: Diagnosis) -> float:
    """Of the base model on the further motion, all joints [Nm]."""
    return float(np.linalg.norm(found.rms_base["joint"]))


@pytest.mark.slow
def test_links_are_taken_back_from_positions_of_the_motors() -> None:
    links = [recorded(5), recorded(6)]
    motors = [arm.at_the_motors(one) for one in links]
    # The base model tells the side, whatever causes there are.
    few = ["cable_spring"]
    behind, published = (
        diagnose(some[:1], arm.chain(), test=some[1:], causes=few) for some in (links, motors)
    )
    as_published = DiagnosisSettings(signals=SignalSettings(encoder="link"))
    twisted = diagnose(motors[:1], arm.chain(), test=motors[1:], causes=few, settings=as_published)
    assert not positions_of_motors(behind.base_model)
    assert positions_of_motors(published.base_model)
    assert positions_of_motors(published.extended_model)
    assert error(published) < 0.5 * error(twisted)
    assert any("those of the motors" in note for note in published.notes)
    assert not any("those of the motors" in note for note in behind.notes)
