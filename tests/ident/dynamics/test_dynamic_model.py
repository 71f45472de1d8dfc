"""The dynamic model and its file."""

import numpy as np
import pytest
import yaml

from fri.errors import ConfigurationError
from ident.dynamics.base_set import numeric_base
from ident.dynamics.structure import Condition, Coupling, DriveMotion, ModelStructure
from ident.model.dynamic_model import DynamicModel
from ident.model.model_file import model_text, read_model, write_model
from tests.ident.dynamics.core_arms import bodies, lwr, scara, states, tx40

STRUCTURES = {
    "lwr": lambda: ModelStructure(lwr(), 2, payloads=("load",)),
    "tx40": lambda: ModelStructure(tx40(), 2, sides=("motor",), couplings=(Coupling(("q5", "q6")),)),
    "scara": lambda: ModelStructure(scara(), 1, without=("offl",)),
}

CABLE = {
    "cause": "cable_spring",
    "side": "joint",
    "joints": [1],
    "form": "linear",
    "parameters": {"stiffness": {"value": 0.3, "std": 0.01, "unit": "Nm/rad"}},
}


def base_model(kind: str = "lwr", *, covariance: bool = True) -> DynamicModel:
    structure = STRUCTURES[kind]()
    base = numeric_base(structure)
    rng = np.random.default_rng(3)
    root = rng.normal(size=(len(base), len(base)))
    return DynamicModel(
        "test arm",
        structure,
        base.names,
        rng.normal(size=len(base)),
        root @ root.T if covariance else None,
        base,
        {"estimator": "wls", "sessions": ["a.mcap"], "samples": np.int64(12)},
    )


@pytest.mark.parametrize("kind", STRUCTURES)
def test_torque_is_the_regressor_times_the_values(kind):
    model = base_model(kind)
    q, qd, qdd = states(model.structure.chain, 15)
    for payload in (None, *model.structure.payloads):
        for side in model.structure.sides:
            matrix = model.regressor(q, qd, qdd, payload=payload, sides=(side,))
            expected = (matrix @ model.values).reshape(model.structure.chain.n, 15).T
            assert model.torque(q, qd, qdd, payload=payload, side=side) == pytest.approx(expected, abs=1e-10)


def test_parameters_without_a_value_are_zero():
    whole = base_model()
    few = ("ZZ2R", "Ia1", "M8")
    values = [whole.value(name) for name in few]
    model = DynamicModel("test arm", whole.structure, few, values, base=whole.base)
    assert model.value("MY2R") == 0.0
    assert model.value("ZZ2") == values[0]
    q, qd, qdd = states(model.structure.chain, 4)
    full = np.zeros(len(whole.base))
    full[[whole.base.index(name) for name in few]] = values
    matrix = whole.regressor(q, qd, qdd, payload="load", sides=("joint",))
    found = model.torque(q, qd, qdd, payload="load", side="joint")
    assert found == pytest.approx((matrix @ full).reshape(7, 4).T, abs=1e-11)


def test_mass_matrix_and_gravity_belong_to_the_torque():
    model = base_model("tx40")
    q = states(model.structure.chain, 1)[0]
    zero, mass = 0 * q, model.mass_matrix(q, drives=True)[0]
    still = model.torque(q, zero, zero)
    for joint in range(6):
        unit = zero.copy()
        unit[0, joint] = 1.0
        assert mass[:, joint] == pytest.approx((model.torque(q, zero, unit) - still)[0], abs=1e-11)
    offsets = model.drive()["offl"] + model.drive()["offm"]
    assert model.gravity(q)[0] + offsets == pytest.approx(still[0], abs=1e-11)


def test_standard_parameters_near_a_prior_and_projected():
    model = base_model()
    prior = np.zeros(model.structure.n_columns)
    for link, body in enumerate(bodies(8)):
        prior[17 * link : 17 * link + 10] = body
    near = model.standard_parameters(prior)
    assert model.base.reduce(near) == pytest.approx(model.values, abs=1e-11)
    assert np.linalg.norm(near - prior) < np.linalg.norm(model.standard - prior)
    seen = []

    def project(given, vector):
        seen.append(given)
        return vector + 1.0

    assert model.standard_parameters(prior, project=project) == pytest.approx(near + 1.0)
    assert seen == [model]


def test_torque_uncertainty_is_that_of_the_linear_model():
    model = base_model("scara")
    q, qd, qdd = states(model.structure.chain, 3)
    matrix = model.regressor(q, qd, qdd)
    expected = np.sqrt(np.diag(matrix @ model.covariance @ matrix.T)).reshape(4, 3).T
    assert model.torque_std(q, qd, qdd) == pytest.approx(expected)
    with pytest.raises(ConfigurationError, match="no covariance"):
        base_model("scara", covariance=False).torque_std(q, qd, qdd)


@pytest.mark.parametrize("kind", STRUCTURES)
def test_a_model_survives_its_file(kind, tmp_path):
    model = base_model(kind)
    write_model(model, tmp_path / "model.yaml")
    again = read_model(tmp_path / "model.yaml")
    assert again.names == model.names
    assert np.array_equal(again.values, model.values)
    assert again.units == model.units
    assert again.covariance == pytest.approx(model.covariance, rel=1e-9, abs=1e-9)
    assert again.provenance == {"estimator": "wls", "sessions": ["a.mcap"], "samples": 12}
    assert again.structure.chain.urdf == model.structure.chain.urdf
    q, qd, qdd = states(model.structure.chain, 5)
    assert np.array_equal(again.torque(q, qd, qdd), model.torque(q, qd, qdd))
    assert model_text(again) == model_text(model)


def test_standard_parameters_survive_their_file(tmp_path):
    structure = STRUCTURES["lwr"]()
    model = DynamicModel("cad", structure, ("M2", "MY2", "Ia1"), [4.0, 0.3, 3.1], effects=(CABLE,))
    write_model(model, tmp_path / "cad.yaml")
    again = read_model(tmp_path / "cad.yaml")
    assert again.kind == "standard"
    assert again.effects == (CABLE,)
    assert np.array_equal(again.standard, model.standard)


def test_the_conditions_of_the_sessions_are_kept(tmp_path):
    structure = STRUCTURES["lwr"]()
    base = numeric_base(structure, [Condition("load")])
    write_model(DynamicModel("arm", structure, base.names, np.ones(92), base=base), tmp_path / "m.yaml")
    assert len(read_model(tmp_path / "m.yaml").base) == 92


def edited(change) -> dict:
    content = yaml.safe_load(model_text(base_model("scara")))
    change(content)
    return content


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda c: c.update(schema_version=2), "schema_version is 2; this software reads 1"),
        (lambda c: c.pop("robot"), "key `robot` is missing"),
        (lambda c: c.update(efects=[]), "unknown key `efects`; did you mean `effects`"),
        (lambda c: c["model"].update(number=7), "model 7 does not exist"),
        (lambda c: c["model"].update(sides=["motors"]), "is not one of motor, joint, difference"),
        (lambda c: c["parameters"][0].update(name="ZZ9"), "'ZZ9'"),
        (lambda c: c["parameters"][0].update(unit="kg"), "has the unit 'kg'; expected 'kg m\\^2'"),
        (lambda c: c["parameters"][0].update(value=float("nan")), "not a finite number"),
        (lambda c: c["parameters"][0].update(std=99.0), "std 99.0 is not the root"),
        (lambda c: c["parameters"][0].update(kind="standard"), "exactly one kind"),
        (lambda c: c["parameters"].append(c["parameters"][0]), "appears twice|rows for"),
        (lambda c: c["covariance"].pop(), "rows for"),
        (lambda c: c["covariance"].__setitem__(1, "1.0"), r"`covariance\[1\]` must hold 2 numbers, found 1"),
        (
            lambda c: c["covariance"].__setitem__(1, "1.0 nan"),
            r"`covariance\[1\]` of (\w+) with \1 \(entry 2\) is nan",
        ),
        (lambda c: c["covariance"].__setitem__(1, "1.0 x"), r"`covariance\[1\]` holds an entry"),
        (lambda c: c.pop("conditions"), "`conditions` is missing"),
        (lambda c: c["chain"]["joints"][0].update(alfa=1.0), "unknown key `alfa`; did you mean `alpha`"),
    ],
)
def test_damaged_files_are_refused_with_the_reason(change, message):
    with pytest.raises(ConfigurationError, match=message):
        read_model(edited(change))


def test_a_name_that_hides_a_regrouping_is_refused():
    def change(content):
        entry = next(e for e in content["parameters"] if e["name"].endswith("R"))
        entry["name"] = entry["name"][:-1]

    with pytest.raises(ConfigurationError, match=r"is `\w+R` under the conditions"):
        read_model(edited(change))


def test_a_covariance_that_is_no_covariance_is_refused():
    def change(content):
        row = content["covariance"][1].split()
        row[0] = "1e6"
        content["covariance"][1] = " ".join(row)

    with pytest.raises(ConfigurationError, match="not positive semi-definite"):
        read_model(edited(change))


def test_values_and_names_must_fit():
    structure = STRUCTURES["scara"]()
    with pytest.raises(ConfigurationError, match="as many finite values"):
        DynamicModel("arm", structure, ("M1", "M2"), [1.0])
    with pytest.raises(ConfigurationError, match="finite and 1 x 1"):
        DynamicModel("arm", structure, ("M1",), [1.0], np.eye(2))
    with pytest.raises(ConfigurationError, match="appears twice"):
        DynamicModel("arm", structure, ("M1", "M1"), [1.0, 2.0])
    with pytest.raises(ConfigurationError, match="another structure"):
        DynamicModel("arm", structure, (), [], base=numeric_base(STRUCTURES["scara"]()))


def test_drives_behind_elastic_joints_move_by_themselves():
    model = base_model()
    q, qd, qdd = states(model.structure.chain, 15)
    moved = DriveMotion(qd[::-1].copy(), qdd[::-1].copy())
    for side in model.structure.sides:
        matrix = model.structure.regressor(q, qd, qdd, sides=(side,), columns=model.columns, drive=moved)
        torque = model.torque(q, qd, qdd, side=side, drive=moved)
        assert torque == pytest.approx((matrix @ model.values).reshape(-1, 15).T, abs=1e-10)
        assert np.allclose(torque, model.torque(q, qd, qdd, side=side)) == (side == "joint")
