"""Reading of YAML into dataclasses: strict, and helpful where it refuses."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import pytest

from fri.errors import ConfigurationError
from lwr_driver.configuration import find, parse, read_mapping, read_yaml, yaml_text
from lwr_driver.places import Place


@dataclass(frozen=True)
class Box:
    size: tuple[float, float, float]
    name: str = "box"


@dataclass(frozen=True)
class Cell:
    margin: float
    boxes: tuple[Box, ...] = ()
    mode: Literal["fast", "slow"] = "slow"
    limit: float | None = None
    table: dict[str, float] | None = None

    def __post_init__(self) -> None:
        if self.margin < 0:
            raise ConfigurationError(f"margin {self.margin} m is negative; give 0 or more")


def test_nested_content_becomes_dataclasses() -> None:
    content = {"margin": 1, "boxes": [{"size": [1, 2.5, 3]}], "mode": "fast", "table": {"a": 2}}
    cell = parse(Cell, content, "cell.yaml")
    assert cell == Cell(1.0, (Box((1.0, 2.5, 3.0)),), "fast", None, {"a": 2.0})


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ({"margn": 1}, "cell.yaml: unknown key `margn`; did you mean `margin`?"),
        ({}, "cell.yaml: key `margin` is missing"),
        ({"margin": "wide"}, "cell.yaml: `margin`: expected a number, found the text 'wide'"),
        ({"margin": float("nan")}, "not a finite number"),
        ({"margin": True}, "expected a number, found the truth value True"),
        ({"margin": 0.1, "boxes": [{"size": [1, 2]}]}, "`boxes`[0]: `size`: expected 3 entries, found 2"),
        ({"margin": 0.1, "mode": "quick"}, "'quick' is not one of fast, slow"),
        ({"margin": -1}, "cell.yaml: margin -1.0 m is negative"),
        ([], "expected a mapping of keys, found a list"),
    ],
)
def test_a_mistake_is_named_with_its_place(content: object, message: str) -> None:
    with pytest.raises(ConfigurationError) as caught:
        parse(Cell, content, "cell.yaml")
    assert message in str(caught.value)


def test_files_are_found_beside_and_in_configs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    beside = tmp_path / "folder"
    beside.mkdir()
    (beside / "own.yaml").write_text("a: 1\n")
    assert find("own.yaml", beside=beside) == beside / "own.yaml"
    assert find("emulator/table2.yaml").is_file()
    with pytest.raises(ConfigurationError, match="tried"):
        find("absent.yaml")


def test_a_folder_in_place_of_a_file_is_told(tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match=f"{tmp_path.name}: is a folder; give a file in it$"):
        read_yaml(tmp_path)


def test_syntax_errors_name_file_and_line(tmp_path: Path) -> None:
    broken = tmp_path / "broken.yaml"
    broken.write_text("a: [1, 2\nb: 3\n")
    with pytest.raises(ConfigurationError, match=r"broken\.yaml:2: not valid YAML(.|\n)*line 2"):
        read_mapping(broken)


@pytest.mark.parametrize(
    ("name", "words"), [("a" * 5000, "File name too long"), ("~nobody_of_this_name/arm.yaml", "home")]
)
def test_a_name_that_no_file_can_have_is_refused_in_short(name: str, words: str) -> None:
    with pytest.raises(ConfigurationError, match=words) as caught:
        find(name)
    assert len(str(caught.value)) < 250


@pytest.mark.parametrize("text", ["5e-05", "5E-5", "-1e3", "1.5e3", "+.5e2", "2.e4", "5.0e-05"])
def test_a_number_with_an_exponent_is_a_number(text: str, tmp_path: Path) -> None:
    (tmp_path / "a.yaml").write_text(f"value: {text}\nname: '{text}'\n")
    content = read_yaml(tmp_path / "a.yaml")
    assert content == {"value": float(text), "name": text}
    (tmp_path / "b.yaml").write_text(yaml_text(content))
    assert read_yaml(tmp_path / "b.yaml") == content


@pytest.mark.parametrize("text", ["e5", "5e", "1e5abc", "A1e5", "5e-", "1.2.3e4"])
def test_a_text_that_only_resembles_a_number_stays_text(text: str, tmp_path: Path) -> None:
    (tmp_path / "a.yaml").write_text(f"value: {text}\n")
    assert read_yaml(tmp_path / "a.yaml") == {"value": text}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("margin: 1\nmodus: fast\n", "cell.yaml:2: unknown key `modus`"),
        ("mode: fast\nmargin: wide\n", "cell.yaml:2: `margin`: expected a number"),
        ("margin: 1\nboxes:\n  - size:\n      - 1\n      - two\n      - 3\n", "cell.yaml:5: `boxes`[0]"),
        ("mode: fast\nmargin: -1\n", "cell.yaml:2: margin -1.0 m is negative"),
        ("margin: 1\nboxes:\n  - size: [1, 1, 1]\n  - name: b\n", "cell.yaml:4: `boxes`[b]: key `size` is missing"),
        ("margin: 1\ntable:\n  a: 1\n  b: x\n", "cell.yaml:4: `table`.b: expected a number"),
        ("x-load: &box\n  size: [1, 2]\nboxes: [*box]\nmargin: 1\n", "cell.yaml:1: unknown key `x-load`"),
        ("margin: 1\nboxes: [&a {size: [1, 1, 1]}, {<<: *a, name: 3}]\n", "cell.yaml:2: `boxes`[1]: `name`"),
        ("mode: fast\n", "cell.yaml: key `margin` is missing"),
        ("- 1\n", "cell.yaml: expected a mapping"),
        ("margin: 1\nmode: [\n", "cell.yaml:3: not valid YAML"),
    ],
)  # fmt: skip
def test_a_mistake_is_named_with_file_and_line(text: str, message: str, tmp_path: Path) -> None:
    path = tmp_path / "cell.yaml"
    path.write_text(text)
    with pytest.raises(ConfigurationError) as caught:
        parse(Cell, read_yaml(path), path)
    assert message in str(caught.value)


def test_of_several_files_the_one_with_the_key_is_named(tmp_path: Path) -> None:
    below, above = tmp_path / "below.yaml", tmp_path / "above.yaml"
    below.write_text("\nmargin: wide\nlimit: high\n")
    above.write_text("limit: low\n")
    place = Place(str(above), (above, below), frozenset({"mode"}))
    assert str(place.key("margin")) == f"{below}:2: `margin`"
    assert str(place.key("limit")) == f"{above}:1: `limit`"
    assert str(place.key("mode")) == f"{above}: `mode`"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            "boxes: [a]\nmargin: 1\nboxes: []\n",
            ":3: key `boxes` stands twice, in line 1 and in line 3; keep one",
        ),
        ('a:\n  - {x: 1, "x": 2}\n', ":2: key `x` stands twice, in line 2 and in line 2"),
        ("base: &b {x: 1}\nsame:\n  <<: {y: 1, y: 2}\n", ":3: key `y` stands twice"),
    ],
)
def test_a_repeated_key_is_refused_with_both_lines(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "cell.yaml"
    path.write_text(text)
    with pytest.raises(ConfigurationError) as caught:
        read_yaml(path)
    assert f"{path}{message}" in str(caught.value)


def test_merged_keys_may_be_replaced(tmp_path: Path) -> None:
    path = tmp_path / "cell.yaml"
    path.write_text(
        "a: &a {x: 1, y: 1}\nb: &b {y: 2}\nc: {<<: [*a, *b], x: 3}\nd:\n  <<: *a\n  <<: *b\n  x: 4\n"
    )
    content = read_yaml(path)
    assert content["c"] == {"x": 3, "y": 1}
    assert content["d"]["x"] == 4


def test_a_folder_in_place_of_a_file_is_told_as_that(tmp_path: Path) -> None:
    (tmp_path / "lab").mkdir()
    (tmp_path / "lab/arm.yaml").touch()
    with pytest.raises(ConfigurationError, match=r"lab is a folder; name a file in it: arm\.yaml"):
        find(tmp_path / "lab")
