"""What the base model lacks on every day is no measure of changes: candidates against their usual size."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from fri.errors import ConfigurationError
from ident.diagnosis.causes.candidates import Candidate, Trial
from ident.diagnosis.causes.claims import Claim
from ident.diagnosis.causes.healthy_null import HealthyNull
from ident.diagnosis.causes.usual_sizes import Healthy, OfDays, UsualSize, scatter_limits, usual_sizes
from ident.diagnosis.gain.score import Score
from ident.diagnosis.settings import DiagnosisSettings
from ident.diagnosis.verdict.confidence import Grounds
from ident.diagnosis.verdict.confirmation import _plain
from ident.effects import EFFECTS, Shape
from ident.effects.course import Course

KEY = ("stribeck", 0)


def score(*values: float, information: float = 100.0) -> Score:
    """Coefficients of a given information each, all of it gain."""
    c = np.array(values)
    gain = information * float(c @ c)
    return Score(gain, gain, c, 0.02, lambda: (np.eye(len(c)) / information, 40))


def test_what_two_days_have_in_common_is_the_usual_size_and_only_their_difference_scatter() -> None:
    alike = usual_sizes([{KEY: {"v": score(1.0)}}, {KEY: {"v": score(1.1)}}])[KEY]
    assert alike.mean == pytest.approx([1.05])
    assert alike.scatter == pytest.approx(100.0 * 2 * 0.05**2)
    opposite = usual_sizes([{KEY: {"v": score(1.0)}}, {KEY: {"v": score(-1.0)}}])[KEY]
    assert opposite.mean == pytest.approx([0.0])
    assert opposite.scatter == pytest.approx(200.0)


def test_the_gain_of_another_shape_counts_as_scatter() -> None:
    tables = [{KEY: {"v": score(1.0), "w": score(1.5)}}, {KEY: {"v": score(1.0), "w": score(0.0)}}]
    found = usual_sizes(tables)[KEY]
    assert found.shape == "w"
    # By the shape of most gain: 0.75 from the mean each, and the second set's gain by a shape of its own.
    assert found.scatter == pytest.approx(2 * 100.0 * 0.75**2 + 100.0)
    assert not usual_sizes([{KEY: {"v": score(1.0)}}, {KEY: {"w": score(1.0)}}])


def test_one_day_says_nothing_of_a_usual_size() -> None:
    assert not usual_sizes([{KEY: {"v": score(1.0)}}])
    assert not scatter_limits({}, 1, 0.01, 4)


def test_a_change_is_measured_from_the_usual_size_in_both_directions() -> None:
    size = UsualSize("v", np.array([1.0, 0.0]), 3.0)
    assert size.change(score(1.0, 0.0)) == pytest.approx(0.0)
    assert size.change(score(2.0, 0.0)) == pytest.approx(100.0)
    assert size.change(score(-1.0, 0.0)) == pytest.approx(400.0)
    # Another number of coefficients is another law.
    assert size.change(score(1.0)) == pytest.approx(100.0)


def test_a_size_as_on_other_days_and_less_of_it_is_no_change() -> None:
    size = UsualSize("v", np.array([1.0]), 3.0)
    assert size.beyond(score(1.25)) == 0.0
    assert size.beyond(score(1.5)) == pytest.approx(100.0 * 0.25)
    assert size.beyond(score(0.2)) == 0.0
    assert size.beyond(score(-0.5)) == pytest.approx(100.0 * 2.25)


def test_a_constant_misfit_hides_no_change_of_the_same_candidate() -> None:
    """A gain below that of the healthy days is a finding where the days agreed, and none where they did not."""
    trial = Trial(Candidate(EFFECTS["stribeck"], 0), Shape(velocity=0.05), score(2.0), {})
    dictionary = SimpleNamespace(
        nearest=lambda trial: "v",
        information=lambda candidate: {"v": 100.0},
        scored=lambda candidate, shape: trial.score if shape == "v" else None,
    )

    def null(mean: float, change: float, *, limit: float = 1000.0, scatter: float = 1.0) -> HealthyNull:
        sizes = {KEY: (UsualSize("v", np.array([mean]), scatter), change)}
        healthy = Healthy({KEY: limit}, {KEY: {"v": 100.0}}, sizes)
        return HealthyNull(dictionary, DiagnosisSettings(), healthy)  # type: ignore[arg-type]

    assert null(1.0, 50.0).exceeded(trial)
    assert not null(1.0, 150.0).exceeded(trial)
    assert not null(2.0, 50.0).exceeded(trial)
    # A gain above that of the healthy days is a finding unless their size is clear and explains it.
    assert null(2.0, 150.0, limit=100.0, scatter=1e3).exceeded(trial)
    assert not null(2.0, 150.0, limit=100.0).exceeded(trial)
    # However alike the days were, a change is more than a claim asks for.
    assert null(1.4, 1.0).exceeded(trial)
    assert not null(1.5, 1.0).exceeded(trial)
    assert not HealthyNull(dictionary, DiagnosisSettings(), Healthy({KEY: 1000.0})).exceeded(trial)  # type: ignore[arg-type]


def test_a_size_that_healthy_sets_hardly_show_is_no_change_where_it_is_the_same() -> None:
    """0.11 and 0.12 of a spring with a deviation of 0.03 each have hardly a gain; 0.115 elsewhere has a large one."""
    tables = [{KEY: {"v": score(value, information=1e3), "w": score(0.02)}} for value in (0.11, 0.12)]
    size = usual_sizes(tables)[KEY]
    assert set(size.known) == {"v"}
    again = UsualSize.read(size.stored())
    assert again.known["v"].covariance == pytest.approx(size.known["v"].covariance)

    def exceeded(value: float, *, nearest: float | None = None) -> bool:
        """A trial of this size; nearest : the size in the nearest shape of the grid, of another gain."""
        here = score(value if nearest is None else nearest, information=1e5)
        trial = Trial(Candidate(EFFECTS[KEY[0]], 0), Shape(velocity=0.05), score(value, information=1e5), {})
        dictionary = SimpleNamespace(
            nearest=lambda trial: "v",
            information=lambda candidate: {"v": 1e5},
            scored=lambda candidate, shape: here if shape == "v" else None,
        )
        other = replace(again, shape="x", scatter=1.0)
        healthy = Healthy({KEY: 1.0}, {KEY: {"v": 1e3}}, {KEY: (other, 1.0)})
        return HealthyNull(dictionary, DiagnosisSettings(), healthy).exceeded(trial)  # type: ignore[arg-type]

    assert not exceeded(0.115)
    assert not exceeded(0.16)
    assert exceeded(0.25)
    assert exceeded(-0.115)
    # A gain that the shape of the healthy sets does not have is a cause of its own.
    assert exceeded(0.16, nearest=0.115)


def test_a_claim_by_its_change_alone_is_no_plain_one() -> None:
    claim = Claim(Trial(Candidate(EFFECTS["stribeck"], 0), Shape(velocity=0.05), score(2.0), {}), score(2.0))
    grounds = Grounds(3.0, 9.0, 4.0, 3.0, 0.0, 0.2, 0.0, 0.0)
    finding = SimpleNamespace(mode=None)
    assert _plain(claim, finding, None, grounds, (1.0, 2.0))  # type: ignore[arg-type]
    assert not _plain(replace(claim, changed_alone=True), finding, None, grounds, (1.0, 2.0))  # type: ignore[arg-type]


def test_limits_of_scatter_lean_on_the_other_joints() -> None:
    sizes = {
        ("stribeck", j): UsualSize("v", np.ones(1), scatter) for j, scatter in enumerate((40.0, 1.0, 1.0))
    }
    limits = scatter_limits(sizes, 2, 0.01, 4)
    assert limits["stribeck", 0] > limits["stribeck", 1] > 1.0
    many = scatter_limits(sizes, 12, 0.01, 4)
    assert many["stribeck", 1] < limits["stribeck", 1]


def test_sensors_that_drift_together_are_one_observation_of_a_day() -> None:
    def largest(cause: str) -> float:
        sizes = {
            (cause, j): UsualSize("v", np.ones(1), scatter) for j, scatter in enumerate((40.0, 1.0, 1.0))
        }
        return scatter_limits(sizes, 2, 0.01, 4)[cause, 0]

    assert largest("sensor_offset_drift") > 3.0 * largest("stribeck")


def test_a_limit_grows_with_what_unlike_sessions_show() -> None:
    short, long = (f"Shape(within a session, time_constant={time})" for time in (8.0, 16.0))
    trial = Trial(Candidate(EFFECTS["sensor_offset_drift"], 0), Shape(), score(1.0), {})
    dictionary = SimpleNamespace(information=lambda _: {long: 8.0}, nearest=lambda _: long)
    null = HealthyNull(
        dictionary,  # type: ignore[arg-type]
        DiagnosisSettings(),
        Healthy({trial.candidate.key: 10.0}, {trial.candidate.key: {short: 2.0}}),
    )
    assert null.limit(trial) == pytest.approx(40.0)


def _drifts(gains: Sequence[float], cause: str = "friction_temperature") -> list[bool]:
    """Whether the step between sessions of each joint, of these gains, is more than on a healthy arm: two sets with a
    mean gain of 50 each, of days alike by chance."""
    step = Shape(Course.LEVEL_AND_STEP, since=2)
    trials = [
        Trial(Candidate(EFFECTS[cause], joint), step, score(np.sqrt(gain / 100.0)), {})
        for joint, gain in enumerate(gains)
    ]
    dictionary = SimpleNamespace(
        information=lambda _: {},
        nearest=lambda _: repr(step),
        shape=lambda *_: step,
        scored=lambda candidate, _: trials[candidate.joint].score,
    )
    keys = [trial.candidate.key for trial in trials]
    healthy = Healthy(
        dict.fromkeys(keys, 500.0),
        sizes=dict.fromkeys(keys, (UsualSize(repr(step), np.array([0.7]), 1.0), 15.0)),
        days=dict.fromkeys(keys, OfDays(50.0, 500.0, 4000.0)),
    )
    null = HealthyNull(dictionary, DiagnosisSettings(), healthy)  # type: ignore[arg-type]
    null.meet(trials)
    return [null.exceeded(trial) for trial in trials]


@pytest.mark.parametrize("cause", ["friction_temperature", "sensor_offset_drift"])
def test_a_step_between_sessions_is_told_beyond_the_state_of_the_day(cause: str) -> None:
    """Two sets of days alike by chance say nothing of other days; the other joints share the day's state."""
    # A warmer day: more than in both sets, in all joints.
    assert not any(_drifts([200.0, 150.0, 250.0, 180.0], cause))
    assert not any(_drifts([1000.0, 700.0, 600.0, 900.0], cause))
    # One joint alone, on an ordinary day and on a warmer one.
    assert _drifts([60.0, 40.0, 900.0, 50.0], cause) == [False, False, True, False]
    assert _drifts([200.0, 250.0, 3000.0, 150.0], cause) == [False, False, True, False]
    # All joints, beyond any day that two sets leave room for.
    assert all(_drifts([5000.0, 6000.0, 7000.0, 6000.0], cause))
    # Too few joints tell nothing of the day.
    assert _drifts([60.0, 900.0], cause) == [False, False]


def test_a_usual_size_is_read_as_it_was_written() -> None:
    size = UsualSize("Shape(velocity=0.05)", np.array([1.25, -3e-7]), 12.34)
    again = UsualSize.read(size.stored())
    assert (again.shape, again.scatter) == (size.shape, size.scatter)
    assert again.mean == pytest.approx(size.mean)
    with pytest.raises(ConfigurationError, match="give a list of numbers"):
        UsualSize.read({"shape": "v", "mean": [], "scatter": 1.0})
