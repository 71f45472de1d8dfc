"""The delay of motor torques without joint torques beside them, from the base model."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fri.errors import DataError
from ident.estimation.identify import Identification, IdentificationSettings, identify
from ident.estimation.validate import validate
from ident.rows.delay import delay_alone
from lwr_driver.session import Session
from tests.ident.estimation_arm import Sensors, chain, session, true_base

SETTINGS = IdentificationSettings(estimator="wls", essential=None)


def alone(late_s: float, seed: int, motion: int = 5, *, loaded: bool = False) -> Session:
    """Motor torques of a whole arm, without its joint torques."""
    sensors = Sensors(position=1e-5, motor=0.3, motor_delay_s=late_s)
    whole = session(
        sensors=sensors, seed=seed, motion_seed=motion, loaded=loaded, metadata={"uid": f"{seed}"}
    )
    return replace(whole, joint=replace(whole.joint, effort=np.zeros((len(whole.joint.log_time), 0))))


def estimated(late_s: float) -> Identification:
    return identify([alone(late_s, 1), alone(late_s, 2, 6, loaded=True)], chain(), SETTINGS)


@pytest.mark.parametrize("late_s", [0.004, 0.012])
def test_a_late_channel_is_found_with_its_interval(late_s: float) -> None:
    found = estimated(late_s)
    for one in found.prepared:
        assert one.delay is not None
        assert one.delay.how == "from the base model"
        assert one.delay.seconds == pytest.approx(late_s, abs=3.0 * one.delay.std)
        assert 0.0 < one.delay.std < 1e-3
    z = (found.estimate.values - true_base(found)) / found.estimate.std
    assert np.mean(np.abs(z) < 2.0) > 0.9
    assert np.max(np.abs(z)) < 4.5
    signals = found.model.provenance["signals"]
    assert signals["motor_delay_s"] == pytest.approx(late_s, abs=1e-3)
    shown = validate(found.model, [alone(late_s, 3, 7)])
    stated = replace(SETTINGS, signals=replace(SETTINGS.signals, motor_delay_s=0.0))
    blind = identify([alone(late_s, 1), alone(late_s, 2, 6, loaded=True)], chain(), stated)
    assert max(shown.scores[0].relative.values()) < max(
        validate(blind.model, [alone(late_s, 3, 7)]).scores[0].relative.values()
    )


def test_a_punctual_channel_is_not_late_and_its_interval_is_in_the_deviations() -> None:
    found = estimated(0.0)
    stated = replace(SETTINGS, signals=replace(SETTINGS.signals, motor_delay_s=0.0))
    known = identify([alone(0.0, 1), alone(0.0, 2, 6, loaded=True)], chain(), stated)
    delays = [one.delay for one in found.prepared]
    assert all(delay is not None and delay.seconds == 0.0 and delay.std > 0.0 for delay in delays)
    place = found.base.names.index("Ia4")
    assert found.estimate.std[place] > known.estimate.std[place]


def test_torques_of_an_arm_at_rest_have_no_delay_to_tell() -> None:
    rows = estimated(0.0).problem
    still = replace(
        rows, groups=tuple(replace(group, matrix=group.matrix * 0.0 + 1.0) for group in rows.groups)
    )
    with pytest.raises(DataError):
        delay_alone(still, [0], (still, still), [0.0])
    with pytest.raises(DataError, match="changes with its delay"):
        delay_alone(rows, [0], (rows, rows), [0.0])
