from __future__ import annotations

import numpy as np
import pytest

from fri.errors import ConfigurationError
from ident.dynamics.structure import Condition, ModelStructure
from ident.excitation.arm_model import ArmEstimate, Mechanism
from ident.excitation.information import Assembly, Columns, Evaluator, Rows
from ident.excitation.motions import FourierBasis

NAMES = (
    "ZZ1R",
    "XX2R",
    "MY2R",
    "ZZ4R",
    "XY5",
    "MX7",
    "Ia3",
    "Fvl2",
    "Fvm2",
    "Fcl5",
    "Fcm5",
    "offl1",
    "offm1",
    "M8",
    "YZ8",
)


@pytest.mark.parametrize("model", [1, 2, 3])
def test_information_is_that_of_the_stacked_observation_matrix(
    model: int, mechanism: Mechanism, estimate: ArmEstimate, rng: np.random.Generator
) -> None:
    columns = Columns.of(7, NAMES)
    evaluator = Evaluator(mechanism, FourierBasis(10.0, 5), estimate, columns, samples=40, refine=2)
    signals = evaluator.signals(0.3 * rng.normal(size=(7, 9)))
    view = evaluator.view(signals, exact_sign=True)
    joint, motor = rng.uniform(0.5, 2.0, 7), rng.uniform(0.5, 2.0, 7)
    rows = Rows(model, (False, True, True), joint, motor)
    found = 40 * Assembly(columns, NAMES, rows).information(view.gram)

    structure = ModelStructure(mechanism.chain, model, payloads=("load",))
    index = [structure.index(name.removesuffix("R")) for name in NAMES]
    q, qd, qdd = (np.ascontiguousarray(signal[::2]) for signal in signals[:3])
    qd = np.where(np.abs(qd) < 1e-7, 0.0, qd)  # at rest up to rounding
    expected = np.zeros((len(NAMES), len(NAMES)))
    weights = {"joint": joint, "motor": motor, "difference": motor}
    for payload in (None, "load", "load"):
        for side in structure.condition_sides(Condition(payload)):
            stacked = structure.regressor(q, qd, qdd, payload=payload, sides=(side,))[:, index]
            expected += stacked.T @ (np.repeat(weights[side], 40)[:, None] * stacked)
    np.testing.assert_allclose(found, expected, rtol=1e-7, atol=1e-7)


def test_adjoint_is_the_transpose_of_the_assembly(rng: np.random.Generator) -> None:
    columns = Columns.of(7, NAMES)
    assembly = Assembly(columns, NAMES, Rows.unweighted(7))
    gram, bar = rng.normal(size=(7, columns.width, columns.width)), rng.normal(size=(len(NAMES), len(NAMES)))
    out = np.zeros_like(gram)
    assembly.adjoint(bar, out)
    assert np.sum(out * gram) == pytest.approx(np.sum(bar * assembly.information(gram)))


def test_gradient_of_any_criterion_reaches_the_coefficients(
    mechanism: Mechanism, estimate: ArmEstimate, rng: np.random.Generator
) -> None:
    columns = Columns.of(7, NAMES)
    assembly = Assembly(columns, NAMES, Rows.unweighted(7))
    evaluator = Evaluator(
        mechanism, FourierBasis(10.0, 5), estimate, columns, samples=30, refine=2, sign_speed=0.1
    )
    bar, torque_bar = rng.normal(size=(len(NAMES),) * 2), rng.normal(size=(30, 7))
    x, step = 0.3 * rng.normal(size=(7, 9)), rng.normal(size=(7, 9))

    def value(at: np.ndarray) -> float:
        view = evaluator.view(evaluator.signals(at))
        return float(np.sum(bar * assembly.information(view.gram)) + np.sum(torque_bar * view.torque))

    view = evaluator.view(evaluator.signals(x))
    assembly.adjoint(bar, view.gram_bar)
    view.torque_bar[:] = torque_bar
    gradient = evaluator.gradient(view)
    h = 1e-6
    assert np.sum(gradient * step) == pytest.approx(
        (value(x + h * step) - value(x - h * step)) / (2 * h), rel=1e-6
    )


def test_unknown_parameters_are_refused() -> None:
    with pytest.raises(ConfigurationError, match="Ia8"):
        Columns.of(7, ["Ia8"])
    with pytest.raises(ConfigurationError, match="QQ3"):
        Columns.of(7, ["QQ3"])
