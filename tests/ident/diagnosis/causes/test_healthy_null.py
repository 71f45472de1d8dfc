"""What healthy sets teach: lengths of presliding, and what a further healthy set stays below."""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from ident.diagnosis.causes.candidates import Candidate, Trial
from ident.diagnosis.causes.contest import Contest
from ident.diagnosis.causes.healthy_null import HealthyNull
from ident.diagnosis.causes.tolerances import Kind, Tolerance
from ident.diagnosis.causes.tolerated import Tolerated
from ident.diagnosis.causes.usual_sizes import Healthy
from ident.diagnosis.gain.score import Score
from ident.diagnosis.healthy import bench, channel_delays
from ident.diagnosis.healthy.channel_delays import common_delays
from ident.diagnosis.healthy.day_spread import compliance_std, delay_std, gain_std
from ident.diagnosis.healthy.presliding import with_far_presliding
from ident.diagnosis.healthy.reference import DELAY_STD_S, Reference
from ident.diagnosis.healthy.tuning import _encoder, with_compliance_std
from ident.diagnosis.rows import recording
from ident.diagnosis.rows.nominal_arm import GAIN_STD, NominalArm
from ident.diagnosis.settings import DiagnosisSettings
from ident.diagnosis.verdict.late_channels import late_by_themselves
from ident.dynamics.base_set import numeric_base
from ident.dynamics.kinematics import Chain
from ident.dynamics.structure import Condition, EncoderSide, ModelStructure
from ident.effects import EFFECTS, Shape
from ident.model import DynamicModel
from ident.rows.delay import Delay
from ident.rows.filters import SignalSettings
from tests.ident.diagnosis.references import bare_reference


def reference(model: DynamicModel, null: dict[tuple[str, int], float], sets: int) -> Reference:
    return bare_reference(model, sets, null=null, habits=True)


@pytest.fixture(scope="module")
def model(chain: Chain) -> DynamicModel:
    structure = ModelStructure(chain, 1)
    base = numeric_base(structure)
    return DynamicModel("arm", structure, base.names, np.ones(len(base)), None, base)


@pytest.fixture
def arm(chain: Chain) -> NominalArm:
    return NominalArm(chain, np.zeros(3), np.ones(3), presliding=np.full(3, 2e-4))


def days(rng: np.random.Generator, mean: float, scatter: float, count: int) -> list[np.ndarray]:
    """Friction that turns slowly (2, 3 distances, 3 joints), each day with a standard deviation of 0.02 Nm."""
    return [
        np.stack([mean + scatter * rng.standard_normal((3, 3)), np.full((3, 3), 0.02)]) for _ in range(count)
    ]


def test_slow_friction_that_the_sets_agree_on_belongs_to_the_arm(arm: NominalArm) -> None:
    found = with_far_presliding(arm, days(np.random.default_rng(1), 0.1, 0.02, 8), [np.full(3, 4.0)] * 8)
    assert found.far_share is not None
    assert found.far is not None
    assert found.far_share == pytest.approx(np.full(3, 0.1 / 4.0), rel=0.3)
    assert np.all(found.far > 3.0 * 2e-4)


def test_slow_friction_that_comes_and_goes_does_not(arm: NominalArm) -> None:
    coulomb = [np.full(3, 4.0)] * 8
    found = with_far_presliding(arm, days(np.random.default_rng(2), 0.0, 0.2, 8), coulomb)
    against = with_far_presliding(arm, days(np.random.default_rng(2), -0.1, 0.02, 8), coulomb)
    for other in (found, against):
        assert other.far_share is not None
        assert np.all(other.far_share == 0.0)
    assert with_far_presliding(arm, days(np.random.default_rng(3), 0.1, 0.0, 2), coulomb[:2]) is arm


def test_friction_turns_partly_within_the_longer_distance(arm: NominalArm) -> None:
    both = replace(arm, far=np.full(3, 1e-2), far_share=np.full(3, 0.3))
    speed = np.repeat(np.where(np.arange(2000) < 1000, 0.1, -0.1)[:, None], 3, axis=1)
    slip = both.slip(speed, 1e-3)
    # Five short reaches after the reversal the rest has turned, and of the slow share a tenth of the way.
    after = 999 + round(1e-3 / 1e-4)
    wanted = -0.7 * (1.0 - 2.0 * np.exp(-5.0)) + 0.3 * (-1.0 + 2.0 * np.exp(-0.1))
    assert slip[after, 0] == pytest.approx(wanted, abs=0.01)


def test_a_further_healthy_set_seldom_exceeds_its_limit(model: DynamicModel) -> None:
    """Deviations that differ from set to set, squared: of the limits from eight sets one in a hundred is broken."""
    rng = np.random.default_rng(4)
    broken = 0
    for _ in range(400):
        gains = 20.0 * rng.standard_normal((9, 7)) ** 2
        null = {("presliding_hysteresis", j): float(gains[:8, j].mean()) for j in range(7)}
        null |= {("stribeck", j): 1.0 for j in range(10)}
        limits = reference(model, null, 8).limits()
        broken += sum(gains[8, j] > limits["presliding_hysteresis", j] for j in range(7))
    assert broken / (400 * 7) < 0.02


def test_few_sets_ask_for_more(model: DynamicModel) -> None:
    null = {("stribeck", 0): 1.0, ("stribeck", 1): 1.0, ("backlash", 0): 12.0}
    limits = [reference(model, null, sets).limits()["backlash", 0] for sets in (1, 4, 20)]
    assert limits[0] > limits[1] > limits[2] > 12.0
    assert reference(model, {}, 0).limits() == {}


def test_scatter_of_a_delay_between_days_is_learned() -> None:
    rng = np.random.default_rng(5)
    late = [(1e-3 + value, 1e-4) for value in rng.normal(0.0, np.hypot(5e-4, 1e-4), 200)]
    assert delay_std(late) == pytest.approx(5e-4, rel=0.1)
    steady = [(1e-3 + value, 1e-4) for value in rng.normal(0.0, 1e-4, 200)]
    assert delay_std(steady) < 0.5 * DELAY_STD_S
    # One day says nothing of other days: what is usual, about a value that has that scatter itself.
    assert delay_std([(3e-3, 1e-4)]) == pytest.approx(np.sqrt(2.0) * DELAY_STD_S)


def test_loosened_parameters_are_less_tied_and_no_others(chain: Chain) -> None:
    structure = ModelStructure(chain, 2)
    base = numeric_base(structure)
    count = len(base)
    model = DynamicModel("arm", structure, base.names, np.full(count, 2.0), 1e-6 * np.eye(count), base)
    healthy = reference(model, {}, 8)
    tied, loose = healthy.prior(base), healthy.loosened("Ia", 0.05).prior(base)
    assert tied is not None
    assert loose is not None
    std = [1.0 / np.sqrt(np.diag(precision)) for precision, _ in (tied, loose)]
    inertias = np.array([name.startswith("Ia") for name in base.names])
    assert inertias.any()
    assert std[1][inertias] == pytest.approx(np.full(inertias.sum(), 1.5 * 0.1), rel=0.01)
    np.testing.assert_allclose(std[1][~inertias], std[0][~inertias])
    np.testing.assert_array_equal(loose[1], tied[1])


def test_scatter_of_the_sensors_gains_is_learned_from_all_joints() -> None:
    rng = np.random.default_rng(6)

    def days(scatter: float) -> list[np.ndarray]:
        return [np.stack([rng.normal(0.02, np.hypot(scatter, 1e-3), 7), np.full(7, 1e-3)]) for _ in range(6)]

    assert gain_std(days(0.02)) == pytest.approx(0.02, rel=0.3)
    assert gain_std(days(0.0)) < 0.4 * GAIN_STD
    # One day, or values less certain than the usual change, say nothing of other days.
    assert gain_std(days(0.02)[:1]) == GAIN_STD
    assert gain_std([np.stack([np.full(7, 0.1 * k), np.full(7, 0.05)]) for k in range(3)]) == GAIN_STD


def test_a_stiffness_that_differs_from_set_to_set_is_unknown(model: DynamicModel) -> None:
    sets = [np.array([1e-4, 1e-4, 0.0]), np.array([1.05e-4, 1.8e-4, 0.0])]
    std = compliance_std(sets)
    assert std is not None
    np.testing.assert_allclose(std, [0.025e-4, 0.4e-4, 0.0])
    healthy = replace(reference(model, {}, 2), compliance=np.mean(sets, axis=0), compliance_std=std)
    names = model.structure.chain.joint_names
    assert healthy.unknown_stiffness == (names[1],)
    assert f"not known within 20 %: {names[1]}" in repr(healthy)
    stored = replace(model, provenance=healthy.stored())
    assert Reference.of(stored).unknown_stiffness == (names[1],)


def test_a_stiffness_that_the_sets_do_not_tell_is_the_stated_one(arm: NominalArm) -> None:
    stated = np.full(3, 1e-4)
    # Agreed on, differing from set to set, and at the end of the factor within which it is stated.
    sets = [np.array([0.80e-4, 0.6e-4, 0.5e-4]), np.array([0.82e-4, 1.4e-4, 0.5e-4])]
    behind = replace(arm, compliance=np.mean(sets, axis=0), encoder="motor", stated=stated)
    found = with_compliance_std(behind, sets)
    np.testing.assert_allclose(found.compliance, [0.81e-4, 1e-4, 1e-4])
    assert found.compliance_std is not None
    np.testing.assert_allclose(found.compliance_std, [0.01e-4, 0.5e-4, 0.5e-4])
    single = with_compliance_std(replace(behind, compliance=sets[0]), sets[:1])
    np.testing.assert_allclose(single.compliance, [0.8e-4, 0.6e-4, 1e-4])
    before = with_compliance_std(replace(behind, encoder="link"), sets)
    np.testing.assert_array_equal(before.compliance, behind.compliance)
    # A fit that ends at a rigid joint in each set knows no stiffness of a joint that is stated elastic.
    rigid = [np.array([0.8e-4, 0.0, 0.0])] * 2
    ended = replace(
        behind, encoder="link", compliance=rigid[0], stated=stated * (1.0, 1.0, 0.0), compliance_std=None
    )
    np.testing.assert_allclose(with_compliance_std(ended, rigid).compliance_std, [0.0, 0.5e-4, 0.0])
    # So does one that ends at the softest joint.
    soft = [np.array([0.8e-4, 3e-4, 0.0])] * 2
    np.testing.assert_allclose(
        with_compliance_std(replace(ended, compliance=soft[0]), soft).compliance_std, [0.0, 0.5e-4, 0.0]
    )
    # A fit well within its range that the description rules out is not believed.
    lagging = [np.array([0.8e-4, 2.5e-4, 0.0])] * 2
    held = with_compliance_std(replace(ended, compliance=lagging[0]), lagging)
    np.testing.assert_allclose(held.compliance, [0.8e-4, 1e-4, 0.0])
    np.testing.assert_allclose(held.compliance_std, [0.0, 0.5e-4, 0.0])


def test_rounds_of_a_fit_stay_near_the_stated_stiffness(
    arm: NominalArm, monkeypatch: pytest.MonkeyPatch
) -> None:
    candidates = [Candidate(EFFECTS["joint_elasticity"], joint) for joint in range(3)]
    dictionary = SimpleNamespace(candidates=candidates, rows=lambda candidate, shape: {})
    monkeypatch.setattr(bench, "Dictionary", lambda *given: dictionary)
    # However sure, the data lead no further than the factor.
    values, covariance = np.full(3, -1e-3), 1e-14 * np.eye(3)
    evidence = SimpleNamespace(
        extra=[],
        base_count=0,
        beside=lambda extra: nullcontext(),
        full=SimpleNamespace(values=values),
        covariance=lambda: covariance,
    )
    fitted = replace(arm, encoder="motor", compliance=np.full(3, 1e-4), stated=np.full(3, 1e-4))
    for _ in range(9):
        step, std = bench._compliance_step(SimpleNamespace(arm=fitted), evidence, fitted)
        fitted = replace(fitted, compliance=fitted.compliance + step)
    np.testing.assert_allclose(fitted.compliance, 0.5e-4)
    np.testing.assert_allclose(std, 1e-7)


def test_joints_of_an_undescribed_arm_twist_where_the_sets_clearly_tell_it(arm: NominalArm) -> None:
    usual = np.full(3, 1e-4)
    for encoder, softest in (("motor", 7.9e-4), ("link", 11.9e-4)):
        # Told, told less than twice its deviation, and at the end of the range of any gear.
        sets = [np.array([0.8e-4, 0.5e-4, softest])] * 2
        own = [np.array([0.05e-4, 0.6e-4, 0.01e-4])] * 2
        undescribed = replace(arm, encoder=encoder, compliance=sets[0], stated=usual, within=8.0)
        found = with_compliance_std(undescribed, sets, own)
        np.testing.assert_array_equal(found.compliance, [0.8e-4, 0.0, 0.0])
        assert found.compliance_std is not None
        np.testing.assert_allclose(found.compliance_std, [0.05e-4 / np.sqrt(2.0), 0.0, 0.0])


def test_encoders_of_an_undescribed_arm_are_at_the_links_unless_the_motors_are_clearly_better(
    arm: NominalArm,
) -> None:
    undescribed, described = replace(arm, within=8.0), replace(arm, within=2.0)
    assert _encoder(undescribed, {"link": -7.32, "motor": -7.36}) == "link"
    assert _encoder(described, {"link": -7.32, "motor": -7.36}) == "motor"
    assert _encoder(undescribed, {"link": -6.67, "motor": -7.01}) == "motor"
    assert _encoder(described, {"link": -7.0}) == "link"


@pytest.mark.parametrize("encoder", ["link", "motor"])
def test_a_joint_that_hardly_moves_is_known_as_stated(arm: NominalArm, encoder: EncoderSide) -> None:
    stated, own = np.full(3, 1e-4), [np.array([1e-6, np.inf, np.inf])] * 2
    found = with_compliance_std(
        replace(arm, encoder=encoder, compliance=stated, stated=stated), [stated] * 2, own
    )
    np.testing.assert_allclose(found.compliance_std, [1e-6 / np.sqrt(2.0), 0.5e-4, 0.5e-4])


@pytest.mark.parametrize("encoder", ["link", "motor"])
def test_a_stiffness_that_no_set_was_fitted_to_is_known_as_stated(
    arm: NominalArm, encoder: EncoderSide
) -> None:
    """Sets that all have the stated one did not find it."""
    stated = np.full(3, 1e-4)
    found = with_compliance_std(replace(arm, encoder=encoder, compliance=stated, stated=stated), [stated] * 2)
    np.testing.assert_array_equal(found.compliance, stated)
    np.testing.assert_allclose(found.compliance_std, 0.5 * stated)


def test_motor_torques_alone_leave_the_stated_stiffness(
    arm: NominalArm, monkeypatch: pytest.MonkeyPatch
) -> None:
    """They do not tell a twist from friction and inertia; a coarse search among factors would still find one."""
    stated = np.full(3, 1e-4)
    elastic = replace(arm, encoder="motor", compliance=stated, stated=stated)

    def stop(chosen: NominalArm, recordings: Any) -> Any:
        raise InterruptedError(chosen.compliance)

    monkeypatch.setattr(bench, "structure_of", stop)
    monkeypatch.setattr(bench, "_roughly_stiff", lambda arm, *rest: replace(arm, compliance=2.0 * stated))
    for sides, factor in ((("motor",), 1.0), (("motor", "joint"), 2.0)):
        with pytest.raises(InterruptedError) as raised:
            bench.prepare_bench(
                elastic, [SimpleNamespace(sides=sides)], DiagnosisSettings(), None, (), fit_compliance=True
            )
        np.testing.assert_allclose(raised.value.args[0], factor * stated)


def test_sets_that_agree_know_a_stiffness_no_better_than_their_rows() -> None:
    sets, own = [np.full(3, 1e-4)] * 4, [np.array([0.0, 1e-5, 2e-5])] * 4
    np.testing.assert_allclose(compliance_std(sets, own), [0.0, 0.5e-5, 1e-5])
    np.testing.assert_allclose(compliance_std(sets[:1], own[:1]), own[0])


def test_one_set_says_nothing_of_its_stiffness(model: DynamicModel) -> None:
    assert compliance_std([np.full(3, 1e-4)]) is None
    assert Reference.of(replace(model, provenance=reference(model, {}, 1).stored())).unknown_stiffness == ()


def test_another_payload_shares_no_parameter_and_has_its_announced_mass(chain: Chain) -> None:
    conditions = [Condition(), Condition("load")]
    base = numeric_base(ModelStructure(chain, 2, ("load",)), conditions)
    model = DynamicModel(
        "arm", base.structure, base.names, np.full(len(base), 3.0), 1e-6 * np.eye(len(base)), base
    )
    healthy = replace(reference(model, {}, 8), masses={"load": 2.0})
    other = numeric_base(ModelStructure(chain, 2, ("tool",)), [Condition(), Condition("tool")])
    assert other.names == base.names
    mine = np.array([name.rstrip("R").endswith(str(chain.n + 1)) for name in base.names])
    mass = base.names.index(f"M{chain.n + 1}")

    same = healthy.prior(base, {"load": 2.0})
    another = healthy.prior(other, {"tool": 4.0})
    heavier = healthy.prior(base, {"load": 4.0})
    unknown = healthy.prior(other, {"tool": None})
    assert same is not None
    assert another is not None
    assert heavier is not None
    assert unknown is not None
    assert np.all(np.diag(same[0]) > 0.0)
    assert np.all(np.diag(same[0])[~mine] == np.diag(another[0])[~mine])
    for precision, values in (another, heavier):
        known = np.diag(precision)[mine] > 0.0
        assert known.sum() == 1
        assert values[mass] == 4.0
        assert 1.0 / np.sqrt(precision[mass, mass]) == pytest.approx(0.08)
    assert np.all(np.diag(unknown[0])[mine] == 0.0)


def test_a_cause_is_held_against_what_its_special_case_reaches_on_the_healthy_arm(
    model: DynamicModel,
) -> None:
    null = {("joint_zero_offset", joint): gain for joint, gain in enumerate((30.0, 5.0, 10.0))}
    null |= {("encoder_eccentricity", 0): 0.0, ("stribeck", 0): 1.0, ("stribeck", 1): 0.5}
    limits = reference(model, null, 2).limits()
    for joint in range(3):
        assert limits["encoder_eccentricity", joint] == limits["joint_zero_offset", joint]
    more = reference(model, null | {("encoder_eccentricity", 1): 500.0}, 2).limits()
    assert more["encoder_eccentricity", 1] > more["joint_zero_offset", 1]


def test_habits_of_healthy_days_are_tolerated_beside_every_cause(chain: Chain) -> None:
    """A candidate of a gain as on healthy days joins the base, and passes for no other cause."""
    trials = {
        "stribeck": Trial(Candidate(EFFECTS["stribeck"], 0), Shape(velocity=0.05), _score(300.0), {}),
        "gear_ripple": Trial(Candidate(EFFECTS["gear_ripple"], 1), Shape(), _score(400.0, 2), {}),
        "cable_spring": Trial(Candidate(EFFECTS["cable_spring"], 2), Shape(), _score(120.0), {}),
    }
    contest: Any = Contest(None, DiagnosisSettings())  # type: ignore[arg-type]
    contest.tolerated.known = []
    usual = {"stribeck": True, "gear_ripple": True, "cable_spring": False}
    contest.enough.carried = lambda trial, healthy=True: not healthy or not usual[trial.candidate.cause]
    found = sorted(trials.values(), key=lambda t: -t.score.gain)
    # Several coefficients are a shape of their own; one is a size that changes from day to day.
    assert contest.habit(found)
    assert [one.of for one in contest.tolerated.known] == [("stribeck", 0)]
    assert not contest.habit([trials["gear_ripple"]])
    assert not contest.habit([trials["cable_spring"]])
    usual["cable_spring"] = True
    # Far below the best candidate it changes little.
    assert not contest.habit([trials["gear_ripple"], trials["cable_spring"]])


def test_what_is_unusual_beside_a_habit_alone_is_no_claim(monkeypatch: pytest.MonkeyPatch) -> None:
    """Healthy sets were without the habit, and columns of the same friction share it."""
    here = {("motor", 0): np.ones((3, 1))}
    habit = Tolerance(Kind.HABIT, 0, here, np.inf, ("stribeck", 0))
    trial = Trial(Candidate(EFFECTS["viscous_nonlinear"], 0), Shape(exponent=0.4), _score(900.0), here)
    clear = replace(trial.score, robust=lambda: (1e-4 * np.eye(1), 40))
    trial = replace(trial, score=clear)
    elsewhere = replace(trial, rows={("motor", 1): np.ones((3, 1))})

    def contest(alone: float) -> Contest:
        evidence = SimpleNamespace(extra=[here], replace=lambda extra: None)
        dictionary: Any = SimpleNamespace(
            trial=lambda *_: replace(trial, score=_score(alone)), evidence=evidence
        )
        found = Contest(dictionary, DiagnosisSettings())
        found.tolerated.known = [habit]
        return found

    monkeypatch.setattr(Tolerated, "beside", lambda self, accepted: None)
    monkeypatch.setattr(HealthyNull, "exceeded", lambda self, trial: trial.score.gain > 500.0)
    monkeypatch.setattr(HealthyNull, "limit", lambda self, trial: 0.0)
    assert not contest(100.0).enough.carried(trial)
    assert contest(800.0).enough.carried(trial)
    assert contest(100.0).enough.carried(elsewhere)
    assert contest(100.0).enough.carried(trial, healthy=False)
    kept = contest(100.0)
    kept.enough.carried(trial)
    assert kept.tolerated.known == [habit]


def test_a_limit_grows_with_the_information_of_the_motion_and_falls_with_none() -> None:
    trial = Trial(Candidate(EFFECTS["stribeck"], 0), Shape(velocity=0.05), _score(300.0), {})
    for now, limit in ((10.0, 50.0), (30.0, 150.0), (1.0, 50.0), (1e6, 50.0 * 25.0)):
        dictionary = SimpleNamespace(
            nearest=lambda trial: "v", information=lambda candidate, now=now: {"v": now}
        )
        healthy = Healthy({("stribeck", 0): 50.0}, {("stribeck", 0): {"v": 10.0}})
        null = HealthyNull(dictionary, DiagnosisSettings(), healthy)  # type: ignore[arg-type]
        assert null.limit(trial) == pytest.approx(limit)


def _score(gain: float, count: int = 1) -> Score:
    return Score(gain, gain, np.ones(count), 1.0, lambda: (np.eye(count), 40))


def told(seconds: float, std: float, earliest: float = 0.0) -> Delay:
    return Delay(max(seconds, earliest), std, "told", estimate=seconds, earliest=earliest)


def test_a_delay_that_one_set_does_not_tell_is_that_of_the_others() -> None:
    precise, vague = told(2e-3, 1e-4), told(9e-3, 5e-3)
    assert common_delays([{"motor": []}, {"motor": [precise]}]) == {"motor": 2e-3}
    assert common_delays([{"motor": [vague]}, {"motor": [precise]}])["motor"] == pytest.approx(2e-3, abs=1e-5)
    # Not told from none, or before the motion, as no channel is unless the positions are late.
    assert common_delays([{"motor": [vague]}]) == {"motor": 0.0}
    assert common_delays([{"motor": [told(-7e-3, 1e-3)]}]) == {"motor": 0.0}
    assert common_delays([{"joint": [told(-7e-3, 1e-3, -np.inf)]}]) == {"joint": -7e-3}
    assert common_delays([{"motor": [], "joint": []}]) == {}


@pytest.mark.parametrize(
    ("delays", "apart"),
    [
        ([5.9e-3, 6.2e-3], True),
        ([3.4e-3, 3.6e-3], False),
        # Sessions that contradict each other tell less than each says of itself.
        ([3.1e-3, 8.9e-3], False),
    ],
)
def test_a_delay_apart_from_the_healthy_one_is_told_by_rows_away_from_reversals(
    delays: list[float], apart: bool, arm: NominalArm, model: DynamicModel, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        channel_delays,
        "channel_delays",
        lambda *_: {"motor": [told(one, 2e-4) for one in delays], "joint": []},
    )
    known = replace(reference(model, {}, 2), delay_std_s={"motor": 2e-4})
    late = replace(arm, motor_delay_s=3e-3)
    found = channel_delays.sides_apart([], late, DiagnosisSettings(), known)
    assert set(found) == ({"motor"} if apart else set())
    if apart:
        assert found["motor"][0] == pytest.approx(3.05e-3, abs=1e-4)


def test_a_session_that_hardly_tells_a_delay_does_not_contradict_one_that_does(
    arm: NominalArm, model: DynamicModel, monkeypatch: pytest.MonkeyPatch
) -> None:
    delays = [told(-1e-3, 3e-3), told(5.4e-3, 7e-4)]
    monkeypatch.setattr(channel_delays, "channel_delays", lambda *_: {"motor": delays})
    known = replace(reference(model, {}, 2), delay_std_s={"motor": 5e-4})
    found = channel_delays.sides_apart([], replace(arm, motor_delay_s=0.0), DiagnosisSettings(), known)
    assert found["motor"] == pytest.approx((5.1e-3, 6.8e-4), abs=1e-4)


def test_a_channel_late_away_from_reversals_alone_is_a_note() -> None:
    apart = {"motor": (4.8e-3, 7e-4), "joint": (-2e-3, 3e-4)}
    state = SimpleNamespace(timing=(), corrected=())
    late, early = late_by_themselves(apart, state)  # type: ignore[arg-type]
    assert late.startswith("motor torques look 4.8 ± 0.7 ms late against the healthy arm")
    assert early.startswith("joint torques look 2.0 ± 0.3 ms early")
    # A finding of the channel, or a note of it, has said so.
    state.timing, state.corrected = (SimpleNamespace(cause="motor_torque_delay"),), ("joint",)
    assert late_by_themselves(apart, state) == []  # type: ignore[arg-type]


def test_healthy_sets_can_say_nothing_of_a_cause() -> None:
    first, second = ("stribeck", 0), ("motor_torque_delay", -1)
    healthy = Healthy({first: 50.0, second: 300.0}, {first: {"v": 1.0}, second: {"v": 1.0}})
    others = healthy.without(["motor_torque_delay"])
    assert (others.limits, others.shown, others.sizes) == ({first: 50.0}, {first: {"v": 1.0}}, {})


def test_what_any_healthy_set_asks_to_leave_out_is_left_out_of_all(monkeypatch: pytest.MonkeyPatch) -> None:
    """Presliding and slow friction are the drives', and not every motion shows them."""
    chosen = {
        "first": SignalSettings(
            cutoff_hz=60.0, decimate_hz=5.0, reversal_s=0.2, turning_rad=1e-3, slow_rad_s=0.1
        ),
        "second": SignalSettings(
            cutoff_hz=50.0, decimate_hz=4.0, reversal_s=0.1, turning_rad=2e-2, slow_rad_s=0.0
        ),
    }
    monkeypatch.setattr(
        recording,
        "settled",
        lambda settings, sessions, *_, healthy: replace(settings, signals=chosen[sessions[0]]),
    )
    found = recording.settled_for_all(DiagnosisSettings(), [["first"], ["second"]], None)  # type: ignore[list-item, arg-type]
    assert found.signals == replace(chosen["first"], turning_rad=2e-2)
