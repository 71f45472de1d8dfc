"""From sessions to a model, end to end on a simulated arm, and the refusal of unusable sessions."""

from __future__ import annotations

import dataclasses
import json
from functools import lru_cache

import numpy as np
import pytest

from fri.errors import ConfigurationError, DataError
from ident.estimation.essential import EssentialSettings
from ident.estimation.identification import Identification, IdentificationSettings, Known
from ident.estimation.identify import identify
from ident.estimators import CovarianceSettings
from ident.rows import SignalSettings
from tests.ident import estimation_arm as arm

NOISY = arm.Sensors(position=1e-5, joint=0.1, motor=0.5, correlation_s=0.2, motor_delay_s=0.004)
# fmt: off
TABLE_2 = [
    "Ia1", "Fvm1", "Fcm1", "Ia2", "Fvm2", "Fcm2", "offm2", "Ia3", "Fvm3", "Fcm3", "Ia4", "Fvm4", "Fcm4",
    "Ia5", "Fvm5", "Fcm5", "Ia6", "Fvm6", "Fcm6", "Ia7", "Fvm7", "Fcm7", "offm7", "Fcl1", "offl1",
    "Fcl2", "offl2", "Fcl3", "Fcl4", "offl4", "Fcl5", "offl5", "Fcl7", "offl7", "XX2R", "ZZ2R", "MY2R",
    "XX4R", "ZZ4R", "MY4R", "MY5R", "MY6R", "XX8", "YY8", "YZ8", "ZZ8", "MY8", "MZ8", "M8",
]
# fmt: on
# For sessions of a healthy arm: their screening takes half of the time and has tests of its own.
SCREENED = Known()


@lru_cache
def sessions(**changes):
    return tuple(
        arm.at_125_hz(loaded=loaded, seed=int(loaded), sensors=NOISY, **changes) for loaded in (False, True)
    )


@lru_cache
def model_2() -> Identification:
    return identify(sessions(command=True), arm.chain(), IdentificationSettings())


def errors(found: Identification) -> np.ndarray:
    return (found.estimate.values - arm.true_base(found)) / found.estimate.std


def test_model_2_counts_those_of_the_paper():
    assert model_2().counts == {"standard": 136, "not_identifiable": 18, "regrouped": 16, "base": 102}


def test_parameters_lie_within_their_standard_deviations_of_the_truth():
    z = errors(model_2())
    assert np.mean(np.abs(z) < 3) >= 0.95
    assert 0.7 < np.sqrt(np.mean(z**2)) < 1.4


def test_essential_parameters_contain_those_of_table_2():
    essential = model_2().essential
    assert [name for name in TABLE_2 if name not in essential.names] == []
    assert len(essential.names) < 85


def test_the_result_prints_itself_and_is_plain_data():
    found = model_2()
    text = found.summary()
    for word in ("102 base", "M8", "exogeneity", "eliminated", "late by", "block jackknife", "A6 motor"):
        assert word in text
    content = json.loads(json.dumps(found.to_dict()))
    entry = next(p for p in content["parameters"] if p["name"] == "M8")
    assert entry["unit"] == "kg"
    assert entry["estimate"] == pytest.approx(3.34, abs=0.05)
    assert entry["rsd_percent"] == pytest.approx(100 * entry["std"] / entry["estimate"])
    assert set(content["torque_rms"]) == {"motor", "joint"}
    assert set(content["torque_rms"]["joint"]) == set(arm.chain().joint_names)


def test_the_model_predicts_the_torque():
    found = model_2()
    q, qd, qdd = arm.fourier(np.linspace(0, 9, 200), 9.0, 77)
    truth, _ = arm.torques(q, qd, qdd, loaded=True)
    for model in (found.model, found.essential_model):
        predicted = model.torque(q, qd, qdd, payload="payload", side="joint")
        assert np.sqrt(np.mean((predicted - truth) ** 2)) < 0.2


def test_commanded_motion_tests_exogeneity():
    assert model_2().assumptions["exogeneity"].holds is True


def test_model_1_needs_no_motor_channel():
    found = identify(sessions(motor=False), arm.chain(), IdentificationSettings(model=1), known=SCREENED)
    assert found.counts["base"] == 74
    z = errors(found)
    assert np.mean(np.abs(z) < 3) >= 0.95


def test_model_3_finds_the_drives_from_the_difference():
    found = identify(sessions(), arm.chain(), IdentificationSettings(model=3), known=SCREENED)
    assert found.counts["base"] == 28
    assert {name.rstrip("1234567") for name in found.base.names} == {"Ia", "Fvm", "Fcm", "offm"}
    assert np.mean(np.abs(errors(found)) < 3) >= 0.95


def test_a_session_without_motor_torques_adds_its_joint_rows():
    bare, loaded = sessions()
    mixed = [dataclasses.replace(bare, motor=None), loaded]
    found = identify(mixed, arm.chain(), IdentificationSettings(), known=SCREENED)
    assert found.counts["base"] == 102
    assert np.mean(np.abs(errors(found)) < 3) >= 0.95


@pytest.mark.slow
def test_stated_intervals_cover_over_many_sessions():
    settings = IdentificationSettings(model=1, essential=None, signals=SignalSettings(cutoff_hz=6.0))
    inside, textbook = [], []
    for seed in range(12):
        sensors = arm.Sensors(joint=0.2, correlation_s=0.5)
        recorded = [
            arm.at_125_hz(
                loaded=loaded,
                seed=100 * seed + loaded,
                sensors=sensors,
                motor=False,
                rate_hz=50.0,
                period_s=12.0,
            )
            for loaded in (False, True)
        ]
        found = identify(recorded, arm.chain(), settings, known=SCREENED)
        truth = arm.true_base(found)
        for result, which in ((inside, None), (textbook, "textbook")):
            low, high = found.estimate.interval(0.95, covariance=which).T
            result.append((low < truth) & (truth < high))
    assert 0.90 <= np.mean(inside) <= 0.99
    assert np.mean(textbook) < 0.85


def test_averaged_periods_give_the_same_parameters_from_fewer_rows():
    whole = model_2()
    averaged = identify(
        sessions(),
        arm.chain(),
        IdentificationSettings(essential=None, signals=SignalSettings(average_periods=True)),
        known=SCREENED,
    )
    assert averaged.problem.rows < 0.6 * whole.problem.rows
    shift = (averaged.estimate.values - whole.estimate.values) / whole.estimate.std
    assert np.sqrt(np.mean(shift**2)) < 1.0


@pytest.mark.parametrize("name", ["ols", "huber", "tukey", "tls", "map", "physical", "recursive", "mixing"])
def test_every_estimator_by_name(name):
    settings = IdentificationSettings(estimator=name, essential=None)
    found = identify(sessions(), arm.chain(), settings, known=SCREENED)
    z = errors(found)
    assert np.sqrt(np.mean(z**2)) < 2.0
    assert np.mean(np.abs(z) < 3) >= 0.9


def test_a_prior_model_sharpens_an_estimate_from_a_loaded_session_alone():
    loaded = sessions()[1:]
    found = identify(loaded, arm.chain(), IdentificationSettings(essential=None), known=SCREENED)
    assert found.counts["base"] == 92
    assert any("add an unloaded session" in warning for warning in found.warnings)


def test_covariance_settings_reach_the_result():
    settings = IdentificationSettings(covariance=CovarianceSettings("hac", bandwidth_s=1.0), essential=None)
    found = identify(sessions(), arm.chain(), settings, known=SCREENED)
    assert found.estimate.covariance.kind.startswith("HAC (Bartlett, stated bandwidth 1.00 s)")


def test_essential_lists_reach_the_result():
    settings = IdentificationSettings(essential=EssentialSettings(keep=("Fvl",), drop=("offm",)))
    found = identify(sessions(), arm.chain(), settings, known=SCREENED)
    assert {f"Fvl{k}" for k in range(1, 8)} <= set(found.essential.names)
    assert not any(name.startswith("offm") for name in found.essential.names)


def test_without_motor_torques_model_1_is_offered():
    with pytest.raises(DataError, match="choose Model 1"):
        identify(sessions(motor=False), arm.chain(), IdentificationSettings())


def test_no_session_is_refused():
    with pytest.raises(DataError, match="no session"):
        identify([], arm.chain(), IdentificationSettings())


def test_sessions_of_two_robots_are_refused():
    bare, loaded = sessions()
    other = dataclasses.replace(loaded, metadata={**loaded.metadata, "robot": "iiwa14"})
    with pytest.raises(DataError, match="different robots"):
        identify([bare, other], arm.chain(), IdentificationSettings())


def test_joint_names_of_another_arm_are_refused():
    foreign = [
        dataclasses.replace(
            session,
            joint=dataclasses.replace(session.joint, names=tuple(f"j{k}" for k in range(7))),
            motor=None,
        )
        for session in sessions()
    ]
    with pytest.raises(DataError, match="has no joint 'A1'"):
        identify(foreign, arm.chain(), IdentificationSettings(model=1))


def test_a_joint_that_never_moves_is_named():
    still = [arm.at_125_hz(loaded=loaded, still=(4,), motor=False) for loaded in (False, True)]
    with pytest.raises(DataError, match="joint A4 never moves"):
        identify(still, arm.chain(), IdentificationSettings(model=1))


def test_less_than_a_second_of_motion_is_too_little_and_it_is_said():
    whole = sessions(command=True)[0]
    start = int(whole.joint.log_time[0]) + 3 * 10**9
    joint = whole.joint.rows(start, start + 750_000_000)
    short = dataclasses.replace(whole, joint=joint, motor=None, command=None)
    settings = IdentificationSettings(model=1, estimator="physical", essential=None)
    found = identify(short, arm.chain(), settings)
    assert [text for text in found.warnings if text.startswith("too little motion: ")]
    assert not [text for text in model_2().warnings if "too little motion" in text]


def named(session, payload, mass=""):
    return dataclasses.replace(
        session, metadata={**session.metadata, "payload": payload, "payload_mass": mass}
    )


@pytest.mark.parametrize("mass", ["", "3.28"])
def test_a_payload_that_was_announced_but_not_mounted_is_refused(mass):
    bare = sessions()[0]
    claimed = named(arm.at_125_hz(seed=9, sensors=NOISY), "payload", mass)
    # The screening leaves it to the mass; once is enough to see that.
    known = SCREENED if mass else None
    with pytest.raises(DataError, match=r"not mounted in unloaded.mcap, or it was mounted in .*`--payload"):
        identify([bare, claimed], arm.chain(), IdentificationSettings(essential=None), known=known)


@pytest.mark.slow
@pytest.mark.parametrize("mass", ["", "3.28"])
def test_a_payload_that_hung_in_the_session_of_the_bare_arm_is_refused(mass):
    bare, loaded = sessions()
    known = SCREENED if mass else None
    with pytest.raises(DataError, match=r"mass -3.* are interchanged"):
        identify(
            [named(loaded, "none"), named(bare, "payload", mass)],
            arm.chain(),
            IdentificationSettings(essential=None),
            known=known,
        )
    both = [named(loaded, "none"), named(arm.at_125_hz(seed=9, sensors=NOISY, loaded=True), "payload", mass)]
    with pytest.raises(DataError, match=r"mounted in loaded.mcap as well"):
        identify(both, arm.chain(), IdentificationSettings(essential=None), known=known)


def test_a_stated_mass_must_be_a_number():
    bare, loaded = sessions()
    heavy = [bare, named(loaded, "payload", "heavy")]
    with pytest.raises(DataError, match="`payload_mass` 'heavy' in the metadata is no number"):
        identify(heavy, arm.chain(), IdentificationSettings(essential=None), known=SCREENED)


def test_a_payload_of_another_mass_than_stated_is_noticed():
    bare, loaded = sessions()
    stated = dataclasses.replace(loaded, metadata={**loaded.metadata, "payload_mass": "1.5"})
    found = identify([bare, stated], arm.chain(), IdentificationSettings(essential=None), known=SCREENED)
    assert any("against 1.500 kg stated" in warning for warning in found.warnings)


def test_an_unknown_estimator_is_refused():
    with pytest.raises(ConfigurationError, match="choose one of"):
        IdentificationSettings(estimator="magic")


def test_model_3_has_no_prior():
    with pytest.raises(ConfigurationError, match="Model 3 has no rigid bodies"):
        identify(sessions(), arm.chain(), IdentificationSettings(model=3, estimator="physical"))
