"""Sessions are given as objects, paths or several of these; results show themselves shortly and as tables."""

from __future__ import annotations

import sys
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest

from fri.errors import ConfigurationError, DataError
from ident.dynamics import Chain, numeric_base
from ident.dynamics.structure import Coupling
from ident.estimation import (
    IdentificationSettings,
    compare,
    cross_validate,
    find_mounting,
    identify,
    identify_payload,
    known_settings,
    validate,
)
from ident.estimation.forward_simulation import simulate_session
from ident.model import DynamicModel
from ident.rows import SignalSettings, as_sessions
from lwr_driver.arm import Arm

PLAIN = SignalSettings(motor_delay_s=0.0)
MODEL_1 = IdentificationSettings(model=1, signals=PLAIN)


@pytest.fixture(scope="module")
def unloaded(bench: Any) -> Any:
    return bench.session("given", seed=31, periods=2)


@pytest.fixture(scope="module")
def loaded(bench: Any) -> Any:
    return bench.session("given_loaded", seed=32, payload="load", announced=3.3)


@pytest.fixture(scope="module")
def found(bench: Any, unloaded: Any) -> Any:
    return identify(unloaded, bench.chain, MODEL_1)


def test_settings_of_a_known_arm_have_its_stiffness_and_those_given_stay(bench: Any, unloaded: Any) -> None:
    stiffness = tuple(Arm.load().stiffness.tolist())
    found = known_settings(unloaded, bench.chain)
    assert (found.estimator, found.model, found.signals.stiffness_nm_rad) == ("auto", 2, stiffness)
    own = SignalSettings(stiffness_nm_rad=(5e3,) * 7)
    given = replace(MODEL_1, signals=own, couplings=(Coupling(("A5", "A6")),))
    assert known_settings(unloaded, bench.chain, given) == given


def test_settings_follow_the_sessions_and_an_unknown_arm_is_rigid(bench: Any, unloaded: Any) -> None:
    sensed = replace(unloaded, motor=None, metadata=unloaded.metadata | {"couplings": "A5:A6"})
    other = Chain.from_table([{"alpha": 0.0}, {"alpha": 1.0}])
    found = known_settings([sensed], other)
    assert (found.model, found.signals.stiffness_nm_rad) == (1, None)
    assert found.couplings == (Coupling(("A5", "A6")),)
    assert known_settings([sensed], other, model=2).model == 2


def test_without_settings_the_result_is_that_of_the_command(
    bench: Any, unloaded: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    taken = []
    monkeypatch.setattr(
        "ident.estimation.automatic.choose", lambda sessions, chain, settings, **known: taken.append(settings)
    )
    identify(unloaded.path, bench.chain)
    assert taken == [known_settings(unloaded, bench.chain)]


def bare(model: DynamicModel) -> DynamicModel:
    structure = replace(model.structure, payloads=())
    arm = [k for k, name in enumerate(model.names) if not name.endswith("8")]
    names = tuple(model.names[k] for k in arm)
    return DynamicModel(model.robot, structure, names, model.values[arm], None, numeric_base(structure))


@pytest.fixture(scope="module")
def results(truth_model: Any, bench: Any, unloaded: Any, loaded: Any, found: Any) -> dict[str, Any]:
    second = bench.session("given_second", seed=33)
    other = identify([second], bench.chain, MODEL_1)
    validation = validate(found.model, second, settings=PLAIN)
    return {
        "chain": bench.chain,
        "estimate": found.estimate,
        "assumptions": found.assumptions,
        "essential": found.essential,
        "identification": found,
        "model": found.model,
        "validation": validation,
        "score": validation.scores[0],
        "comparison": compare(found.model, other.model),
        "payload": identify_payload(bare(truth_model), loaded, settings=PLAIN),
        "cross-validation": cross_validate([unloaded, second], bench.chain, MODEL_1),
        "simulation": simulate_session(found.model, second, settings=PLAIN),
    }


def test_a_session_a_path_and_a_list_are_the_same_input(bench: Any, unloaded: Any, found: Any) -> None:
    for given in (unloaded.path, str(unloaded.path), [unloaded], (path for path in [unloaded.path])):
        again = identify(given, bench.chain, MODEL_1)
        assert again.estimate.values.tolist() == found.estimate.values.tolist()
    assert as_sessions(unloaded) == [unloaded]
    assert as_sessions([]) == []


@pytest.mark.parametrize("given", [5, None, b"loaded.mcap", [3], [None]])
def test_other_inputs_are_refused_with_advice(bench: Any, found: Any, given: Any) -> None:
    for call in (
        lambda: identify(given, bench.chain),
        lambda: validate(found.model, given),
        lambda: identify_payload(found.model, given),
        lambda: cross_validate(given, bench.chain),
        lambda: find_mounting(given, bench.chain),
    ):
        with pytest.raises(ConfigurationError, match=r"give a Session, the path of a session log"):
            call()


def test_a_missing_log_is_an_error_of_the_data(bench: Any, found: Any, tmp_path: Any) -> None:
    for call in (
        lambda: identify(tmp_path / "none.mcap", bench.chain),
        lambda: validate(found.model, str(tmp_path / "none.mcap")),
    ):
        with pytest.raises(DataError, match=r"none\.mcap"):
            call()


def test_a_model_or_chain_of_another_type_is_refused(bench: Any, unloaded: Any, found: Any) -> None:
    with pytest.raises(
        ConfigurationError, match=r"`chain` must be of type Chain, not str 'arm\.urdf'; read one"
    ):
        identify(unloaded, "arm.urdf")  # type: ignore[arg-type]
    with pytest.raises(ConfigurationError, match=r"`settings` must be of type IdentificationSettings"):
        identify(unloaded, bench.chain, {"model": 1})  # type: ignore[arg-type]
    for call in (
        lambda: validate(5, unloaded),  # type: ignore[arg-type]
        lambda: identify_payload(found, unloaded),
    ):
        with pytest.raises(ConfigurationError, match=r"`model` must be of type DynamicModel or the path"):
            call()
    with pytest.raises(ConfigurationError, match=r"`second` must be of type DynamicModel"):
        compare(found.model, found)


def test_results_have_a_short_form(results: dict[str, Any], bench: Any, found: Any) -> None:
    inside = {"problem": found.problem, "base": found.base, "prepared": found.prepared[0]}
    for name, result in {**results, **inside}.items():
        text = repr(result)
        assert len(text.splitlines()) <= 10, name
        assert max(map(len, text.splitlines())) < 200, name
        assert "array(" not in text, name
    assert " base, " in repr(results["identification"])
    assert "least certain parameters" in repr(results["estimate"])
    assert "torque error" in repr(results["validation"])
    assert repr(bench.chain).startswith("Chain of 7 joints (RRRRRRR)")


def test_results_are_tables_in_a_notebook(results: dict[str, Any]) -> None:
    for name, result in results.items():
        html = result._repr_html_()
        assert html.count("<tr>") == len(result.records()) + 1, name
        assert "&lt;" not in html, name


def test_results_become_data_frames(results: dict[str, Any], monkeypatch: pytest.MonkeyPatch) -> None:
    pandas = SimpleNamespace(DataFrame=lambda rows: ("frame", rows))
    monkeypatch.setitem(sys.modules, "pandas", pandas)
    for result in results.values():
        kind, rows = result.to_dataframe()
        assert kind == "frame"
        assert [list(row) for row in rows] == [list(row) for row in result.records()]
    assert results["estimate"].records()[0].keys() == {"name", "unit", "estimate", "std", "rsd_percent"}


def test_without_pandas_the_advice_is_to_install_it(
    results: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(ConfigurationError, match="needs pandas, which is not installed; install it"):
        results["estimate"].to_dataframe()


def test_a_chain_from_a_table_says_so() -> None:
    chain = Chain.from_table([{"alpha": 0.0}, {"kind": "prismatic"}])
    assert repr(chain) == "Chain of 2 joints (RP) q1 q2 from a table, gravity [0, 0, -9.81]"
