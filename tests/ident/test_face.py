"""The face of `ident`: what it gives, the inputs it takes, and the figures of its results."""

from __future__ import annotations

import inspect
import subprocess
import sys
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import pandas
import pytest

import ident
from fri.errors import ConfigurationError, DataError
from ident import (
    IdentificationSettings,
    commission,
    compare,
    diagnose,
    export,
    identify,
    plan,
    read_model,
    read_session,
    validate,
    write_model,
)
from ident.diagnosis.outcome.result import Diagnosis, Finding, FindingEvidence, Unexplained, Value
from ident.rows import SignalSettings

matplotlib.use("Agg")
PLAIN = SignalSettings(motor_delay_s=0.0)
NO_SESSION = r"is neither a session nor a path; give a Session, the path"


@pytest.fixture(scope="module")
def logs(bench: Any) -> tuple[Path, Path]:
    return tuple(bench.session(f"face_{seed}", seed=seed).path for seed in (41, 42))


@pytest.fixture(scope="module")
def found(bench: Any, logs: tuple[Path, Path]) -> Any:
    return identify(logs[0], bench.chain, IdentificationSettings(model=2, signals=PLAIN))


def test_every_name_is_a_thing_of_the_library_and_no_module() -> None:
    for name in ident.__all__:
        assert not inspect.ismodule(getattr(ident, name)), name
        assert name in dir(ident)
    assert ident.__version__
    with pytest.raises(AttributeError, match="has no attribute 'identity'"):
        _ = ident.identity


def test_the_face_alone_loads_nothing_heavy() -> None:
    code = "import ident, sys; print(*{'numpy', 'scipy', 'pinocchio', 'ident.dynamics'} & {*sys.modules})"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True).stdout.strip() == ""


@pytest.mark.parametrize(
    ("package", "name"),
    [
        ("diagnosis", "diagnose"),
        ("estimation", "identify"),
        ("estimation", "compare"),
        ("excitation", "plan"),
    ],
)
def test_a_name_like_that_of_its_module_is_the_function_before_and_after_an_import(
    package: str, name: str
) -> None:
    code = (
        f"import inspect, ident.{package} as face; from importlib import import_module; "
        f"first = face.{name}; import_module('ident.{package}.{name}'); import ident.{package}.{name}; "
        f"print(inspect.isfunction(first), face.{name} is first, '{name}' in dir(face))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.stdout.split() == ["True"] * 3, done.stderr


def test_words_of_a_diagnosis_need_no_planner_and_the_package_no_numpy() -> None:
    code = (
        "import sys, ident.diagnosis; assert 'numpy' not in sys.modules; import runner.ending; "
        "print(*{'pinocchio', 'coal', 'ident.excitation.assembly', 'scipy.optimize'} & {*sys.modules})"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.stdout.strip() == "", done.stdout
    assert not done.stderr, done.stderr


def test_a_model_file_stands_for_a_model(found: Any, logs: tuple[Path, Path], tmp_path: Path) -> None:
    path = tmp_path / "model.yaml"
    write_model(found.model, path)
    by_path = validate(str(path), logs[1], settings=PLAIN)
    assert by_path.to_dict() == validate(read_model(path), read_session(logs[1]), settings=PLAIN).to_dict()
    assert not compare(path, found.model).significant
    with pytest.raises(ConfigurationError, match=r"none\.yaml"):
        validate(tmp_path / "none.yaml", logs[1])


def test_wrong_arguments_are_refused_with_advice(bench: Any, logs: tuple[Path, Path], tmp_path: Path) -> None:
    for call in (
        lambda: diagnose(5, bench.chain),  # type: ignore[arg-type]
        lambda: diagnose(logs[0], bench.chain, test=[3]),  # type: ignore[list-item]
        lambda: commission([None], bench.chain),  # type: ignore[list-item]
    ):
        with pytest.raises(ConfigurationError, match=NO_SESSION):
            call()
    with pytest.raises(ConfigurationError, match=r"sets: .* is no list of sets; give"):
        commission(str(logs[0]), bench.chain)
    with pytest.raises(ConfigurationError, match=r"`chain` must be of type Chain, not str"):
        diagnose(logs[0], "arm.urdf")  # type: ignore[arg-type]
    with pytest.raises(ConfigurationError, match=r"`reference` must be of type DynamicModel or the path"):
        diagnose(logs[0], bench.chain, reference=5)  # type: ignore[arg-type]
    with pytest.raises(ConfigurationError, match=r"`problem` must be of type PlanProblem or the path"):
        plan(5)  # type: ignore[arg-type]
    with pytest.raises(ConfigurationError, match=r"none\.yaml"):
        plan(tmp_path / "none.yaml")
    with pytest.raises(DataError, match=r"none\.mcap"):
        commission([tmp_path / "none.mcap"], bench.chain)


def test_the_ending_chooses_the_format(found: Any, tmp_path: Path) -> None:
    done = export(found.model, tmp_path / "arm.urdf", str(tmp_path / "arm.py"))
    assert done.title
    assert (tmp_path / "arm.urdf").read_text().lstrip().startswith("<")
    assert "def " in (tmp_path / "arm.py").read_text()
    with pytest.raises(ConfigurationError, match=r"exists; choose another name or allow to overwrite"):
        export(found.model, tmp_path / "arm.urdf")
    with pytest.raises(ConfigurationError, match=r"the ending says the format; known: \.urdf"):
        export(found.model, tmp_path / "arm.step")
    with pytest.raises(ConfigurationError, match=r"no output given"):
        export(found.model)
    with pytest.raises(ConfigurationError, match=r"output 3 is no path"):
        export(found.model, 3)  # type: ignore[arg-type]


def test_figures_hold_the_numbers(found: Any, logs: tuple[Path, Path]) -> None:
    session = read_session(logs[1])
    axes = session.plot()
    assert len(axes) == 3
    np.testing.assert_array_equal(axes[0].lines[2].get_ydata(), session.joint.position[:, 2])
    axes = found.plot()
    assert sum(len(axis.containers[0].lines[0].get_xdata()) for axis in axes) == len(found.base)
    result = validate(found.model, session, settings=PLAIN)
    axes = result.plot(side="joint")
    measured, computed = (line.get_ydata() for line in axes[1].lines)
    scored = np.isfinite(computed)
    (score,) = (s for s in result.scores[0].scores if (s.side, s.joint) == ("joint", axes[1].get_ylabel()))
    assert np.sqrt(np.mean((measured - computed)[scored] ** 2)) == pytest.approx(score.rms, rel=0.3)
    with pytest.raises(ConfigurationError, match=r"side 'link' has no torque; choose of: "):
        result.plot(side="link")
    with pytest.raises(ConfigurationError, match=r"session 1 of 1"):
        result.plot(1)


def test_a_diagnosis_is_short_a_table_and_a_figure(found: Any) -> None:
    finding = Finding(
        cause="joint_elasticity",
        side="joint",
        joints=(4,),
        parameters={"compliance": Value(1.2e-4, 1e-5, "rad/Nm")},
        evidence=FindingEvidence(80.0, 1e-9, 0.25, 0.21, (0.02, 0.06)),
        confidence=0.98,
        alternatives=(),
        tell_apart="",
        gain=90.0,
    )
    rms = {"motor": np.full(7, 0.3), "joint": np.full(7, 0.2)}
    less = {side: 0.9 * values for side, values in rms.items()}
    diagnosis = Diagnosis(
        train=("a.mcap",),
        test=("b.mcap",),
        model_number=2,
        findings=(finding,) * 12,
        unexplained=(Unexplained("motor", 2, ("speed",), 0.3, 0.2),),
        noise_floor=less,
        rms_base=rms,
        rms_extended=less,
        base_model=found.model,
        extended_model=found.model,
        changes={},
        scores={},
        nuisance={},
    )
    lines = repr(diagnosis).splitlines()
    assert len(lines) <= 10
    assert lines[0] == "Diagnosis of a.mcap"
    assert lines[1].startswith("12 causes found")
    assert lines[2].lower().startswith("joint elasticity, joint a3: ")
    assert "compliance 0.00012 ± 1e-05 rad/Nm" in lines[2]
    assert lines[-1].startswith("... and ")
    table = diagnosis.to_dataframe()
    assert isinstance(table, pandas.DataFrame)
    assert table.loc[0, "rms_after"] == 0.21
    axes = diagnosis.plot()
    assert [axis.get_title() for axis in axes] == ["motor torque", "joint torque"]
    assert [bar.get_height() for bar in axes[1].containers[1]] == pytest.approx([0.2] * 7)


@pytest.mark.slow
def test_a_reference_is_kept_in_a_file(bench: Any, logs: tuple[Path, Path], tmp_path: Path) -> None:
    reference = commission([logs[0]], bench.chain)
    assert repr(reference).startswith("Reference of ")
    assert len(repr(reference).splitlines()) <= 10
    reference.save(tmp_path / "healthy.yaml")
    by_path = diagnose(logs[1], bench.chain, reference=str(tmp_path / "healthy.yaml"))
    by_value = diagnose([read_session(logs[1])], bench.chain, reference=reference)
    assert by_path.details["reference"]
    assert {row["side"] for row in by_path.details["rows"]} == {"motor", "joint"}
    said = ("cause", "kind", "joint", "parameters")
    assert [[row[k] for k in said] for row in by_path.records()] == [
        [row[k] for k in said] for row in by_value.records()
    ]
    np.testing.assert_allclose(by_path.healthy_left["joint"], reference.left["joint"])
    # One healthy set: parts of its motion, predicted in turn.
    assert np.all(reference.left["joint"] < 3.0 * by_path.rms_base["joint"])
    assert np.all(reference.left["joint"] > reference.noise["joint"] / 3.0)
    # The file keeps ten digits of the covariance.
    np.testing.assert_allclose(by_path.rms_base["joint"], by_value.rms_base["joint"], rtol=1e-6)
