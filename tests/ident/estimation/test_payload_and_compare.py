from __future__ import annotations

import json
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner

from fri.errors import ConfigurationError, DataError
from ident.dynamics import parameters
from ident.dynamics.base_set import numeric_base
from ident.dynamics.structure import Condition, ModelStructure
from ident.estimation.compare import compare
from ident.estimation.payload import identify_payload, with_payload
from ident.estimators.covariance import CovarianceSettings
from ident.model import DynamicModel
from ident.model.model_file import read_model, write_model
from ident.rows.filters import SignalSettings
from runner.cli import main
from runner.commands.models import compare_command, export_command, payload_command, validate_command
from runner.ending import of_payload
from tests.ident.known_arm import LOAD

PLAIN = SignalSettings(motor_delay_s=0.0)


def bare(model: DynamicModel) -> DynamicModel:
    """The arm alone: the same numbers in a structure without payload."""
    structure = replace(model.structure, payloads=())
    base = numeric_base(structure)
    arm = [k for k, name in enumerate(model.names) if not name.endswith("8")]
    covariance = None if model.covariance is None else model.covariance[np.ix_(arm, arm)]
    names = tuple(model.names[k] for k in arm)
    return DynamicModel(
        model.robot, structure, names, model.values[arm], covariance, base, dict(model.provenance)
    )


@pytest.fixture(scope="module")
def loaded(bench: Any) -> Any:
    return bench.session("carrying", seed=5, payload="load", announced=3.3, periods=2)


def test_payload_of_a_perfectly_known_arm(truth_model: Any, loaded: Any) -> None:
    found = identify_payload(bare(truth_model), [loaded], settings=PLAIN)
    z = (found.values - LOAD) / found.std
    assert np.abs(z).max() < 4.0
    assert found.mass == pytest.approx(3.3, abs=0.01)
    np.testing.assert_allclose(found.com, [0.01, -0.06, 0.14], atol=0.004)
    assert not found.arm_covariance.any()
    assert "no covariance" in found.notes[0]
    assert "they agree" in found.verdict
    assert parameters.consistency(found.consistent)[0].consistent
    sharp = replace(found, covariance=1e-4 * found.covariance)
    assert all(float(part.split("±")[1].split()[0]) > 0.0 for part in sharp.centre.split(","))
    named = of_payload(found, Path("arm.yaml"), [Path("load.mcap")], None)
    assert named.next_step == "lwr-run payload arm.yaml load.mcap --out with_payload.yaml"
    known = of_payload(found, Path("arm.yaml"), [Path("load.mcap")], None, [found.payload])
    assert known.next_step == "lwr-run export arm.yaml arm.urdf --payload load"


def test_uncertainty_of_the_arm_is_part_of_the_payloads(
    estimated: Callable[..., DynamicModel], loaded: Any
) -> None:
    """Over many arm models with the stated scatter, the payload has its stated scatter."""
    z = []
    for seed in range(12):
        found = identify_payload(
            bare(estimated(seed, 0.02)), [loaded], settings=PLAIN, covariance=CovarianceSettings("textbook")
        )
        z.append((found.values - LOAD) / found.std)
        assert np.all(np.diag(found.arm_covariance) <= np.diag(found.covariance))
    spread = np.sqrt(np.mean(np.square(z)))
    assert 0.75 < spread < 1.3
    arm_share = np.diag(found.arm_covariance)[9] / found.mass_std**2
    assert arm_share > 0.5


def test_offsets_that_moved_do_not_spoil_the_payload(truth_model: Any, bench: Any) -> None:
    values = truth_model.values.copy()
    moved = truth_model.names.index("offl2")
    values[moved] += 1.5
    drifted = DynamicModel(
        truth_model.robot, truth_model.structure, truth_model.names, values, None, truth_model.base
    )
    session = bench.session("drifted", seed=6, payload="load", model=drifted)
    held = identify_payload(bare(truth_model), [session], settings=PLAIN)
    freed = identify_payload(bare(truth_model), [session], settings=PLAIN, free_offsets=True)
    assert freed.offsets["offl2"] == pytest.approx(1.5, abs=0.1)
    assert abs(freed.mass - 3.3) < 0.02
    assert np.linalg.norm(freed.values - LOAD) < np.linalg.norm(held.values - LOAD)


def test_announced_mass_that_contradicts_is_said(truth_model: Any, loaded: Any) -> None:
    wrong = replace(loaded, metadata={**loaded.metadata, "payload_mass": "2.0"})
    found = identify_payload(bare(truth_model), [wrong], settings=PLAIN)
    assert "contradict" in found.verdict
    near = replace(loaded, metadata={**loaded.metadata, "payload_mass": str(found.mass * 1.018)})
    assert "sensors' gain" in identify_payload(bare(truth_model), [near], settings=PLAIN).verdict


def test_payload_added_to_the_model_predicts_the_loaded_arm(
    estimated: Callable[..., DynamicModel], truth_model: Any, loaded: Any, bench: Any, tmp_path: Path
) -> None:
    arm = bare(estimated(3, 0.005))
    found = identify_payload(arm, [loaded], settings=PLAIN)
    whole = with_payload(arm, found)
    write_model(whole, tmp_path / "whole.yaml")
    whole = read_model(tmp_path / "whole.yaml")
    _, q, qd, qdd = bench.motion(9, 4.0, 50.0, 4.0)
    truth = truth_model.torque(q, qd, qdd, payload="load", side="joint")
    error = whole.torque(q, qd, qdd, payload="load", side="joint") - truth
    std = whole.torque_std(q, qd, qdd, payload="load", side="joint")
    assert 0.3 < np.sqrt(np.mean((error / std) ** 2)) < 2.0
    apart = whole.covariance
    assert apart is not None
    assert np.abs(apart[: len(arm.names), len(arm.names) :]).max() > 0
    with pytest.raises(ConfigurationError, match="already"):
        with_payload(whole, found)


def test_payload_needs_a_payload_and_an_arm_without_one(truth_model: Any, loaded: Any, bench: Any) -> None:
    empty = bench.session("empty", seed=7)
    with pytest.raises(DataError, match="announce no payload"):
        identify_payload(bare(truth_model), [empty], settings=PLAIN)
    pretended = replace(empty, metadata={**empty.metadata, "payload": "load"})
    standard = truth_model.standard[: 17 * 7].copy()
    standard[17 * 6 : 17 * 6 + 10] += LOAD
    arm = bare(truth_model)
    assert arm.base is not None
    heavy = replace(arm, values=arm.base.reduce(standard))
    with pytest.raises(DataError, match=r"mass is -3\.\d+ kg; it was not mounted"):
        identify_payload(heavy, [pretended], settings=PLAIN)
    other = replace(loaded, metadata={**loaded.metadata, "payload": "gripper"})
    with pytest.raises(DataError, match="different payloads"):
        identify_payload(bare(truth_model), [loaded, other], settings=PLAIN)
    structure = replace(truth_model.structure)
    always = numeric_base(structure, [Condition("load")])
    carrying = DynamicModel("LWR4+", structure, always.names, np.ones(len(always)), None, always)
    with pytest.raises(ConfigurationError, match="mounted all the time"):
        identify_payload(carrying, [loaded], settings=PLAIN)


def test_equal_models_do_not_differ_and_a_changed_parameter_does(
    estimated: Callable[..., DynamicModel],
) -> None:
    one, other = estimated(1), estimated(2)
    same = compare(one, other)
    assert len(same.differences) == len(one.names)
    assert len(same.significant) <= 1
    assert same.p > 0.001
    assert 0.7 < np.sqrt(np.nanmean([d.z**2 for d in same.differences])) < 1.3
    values = np.array(other.values)
    values[other.names.index("Fcm4")] *= 1.2
    changed = compare(one, replace(other, values=values))
    assert "Fcm4" in changed.significant
    assert changed.p < same.p
    found = next(d for d in changed.differences if d.name == "Fcm4")
    assert found.percent == pytest.approx(20.0, abs=4.0)
    assert "Fcm4" in str(changed)
    assert json.loads(json.dumps(changed.to_dict()))["parameters"]


def test_models_of_different_base_sets_meet_in_what_both_determine(truth_model: Any) -> None:
    """Model 2 apart against motor torque alone: there, friction of the two sides is one parameter."""
    chain = truth_model.structure.chain
    structure = ModelStructure(chain, 2, sides=("motor",))
    base = numeric_base(structure)
    standard = np.zeros(structure.n_columns)
    standard[: 17 * 7] = truth_model.standard[: 17 * 7]
    motor = DynamicModel("LWR4+ motors", structure, base.names, base.reduce(standard), None, base)
    found = compare(motor, truth_model)
    assert {d.name for d in found.differences} >= {"ZZ1R", "MY2R", "Fvl1R", "Fcl2R"}
    for d in found.differences:
        assert d.second == pytest.approx(d.first, abs=1e-9)
    friction = next(d for d in found.differences if d.name == "Fcl2R")
    assert friction.note == "second: Fcl2 + Fcm2"
    back = compare(truth_model, motor)
    assert "Fcm2" in back.only_first
    assert not back.only_second or all(name.endswith("R") for name in back.only_second)


def test_payloads_are_matched_by_their_name(truth_model: Any) -> None:
    structure = replace(truth_model.structure, payloads=("other",))
    base = numeric_base(structure)
    renamed = DynamicModel("LWR4+", structure, base.names, truth_model.values, None, base)
    found = compare(truth_model, renamed)
    assert set(found.only_first) == {f"{symbol}8" for symbol in parameters.INERTIAL}
    assert set(found.only_second) == set(found.only_first)


def test_arms_of_another_geometry_are_not_compared(truth_model: Any) -> None:
    lengths = truth_model.structure.chain.r.copy()
    lengths[2] += 0.1
    chain = replace(truth_model.structure.chain, r=lengths)
    structure = replace(truth_model.structure, chain=chain)
    base = numeric_base(structure)
    other = DynamicModel("long arm", structure, base.names, truth_model.values, None, base)
    with pytest.raises(ConfigurationError, match="different geometry"):
        compare(truth_model, other)


def run(command: Any, *arguments: object) -> str:
    result = CliRunner().invoke(main, [command.name, *map(str, arguments)])
    assert result.exit_code == 0, (result.output, result.exception)
    return result.output


def test_commands_work_on_files(
    estimated: Callable[..., DynamicModel], bench: Any, loaded: Any, tmp_path: Path
) -> None:
    session = bench.session("command", seed=8)
    whole, arm = tmp_path / "whole.yaml", tmp_path / "arm.yaml"
    write_model(estimated(4, 0.002), whole)
    write_model(bare(estimated(5, 0.002)), arm)
    table = run(validate_command, whole, session.path, "--against", arm)
    assert str(arm) in table
    content = json.loads(run(validate_command, whole, session.path, "--json"))
    assert len(content["sessions"][0]["scores"]) == 14
    assert "differs by more than chance" in run(compare_command, whole, arm)
    assert json.loads(run(compare_command, whole, arm, "--json"))["p"] > 0
    text = run(payload_command, arm, loaded.path, "--out", tmp_path / "with_load.yaml")
    mass = re.search(r"has (\S+) ± (\S+) kg", text)
    assert mass is not None
    assert float(mass[1]) == pytest.approx(3.3, abs=5 * float(mass[2]))
    assert read_model(tmp_path / "with_load.yaml").structure.payloads == ("load",)
    outputs = [tmp_path / name for name in ("lwr.urdf", "lwr.xml", "lwr.c", "lwr.py")]
    text = run(export_command, whole, *outputs, "--payload", "load")
    assert all(output.exists() for output in outputs)
    refused = CliRunner().invoke(main, ["export", str(whole), str(outputs[0])])
    assert refused.exit_code == ConfigurationError.exit_code
    refused = CliRunner().invoke(main, ["export", str(whole), str(tmp_path / "lwr.sdf")])
    assert "ending says the format" in refused.output


def test_a_payload_from_a_session_of_the_arm_model_is_warned_about(
    estimated: Callable[..., DynamicModel], loaded: Any
) -> None:
    arm = replace(
        bare(estimated(3, 0.005)), provenance={"sessions": [{"uid": loaded.metadata["uid"], "file": "x"}]}
    )
    found = identify_payload(arm, [loaded], settings=PLAIN)
    assert any("the arm model was fitted to carrying.mcap too" in note for note in found.notes)
    assert "standard deviations too small" in str(found)
    other = replace(arm, provenance={"sessions": [{"uid": "another", "file": "another.mcap"}]})
    assert not identify_payload(other, [loaded], settings=PLAIN).notes
