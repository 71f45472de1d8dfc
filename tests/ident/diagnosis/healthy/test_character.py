"""What healthy sets of sessions have in common belongs to the arm."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from ident.diagnosis import Reference, commission, diagnose
from ident.diagnosis.causes.candidates import Candidate, Trial
from ident.diagnosis.gain.score import Score
from ident.diagnosis.healthy.character import Size, _carried, _kind, _Set
from ident.diagnosis.settings import DiagnosisSettings
from ident.dynamics.kinematics import Chain
from ident.effects import EFFECTS, Shape, parameter_values
from lwr_driver.session import Session

Make = Callable[..., Session]
Signals = dict[str, np.ndarray]
STRIBECK = Candidate(EFFECTS["stribeck"], 1)


def trial(value: float, gain: float, std: float = 0.1, blocks: int = 40) -> Trial:
    score = Score(gain, gain, np.array([value]), 0.02, lambda: (np.array([[std**2]]), blocks))
    return Trial(STRIBECK, Shape(velocity=0.1, exponent=1.0), score, {})


def test_the_size_of_an_effect_is_the_weighted_mean_of_its_sets() -> None:
    one = Size.of([np.array([1.0]), np.array([2.0])], [np.eye(1) * 0.01, np.eye(1) * 0.04], blocks=90)
    # Variances of 0.01 and 0.04, and 0.475 between the sets beyond their mean.
    weights = np.array([1.0 / 0.485, 1.0 / 0.515])
    assert one.mean == pytest.approx([float(weights @ [1.0, 2.0] / weights.sum())])
    assert one.from_set_to_set == pytest.approx(np.sqrt(0.475))
    assert one.blocks == 90
    assert not one.lasting
    alike = Size.of([np.array([1.0]), np.array([1.05])], [np.eye(1) * 0.01] * 2, blocks=80)
    assert alike.from_set_to_set == 0.0
    assert alike.lasting
    assert alike.covariance == pytest.approx(np.eye(1) * 0.005)
    assert alike.p_value < 1e-10


def test_evidence_too_weak_in_each_set_suffices_in_all_together() -> None:
    settings = DiagnosisSettings()
    assert not _carried([trial(0.4, 14.0)], settings)
    assert _carried([trial(value, 14.0) for value in (0.4, 0.45, 0.38)], settings)


def test_an_effect_of_another_size_in_each_set_or_without_a_majority_is_none_of_the_arm() -> None:
    settings = DiagnosisSettings()
    assert not _carried([trial(value, 40.0) for value in (0.9, 0.1, -0.6)], settings)
    assert not _carried([trial(0.9, 90.0), trial(0.9, -1.0), None, trial(0.9, 90.0)], settings)
    assert _carried([trial(0.9, 90.0), trial(0.9, 90.0), None, trial(0.9, 90.0)], settings)


def test_each_harmonic_of_a_ripple_may_be_in_the_model() -> None:
    ripple, shape = Candidate(EFFECTS["gear_ripple"], 2), Shape(cycles_per_turn=1.0, gear_ratio=100.0)
    assert _kind(ripple, shape) != _kind(ripple, shape.at(cycles_per_turn=2.0))
    assert _kind(STRIBECK, Shape(velocity=0.1, exponent=1.0)) == _kind(
        STRIBECK, Shape(velocity=0.2, exponent=2.0)
    )


def of_friction(base: tuple[float, float], laws: list[tuple[str, Shape, float]]) -> list[bool]:
    """Which laws of the speed are part of the friction of joint 2 beside its Coulomb and viscous friction."""
    speed = np.linspace(0.01, 1.5, 300)

    def column(cause: str, shape: Shape) -> np.ndarray:
        if cause == "stribeck":
            return np.exp(-((speed / shape["velocity"]) ** shape["exponent"]))[:, None]
        return (speed ** shape["exponent"])[:, None]

    side = SimpleNamespace(
        valid=np.ones((300, 2), dtype=bool), matrix=np.stack([np.column_stack([np.ones(300), speed])] * 2)
    )
    nominal = SimpleNamespace(rows={"motor": side}, base=SimpleNamespace(names=("Fcm2", "Fvm2")))
    sizes = [np.array([size]) for *_, size in laws]
    evidence = SimpleNamespace(
        extra=[],
        base_count=2,
        full=SimpleNamespace(values=np.array(base)),
        beside=lambda extra: nullcontext(),
        coefficients=lambda: sizes,
    )
    bench = SimpleNamespace(nominal=nominal, evidence=evidence, dictionary=None)
    score = Score(1.0, 1.0, np.ones(1), 0.02, lambda: (np.eye(1), 40))
    trials = [
        Trial(Candidate(EFFECTS[cause], 1), shape, score, {("motor", 1): column(cause, shape)})
        for cause, shape, _ in laws
    ]
    return _Set(bench, DiagnosisSettings()).parts(trials)  # type: ignore[arg-type]


def test_a_law_of_the_speed_is_no_larger_than_the_friction_it_belongs_to() -> None:
    power, slow = Shape(exponent=0.94), Shape(velocity=0.08, exponent=0.5)
    assert of_friction((7.5, 5.0), [("viscous_nonlinear", Shape(exponent=0.6), 8.0)]) == [True]
    assert of_friction((9.4, -1.3), [("viscous_nonlinear", Shape(exponent=0.83), 13.4)]) == [True]
    assert of_friction((7.8, -24.4), [("viscous_nonlinear", power, 37.1)]) == [False]
    assert of_friction((7.8, 5.0), [("stribeck", slow, 2.0)]) == [True]
    assert of_friction((7.8, 5.0), [("stribeck", slow, 84.0)]) == [False]
    pair = [("stribeck", slow, 424.7), ("stribeck", slow.at(velocity=0.0803), -421.9)]
    assert of_friction((9.4, 5.0), pair) == [False, False]


def test_an_accepted_effect_stays_once_whatever_its_size_in_a_set_of_less_noise(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def bench() -> SimpleNamespace:
        dictionary = SimpleNamespace(
            trial=lambda candidate, shape, choices=1: None,
            rows=lambda candidate, shape: {("motor", 1): np.ones((3, 1))},
            measure=lambda candidate, rows: trial(-0.1, 5.0).score,
        )
        return SimpleNamespace(dictionary=dictionary, evidence=None)

    monkeypatch.setattr("ident.diagnosis.healthy.character.again_with", lambda *_: bench())
    monkeypatch.setattr("ident.diagnosis.causes.tolerated.Tolerated.beside", lambda self, accepted: None)
    monkeypatch.setattr("ident.diagnosis.healthy.character.Contest.simplest", lambda self: [trial(0.3, 90.0)])
    one = _Set(bench(), DiagnosisSettings(), [trial(0.4, 90.0)])  # type: ignore[arg-type]
    quieter = one.quieter(["stribeck"])
    assert [t.candidate.key for t in quieter.accepted] == [STRIBECK.key]
    assert not quieter.found()


def sticky(make: Make, day: int, amplitude: float) -> list[Session]:
    """Sessions of a day with friction of joint 2 that rises by `amplitude` towards a standstill."""

    def stick(s: Signals) -> None:
        v = s["qd"][:, 1]
        s["motor"][:, 1] += amplitude * np.sign(v) * np.exp(-np.abs(v) / 0.1)

    return [make("a.mcap", 11 + 10 * day, stick), make("b.mcap", 12 + 10 * day, stick, 1)]


@pytest.fixture(scope="module")
def make(make_250_hz: Make) -> Make:
    """What is looked for here is small."""
    return make_250_hz


@pytest.fixture(scope="module")
def sticking(make: Make, chain: Chain) -> Reference:
    """Of an arm whose friction rises so on both days."""
    return commission([sticky(make, 0, 0.4), sticky(make, 1, 0.4)], chain)


@pytest.mark.slow
def test_friction_that_all_healthy_days_show_is_in_the_reference_and_what_comes_and_goes_is_not(
    make: Make, chain: Chain, sticking: Reference
) -> None:
    lasting = sticking.model.effects
    assert [(entry["cause"], entry["joints"]) for entry in lasting] == [("stribeck", [2])]
    assert not commission([sticky(make, 0, 0.12), sticky(make, 1, -0.12)], chain).model.effects


@pytest.mark.slow
def test_a_usual_change_of_what_the_healthy_arm_has_is_in_the_models_and_no_finding(
    make: Make, chain: Chain, sticking: Reference
) -> None:
    (own,) = (parameter_values(entry) for entry in sticking.model.effects)
    for times in (0.75, 1.3):
        found = diagnose(sticky(make, 2, 0.4 * times), chain, reference=sticking)
        assert not found.findings
        (entry,) = (entry for entry in found.base_model.effects if entry["cause"] == "stribeck")
        now = parameter_values(entry)
        assert now["amplitude"] == pytest.approx(times * own["amplitude"], rel=0.1)
        assert now["velocity"] == own["velocity"]
        # Beside these sessions' claims the reader sees what commissioning learned.
        (told,) = found.to_dict()["healthy"]
        assert (told["cause"], told["joints"]) == ("stribeck", [2])
        assert told["parameters"]["amplitude"]["value"] == own["amplitude"]
        assert set(told["parameters"]["amplitude"]) == {"value", "std", "unit"}
        assert "The healthy arm has: stribeck (two)." in str(found)
    findings = diagnose(sticky(make, 2, 1.2), chain, reference=sticking).findings
    assert [(f.cause, f.joints) for f in findings] == [("stribeck", (2,))]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("known_to", "as_slow", "causes"),
    [(0.02, True, ["stribeck"]), (0.5, True, ["stribeck"]), (0.5, False, [])],
)
def test_a_law_of_the_speed_within_the_error_of_the_healthy_one_is_no_change_where_the_days_were_not_as_slow(
    make: Make, chain: Chain, sticking: Reference, known_to: float, as_slow: bool, causes: list[str]
) -> None:
    (entry,) = sticking.model.effects
    amplitude = entry["parameters"]["amplitude"]
    # Other shapes fit the days about as well, and rise otherwise towards a standstill.
    assert 0.05 < amplitude["std"] / amplitude["value"] < 0.4
    parameters = {**entry["parameters"], "amplitude": {**amplitude, "std": known_to * amplitude["value"]}}
    model = replace(sticking.model, effects=({**entry, "parameters": parameters},))

    def more(s: Signals) -> None:
        v = s["qd"][:, 1]
        s["motor"][:, 1] += np.sign(v) * (0.4 * np.exp(-np.abs(v) / 0.1) + 0.3 * np.exp(-((v / 0.15) ** 2)))

    day = [make("a.mcap", 31, more), make("b.mcap", 32, more, 1)]
    shown = {key: dict(information) for key, information in sticking.shown.items()}
    for shape in shown["stribeck", 1] if not as_slow else ():
        shown["stribeck", 1][shape] /= 1e3
    found = diagnose(day, chain, reference=replace(sticking, model=model, shown=shown))
    assert [f.cause for f in found.findings] == causes
