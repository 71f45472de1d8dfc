from __future__ import annotations

import ctypes
import re
import shutil
import subprocess
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
import yaml
from numpy.typing import NDArray

from fri.errors import ConfigurationError
from ident.dynamics import parameters
from ident.dynamics.base_set import numeric_base
from ident.dynamics.kinematics import Chain
from ident.dynamics.physical import project, reference_bodies
from ident.dynamics.structure import ModelStructure
from ident.formats import CoupledDrives, Program, StandardModel, to_c, to_mjcf, to_numpy, to_urdf
from lwr_driver.configuration import CONFIGS

Floats = NDArray[np.float64]


def table2() -> tuple[Chain, Floats]:
    chain = Chain.from_urdf(CONFIGS / "lwr4plus.urdf")
    values = yaml.safe_load((CONFIGS / "emulator" / "table2.yaml").read_text())["parameters"]
    rows = [[float(values[f"{symbol}{link}"]) for symbol in parameters.PER_LINK] for link in range(1, 8)]
    return chain, np.array(rows)


def lwr() -> StandardModel:
    chain, rows = table2()
    return StandardModel(chain, rows[:, :10], rows[:, 10:], title="LWR4+ of Table 2")


def odd_arm() -> StandardModel:
    rng = np.random.default_rng(5)
    chain = Chain.from_table(
        [
            {"alpha": 0.3, "d": 0.1, "theta": 0.5, "r": 0.2},
            {"alpha": -1.1, "d": 0.3, "r": 0.2, "kind": "prismatic", "theta": 0.4},
            {"alpha": np.pi / 2, "d": 0.1, "theta": np.pi, "r": 0.2},
            {"alpha": -np.pi / 2, "d": 0.1, "theta": -np.pi / 2, "kind": "prismatic"},
        ],
        gravity=(1.0, -2.0, -9.0),
    )
    couplings = (CoupledDrives((2, 0), 0.3, 0.7, 1.1),)
    return StandardModel(chain, rng.normal(size=(4, 10)), rng.normal(size=(4, 7)), couplings)


def expected(model: StandardModel, q: Floats, qd: Floats, qdd: Floats) -> dict[str, Floats]:
    """Torques from pinocchio and the friction terms written out."""
    pinocchio_model = model.chain.to_pinocchio()
    for k in range(model.chain.n):
        body = pin.Inertia.FromDynamicParameters(parameters.to_pinocchio(model.inertial[k]))
        pinocchio_model.inertias[k + 1] = body
    data = pinocchio_model.createData()
    rigid = np.array(
        [
            pin.rnea(pinocchio_model, data, *state).copy()
            for state in zip(configuration(model.chain, q), qd, qdd, strict=True)
        ]
    )
    ia, fvl, fcl, offl, fvm, fcm, offm = model.drive.T
    joint = rigid + fvl * qd + fcl * np.sign(qd) + offl
    own = ia * qdd + fvm * qd + fcm * np.sign(qd) + offm
    for coupling in model.couplings:
        a, b = coupling.joints
        both = qd[:, a] + qd[:, b]
        for one, other in ((a, b), (b, a)):
            own[:, one] += coupling.inertia * qdd[:, other] + coupling.viscous * both
            own[:, one] += coupling.coulomb * np.sign(both)
    return {"tau_joint": joint, "tau_motor": joint + own, "tau_difference": own}


def configuration(chain: Chain, q: Floats) -> Floats:
    """pinocchio's configuration of joints bounded on neither side is the joint position for RZ and PZ."""
    return q


def states(n: int, count: int = 40) -> Floats:
    q, qd, qdd = np.random.default_rng(3).normal(size=(3, count, n))
    qd[0] = 0.0
    return np.array([q, qd, qdd])


MODELS: list[Callable[[], StandardModel]] = [lwr, odd_arm]


@pytest.mark.parametrize("build", MODELS)
def test_numpy_program_computes_the_torques_of_the_model(build: Callable[[], StandardModel]) -> None:
    model = build()
    space: dict[str, Any] = {}
    exec(to_numpy(model), space)
    q, qd, qdd = states(model.chain.n)
    found = space["inverse_dynamics"](q, qd, qdd)
    truth = expected(model, q, qd, qdd)
    for output, values in zip(Program.of(model).outputs, found, strict=True):
        np.testing.assert_allclose(values, truth[output], rtol=0, atol=1e-9)
    one = space["inverse_dynamics"](q[0], qd[0], qdd[0])
    np.testing.assert_array_equal(one[0], found[0][0])
    offset = model.drive[:, 3]
    still = expected(StandardModel(model.chain, model.inertial, 0 * model.drive), q, 0 * q, 0 * q)
    np.testing.assert_allclose(space["gravity"](q), still["tau_joint"], rtol=0, atol=1e-9)
    assert np.any(offset != 0)


@pytest.mark.parametrize("build", MODELS)
def test_c_program_computes_the_torques_of_the_model(
    build: Callable[[], StandardModel], tmp_path: Path
) -> None:
    compiler = shutil.which("cc")
    if compiler is None:
        pytest.skip("no C compiler `cc` on this machine")
    model = build()
    (tmp_path / "arm.c").write_text(to_c(model, "arm"))
    flags = ["-std=c99", "-O2", "-Wall", "-Wextra", "-Werror", "-shared", "-fPIC"]
    library = tmp_path / "arm.so"
    subprocess.run([compiler, *flags, "-o", str(library), str(tmp_path / "arm.c"), "-lm"], check=True)
    function = ctypes.CDLL(str(library)).arm_inverse_dynamics
    n = model.chain.n
    vector = ctypes.c_double * n
    q, qd, qdd = states(n)
    truth = expected(model, q, qd, qdd)
    names = list(Program.of(model).outputs)
    for row in range(len(q)):
        outputs = [vector() for _ in names]
        function(*(vector(*values[row]) for values in (q, qd, qdd)), *outputs)
        for name, output in zip(names, outputs, strict=True):
            np.testing.assert_allclose(list(output), truth[name][row], rtol=0, atol=1e-9)


def test_base_parameters_need_fewer_operations_than_all_of_them() -> None:
    model = lwr()
    chain, rows = table2()
    structure = ModelStructure(chain)
    base = numeric_base(structure)
    standard = np.zeros(structure.n_columns)
    standard[base.columns] = base.reduce(rows.ravel())
    reduced = standard.reshape(7, 17)
    small = StandardModel(chain, reduced[:, :10], reduced[:, 10:])
    q, qd, qdd = states(7)
    space: dict[str, Any] = {}
    exec(to_numpy(small), space)
    motor, joint = space["inverse_dynamics"](q, qd, qdd)
    truth = expected(model, q, qd, qdd)
    np.testing.assert_allclose(motor, truth["tau_motor"], rtol=0, atol=1e-9)
    np.testing.assert_allclose(joint, truth["tau_joint"], rtol=0, atol=1e-9)
    full, few = Program.of(model).operations, Program.of(small).operations
    assert few["multiplications"] < full["multiplications"]


def test_difference_model_has_no_rigid_part() -> None:
    chain, rows = table2()
    model = StandardModel(chain, np.zeros((7, 10)), rows[:, 10:], sides=("difference",))
    program = Program.of(model)
    assert list(program.outputs) == ["tau_difference"]
    assert program.operations["functions"] == 7
    assert "sin" not in to_c(model)


def test_coulomb_functions_other_than_sign(tmp_path: Path) -> None:
    chain, rows = table2()
    q, qd, qdd = states(7)
    for kind, function in (
        ("tanh", lambda x: np.tanh(x / 0.3)),
        ("deadband", lambda x: np.where(np.abs(x) <= 0.3, 0, np.sign(x))),
    ):
        model = StandardModel(
            chain, rows[:, :10], rows[:, 10:], sides=("difference",), coulomb_kind=kind, coulomb_width=0.3
        )
        space: dict[str, Any] = {}
        exec(to_numpy(model), space)
        ia, _, _, _, fvm, fcm, offm = model.drive.T
        truth = ia * qdd + fvm * qd + fcm * function(qd) + offm
        np.testing.assert_allclose(space["inverse_dynamics"](q, qd, qdd), truth, atol=1e-12)


def test_a_name_that_is_no_identifier_is_refused() -> None:
    with pytest.raises(ConfigurationError, match="cannot begin a C function"):
        to_c(lwr(), "my arm")


def consistent_lwr() -> StandardModel:
    """Bodies other than the URDF's, with the base parameters of Table 2."""
    chain, rows = table2()
    structure = ModelStructure(chain)
    base = numeric_base(structure)
    columns = [17 * link + position for link in range(7) for position in range(10)]
    matrix = base.matrix[:, columns]
    rigid = np.any(matrix != 0, axis=1)
    found = project(matrix[rigid], base.reduce(rows.ravel())[rigid], reference_bodies(chain.urdf_inertials()))
    assert found.exact
    return StandardModel(chain, found.bodies, rows[:, 10:])


def test_urdf_reloaded_gives_the_identified_torques() -> None:
    model = consistent_lwr()
    reloaded = pin.buildModelFromXML(to_urdf(model))
    data = reloaded.createData()
    q, qd, qdd = states(7)
    truth = expected(lwr(), q, qd, qdd)["tau_joint"]
    _, fvl, fcl, offl, *_ = lwr().drive.T
    for row in range(len(q)):
        rigid = pin.rnea(reloaded, data, q[row], qd[row], qdd[row])
        joint = rigid + fvl * qd[row] + fcl * np.sign(qd[row]) + offl
        np.testing.assert_allclose(joint, truth[row], rtol=0, atol=1e-6)
    damping = model.drive[:, 1] + model.drive[:, 4]
    np.testing.assert_allclose(reloaded.damping, damping)
    np.testing.assert_allclose(reloaded.friction, model.drive[:, 2] + model.drive[:, 5])


def test_urdf_of_a_chain_that_came_from_a_table() -> None:
    chain = odd_arm().chain
    bodies = reference_bodies(np.random.default_rng(0).normal(size=(4, 10)))
    model = StandardModel(chain, bodies, np.zeros((4, 7)))
    again = Chain.from_urdf(to_urdf(model), gravity=chain.gravity)
    np.testing.assert_allclose(again.urdf_inertials().sum(axis=0)[9], bodies[:, 9].sum())
    q, qd, qdd = states(4)
    truth = expected(model, q, qd, qdd)["tau_joint"]
    turned = StandardModel(again, again.urdf_inertials(), np.zeros((4, 7)))
    np.testing.assert_allclose(expected(turned, q, qd, qdd)["tau_joint"], truth, atol=1e-9)


def test_urdf_drops_bodies_that_are_part_of_an_identified_link() -> None:
    text = to_urdf(consistent_lwr())
    with_tool = text.replace(
        "</robot>",
        '<link name="tool"><inertial><mass value="5"/><inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" '
        'izz="1"/></inertial></link><joint name="tool_joint" type="fixed"><parent link="flange"/>'
        '<child link="tool"/></joint></robot>',
    )
    chain = Chain.from_urdf(with_tool)
    model = consistent_lwr()
    exported = to_urdf(StandardModel(chain, model.inertial, model.drive))
    np.testing.assert_allclose(Chain.from_urdf(exported).urdf_inertials(), model.inertial, atol=1e-12)


def test_urdf_writes_angles_given_with_few_digits_as_the_right_angles_they_mean() -> None:
    rough = to_urdf(consistent_lwr()).replace("1.5707963267949", "1.5708")
    chain = Chain.from_urdf(rough)
    exported = to_urdf(StandardModel(chain, consistent_lwr().inertial, np.zeros((7, 7))))
    joints = [joint.find("origin") for joint in ElementTree.fromstring(exported).findall("joint")]
    angles = " ".join("" if origin is None else origin.get("rpy", "") for origin in joints).split()
    assert angles.count("1.5707963267948966") == 3
    assert not any(angle.endswith("1.5708") for angle in angles)


@pytest.mark.parametrize("axis", ["0 0 1", "0 1 0"])
def test_urdf_has_the_kinematics_of_the_chain_however_its_angles_were_rounded(axis: str) -> None:
    text = to_urdf(consistent_lwr()).replace("1.5707963267949", "1.5708")
    text = text.replace('xyz="0 0 0.3105" rpy="0 0 0"', 'xyz="0 0 0.3105" rpy="3.1416 0 1.5708"')
    assert "3.1416" in text
    chain = Chain.from_urdf(text.replace('axis xyz="0 0 1"', f'axis xyz="{axis}"'))
    model = StandardModel(chain, consistent_lwr().inertial, np.zeros((7, 7)))
    reloaded = pin.buildModelFromXML(to_urdf(model))
    data = reloaded.createData()
    q, qd, qdd = states(7)
    truth = expected(model, q, qd, qdd)["tau_joint"]
    for row in range(len(q)):
        np.testing.assert_allclose(
            pin.rnea(reloaded, data, q[row], qd[row], qdd[row]), truth[row], rtol=0, atol=1e-9
        )


def test_impossible_bodies_are_not_exported() -> None:
    chain, rows = table2()
    bodies = rows[:, :10].copy()
    bodies[2, 5] = -1.0
    for write in (to_urdf, to_mjcf):
        with pytest.raises(ConfigurationError, match=r"link_3.*physically consistent variant"):
            write(StandardModel(chain, bodies, rows[:, 10:]))


def test_negative_friction_is_written_as_zero_and_said() -> None:
    model = consistent_lwr()
    drive = model.drive.copy()
    drive[3] = [-1.0, 0.0, 0.0, 0.0, -2.0, 1.0, 0.0]
    changed = StandardModel(model.chain, model.inertial, drive)
    for text in (to_urdf(changed), to_mjcf(changed)):
        assert "damping of A3 was estimated as -2" in text
    assert "drive inertia of A3 was estimated as -1" in to_mjcf(changed)


def test_mjcf_says_what_the_model_says() -> None:
    model = consistent_lwr()
    root = ElementTree.fromstring(to_mjcf(model))
    joints = {joint.get("name"): joint for joint in root.iter("joint")}
    assert [float(joints[name].get("armature", "")) for name in model.chain.joint_names] == list(
        model.drive[:, 0]
    )
    pose = np.eye(4)
    for k, body in enumerate(body for body in root.iter("body") if body.get("name") != "base"):
        step = np.eye(4)
        w, x, y, z = (float(part) for part in body.get("quat", "").split())
        step[:3, :3] = pin.Quaternion(w, x, y, z).toRotationMatrix()
        step[:3, 3] = [float(part) for part in body.get("pos", "").split()]
        pose = pose @ step
        np.testing.assert_allclose(pose, model.chain.forward(np.zeros(7))[k], atol=1e-14)
        inertial = body.find("inertial")
        assert inertial is not None
        xx, yy, zz, xy, xz, yz = (float(part) for part in inertial.get("fullinertia", "").split())
        com = [float(part) for part in inertial.get("pos", "").split()]
        again = parameters.from_com(
            float(inertial.get("mass", "")), com, [[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]
        )
        np.testing.assert_allclose(again, model.inertial[k], atol=1e-14)


def test_mjcf_gives_the_torques_in_mujoco(tmp_path: Path) -> None:
    try:
        import mujoco
    except ImportError:
        pytest.skip("mujoco is not installed; the MJCF is checked without it elsewhere")
    model = consistent_lwr()
    loaded = mujoco.MjModel.from_xml_string(to_mjcf(model))
    data = mujoco.MjData(loaded)
    q, qd, qdd = states(7)
    truth = expected(model, q, qd, qdd)
    _, _, fcl, offl, _, fcm, offm = model.drive.T
    smooth = truth["tau_motor"] - (fcl + fcm) * np.sign(qd) - offl - offm
    for row in range(len(q)):
        data.qpos[:], data.qvel[:], data.qacc[:] = q[row], qd[row], qdd[row]
        mujoco.mj_inverse(loaded, data)
        np.testing.assert_allclose(data.qfrc_inverse + data.qfrc_constraint, smooth[row], atol=1e-9)


def test_a_tilted_base_is_named_where_the_format_has_no_place_for_it() -> None:
    upright = consistent_lwr()
    chain = replace(upright.chain, gravity=np.array([0.5, -1.2, -9.7]))
    model = StandardModel(chain, upright.inertial, upright.drive)
    text = to_urdf(model)
    assert "gravity [0.5 -1.2 -9.7] m/s^2 in the axes of the base" in text
    assert "tilted" not in to_urdf(upright)
    assert "tilted" not in to_mjcf(model)
    found = re.search(r'mount the base with rpy="(\S+) (\S+) 0"', text)
    assert found is not None
    mounted = pin.rpy.rpyToMatrix(float(found[1]), float(found[2]), 0.0) @ chain.gravity
    np.testing.assert_allclose(mounted, [0.0, 0.0, -np.linalg.norm(chain.gravity)], atol=1e-4)


def coupled_lwr(inertia: float) -> StandardModel:
    model = consistent_lwr()
    return StandardModel(
        model.chain, model.inertial, model.drive, (CoupledDrives((4, 5), inertia, 0.7, 1.1),)
    )


def test_coupled_drives_are_named_where_the_format_has_no_place_for_them() -> None:
    model = coupled_lwr(0.1)
    named = "the coupled drives of A4 and A5: inertia 0.1 kg m^2, viscous friction 0.7 Nm s/rad"
    assert named in to_urdf(model)
    assert "Missing in" not in to_mjcf(model)
    impossible = to_mjcf(coupled_lwr(50.0))
    assert (
        "Missing in this file, the coupled drives of A4 and A5: inertia 50 kg m^2; the torques" in impossible
    )


@pytest.mark.parametrize("share", [0.5, 0.99, -0.5])
def test_mjcf_has_coupled_drives_as_tendons(share: float) -> None:
    mujoco = pytest.importorskip("mujoco")
    first, second = consistent_lwr().drive[[4, 5], 0]
    model = coupled_lwr(share * float(np.sqrt(first * second)))
    loaded = mujoco.MjModel.from_xml_string(to_mjcf(model))
    data = mujoco.MjData(loaded)
    q, qd, qdd = states(7)
    truth = expected(model, q, qd, qdd)["tau_motor"]
    _, _, fcl, offl, _, fcm, offm = model.drive.T
    truth -= (fcl + fcm) * np.sign(qd) + offl + offm
    truth[:, [4, 5]] -= 1.1 * np.sign(qd[:, 4] + qd[:, 5])[:, None]
    for row in range(len(q)):
        data.qpos[:], data.qvel[:], data.qacc[:] = q[row], qd[row], qdd[row]
        mujoco.mj_inverse(loaded, data)
        np.testing.assert_allclose(data.qfrc_inverse + data.qfrc_constraint, truth[row], atol=1e-9)
    np.testing.assert_allclose(loaded.tendon_frictionloss, [1.1, 0.0])


def test_a_model_of_joint_torques_names_its_motors_as_unknown() -> None:
    full = consistent_lwr()
    model = StandardModel(full.chain, full.inertial, full.drive, sides=("joint",))
    for text in (to_urdf(model), to_mjcf(model)):
        assert "drive inertia and motor friction are unknown, not zero" in text
        assert "by joint: torque offset joint side [Nm]:" in text
    assert "unknown" not in to_urdf(full) + to_mjcf(full)
    assert "Not part of an MJCF file, by joint: torque offset joint side [Nm], torque offset" in to_mjcf(full)
