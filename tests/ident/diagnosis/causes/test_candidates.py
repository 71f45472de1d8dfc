"""Candidates: pushes longer than their bursts, and remembered products."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import product
from types import SimpleNamespace

import numpy as np
import pytest

from fri.errors import ConfigurationError
from ident.diagnosis.causes.candidates import Candidate, Dictionary, _beside_rest, _neighbours, find_bursts
from ident.diagnosis.gain.evidence import Evidence
from ident.diagnosis.outcome.signatures import signature_bench
from ident.diagnosis.settings import DiagnosisSettings
from ident.dynamics.kinematics import Chain
from ident.effects import EFFECTS, Shape
from ident.effects.nameless import hats
from lwr_driver.session import Session

MIDDLE_S, LENGTH_S, SIZE_NM = 8.0, 3.0, 0.12


def test_a_push_longer_than_its_burst_is_tried(make: Callable[..., Session], chain: Chain) -> None:
    random = np.random.default_rng(3)

    def restless(s: dict[str, np.ndarray]) -> None:
        knots = np.arange(0.0, s["time"][-1] + 1.0, 0.15)
        for joint in range(chain.n):
            wave = np.interp(s["time"], knots, 0.05 * random.normal(size=len(knots)))
            s["joint"][:, joint] += wave
            s["motor"][:, joint] += wave

    def leaning(s: dict[str, np.ndarray]) -> None:
        restless(s)
        since = s["time"] - MIDDLE_S
        push = np.where(np.abs(since) < 0.5 * LENGTH_S, SIZE_NM * np.cos(np.pi * since / LENGTH_S), 0.0)
        s["joint"][:, 1] += push
        s["motor"][:, 1] += push

    bench = signature_bench([make("a.mcap", 1, leaning), make("b.mcap", 2, restless, 1)], chain)
    burst = find_bursts(bench.evidence)[0]
    found = bench.dictionary.best(Candidate(EFFECTS["contact"], -1))
    assert found is not None
    assert abs(found.shape["time"] - MIDDLE_S) < 0.5
    assert burst.duration_s + 0.3 < found.shape["duration"] < LENGTH_S + 0.5


@pytest.mark.parametrize(
    ("here", "ends"), [(-1.8, (-2.3, -0.7)), (-0.7, (-1.8, 0.7)), (0.7, (-0.7, 1.8)), (1.8, (0.7, 4.5))]
)
def test_a_value_is_refined_between_those_beside_it(here: float, ends: tuple[float, float]) -> None:
    assert _neighbours([-1.8, -0.7, 0.7, 1.8], here, signed=True) == pytest.approx(ends)


def test_columns_by_parts_are_those_of_whole_motions(make: Callable[..., Session], chain: Chain) -> None:
    bench = signature_bench([make("a.mcap", 1), make("b.mcap", 2, None, 1)], chain)
    nominal, setting = bench.nominal, bench.dictionary.setting
    for cause in ("presliding_hysteresis", "friction_temperature", "joint_zero_offset", "joint_torque_delay"):
        effect = EFFECTS[cause]
        for shape in effect.shapes(setting, 1):
            whole = [effect.columns(motion, 1, shape) for motion in nominal.motions]
            parts = nominal.columns(lambda m, e=effect, s=shape: e.columns(m, 1, s))
            for k, columns in enumerate(zip(*whole, strict=True)):
                for side in nominal.rows:
                    signals = [getattr(column, side) for column in columns]
                    if signals[0] is not None:
                        expected = nominal.grid.reduce(side, signals)
                        scale = np.abs(expected).max()
                        np.testing.assert_allclose(parts[side][k], expected, rtol=1e-9, atol=1e-9 * scale)


def test_hat_functions_in_rows_are_those_of_the_motion(make: Callable[..., Session], chain: Chain) -> None:
    nominal = signature_bench([make("a.mcap", 1), make("b.mcap", 2, None, 1)], chain).nominal
    whole = [hats(motion.q[:, 1], -0.5, 0.7) for motion in nominal.motions]
    loads = [motion.joint_torque[:, 2] for motion in nominal.motions]
    for side in nominal.rows:
        plain, loaded = nominal.functions(
            side,
            lambda motion: motion.q[:, 1],
            -0.5,
            0.7,
            [lambda m: np.ones(len(m.time)), lambda m: m.joint_torque[:, 2]],
        )
        times = [hat * load[:, None] for hat, load in zip(whole, loads, strict=True)]
        for mine, expected in ((plain, whole), (loaded, times)):
            rows = nominal.grid.reduce(side, expected)
            np.testing.assert_allclose(mine, rows, rtol=1e-9, atol=1e-12 * np.abs(rows).max())


def test_a_dictionary_of_fewer_causes_keeps_its_columns(make: Callable[..., Session], chain: Chain) -> None:
    bench = signature_bench([make("a.mcap", 1), make("b.mcap", 2, None, 1)], chain)
    more = bench.dictionary.of(["sensor_gain", "cable_spring"])
    before = [t for t in more.trials() if t.candidate.cause == "sensor_gain"]
    after = list(more.of(["sensor_gain"]).trials())
    assert before
    assert [t.score.gain for t in after] == [t.score.gain for t in before]
    assert all(a.rows is b.rows for a, b in zip(after, before, strict=True))


def test_any_number_of_threads_gives_the_same_trials(make: Callable[..., Session], chain: Chain) -> None:
    bench = signature_bench([make("a.mcap", 1), make("b.mcap", 2, None, 1)], chain)
    found = []
    for jobs in (1, 2, 3):
        settings = replace(bench.nominal.settings, jobs=jobs)
        nominal = replace(bench.nominal, settings=settings)
        evidence = Evidence(nominal, settings, bench.evidence.sigma, bench.evidence.variance_inflation)
        trials = list(Dictionary(nominal, evidence).trials())
        found.append([(t.candidate.key, t.shape, t.score.gain, *t.score.coefficients) for t in trials])
    assert len(found[0]) > 30
    assert found[1] == found[0]
    assert found[2] == found[0]


@pytest.mark.parametrize("sessions", [2, 3])
@pytest.mark.parametrize("cause", ["sensor_offset_drift", "payload_change"])
def test_steps_of_all_sessions_are_searched_with_the_products_of_one_set_of_columns_for_each_form(
    make: Callable[..., Session], chain: Chain, cause: str, sessions: int
) -> None:
    bench = signature_bench([make(f"{k}.mcap", k, None, k) for k in range(sessions)], chain)
    motions = [replace(motion, loaded=motion.session != 1) for motion in bench.nominal.motions]
    nominal, settings = replace(bench.nominal, motions=motions), bench.nominal.settings
    evidence = Evidence(nominal, settings, bench.evidence.sigma, bench.evidence.variance_inflation)
    dictionary, effect = Dictionary(nominal, evidence), EFFECTS[cause]
    candidate = Candidate(effect, -1 if effect.whole_arm else 1)
    evidence.replace([dictionary.rows(Candidate(EFFECTS["viscous_nonlinear"], 0), Shape(exponent=2.0))])
    best: dict[tuple[object, int], tuple[float, float]] = {}
    for form, session in product(effect.onsets, range(sessions)):
        rows = dictionary.rows(candidate, Shape(form, time=-1.0, session=session + 1))
        for start in np.sort(evidence.block_start[evidence.block_session == session])[1:]:
            on = (evidence.block_session != session) | (evidence.block_start >= start)
            whole = evidence.products.beside(rows)
            after = whole.only(on.astype(float), evidence.products.in_blocks(whole))
            (score,) = evidence.score_products([after], [list(rows)])
            if 1.0 <= start <= dictionary.setting.durations_s[session] - 1.0:
                here = best.get((form, session + 1), (0.0, 0.0))
                best[form, session + 1] = max(here, (score.fitted, start))
    made: list[int] = []
    entry = dictionary._entry
    dictionary._entry = lambda *of: made.append(1) or entry(*of)  # type: ignore[method-assign,func-returns-value]
    found = dictionary._onset(candidate)
    assert found is not None
    assert len(made) == len(effect.onsets)
    fitted, time = best[found.shape.form, int(found.shape["session"])]
    assert found.score.fitted == pytest.approx(fitted, rel=1e-9)
    assert found.shape["time"] == time


def test_no_threads_are_refused() -> None:
    with pytest.raises(ConfigurationError, match="`jobs` is 0; give a number of threads"):
        DiagnosisSettings(jobs=0)


def test_a_limit_in_the_samples_is_believed_above_the_excess_that_a_clipped_model_predicts() -> None:
    effect = EFFECTS["sensor_saturation"]
    bent, tiny = np.array([1.6]), np.array([0.1])
    seen = next(iter(effect.shapes(SimpleNamespace(clipped=np.array([5.0])), 0)))
    guessed = next(iter(effect.shapes(SimpleNamespace(clipped=None, torque_range=np.array([9.0])), 0)))
    assert effect.plausible(bent, seen)
    assert not effect.plausible(bent, guessed)
    assert not effect.plausible(tiny, seen)
    assert not effect.plausible(tiny, guessed)


def test_bursts_keep_away_from_a_rest_of_the_whole_arm() -> None:
    time = np.arange(500) * 0.01
    moving = np.ones((500, 2), dtype=bool)
    moving[200:250] = False
    moving[400:410] = False
    moving[100:180, 0] = False
    rows = SimpleNamespace(time=time, valid=moving)
    mine = np.ones(500, dtype=bool)
    mine[:150] = False
    close = _beside_rest(rows, mine)  # type: ignore[arg-type]
    assert time[close].min() == pytest.approx(1.71)
    assert time[close].max() == pytest.approx(2.79)
    assert close.sum() == 109
