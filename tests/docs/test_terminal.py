"""The command line as a whole: options, JSON, colours, exit codes, completion."""

from __future__ import annotations

import json
import os
import pty
import re
import shlex
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import click
import pytest
import yaml
from click.testing import CliRunner

from fri.errors import (
    ConfigurationError,
    DataError,
    LwrError,
    NetworkError,
    OperatorError,
    RefusedError,
    RobotError,
)
from ident.estimation.identify import ESTIMATORS
from ident.excitation import ExcitationPlan
from ident.model.model_file import read_model
from lwr_driver.configuration import find
from runner.cli import VERBS, main
from runner.laboratory import free_port
from runner.plain import as_json

LWR_RUN = str(Path(sys.executable).parent / "lwr-run")


def run(*arguments: str) -> tuple[int, str]:
    result = CliRunner().invoke(main, list(arguments))
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    return result.exit_code, result.stdout if result.exit_code == 0 else result.output


def verb(name: str) -> click.Command:
    with click.Context(main, **main.context_settings) as context:
        command = main.get_command(context, name)
    assert command is not None
    return command


# One call of each, in the folder that the documents speak of; what it must say, as a path into the JSON.
REPORTS: dict[str, tuple[str, str]] = {
    "doctor": ("doctor", "findings.0.advice"),
    "experiment": ("experiment --resume results --yes --no-diagnosis", "sessions.0.exit_status"),
    "plan": ("plan --out my.plan.yaml", "margins.0.limit"),
    "check": ("check my_lab.yaml", "loaded.0.limit"),
    "preview": ("preview my_lab.yaml --out preview.html", "tightest.distance_m"),
    "report": ("report results", "verdicts.0.level"),
    "identify": ("identify unloaded.mcap --model 1 --no-essential", "parameters.0.estimate"),
    "validate": ("validate model.yaml another.mcap", "sessions.0.scores.0.rms"),
    "commission": ("commission unloaded.mcap loaded.mcap --out commissioned.yaml", "file"),
    "diagnose": ("diagnose unloaded.mcap loaded.mcap --no-simulation --out diagnosis", "findings"),
    "compare": ("compare model.yaml another_model.yaml", "level"),
    "payload": ("payload model.yaml loaded.mcap", "payload"),
    "export": ("export model.yaml out.urdf", "files.0.format"),
    "info": ("info loaded.mcap", "metadata.robot"),
    "recover": ("recover broken.mcap", "needed"),
    "attach": ("attach bare.mcap other/loaded.trace.csv", "alignment.delay_s"),
    "import": ("import mapping.yaml recording imported.mcap", "rows_in_source"),
}
SLOW_REPORTS = ("commission", "diagnose")
MAPPING = {
    "robot": "bench arm",
    "joints": ["a"],
    "time": {"column": "t", "file": "arm.csv"},
    "position": {"file": "arm.csv", "columns": ["q"], "unit": "rad"},
    "joint_torque": {"file": "arm.csv", "columns": ["tau"], "unit": "Nm"},
}


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=pytest.mark.long) if n in SLOW_REPORTS else n for n in REPORTS]
)
def test_commands_that_report_print_one_json_value(
    name: str, workplace: Callable[[], Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    place = workplace()
    (place / "other" / "loaded.plain.mcap").rename(place / "bare.mcap")
    (place / "recording").mkdir()
    (place / "recording" / "arm.csv").write_text("t,q,tau\n0,0,1\n0.01,0.1,1.1\n0.02,0.2,1\n")
    (place / "mapping.yaml").write_text(yaml.safe_dump(MAPPING))
    stored = ExcitationPlan.load(find("plans/default.plan.yaml"))
    monkeypatch.setattr("runner.commands.plan.plan", lambda problem, report: stored)
    line, wanted = REPORTS[name]
    code, text = run(*line.split(), "--json")
    assert code == 0, text
    value = json.loads(text, parse_constant=lambda constant: pytest.fail(f"{constant} is no JSON"))
    for part in wanted.split("."):
        value = value[int(part)] if isinstance(value, list) else value[part]


def test_every_command_reports_but_two() -> None:
    assert set(VERBS) - set(REPORTS) == {"emulator", "completion"}


def test_the_emulator_tells_its_ports_as_json() -> None:
    port = free_port("127.0.0.1")
    command = [LWR_RUN, "emulator", "--json", "--lock-step", "--fri-port", str(port)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        try:
            text = process.stdout.readline()
            while not text.rstrip().endswith("}"):
                text += process.stdout.readline()
            process.send_signal(signal.SIGINT)
            assert process.wait(60) == 0
        finally:
            process.kill()
    said = json.loads(text)
    assert (said["fri_host"], said["fri_port"]) == ("127.0.0.1", port)
    assert said["pendant_port"] > 0


@pytest.mark.parametrize("name", VERBS)
def test_the_help_of_every_command_has_an_example_that_it_understands(name: str) -> None:
    command = verb(name)
    result = CliRunner().invoke(main, [name, "-h"])
    assert result.exit_code == 0
    examples = [
        line.strip() for line in str(command.help).splitlines() if line.strip().startswith("lwr-run ")
    ]
    assert examples
    for example in examples:
        call = re.split(r"\s{2,}", example)[0]
        assert call in result.output
        words = shlex.split(call.partition(" >")[0])
        assert words[1] == name
        with click.Context(main, **main.context_settings) as context:
            command.make_context(name, words[2:], parent=context)


# The same thing has the same name in every command.
MEANINGS = {
    "--out": "path",
    "--json": "boolean",
    "--yes": "boolean",
    "--force": "boolean",
    "--arm": "text",
    "--urdf": "path",
    "--port": "integer range",
    "--period-ms": "float range",
    "--allow-non-realtime": "boolean",
}


def test_options_of_one_name_are_of_one_kind_and_of_one_style() -> None:
    for name in VERBS:
        for parameter in verb(name).params:
            if not isinstance(parameter, click.Option):
                continue
            for option in (*parameter.opts, *parameter.secondary_opts):
                assert option == "-h" or (option.startswith("--") and option == option.lower()), option
                assert "_" not in option, f"{name} {option}"
                if option in MEANINGS:
                    assert parameter.type.name == MEANINGS[option], f"{name} {option}"


@pytest.mark.parametrize("name", VERBS)
def test_every_option_has_a_help_text_and_a_sentence_of_its_own(name: str) -> None:
    command = verb(name)
    assert command.help
    for parameter in command.params:
        if isinstance(parameter, click.Option) and parameter.opts[0] not in ("--estimator",):
            assert parameter.help, f"{name} {parameter.opts[0]}"
            assert parameter.help.rstrip()[-1] in ".;", f"{name} {parameter.opts[0]}"


@pytest.mark.parametrize(
    ("error", "code"),
    [
        (LwrError, 1),
        (ConfigurationError, 2),
        (RefusedError, 3),
        (OperatorError, 4),
        (RobotError, 5),
        (NetworkError, 6),
        (DataError, 7),
    ],
)
def test_exit_code_says_who_must_act(
    error: type[LwrError], code: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*arguments: Any, **named: Any) -> None:
        raise error("A4 is 3 rad, limit 2 rad; move it")

    monkeypatch.setattr(verb("info"), "callback", fail)
    result = CliRunner().invoke(main, ["info", "some.mcap"])
    assert result.exit_code == code
    assert result.output.strip() == f"{error.__name__}: A4 is 3 rad, limit 2 rad; move it"
    assert result.stdout == ""


@pytest.mark.parametrize("error", [KeyboardInterrupt, click.Abort])
def test_ctrl_c_is_the_operators(error: type[BaseException], monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*arguments: Any, **named: Any) -> None:
        raise error

    monkeypatch.setattr(verb("info"), "callback", fail)
    assert CliRunner().invoke(main, ["info", "some.mcap"]).exit_code == 4


def test_wrong_usage_is_2() -> None:
    assert run("identify", "--model", "4", "a.mcap")[0] == 2
    assert run("fly")[0] == 2


def test_colours_on_a_terminal_only(tmp_path: Path) -> None:
    command = [LWR_RUN, "info", str(tmp_path / "none.mcap")]
    plain = subprocess.run(command, capture_output=True)
    assert b"\x1b[" not in plain.stderr
    assert plain.returncode == 2 or plain.returncode == 7
    leader, follower = pty.openpty()
    subprocess.run(command, stderr=follower, stdout=follower)
    os.close(follower)
    shown = os.read(leader, 65536)
    os.close(leader)
    assert b"\x1b[31m" in shown


@pytest.mark.parametrize(
    ("typed", "wanted"),
    [
        (["lwr-run", "ide"], "identify"),
        (["lwr-run", "identify", "--estimator", "phy"], "physical"),
        (["lwr-run", "doctor", "--pe"], "--period-ms"),
    ],
)
def test_the_shell_completes_commands_options_and_choices(typed: list[str], wanted: str) -> None:
    environment = os.environ | {
        "_LWR_RUN_COMPLETE": "bash_complete",
        "COMP_WORDS": " ".join(typed),
        "COMP_CWORD": str(len(typed) - 1),
    }
    done = subprocess.run([LWR_RUN], env=environment, capture_output=True, text=True, check=True)
    assert wanted in {line.split(",")[-1] for line in done.stdout.splitlines()}


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_completion_scripts_name_the_program(shell: str) -> None:
    code, text = run("completion", shell)
    assert code == 0
    assert f"_LWR_RUN_COMPLETE={shell}_complete" in text


def test_bash_takes_the_script(tmp_path: Path) -> None:
    _, text = run("completion", "bash")
    script = tmp_path / "completion.bash"
    script.write_text(text)
    subprocess.run(["bash", "-n", str(script)], check=True)


def test_json_is_always_valid() -> None:
    import numpy as np

    text = as_json(
        {"a": float("inf"), "b": np.array([1.0, np.nan]), "c": (Path("x"), np.int64(3), None, True)}
    )
    assert json.loads(text) == {"a": None, "b": [1.0, None], "c": ["x", 3, None, True]}


@pytest.mark.parametrize("estimator", ESTIMATORS)
def test_every_estimator_is_reached(estimator: str, workplace: Callable[[], Path]) -> None:
    workplace()
    arguments = ["unloaded.mcap", "loaded.mcap", "--model", "1", "--no-essential", "--covariance", "textbook"]
    code, text = run("identify", *arguments, "--estimator", estimator, "--json")
    assert code == 0, text
    content = json.loads(text)
    masses = [entry["estimate"] for entry in content["parameters"] if entry["name"] == "M8"]
    assert content["essential"] is None
    # Some settle on a prior or are still under way; none may be far off.
    assert masses[0] == pytest.approx(3.34, abs=0.7)


def test_settings_reach_the_identification(workplace: Callable[[], Path]) -> None:
    place = workplace()
    sessions = ["unloaded.mcap", "loaded.mcap", "--model", "1"]
    code, text = run(
        "identify", *sessions, "--essential", "--keep", "MX7", "--drop", "Fvl", "--out", "small.yaml"
    )
    assert code == 0, text
    small = read_model(place / "small.yaml")
    assert "MX7" in {name.rstrip("R") for name in small.names}
    assert not [name for name in small.names if name.startswith("Fvl")]
    options = ["--standstill-share", "1", "--cutoff-hz", "8", "--coulomb", "tanh:0.01", "--without", "offl"]
    code, text = run("identify", *sessions, *options, "--coupling", "A5:A6", "--no-essential", "--json")
    assert code == 0, text
    content = json.loads(text)
    assert content["sessions"][0]["cutoff_hz"] == 8.0
    assert not [entry for entry in content["parameters"] if entry["name"].startswith("offl")]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--tuning", "2"], "--tuning is for huber and tukey, not for wls"),
        (["--coupling", "A5"], "does not name two joints"),
        (["--coulomb", "tanh"], "width 0.0 must be positive"),
        (["--payload", "other.mcap=block"], "write FILE=NAME"),
        (["--payload", "loaded.mcap=block:heavy"], "'heavy' is no mass in kg"),
        (["--no-essential", "--keep", "M8"], "leave --no-essential"),
        (["--keep", "M8", "--drop", "M8"], "in both"),
        (["--prior-strength", "much", "--estimator", "map"], "neither a number nor one of evidence"),
    ],
)
def test_options_that_make_no_sense_are_refused(
    options: list[str], message: str, workplace: Callable[[], Path]
) -> None:
    workplace()
    code, text = run("identify", "unloaded.mcap", "loaded.mcap", "--model", "1", *options)
    assert code == 2
    assert message in " ".join(text.split())


def test_the_payload_of_a_log_can_be_corrected(workplace: Callable[[], Path]) -> None:
    workplace()
    arguments = ["unloaded.mcap", "loaded.mcap", "--model", "1", "--no-essential", "--json"]
    code, text = run("identify", *arguments, "--payload", "loaded.mcap=block:3.3")
    assert code == 0, text
    assert [session["payload"] for session in json.loads(text)["sessions"]] == [None, "block"]


def test_json_of_recover_attach_and_export(workplace: Callable[[], Path]) -> None:
    place = workplace()
    code, text = run("recover", "broken.mcap", "--json")
    assert code == 0
    assert json.loads(text)["needed"] is True
    (place / "other" / "loaded.plain.mcap").rename(place / "bare.mcap")
    code, text = run("attach", "bare.mcap", "other/loaded.trace.csv", "--json")
    assert code == 0
    assert json.loads(text)["alignment"]["delay_std_s"] < 1e-3
    code, text = run("export", "model.yaml", "out.urdf", "out.c", "--json")
    assert [entry["format"] for entry in json.loads(text)["files"]] == ["URDF", "C"]
