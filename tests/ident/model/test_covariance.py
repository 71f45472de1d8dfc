"""Singular and indefinite covariances: written, read back, and never refused for rounding."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from fri.errors import ConfigurationError, DataError
from ident.dynamics.structure import ModelStructure
from ident.model import model_file
from ident.model.covariance import nearest_covariance, rounded, smallest_eigenvalue
from ident.model.dynamic_model import DynamicModel
from ident.model.model_file import model_text, read_model, write_checked, write_model
from tests.ident.dynamics.core_arms import scara


def model(covariance: np.ndarray) -> DynamicModel:
    structure = ModelStructure(scara(), 1)
    names = structure.names[: len(covariance)]
    return DynamicModel("arm", structure, names, np.ones(len(covariance)), covariance)


def scaled(matrix: np.ndarray) -> np.ndarray:
    """The matrix with standard deviations of very different sizes."""
    scale = np.geomspace(1e-6, 1e2, len(matrix))
    return np.asarray(matrix * np.outer(scale, scale))


def singular(size: int = 40, rank: int = 6, below: float = 0.0) -> np.ndarray:
    """A covariance of fewer rows than parameters. below : taken off every eigenvalue."""
    root = np.random.default_rng(1).normal(size=(size, rank))
    return scaled(root @ root.T - below * np.eye(size))


@pytest.mark.parametrize("below", [0.0, 1e-13, 1e-7, 1e-3])
def test_a_covariance_of_few_rows_survives_its_file(tmp_path: Path, below: float) -> None:
    written = model(singular(below=below))
    write_model(written, tmp_path / "m.yaml")
    again = read_model(tmp_path / "m.yaml")
    assert again.covariance is not None
    assert smallest_eigenvalue(again.covariance) >= -1e-13
    np.testing.assert_allclose(again.std, written.std, rtol=1e-9)
    assert model_text(again) == (tmp_path / "m.yaml").read_text()
    std = np.sqrt(np.diag(again.covariance))
    change = (again.covariance - written.covariance) / np.outer(std, std)
    assert np.abs(change).max() < 2.0 * below + 1e-6


def test_a_file_of_an_indefinite_covariance_is_read_and_says_by_how_much(
    caplog: pytest.LogCaptureFixture,
) -> None:
    content = yaml.safe_load(model_text(model(scaled(np.eye(3)))))
    wrong = scaled(np.array([[1.0, 0.9, -0.9], [0.9, 1.0, 0.9], [-0.9, 0.9, 1.0]]))
    content["covariance"] = [" ".join(f"{v:.10g}" for v in row[: k + 1]) for k, row in enumerate(wrong)]
    with caplog.at_level(logging.WARNING):
        again = read_model(content)
    assert again.covariance is not None
    assert smallest_eigenvalue(again.covariance) >= 0.0
    np.testing.assert_allclose(np.diag(again.covariance), np.diag(wrong))
    assert "smallest eigenvalue of the correlations -0.8" in caplog.text
    assert "moved by up to" in caplog.text


def test_rounding_is_repaired_without_a_word(caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING):
        nearest_covariance(rounded(singular()))
    assert not caplog.text


def test_a_sound_covariance_stays_bit_for_bit() -> None:
    root = np.random.default_rng(2).normal(size=(12, 30))
    sound = scaled(root @ root.T)
    assert nearest_covariance(sound) is sound


def test_variances_of_zero_and_below_are_zero() -> None:
    covariance = np.diag([1.0, 0.0, -1e-20])
    covariance[0, 2] = covariance[2, 0] = 1e-12
    found = nearest_covariance(covariance)
    assert np.diag(found).tolist() == [1.0, 0.0, 0.0]
    assert found[0, 2] == 0.0


def test_a_model_that_cannot_be_read_back_leaves_the_old_file(tmp_path: Path, monkeypatch: Any) -> None:
    path = tmp_path / "m.yaml"
    good = model(scaled(np.eye(3)))
    write_model(good, path)
    before = path.read_text()
    monkeypatch.setattr(model_file, "model_text", lambda model: before.replace("value: 1.0", "value: 2.0"))
    with pytest.raises(
        DataError, match=r"m\.yaml: the file cannot be read back.*the parameters read back differ"
    ):
        write_model(good, path)
    assert path.read_text() == before


def test_a_place_that_cannot_be_written_is_said_so(tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match="cannot be written: No such file"):
        write_checked(tmp_path / "none" / "m.yaml", "text", lambda text: None)


def test_a_variance_without_a_point_is_read_back(tmp_path: Path) -> None:
    # `1e-12` is a number of YAML 1.2; in the file it is a row of text.
    path = tmp_path / "m.yaml"
    written = model(1e-12 * np.eye(3))
    write_model(written, path)
    assert np.allclose(read_model(path).covariance, written.covariance, rtol=1e-9)


def test_a_negative_zero_beside_a_known_parameter_is_read_back(tmp_path: Path) -> None:
    covariance = np.diag([1.0, 0.0, 2.0])
    covariance[1, 0] = covariance[0, 1] = covariance[1, 2] = covariance[2, 1] = -0.0
    write_model(model(covariance), tmp_path / "m.yaml")
    np.testing.assert_array_equal(read_model(tmp_path / "m.yaml").covariance, covariance)
