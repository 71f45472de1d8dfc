"""Exports compute what the model computes, with its Coulomb function, and are checked before they are there."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fri.errors import DataError
from ident.dynamics.base_set import numeric_base
from ident.dynamics.structure import Coulomb
from ident.formats import export, files, standard_model, to_c, to_mjcf, to_numpy, to_urdf
from ident.formats.read_back import check_c, check_mjcf, check_numpy, check_urdf
from ident.model.dynamic_model import DynamicModel

LAWS = [Coulomb(), Coulomb("deadband", 0.004), Coulomb("tanh", 0.02)]


def with_law(model: DynamicModel, law: Coulomb) -> DynamicModel:
    structure = replace(model.structure, coulomb=law)
    conditions = None if model.base is None else model.base.conditions
    base = numeric_base(structure, conditions)
    return DynamicModel(model.robot, structure, base.names, model.values, None, base)


def slow_states(width: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    q, qd, qdd = np.random.default_rng(7).normal(size=(3, 60, 7))
    qd[:40] *= width or 1e-3
    qd[0] = 0.0
    return q, qd, qdd


@pytest.mark.parametrize("law", LAWS, ids=lambda law: law.kind)
def test_code_follows_the_models_coulomb_function(truth_model: DynamicModel, law: Coulomb) -> None:
    model = with_law(truth_model, law)
    states = slow_states(law.width)
    space: dict[str, Any] = {}
    text = to_numpy(standard_model(model, payload="load"))
    exec(text, space)
    motor, joint = space["inverse_dynamics"](*states)
    np.testing.assert_allclose(motor, model.torque(*states, payload="load", side="motor"), atol=1e-9)
    np.testing.assert_allclose(joint, model.torque(*states, payload="load", side="joint"), atol=1e-9)
    check_numpy(text, model, "load")
    assert check_c(to_c(standard_model(model, payload="load"), "arm"), model, "load", "arm") == "" or not (
        shutil.which("cc")
    )


def test_code_of_another_law_is_found(truth_model: DynamicModel) -> None:
    model = with_law(truth_model, Coulomb("tanh", 0.02))
    other = with_law(truth_model, Coulomb("tanh", 0.03))
    with pytest.raises(DataError, match="its motor torque differs from the model's"):
        check_numpy(to_numpy(standard_model(other)), model, None)
    if shutil.which("cc"):
        with pytest.raises(DataError, match="its motor torque differs from the model's"):
            check_c(to_c(standard_model(other), "arm"), model, None, "arm")
        with pytest.raises(DataError, match="does not compile"):
            check_c("this is no C;", model, None, "arm")


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('<mass value="', '<mass value="1', "its torque differs"),
        ('damping="', 'damping="1', "its damping differs"),
        ('friction="', 'friction="1', "its friction differs"),
    ],
)
def test_a_urdf_of_other_numbers_is_found(
    truth_model: DynamicModel, old: str, new: str, message: str
) -> None:
    found = standard_model(truth_model, payload="load", consistent=True)
    text = to_urdf(found)
    check_urdf(text, found)
    with pytest.raises(DataError, match=message):
        check_urdf(text.replace(old, new), found)


@pytest.mark.parametrize("key", ["mass", "fullinertia", "armature", "damping", "frictionloss"])
def test_an_mjcf_of_other_numbers_is_found(truth_model: DynamicModel, key: str) -> None:
    found = standard_model(truth_model, consistent=True)
    text = to_mjcf(found)
    check_mjcf(text, found)
    with pytest.raises(DataError, match="differs from the model's"):
        check_mjcf(text.replace(f'{key}="', f'{key}="1'), found)


def test_a_bad_export_leaves_no_file(
    truth_model: DynamicModel, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def wrong(model: Any) -> str:
        return to_numpy(replace(model, drive=2.0 * model.drive))

    monkeypatch.setattr(files, "to_numpy", wrong)
    with pytest.raises(DataError, match=r"arm\.py: the file cannot be read back"):
        export(truth_model, tmp_path / "arm.py")
    assert list(tmp_path.iterdir()) == []


def test_one_bad_export_costs_no_other(
    truth_model: DynamicModel, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        files, "to_urdf", lambda model: to_urdf(model).replace("mass value=", "mass value='1' x=")
    )
    with pytest.raises(
        DataError, match=r"arm\.urdf: the file cannot be read back.*\(written: arm.py, arm.xml\)"
    ):
        export(truth_model, tmp_path / "arm.py", tmp_path / "arm.urdf", tmp_path / "arm.xml")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["arm.py", "arm.xml"]


def test_a_name_cannot_end_the_comment_of_the_code(
    estimated: Callable[..., DynamicModel], tmp_path: Path
) -> None:
    odd = replace(estimated(1), robot='arm """ */ \\ \n x')
    export(odd, tmp_path / "arm.py", tmp_path / "arm.c", tmp_path / "arm.urdf")
    assert (tmp_path / "arm.py").exists()
