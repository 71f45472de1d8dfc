"""Mangled input: a fixed part of the campaign, and what only chance should find."""

from __future__ import annotations

import os
import warnings
from pathlib import Path

import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from benchmarks.trust import targets
from benchmarks.trust.input import mangle
from fri.errors import ConfigurationError
from fri.packets import CMD_SIZE
from runner.experiment_file import Experiment

ACCEPTED = ("ok", "refused")


@pytest.mark.parametrize("name", list(targets.TARGETS))
def test_good_input_is_taken(name):
    assert [targets.check(name, data) for data in targets.corpus(name)] == ["ok"] * len(targets.corpus(name))


@pytest.mark.parametrize("name", list(targets.TARGETS))
def test_mangled_input_is_refused_or_right(name):
    corpus = targets.corpus(name)
    for number in range(40):
        random = np.random.default_rng([1, number])
        data = mangle(name, corpus[number % len(corpus)], random)
        assert targets.check(name, data) in ACCEPTED, number


@pytest.mark.long
@pytest.mark.parametrize("name", list(targets.TARGETS))
def test_more_mangled_input(name):
    corpus = targets.corpus(name)
    for number in range(1000, 2000):
        random = np.random.default_rng([1, number])
        assert targets.check(name, mangle(name, corpus[number % len(corpus)], random)) in ACCEPTED, number


@given(st.binary(max_size=3 * CMD_SIZE))
def test_arbitrary_datagrams_never_move_the_set_point_out_of_its_limits(data):
    assert targets.check("command", data) == "ok"
    assert targets.check("measurement", data) == "ok"


@pytest.mark.parametrize("name", list(targets.TARGETS))
@settings(max_examples=15, derandomize=True, deadline=None)
@given(st.data())
def test_good_input_with_anything_put_over_it_is_refused_or_right(name, data):
    base = data.draw(st.sampled_from(targets.corpus(name)))
    place = data.draw(st.integers(0, len(base)))
    patch = data.draw(st.binary(max_size=40))
    kept = data.draw(st.sampled_from([len(base), place]))
    changed = base[:place] + patch + base[place + len(patch) : kept]
    assert targets.check(name, changed) in ACCEPTED


def test_urdf_that_cannot_be_the_name_of_a_file():
    assert targets.check("urdf", b"\x00'") == "refused"


def test_signalling_nan_in_a_command_is_objected_to_without_a_warning():
    good = bytearray(targets.corpus("command")[0])
    # The first command is answered in monitor mode, the second one counts.
    good[CMD_SIZE + 144 : CMD_SIZE + 148] = b"\x01\x00\xa0\x7f"
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert targets.check("command", bytes(good)) == "ok"


def test_yaml_that_would_run_a_program_is_refused(tmp_path):
    mark = tmp_path / "mark"
    file = tmp_path / "bad.yaml"
    file.write_text(f"name: !!python/object/apply:os.mkdir ['{mark}']\n")
    with pytest.raises(ConfigurationError):
        Experiment.load(file)
    assert not mark.exists()


@pytest.mark.parametrize("name", ["../up", "a/b", "/abs", "..", "", "a\nb", "a b"])
def test_names_that_would_become_paths_are_refused(tmp_path, name):
    file = tmp_path / "bad.yaml"
    for content in ({"name": name}, {"name": "good", "sessions": [{"name": name}]}):
        file.write_text(yaml.safe_dump(content))
        with pytest.raises(ConfigurationError):
            Experiment.load(file)


def test_only_safe_loading_of_yaml():
    root = Path(__file__).resolve().parents[2]
    for package in ("fri", "lwr_driver", "ident", "sim_backend", "runner"):
        for file in (root / package).rglob("*.py"):
            text = file.read_text(encoding="utf-8")
            for loader in (
                "yaml.load(",
                "yaml.unsafe_load",
                "yaml.full_load",
                "pickle.load",
                "allow_pickle=True",
            ):
                if loader == "yaml.load(" and "SafeLoader" in text:
                    continue
                assert loader not in text, f"{os.fspath(file)} uses {loader}"
