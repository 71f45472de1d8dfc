"""Gear ratios and couplings of an arm are those that it was commissioned with."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ident.diagnosis import ArmData, Reference
from ident.diagnosis.healthy.bench import known_drives, nominal_arm
from ident.dynamics.base_set import numeric_base
from ident.dynamics.kinematics import Chain
from ident.dynamics.structure import Coupling, ModelStructure
from ident.model import DynamicModel
from ident.model.model_file import read_model
from tests.ident.diagnosis.references import bare_reference

RATIO = np.array([101.0, 80.0, 50.0])


@pytest.fixture
def healthy(chain: Chain, tmp_path: Path) -> Reference:
    """As read from its file."""
    structure = ModelStructure(chain, 1, couplings=(Coupling(chain.joint_names[1:3]),))
    base = numeric_base(structure)
    model = DynamicModel("arm", structure, base.names, np.ones(len(base)), np.eye(len(base)), base)
    bare_reference(model, gear_ratio=RATIO).save(tmp_path / "healthy.yaml")
    return Reference.of(read_model(tmp_path / "healthy.yaml"))


def test_a_diagnosis_needs_no_gear_ratio_beside_its_reference(healthy: Reference, chain: Chain) -> None:
    np.testing.assert_array_equal(nominal_arm(chain, None, healthy).gear_ratio, RATIO)
    other = ArmData(gear_ratio=np.full(3, 100.0))
    np.testing.assert_array_equal(nominal_arm(chain, other, healthy).gear_ratio, RATIO)
    assert known_drives(None, healthy).couplings == healthy.model.structure.couplings != ()


def test_a_reference_without_gear_ratios_leaves_those_of_the_description(
    healthy: Reference, chain: Chain
) -> None:
    described = ArmData(gear_ratio=np.full(3, 100.0))
    unknown = replace(healthy, gear_ratio=None)
    np.testing.assert_array_equal(nominal_arm(chain, described, unknown).gear_ratio, np.full(3, 100.0))
    np.testing.assert_array_equal(nominal_arm(chain, None, unknown).gear_ratio, np.ones(3))
