from __future__ import annotations

import json
import re
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from fri.errors import ConfigurationError, DataError
from ident.dynamics.base_set import numeric_base
from ident.estimation.compare import competitor_scores
from ident.estimation.forward_simulation import simulate, simulate_session
from ident.estimation.identification import IdentificationSettings
from ident.estimation.identify import identify
from ident.estimation.validate import Validation, cross_validate, validate
from ident.model.dynamic_model import DynamicModel
from ident.rows.filters import SignalSettings
from runner.estimation import announced

PLAIN = SignalSettings(motor_delay_s=0.0)
SIDES = ("motor", "joint")


def side_of(model: DynamicModel, side: Any) -> DynamicModel:
    """The model with one side, and its parameters there."""
    structure = replace(model.structure, sides=(side,))
    base = numeric_base(structure)
    return DynamicModel(model.robot, structure, base.names, base.reduce(model.standard), None, base)


@pytest.fixture(scope="module")
def unloaded(bench: Any) -> Any:
    return bench.session("unloaded", seed=1, periods=2, controller_model=True)


@pytest.fixture(scope="module")
def loaded(bench: Any) -> Any:
    return bench.session("loaded", seed=2, payload="load", rate_hz=250.0)


def scores(result: Validation, side: str) -> np.ndarray:
    return np.array([s.rms for s in result.scores[0].scores if s.side == side])


def test_the_true_model_leaves_the_noise_and_reaches_the_floor(truth_model: Any, unloaded: Any) -> None:
    result = validate(truth_model, [unloaded], settings=PLAIN)
    np.testing.assert_allclose(scores(result, "joint"), 0.05, rtol=0.06)
    np.testing.assert_allclose(scores(result, "motor"), 0.2, rtol=0.06)
    for score in result.scores[0].scores:
        assert abs(score.bias) < 0.02
        assert score.floor_rms == pytest.approx(score.band_rms, rel=0.35)
        assert score.band_rms < 0.3 * score.rms
    assert result.scores[0].relative["joint"] < 0.01


def test_the_loaded_session_is_predicted_with_its_payload(truth_model: Any, loaded: Any) -> None:
    np.testing.assert_allclose(
        scores(validate(truth_model, [loaded], settings=PLAIN), "joint"), 0.05, rtol=0.06
    )


def test_a_recording_that_the_model_does_not_predict_is_a_warning(truth_model: Any, unloaded: Any) -> None:
    assert not validate(truth_model, [unloaded], settings=PLAIN).warnings
    values = truth_model.values.copy()
    values[truth_model.names.index("offl3")] += 30.0
    shifted = replace(truth_model, values=values)
    (told,) = validate(shifted, [unloaded], settings=PLAIN).warnings
    assert told.startswith("unloaded.mcap: the joint torque is off by")
    assert "most at E1 (30 Nm rms): the model does not hold there" in told


def test_errors_of_the_model_are_found_where_they_are(truth_model: Any, bench: Any, unloaded: Any) -> None:
    values = truth_model.values.copy()
    values[truth_model.names.index("offl3")] += 0.5
    values[truth_model.names.index("Fvm5")] *= 1.5
    wrong = DynamicModel(
        truth_model.robot, truth_model.structure, truth_model.names, values, None, truth_model.base
    )
    result = validate(wrong, [unloaded], settings=PLAIN)
    table = {(s.joint, s.side): s for s in result.scores[0].scores}
    assert table["E1", "joint"].bias == pytest.approx(-0.5, abs=0.02)
    assert table["E1", "motor"].bias == pytest.approx(-0.5, abs=0.02)
    assert table["A4", "motor"].rms > 0.5
    assert table["A4", "joint"].rms == pytest.approx(0.05, rel=0.06)
    worst = table["A4", "motor"]
    t, _, qd, _ = bench.motion(1, 26.0, 250.0, 12.0)
    speed = np.interp(worst.worst_time_s, t, qd[:, 4])
    assert abs(worst.worst) == pytest.approx(
        abs(speed) * values[truth_model.names.index("Fvm5")] / 3, abs=0.8
    )


def test_a_session_that_the_estimate_has_seen_is_refused_or_labelled(
    estimated: Callable[..., DynamicModel], unloaded: Any, loaded: Any
) -> None:
    for provenance in (
        {"sessions": [{"uid": "uid-unloaded", "file": "x.mcap"}]},
        {"sessions": ["uid-unloaded"]},
        {"sessions": ["unloaded.mcap"], "experiment": ""},
    ):
        model = estimated(provenance=provenance)
        with pytest.raises(DataError, match=r"unloaded\.mcap: the model was fitted to this session"):
            validate(model, [unloaded, loaded], settings=PLAIN)
        result = validate(model, [unloaded, loaded], settings=PLAIN, allow_seen=True)
        assert [score.seen for score in result.scores] == [True, False]
        assert [score.session for score in result.unseen] == ["loaded.mcap"]
        assert "SEEN BY THE ESTIMATE" in str(result)
    other = estimated(provenance={"sessions": ["unloaded.mcap"], "experiment": "another one"})
    assert not validate(other, [unloaded], settings=PLAIN).scores[0].seen


def test_a_copy_of_a_session_of_the_estimate_is_no_held_out_one(bench: Any, unloaded: Any) -> None:
    model = identify([unloaded], bench.chain, IdentificationSettings(signals=PLAIN, essential=None)).model

    def later(session: Any) -> Any:
        """The samples under another name, a hundred seconds later."""
        shifted = {
            channel: replace(
                columns,
                log_time=columns.log_time + 10**11,
                publish_time=columns.publish_time + 10**11,
            )
            for channel, columns in (("joint", session.joint), ("motor", session.motor))
        }
        phases = tuple(phase._replace(log_time=phase.log_time + 10**11) for phase in session.phases)
        metadata = {**session.metadata, "uid": "uid-copy"}
        return replace(
            session, path=session.path.with_name("copy.mcap"), metadata=metadata, phases=phases, **shifted
        )

    copy = later(unloaded)
    with pytest.raises(DataError, match=r"copy\.mcap: the model was fitted to this session or a copy of it"):
        validate(model, [copy])
    assert validate(model, [copy], allow_seen=True).scores[0].seen
    other = later(bench.session("other", seed=7, periods=2))
    assert not validate(model, [other]).scores[0].seen
    # A model file of an earlier version holds no marks.
    entries = [{k: v for k, v in entry.items() if k != "rows"} for entry in model.provenance["sessions"]]
    older = replace(model, provenance={**model.provenance, "sessions": entries})
    assert not validate(older, [copy]).scores[0].seen


def test_an_unknown_payload_is_refused(truth_model: Any, bench: Any) -> None:
    session = bench.session("strange", seed=3)
    strange = replace(session, metadata={**session.metadata, "payload": "gripper"})
    with pytest.raises(
        DataError, match=r"payload 'gripper' is not in the model \(payloads: load\)"
    ) as raised:
        validate(truth_model, [strange], settings=PLAIN)
    (option,) = re.findall(r"`--payload ([^`]+)`", str(raised.value))
    # The same load under another name is named as the model does.
    (named,) = announced([strange], [option])
    assert validate(truth_model, [named], settings=PLAIN).scores


def test_a_session_without_the_sides_of_the_model_says_so(truth_model: Any, bench: Any) -> None:
    session = bench.session("jointonly", seed=4, motor=False)
    result = validate(truth_model, [session], settings=PLAIN)
    assert {score.side for score in result.scores[0].scores} == {"joint"}
    structure = replace(truth_model.structure, model=3, sides=("difference",), payloads=())
    difference = DynamicModel("LWR4+", structure, ("Fvm1",), np.array([16.0]))
    with pytest.raises(DataError, match="no usable difference torque"):
        validate(difference, [session], settings=PLAIN)


def test_effects_in_the_torque_are_named(truth_model: Any, loaded: Any) -> None:
    extended = replace(
        truth_model,
        effects=(
            {
                "cause": "stribeck",
                "side": "motor",
                "joints": [2],
                "parameters": {
                    "amplitude": {"value": 1.0, "std": 0.1, "unit": "Nm"},
                    "velocity": {"value": 0.05, "std": 0.01, "unit": "rad/s"},
                },
            },
        ),
    )
    assert "the effects of the model: stribeck" in str(validate(extended, [loaded], settings=PLAIN))


def test_results_print_and_serialise(truth_model: Any, unloaded: Any) -> None:
    result = validate(truth_model, [unloaded], settings=PLAIN)
    result = replace(result, competitors=competitor_scores(truth_model, [unloaded], settings=PLAIN))
    text = str(result)
    assert "floor" in text
    assert "controller's M(q), g(q)" in text
    content = json.loads(json.dumps(result.to_dict()))
    assert content["sessions"][0]["scores"][0]["joint"] == "A1"
    assert {c["predictor"] for c in content["competitors"]} == {
        "controller's M(q), g(q)",
        "CAD (URDF), no friction",
    }


def test_competitors_leave_what_they_do_not_describe(truth_model: Any, unloaded: Any) -> None:
    found = competitor_scores(truth_model, [unloaded], settings=PLAIN, others=[truth_model])
    by_name = {score.predictor: score for score in found}
    other = {side: [s.rms for s in by_name["model of LWR4+"].scores if s.side == side] for side in SIDES}
    np.testing.assert_allclose(other["joint"], 0.05, rtol=0.06)
    np.testing.assert_allclose(other["motor"], 0.2, rtol=0.06)
    # The controller's matrices are the true ones here: friction and centrifugal terms remain.
    rms = {s.joint: s.rms for s in by_name["controller's M(q), g(q)"].scores}
    friction = truth_model.drive()
    assert rms["A1"] > 0.9 * friction["Fcl"][0]
    assert rms["A5"] == pytest.approx(0.05, abs=0.03)
    assert by_name["CAD (URDF), no friction"].relative["joint"] > 0.02


def test_models_of_the_motor_side_compete_there(truth_model: Any, unloaded: Any) -> None:
    motor_only = side_of(truth_model, "motor")
    alone = replace(unloaded, joint=replace(unloaded.joint, effort=np.empty((len(unloaded.joint), 0))))
    for model, session in ((truth_model, unloaded), (motor_only, unloaded), (motor_only, alone)):
        found = competitor_scores(model, [session], settings=PLAIN, others=[motor_only])
        score = next(one for one in found if one.predictor == "model of LWR4+")
        assert list(score.relative) == ["motor"]
        result = replace(validate(model, [session], settings=PLAIN), competitors=found)
        assert "unloaded.mcap, motor side" in str(result)
    with pytest.raises(
        ConfigurationError, match="so they cannot compete; choose models with a side in common"
    ):
        competitor_scores(side_of(truth_model, "joint"), [unloaded], settings=PLAIN, others=[motor_only])


def test_a_session_of_motor_torques_alone_has_no_joint_rows(truth_model: Any, unloaded: Any) -> None:
    alone = replace(unloaded, joint=replace(unloaded.joint, effort=np.empty((len(unloaded.joint), 0))))
    result = validate(truth_model, [alone], settings=PLAIN)
    assert {score.side for score in result.scores[0].scores} == {"motor"}
    assert "joint" not in result.scores[0].to_dict()["torque_error"]
    assert " joint " not in str(result)


def test_the_torque_error_is_that_of_all_samples_of_all_joints(truth_model: Any, unloaded: Any) -> None:
    result = validate(truth_model, [unloaded], settings=PLAIN).scores[0]
    for side, value in result.relative.items():
        mine = [score for score in result.scores if score.side == side]
        squares = np.array([score.samples * score.rms**2 for score in mine])
        torques = np.array([score.samples * (score.rms / score.relative) ** 2 for score in mine])
        assert value == pytest.approx(np.sqrt(squares.sum() / torques.sum()), rel=1e-9)
        held = np.array([score.standstill_error for score in mine])
        assert result.standstill_error[side] == pytest.approx((squares * held).sum() / squares.sum())
    content = result.to_dict()
    assert content["torque_error"] == dict(result.relative)
    assert f"torque error, all joints and samples: motor {100 * result.relative['motor']:.2f} %" in str(
        result
    )


def test_standstill_counts_and_is_named(truth_model: Any, bench: Any, unloaded: Any) -> None:
    t, _, qd, _ = bench.motion(1, 26.0, 250.0, 12.0)
    times = (unloaded.motor.log_time - unloaded.joint.log_time[0]) * 1e-9
    slow = np.abs(np.column_stack([np.interp(times, t, column) for column in qd.T])) < 0.04
    # Friction that no model of the motion computes.
    effort = unloaded.motor.effort + np.where(slow, 1.0, 0.0)
    changed = replace(unloaded, motor=replace(unloaded.motor, effort=effort))
    settings = replace(PLAIN, standstill_rad_s=0.05)
    found, before = (validate(truth_model, [one], settings=settings).scores[0] for one in (changed, unloaded))
    assert found.standstill["motor"] == before.standstill["motor"] > 0.01
    assert found.standstill_error["motor"] > 5.0 * before.standstill_error["motor"]
    assert found.relative["motor"] > 1.05 * before.relative["motor"]
    assert found.moving_relative["motor"] == pytest.approx(before.moving_relative["motor"], rel=0.02)
    assert f"{100 * found.standstill_error['motor']:.1f} % of the squared error" in str(found)


def test_a_session_without_a_score_leaves_the_others(truth_model: Any, bench: Any, unloaded: Any) -> None:
    strange = replace(unloaded, metadata={**unloaded.metadata, "payload": "gripper"})
    result = validate(truth_model, [strange, unloaded], settings=PLAIN, keep_going=True)
    assert len(result.scores) == 1
    assert "not validated: unloaded.mcap: payload 'gripper' is not in the model" in str(result)
    assert result.to_dict()["unscored"][0]["session"] == "unloaded.mcap"
    with pytest.raises(DataError, match=r"not validated: unloaded\.mcap: payload 'gripper'"):
        result.require_all()
    validate(truth_model, [unloaded], settings=PLAIN).require_all()


def test_forward_simulation_reproduces_the_measured_torque(truth_model: Any, loaded: Any) -> None:
    result = simulate_session(truth_model, loaded, settings=PLAIN, step_s=2e-3)
    assert result.reference == "commanded"
    assert result.side == "motor"
    assert result.relative < 0.05
    assert result.position_rms.max() < 0.02
    assert "Forward simulation of loaded.mcap, motor torque" in str(result)


def test_forward_simulation_feels_a_wrong_payload(truth_model: Any, loaded: Any) -> None:
    blind = replace(loaded, metadata={**loaded.metadata, "payload": "none"})
    good = simulate_session(truth_model, loaded, settings=PLAIN, step_s=4e-3)
    bad = simulate_session(truth_model, blind, settings=PLAIN, step_s=4e-3)
    assert bad.torque_rms[1] > good.torque_rms[1] + 2.0


def test_simulated_pendulum_keeps_its_energy_balance(truth_model: Any) -> None:
    """The work of the controller is the gain of energy plus the loss in friction."""
    times = np.arange(0, 2.0, 5e-4)
    target = 0.3 * np.sin(2 * np.pi * 0.5 * times)[:, None] * np.ones(7)
    q, qd, torque = simulate(truth_model, times, target, side="joint")
    kinetic = 0.5 * np.einsum("ni,nij,nj->n", qd, truth_model.mass_matrix(q), qd)
    drive = truth_model.drive()
    resisting = drive["Fvl"] * qd + drive["Fcl"] * np.tanh(qd / 5e-3) + drive["offl"]
    power = np.sum(qd * (torque - resisting - truth_model.gravity(q)), axis=1)
    work = np.concatenate([[0.0], np.cumsum(0.5 * (power[1:] + power[:-1]) * 5e-4)])
    np.testing.assert_allclose(kinetic - kinetic[0], work, atol=0.02 * kinetic.max() + 1e-3)


def test_a_model_of_no_real_arm_is_not_simulated(truth_model: Any) -> None:
    values = truth_model.values.copy()
    for name in ("ZZ7", "Ia7"):
        values[truth_model.names.index(name)] = -5.0
    wrong = DynamicModel(
        truth_model.robot, truth_model.structure, truth_model.names, values, None, truth_model.base
    )
    times = np.arange(0, 0.1, 1e-3)
    with pytest.raises(DataError, match="not positive definite"):
        simulate(wrong, times, np.zeros((len(times), 7)))


def test_cross_validation_predicts_each_session_by_the_others(bench: Any, unloaded: Any, loaded: Any) -> None:
    other = bench.session("second", seed=21, periods=2)
    chain = bench.chain
    settings = IdentificationSettings(model=1, signals=PLAIN)
    result = cross_validate([unloaded, other, loaded], chain, settings)
    assert [score.session for score in result.scores] == ["unloaded.mcap", "second.mcap"]
    assert "loaded.mcap: payload 'load' is in no other session" in result.skipped[0]
    assert not any(score.seen for score in result.scores)
    for key, rms in result.rms.items():
        assert key.endswith("joint")
        assert rms == pytest.approx(0.05, rel=0.15)
    with pytest.raises(DataError, match="two at least"):
        cross_validate([unloaded], chain, settings)
    found = identify([unloaded, other], chain, settings)
    with pytest.raises(DataError, match="the model was fitted to this session"):
        validate(found.model, [other], settings=PLAIN)
