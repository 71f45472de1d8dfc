"""Delays from the base model: of joint torques, and of motor torques without joint torques beside them."""

from __future__ import annotations

import importlib
import logging
import re
from dataclasses import replace

import numpy as np
import pytest

from fri.errors import DataError
from ident.estimation.identification import Identification, IdentificationSettings, Known
from ident.estimation.identify import identify
from ident.estimation.validate import validate
from ident.estimators.problem import Problem
from ident.rows.delay import Delay, delays_from_model, shared_delay
from ident.screening.doubts import MEND_TIME, Doubt
from lwr_driver.session import Session
from tests.ident.estimation_arm import Sensors, at_125_hz, chain, drive, fourier, torques, true_base

session_rows = importlib.import_module("ident.estimation.session_rows")
delay_module = importlib.import_module("ident.rows.delay")
SETTINGS = IdentificationSettings(estimator="wls", essential=None)


def alone(late_s: float, seed: int, motion: int = 5, *, loaded: bool = False) -> Session:
    """Motor torques of a whole arm, without its joint torques."""
    sensors = Sensors(position=1e-5, motor=0.3, motor_delay_s=late_s)
    whole = at_125_hz(
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


def test_late_positions_are_told_by_torques_that_fit_better_early(monkeypatch: pytest.MonkeyPatch) -> None:
    def warnings() -> list[str]:
        return [text for one in estimated(-0.008).prepared for text in one.warnings if "ms early" in text]

    assert len(warnings()) == 2
    # One step from rows in time says little of where they fit best.
    monkeypatch.setattr(session_rows, "fits_better", lambda *given: False)
    assert warnings() == []


def test_joints_that_disagree_are_not_early() -> None:
    """Delays of a healthy arm whose friction turns over a path."""
    names = ["a1", "a2", "a3", "a4", "a5", "a6"]
    values = np.array([4.67, -4.72, -3.52, 3.36, -1.71, 1.71]) * 1e-3
    stds = np.array([2.05, 1.73, 2.28, 5.23, 4.21, 6.50]) * 1e-3
    delay = delay_module._agreed(names, values, stds, "motor")
    assert delay.estimate == pytest.approx(-3.4e-3, abs=1e-4)
    assert not delay.early
    # Seven times as sure all of them are.
    assert delay_module._agreed(names, np.full(6, -4.4e-3), stds / 7.0, "motor").early


def test_a_punctual_channel_is_not_late_and_its_interval_is_in_the_deviations() -> None:
    found = estimated(0.0)
    stated = replace(SETTINGS, signals=replace(SETTINGS.signals, motor_delay_s=0.0))
    known = identify([alone(0.0, 1), alone(0.0, 2, 6, loaded=True)], chain(), stated)
    delays = [one.delay for one in found.prepared]
    assert all(delay is not None and delay.seconds == 0.0 and delay.std > 0.0 for delay in delays)
    place = found.base.names.index("Ia4")
    assert found.estimate.std[place] > known.estimate.std[place]


def pulled(late_s: float, seed: int) -> Session:
    """Motor torques alone of an arm whose drives give way to the jump of their friction at each reversal."""
    whole, step, pull = alone(0.0, seed), 1e-3, drive("Fcm") / drive("Ia")
    periods, run_in_s = 10.0, 3.0
    times = np.arange(round(whole.duration_s / step) + 1) * step
    states = np.stack(fourier(times - run_in_s, periods, 5))
    # A controller of 3 Hz holds the motors against it.
    apart, rate = np.zeros((2, 7))
    for q, qd, qdd in states.swapaxes(0, 1):
        change = -(20.0**2) * apart - 32.0 * rate - pull * np.sign(qd + rate)
        q += apart
        qd += rate
        qdd += change
        apart, rate = apart + step * rate + 0.5 * step**2 * change, rate + step * change
    random = np.random.default_rng(seed)
    place = np.rint(np.arange(len(whole.joint)) * whole.joint.period_s / step).astype(np.int64)
    effort = torques(*states, False)[1][np.maximum(place - round(late_s / step), 0)]
    assert whole.motor is not None
    joint = replace(whole.joint, position=states[0][place] + 1e-5 * random.normal(size=effort.shape))
    motor = replace(
        whole.joint,
        topic="/motor_states",
        position=effort[:, :0],
        effort=effort + 0.3 * random.normal(size=effort.shape),
    )
    return replace(whole, joint=joint, motor=motor)


@pytest.mark.parametrize("late_s", [0.0, 0.008])
def test_a_drive_that_gives_way_at_reversals_looks_neither_late_nor_early(late_s: float) -> None:
    signals = replace(SETTINGS.signals, cutoff_hz=5.0, decimate_hz=2.0, reversal_s=0.1)
    found = identify([pulled(late_s, 1)], chain(), replace(SETTINGS, signals=signals))
    delay = found.prepared[0].delay
    assert delay is not None
    assert found.prepared[0].cutoff_hz == 5.0
    assert delay.estimate == pytest.approx(late_s, abs=3.0 * delay.std)
    assert 0.0 < delay.std < 1e-3


def sensed(
    late_s: float, seed: int, motion: int = 5, *, loaded: bool = False, motor_s: float = 0.0
) -> Session:
    """Joint torques `late_s` and motor torques `motor_s` after the positions."""
    sensors = Sensors(position=1e-5, joint=0.05, motor=0.3, motor_delay_s=motor_s, joint_delay_s=late_s)
    return at_125_hz(
        sensors=sensors, seed=seed, motion_seed=motion, loaded=loaded, metadata={"uid": f"{seed}"}
    )


@pytest.mark.slow
@pytest.mark.parametrize(("late_s", "motor_s"), [(0.012, 0.0), (0.003, 0.005), (-0.004, -0.002)])
def test_late_joint_torques_are_found_and_the_motor_torques_against_the_motion(
    late_s: float, motor_s: float
) -> None:
    days = [
        sensed(late_s, 1, motor_s=motor_s),
        sensed(late_s, 2, 6, loaded=True, motor_s=motor_s),
    ]
    found = identify(days, chain(), SETTINGS)
    for one in found.prepared:
        assert one.joint_delay is not None
        assert one.delay is not None
        assert one.joint_delay.seconds == pytest.approx(late_s, abs=max(4.0 * one.joint_delay.std, 1e-4))
        assert one.joint_delay.std < 3e-4
        assert one.delay.seconds == pytest.approx(motor_s, abs=4.0 * one.delay.std)
        assert not one.warnings
    z = (found.estimate.values - true_base(found)) / found.estimate.std
    assert np.mean(np.abs(z) < 2.0) > 0.9
    assert np.max(np.abs(z)) < 4.5
    assert found.model.provenance["signals"]["joint_delay_s"] == pytest.approx(late_s, abs=3e-4)
    shown = "ahead of the positions by" if late_s < 0.0 else "joint torques late by"
    assert shown in found.summary()
    further = sensed(late_s, 3, 7, motor_s=motor_s)
    blind = identify(days, chain(), replace(SETTINGS, signals=replace(SETTINGS.signals, joint_delay_s=0.0)))
    errors = [validate(one.model, [further]).scores[0].relative["joint"] for one in (found, blind)]
    assert errors[0] < 0.9 * errors[1]


@pytest.mark.slow
def test_punctual_joint_torques_are_not_late_and_cost_no_certainty() -> None:
    days = [sensed(0.0, 1), sensed(0.0, 2, 6, loaded=True)]
    found = identify(days, chain(), SETTINGS)
    known = identify(days, chain(), replace(SETTINGS, signals=replace(SETTINGS.signals, joint_delay_s=0.0)))
    for one in found.prepared:
        assert one.joint_delay is not None
        assert one.joint_delay.seconds == 0.0
        assert 0.0 < one.joint_delay.std < 2e-4
    np.testing.assert_allclose(found.estimate.values, known.estimate.values)
    assert np.all(found.estimate.std >= known.estimate.std * (1.0 - 1e-9))
    assert np.median(found.estimate.std / known.estimate.std) < 1.1


@pytest.mark.slow
def test_delays_of_many_long_sessions_come_from_a_few_and_their_first_rows(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(session_rows, "_TOGETHER", 1)
    monkeypatch.setattr(delay_module, "_MOST_ROWS", 60)
    asked = []
    whole = session_rows.delays_from_model

    def counted(problem: Problem, sides: dict[int, str], before: dict[int, float]) -> dict[int, Delay]:
        asked.append((len(problem.record_names), max(len(group.target) for group in problem.groups)))
        return whole(problem, sides, before)

    monkeypatch.setattr(session_rows, "delays_from_model", counted)
    found = identify([sensed(0.006, 1), sensed(-0.002, 2, 6, loaded=True)], chain(), SETTINGS)
    assert {count for count, _ in asked} == {1}
    assert max(rows for _, rows in asked) > 60
    for one, late_s in zip(found.prepared, (0.006, -0.002), strict=True):
        assert one.joint_delay is not None
        assert one.joint_delay.seconds == pytest.approx(late_s, abs=max(4.0 * one.joint_delay.std, 2e-4))


def _late_by_joint(own: dict[str, float]) -> tuple[Delay, tuple[str, ...]]:
    """Delay of joint torques late by joint, and the warnings."""
    found = identify([sensed(0.0, 1)], chain(), SETTINGS)
    groups = []
    for place, group in enumerate(found.problem.groups):
        slope = next(one.columns[place] for one in found.problem.nuisances if place in one.columns)
        late = own[group.joint] if group.side == "joint" else 0.0
        groups.append(replace(group, target=group.target - late * slope))
    delay = delays_from_model(replace(found.problem, groups=tuple(groups)), {0: "joint"}, {0: 0.0})[0]
    prepared = replace(found.prepared[0], joint_delay=delay)
    return delay, session_rows.SessionRows(prepared, found.problem, None).doubted().prepared.warnings


def test_joints_that_disagree_tell_no_delay() -> None:
    names = chain().joint_names
    delay, (told,) = _late_by_joint(dict(zip(names, np.linspace(-0.012, 0.012, 7).tolist(), strict=True)))
    assert delay.disagreement > 3.0
    assert (delay.seconds, delay.std) == (0.0, 0.0)
    assert str(delay) == "not late (the joints disagree)"
    assert re.search(
        r"disagree on the delay of the joint torques, -12.0 ± \S+ ms in A1 and 1[12]\S+ ± \S+ ms in A6", told
    )
    unsure = {name: (late, 5e-3) for name, (late, _) in delay.by_joint.items()}
    assert replace(delay, by_joint=unsure).torn is None


def test_a_joint_late_by_itself_is_named_beside_the_delay_of_the_others() -> None:
    own = dict.fromkeys(chain().joint_names, -0.004)
    delay, _ = _late_by_joint({**own, "A1": 0.004})
    assert delay.apart == ("A1",)
    assert delay.by_joint["A1"][0] == pytest.approx(0.004, abs=3e-4)
    assert delay.seconds == pytest.approx(-0.004, abs=1e-4)


def test_a_joint_late_by_itself_is_a_warning_of_the_result(caplog: pytest.LogCaptureFixture) -> None:
    log = sensed(0.0, 1)
    effort = log.joint.effort.copy()
    effort[:, 2] = np.roll(effort[:, 2], round(0.024 / log.joint.period_s))
    found = identify(replace(log, joint=replace(log.joint, effort=effort)), chain(), SETTINGS)
    # Whoever prints the result prints it; the log is not to say it again.
    assert not [record for record in caplog.records if record.levelno >= logging.WARNING]
    (told,) = [text for text in found.warnings if "of the other joints; check how this" in text]
    late = re.search(r"E1 joint torque fits the motion best ([\d.]+) ± [\d.]+ ms late", told)
    assert late is not None
    assert float(late[1]) == pytest.approx(24.0, abs=0.5)
    known = Known((Doubt("position", ("E1",), "comes late", "late positions", MEND_TIME),))
    again = identify(replace(log, joint=replace(log.joint, effort=effort)), chain(), SETTINGS, known=known)
    assert not [text for text in again.warnings if "of the other joints; check how this" in text]


def test_torques_of_an_arm_at_rest_have_no_delay_to_tell() -> None:
    rows = estimated(0.0).problem
    still = replace(
        rows,
        nuisances=tuple(
            replace(one, columns={k: 0.0 * column for k, column in one.columns.items()})
            for one in rows.nuisances
        ),
    )
    with pytest.raises(DataError, match="changes with its delay"):
        delays_from_model(still, {0: "motor"}, {0: 0.0})


def test_sessions_late_by_other_times_are_told_and_the_model_keeps_the_usual_delay() -> None:
    logs = [alone(0.0, 1), alone(0.02, 2, 6, loaded=True)]
    found = identify(logs, chain(), SETTINGS)
    (told,) = [text for text in found.warnings if "in the other session " in text]
    late = re.match(rf"{logs[1].path.name}: the motor torques come ([\d.]+) ± ", told)
    assert late is not None
    assert float(late[1]) == pytest.approx(20.0, abs=0.5)
    assert found.model.provenance["signals"]["motor_delay_s"] == pytest.approx(0.0, abs=1e-3)
    alike = identify([alone(0.02, 1), alone(0.02, 2, 6, loaded=True)], chain(), SETTINGS)
    assert not [text for text in alike.warnings if "in the other session" in text]


def test_the_delay_that_sessions_share() -> None:
    def delays(*known: tuple[float, float]) -> list[Delay]:
        return [Delay(1e-3 * seconds, 1e-3 * std, "") for seconds, std in known]

    assert shared_delay(delays((2.0, 0.1), (2.2, 0.1))) == (pytest.approx(2.1e-3), ())
    assert shared_delay(delays((20.0, 0.1), (0.5, 0.1))) == (pytest.approx(0.5e-3), (0,))
    assert shared_delay(delays((5.0, 0.1), (5.0, 0.1), (0.0, 0.1))) == (pytest.approx(5e-3), (2,))
    # Within three milliseconds, or within what is known of them.
    assert shared_delay(delays((0.0, 0.1), (2.9, 0.1)))[1] == ()
    assert shared_delay(delays((0.0, 3.0), (12.0, 0.1)))[1] == ()
    # Of a session without a deviation nothing is known.
    assert shared_delay(delays((0.0, 0.0), (12.0, 0.1))) == (pytest.approx(12e-3), ())
