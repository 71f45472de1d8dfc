"""A doubt that comes by itself from a poor session, and the motion that settles it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pytest

from ident.diagnosis import Diagnosis, diagnose
from ident.dynamics.kinematics import Chain
from ident.effects import Discriminator
from ident.excitation import ExcitationPlan
from ident.excitation.motions import SplineMotion
from lwr_driver.session import Session
from runner.diagnosis.after_run import decisions
from runner.diagnosis.discriminating import Discriminating, made_up

Make = Callable[..., Session]
PAIR = ("stribeck", "viscous_nonlinear")
STEP_S = 0.1


def of_joint_2(name: str, path: Sequence[float], chain: Chain) -> Discriminating:
    """A motion of joint 2 through points every tenth of a second, at rest before and after."""
    points = np.zeros((3, len(path) + 8))
    points[1] = np.pad(path, 4)
    whole = round((points.shape[1] - 1) * STEP_S / 0.12) * 0.12
    return Discriminating(
        name,
        Discriminator.SLOW_SWEEP,
        2,
        ExcitationPlan(SplineMotion(whole, points), chain.joint_names, 1),
        (None,),
        (),
    )


def slow_and_wide(duration_s: float = 24.0) -> list[float]:
    """One oscillation, up to 0.8 rad/s: nothing fast, little slow."""
    time = np.arange(0.0, duration_s, STEP_S)
    edge = np.minimum(1.0, np.minimum(time, duration_s - time) / 4.0)
    return list(0.8 * edge * np.sin(2.0 * np.pi * time / 6.0))


def sweep() -> list[float]:
    """Constant speeds from 0.6 down to 0.08 rad/s, then swings of up to 3.8 rad/s."""
    path = [0.0]
    for half, speed in ((0.6, 0.6), (0.4, 0.2), (0.2, 0.08)):
        for target in (half, -half, 0.0):
            count = round(abs(target - path[-1]) / speed / STEP_S)
            path += list(np.linspace(path[-1], target, count + 1)[1:])
    for count, swings in ((40, 6), (20, 8)):
        turns = np.arange(1, swings * count + 1) / count
        path += list(1.2 * np.minimum(1.0, np.minimum(turns, swings - turns)) * np.sin(2.0 * np.pi * turns))
    return path


@pytest.fixture(scope="module")
def make(make_250_hz: Make) -> Make:
    """What is looked for here is small."""
    return make_250_hz


@pytest.fixture(scope="module")
def doubt(make: Make, chain: Chain) -> tuple[Diagnosis, Diagnosis]:
    """The diagnosis of an arm with the Stribeck effect from a poor session, and with the sweep besides."""

    def loud(s: dict[str, np.ndarray]) -> None:
        s["motor"][:, 1] += 0.3 * np.random.default_rng(5).normal(size=len(s["time"]))

    healthy_log = make("healthy.mcap", 1, loud)
    healthy = diagnose([healthy_log], chain, causes=PAIR)
    values = {"amplitude": (0.3, "Nm"), "velocity": (0.2, "rad/s"), "exponent": (1.0, "1")}
    parameters = {name: {"value": value, "std": 0.0, "unit": unit} for name, (value, unit) in values.items()}
    hidden = {"cause": "stribeck", "side": "motor", "joints": [2], "parameters": parameters}
    arm = replace(healthy.base_model, effects=(hidden,))
    logs = [
        made_up(healthy, arm, of_joint_2(name, path, chain), None, [healthy_log], start)
        for name, path, start in (("poor", slow_and_wide(), 10**15), ("sweep", sweep(), 10**15 + 10**11))
    ]
    return diagnose(logs[:1], chain, causes=PAIR), diagnose(logs, chain, causes=PAIR)


def test_a_poor_session_leaves_a_doubt(doubt: tuple[Diagnosis, Diagnosis]) -> None:
    (finding,) = doubt[0].claims
    (other, joints, _) = finding.alternatives[0]
    assert {(finding.cause, finding.joints), (other, joints)} == {(cause, (2,)) for cause in PAIR}
    assert finding.confidence < 0.8


def test_the_sweep_decides_for_what_is_there(doubt: tuple[Diagnosis, Diagnosis]) -> None:
    (answer,) = decisions(*doubt)
    assert answer.outcome == "decided"
    assert answer.named == ("stribeck", (2,))
    amplitude = doubt[1].claims[0].parameters["amplitude"]
    assert abs(amplitude.value - 0.3) < 4.0 * amplitude.std
