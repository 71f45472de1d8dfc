"""Base parameters by both routes: published counts and relations, and agreement on random arms."""

import numpy as np
import pytest
import yaml

from fri.errors import ConfigurationError, DataError
from ident.dynamics.base_closed_form import closed_form_base
from ident.dynamics.base_set import columns_by_preference, numeric_base, rank_at_gap
from ident.dynamics.kinematics import Chain
from ident.dynamics.structure import Condition, Coupling, ModelStructure
from lwr_driver.configuration import find
from tests.ident.dynamics.core_arms import (
    RIGHT,
    lwr,
    panda,
    puma560,
    random_chain,
    scara,
    shared,
    states,
    tx40,
    ur10,
)

ROUTES = pytest.mark.parametrize("route", [numeric_base, closed_form_base], ids=["numeric", "closed form"])


def assert_same(structure, conditions=None):
    numeric, closed = numeric_base(structure, conditions), closed_form_base(structure, conditions)
    assert numeric.columns.tolist() == closed.columns.tolist()
    assert numeric.not_identifiable.tolist() == closed.not_identifiable.tolist()
    assert numeric.dependent.tolist() == closed.dependent.tolist()
    assert np.abs(numeric.regrouping - closed.regrouping).max(initial=0.0) < 1e-9
    assert numeric.names == closed.names
    return numeric


@ROUTES
def test_model_2_of_the_lwr_with_payload_has_the_papers_counts(route):
    """Kolyubin et al.: 136 parameters = 18 not identifiable + 16 regrouped + 102 base."""
    base = route(ModelStructure(lwr(), 2, payloads=("load",)))
    names = base.structure.names
    assert len(base) == 102
    assert " ".join(names[k] for k in base.not_identifiable) == (
        "XX1 XY1 XZ1 YY1 YZ1 MX1 MY1 MZ1 M1 MZ2 M2 Ia8 Fvl8 Fcl8 offl8 Fvm8 Fcm8 offm8"
    )
    assert " ".join(names[k] for k in base.dependent) == (
        "YY2 YY3 MZ3 M3 YY4 MZ4 M4 YY5 MZ5 M5 YY6 MZ6 M6 YY7 MZ7 M7"
    )


@ROUTES
def test_regrouping_relations_of_the_lwr(route):
    """Closed form for alpha = +-90 deg, d = 0, r3 = 0.40, r5 = 0.39 (Jubien et al. 2014b, table III)."""
    masses = {3: "M3 M4 M5 M6 M7", 5: "M5 M6 M7"}

    def sum_of(factor: str, sign: str, link: int) -> str:
        return "".join(f" {sign} {factor} {mass}" for mass in masses[link].split())

    assert route(ModelStructure(lwr(), 2, payloads=("load",))).relations() == (
        "ZZ1R = ZZ1 + YY2",
        "XX2R = XX2 - YY2 + YY3 + 0.8 MZ3" + sum_of("0.16", "+", 3),
        "ZZ2R = ZZ2 + YY3 + 0.8 MZ3" + sum_of("0.16", "+", 3),
        "MY2R = MY2 + MZ3" + sum_of("0.4", "+", 3),
        "XX3R = XX3 - YY3 + YY4",
        "ZZ3R = ZZ3 + YY4",
        "MY3R = MY3 + MZ4",
        "XX4R = XX4 - YY4 + YY5 + 0.78 MZ5" + sum_of("0.1521", "+", 5),
        "ZZ4R = ZZ4 + YY5 + 0.78 MZ5" + sum_of("0.1521", "+", 5),
        "MY4R = MY4 - MZ5" + sum_of("0.39", "-", 5),
        "XX5R = XX5 - YY5 + YY6",
        "ZZ5R = ZZ5 + YY6",
        "MY5R = MY5 - MZ6",
        "XX6R = XX6 - YY6 + YY7",
        "ZZ6R = ZZ6 + YY7",
        "MY6R = MY6 + MZ7",
        "XX7R = XX7 - YY7",
    )


@pytest.mark.parametrize(
    ("model", "sides", "conditions", "expected"),
    [
        (1, (), [Condition()], (64, 56, 16)),
        (1, (), [Condition("load")], (64, 46, 26)),
        (1, (), None, (74, 46, 16)),
        (2, ("motor",), [Condition()], (69, 28, 39)),
        (2, ("motor",), None, (79, 18, 39)),
        (2, (), [Condition()], (92, 28, 16)),
        (2, (), [Condition("load")], (92, 18, 26)),
        (2, (), None, (102, 18, 16)),
        (2, (), [Condition(None, ("joint",)), Condition("load")], (102, 18, 16)),
        (3, (), None, (28, 108, 0)),
    ],
)
def test_counts_of_the_lwr_in_every_arrangement(model, sides, conditions, expected):
    """(base, not identifiable, regrouped) of 136; ranks computed once from 400 random states a session."""
    base = assert_same(ModelStructure(lwr(), model, payloads=("load",), sides=sides), conditions)
    assert (len(base), len(base.not_identifiable), len(base.dependent)) == expected


RIGID = ("Ia", "Fvl", "Fcl", "offl", "Fvm", "Fcm", "offm")
LADDER = (RIGID, RIGID[1:], ("Fvl", "Fcl", "offl", "offm"), ("Fvl", "Fcl", "offl"))


@pytest.mark.parametrize(
    ("arm", "counts"),
    [
        (lwr, (43, 48, 62, 69)),
        (panda, (43, 48, 62, 69)),
        (puma560, (36, 40, 52, 58)),
        (tx40, (36, 40, 52, 58)),
        (ur10, (36, 40, 52, 58)),
    ],
)
def test_known_counts_of_other_arms(arm, counts):
    """Rigid, + Ia, + friction, + offset: SymPyBotics (LWR, Puma), FIGAROH (UR10 36, TX40 58), WAM7 (69)."""
    found = []
    for without in LADDER:
        structure = ModelStructure(arm(), 2, without=without, sides=("motor",))
        found.append(len(assert_same(structure)))
    assert tuple(found) == counts


@pytest.mark.parametrize(("arm", "count"), [(lwr, 12), (panda, 12), (puma560, 10), (tx40, 10), (ur10, 10)])
def test_gravity_alone_shows_few_parameters(arm, count):
    chain = arm()
    structure = ModelStructure(chain, 1, without=RIGID)
    q = states(chain, 60)[0]
    matrix = structure.regressor(q, 0 * q, 0 * q)
    assert np.linalg.matrix_rank(matrix, 1e-9 * np.linalg.norm(matrix)) == count


@pytest.mark.parametrize(
    ("file", "count"),
    [
        ("lwr4_flobaroid/kuka_lwr4_2016-04-11.urdf", 43),
        ("iiwa14/iiwa14.urdf", 43),
        ("tx40/tx40_mdh_modified.urdf", 36),
    ],
)
def test_published_urdfs_have_the_known_rigid_count(file, count):
    structure = ModelStructure(Chain.from_urdf(shared(file)), 1, without=RIGID)
    assert len(assert_same(structure)) == count


def test_the_coupled_wrist_of_the_tx40_adds_three():
    structure = ModelStructure(
        tx40(), 2, without=LADDER[3], sides=("motor",), couplings=(Coupling(("q5", "q6")),)
    )
    assert len(assert_same(structure)) == 61


def test_a_scara_regroups_its_prismatic_drive():
    """z4 parallel to z1: M4 is Ia4 and a weight, besides its share in the links before."""
    structure = ModelStructure(scara(), 2, sides=("motor",), without=("Fvl", "Fcl", "offl"))
    base = assert_same(structure)
    assert base.status("M4") == "a base parameter"
    assert "regrouped" in base.status("offm4")
    bare = ModelStructure(scara(), 2, sides=("motor",), without=("Fvl", "Fcl", "offl", "offm"))
    assert assert_same(bare).status("Ia4") == "a base parameter"


@pytest.mark.parametrize("seed", range(60))
def test_both_routes_agree_on_random_arms(seed):
    rng = np.random.default_rng(seed)
    chain = random_chain(rng)
    model = int(rng.integers(1, 4))
    structure = ModelStructure(
        chain,
        model,
        payloads=("p",) if rng.random() < 0.4 else (),
        without=() if rng.random() < 0.6 else ("offl", "offm"),
        couplings=(Coupling(chain.joint_names[-2:]),) if chain.n > 1 and rng.random() < 0.3 else (),
        sides=("motor",) if model == 2 and rng.random() < 0.5 else (),
    )
    assert_same(structure)


def test_the_torque_depends_on_the_base_parameters_only():
    structure = ModelStructure(puma560(), 2, payloads=("p",))
    base = numeric_base(structure)
    x = np.random.default_rng(0).normal(size=structure.n_columns)
    q, qd, qdd = states(structure.chain, 20)
    for payload in (None, "p"):
        whole = structure.regressor(q, qd, qdd, payload=payload)
        part = structure.regressor(q, qd, qdd, payload=payload, columns=base.columns)
        assert part @ base.reduce(x) == pytest.approx(whole @ x, abs=1e-9)
        assert whole @ base.expand(base.reduce(x)) == pytest.approx(whole @ x, abs=1e-9)


def test_expand_gives_the_nearest_to_the_prior():
    base = numeric_base(ModelStructure(lwr(), 2, payloads=("load",)))
    rng = np.random.default_rng(1)
    prior = rng.normal(size=136)
    assert base.expand(base.reduce(prior), prior) == pytest.approx(prior, abs=1e-12)
    values = rng.normal(size=102)
    near, least = base.expand(values, prior), base.expand(values)
    assert base.reduce(near) == pytest.approx(values, abs=1e-12)
    assert base.reduce(least) == pytest.approx(values, abs=1e-12)
    # The step from the prior is orthogonal to everything invisible in the torque.
    _, _, null = np.linalg.svd(base.matrix)
    assert null[102:] @ (near - prior) == pytest.approx(np.zeros(34), abs=1e-12)


def test_parameters_left_out_of_a_model_stay_zero():
    base = numeric_base(ModelStructure(lwr(), 2, without=("offl", "Ia3")))
    assert len(base.excluded)
    rng = np.random.default_rng(2)
    values, prior = rng.normal(size=len(base.columns)), rng.normal(size=base.structure.n_columns)
    for found in (base.expand(values), base.expand(values, prior)):
        assert not found[base.excluded].any()
        assert base.reduce(found) == pytest.approx(values, abs=1e-12)


def test_published_values_of_table_2_come_out_of_the_emulated_arm():
    """The emulator's standard parameters were made from Table 2 of Kolyubin et al. (two decimals)."""
    content = yaml.safe_load(find("emulator/table2.yaml").read_text(encoding="utf-8"))
    base = numeric_base(ModelStructure(lwr(), 2))
    x = np.array([float(content["parameters"][name]) for name in base.structure.names])
    values = dict(zip(base.names, base.reduce(x), strict=True))
    published = {
        "XX2R": 1.36,
        "ZZ2R": 1.40,
        "MY2R": 3.46,
        "XX4R": 0.44,
        "ZZ4R": 0.45,
        "MY4R": -1.37,
        "MY5R": 0.04,
        "MY6R": 0.03,
    }
    for name, value in published.items():
        assert values[name] == pytest.approx(value, abs=0.005), name


def test_the_gap_in_the_singular_values_is_wide_and_reported():
    base = numeric_base(ModelStructure(lwr(), 2, payloads=("load",)))
    assert base.gap > 1e12
    assert (
        "136 parameters = 18 not identifiable + 16 regrouped + 102 base parameters (numeric)"
        in base.summary()
    )
    assert "not identifiable: XX1 XY1" in base.summary()


def test_names_are_found_with_and_without_r():
    base = numeric_base(ModelStructure(lwr(), 2, without=("Fvl",)))
    assert base.index("ZZ2R") == base.index("ZZ2")
    assert base.names[base.index("MX3")] == "MX3"
    with pytest.raises(
        ConfigurationError, match="'MZ3' is no base parameter of this model; it is regrouped into"
    ):
        base.index("MZ3")
    with pytest.raises(ConfigurationError, match="it is not identifiable"):
        base.index("M1")
    with pytest.raises(ConfigurationError, match="it is left out of the model"):
        base.index("Fvl3")
    with pytest.raises(ConfigurationError, match="did you mean 'ZZ2R'"):
        base.index("ZZ2RR")


@pytest.mark.parametrize("tilt", [0.0, 1e-12, 1e-10])
def test_axes_parallel_to_rounding_are_parallel(tilt):
    chain = Chain.from_table([{}, {"alpha": tilt, "d": 0.3}, {"d": 0.3}])
    assert len(numeric_base(ModelStructure(chain, 2, sides=("motor",)))) == 18


def test_a_rank_without_a_clear_gap_is_not_guessed():
    assert rank_at_gap(np.array([2.0, 1.0, 1e-14]))[0] == 2
    assert rank_at_gap(np.array([2.0, 1.0, 0.5]))[0] == 3
    with pytest.raises(DataError, match="its rank is not clear"):
        rank_at_gap(np.geomspace(1.0, 1e-17, 40))


def test_the_closed_form_needs_gravity():
    chain = Chain.from_table([{}, {"alpha": np.pi / 2}], gravity=(0, 0, 0))
    with pytest.raises(ConfigurationError, match="assume gravity"):
        closed_form_base(ModelStructure(chain, 1))


@ROUTES
def test_an_empty_stack_is_refused(route):
    with pytest.raises((DataError, ConfigurationError), match="no condition"):
        route(ModelStructure(lwr(), 1), [])


def test_columns_are_preferred_as_in_the_literature():
    """Of a revolute joint's link YY, MZ and M come last, of a prismatic one's the inertia tensor and MZ."""
    structure = ModelStructure(scara(), 2, payloads=("p",), couplings=(Coupling(("q1", "q2")),))
    order = columns_by_preference(structure)
    assert sorted(order) == list(range(structure.n_columns))
    names = [structure.names[k] for k in order]
    tensor = ("XX", "XY", "XZ", "YY", "YZ", "ZZ", "MZ")
    late = [f"{symbol}{link}" for link in (1, 2, 3) for symbol in ("YY", "MZ", "M")]
    # The payload is on the last link, of the prismatic joint.
    late += [f"{symbol}{link}" for link in (4, 5) for symbol in tensor]
    assert names[-len(late) :] == late
    assert names[:4] == ["XX1", "XY1", "XZ1", "YZ1"]
    assert names[-len(late) - 3 : -len(late)] == list(structure.names[-3:])


@pytest.mark.parametrize("seed", range(24))
def test_both_routes_agree_on_gantries(seed):
    """Slides between the first turning joint and the next that is not parallel to it."""
    rng = np.random.default_rng([seed, 7])
    n = int(rng.integers(4, 6))
    slides = [False, True, True, bool(rng.random() < 0.5), False][:n]
    joints = [
        {
            "kind": "prismatic" if slide else "revolute",
            "alpha": float(rng.choice([0.0, RIGHT, -RIGHT, 0.7])),
            "d": float(rng.choice([0.0, 0.3])),
            "r": float(rng.choice([0.0, 0.25])),
            **({"theta": float(rng.choice([0.0, RIGHT, 0.5]))} if slide else {}),
        }
        for slide in slides
    ]
    joints[0]["alpha"] = 0.0
    chain = Chain.from_table(joints)
    assert_same(ModelStructure(chain, int(rng.integers(1, 3)), without=() if seed % 2 else ("offl", "offm")))


@pytest.mark.parametrize("kinds", ["PR", "RPR", "PRR", "PPRR", "RPPR"])
@pytest.mark.parametrize("tilt", [0.0, RIGHT])
def test_both_routes_agree_on_lifts(kinds: str, tilt: float):
    """Slides along the first turning axis, all along gravity or all across."""
    joints = [{"kind": "prismatic" if kind == "P" else "revolute", "alpha": 0.0} for kind in kinds]
    joints[0]["alpha"] = tilt
    joints.append({"kind": "revolute", "alpha": RIGHT, "d": 0.2})
    chain = Chain.from_table(joints)
    assert_same(ModelStructure(chain, 2, without=("offl", "offm")))
