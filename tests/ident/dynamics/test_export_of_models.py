from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest

from fri.errors import ConfigurationError
from ident.dynamics import parameters
from ident.dynamics.base_set import numeric_base
from ident.dynamics.kinematics import Chain
from ident.dynamics.parameters import INERTIAL, PER_LINK
from ident.dynamics.physical import reference_bodies
from ident.dynamics.structure import Coulomb, Coupling, ModelStructure
from ident.formats import (
    Program,
    consistent_parameters,
    export,
    standard_model,
    to_mjcf,
    to_numpy,
    to_urdf,
)
from ident.model.dynamic_model import DynamicModel


def states(n: int, count: int = 30) -> np.ndarray:
    return np.random.default_rng(4).normal(size=(3, count, n))


def program(model: Any) -> dict[str, Any]:
    space: dict[str, Any] = {}
    exec(to_numpy(model), space)
    return space


@pytest.mark.parametrize("payload", [None, "load"])
def test_code_of_a_model_has_its_torques(estimated: Callable[..., DynamicModel], payload: str | None) -> None:
    model = estimated(1)
    q, qd, qdd = states(7)
    motor, joint = program(standard_model(model, payload=payload))["inverse_dynamics"](q, qd, qdd)
    np.testing.assert_allclose(motor, model.torque(q, qd, qdd, payload=payload, side="motor"), atol=1e-9)
    np.testing.assert_allclose(joint, model.torque(q, qd, qdd, payload=payload, side="joint"), atol=1e-9)
    gravity = program(standard_model(model, payload=payload))["gravity"](q)
    np.testing.assert_allclose(gravity, model.gravity(q, payload=payload), atol=1e-9)


def test_code_of_coupled_drives_and_motor_torque_alone() -> None:
    rng = np.random.default_rng(8)
    chain = Chain.from_table(
        [
            {"r": 0.32},
            {"alpha": -np.pi / 2, "theta": -np.pi / 2},
            {"d": 0.225, "r": 0.035, "theta": np.pi / 2},
            {"alpha": np.pi / 2, "r": 0.225},
            {"alpha": -np.pi / 2},
            {"alpha": np.pi / 2},
        ]
    )
    structure = ModelStructure(
        chain, 2, couplings=(Coupling(("q5", "q6")),), coulomb=Coulomb("tanh", 0.05), sides=("motor",)
    )
    base = numeric_base(structure)
    model = DynamicModel("wrist", structure, base.names, rng.normal(size=len(base)), None, base)
    q, qd, qdd = states(6)
    found = program(standard_model(model))["inverse_dynamics"](q, qd, qdd)
    np.testing.assert_allclose(found, model.torque(q, qd, qdd, side="motor"), atol=1e-9)


def test_essential_parameters_alone_make_the_shortest_code(estimated: Callable[..., DynamicModel]) -> None:
    model = estimated(1)
    keep = [
        k for k, name in enumerate(model.names) if name in {"XX2R", "ZZ2R", "MY2R", "XX4R", "ZZ4R", "MY4R"}
    ]
    small = replace(
        model, names=tuple(model.names[k] for k in keep), values=model.values[keep], covariance=None
    )
    q, qd, qdd = states(7)
    space = program(standard_model(small))
    np.testing.assert_allclose(
        space["inverse_dynamics"](q, qd, qdd)[1], small.torque(q, qd, qdd, side="joint"), atol=1e-9
    )
    few, many = (Program.of(standard_model(m)).operations["multiplications"] for m in (small, model))
    assert few < 0.5 * many


def test_urdf_of_a_true_model_reproduces_its_torques(truth_model: DynamicModel) -> None:
    found = standard_model(truth_model, payload="load", consistent=True)
    assert found.notes == (
        "Physically consistent bodies; the torque of the bodies is exactly the identified one.",
    )
    reloaded = pin.buildModelFromXML(to_urdf(found))
    data = reloaded.createData()
    q, qd, qdd = states(7)
    drive = truth_model.drive()
    truth = truth_model.torque(q, qd, qdd, payload="load", side="joint")
    for row in range(len(q)):
        rigid = pin.rnea(reloaded, data, q[row], qd[row], qdd[row])
        joint = rigid + drive["Fvl"] * qd[row] + drive["Fcl"] * np.sign(qd[row]) + drive["offl"]
        np.testing.assert_allclose(joint, truth[row], rtol=0, atol=1e-6)


def test_motor_torques_alone_leave_the_drives_what_the_bodies_of_the_urdf_leave(
    truth_model: DynamicModel, tmp_path: Path
) -> None:
    chain = truth_model.structure.chain
    structure = ModelStructure(chain, 2, sides=("motor",))
    base = numeric_base(structure)
    drives = [structure.names.index(f"Ia{k + 1}") for k in range(chain.n)]
    assert set(drives) & set(base.dependent), "a first drive turns with its link"
    standard = np.zeros(structure.n_columns)
    rotors = np.linspace(0.9, 0.3, chain.n)
    for link, body in enumerate(reference_bodies(chain.urdf_inertials())):
        standard[len(PER_LINK) * link : len(PER_LINK) * link + len(INERTIAL)] = body
    standard[drives] = rotors
    model = DynamicModel("currents", structure, base.names, base.reduce(standard), None, base)
    np.testing.assert_allclose(standard_model(model, consistent=True).drive[:, 0], rotors, atol=1e-6)
    done = export(model, tmp_path / "arm.urdf", tmp_path / "arm.xml")
    assert any(
        "arm.urdf has the bodies without the drives" in note and "A1 0.9" in note for note in done.notes
    )
    armature = [
        float(one.get("armature", 0)) for one in ElementTree.parse(tmp_path / "arm.xml").iter("joint")
    ]
    np.testing.assert_allclose(armature, rotors, atol=1e-6)


def test_an_estimate_of_no_real_body_moves_by_its_uncertainty_and_says_so(
    estimated: Callable[..., DynamicModel],
) -> None:
    model = estimated(2, 0.05)
    found = consistent_parameters(model)
    assert not found.projection.exact
    table = found.vector.reshape(8, 17)[:, :10]
    assert all(verdict.consistent for verdict in parameters.consistency(table))
    assert found.projection.worst < 3.0
    assert "nearest ones were taken" in found.notes[0]
    q, qd, qdd = states(7, 200)
    std = model.torque_std(q, qd, qdd, side="joint")
    for text in (to_urdf, to_mjcf):
        assert "RMS change of the joint torque" in text(standard_model(model, consistent=True))
    assert np.all(found.torque_change_nm < 2.0 * np.sqrt(np.mean(std**2, axis=0)))
    # Masses stay those of an arm although only combinations of them are identified.
    assert 5.0 < table[:7, 9].sum() < 60.0


def test_unsuitable_models_and_payloads_are_refused(truth_model: DynamicModel) -> None:
    with pytest.raises(ConfigurationError, match="payload 'cup' is not in this model"):
        standard_model(truth_model, payload="cup")
    structure = ModelStructure(truth_model.structure.chain, 3)
    difference = DynamicModel("drives", structure, ("Fvm1",), np.array([3.0]))
    with pytest.raises(ConfigurationError, match="has no bodies"):
        standard_model(difference, consistent=True)
    assert "tau_difference" in to_numpy(standard_model(difference))
    with pytest.raises(ConfigurationError, match="reference bodies have shape"):
        standard_model(truth_model, consistent=True, reference=np.zeros((2, 10)))
