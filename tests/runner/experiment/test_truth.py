"""True parameters of the emulated arm beside the estimate: for any payload, and none where there are none."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from ident.dynamics.kinematics import Chain
from lwr_driver.arm import Arm
from runner.experiment_file import Experiment
from runner.results import true_base

BRICK = "{name: brick, mass: 2.5, com: [0.0, 0.02, 0.13], inertia: [0.01, 0, 0, 0.012, 0, 0.008]}"
PAPER = "{name: paper_load, mass: 3.34, com: [0.0, -0.0659, 0.1437]}"


def experiment(tmp_path: Path, payloads: list[str], more: str = "") -> Experiment:
    rows = "".join(f"  - {{name: s{k}, payload: {payload}}}\n" for k, payload in enumerate(payloads))
    path = tmp_path / "lab.yaml"
    path.write_text(f"name: test\nbackend: emulator\n{more}sessions:\n  - {{name: unloaded}}\n{rows}")
    return Experiment.load(path)


def found(*payloads: str, urdf: str | None = None) -> Any:
    """An estimate whose base parameters are the masses and first moments of the payloads, and Ia1."""
    chain = Chain.from_urdf(urdf if urdf is not None else Arm.load().urdf)
    names = ["Ia1"] + [
        f"{symbol}{link}" for link in range(8, 8 + len(payloads)) for symbol in ("M", "MY", "MZ")
    ]
    structure = SimpleNamespace(
        payloads=payloads, names=names, chain=chain, payload_link=lambda name: 7 + payloads.index(name)
    )
    return SimpleNamespace(structure=structure, base=SimpleNamespace(names=names, reduce=np.asarray))


def test_a_payload_that_the_emulator_does_not_know_has_the_announced_truth(tmp_path: Path) -> None:
    values = true_base(experiment(tmp_path, [BRICK]), found("brick"))
    assert values == pytest.approx({"Ia1": 3.14, "M8": 2.5, "MY8": 0.05, "MZ8": 0.325})


def test_several_payloads_have_a_truth_each(tmp_path: Path) -> None:
    values = true_base(experiment(tmp_path, [PAPER, BRICK]), found("paper_load", "brick"))
    assert values["M8"] == 3.34
    assert values["MZ8"] == pytest.approx(0.48)
    assert (values["M9"], values["MZ9"]) == pytest.approx((2.5, 0.325))


def test_without_payload_and_with_settings_of_the_emulator(tmp_path: Path) -> None:
    assert true_base(experiment(tmp_path, []), found()) == {"Ia1": 3.14}
    more = "emulator_settings:\n  robot.payloads: {brick: {mass: 2.0, com: [0.0, 0.0, 0.1]}}\n"
    values = true_base(experiment(tmp_path, [BRICK], more), found("brick"))
    assert values["M8"] == 2.0, "what hangs on the emulated flange, not what was announced"


def test_physics_of_another_kind_and_another_arm_have_none(tmp_path: Path) -> None:
    more = "emulator_settings:\n  robot.plant: {type: 'somewhere:Plant'}\n"
    assert true_base(experiment(tmp_path, [BRICK], more), found("brick")) == {}
    other = Arm.load().urdf.replace('<origin xyz="0 0 0.3105"', '<origin rpy="0.5 0 0" xyz="0 0 0.3105"', 1)
    other = other.replace('xyz="0 0 0.3105" rpy="0 0 0"', 'xyz="0 0 0.3105"', 1)
    assert true_base(experiment(tmp_path, [BRICK]), found("brick", urdf=other)) == {}
