"""The estimator that predicts best: parts held back, the choice, its reasons, and weak motions."""

from __future__ import annotations

import re
from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest

from fri.errors import ConfigurationError, DataError
from ident.dynamics.kinematics import Chain
from ident.estimation.automatic import BesideGains, choose
from ident.estimation.estimator_comparison import EstimatorComparison, Kind
from ident.estimation.identification import Identification, IdentificationSettings, Known
from ident.estimation.identify import identify
from ident.estimation.parts import PARTS, beside, held_back_parts
from ident.estimators import MaximumAPosteriori, Prior, Problem, RowGroup, WeightedLeastSquares
from ident.estimators.physical import lacking_bodies
from ident.estimators.prior import Disagreement
from tests.ident.estimation_arm import Sensors, at_125_hz, chain, true_base
from tests.ident.regression_problems import design, problem

SENSORS = Sensors(position=1e-5, joint=0.2, correlation_s=0.3)
MODEL_1 = IdentificationSettings(model=1, estimator="auto", essential=None)
# No doubts about the sessions: the choice is the same without their screening.
SCREENED = Known()


@lru_cache
def chosen(periods: int = 3, kilogrammes: float | None = None) -> Identification:
    """By `auto`; with `kilogrammes` every link of the URDF has this mass."""
    text = chain().urdf
    assert isinstance(text, str)
    if kilogrammes is not None:
        text = re.sub(r'<mass value="[^"]*"', f'<mass value="{kilogrammes}"', text)
        text = re.sub(r'<origin xyz="[^"]*"(?=[^<]*/>\s*<mass)', '<origin xyz="0 0 0"', text)
    logs = [at_125_hz(sensors=SENSORS, motor=False, periods=periods)]
    return identify(logs, Chain.from_urdf(text), MODEL_1, known=SCREENED if kilogrammes else None)


def repeated(shift: int = 0) -> Problem:
    """Two records of one motion of 200 rows, the second begun `shift` rows later, of two payloads or one."""
    matrices = design(records=1, samples=200)
    second = [np.roll(m, -shift, axis=0) for m in matrices]
    rows = [*matrices, *second]
    return problem(rows, np.ones(12), [np.zeros(200)] * len(rows))


def test_a_repeated_motion_is_held_back_with_its_repeat():
    parts = held_back_parts(repeated(), (None, None), 5)
    np.testing.assert_array_equal(parts[0], parts[3])
    assert set(parts[0].tolist()) == set(range(PARTS))
    later = held_back_parts(repeated(50), (None, None), 5)
    np.testing.assert_array_equal(later[0], np.roll(later[3], 50))


def test_every_payload_stays_in_the_training_rows():
    parts = held_back_parts(repeated(), (None, "load"), 5)
    for record in (0, 3):
        assert set(parts[record].tolist()) == set(range(PARTS))
    np.testing.assert_array_equal(parts[0], parts[3])


def test_a_motion_of_two_blocks_has_no_parts():
    assert all(np.all(part == -1) for part in held_back_parts(repeated(), (None, None), 200))


def test_rows_beside_a_part_are_left_out_by_time_not_by_number():
    time = np.array([0, 1, 2, 3, 9, 10])
    near = beside(time, np.array([False, False, False, True, False, False]), 2)
    assert near.tolist() == [False, True, True, True, False, False]


def test_a_good_prior_wins_and_the_text_says_by_how_much():
    found = chosen()
    assert found.choice is not None
    winner = found.choice.winner
    errors = {(c.estimator, c.prior_scale, c.tilt): c.held_back_percent for c in found.choice.candidates}
    assert winner.estimator == "physical"
    assert not winner.tilt
    assert errors["physical", 1.0, False] < errors["wls", None, False]
    text = found.summary()
    for candidate in found.choice.candidates:
        assert f"{candidate.held_back_percent:.2f}" in text
    assert found.model.provenance["choice"]["chosen"] == winner.title
    assert found.to_dict()["choice"]["candidates"][0]["by_joint_percent"].keys() == {
        f"{name} joint" for name in chain().joint_names
    }
    assert found.settings.estimator == "auto"


@pytest.mark.parametrize(("wls", "winner"), [(0.5, "wls"), (3.0, "physical")])
def test_what_predicts_no_better_than_zero_is_no_choice(
    monkeypatch: pytest.MonkeyPatch, wls: float, winner: str
) -> None:
    """A part of a short motion, estimated from the others, may be off by any factor; one part with most of the error
    has no significant difference."""

    def errors(self: EstimatorComparison, kind: Kind) -> np.ndarray:
        torque = self.held[:, :, -1, -1].sum(axis=0)
        share = np.zeros(len(self.held))
        share[0] = wls if kind[0] == "wls" else 1e6
        return share[:, None] * torque

    monkeypatch.setattr(EstimatorComparison, "_errors", errors)
    found = choose(
        [at_125_hz(sensors=SENSORS, motor=False, periods=3)], chain(), MODEL_1, tilt=False, known=SCREENED
    )
    assert found.choice is not None
    assert found.choice.winner.estimator == winner
    assert ("not compared" in " ".join(found.choice.advice)) == (winner == "physical")
    assert np.isnan(found.choice.winner.held_back_percent) == (winner == "physical")


def test_a_tilt_is_found_where_it_helps():
    log = at_125_hz(sensors=SENSORS, motor=False, periods=3)
    turn = np.deg2rad(2.0)
    turned = Chain.from_urdf(chain().urdf, gravity=(0.0, 9.81 * np.sin(turn), -9.81 * np.cos(turn)))
    found = choose([log], turned, MODEL_1, known=SCREENED)
    assert found.choice is not None
    assert found.choice.mounting is not None
    assert np.rad2deg(np.linalg.norm(found.choice.mounting.tilt_rad)) == pytest.approx(2.0, abs=0.3)
    assert "the base leans by" in str(found.choice)
    upright = choose([log], turned, MODEL_1, known=SCREENED, tilt=False)
    assert upright.choice is not None
    assert not any(candidate.tilt for candidate in upright.choice.candidates)


def test_an_earlier_choice_is_taken_for_other_sessions_and_estimates_anew(monkeypatch: pytest.MonkeyPatch):
    first = chosen(kilogrammes=4.0).choice
    assert first is not None
    monkeypatch.setattr("ident.estimation.automatic.compared", None)
    other = at_125_hz(sensors=SENSORS, motor=False, seed=7)
    again = choose([other], chain(), MODEL_1, known=SCREENED, like=first)
    assert again.choice is not None
    assert again.choice.winner == first.winner
    assert again.choice.used == first.used
    assert not np.array_equal(again.model.values, chosen(kilogrammes=4.0).model.values)


def test_a_sensor_that_reads_too_much_is_found_and_stated_as_an_effect():
    log = at_125_hz(sensors=SENSORS, motor=False, periods=3)
    effort = log.joint.effort.copy()
    effort[:, 1] *= 1.08
    changed = replace(log, joint=replace(log.joint, effort=effort))
    found = identify(changed, chain(), MODEL_1)
    assert found.choice is not None
    (joint,) = found.choice.gains
    assert joint == chain().joint_names[1]
    # Bodies free of the prior mimic a part of the gain; beside it they do not pay.
    assert found.choice.winner.title == f"physical, sensor gain of {joint}"
    error, std = found.choice.gains[joint]
    assert error == pytest.approx(0.08, abs=3.0 * std)
    assert std < 0.02
    (effect,) = found.model.effects
    assert (effect["cause"], effect["joints"]) == ("sensor_gain", [2])
    assert found.model.torque(log.joint.position, *np.zeros((2, *effort.shape)), measured=True)[
        :, 1
    ] == pytest.approx(
        (1.0 + error) * found.model.torque(log.joint.position, *np.zeros((2, *effort.shape)))[:, 1]
    )
    assert "joint torque sensors read too much by" in found.summary()


def test_an_error_common_to_most_sensors_is_one_of_the_bodies():
    """Beside a sensor that reads far too little the others' errors have a common part of two per cent."""
    log = at_125_hz(sensors=SENSORS, motor=False, periods=3)
    effort = log.joint.effort.copy()
    effort[:, 3] *= 0.84
    changed = replace(log, joint=replace(log.joint, effort=effort))
    found = identify(changed, chain(), MODEL_1)
    assert found.choice is not None
    assert list(found.choice.gains) == ["A3"]
    assert found.choice.gains["A3"][0] == pytest.approx(-0.16, abs=0.01)


def test_a_sensor_dead_in_one_session_leaves_the_choice_to_the_others():
    first, second = (at_125_hz(sensors=SENSORS, seed=seed, motor=False) for seed in (1, 2))
    effort = second.joint.effort.copy()
    effort[:, 3] = 0.0
    found = identify([first, replace(second, joint=replace(second.joint, effort=effort))], chain(), MODEL_1)
    assert found.choice is not None
    assert any("A3 joint torque" in one and "dead" in one for one in found.warnings)


def test_a_joint_that_a_gain_explains_weighs_by_what_is_left():
    log = at_125_hz(sensors=replace(SENSORS, joint=0.02), motor=False, periods=3)
    effort = log.joint.effort.copy()
    effort[:, 3] *= 1.08
    changed = replace(log, joint=replace(log.joint, effort=effort))
    found = identify(changed, chain(), MODEL_1)
    assert found.choice is not None
    # With the weights of the model without it: least squares, and a deviation of 0.0065.
    assert found.choice.winner.estimator == "physical"
    error, std = found.choice.gains["A3"]
    assert error == pytest.approx(0.08, abs=3.0 * std)
    assert std < 0.002
    np.testing.assert_allclose(found.choice.gains_covariance, [[std**2]])
    # The moment about A3 carries the uncertainty of its sensor.
    place = found.base.names.index("MY4R")
    plain = WeightedLeastSquares().fit(found.problem)
    wide = BesideGains(WeightedLeastSquares(), {"A3": (0.0, 0.05)}, np.array([[0.05**2]])).fit(found.problem)
    added = np.sqrt(wide.std[place] ** 2 - plain.std[place] ** 2)
    assert 0.01 * abs(plain.values[place]) < added < 0.05 * abs(plain.values[place])


def test_healthy_sensors_get_no_gain():
    assert chosen().choice is not None
    assert not chosen().choice.gains
    assert not chosen().model.effects


def test_a_placeholder_in_the_urdf_loses_and_is_named():
    found = chosen(6, 1.0)
    assert found.choice is not None
    winner = found.choice.winner
    assert winner.estimator == "wls" or (winner.prior_scale or 0.0) > 1.0
    text = str(found.choice)
    assert "same mass (1 kg)" in text
    assert "same mass (1 kg)" in found.choice.urdf_doubt
    assert found.choice.disagreement is not None
    assert found.choice.disagreement.p_value < 1e-6
    assert "disagree" in text


def test_a_urdf_without_bodies_leaves_least_squares_and_the_reason():
    text = chain().urdf
    assert isinstance(text, str)
    bare = Chain.from_urdf(re.sub(r"<inertial>.*?</inertial>", "", text, flags=re.DOTALL))
    log = at_125_hz(sensors=SENSORS, motor=False)
    found = identify([log], bare, MODEL_1, known=SCREENED)
    assert found.choice is not None
    assert {candidate.estimator for candidate in found.choice.candidates} == {"wls"}
    assert found.choice.excluded == ("physical: the URDF states no bodies",)
    assert found.to_dict()["choice"]["urdf_doubt"] == "the URDF states no bodies"
    for name in ("physical", "map"):
        with pytest.raises(ConfigurationError, match=r"states no bodies.*<inertial>.*--estimator wls"):
            identify([log], bare, replace(MODEL_1, estimator=name))


def test_a_link_without_mass_is_named_and_leaves_no_prior():
    text = chain().urdf
    assert isinstance(text, str)
    before, mass, after = text.rpartition("<mass value=")
    light = Chain.from_urdf(before + mass + re.sub(r'"[^"]*"', '"0"', after, count=1))
    masses = light.urdf_inertials()[:, 9]
    assert np.count_nonzero(masses == 0.0) == 1
    name = light.link_names[int(np.argmin(masses))]
    assert lacking_bodies(light) == f"the URDF states no mass of {name}"
    assert not lacking_bodies(chain())
    assert "from a table" in lacking_bodies(replace(chain(), urdf=None))


def test_a_weak_motion_is_identified_with_the_prior_and_names_what_it_does_not_show():
    log = at_125_hz(sensors=SENSORS, motor=False, still=(0, 2, 3))
    arm = chain()
    with pytest.raises(DataError, match=r"--without.*--estimator physical"):
        WeightedLeastSquares().fit(_weak())
    fit = MaximumAPosteriori(_prior(), 1.0).fit(_weak())
    assert set(fit.prior_only) == {"p3", "p7"}
    assert fit.std[3] == pytest.approx(0.5)
    assert "from the prior" in fit.summary()
    with pytest.raises(DataError, match="never move"):
        identify([log], arm, MODEL_1)


def _prior() -> Prior:
    std = np.full(12, np.inf)
    std[3], std[7] = 0.5, 2.0
    return Prior.independent(np.ones(12), std)


def _weak() -> Problem:
    """Without any effect of p3 and p7, and with p5 hidden behind p6."""
    case = problem(design(), np.ones(12), [0.1 * np.random.default_rng(k).normal(size=200) for k in range(6)])
    groups = []
    for group in case.groups:
        matrix = group.matrix.copy()
        matrix[:, [3, 7]] = 0.0
        matrix[:, 5] = matrix[:, 6]
        groups.append(RowGroup(group.joint, group.side, group.record, matrix, group.target, group.time_index))
    return Problem(case.names, tuple(groups), case.sample_time_s)


def test_without_prior_and_rank_the_common_torque_is_shared():
    fit = MaximumAPosteriori(_prior(), 1.0).fit(_weak())
    assert fit.values[5] == pytest.approx(fit.values[6], rel=1e-3)
    assert np.all(np.isfinite(fit.std))


def test_the_distance_from_a_right_prior_is_chi_square():
    random = np.random.default_rng(3)
    matrices = design()
    prior = Prior.independent(np.zeros(12), np.full(12, 0.2))
    found = []
    for _ in range(60):
        chi = 0.2 * random.normal(size=12)
        case = problem(matrices, chi, [0.5 * random.normal(size=len(m)) for m in matrices])
        found.append(Disagreement.between(prior, case, np.full(3, 4.0)))
    assert found[0].freedom == 12
    assert np.mean([f.chi_square for f in found]) == pytest.approx(12.0, rel=0.15)
    assert 0.2 < np.mean([f.p_value < 0.5 for f in found]) < 0.8
    wrong = problem(matrices, np.full(12, 1.0), [0.5 * random.normal(size=len(m)) for m in matrices])
    distance = Disagreement.between(prior, wrong, np.full(3, 4.0))
    assert distance.p_value < 1e-6
    assert abs(distance.deviations[0]) > 4.0


def test_least_squares_stays_one_word_away():
    log = at_125_hz(sensors=SENSORS, motor=False)
    settings = IdentificationSettings(model=1, essential=None)
    found = identify([log], chain(), settings, known=SCREENED)
    assert found.choice is None
    assert found.estimate.method == "WLS"
    assert np.abs(found.estimate.values - true_base(found)).max() < 5.0


def test_a_leaning_base_has_to_pay_against_the_same_estimator_upright(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Least squares are better by chance here, leaning by a little less chance."""
    share = {("physical", False): 0.02, ("physical", True): 0.03, ("wls", False): 0.016, ("wls", True): 0.018}

    def errors(self: EstimatorComparison, kind: Kind) -> np.ndarray:
        torque, parts = self.held[:, :, -1, -1].sum(axis=0), len(self.held)
        uneven = 0.03 * (np.arange(parts) % 2) * (kind[0] == "wls")
        each = share[kind[0], kind[2]] + uneven - uneven.mean()
        return each[:, None] / parts * torque

    monkeypatch.setattr(EstimatorComparison, "_errors", errors)
    monkeypatch.setattr(EstimatorComparison, "_leans", lambda *_: True)
    monkeypatch.setattr(EstimatorComparison, "_wider", lambda *_: iter(()))
    found = choose([at_125_hz(sensors=SENSORS, motor=False, periods=3)], chain(), MODEL_1, known=SCREENED)
    assert found.choice is not None
    assert (found.choice.winner.estimator, found.choice.winner.tilt) == ("physical", False)
    assert "the lower error of wls is no proof" in str(found.choice)
