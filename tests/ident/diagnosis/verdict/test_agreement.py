"""A claim gives its torque in all rows by one size: the other side of the drive and single joints may contradict it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from ident.diagnosis.causes.candidates import Candidate, Dictionary
from ident.diagnosis.causes.claims import Claim
from ident.diagnosis.outcome.signatures import signature_bench
from ident.diagnosis.verdict.agreement import in_one_joint, on_both_sides, uneven
from ident.dynamics.kinematics import Chain
from ident.dynamics.regressor import torque
from ident.effects import EFFECTS
from lwr_driver.session import Session

Make = Callable[..., Session]
Signals = dict[str, np.ndarray]
TILT_RAD = 0.02


def claimed(
    make: Make, chain: Chain, change: Callable[[Signals], None], cause: str, joint: int
) -> tuple[Dictionary, Claim]:
    bench = signature_bench([make("a.mcap", 1, change), make("b.mcap", 2, change, 1)], chain)
    trial = bench.dictionary.best(Candidate(EFFECTS[cause], joint))
    assert trial is not None
    assert trial.score.gain > 100.0
    bench.evidence.replace([*bench.evidence.extra, trial.rows])
    return bench.dictionary, Claim(trial, trial.score)


@pytest.mark.parametrize(("sides", "told"), [(("joint",), False), (("joint", "motor"), True)])
def test_a_torque_that_motor_and_sensor_show_is_no_error_of_the_sensor(
    make: Make, chain: Chain, sides: tuple[str, ...], told: bool
) -> None:
    def wave(s: Signals) -> None:
        for side in sides:
            s[side][:, 2] += 0.3 * np.sin(4.0 * s["q"][:, 2])

    assert on_both_sides(*claimed(make, chain, wave, "sensor_ripple", 2)) is told


def test_friction_is_not_in_the_sensor(make: Make, chain: Chain) -> None:
    def friction(s: Signals) -> None:
        s["motor"][:, 1] += 0.4 * np.sign(s["qd"][:, 1]) * np.exp(-np.abs(s["qd"][:, 1]) / 0.15)

    assert not on_both_sides(*claimed(make, chain, friction, "stribeck", 1))


@pytest.fixture(scope="module")
def tilted(chain: Chain, bodies: np.ndarray) -> Callable[[Signals], np.ndarray]:
    """Torque (N, 3) of a base that leans to a side."""
    lean = np.array([[1.0, 0.0, TILT_RAD], [0.0, 1.0, 0.0], [-TILT_RAD, 0.0, 1.0]])

    def found(s: Signals) -> np.ndarray:
        still = np.zeros_like(s["q"])
        leaning = torque(replace(chain, gravity=lean @ chain.gravity), s["q"], still, still, bodies)
        return np.asarray(leaning - torque(chain, s["q"], still, still, bodies))

    return found


def test_all_joints_agree_on_a_tilt(
    make: Make, chain: Chain, tilted: Callable[[Signals], np.ndarray]
) -> None:
    def lean(s: Signals) -> None:
        for side in ("joint", "motor"):
            s[side] += tilted(s)

    found = claimed(make, chain, lean, "base_tilt", -1)
    assert not uneven(*found)
    assert not in_one_joint(*found)


def test_a_joint_without_its_share_contradicts_a_tilt(
    make: Make, chain: Chain, tilted: Callable[[Signals], np.ndarray]
) -> None:
    def pull(s: Signals) -> None:
        for side in ("joint", "motor"):
            s[side] += tilted(s) * np.array([1.0, 0.0, 1.0])

    assert uneven(*claimed(make, chain, pull, "base_tilt", -1))


def test_a_tilt_that_one_joint_alone_can_show_is_told(
    make: Make, chain: Chain, tilted: Callable[[Signals], np.ndarray]
) -> None:
    def noisy(s: Signals) -> None:
        random = np.random.default_rng(4)
        for side in ("joint", "motor"):
            s[side] += tilted(s)
            s[side][:, 1:] += 20.0 * random.normal(size=s["q"][:, 1:].shape)

    found = claimed(make, chain, noisy, "base_tilt", -1)
    assert in_one_joint(*found)
    assert not uneven(*found)
