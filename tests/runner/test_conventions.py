"""What holds for every command: missing inputs, existing outputs, JSON of errors, completion, suggestions."""

from __future__ import annotations

import ast
import io
import json
import os
import subprocess
import sys
from pathlib import Path

import click
import pytest
from click.testing import CliRunner

from lwr_driver.configuration import CONFIGS
from lwr_driver.listing import Listing
from runner import status
from runner.cli import VERBS, main
from runner.output import OutputFile, set_aside
from runner.terminal import NAMED_FILE, InputPath

LWR_RUN = str(Path(sys.executable).parent / "lwr-run")

ROOT = Path(__file__).resolve().parents[2]

# One call of each command with a missing input.
MISSING = (
    "doctor none.yaml",
    "record none.yaml",
    "hold none.yaml",
    "jog A6 2 none.yaml",
    "home none.yaml",
    "home --poses none.yaml",
    "experiment none.yaml",
    "experiment --resume none",
    "experiment --reveal none",
    "plan none.yaml",
    "check none.yaml",
    "preview none.yaml",
    "replay none",
    "report none",
    "report none --figures paper",
    "emulator none.yaml",
    "emulator --program none.src",
    "identify none.mcap",
    "validate none.yaml none.mcap",
    "commission none.mcap --out m.yaml",
    "commission --experiment none.yaml --out m.yaml",
    "diagnose none.mcap --out d",
    "compare none.yaml none.yaml",
    "batch none",
    "payload none.yaml none.mcap",
    "export none.yaml m.urdf",
    "info none.mcap",
    "recover none.mcap",
    "attach none.mcap none.csv --force",
    "import none.yaml none.csv m.mcap",
    "schema --refer none.yaml",
)


def lwr_run(line: str) -> tuple[int, str, str]:
    done = CliRunner().invoke(main, line.split())
    return done.exit_code, done.stdout, done.stderr


@pytest.mark.parametrize("line", MISSING)
def test_a_missing_file_is_code_2_and_json_says_so(
    line: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    code, out, said = lwr_run(line)
    assert code == 2, said
    assert "none" in said
    assert out == ""
    code, out, again = lwr_run(f"{line} --json")
    assert (code, again) == (2, said)
    answer = json.loads(out)
    assert answer["exit_code"] == 2
    assert answer["kind"] in ("ConfigurationError", "FileError")
    assert f"{answer['kind']}: {answer['error']}\n" == said
    assert not list(tmp_path.rglob("*.mcap"))


def test_every_command_with_an_input_was_tried() -> None:
    tried = {line.split()[0] for line in MISSING}
    assert set(VERBS) - tried == {"init", "completion", "example", "trend"}


def test_a_near_name_of_a_missing_file_is_suggested(tmp_path: Path) -> None:
    (tmp_path / "loaded.mcap").write_bytes(b"")
    assert f"did you mean {tmp_path / 'loaded.mcap'}?" in lwr_run(f"info {tmp_path}/laoded.mcap")[2]


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("indentify a.mcap", "did you mean 'identify'?"),
        ("fly", "`lwr-run -h` lists the commands"),
        ("identify --estimatr wls a.mcap", "--estimator"),
        ("experiment --ot results", "--out"),
    ],
)
def test_a_misspelt_word_is_told_with_the_nearest_one(line: str, words: str) -> None:
    code, out, said = lwr_run(line)
    assert (code, out) == (2, "")
    assert words in said
    code, out, _ = lwr_run(f"{line} --json")
    answer = json.loads(out)
    assert (code, answer["exit_code"]) == (2, 2)
    assert words in answer["error"] or answer["kind"] == "NoSuchOption"


# The output is looked at first, so the inputs need not be there.
REPLACING = (
    "identify none.mcap --out {}",
    "commission none.mcap --out {}",
    "payload none.yaml none.mcap --out {}",
    "export none.yaml {}",
    "recover none.mcap --out {}",
    "attach none.mcap none.csv --out {}",
    "import none.yaml none.csv {}",
    "plan none.yaml --out {}",
    "preview none.yaml --out {}",
    "replay none --out {}",
    "diagnose none.mcap --out {}/..",
    "report . --figures {}/..",
    "init {}/..",
    "schema none --out {}",
    "trend --store none --out {}",
    "compare none.yaml none.yaml --report {}",
)


@pytest.mark.parametrize("line", REPLACING)
def test_nothing_that_exists_is_replaced_without_force(
    line: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "out").mkdir()
    place = tmp_path / "out" / "kept"
    place.write_text("mine")
    code, _, said = lwr_run(line.format(place).replace("/kept/..", ""))
    assert code == 2
    assert "--force" in said
    assert place.read_text() == "mine"
    name = line.split()[0]
    if name != "init":
        assert "--force" not in lwr_run(f"{line.format(place).replace('/kept/..', '')} --force")[2]
        assert place.read_text() == "mine"


def test_every_command_with_an_output_was_tried() -> None:
    tried = {line.split()[0] for line in REPLACING}
    for name in VERBS:
        command = main.get_command(click.Context(main), name)
        assert command is not None
        replaces = any(isinstance(one.type, OutputFile) and one.type.replaces for one in command.params)
        assert replaces == (name in tried), name


@pytest.mark.parametrize(
    "line",
    ["record --out {}", "record --poses {}", "hold --out {}", "jog A6 1 --out {}", "home --out {}"],
)
def test_a_log_of_the_arm_is_never_replaced(line: str, tmp_path: Path) -> None:
    place = tmp_path / "kept.mcap"
    place.write_text("mine")
    code, _, said = lwr_run(line.format(place))
    assert (code, place.read_text()) == (2, "mine")
    assert "exists; choose another name" in said


@pytest.mark.parametrize("line", ["plan", "preview"])
def test_a_default_output_that_exists_is_not_replaced_either(
    line: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "default.plan.yaml").write_text("mine")
    (tmp_path / "preview.html").write_text("mine")
    monkeypatch.setattr("ident.excitation.planner.plan", lambda *arguments: pytest.fail("planned"))
    code, _, said = lwr_run(line)
    assert code == 2
    assert "exists; choose another name, or replace it with --force" in said


def test_a_file_set_aside_comes_back_after_a_failure(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    path.write_text("old")

    def fail() -> None:
        with set_aside(path):
            path.write_text("half of the new one")
            raise KeyError

    with pytest.raises(KeyError):
        fail()
    assert path.read_text() == "old"
    with set_aside(path):
        path.write_text("new")
    assert (path.read_text(), os.listdir(tmp_path)) == ("new", ["a.mcap"])


def complete(words: list[str]) -> list[str]:
    environment = os.environ | {
        "_LWR_RUN_COMPLETE": "bash_complete",
        "COMP_WORDS": " ".join(words),
        "COMP_CWORD": str(len(words) - 1),
    }
    done = subprocess.run([LWR_RUN], env=environment, capture_output=True, text=True, check=True)
    return done.stdout.splitlines()


def test_a_shell_completes_files() -> None:
    assert complete(["lwr-run", "experiment", "my"]) == ["file,my"]


@pytest.mark.parametrize("name", VERBS)
def test_every_path_is_completed_as_a_file(name: str) -> None:
    command = main.get_command(click.Context(main), name)
    assert command is not None
    words = ("FILE", "SESSION", "MODEL", "FOLDER", "SOURCE", "OUTPUT", "TRACE", "CONFIG", "MAPPING", "URDF")
    context = click.Context(command)
    for one in command.params:
        shown = one.make_metavar(context).strip("[].").upper()
        path = isinstance(one.type, click.Path)
        assert path == isinstance(one.type, (InputPath, OutputFile, type(NAMED_FILE)))
        if isinstance(one, click.Argument) and shown.rstrip("S") in words:
            assert path, f"{name} {shown}"
        if path:
            (item,) = one.shell_complete(context, "my")
            assert item.type == "file"


def test_one_json_value_is_printed_when_checks_fail(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "fast.yaml").write_text(
        "name: fast\nmoves: {clearance_m: 0.5}\nexcitation: {plan: plans/default.plan.yaml}\n"
    )
    code, out, said = lwr_run("check fast.yaml --json")
    answer = json.loads(out)
    assert (code, answer["exit_code"], answer["kind"]) == (3, 3, "RefusedError")
    assert answer["unloaded"]
    assert answer["error"] in said


def test_verbose_stands_before_or_behind_the_command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    seen: list[int] = []
    command = main.get_command(click.Context(main), "completion")
    assert command is not None
    from runner.terminal import verbosity

    monkeypatch.setattr(command, "callback", lambda **named: seen.append(verbosity()))
    for line in ("completion bash", "-v completion bash", "completion bash -v", "-v completion -v bash"):
        assert lwr_run(line)[0] == 0
    assert seen == [0, 1, 1, 2]


@pytest.mark.parametrize(
    "line",
    ["experiment --yes", "hold --yes", "jog A6 1 --yes", "home --yes", "commission --yes --out m.yaml"],
)
def test_a_real_arm_is_moved_by_a_named_file_alone(
    line: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    text = (CONFIGS / "experiments/default.yaml").read_text()
    text = text.replace("backend: emulator", "backend: fri").replace("lock_step: true", "lock_step: false")
    Path("experiment.yaml").write_text(text)
    code, _, said = lwr_run(line)
    assert code == 2
    assert "moves a real arm" in said
    assert "name it" in said


def test_a_damaged_log_is_not_replaced_by_its_repair(tmp_path: Path) -> None:
    log = tmp_path / "a.mcap"
    log.write_bytes(b"damaged")
    code, _, said = lwr_run(f"recover {log} --out {log} --force")
    assert (code, log.read_bytes()) == (2, b"damaged")
    assert "the damaged log itself" in said


def echoed() -> dict[str, str]:
    """What the code prints past `runner.status`, by module."""
    found = {}
    for path in [*(ROOT / "runner").rglob("*.py")]:
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Call) and ast.unparse(node.func) in (
                "click.echo",
                "print",
                "click.secho",
            ):
                text = ast.unparse(node.args[0])
                if not text.startswith("to_json("):
                    found[f"{path.relative_to(ROOT / 'runner')}: {text}"] = text
    return found


def test_every_command_writes_for_people_in_one_way() -> None:
    # JSON aside: text of other programs, a word at Ctrl-C, the answers of a process to its parent.
    assert {place.partition(":")[0] for place in echoed()} == {
        "cli.py",
        "commands/schema.py",
        "commands/setup.py",
        "live.py",
    }
    assert len(echoed()) == 5


WIDE = Listing(("predictor", *(f"A{k} error" for k in range(30))), [("model", *["1234.567"] * 30)])


def test_a_pipe_gets_whole_lines_without_colours(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("COLUMNS", "CI"):
        monkeypatch.delenv(name, raising=False)
    stream = io.StringIO()
    status.write(WIDE, stream=stream)
    status.write("ok   " + "word " * 60, "red", stream=stream)
    lines = stream.getvalue().splitlines()
    assert len(lines) == 3
    assert min(map(len, lines)) > 250
    assert "\x1b" not in stream.getvalue()


@pytest.mark.parametrize("columns", [40, 80, 200])
def test_a_wide_table_is_broken_into_tables_that_fit(columns: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(status, "watched", lambda stream: True)
    monkeypatch.setenv("COLUMNS", str(columns))
    stream = io.StringIO()
    status.write(WIDE, stream=stream)
    text = stream.getvalue()
    assert max(map(len, text.splitlines())) <= columns
    assert text.count("1234.567") == 30
    assert text.count("predictor") == text.count("model") > 1


def test_verdict_words_of_a_table_have_their_colour(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(status, "watched", lambda stream: True)
    monkeypatch.delenv("NO_COLOR", raising=False)
    monkeypatch.setenv("FORCE_COLOR", "1")
    monkeypatch.setenv("TERM", "xterm")
    stream = io.StringIO()
    rows = [("ok", "position"), ("FAIL", "clearance")]
    status.write(Listing(("", "condition"), rows), stream=stream)
    assert "\x1b[32mok" in stream.getvalue()
    assert "\x1b[1;31mFAIL" in stream.getvalue()


def _numbers() -> list[tuple[str, click.Parameter]]:
    context = click.Context(main)
    commands = {verb: main.get_command(context, verb) for verb in VERBS}
    return [
        (verb, param)
        for verb, command in commands.items()
        if command is not None
        for param in command.params
        if isinstance(param.type, click.types.FloatParamType)
    ]


def test_numbers_of_every_command_are_finite():
    numbers = _numbers()
    assert len(numbers) > 8
    for verb, param in numbers:
        for text in ("nan", "inf", "-inf"):
            with pytest.raises(click.BadParameter, match=r"no finite number|not in the range"):
                param.type.convert(text, param, None)
            assert verb


def test_a_program_of_the_command_line_lies_in_the_working_folder(tmp_path, monkeypatch):
    asked = []

    class Emulator:
        def __init__(self, config, settings, **_):
            asked.append(settings["fri.program"])
            raise FileNotFoundError(2, "no emulator here")

    monkeypatch.setattr("sim_backend.process.EmulatorProcess", Emulator)
    monkeypatch.chdir(tmp_path)
    (tmp_path / "my_lab.src").write_text("DEF my_lab( )\nEND\n")
    (tmp_path / "cell").mkdir()
    for name in ("arm.yaml", "beside.src"):
        (tmp_path / "cell" / name).write_text("")
    for line in (
        "--program my_lab.src",
        "--program rcprg",
        "cell/arm.yaml --program beside.src",
        "--program cell/beside.src",
        "cell/arm.yaml --program ../my_lab.src",
    ):
        CliRunner().invoke(main, ["emulator", *line.split()])
    beside = str(tmp_path / "cell/beside.src")
    assert asked == [str(tmp_path / "my_lab.src"), "rcprg", "beside.src", beside, "../my_lab.src"]
    result = CliRunner().invoke(main, ["emulator", "--program", "my_lap.src"])
    assert result.exit_code == 2
    assert "did you mean my_lab.src?" in result.output
