from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fri.errors import ConfigurationError
from lwr_driver.configuration import parse
from lwr_driver.session import JointColumns
from lwr_driver.session.motor_torque import KrlMotorTorque, KrlTorqueDecoder, match_torques
from tests.lwr_driver.session.session_samples import JOINTS, signals


def cycles(counters, config, seed=0):
    """KRL variables of one cycle per counter; the values belong to the counter and are noise elsewhere."""
    rng = np.random.default_rng(seed)
    count = len(counters)
    real = rng.normal(size=(count, 16)).astype(np.float32)
    integer = rng.integers(-5, 5, size=(count, 16)).astype(np.int32)
    integer[:, config.counter_int - 1] = (
        np.array(counters, dtype=np.int64).astype(np.uint32).view(np.int32) if count else 0
    )
    for joint, slot in enumerate(config.reals):
        real[:, slot - 1] = [np.float32(value * 8 + joint) for value in counters]
    return real, integer


def decode(decoder, counters, config, cuts):
    real, integer = cycles(counters, config)
    times = 1000 + np.arange(len(counters)) * 10
    parts = []
    bounds = [0, *cuts, len(counters)]
    for first, stop in itertools.pairwise(bounds):
        part = slice(first, stop)
        parts.append(decoder.decode(times[part], times[part] * 2, real[part], integer[part]))
    return parts


@settings(max_examples=100, deadline=None)
@given(
    steps=st.lists(st.sampled_from([0, 0, 0, 0, 1, 1, 2, 5]), min_size=1, max_size=80),
    start=st.integers(0, 20),
    modulus=st.sampled_from([2**31, 2**16, 2500]),
    data=st.data(),
)
def test_one_sample_for_each_change_of_the_counter(steps, start, modulus, data):
    config = KrlMotorTorque(
        reals=(3, 1, 16), scale=(1.0, 2.0, 0.5), sign=(1, -1, 1), counter_int=7, counter_modulus=modulus
    )
    unwrapped = np.cumsum([modulus - start, *steps])
    counters = (unwrapped % modulus).tolist()
    cuts = sorted(data.draw(st.lists(st.integers(0, len(counters)), max_size=4)))
    decoder = KrlTorqueDecoder(config)
    parts = decode(decoder, counters, config, cuts)
    fresh = [row for row in range(1, len(counters)) if unwrapped[row] != unwrapped[row - 1]]
    wanted = [
        [(counters[row] * 8) * 1.0, -(counters[row] * 8 + 1) * 2.0, (counters[row] * 8 + 2) * 0.5]
        for row in fresh
    ]
    effort = np.concatenate([part.effort for part in parts])
    np.testing.assert_allclose(
        effort, np.float32(wanted).reshape(-1, 3) if fresh else np.empty((0, 3)), rtol=1e-6
    )
    np.testing.assert_array_equal(
        np.concatenate([part.log_time for part in parts]), [1000 + 10 * row for row in fresh]
    )
    numbers = np.concatenate([part.sequence for part in parts])
    np.testing.assert_array_equal(np.diff(numbers), np.diff(unwrapped[fresh]))
    assert decoder.fresh == len(fresh)
    assert decoder.lost == int((np.diff(unwrapped[fresh]) - 1).sum())
    assert decoder.restarts == 0
    assert decoder.torn == 0


def test_the_first_value_has_no_known_time():
    config = KrlMotorTorque()
    parts = decode(KrlTorqueDecoder(config), [5, 5, 5, 6, 6], config, [])
    assert parts[0].sequence.tolist() == [6]
    assert parts[0].log_time.tolist() == [1030]


def test_restart_of_the_krl_program_is_no_million_lost_values():
    config = KrlMotorTorque()
    decoder = KrlTorqueDecoder(config)
    parts = decode(decoder, [100, 101, 102, 0, 1, 2], config, [4])
    assert decoder.restarts == 1
    assert decoder.lost == 0
    assert np.concatenate([part.sequence for part in parts]).tolist() == [101, 102, 103, 104, 105]


def test_values_written_after_the_counter_are_counted():
    config = KrlMotorTorque()
    real, integer = cycles([1, 2, 2, 3], config)
    real[2, 0] += 1.0
    decoder = KrlTorqueDecoder(config)
    times = np.arange(4)
    decoder.decode(times, times, real, integer)
    assert decoder.torn == 1


def test_nan_that_is_held_is_no_change():
    config = KrlMotorTorque()
    real, integer = cycles([1, 2, 2, 2], config)
    real[:, 3] = np.nan
    decoder = KrlTorqueDecoder(config)
    times = np.arange(4)
    fresh = decoder.decode(times, times, real, integer)
    assert len(fresh.effort) == 0
    assert (decoder.torn, decoder.rejected) == (0, 1)


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_sample_that_is_not_finite_is_left_out_counted_and_missing_in_the_numbers(value):
    config = KrlMotorTorque()
    real, integer = cycles([1, 2, 3, 4], config)
    real[2, config.reals[3] - 1] = value
    decoder = KrlTorqueDecoder(config)
    times = np.arange(4)
    fresh = decoder.decode(times, times, real, integer)
    assert fresh.sequence.tolist() == [2, 4]
    assert np.isfinite(fresh.effort).all()
    assert (decoder.fresh, decoder.rejected) == (2, 1)


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({"reals": [1, 2, 3, 4, 5, 6, 6]}, "different variable for each joint"),
        ({"reals": [1, 2, 3, 4, 5, 6, 17]}, "outside 1 to 16 .KRL variables are numbered from 1"),
        ({"counter_int": 0}, "outside 1 to 16 .KRL variables are numbered from 1"),
        ({"reals": [1, 2]}, "have 2, 7 and 7"),
        ({"sign": [1, 1, 1, 0, 1, 1, 1]}, "must be 1 or -1"),
        ({"scale": [1.0, 1.0, 0.0, 1.0, 1.0, 1.0, 1.0]}, "finite and not zero"),
        ({"counter_modulus": 1}, "outside 2 to"),
        ({"realls": [1]}, "did you mean `reals`"),
    ],
)
def test_settings_that_cannot_be(keys, message):
    with pytest.raises(ConfigurationError, match=message):
        parse(KrlMotorTorque, keys, "robot.yaml")


def columns(topic, effort):
    count = len(effort)
    times = np.arange(count) * 1_000_000
    empty = np.empty((count, 0))
    return JointColumns(topic, JOINTS, times, times, np.arange(count), empty, empty, effort)


def test_torques_are_matched_with_their_sensors():
    _, torque = signals(6000)
    motor = torque + 3.0 * np.sign(torque)
    matches = match_torques(columns("/joint_states", torque), columns("/motor_states", motor))
    assert not any(match.suspect for match in matches)
    assert all(match.follows == match.joint and match.correlation > 0.98 for match in matches)


def test_exchanged_and_wrongly_scaled_torques_are_said():
    _, torque = signals(6000)
    motor = torque[:, [0, 2, 1, 3, 4, 5, 6]] * [1, 1, 1, 160.0, -1, 1, 1]
    matches = match_torques(columns("/joint_states", torque), columns("/motor_states", motor))
    assert [match.joint for match in matches if match.swapped] == ["A2", "E1"]
    assert [match.joint for match in matches if match.suspect] == ["A2", "E1", "A3", "A4"]
    assert "motor torque of A2 follows the torque sensor of E1" in str(matches[1])
    assert "motor torque of A3 is 160 times its torque sensor" in str(matches[3])
