"""Files named by files: found beside them, frozen as copies, refused after a change."""

from __future__ import annotations

import hashlib
from pathlib import Path

import pytest

from fri.errors import ConfigurationError
from lwr_driver.configuration import CONFIGS, find
from lwr_driver.references import Frozen, freeze, noting, sha256


@pytest.fixture
def lab(tmp_path: Path) -> Path:
    """A folder with an experiment file, a cell beside it and another cell elsewhere."""
    for place, text in (("lab", "name: lab\n"), ("elsewhere", "name: elsewhere\n")):
        (tmp_path / place).mkdir()
        (tmp_path / place / "cell.yaml").write_text(text)
    (tmp_path / "lab/experiment.yaml").write_text("name: x\n")
    return tmp_path / "lab"


def frozen(lab: Path, *names: str) -> Path:
    """The results folder with the files of these names frozen; the folder of the frozen experiment file."""
    with noting() as found:
        for name in names:
            find(name, beside=lab)
    results = lab.parent / "results"
    freeze(lab / "experiment.yaml", found, results)
    return Frozen(results).root().parent


def test_a_name_in_a_file_never_means_the_working_directory(
    lab: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(lab.parent / "elsewhere")
    (lab.parent / "elsewhere/lwr4plus.yaml").write_text("name: wide\n")
    assert find("cell.yaml", beside=lab) == lab / "cell.yaml"
    assert find("lwr4plus.yaml", beside=lab) == CONFIGS / "lwr4plus.yaml"
    assert find("cell.yaml") == lab.parent / "elsewhere/cell.yaml"


def test_frozen_files_are_found_by_the_names_of_their_start(lab: Path) -> None:
    absolute = str(lab.parent / "elsewhere/cell.yaml")
    folder = frozen(lab, "cell.yaml", "../elsewhere/cell.yaml", absolute, "lwr4plus.yaml")
    for path in lab.rglob("*.yaml"):
        path.write_text("edited\n")
    assert find("cell.yaml", beside=folder).read_text() == "name: lab\n"
    for name in ("../elsewhere/cell.yaml", absolute):
        assert find(name, beside=folder).read_text() == "name: elsewhere\n"
    assert find("lwr4plus.yaml", beside=folder).read_bytes() == (CONFIGS / "lwr4plus.yaml").read_bytes()


def test_a_file_that_was_not_there_at_the_start_is_refused(lab: Path) -> None:
    folder = frozen(lab, "cell.yaml")
    (folder / "table.yaml").write_text("name: table\n")
    with pytest.raises(ConfigurationError, match=r"'table\.yaml' is not among the files frozen in"):
        find("table.yaml", beside=folder)


def test_a_changed_or_missing_copy_is_refused(lab: Path) -> None:
    folder = frozen(lab, "cell.yaml")
    copy = find("cell.yaml", beside=folder)
    copy.write_text("name: other\n")
    results = Frozen(folder.parents[1])
    for look in (lambda: find("cell.yaml", beside=folder), results.check):
        with pytest.raises(ConfigurationError, match=r"cell\.yaml changed since the start"):
            look()
    copy.unlink()
    with pytest.raises(ConfigurationError, match=r"cell\.yaml is missing since the start"):
        results.check()


def test_origin_and_hash_of_each_file_are_kept(lab: Path) -> None:
    results = Frozen(frozen(lab, "cell.yaml").parents[1])
    assert [file.path for file in results.files()] == [lab / "experiment.yaml", lab / "cell.yaml"]
    digest = hashlib.sha256(b"name: lab\n").hexdigest()
    assert str(results.files()[1]) == f"{digest}  {lab / 'cell.yaml'}"
    assert results.edited() == []
    (lab / "cell.yaml").write_text("name: moved\n")
    assert [file.path.name for file in results.edited()] == ["cell.yaml"]


def test_a_plan_made_later_is_kept_with_its_hash(lab: Path) -> None:
    results = Frozen(frozen(lab).parents[1])
    plan = results.folder / "plan.yaml"
    plan.write_text("half written")
    assert not results.kept("plan.yaml")
    plan.write_text("whole")
    results.keep("plan.yaml")
    assert results.kept("plan.yaml")
    plan.write_text("scaled")
    with pytest.raises(ConfigurationError, match=r"plan\.yaml changed since it was made"):
        results.kept("plan.yaml")


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"root": 1, "files": [], "references": [], "made": {}}'])
def test_a_broken_manifest_is_an_error_of_ours(lab: Path, text: str) -> None:
    folder = frozen(lab, "cell.yaml")
    (folder.parent / "files.json").write_text(text)
    with pytest.raises(ConfigurationError, match=r"files\.json: cannot be read"):
        find("cell.yaml", beside=folder)


def test_the_hash_is_that_of_the_usual_tool(tmp_path: Path) -> None:
    (tmp_path / "empty").write_bytes(b"")
    assert sha256(tmp_path / "empty").startswith("e3b0c44298fc1c14")
