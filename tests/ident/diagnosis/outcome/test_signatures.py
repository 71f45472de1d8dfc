from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from fri.errors import ConfigurationError, DataError
from ident.diagnosis.healthy.bench import DiagnosisBench
from ident.diagnosis.outcome.signatures import overlap, signature_bench, signatures
from ident.dynamics.kinematics import Chain
from lwr_driver.session import Session

Make = Callable[..., Session]


@pytest.fixture(scope="module")
def bench(make: Make, chain: Chain) -> DiagnosisBench:
    def cable(s: dict[str, np.ndarray]) -> None:
        s["motor"][:, 2] += 0.1 * s["q"][:, 2] ** 3
        s["joint"][:, 2] += 0.1 * s["q"][:, 2] ** 3

    return signature_bench([make("a.mcap", 1, cable), make("b.mcap", 2, cable, 1)], chain)


def test_signature_is_the_torque_of_the_cause_that_the_data_fit(bench: DiagnosisBench) -> None:
    (cable,) = signatures(bench, [("cable_spring", (3,))])
    assert cable.joints == (3,)
    assert cable.form is not None
    assert cable.form.value == "cubic"
    assert cable.parameters["stiffness"] == pytest.approx(0.1, rel=0.1)
    assert cable.strength > 20.0
    assert 0.05 < cable.share < 0.99
    for side in ("motor", "joint"):
        assert cable.torque[side].shape == cable.left[side].shape == (len(cable.time[side]), 3)
        assert not np.any(cable.torque[side][:, :2])


def test_nothing_is_left_of_what_base_parameters_imitate(bench: DiagnosisBench) -> None:
    mass = {"mass": 0.3, "moment_x": 0.03, "moment_y": 0.0, "moment_z": 0.0}
    (payload,) = signatures(bench, [("payload_error", ())], parameters=[mass])
    assert np.abs(payload.torque["joint"]).max() > 0.3
    assert payload.share < 1e-6
    assert np.nanmax(np.abs(payload.left["joint"])) < 1e-3


def test_left_is_orthogonal_to_the_base(bench: DiagnosisBench) -> None:
    (stribeck,) = signatures(bench, [("stribeck", (2,))])
    rows, evidence = bench.nominal.rows["motor"], bench.evidence
    used = np.isfinite(stribeck.left["motor"][:, 1])
    moment = rows.matrix[1][used].T @ stribeck.left["motor"][used, 1]
    whole = np.linalg.norm(rows.matrix[1][used], axis=0) * np.linalg.norm(stribeck.torque["motor"][used, 1])
    alone = [k for k, name in enumerate(evidence.nominal.base.names) if name.startswith(("Fvm2", "Fcm2"))]
    assert alone
    assert np.all(np.abs(moment[alone]) < 1e-5 * whole[alone])


def test_look_alikes_overlap_and_strangers_do_not(bench: DiagnosisBench) -> None:
    names = [
        ("stribeck", (2,)),
        ("viscous_nonlinear", (2,)),
        ("sensor_crosstalk", (1,)),
        ("stribeck", (2,)),
    ]
    rise = {"amplitude": 0.3, "velocity": 0.15, "exponent": 1.0}
    thin = {"coefficient": 0.3, "exponent": 0.4}
    found = signatures(bench, names, parameters=[rise, thin, None, {**rise, "amplitude": -1.0}])
    stribeck, thinning, stranger, again = found
    assert overlap(stribeck, again) == pytest.approx(1.0)
    assert 0.6 < overlap(stribeck, thinning) < 0.999
    assert overlap(stribeck, stranger) < 0.2


def test_what_has_no_signature_is_an_error(bench: DiagnosisBench, make: Make, chain: Chain) -> None:
    with pytest.raises(DataError, match="lost_samples leaves no torque"):
        signatures(bench, [("lost_samples", ())])
    with pytest.raises(ConfigurationError, match="did you mean"):
        signatures(bench, [("stribek", (1,))])
    other = signature_bench([make("a.mcap", 1)], chain)
    with pytest.raises(ValueError, match="different benches"):
        overlap(*signatures(bench, [("stribeck", (2,))]), *signatures(other, [("stribeck", (2,))]))
    with pytest.raises(DataError, match="no session given"):
        signature_bench([], chain)
